//! Loads at the flange: set by request, and with objects of known mass that a robot holds.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use crate::runtime::arm::arm_requests::{order, refused};
use crate::runtime::{Service, internal};
use dimos_control::request::Request;
use dimos_core::arm::Load;
use dimos_core::joint::STANDSTILL;
use dimos_core::telemetry::describe::Severity;
use dimos_core::telemetry::{Phase, TaskState};
use dimos_hardware::adapter::AdapterError;
use dimos_robot::dynamics::{RestingEffort, find_load};
use dimos_rpc::api::{self, AttachReply, LoadReport, PayloadReply, Reply, Request as Call};
use dimos_rpc::report::end_of_lead;
use dimos_rpc::{Code, RpcError};

/// How long a controller may count an arm as moving that is at rest here: after this time a refused load is tried once
/// more. Not more often: a try may reset the controller.
const SETTLING_TIME: Duration = Duration::from_millis(500);

/// The objects that an arm holds and whose mass is known.
#[derive(Debug, Default)]
pub(in crate::runtime) struct HeldLoads {
    /// The load that was set without them, by this run.
    set: Option<Load>,
    /// The load without them, known when the first one was attached.
    base: Load,
    /// By name.
    objects: BTreeMap<String, Load>,
}

/// A load that the controller has taken.
struct Written {
    /// As the controller reports it.
    payload: Option<LoadReport>,
    /// Whether the arm is as ready as before: a controller may reset when its load is set.
    ready: Result<(), RpcError>,
}

impl HeldLoads {
    fn total(&self) -> Load {
        self.objects.values().fold(self.base, |sum, load| sum.plus(load))
    }
}

impl Service {
    /// Reads the load that an arm's controller calculates with.
    pub(in crate::runtime) async fn payload(&self, id: &str) -> Result<PayloadReply, RpcError> {
        let arm = self.facts.arm_index(id)?;
        self.takes_payload(arm)?;
        let load = order(self.arms.device(arm)?.read_payload()).await;
        let load = load.map_err(|e| refused(id, "did not report its payload", &e))?;
        Ok(PayloadReply { payload: load.map(LoadReport::from) })
    }

    /// Sets the load at an arm's flange: all of it, with the objects that the arm holds.
    pub(in crate::runtime) async fn set_payload(&self, call: api::ArmPayloadSet) -> Result<Reply, RpcError> {
        let arm = self.facts.arm_index(&call.arm)?;
        self.takes_payload(arm)?;
        let held = &mut *self.tools.held.get(arm as usize).ok_or_else(internal)?.lock().await;
        let written = self.write_payload(arm, &call.load()).await?;
        held.objects.clear();
        held.set = Some(call.load());
        written.ready?;
        Ok(Reply::ArmPayloadSet(PayloadReply { payload: written.payload }))
    }

    /// Finds the load at an arm's flange from its efforts at rest.
    pub(in crate::runtime) fn find_payload(&self, call: &api::ArmPayloadFind) -> Result<api::FoundPayload, RpcError> {
        let arm = self.facts.arm_index(&call.arm)?;
        let own = self.facts.blueprint.arms.get(arm as usize).ok_or_else(internal)?;
        let unknown = |what: String| {
            let what = format!("the weight of {} cannot be computed: {what}", call.arm);
            RpcError::new(Code::Unsupported, what)
                .hint("a model with the masses of its links: `model_path` in the blueprint")
        };
        let (mut dynamics, flange) = own.unloaded_dynamics().map_err(unknown)?;
        let of = |list: &[api::RestingEffort]| -> Vec<RestingEffort> {
            let one =
                |at: &api::RestingEffort| RestingEffort { position: at.position.clone(), effort: at.effort.clone() };
            list.iter().map(one).collect()
        };
        let unloaded = Some(of(&call.unloaded)).filter(|list| !list.is_empty());
        let found = find_load(&mut dynamics, flange, &of(&call.loaded), unloaded.as_deref());
        let found = found.map_err(|what| RpcError::new(Code::InvalidParams, what))?;
        Ok(api::FoundPayload { mass: found.mass, center: found.center, residual: found.residual })
    }

    fn takes_payload(&self, arm: u16) -> Result<(), RpcError> {
        if self.facts.connected.get(arm as usize).is_some_and(|connected| connected.has_payload) {
            return Ok(());
        }
        let what = format!("the controller of {} takes no payload", self.facts.names.arm(arm));
        Err(RpcError::new(Code::Unsupported, what).hint("its page in docs/arms lists what the adapter supports"))
    }

    /// Sets a load at rest. After an error the controller has the load that it had.
    async fn write_payload(&self, arm: u16, load: &Load) -> Result<Written, RpcError> {
        let most = self.facts.blueprint.arms.get(arm as usize).and_then(|arm| arm.setup.max_payload);
        load.within(most).map_err(|what| RpcError::new(Code::InvalidParams, what).hint(Load::TOO_HEAVY))?;
        self.rests(arm)?;
        let name = self.facts.names.arm(arm);
        if self.tick.phase(arm as usize) == Phase::Led {
            let hint = end_of_lead(&name, self.led_by(arm));
            return Err(RpcError::new(Code::ArmNotReady, format!("{name} is led")).hint(hint));
        }
        let resets = self.facts.connected.get(arm as usize).is_some_and(|connected| connected.payload_resets);
        let again = resets && matches!(self.tick.phase(arm as usize), Phase::Activating | Phase::Ready);
        if again {
            self.ask(Request::PrepareDisable { arm }).await?;
            self.wait_for_rest(&name, arm, Instant::now()).await?;
        }
        let device = self.arms.device(arm)?;
        let mut actual = order(device.set_payload(*load)).await;
        if matches!(actual, Err(AdapterError::Rejected(_))) {
            self.tick.until(Instant::now() + SETTLING_TIME, || None::<()>).await;
            self.rests(arm)?;
            actual = order(device.set_payload(*load)).await;
        }
        let ready = if again { self.enable(name.clone(), false).await.map(drop) } else { Ok(()) };
        let actual = actual.map_err(|e| refused(&name, "did not take the payload", &e))?;
        let [x, y, z] = load.center;
        self.tick
            .dispatcher()
            .log(Severity::Info, format!("{name}: payload set to {:.3} kg at {x:.4} {y:.4} {z:.4} m", load.mass));
        // Each load is logged, also one that is soon replaced.
        self.log_details();
        Ok(Written { payload: actual.map(LoadReport::from), ready })
    }

    /// Returns an error while an arm moves or executes a motion.
    pub(in crate::runtime) fn rests(&self, arm: u16) -> Result<(), RpcError> {
        let joints = self.facts.joints_of_arm(arm);
        let tasks = self.facts.config.tasks.iter().enumerate();
        let mut of_arm = tasks.filter(|(_, task)| task.joints.iter().any(|j| joints.contains(j)));
        // A stream at rest does not move the arm.
        let executes = |index| {
            let view = self.tick.task_view(index);
            view.motion > 0 && matches!(view.state, TaskState::Executing | TaskState::Cancelling)
        };
        let busy = of_arm.find(|(index, _)| executes(*index)).map(|(_, task)| &task.name);
        let (name, speed) = (self.facts.names.arm(arm), self.tick.speed(arm));
        let what = match busy {
            Some(task) => format!("{name} moves: task {task} is executing"),
            None if speed > STANDSTILL => format!("{name} moves at {speed:.2} rad/s"),
            None => return Ok(()),
        };
        Err(RpcError::new(Code::ArmNotReady, what).hint("this is done at rest: wait, or end the motion first"))
    }

    /// Attaches an object to a robot; with a mass, the arm's controller is set to carry it.
    pub(in crate::runtime) async fn attach(&self, call: api::Attach) -> Result<Reply, RpcError> {
        let (name, robot) = (call.name.clone(), call.robot.clone());
        let arm = match call.mass {
            Some(_) => self.arm_of_robot(&robot).await?.filter(|arm| self.takes_payload(*arm).is_ok()),
            None => None,
        };
        let Some(arm) = arm else { return self.planner_call(Call::Attach(call)).await };
        let held = &mut *self.tools.held.get(arm as usize).ok_or_else(internal)?.lock().await;
        self.rests(arm)?;
        let Reply::Attach(attached) = self.planner_call(Call::Attach(call)).await? else { return Err(internal()) };
        let carried = match attached.load {
            Some(load) => self.carry(arm, held, &name, Some(load.into())).await,
            None => Err(internal()),
        };
        match carried {
            Ok(written) => {
                written.ready?;
                Ok(Reply::Attach(AttachReply { payload: written.payload, ..attached }))
            }
            Err(error) => {
                // An object that the controller does not carry stays in the world.
                let _ = self.planner_call(Call::Detach(api::Detach { name })).await;
                Err(error)
            }
        }
    }

    /// Detaches an object; the controller no longer carries its mass.
    pub(in crate::runtime) async fn detach(&self, call: api::Detach) -> Result<Reply, RpcError> {
        for (arm, held) in self.tools.held.iter().enumerate() {
            let held = &mut *held.lock().await;
            if held.objects.contains_key(&call.name) {
                self.rests(arm as u16)?;
                let name = call.name.clone();
                // One that no robot holds any longer, after an error or in a planner that was started again, still
                // weighs on the controller.
                let detached = match self.planner_call(Call::Detach(call)).await {
                    Err(error) if !matches!(error.code, Code::UnknownObject | Code::WrongObject) => {
                        return Err(error);
                    }
                    detached => detached,
                };
                self.carry(arm as u16, held, &name, None).await?.ready?;
                return detached;
            }
        }
        self.planner_call(Call::Detach(call)).await
    }

    /// Returns the arm whose load an `attach` or `detach` changes.
    pub(in crate::runtime) async fn arm_of_load(&self, call: &Call) -> Result<Option<u16>, RpcError> {
        match call {
            Call::Attach(attach) if attach.mass.is_some() => self.arm_of_robot(&attach.robot).await,
            Call::Detach(detach) => {
                for (held, arm) in self.tools.held.iter().zip(0..) {
                    if held.lock().await.objects.contains_key(&detach.name) {
                        return Ok(Some(arm));
                    }
                }
                Ok(None)
            }
            _ => Ok(None),
        }
    }

    /// Adds or removes an object of an arm's load, and sets the load.
    async fn carry(
        &self,
        arm: u16,
        held: &mut HeldLoads,
        object: &str,
        load: Option<Load>,
    ) -> Result<Written, RpcError> {
        if held.objects.is_empty() {
            let name = self.facts.names.arm(arm);
            let configured = self.facts.blueprint.arms.get(arm as usize).and_then(|arm| arm.setup.payload);
            // What was set counts, even if the controller has lost it since: it is set again with the motors.
            held.base = match held.set.or(configured) {
                Some(set) => set,
                None => {
                    let read = order(self.arms.device(arm)?.read_payload()).await;
                    read.map_err(|e| refused(&name, "did not report its payload", &e))?.unwrap_or_default()
                }
            };
        }
        let before = match load {
            Some(load) => held.objects.insert(object.to_owned(), load),
            None => held.objects.remove(object),
        };
        let set = self.write_payload(arm, &held.total()).await;
        if set.is_err() {
            match before {
                Some(before) => held.objects.insert(object.to_owned(), before),
                None => held.objects.remove(object),
            };
        }
        set
    }

    /// Returns the arm of a planning robot; `None` if it has no joints of an arm.
    pub(in crate::runtime) async fn arm_of_robot(&self, robot: &str) -> Result<Option<u16>, RpcError> {
        let Reply::Planner(report) = self.planner_call(Call::Planner(api::Planner {})).await? else {
            return Err(internal());
        };
        let joints = report.robots.into_iter().find(|found| found.name == robot).map(|found| found.joints);
        let arms = self.facts.names.arms.iter();
        Ok(joints.and_then(|joints| {
            arms.zip(0..).find(|(arm, _)| joints.iter().any(|j| arm.joints.contains(j))).map(|(_, index)| index)
        }))
    }
}
