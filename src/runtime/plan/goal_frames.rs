//! Frames of pose goals: from a pose in a frame, or a motion relative to the present pose, to a pose in `map`.

use nalgebra::Isometry3;

use super::PlannerPort;
use super::planner_port::{isometry, positions_of};
use super::world_requests::link_pose;
use crate::runtime::tool::tcp::MAP;
use dimos_core::sync::lock;
use dimos_planner::planning::scene::planning_scene::PlannedRobot;
use dimos_robot::kinematics::pose;
use dimos_rpc::api::{Moment, PlanGoal};
use dimos_rpc::{Code, RpcError};

impl PlannerPort {
    /// Returns the pose in `map` that a goal asks of a robot; `None` if it is no pose.
    pub(in crate::runtime) fn goal_pose(
        &self,
        robot: &PlannedRobot,
        goal: &PlanGoal,
        moment: &Moment,
    ) -> Result<Option<Isometry3<f64>>, RpcError> {
        let frame = || self.frame_in_map(robot, goal.frame.as_deref().unwrap_or(MAP), moment);
        match (&goal.pose, &goal.by) {
            (Some(given), _) => Ok(Some(frame()? * isometry(given))),
            (None, Some(by)) => {
                let (now, by, axes) = (self.tcp_in_map(robot, moment)?, isometry(by), frame()?.rotation);
                let translation = now.translation.vector + axes * by.translation.vector;
                let rotation = axes * by.rotation * axes.inverse() * now.rotation;
                Ok(Some(Isometry3::from_parts(translation.into(), rotation)))
            }
            (None, None) => Ok(None),
        }
    }

    /// Returns the present pose of a robot's tool centre point in `map`.
    pub(in crate::runtime) fn tcp_in_map(
        &self,
        robot: &PlannedRobot,
        moment: &Moment,
    ) -> Result<Isometry3<f64>, RpcError> {
        let joints = positions_of(&robot.config.name, &robot.config.coordinator_joints, moment)?;
        Ok(pose(&robot.tcp_pose(&joints)))
    }

    /// Returns the pose of a frame in `map`: `map`, `base` and `tool` of a robot, or an object of the world.
    fn frame_in_map(&self, robot: &PlannedRobot, name: &str, moment: &Moment) -> Result<Isometry3<f64>, RpcError> {
        match name {
            MAP => Ok(Isometry3::identity()),
            "base" => Ok(robot.config.base_pose),
            "tool" => self.tcp_in_map(robot, moment),
            _ => {
                let object = {
                    let objects = lock(&self.objects);
                    let names = || [MAP, "base", "tool"].into_iter().chain(objects.keys().map(String::as_str));
                    let unknown = || {
                        RpcError::unknown(Code::UnknownObject, "frame or object", name, &names().collect::<Vec<_>>())
                    };
                    objects.get(name).cloned().ok_or_else(unknown)?
                };
                let at = isometry(&object.pose);
                let Some([holder, link]) = &object.held_by else { return Ok(at) };
                let scene = self.thread.now();
                let held = scene.robot(holder).and_then(|index| scene.robots.get(index));
                let holder = held.ok_or_else(crate::runtime::internal)?;
                Ok(link_pose(holder, link, moment)? * at)
            }
        }
    }
}
