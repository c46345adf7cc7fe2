//! Motions whose tool would be too fast are slowed down before they begin. A plan keeps the limit already.

use nalgebra::Isometry3;

use crate::runtime::Service;
use crate::runtime::plan::planner_port::run_blocking;
use dimos_control::config::ToolLimit;
use dimos_control::request::Request;
use dimos_control::task_robot::FramePose;
use dimos_core::joint::MAX_DOF;
use dimos_core::telemetry::describe::Severity;
use dimos_core::trajectory::JointTrajectory;
use dimos_planner::planning::timing::settings::ToolTimingSettings;
use dimos_planner::planning::timing::tool_timing::slowed;
use dimos_robot::kinematics::tool_speed::ToolSpeed;
use dimos_rpc::RpcError;

/// An arm that a motion moves.
struct Moved {
    arm: usize,
    /// Its joints [rad]: those that the motion does not move stay.
    at: [f64; MAX_DOF],
    /// The motion's joints, by their number in the motion and in the arm.
    joints: Vec<(usize, usize)>,
    tool: ToolSpeed,
    limit: f64,
}

impl Moved {
    fn part(&mut self, positions: &[f64], velocities: &[f64]) -> f64 {
        let (mut q, mut v) = (self.at, [0.0; MAX_DOF]);
        for &(from, to) in &self.joints {
            if let (Some(q), Some(v)) = (q.get_mut(to), v.get_mut(to)) {
                *q = positions.get(from).copied().unwrap_or(*q);
                *v = velocities.get(from).copied().unwrap_or_default();
            }
        }
        self.tool.at(&q, &v) / self.limit
    }
}

impl Service {
    /// Returns a motion of these joints on which every tool keeps its speed, at a part of it (0 to 1): the motion, or
    /// the same path more slowly. The text log says so. Computed beside the requests: a stop does not wait for it.
    pub(in crate::runtime) async fn within_tool_speed(
        &self,
        joints: &[u16],
        motion: JointTrajectory,
        speed: f64,
    ) -> Result<JointTrajectory, RpcError> {
        let mut moved = self.moved(joints);
        if moved.is_empty() {
            return Ok(motion);
        }
        let bound = |joint: &u16| {
            let (arm, j) = self.facts.locate(*joint)?;
            self.facts.config.arms.get(arm)?.limits.joint(j)
        };
        let Some(bounds) = joints.iter().map(bound).collect::<Option<Vec<_>>>() else { return Ok(motion) };
        let (motion, slower, moved, fastest) = run_blocking(move || {
            let mut fastest = vec![0.0_f64; moved.len()];
            let slower = slowed(&motion, &bounds, &ToolTimingSettings::default(), |q, v| {
                let parts = moved.iter_mut().zip(&mut fastest).map(|(arm, fastest)| {
                    let part = arm.part(q, v) / speed;
                    *fastest = fastest.max(part);
                    part
                });
                parts.fold(0.0, f64::max)
            });
            (motion, slower, moved, fastest)
        })
        .await?;
        let Some(slower) = slower else { return Ok(motion) };
        for (arm, part) in moved.iter().zip(fastest).filter(|(_, part)| *part > 1.0) {
            let (limit, name) = (arm.limit * speed, self.facts.names.arm(arm.arm as u16));
            let text = format!(
                "{name}: slowed down, its tool would move at {:.2} m/s and may at most {limit:.2} m/s: {:.1} s instead of \
                 {:.1} s",
                part * limit,
                slower.duration(),
                motion.duration()
            );
            self.tick.dispatcher().log(Severity::Info, text);
        }
        Ok(slower)
    }

    fn moved(&self, joints: &[u16]) -> Vec<Moved> {
        let limits = self.facts.config.arms.iter().enumerate().filter_map(|(i, arm)| Some((i, arm.tool.as_deref()?)));
        let moved = |(arm, limit): (usize, &ToolLimit)| {
            let own =
                |(k, joint): (usize, &u16)| self.facts.locate(*joint).filter(|at| at.0 == arm).map(|at| (k, at.1));
            let joints: Vec<(usize, usize)> = joints.iter().enumerate().filter_map(own).collect();
            let view = self.tick.arm_view(arm)?;
            let commanded = view.command.mode.is_some_and(|mode| mode.is_position());
            let at = if commanded { view.command.values } else { view.state.position };
            let mut limit = limit.clone();
            limit.robot.tool = self.tool_of(arm).unwrap_or(limit.robot.tool);
            let tool = limit.speed();
            (!joints.is_empty()).then_some(Moved { arm, at, joints, tool, limit: limit.velocity })
        };
        limits.filter_map(moved).collect()
    }

    /// Returns the present tool of an arm in the frame of the link whose speed is limited; `None`: that at its start.
    fn tool_of(&self, arm: usize) -> Option<FramePose> {
        let model = self.tcp_models().into_iter().nth(arm)??;
        self.limits_tool_on(arm, &model.link).then(|| model.tool.as_ref().map_or(FramePose::SAME, FramePose::from))
    }

    /// Returns whether the speed of a tool on this link is limited.
    fn limits_tool_on(&self, arm: usize, link: &str) -> bool {
        let described = self.facts.blueprint.arms.get(arm).and_then(|arm| arm.tool_robot.as_ref());
        let limited = self.facts.config.arms.get(arm).is_some_and(|arm| arm.tool.is_some());
        limited && described.is_some_and(|tool| tool.robot.link == link)
    }

    /// Limits the speed of another tool from now on.
    pub(in crate::runtime) async fn limit_tool(
        &self,
        arm: u16,
        link: &str,
        tool: Option<Isometry3<f64>>,
    ) -> Result<(), RpcError> {
        if self.limits_tool_on(arm.into(), link) {
            let tool = tool.as_ref().map_or(FramePose::SAME, FramePose::from);
            self.ask(Request::ArmTool { arm, tool }).await?;
        }
        Ok(())
    }
}
