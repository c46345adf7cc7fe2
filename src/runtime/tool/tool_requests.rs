//! Tools: shown, and replaced at rest, in the planner and in every task that moves the same link.

use nalgebra::Isometry3;

use super::tcp::TcpModel;
use crate::runtime::plan::planner_port::{isometry, spec};
use crate::runtime::{Service, internal};
use dimos_control::request::Request;
use dimos_control::task_robot::FramePose;
use dimos_core::sync::lock;
use dimos_core::telemetry::describe::Severity;
use dimos_rpc::api::{self, ArmToolReply, Reply, Request as Call};
use dimos_rpc::report::{TcpReport, ToolReport};
use dimos_rpc::{Code, RpcError};

impl Service {
    /// Returns an arm's tool centre point.
    pub(in crate::runtime) fn tool(&self, arm: &str) -> Result<ArmToolReply, RpcError> {
        let tcp = self.tcp_model(self.facts.arm_index(arm)?)?.report();
        Ok(ArmToolReply { arm: arm.to_owned(), tcp })
    }

    /// Replaces an arm's tool. After an error the arm has the tool that it had.
    pub(in crate::runtime) async fn set_tool(&self, call: api::ArmToolSet) -> Result<Reply, RpcError> {
        let arm = self.facts.arm_index(&call.arm)?;
        let model = self.tcp_model(arm)?;
        let tool = call.tool.as_ref().map(isometry);
        self.rests(arm)?;
        self.set_planner_tool(&model, tool).await?;
        let tasks = self.tasks_of(arm, &model.link);
        let set = match self.set_task_tools(&tasks, tool).await {
            Ok(()) => self.limit_tool(arm, &model.link, tool).await,
            Err(error) => Err(error),
        };
        if let Err(error) = set {
            let _ = self.set_task_tools(&tasks, model.tool).await;
            let _ = self.set_planner_tool(&model, model.tool).await;
            return Err(error);
        }
        self.log_tcps();
        let tcp = TcpReport { tool: tool.as_ref().map(ToolReport::from), ..model.report() };
        let text = match tcp.tool {
            Some(tool) => format!("tool on {} at xyz {:.4?} m, rpy {:.4?} rad", tcp.link, tool.xyz, tool.rpy),
            None => format!("no tool on {}", tcp.link),
        };
        self.tick.dispatcher().log(Severity::Info, format!("{}: {text}", call.arm));
        Ok(Reply::ArmToolSet(ArmToolReply { arm: call.arm, tcp }))
    }

    fn tcp_model(&self, arm: u16) -> Result<TcpModel, RpcError> {
        self.tcp_models().into_iter().nth(arm as usize).flatten().ok_or_else(|| {
            let what = format!("this run has no model of {}: a tool is on a link of one", self.facts.names.arm(arm));
            RpcError::new(Code::Unsupported, what).hint("run a planner blueprint of this arm, such as yourarm-planner")
        })
    }

    async fn set_planner_tool(&self, model: &TcpModel, tool: Option<Isometry3<f64>>) -> Result<(), RpcError> {
        let Some(robot) = &model.robot else { return Ok(()) };
        let tool_spec = tool.as_ref().map(spec);
        self.planner_call(Call::ArmToolSet(api::ArmToolSet { arm: robot.clone(), tool: tool_spec })).await?;
        self.plans.set_attached_tool(robot, tool);
        Ok(())
    }

    /// Returns the tasks that move this link of an arm.
    fn tasks_of(&self, arm: u16, link: &str) -> Vec<u16> {
        let joints = self.facts.joints_of_arm(arm);
        let tasks = self.facts.config.tasks.iter().zip(&self.facts.blueprint.tasks).zip(0..);
        let moves = |task: &dimos_control::config::TaskConfig| task.joints.iter().any(|j| joints.contains(j));
        let same = |task: &crate::blueprint::Task| task.robot.as_ref().is_some_and(|robot| robot.link == link);
        tasks.filter(|((config, task), _)| moves(config) && same(task)).map(|(_, index)| index).collect()
    }

    async fn set_task_tools(&self, tasks: &[u16], tool: Option<Isometry3<f64>>) -> Result<(), RpcError> {
        let pose = tool.as_ref().map_or(FramePose::SAME, FramePose::from);
        for &task in tasks {
            self.ask(Request::Tool { task, tool: pose }).await?;
            *lock(&self.tools.of_tasks).get_mut(task as usize).ok_or_else(internal)? = tool;
        }
        Ok(())
    }

    /// Gives the tools of an attached planner to the tasks that move the same links. An active task keeps its own.
    pub(in crate::runtime) fn take_planner_tools(&self, models: &[TcpModel]) {
        for (arm, names) in (0..).zip(&self.facts.names.arms) {
            let Some(model) = models.iter().find(|model| model.moves(&names.joints)) else { continue };
            for task in self.tasks_of(arm, &model.link) {
                let own = lock(&self.tools.of_tasks).get(task as usize).copied().flatten();
                if own == model.tool {
                    continue;
                }
                let (Some(me), Ok(runtime)) = (self.me.upgrade(), tokio::runtime::Handle::try_current()) else {
                    return;
                };
                let tool = model.tool;
                runtime.spawn(async move {
                    if let Err(error) = me.set_task_tools(&[task], tool).await {
                        let name = me.facts.names.task(task);
                        tracing::warn!("task {name} keeps its tool, not the planner's: {}", error.message);
                    }
                });
            }
        }
    }
}
