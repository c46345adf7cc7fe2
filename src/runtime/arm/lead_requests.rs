//! Requests that hand an arm over: to the hand that leads it, or to its own controller. Both end by `enable`: the arm
//! is stopped where it is, and the run takes over at rest.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use nalgebra::{Isometry3, Vector3};
use tokio::sync::oneshot;

use super::arm_requests::{order, refused};
use crate::runtime::client::asker::asker;
use crate::runtime::motion::motions::{NATIVE, Planned};
use crate::runtime::plan::planner_port::isometry;
use crate::runtime::{Service, internal};
use dimos_control::request::Request;
use dimos_core::arm::{ControllerPose, Pose};
use dimos_core::joint::STANDSTILL;
use dimos_core::pose::from_xyz_rpy;
use dimos_core::telemetry::describe::Severity;
use dimos_core::telemetry::{LedBy, Origin, Outcome, Phase, Reason, TaskState};
use dimos_hardware::adapter::AdapterError;
use dimos_hardware::device::Way;
use dimos_hardware::registry::Teach;
use dimos_robot::kinematics::pose as to_isometry;
use dimos_rpc::api::{self, Reply};
use dimos_rpc::report::{LED_BY_CONTROLLER, end_of_lead};
use dimos_rpc::{Code, RpcError};

/// Largest distance between the controller's own pose and the tool centre point [m]: more means different base frames.
const LARGEST_TOOL: f64 = 0.35;
/// A pose is reached within these [m, rad].
const REACHED: (f64, f64) = (1e-3, 0.01);
/// A controller whose joints make no progress for this long has ended its motion, or does not begin it.
const ENDED_AFTER: Duration = Duration::from_secs(1);
/// Progress of a joint [rad].
const PROGRESS: f64 = 2e-4;

/// A motion of an arm's own controller.
struct Native {
    name: String,
    arm: u16,
    motion: u64,
    /// In the controller's base frame, of the point that it reports.
    target: Pose,
    /// Fraction of the controller's top speed.
    speed: f64,
    origin: Origin,
}

impl Service {
    /// Lets an arm be led by hand, as its adapter's row says.
    pub(in crate::runtime) async fn teach(&self, call: api::ArmTeach, origin: Origin) -> Result<Reply, RpcError> {
        let arm = self.facts.arm_index(&call.arm)?;
        let name = &call.arm;
        let (by, note) = match self.facts.blueprint.arms.get(arm as usize).ok_or_else(internal)?.adapter.teach {
            Teach::No(why) => {
                let what = format!("{name} cannot be led by hand: {why}");
                return Err(RpcError::new(Code::Unsupported, what).hint(format!("dimos jog {name} moves it with keys")));
            }
            Teach::MotorsOff if !call.support_the_arm => {
                let what = format!("{name} is led with its motors off: it falls unless you support it");
                return Err(RpcError::new(Code::InvalidParams, what)
                    .hint(format!("hold the arm, then: dimos arm teach {name} --support-the-arm")));
            }
            Teach::MotorsOff => (LedBy::HandMotorsOff, "led by hand, motors off: support the arm"),
            Teach::HandGuiding => (LedBy::Hand, "led by hand, motors on: the controller compensates gravity"),
        };
        self.end_streams(&self.facts.joints_of_arm(arm).collect::<Vec<_>>()).await?;
        let lead = self.lead(arm, by, origin).await?;
        let device = self.arms.device(arm)?;
        let begun = order(if by == LedBy::Hand { device.lead(Way::Hand, lead) } else { device.disable() }).await;
        if let Err(error) = begun {
            let _ = self.take_over(name, arm).await;
            return Err(refused(name, "cannot be led now", &error));
        }
        if by == LedBy::HandMotorsOff {
            self.tick.next_tick().await;
            self.tick.until(self.next_report(arm), || self.tick.seen(arm, |view| !view.state.enabled)).await;
        }
        self.tick.dispatcher().log(Severity::Info, format!("{name}: {note}"));
        Ok(Reply::ArmTeach(api::ArmReply {
            arm: call.arm,
            phase: Phase::Led.name().to_owned(),
            note: Some(note.into()),
        }))
    }

    /// Makes a led arm ready.
    pub(in crate::runtime) async fn take_over_led(&self, id: String) -> Result<Reply, RpcError> {
        let phase = self.tick.phase(self.facts.arm_index(&id)?.into());
        if phase != Phase::Led {
            let what = format!("{id} is not led, or no longer: it is {}", phase.name());
            return Err(RpcError::new(Code::Unsupported, what).hint("`dimos status` shows the cause"));
        }
        match self.enable(id, false).await? {
            Reply::ArmEnable(reply) => Ok(Reply::ArmTakeOver(reply)),
            _ => Err(internal()),
        }
    }

    /// Lets the tick pass an arm on. Returns the number of this lead.
    async fn lead(&self, arm: u16, by: LedBy, origin: Origin) -> Result<u32, RpcError> {
        self.ask_from(Request::Lead { arm, by }, Some(origin)).await?;
        Ok(self.tick.arm_view(arm as usize).ok_or_else(internal)?.command.lead_seq)
    }

    /// Ends the leading of an arm whose motors are on, and makes it ready where it is.
    async fn take_over(&self, name: &str, arm: u16) -> Result<(), RpcError> {
        self.end_lead(name, arm).await?;
        order(self.arms.device(arm)?.take_over()).await.map_err(|e| refused(name, "was not taken over", &e))?;
        self.ask(Request::Enabled { arm, outside: false }).await?;
        self.until_ready(name.to_owned(), arm).await.map(|_| ())
    }

    /// Ends the leading of an arm: it gets its own stop, unless its motors are off, and is in standby.
    pub(in crate::runtime) async fn end_lead(&self, name: &str, arm: u16) -> Result<(), RpcError> {
        let began = Instant::now();
        self.ask(Request::PrepareDisable { arm }).await?;
        self.wait_for_rest(name, arm, began).await
    }

    /// Refuses to take over an arm that still moves.
    pub(in crate::runtime) fn led_arm_rests(&self, name: &str, arm: u16) -> Result<(), RpcError> {
        if self.is_native(arm) {
            return Err(RpcError::new(Code::ArmNotReady, format!("{name} is moved by its own controller"))
                .hint(end_of_lead(name, LED_BY_CONTROLLER)));
        }
        let speed = self.tick.speed(arm);
        if speed <= STANDSTILL {
            return Ok(());
        }
        let what = format!("{name} still moves at {speed:.2} rad/s");
        Err(RpcError::new(Code::ArmNotReady, what).hint("hold it still, then again"))
    }

    /// Lets an arm's own controller move it to a pose. Replies when the motion begins; a separate thread watches the
    /// motion to its end, also without its client.
    pub(in crate::runtime) async fn move_native(
        &self,
        call: api::MoveNative,
        origin: Origin,
    ) -> Result<Reply, RpcError> {
        let arm = self.facts.arm_index(&call.arm)?;
        if !call.direct {
            self.plans.needs_no_plan(&call.arm)?;
        }
        let joints: Vec<u16> = self.facts.joints_of_arm(arm).collect();
        self.end_streams(&joints).await?;
        let (target, tool) = self.native_target(arm, &call)?;
        let motion = self.tick.dispatcher().next_id();
        let planned = Planned {
            task: NATIVE,
            joints,
            goal: Vec::new(),
            duration: 0.0,
            plan: None,
            blocked: None,
            next: None,
            retraces_to: None,
            began: None,
            by: asker(),
        };
        self.motions.plan(motion, planned);
        let speed = call.speed * self.tick.speed_override().fraction;
        let native = Native { name: call.arm, arm, motion, target, speed, origin };
        let reply = api::NativeReply { motion, speed: native.speed, tool };
        let (begun, answer) = oneshot::channel();
        let me = self.me.upgrade().ok_or_else(internal)?;
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build();
        let runtime = runtime.map_err(|e| RpcError::new(Code::Internal, e.to_string()))?;
        let thread = std::thread::Builder::new().name("native".into());
        let started = thread.spawn(move || runtime.block_on(me.run_native(&native, begun)));
        started.map_err(|e| RpcError::new(Code::Internal, e.to_string()))?;
        match answer.await {
            Ok(Ok(())) => Ok(Reply::MoveNative(reply)),
            refused => {
                self.motions.forget(motion);
                refused.map_or_else(|_| Err(internal()), |result| result.map(|()| Reply::MoveNative(reply)))
            }
        }
    }

    /// Begins a native motion, sends the result to `begun`, and takes the arm over at its end.
    async fn run_native(self: Arc<Self>, native: &Native, begun: oneshot::Sender<Result<(), RpcError>>) {
        let arm = native.arm;
        let lead = match self.lead(arm, LedBy::Controller, native.origin).await {
            Ok(lead) => lead,
            Err(error) => return drop(begun.send(Err(error))),
        };
        self.set_native(arm, true);
        let ordered = match self.arms.device(arm) {
            Ok(device) => order(device.lead(Way::To(native.target, native.speed), lead)).await,
            Err(_) => Err(AdapterError::NotConnected),
        };
        if let Err(error) = ordered {
            let _ = self.take_over(&native.name, arm).await;
            self.set_native(arm, false);
            let why = match error {
                AdapterError::Unsupported => no_native_motions(&native.name),
                error => refused(&native.name, "does not move there", &error),
            };
            return drop(begun.send(Err(why)));
        }
        let text = format!("{}: native motion {}, not collision-checked", native.name, native.motion);
        self.tick.dispatcher().log(Severity::Info, text);
        let since = Instant::now();
        // The client may be gone: the motion has begun all the same.
        let _ = begun.send(Ok(()));
        let end = self.native_end(native).await;
        self.set_native(arm, false);
        let text = format!("{}: native motion {} is {}", native.name, native.motion, end.0.name());
        self.tick.dispatcher().log(Severity::Info, text);
        let elapsed = since.elapsed().as_secs_f64();
        self.motions.end(native.motion, end, elapsed, &self.positions());
    }

    /// Waits for the end of a native motion, takes the arm over, and returns how it ended.
    async fn native_end(&self, native: &Native) -> (TaskState, Reason, Option<String>) {
        let (arm, target) = (native.arm, from_xyz_rpy(native.target.xyz, native.target.rpy));
        let (mut anchor, mut since) = (self.positions(), Instant::now());
        while self.tick.phase(arm as usize) == Phase::Led && !self.lifecycle.is_closed() {
            let now = self.positions();
            if anchor.iter().zip(&now).any(|(a, b)| (a - b).abs() > PROGRESS) {
                (anchor, since) = (now, Instant::now());
            }
            let arrived = self.off_by(arm, &target).is_some_and(is_reached);
            if since.elapsed() > if arrived { ENDED_AFTER / 10 } else { ENDED_AFTER } {
                break;
            }
            self.tick.next_tick().await;
        }
        let off = self.off_by(arm, &target);
        let cancelled = self.tick.phase(arm as usize) != Phase::Led;
        let taken = match self.tick.phase(arm as usize) {
            Phase::Led | Phase::Standby if !self.lifecycle.is_closed() => self.take_over(&native.name, arm).await,
            _ => Ok(()),
        };
        let view = self.tick.arm_view(arm as usize);
        match (view.map(|view| (view.phase, view.cause)), taken, off) {
            (Some((Phase::Held, cause)), ..) => (TaskState::Aborted, Reason::ArmHeld(arm, cause), None),
            (_, Err(error), _) => (TaskState::Aborted, Reason::Cancelled, Some(error.message)),
            _ if cancelled => (TaskState::Aborted, Reason::Cancelled, None),
            (_, _, Some(off)) if is_reached(off) => (TaskState::Completed, Reason::None, None),
            (_, _, Some((m, rad))) => {
                let text = format!("it ended {m:.4} m and {rad:.4} rad from the pose");
                (TaskState::Aborted, Reason::Cancelled, Some(text))
            }
            (_, _, None) => {
                let text = "the arm no longer reports its pose".to_owned();
                (TaskState::Aborted, Reason::Cancelled, Some(text))
            }
        }
    }

    /// Returns the pose that the controller is given: in its own base frame, of the point that it reports; and how far
    /// that point is from the tool centre point [m], if the goal is one of the latter.
    fn native_target(&self, arm: u16, call: &api::MoveNative) -> Result<(Pose, Option<f64>), RpcError> {
        let name = self.facts.names.arm(arm);
        let own = self.tick.arm_view(arm as usize).and_then(|view| view.state.pose);
        let own = own.ok_or_else(|| {
            let what = format!("{name} reports no pose of its own, so it does not move to one");
            RpcError::new(Code::Unsupported, what)
                .hint("a run with a planner moves to poses: `dimos move` without --native")
        })?;
        let model = self.tcp_models().into_iter().nth(arm as usize).flatten();
        let measured = self.tcp_poses().into_iter().nth(arm as usize).flatten();
        let (target, tool) = match (model, measured) {
            (Some(model), Some(tcp)) if !call.controller_frame => {
                let flange = own.flange().ok_or_else(|| no_flange(&name, &own))?.isometry();
                let (root, tcp) = (to_isometry(&model.root), from_xyz_rpy(tcp.xyz, tcp.rpy));
                let tool = (root * flange).inverse() * tcp;
                let distance = tool.translation.vector.norm();
                if distance > LARGEST_TOOL {
                    let what = format!(
                        "the flange by the controller of {name} is {distance:.3} m from the tool centre point of its model: their \
                         base frames differ"
                    );
                    return Err(RpcError::new(Code::Unsupported, what)
                        .hint("give the pose in the controller's own frame: --frame controller"));
                }
                let goal = root.inverse() * goal(call, &tcp) * tool.inverse();
                (own.tcp_at(&goal).ok_or_else(|| no_flange(&name, &own))?, Some(distance))
            }
            _ => (goal(call, &own.tcp.isometry()), None),
        };
        Ok((Pose::from(&target), tool))
    }

    fn set_native(&self, arm: u16, runs: bool) {
        if let Some(native) = self.arms.natives.get(arm as usize) {
            native.store(runs, Ordering::Release);
        }
    }

    fn is_native(&self, arm: u16) -> bool {
        self.arms.natives.get(arm as usize).is_some_and(|native| native.load(Ordering::Acquire))
    }

    /// Returns what leads an arm that is led: `controller` or `hand`.
    pub(in crate::runtime) fn led_by(&self, arm: u16) -> &'static str {
        if self.is_native(arm) { LED_BY_CONTROLLER } else { "hand" }
    }

    /// Cancels the native motions of these arms: each gets its own stop. Returns whether there was any.
    pub(in crate::runtime) async fn cancel_natives(&self, is_meant: impl Fn(u16) -> bool) -> Result<bool, RpcError> {
        let led = |arm: &u16| is_meant(*arm) && self.tick.phase(*arm as usize) == Phase::Led;
        let mut any = false;
        for arm in (0..self.arms.natives.len() as u16).filter(led) {
            any |= self.ask(Request::EndNative { arm }).await? == Outcome::Cancelled;
        }
        Ok(any)
    }

    /// Returns how far the pose that an arm reports is from another one [m, rad].
    fn off_by(&self, arm: u16, target: &Isometry3<f64>) -> Option<(f64, f64)> {
        let own = self.tick.arm_view(arm as usize)?.state.pose?;
        let off = own.tcp.isometry().inverse() * target;
        Some((off.translation.vector.norm(), off.rotation.angle()))
    }
}

fn no_native_motions(arm: &str) -> RpcError {
    RpcError::new(Code::Unsupported, format!("the controller of {arm} takes no poses"))
        .hint("a run with a planner moves to poses: `dimos move` without --native")
}

fn no_flange(arm: &str, own: &ControllerPose) -> RpcError {
    let what = own.missing().unwrap_or("pose");
    RpcError::new(
        Code::Unsupported,
        format!("the controller of {arm} does not report its {what}: where its flange is, is not known"),
    )
    .hint("give the pose in the controller's own frame: --frame controller")
}

/// Returns the requested pose; without an orientation, that of the present one.
fn goal(call: &api::MoveNative, now: &Isometry3<f64>) -> Isometry3<f64> {
    let turned = call.pose.rpy.is_some() || call.pose.quat.is_some();
    let rotation = if turned { isometry(&call.pose).rotation } else { now.rotation };
    Isometry3::from_parts(Vector3::from(call.pose.xyz).into(), rotation)
}

fn is_reached(off: (f64, f64)) -> bool {
    off.0 <= REACHED.0 && off.1 <= REACHED.1
}
