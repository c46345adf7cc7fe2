//! Handle of a run for the program that started it: the rpc methods as blocking calls.

use std::sync::Arc;
use std::time::Duration;

use super::Service;
use super::client::in_process;
use super::watchdog;
use dimos_rpc::api::{
    ArmDisable, ArmEnable, ArmReply, ArmReset, Cancel, CancelReply, Execute, ExecuteReply, Grip, GripReport, Gripper,
    Method, Move, MoveReply, Servo, Stop, StopReply, Trajectory, Velocity,
};
use dimos_rpc::report::{MotionReport, StateReport, StatusReport};
use dimos_rpc::{Code, RpcError};

/// Poll period while waiting for a motion.
const POLL_PERIOD: Duration = Duration::from_millis(10);

/// Handle of a run in this process. Clones refer to the same run, from any thread.
///
/// Units are SI: rad, rad/s, m, s. An error has a [`Code`] for programs, a sentence, and a hint. After the end of the
/// run all methods except `status` and `state` return [`Code::ShuttingDown`]. Methods block until their reply: do not
/// call them in async code.
#[derive(Clone)]
pub struct Handle {
    service: Arc<Service>,
    /// The epoch of its requests; `None`: that in which each is made.
    epoch: Option<u64>,
}

impl Handle {
    pub(in crate::runtime) fn new(service: Arc<Service>) -> Self {
        Self { service, epoch: None }
    }

    /// Returns the run as its requests see it.
    pub(in crate::runtime) fn service(&self) -> &Arc<Service> {
        &self.service
    }

    /// Returns a handle for a motion in several parts: it no longer moves an arm that is stopped, held, disabled or
    /// lost from now on, not even after that was enabled again. Its requests are then refused with
    /// [`Code::Superseded`].
    pub fn until_interrupted(&self) -> Self {
        Self { service: self.service.clone(), epoch: Some(self.service.tick.epoch()) }
    }

    /// Returns the run's name.
    pub fn name(&self) -> &str {
        &self.service.facts.run
    }

    /// Returns the status of arms, tasks, timing and recorder.
    pub fn status(&self) -> StatusReport {
        self.service.status()
    }

    /// Returns the latest joint states and commands.
    pub fn state(&self) -> StateReport {
        self.service.state()
    }

    /// Returns the joint positions of an arm at a time within the last 2 s [s since the Unix epoch], as in
    /// [`StateReport::stamp`]: interpolated between measured states, never beyond them [rad or m]. An error if there is
    /// no such arm, or nothing is known of that time.
    pub fn joints_at(&self, arm: &str, stamp: f64) -> Result<Vec<f64>, RpcError> {
        self.service.joints_at(arm, stamp)
    }

    /// Moves an arm from its present position to joint positions [rad], directly: not collision-checked; refused if the
    /// run has a planner (call [`Move::direct`] then). `speed` is a fraction of the velocity and acceleration limits,
    /// 0.01–1. Returns when the motion begins; [`wait`](Self::wait) waits for its end. An error if a limit is exceeded,
    /// the arm is not ready, or its task is executing already.
    pub fn move_arm(&self, arm: &str, target: &[f64], speed: f64) -> Result<MoveReply, RpcError> {
        self.call(Move::new(arm, target, speed))
    }

    /// Executes a trajectory with the task that covers its joints. Returns when the motion begins. An error if it does
    /// not start at the arm's position, or exceeds a limit.
    pub fn execute(&self, trajectory: Trajectory) -> Result<ExecuteReply, RpcError> {
        self.call(Execute { trajectory, task: None, retraces_to: None })
    }

    /// Returns the progress of a motion, or how it ended.
    pub fn motion(&self, motion: u64) -> Result<MotionReport, RpcError> {
        self.service.motion(motion)
    }

    /// Waits for the end of a motion. Its `state` is `COMPLETED` if the arm arrived, otherwise `error` has the reason.
    /// After replanning around an obstacle, returns the report of the motion that continued. An error if the run shuts
    /// down or its tick hangs.
    pub fn wait(&self, motion: u64) -> Result<MotionReport, RpcError> {
        let (mut motion, mut last_beat, mut silent_for, mut used) = (motion, None, Duration::ZERO, None);
        let pulse = &self.service.tick.pulse().beat;
        let limit = 2 * watchdog::tick_timeout(self.service.facts.period());
        loop {
            let report = self.motion(motion)?;
            match report.next {
                Some(next) if report.done => motion = next,
                _ if report.done => return Ok(report),
                _ => {}
            }
            if self.service.lifecycle.is_closed() {
                return Err(RpcError::new(Code::ShuttingDown, format!("the run ends during motion {motion}")));
            }
            // Counts only the time in which this thread could run: a stall of the host also stops the tick.
            let (beat, used_before) = (pulse.last(), std::mem::replace(&mut used, pulse.cpu_time()));
            if beat != last_beat {
                silent_for = Duration::ZERO;
            } else if !pulse.is_starved(used_before, POLL_PERIOD) {
                silent_for += POLL_PERIOD;
            }
            last_beat = beat;
            if silent_for > limit {
                let what = format!("no tick for {} ms during motion {motion}", silent_for.as_millis());
                return Err(RpcError::new(Code::NoAnswer, what).hint("the tick hangs or has panicked: stop the run"));
            }
            std::thread::sleep(POLL_PERIOD);
        }
    }

    /// Cancels all motions: decelerates within limits.
    pub fn cancel(&self) -> Result<CancelReply, RpcError> {
        self.call(Cancel::default())
    }

    /// Holds all arms at once, latched: tasks are cancelled, and nothing moves an arm until it is reset and enabled.
    /// An operational stop, not a safety function.
    pub fn stop_arms(&self) -> Result<StopReply, RpcError> {
        self.call(Stop { arm: None })
    }

    /// Holds one arm at once, latched.
    pub fn stop_arm(&self, arm: &str) -> Result<StopReply, RpcError> {
        self.call(Stop { arm: Some(arm.to_owned()) })
    }

    /// Clears a latched hold or a fault of an arm. Moves and enables nothing. An error while the cause persists.
    pub fn reset(&self, arm: &str) -> Result<ArmReply, RpcError> {
        self.call(ArmReset { arm: arm.to_owned() })
    }

    /// Enables an arm's motors and makes it ready for motion, without moving it.
    pub fn enable(&self, arm: &str) -> Result<ArmReply, RpcError> {
        self.call(ArmEnable::new(arm.to_owned()))
    }

    /// Decelerates an arm to rest and disables its motors; an error if it still moves. An arm without brakes drops.
    pub fn disable(&self, arm: &str) -> Result<ArmReply, RpcError> {
        self.call(ArmDisable { arm: arm.to_owned(), now: false })
    }

    /// Disables an arm's motors at once, also while it moves.
    pub fn disable_now(&self, arm: &str) -> Result<ArmReply, RpcError> {
        self.call(ArmDisable { arm: arm.to_owned(), now: true })
    }

    /// Commands the position of a gripper: its opening [m], or the angle [rad] of a rotary one.
    pub fn gripper(&self, arm: &str, position: f64) -> Result<(), RpcError> {
        self.call(Gripper { arm: arm.to_owned(), position, ..Gripper::default() }).map(drop)
    }

    /// Commands the position of a gripper [m or rad] with a largest force, in its force unit [N or Nm].
    pub fn gripper_with_force(&self, arm: &str, position: f64, force: f64) -> Result<(), RpcError> {
        self.call(Gripper { arm: arm.to_owned(), position, force: Some(force), ..Gripper::default() }).map(drop)
    }

    /// Moves a gripper and waits for the outcome, which `outcome` has, or else `error` the reason.
    pub fn grip(&self, command: Gripper) -> Result<GripReport, RpcError> {
        let arm = command.arm.clone();
        let order = self.call(command)?.order;
        loop {
            let report = self.call(Grip { arm: arm.clone(), order: Some(order) })?;
            if report.done {
                return Ok(report);
            }
            std::thread::sleep(POLL_PERIOD);
        }
    }

    /// Sends the next target of a servo task [rad], one value per joint of the task; repeat it within the task's
    /// timeout.
    pub fn servo(&self, task: &str, positions: &[f64]) -> Result<(), RpcError> {
        self.call(Servo::new(task, positions.to_vec())).map(drop)
    }

    /// Sends the next target of a velocity task [rad/s], one value per joint of the task; repeat it within the task's
    /// timeout.
    pub fn velocity(&self, task: &str, velocities: &[f64]) -> Result<(), RpcError> {
        self.call(Velocity { task: task.to_owned(), velocities: velocities.to_vec() }).map(drop)
    }

    /// Calls any method of [`api`](dimos_rpc::api), with the checks of the socket.
    pub fn call<M: Method>(&self, params: M) -> Result<M::Reply, RpcError> {
        let answers = self.call_together(std::slice::from_ref(&params));
        answers.into_iter().next().unwrap_or_else(|| Err(in_process::defect("no answer")))
    }

    /// Calls a method several times at once: the requests usually reach the same tick.
    pub fn call_together<M: Method>(&self, requests: &[M]) -> Vec<Result<M::Reply, RpcError>> {
        in_process::call(&self.service, self.epoch, requests)
    }
}
