//! Targets of streams: one request each.

use super::planner_port::isometry;
use super::service::Service;
use crate::control::request::{Goal, Request};
use crate::joint::joints_of;
use crate::rpc::api::{self, Done};
use crate::rpc::{Code, RpcError};

impl Service {
    /// Sends the next target of a servo (`positions`) or velocity task.
    pub(super) async fn stream(&self, task: String, values: Vec<f64>, positions: bool) -> Result<(), RpcError> {
        let index = self.task_index(&task)?;
        let width = self.parts.config.tasks[index as usize].joints.len();
        if values.len() != width {
            let what = format!("{task} has {width} joints, the target {} values", values.len());
            return Err(RpcError::new(Code::InvalidParams, what).hint("give one value per joint of the task, in order"));
        }
        let target = joints_of(&values);
        self.ask(match positions {
            true => Request::Servo { task: index, target },
            false => Request::Velocity { task: index, target },
        })
        .await?;
        Ok(())
    }

    /// Sends the next target of an `eef_twist` task.
    pub(super) async fn twist(&self, call: &api::Twist) -> Result<Done, RpcError> {
        let tool = call.frame == api::TwistFrame::Tool;
        self.steer(&call.task, Goal::Twist { linear: call.linear, angular: call.angular, tool }).await
    }

    /// Sends the next target of a `cartesian_ik` task.
    pub(super) async fn pose(&self, call: &api::Pose) -> Result<Done, RpcError> {
        let turn = isometry(&call.spec()).rotation;
        self.steer(&call.task, Goal::Pose { position: call.xyz, orientation: turn.coords.into() }).await
    }

    async fn steer(&self, task: &str, goal: Goal) -> Result<Done, RpcError> {
        let task = self.task_index(task)?;
        self.ask(Request::CartesianTarget { task, goal }).await?;
        Ok(Done {})
    }
}
