//! A run as the program that started it sees it: what can be asked over rpc, as methods that wait for the answer.

use std::sync::Arc;
use std::time::Duration;

use super::in_process;
use super::service::Service;
use crate::rpc::api::{
    ArmDisable, ArmEnable, ArmReply, ArmReset, Cancel, CancelReply, Execute, ExecuteReply, Gripper, Method, Move,
    MoveReply, Servo, Stop, StopReply, Trajectory, Velocity,
};
use crate::rpc::report::{MotionReport, StateReport, StatusReport};
use crate::rpc::{Code, RpcError};

/// Poll period while waiting for a motion.
const INTERVAL: Duration = Duration::from_millis(10);

/// A way to talk to a run of this process. Clones talk to the same run, from any thread.
///
/// Units are SI: rad, rad/s, m, s. A refusal has a [`Code`] for programs, a sentence, and a hint for people; when the
/// run has ended everything but `status` and `state` is refused with [`Code::ShuttingDown`]. Methods wait for their
/// answer, so they belong on threads of one's own and not in async code, which they would hold up.
#[derive(Clone)]
pub struct Handle {
    pub(super) service: Arc<Service>,
}

impl Handle {
    /// The run's name.
    pub fn name(&self) -> &str {
        &self.service.parts.run
    }

    /// Everything about the run: arms, tasks, timing, recorder.
    pub fn status(&self) -> StatusReport {
        self.service.status()
    }

    /// The latest joint states and commands.
    pub fn state(&self) -> StateReport {
        self.service.state()
    }

    /// Moves an arm from where it is to joint positions [rad], directly: not collision-checked. `speed` is a fraction
    /// of the velocity and acceleration limits, 0.1–1. Returns when the motion begins; [`wait`](Self::wait) waits for
    /// its end. Refused where a limit is in the way, the arm is not ready, or its task is executing already.
    pub fn move_arm(&self, arm: &str, target: &[f64], speed: f64) -> Result<MoveReply, RpcError> {
        self.call(Move { arm: arm.to_owned(), target: target.to_vec(), speed })
    }

    /// Follows a trajectory, by the task whose joints cover it. Returns when the motion begins. Refused where it does
    /// not start where the arm is, or breaks a limit.
    pub fn execute(&self, trajectory: Trajectory) -> Result<ExecuteReply, RpcError> {
        self.call(Execute { trajectory, task: None })
    }

    /// How a motion goes, or how it ended.
    pub fn motion(&self, motion: u64) -> Result<MotionReport, RpcError> {
        self.service.motion(motion)
    }

    /// Waits for the end of a motion. Its `state` is `COMPLETED` when the arm has arrived; else `error` says why not.
    /// After replanning around an obstacle: the report of the motion that continued.
    pub fn wait(&self, motion: u64) -> Result<MotionReport, RpcError> {
        let mut motion = motion;
        loop {
            let report = self.motion(motion)?;
            match report.next {
                Some(next) if report.done => motion = next,
                _ if report.done => return Ok(report),
                _ => {}
            }
            if self.service.is_closed() {
                return Err(RpcError::new(Code::ShuttingDown, format!("the run ends during motion {motion}")));
            }
            std::thread::sleep(INTERVAL);
        }
    }

    /// Ends all motions by decelerating within limits.
    pub fn cancel(&self) -> Result<CancelReply, RpcError> {
        self.call(Cancel::default())
    }

    /// Holds all arms at once, latched: tasks are cancelled, and nothing moves an arm until it is reset and enabled.
    /// An operational stop, not a safety function.
    pub fn stop_arms(&self) -> Result<StopReply, RpcError> {
        self.call(Stop { arm: None })
    }

    /// The same for one arm.
    pub fn stop_arm(&self, arm: &str) -> Result<StopReply, RpcError> {
        self.call(Stop { arm: Some(arm.to_owned()) })
    }

    /// Clears a latched hold or a fault of an arm. Moves nothing, enables nothing. Refused while the cause is present.
    pub fn reset(&self, arm: &str) -> Result<ArmReply, RpcError> {
        self.call(ArmReset { arm: arm.to_owned() })
    }

    /// Enables an arm's motors and makes it ready for motion, where it is.
    pub fn enable(&self, arm: &str) -> Result<ArmReply, RpcError> {
        self.call(ArmEnable { arm: arm.to_owned() })
    }

    /// Brings an arm to rest and disables its motors; refused while it still moves. An arm without brakes falls.
    pub fn disable(&self, arm: &str) -> Result<ArmReply, RpcError> {
        self.call(ArmDisable { arm: arm.to_owned(), now: false })
    }

    /// Disables an arm's motors at once, also while it moves.
    pub fn disable_now(&self, arm: &str) -> Result<ArmReply, RpcError> {
        self.call(ArmDisable { arm: arm.to_owned(), now: true })
    }

    /// Commands the opening of a gripper [m].
    pub fn gripper(&self, arm: &str, position: f64) -> Result<(), RpcError> {
        self.call(Gripper { arm: arm.to_owned(), position }).map(drop)
    }

    /// The next target of a servo task [rad], one value per joint of the task; to be repeated within its timeout.
    pub fn servo(&self, task: &str, positions: &[f64]) -> Result<(), RpcError> {
        self.call(Servo { task: task.to_owned(), positions: positions.to_vec() }).map(drop)
    }

    /// The next target of a velocity task [rad/s], one value per joint of the task; to be repeated within its timeout.
    pub fn velocity(&self, task: &str, velocities: &[f64]) -> Result<(), RpcError> {
        self.call(Velocity { task: task.to_owned(), velocities: velocities.to_vec() }).map(drop)
    }

    /// Any method of [`api`](crate::rpc::api), checked and answered as over the socket.
    pub fn call<M: Method>(&self, params: M) -> Result<M::Reply, RpcError> {
        let answers = self.call_together(std::slice::from_ref(&params));
        answers.into_iter().next().unwrap_or_else(|| Err(in_process::defect("no answer")))
    }

    /// Asks several things at once: they reach the tick together, but for a tick now and then.
    pub fn call_together<M: Method>(&self, requests: &[M]) -> Vec<Result<M::Reply, RpcError>> {
        in_process::call(&self.service, requests)
    }
}
