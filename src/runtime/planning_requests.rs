//! What rpc asks of the planner: translated to the planner's words, and its plans handed to the coordinator.

use super::service::Service;
use crate::rpc::api::{Reply, Request as Call};
use crate::rpc::{Code, RpcError};

impl Service {
    /// Answers the planner's methods.
    pub(super) async fn planner_call(&self, call: Call) -> Result<Reply, RpcError> {
        let _ = call;
        Err(RpcError::new(Code::NoPlanner, "this run has no planner")
            .hint("run a planner blueprint, such as yourarm-planner"))
    }

    /// The coordinator's joints that a plan moves; none where there is no such plan.
    pub(super) fn joints_of_plan(&self, plan: Option<u64>) -> Vec<String> {
        let _ = plan;
        Vec::new()
    }
}
