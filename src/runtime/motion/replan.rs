//! Replanning: a planned motion that was stopped before an obstacle is planned again from there to its goal, and
//! continues as another motion. Runs on its own thread, which waits for the arm and the planner.

use std::time::{Duration, Instant};

use super::motions::UnderWay;
use crate::runtime::client::asker::asked_by;
use crate::runtime::client::curb::curbed;
use crate::runtime::{Service, internal};
use dimos_core::joint::STANDSTILL;
use dimos_core::telemetry::{Phase, TaskState};
use dimos_rpc::api::{ExecutePlan, Plan, PlanGoal, PlanLevel, Planner, Planning, Reply, Request as Call};
use dimos_rpc::{Code, RpcError};

/// Timeout for the arm to decelerate to rest.
const REST_TIMEOUT: Duration = Duration::from_secs(10);
/// Poll period while waiting for the arm and the planner.
const POLL_PERIOD: Duration = Duration::from_millis(10);

/// Returns whether a goal depends on where its robot was, or on an object that may move.
fn is_relative(goal: &PlanGoal) -> bool {
    let fixed = matches!(goal.frame.as_deref(), None | Some("map" | "base"));
    goal.by.is_some() || goal.path.is_some() || !fixed
}

impl Service {
    /// Begins to plan a blocked motion again.
    pub(in crate::runtime) fn go_around(&self, motion: &UnderWay) {
        let (number, motion) = (motion.number, motion.clone());
        let Some(me) = self.me.upgrade() else { return };
        let thread = std::thread::Builder::new().name("replan".into()).spawn(move || {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build();
            let went_on = match runtime {
                Ok(runtime) => runtime.block_on(me.plan_again(&motion)),
                Err(e) => Err(RpcError::new(Code::Internal, e.to_string())),
            };
            if let Err(error) = &went_on {
                tracing::warn!("motion {number}: not planned around what is in its way: {}", error.message);
            }
            me.motions.went_on(number, went_on.map_err(|error| error.message));
        });
        if let Err(e) = thread {
            self.motions.went_on(number, Err(e.to_string()));
        }
    }

    async fn plan_again(&self, motion: &UnderWay) -> Result<u64, RpcError> {
        self.rested(motion).await?;
        let unknown = || RpcError::new(Code::UnknownPlan, "the request of this plan is no longer known");
        let mut request = self.plans.request(motion.plan).ok_or_else(unknown)?;
        if request.goals.iter().any(|goal| goal.path.is_some()) {
            let what = "a path is followed as it is, not planned around what is in its way";
            return Err(RpcError::new(Code::NoPlan, what));
        }
        if request.goals.iter().any(is_relative) {
            self.resolve(&mut request, motion).await?;
        }
        request.by_number = true;
        let unproven = request.level == PlanLevel::Fast; // Its motion was executed.
        let Reply::Plan(begun) = self.planner_call_from(Call::Plan(request), motion.origin).await? else {
            return Err(internal());
        };
        loop {
            if let Err(ended) = self.may_go_on(motion) {
                self.cancel_planning(Some(begun.plan)).await;
                return Err(ended);
            }
            let asked = Call::Planning(Planning { plan: begun.plan });
            let Reply::Planning(report) = self.planner_call(asked).await? else { return Err(internal()) };
            match report.state.as_str() {
                "PLANNING" => tokio::time::sleep(POLL_PERIOD).await,
                "PLANNED" => break,
                _ => return Err(RpcError::new(Code::NoPlan, report.error.unwrap_or(report.state))),
            }
        }
        self.may_go_on(motion)?;
        let presence = motion.replan.clone().flatten();
        let execute =
            ExecutePlan { plan: Some(begun.plan), replan: true, unproven, presence, ..ExecutePlan::default() };
        let execute = curbed(motion.curb.clone(), self.planner_call_from(Call::ExecutePlan(execute), motion.origin));
        let executed = match motion.by.clone() {
            Some(who) => asked_by(who, execute).await?,
            None => execute.await?,
        };
        match executed {
            Reply::ExecutePlan(begun) => Ok(begun.motion),
            _ => Err(internal()),
        }
    }

    /// Replaces goals that depend on where the arm was by the joint positions that their plan found.
    async fn resolve(&self, request: &mut Plan, motion: &UnderWay) -> Result<(), RpcError> {
        let Reply::Planner(planner) = self.planner_call(Call::Planner(Planner {})).await? else {
            return Err(internal());
        };
        let plan = Call::Planning(Planning { plan: motion.plan });
        let Reply::Planning(report) = self.planner_call(plan).await? else {
            return Err(internal());
        };
        let found = report.summary.ok_or_else(internal)?;
        for goal in request.goals.iter_mut().filter(|goal| is_relative(goal)) {
            let robot = planner.robots.iter().find(|robot| robot.name == goal.robot).ok_or_else(internal)?;
            let at = |joint| found.joints.iter().position(|j| j == joint).and_then(|at| found.goal.get(at).copied());
            let joints = robot.joints.iter().map(at).collect::<Option<Vec<f64>>>().ok_or_else(internal)?;
            *goal = PlanGoal { robot: goal.robot.clone(), joints: Some(joints), ..PlanGoal::default() };
        }
        Ok(())
    }

    /// Waits until the motion has ended and its arms are at rest.
    async fn rested(&self, motion: &UnderWay) -> Result<(), RpcError> {
        let began = Instant::now();
        loop {
            self.may_go_on(motion)?;
            let view = self.tick.task_view(motion.task as usize);
            let ends = matches!(view.state, TaskState::Executing | TaskState::Cancelling);
            let still = |joint: &u16| {
                let (arm, j) = self.facts.locate(*joint)?;
                self.tick.arm_view(arm)?.state.velocity.get(j).map(|velocity| velocity.abs() <= STANDSTILL)
            };
            if !ends && motion.joints.iter().all(|joint| still(joint).unwrap_or(false)) {
                return Ok(());
            }
            if began.elapsed() > REST_TIMEOUT {
                let what = format!("the arm does not rest after {} s", REST_TIMEOUT.as_secs());
                return Err(RpcError::new(Code::NoAnswer, what));
            }
            tokio::time::sleep(POLL_PERIOD).await;
        }
    }

    /// Returns whether it may continue: no `cancel`, no stop, no end of the lease meanwhile.
    fn may_go_on(&self, motion: &UnderWay) -> Result<(), RpcError> {
        let ended = |what: &str| Err(RpcError::new(Code::ShuttingDown, what));
        if self.lifecycle.is_closed() {
            return ended("the run ends");
        }
        if !self.motions.is_replanning(motion.number) {
            return ended("cancelled");
        }
        if motion.replan.as_ref().is_some_and(|asked| asked.as_ref().is_some_and(|presence| presence.is_over())) {
            return ended("who asked for it has gone");
        }
        let mut arms = motion.joints.iter().filter_map(|joint| self.facts.locate(*joint));
        if arms.any(|(arm, _)| self.tick.phase(arm) != Phase::Ready) {
            return ended("the arm is not ready");
        }
        Ok(())
    }
}
