//! Action chunks: makes the curve, checks it, passes it to the tick with its time on the tick's clock.

use serde_json::json;

use crate::runtime::Service;
use dimos_control::request::{Motion, Request};
use dimos_control::task_body::TargetKind;
use dimos_control::tasks::chunk::curve;
use dimos_core::clock::Mono;
use dimos_core::joint::{JointBounds, JointLimits};
use dimos_core::telemetry::{Origin, Outcome};
use dimos_core::trajectory::Spline;
use dimos_rpc::api;
use dimos_rpc::{Code, RpcError};

/// Chunks that begin this far from now are mistaken about the clock [s].
const MAX_DISTANCE: f64 = 600.0;

impl Service {
    /// Sends the next chunk of a chunk task.
    pub(in crate::runtime) async fn chunk(
        &self,
        mut call: api::Chunk,
        origin: Origin,
    ) -> Result<api::ChunkReply, RpcError> {
        let task = self.facts.task_index(&call.task)?;
        let config = &self.facts.config.tasks[task as usize];
        let takes = self.facts.blueprint.tasks.get(task as usize).is_some_and(|t| t.spec.takes(TargetKind::Chunk));
        if !takes {
            return Err(self.refusal(&Outcome::WrongTask(task)).unwrap_or_else(crate::runtime::internal));
        }
        let (width, given) = (config.joints.len(), call.actions.first().map_or(0, Vec::len));
        if width != given {
            let what = format!("{} has {width} joints, an action {given} values", call.task);
            return Err(RpcError::new(Code::InvalidParams, what).hint("give one value per joint of the task, in order"));
        }
        let (now, actions) = (self.now(), call.actions.len());
        let start = self.start_of(&call, now)?;
        let age = if now > start { now.seconds_since(start) } else { 0.0 };
        let late = ((age / call.period).ceil() as usize).min(actions);
        let arm = call.gripper.as_deref().map(|targets| self.check_gripper_targets(task, targets)).transpose()?;
        if late == actions {
            self.streams.count_actions(task, actions, late);
            return Ok(api::ChunkReply { actions, late });
        }
        let limits = self.limits_of(&config.joints);
        for action in &mut call.actions {
            for ((value, lower), upper) in action.iter_mut().zip(&limits.position_lower).zip(&limits.position_upper) {
                let bounds = JointBounds::inside(*lower, *upper, 1.0, 1.0);
                *value = value.max(bounds.lower).min(bounds.upper);
            }
        }
        let names: Vec<String> = config.joints.iter().map(|joint| self.facts.names.joint(*joint)).collect();
        let trajectory = curve(&names, &call.actions, call.period, &limits);
        let spline = Spline::new(&trajectory).map_err(|e| RpcError::new(Code::InvalidTrajectory, e.to_string()))?;
        self.check_limits(&config.joints, &spline)?;
        let log = json!({"chunk": {"task": task, "start": start.0, "trajectory": trajectory}});
        let motion = Box::new(Motion { id: 0, joints: config.joints.clone(), spline, until: None });
        let sent = self.tick.dispatcher().ask(Request::Chunk { task, start, motion }, Some(origin), log);
        self.outcome(sent.await)?;
        self.streams.begin(task);
        self.streams.count_actions(task, actions, late);
        if let (Some(arm), Some(targets)) = (arm, &call.gripper) {
            self.take_gripper_targets((task, origin), arm, start, call.period, targets);
        }
        Ok(api::ChunkReply { actions, late })
    }

    /// Returns the time of the first action on the clock of the tick.
    fn start_of(&self, call: &api::Chunk, now: Mono) -> Result<Mono, RpcError> {
        let Some(start) = call.start else { return Ok(now) };
        let ahead = start - self.facts.wall.wall(now) as f64 * 1e-9;
        if ahead.abs() > MAX_DISTANCE {
            let what = format!("start is {ahead:.1} s from now (limit {MAX_DISTANCE} s)");
            return Err(RpcError::new(Code::InvalidParams, what)
                .hint("give the `stamp` of a joint state of this run: seconds since 1970"));
        }
        let distance = std::time::Duration::from_secs_f64(ahead.abs());
        Ok(if ahead < 0.0 { now.before(distance) } else { now.after(distance) })
    }

    /// Returns the limits of joints over all arms, in their order.
    fn limits_of(&self, joints: &[u16]) -> JointLimits {
        let of = |column: fn(&JointLimits) -> &Vec<f64>| -> Vec<f64> {
            let located = joints.iter().filter_map(|joint| self.facts.locate(*joint));
            located.filter_map(|(arm, j)| column(&self.facts.config.arms.get(arm)?.limits).get(j).copied()).collect()
        };
        JointLimits {
            position_lower: of(|limits| &limits.position_lower),
            position_upper: of(|limits| &limits.position_upper),
            velocity_max: of(|limits| &limits.velocity_max),
            acceleration_max: of(|limits| &limits.acceleration_max),
            jerk_max: of(|limits| &limits.jerk_max),
        }
    }
}
