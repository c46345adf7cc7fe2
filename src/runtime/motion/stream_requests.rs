//! Targets of streams: one request each. A stream ends with the next motion of the client that sends it.

use std::time::Instant;

use crate::runtime::Service;
use crate::runtime::plan::planner_port::isometry;
use dimos_control::request::{Goal, Request};
use dimos_core::arm::ArmCommand;
use dimos_core::joint::joints_of;
use dimos_core::telemetry::Origin;
use dimos_rpc::api::{self, Done};
use dimos_rpc::{Code, RpcError};

/// Commanded velocities below this are at rest [rad/s].
const AT_REST: f64 = 1e-6;

impl Service {
    /// Sends a target to a task, and remembers that a client streams to it.
    async fn target(&self, task: u16, request: Request, origin: Origin) -> Result<(), RpcError> {
        self.ask_from(request, Some(origin)).await?;
        self.streams.begin(task);
        Ok(())
    }

    /// Ends the streams that clients have sent to tasks with these joints, and waits until the commands of their arms
    /// are at rest, at most for the time that braking needs. A client that begins a motion holds the leases of its
    /// arms, so the streams are its own, or those of a connection that has ended. Tasks that the blueprint starts
    /// continue.
    pub(in crate::runtime) async fn end_streams(&self, joints: &[u16]) -> Result<(), RpcError> {
        let mut arms = Vec::new();
        for task in 0..self.streams.tasks() {
            let own = self.facts.config.tasks.get(task as usize).map(|config| config.joints.as_slice());
            let own = own.unwrap_or_default();
            if own.iter().any(|joint| joints.contains(joint)) && self.streams.end(task) {
                self.ask(Request::Cancel { task: Some(task) }).await?;
                arms.extend(own.iter().filter_map(|joint| self.facts.locate(*joint)).map(|(arm, _)| arm as u16));
            }
        }
        arms.sort_unstable();
        arms.dedup();
        for arm in arms {
            self.commands_rest(arm).await;
        }
        Ok(())
    }

    /// Waits until the commands of an arm are at rest, at most for the time that braking needs.
    async fn commands_rest(&self, arm: u16) {
        let limit = Instant::now() + self.braking_limit(arm);
        let dof = self.facts.config.arms.get(arm as usize).map_or(0, |config| config.dof);
        let mut before: Option<ArmCommand> = None;
        let look = || {
            let command = self.tick.arm_view(arm as usize)?.command;
            let Some(mode) = command.mode else { return Some(()) };
            let last = before.replace(command);
            let of = |values: &dimos_core::joint::Joints| values.iter().take(dof).copied().collect::<Vec<f64>>();
            let values = of(&command.values);
            let rests = if mode.is_position() {
                // The same view may come twice: only another tick's command shows that nothing moves.
                last.is_some_and(|last| last.seq != command.seq && of(&last.values) == values)
            } else {
                values.iter().all(|velocity| velocity.abs() <= AT_REST)
            };
            rests.then_some(())
        };
        self.tick.until(limit, look).await;
    }

    /// Sends the next target of a servo (`positions`) or velocity task, and one of the gripper.
    pub(in crate::runtime) async fn stream(
        &self,
        task: String,
        (values, positions): (Vec<f64>, bool),
        gripper: Option<f64>,
        origin: Origin,
    ) -> Result<(), RpcError> {
        let index = self.facts.task_index(&task)?;
        let width = self.facts.config.tasks[index as usize].joints.len();
        if values.len() != width {
            let what = format!("{task} has {width} joints, the target {} values", values.len());
            return Err(RpcError::new(Code::InvalidParams, what).hint("give one value per joint of the task, in order"));
        }
        let target = joints_of(&values);
        let request = match positions {
            true => Request::Servo { task: index, target },
            false => Request::Velocity { task: index, target },
        };
        let arm = gripper.map(|gripper| self.check_gripper_targets(index, &[gripper])).transpose()?;
        self.target(index, request, origin).await?;
        if let (Some(arm), Some(gripper)) = (arm, gripper) {
            self.take_gripper_targets((index, origin), arm, self.now(), 0.0, &[gripper]);
        }
        Ok(())
    }

    /// Sends the next target of an `eef_twist` task.
    pub(in crate::runtime) async fn twist(&self, call: &api::Twist, origin: Origin) -> Result<Done, RpcError> {
        let tool = call.frame == api::TwistFrame::Tool;
        self.steer(&call.task, Goal::Twist { linear: call.linear, angular: call.angular, tool }, origin).await
    }

    /// Sends the next target of a `cartesian_ik` task.
    pub(in crate::runtime) async fn pose(&self, call: &api::Pose, origin: Origin) -> Result<Done, RpcError> {
        let turn = isometry(&call.spec()).rotation;
        self.steer(&call.task, Goal::Pose { position: call.xyz, orientation: turn.coords.into() }, origin).await
    }

    /// Starts a task that takes no targets.
    pub(in crate::runtime) async fn start_task(&self, task: &str, origin: Origin) -> Result<Done, RpcError> {
        let task = self.facts.task_index(task)?;
        self.target(task, Request::Start { task }, origin).await?;
        Ok(Done {})
    }

    async fn steer(&self, task: &str, goal: Goal, origin: Origin) -> Result<Done, RpcError> {
        let task = self.facts.task_index(task)?;
        self.target(task, Request::CartesianTarget { task, goal }, origin).await?;
        Ok(Done {})
    }
}
