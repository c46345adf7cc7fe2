//! Checks planned motions during their execution: after every change of the world, the rest of each is checked again. A
//! motion that would come too close to an obstacle decelerates along its path before it; if it is too late for that,
//! its arms are held.

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::PlannerPort;
use super::plan_requests::all_positions;
use super::planner_link::Planner;
use super::planner_port::run_blocking;
use crate::runtime::Service;
use crate::runtime::motion::motions::UnderWay;
use dimos_control::request::Request;
use dimos_core::sync::lock;
use dimos_core::telemetry::TaskState;
use dimos_planner::collision::Stop;
use dimos_planner::planning::request::ahead::rests_before;
use dimos_planner::planning::request::pipeline::PlannedMotion;
use dimos_rpc::api::{BlockedReport, Moment, Recheck, RecheckReply};
use dimos_rpc::{Code, RpcError};

/// Timeout for checking the rest of a motion; after that the motion is cancelled.
const LIMIT: Duration = Duration::from_secs(1);
/// Maximum number of executed plans kept.
const RELEASED: usize = 64;

/// A plan that was executed, and the version of the world for which its motion was checked.
pub(in crate::runtime) type Released = (Arc<PlannedMotion>, u64);

impl PlannerPort {
    /// Keeps a plan that is executed, for later checks.
    pub(in crate::runtime) fn remember(&self, plan: u64, found: Arc<PlannedMotion>, version: u64) {
        let mut released = lock(&self.released);
        while released.len() >= RELEASED {
            released.pop_first();
        }
        released.insert(plan, (found, version));
    }

    /// Returns what blocks the rest of a motion. Skips the check if the world has not changed since the last one.
    pub(in crate::runtime) async fn recheck(&self, call: &Recheck, moment: &Moment) -> Result<RecheckReply, RpcError> {
        let unknown = || RpcError::new(Code::UnknownPlan, format!("the planner does not know plan {}", call.plan));
        let (found, verified) = lock(&self.released).get(&call.plan).cloned().ok_or_else(unknown)?;
        self.measured(moment);
        let version = self.thread.version();
        if version == verified {
            return Ok(RecheckReply::default());
        }
        let positions = all_positions(self.thread.setup(), moment)?;
        let stop = Stop::new(Some(Instant::now() + LIMIT), None);
        let blocked = run_blocking(self.thread.look_ahead(found, positions, call.elapsed, stop)).await?;
        let blocked = blocked.map_err(|failure| RpcError::new(Code::PlanOutdated, failure.what))?;
        if blocked.is_none()
            && let Some(released) = lock(&self.released).get_mut(&call.plan)
        {
            released.1 = released.1.max(version);
        }
        let report = |b: dimos_planner::planning::request::ahead::Blocked| BlockedReport {
            free_until: b.free_until,
            what: b.what,
        };
        Ok(RecheckReply { blocked: blocked.map(report) })
    }
}

impl Service {
    /// Checks the rest of every planned motion that is being executed.
    pub(super) async fn recheck(&self, planner: &Planner<'_>) {
        let under_way = self.motions.under_way();
        for motion in under_way {
            self.recheck_motion(planner, &motion).await;
        }
    }

    /// Returns the progress of a motion [s]; `None`: it has ended, or decelerates already.
    fn elapsed(&self, motion: &UnderWay) -> Option<f64> {
        let view = self.tick.task_view(motion.task as usize);
        match view.state {
            TaskState::Executing if view.motion == motion.number => Some(view.elapsed),
            // The tick has accepted it, and shows it after the next tick.
            _ if view.motion < motion.number => Some(0.0),
            _ => None,
        }
    }

    pub(super) async fn recheck_motion(&self, planner: &Planner<'_>, motion: &UnderWay) {
        let Some(elapsed) = self.elapsed(motion) else { return };
        let asked = Recheck { plan: motion.plan, elapsed };
        let (free_until, what) = match planner.recheck(&asked, self.moment(0), LIMIT + LIMIT / 2).await {
            Ok(RecheckReply { blocked: None }) => return,
            Ok(RecheckReply { blocked: Some(blocked) }) => (blocked.free_until, blocked.what),
            // A motion that could not be checked must not continue.
            Err(e) => (f64::INFINITY, e.message),
        };
        let Some(elapsed) = self.elapsed(motion) else { return };
        let tick = self.facts.period().as_secs_f64();
        let acceleration: Vec<f64> = motion.joints.iter().map(|joint| self.acceleration(*joint)).collect();
        let in_time = rests_before(free_until, &motion.spline, &acceleration, elapsed, tick);
        let ahead = (free_until - elapsed).max(0.0);
        let text = match (in_time, free_until.is_finite()) {
            (true, false) => format!("the world has changed, and {what}: the arm slows down"),
            (true, true) => format!("path blocked in {ahead:.2} s: {what}; the arm rests before it"),
            (false, _) => format!(
                "path blocked in {ahead:.2} s, closer than the arm can brake along its path: {what}; held at once"
            ),
        };
        tracing::warn!("motion {} on {}: {text}", motion.number, self.facts.names.task(motion.task));
        let again = self.motions.blocked(motion.number, text, in_time);
        let _ = self.ask(Request::WayBlocked { task: motion.task, motion: motion.number, in_time }).await;
        if again {
            self.go_around(motion);
        }
    }

    /// Returns the acceleration limit of a joint [rad/s²].
    fn acceleration(&self, joint: u16) -> f64 {
        let located = self.facts.locate(joint);
        let limit = located.and_then(|(arm, j)| self.facts.config.arms.get(arm)?.limits.acceleration_max.get(j));
        limit.copied().unwrap_or(0.0)
    }
}
