//! Requests that hand an arm over: to the hand that leads it, or to its own controller. Both end by `enable`: the arm
//! is stopped where it is, and the run takes over at rest.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use nalgebra::{Isometry3, Vector3};

use super::arm_requests::{order, refused};
use super::motions::{NATIVE, Planned};
use super::planner_port::isometry;
use super::service::{Service, internal};
use crate::arm::Pose;
use crate::control::request::Request;
use crate::hardware::registry::Teach;
use crate::joint::STANDSTILL;
use crate::pose::{from_xyz_rpy, to_xyz_rpy};
use crate::robot::kinematics::pose as to_isometry;
use crate::rpc::api::{self, Reply};
use crate::rpc::{Code, RpcError};
use crate::sync::lock;
use crate::telemetry::describe::Severity;
use crate::telemetry::{Cause, LedBy, Outcome, Phase, Reason, TaskState};

/// Largest distance between the controller's own pose and the tool centre point [m]: more means different base frames.
const LARGEST_TOOL: f64 = 0.6;
/// A pose is reached within these [m, rad].
const REACHED: (f64, f64) = (1e-3, 0.01);
/// A controller that is at rest for this long has ended its motion, or does not begin it.
const ENDED_AFTER: Duration = Duration::from_secs(1);
/// Number of a native motion that a client has cancelled.
const CANCELLED: u64 = u64::MAX;

impl Service {
    /// Lets an arm be led by hand, as its adapter's row says.
    pub(super) async fn teach(&self, call: api::ArmTeach) -> Result<Reply, RpcError> {
        let arm = self.arm_index(&call.arm)?;
        let name = &call.arm;
        let way = self.parts.blueprint.arms.get(arm as usize).ok_or_else(internal)?.adapter.teach;
        let note = match way {
            Teach::No(why) => {
                let what = format!("{name} cannot be led by hand: {why}");
                return Err(RpcError::new(Code::Unsupported, what).hint(format!("dimos jog {name} moves it with keys")));
            }
            Teach::MotorsOff if !call.support_the_arm => {
                let what = format!("{name} is led with its motors off: it falls unless you support it");
                return Err(RpcError::new(Code::InvalidParams, what)
                    .hint(format!("hold the arm, then: dimos arm teach {name} --support-the-arm")));
            }
            Teach::MotorsOff => {
                self.disable(name.clone(), false).await?;
                self.ask(Request::Lead { arm, by: LedBy::HandMotorsOff }).await?;
                "led by hand, motors off: support the arm"
            }
            Teach::HandGuiding => {
                self.end_streams(&self.joints_of_arm(arm).collect::<Vec<_>>()).await?;
                self.ask(Request::Lead { arm, by: LedBy::Hand }).await?;
                if let Err(error) = order(self.device(arm)?.guide()).await {
                    let _ = self.take_over(name, arm).await;
                    return Err(refused(name, "does not begin hand guiding", &error));
                }
                "led by hand, motors on: the controller compensates gravity"
            }
        };
        self.parts.dispatcher.log(Severity::Info, format!("{name}: {note}"));
        Ok(Reply::ArmTeach(api::ArmReply {
            arm: call.arm,
            phase: Phase::Led.name().to_owned(),
            note: Some(note.into()),
        }))
    }

    /// Ends the leading of an arm that is at rest, and makes it ready.
    async fn take_over(&self, name: &str, arm: u16) -> Result<(), RpcError> {
        self.end_lead(name, arm).await?;
        self.enable(name.to_owned()).await.map(|_| ())
    }

    /// Ends the leading of an arm: it gets its own stop, unless its motors are off, and is in standby.
    pub(super) async fn end_lead(&self, name: &str, arm: u16) -> Result<(), RpcError> {
        let limit = Instant::now() + self.braking_limit(arm);
        self.ask(Request::PrepareDisable { arm }).await?;
        self.wait_for_rest(name, arm, limit).await
    }

    /// Refuses to take over an arm that still moves.
    pub(super) fn led_arm_rests(&self, name: &str, arm: u16) -> Result<(), RpcError> {
        if self.native(arm).is_some_and(|number| number != 0) {
            return Err(RpcError::new(Code::ArmNotReady, format!("{name} is moved by its own controller"))
                .hint("wait for it, or end it with `dimos cancel`"));
        }
        let speed = self.speed(arm);
        if speed <= STANDSTILL {
            return Ok(());
        }
        let what = format!("{name} still moves at {speed:.2} rad/s");
        Err(RpcError::new(Code::ArmNotReady, what).hint("hold it still, then again"))
    }

    /// Lets an arm's own controller move it to a pose. Replies when the motion begins.
    pub(super) async fn move_native(&self, call: api::MoveNative) -> Result<Reply, RpcError> {
        let arm = self.arm_index(&call.arm)?;
        if !call.direct {
            self.needs_no_plan(&call.arm)?;
        }
        let joints: Vec<u16> = self.joints_of_arm(arm).collect();
        self.end_streams(&joints).await?;
        let target = self.native_target(arm, &call)?;
        let speed = call.speed * self.speed_override().fraction;
        if self.speed_override().paused {
            let what = "motions are paused, and a native motion does not wait";
            return Err(RpcError::new(Code::ArmNotReady, what).hint("dimos resume"));
        }
        self.ask(Request::Lead { arm, by: LedBy::Controller }).await?;
        if let Err(error) = order(self.device(arm)?.move_native(target, speed)).await {
            let _ = self.take_over(&call.arm, arm).await;
            return Err(refused(&call.arm, "does not move there", &error));
        }
        let motion = self.parts.dispatcher.next_id();
        let planned =
            Planned { task: NATIVE, joints, goal: Vec::new(), duration: 0.0, plan: None, blocked: None, next: None };
        lock(&self.motions).plan(motion, planned);
        self.natives.get(arm as usize).ok_or_else(internal)?.store(motion, Ordering::Release);
        let text = format!("{}: native motion {motion}, not collision-checked", call.arm);
        self.parts.dispatcher.log(Severity::Info, text);
        let me = self.me.upgrade().ok_or_else(internal)?;
        tokio::spawn(me.watch_native(call.arm, arm, motion, target));
        Ok(Reply::MoveNative(api::NativeReply { motion, speed }))
    }

    /// Returns the pose that the controller is given: in its own base frame, of the point that it reports.
    fn native_target(&self, arm: u16, call: &api::MoveNative) -> Result<Pose, RpcError> {
        let name = self.parts.names.arm(arm);
        let own = self.arm_view(arm as usize).and_then(|view| view.state.pose);
        let own = own.ok_or_else(|| {
            let what = format!("{name} reports no pose of its own, so it does not move to one");
            RpcError::new(Code::Unsupported, what)
                .hint("a run with a planner moves to poses: `dimos move` without --native")
        })?;
        let now = from_xyz_rpy(own.xyz, own.rpy);
        let model = self.tcp_models().into_iter().nth(arm as usize).flatten();
        let measured = self.tcp_poses().into_iter().nth(arm as usize).flatten();
        let target = match (model, measured) {
            (Some(model), Some(tcp)) if !call.controller_frame => {
                let (root, tcp) = (to_isometry(&model.root), from_xyz_rpy(tcp.xyz, tcp.rpy));
                let tool = (root * now).inverse() * tcp;
                if tool.translation.vector.norm() > LARGEST_TOOL {
                    let what = format!(
                        "the pose that {name} reports is {:.3} m from the tool centre point of its model: their base \
                         frames differ",
                        tool.translation.vector.norm()
                    );
                    return Err(RpcError::new(Code::Unsupported, what)
                        .hint("give the pose in the controller's own frame: --frame controller"));
                }
                root.inverse() * goal(call, &tcp) * tool.inverse()
            }
            _ => goal(call, &now),
        };
        let (xyz, rpy) = to_xyz_rpy(&target);
        Ok(Pose { xyz, rpy })
    }

    fn native(&self, arm: u16) -> Option<u64> {
        Some(self.natives.get(arm as usize)?.load(Ordering::Acquire))
    }

    /// Cancels the native motions of these arms: each gets its own stop. Returns whether there was any.
    pub(super) async fn cancel_natives(&self, is_meant: impl Fn(u16) -> bool) -> Result<bool, RpcError> {
        let mut any = false;
        for (arm, motion) in (0..).zip(&self.natives) {
            let running = |number| (number != 0 && number != CANCELLED).then_some(CANCELLED);
            if is_meant(arm) && motion.fetch_update(Ordering::AcqRel, Ordering::Acquire, running).is_ok() {
                self.ask(Request::PrepareDisable { arm }).await?;
                any = true;
            }
        }
        Ok(any)
    }

    /// Watches a native motion until the arm is at rest, and takes the arm over.
    async fn watch_native(self: Arc<Self>, name: String, arm: u16, motion: u64, target: Pose) {
        let (target, begun) = (from_xyz_rpy(target.xyz, target.rpy), Instant::now());
        let mut still: Option<Instant> = None;
        while self.phase(arm as usize) == Phase::Led && !self.is_closed() {
            if self.speed(arm) > STANDSTILL {
                still = None;
            }
            let since = still.get_or_insert_with(Instant::now).elapsed();
            if since > ENDED_AFTER || (since > ENDED_AFTER / 10 && self.off_by(arm, &target).is_some_and(is_reached)) {
                break;
            }
            self.next_tick().await;
        }
        let off = self.off_by(arm, &target);
        let view = self.arm_view(arm as usize);
        let (phase, cause) = view.map_or((Phase::Unknown, Cause::None), |view| (view.phase, view.cause));
        let cancelled = self.native(arm) == Some(CANCELLED);
        let elapsed = begun.elapsed().as_secs_f64();
        let end = match phase {
            Phase::Held => (TaskState::Aborted, Reason::ArmHeld(arm, cause), None),
            Phase::Led | Phase::Standby if cancelled || phase == Phase::Led => {
                let taken = self.take_over(&name, arm).await;
                match (taken, off) {
                    (Err(error), _) => (TaskState::Aborted, Reason::Cancelled, Some(error.message)),
                    _ if cancelled => (TaskState::Aborted, Reason::Cancelled, None),
                    (_, Some(off)) if !is_reached(off) => {
                        let text = format!("it ended {:.4} m and {:.4} rad from the pose", off.0, off.1);
                        (TaskState::Aborted, Reason::Cancelled, Some(text))
                    }
                    _ => (TaskState::Completed, Reason::None, None),
                }
            }
            phase => {
                let outcome = Outcome::ArmNotReady(arm, phase, cause);
                let text = self.refusal(&outcome).map(|error| error.message);
                (TaskState::Aborted, Reason::Cancelled, text)
            }
        };
        lock(&self.motions).end(motion, end, elapsed, &self.positions());
        if let Some(native) = self.natives.get(arm as usize) {
            native.store(0, Ordering::Release);
        }
    }

    /// Returns how far the pose that an arm reports is from another one [m, rad].
    fn off_by(&self, arm: u16, target: &Isometry3<f64>) -> Option<(f64, f64)> {
        let own = self.arm_view(arm as usize)?.state.pose?;
        let off = from_xyz_rpy(own.xyz, own.rpy).inverse() * target;
        Some((off.translation.vector.norm(), off.rotation.angle()))
    }
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
