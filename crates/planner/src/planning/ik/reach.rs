//! Inverse kinematics for a pose that people drag: the configuration that continues the one before, and what touches.

use glamx::DAffine3;

use crate::collision::world::World;
use crate::collision::{CollisionChecker, Stop};
use crate::planning::ik::Ik;
use crate::planning::ik::settings::IkSettings;
use crate::planning::request::ahead::describe_contact;
use crate::planning::request::pipeline::{PlanFailure, stage};
use crate::planning::scene::planning_scene::PlanningScene;

/// Joint positions that reach a pose.
#[derive(Debug, Clone, PartialEq)]
pub struct Reached {
    /// Positions of the robot's planned joints [rad].
    pub joints: Vec<f64>,
    /// A contact there, if any.
    pub contact: Option<String>,
}

/// Returns positions of a robot (index) that bring its tool centre point to `target` in `map`, on the branch of `near`
/// if that leads there. All other robots are at their `positions` [rad]. The failure says how far the pose is out of
/// reach.
pub fn reach(
    setup: &PlanningScene,
    world: &World,
    robot: usize,
    positions: &[Vec<f64>],
    (target, position_only): (&DAffine3, bool),
    near: &[f64],
    stop: &Stop,
) -> Result<Reached, PlanFailure> {
    let mut stage = stage(setup, world, &[robot], positions, 0.0, &[])?;
    let Some(robot) = stage.robots.first() else { return Err(PlanFailure::new("no such robot")) };
    let drag = &stage.settings.drag;
    let (position, rotation, attempts) = (drag.tolerance, drag.tolerance, drag.attempts);
    let settings = IkSettings { position, rotation, position_only, attempts, ..stage.settings.ik };
    let in_root = robot.body.base.inverse() * *target;
    let mut ik = Ik::new(&robot.body.kinematics, robot.tcp());
    let joints = match ik.follow(&in_root, near, &settings) {
        Some(joints) => joints,
        None => {
            let found = ik.solve(&in_root, near, &settings, |_| true, stop);
            let found = found.map_err(|failure| PlanFailure::new(format!("{}: {failure}", robot.config.name)))?;
            found.into_iter().next().unwrap_or_default()
        }
    };
    let contact = stage.checker.contacts(&joints).first().map(|contact| describe_contact(contact, 0.0));
    Ok(Reached { joints, contact })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::planning::scene::config::{PlannerConfig, RobotConfig};
    use dimos_robot::kinematics::step::rotation_between;

    fn reach_of(pose: &DAffine3, near: &[f64]) -> Result<Reached, PlanFailure> {
        let scene = scene();
        reach(&scene, &scene.world, 0, &[HOME.to_vec()], (pose, false), near, &Stop::never())
    }

    const HOME: [f64; 6] = [0.0, -0.3, 0.6, 0.0, 0.8, 0.0];

    fn scene() -> PlanningScene {
        PlanningScene::load(&PlannerConfig { robots: vec![RobotConfig::yourarm()], ..Default::default() }).unwrap()
    }

    #[test]
    fn a_dragged_pose_stays_on_its_branch_names_contacts_and_says_what_is_out_of_reach() {
        let scene = scene();
        let mut near = HOME.to_vec();
        let start = scene.robots[0].tcp_pose(&near);
        for step in 1..=20 {
            let mut pose = start;
            pose.translation.y += 0.01 * f64::from(step);
            let reached = reach_of(&pose, &near).unwrap();
            assert_eq!(reached.contact, None);
            let moved = near.iter().zip(&reached.joints).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            assert!(moved < 0.15, "step {step}: a joint jumps by {moved} rad");
            let is_at = scene.robots[0].tcp_pose(&reached.joints);
            assert!(is_at.translation.distance(pose.translation) < 1e-4);
            assert!(rotation_between(&is_at.matrix3, &pose.matrix3).length() < 1e-4);
            near = reached.joints;
        }
        let mut far = start;
        far.translation.x += 3.0;
        let failure = reach_of(&far, &near).unwrap_err();
        assert!(failure.what.contains("no IK solution"), "{}", failure.what);
        let mut inside = start;
        inside.translation = glamx::DVec3::new(0.0, 0.0, 0.12);
        let scene_of = reach(&scene, &scene.world, 0, &[HOME.to_vec()], (&inside, true), &HOME, &Stop::never());
        let contact = scene_of.unwrap().contact.expect("the flange is inside the base");
        assert!(contact.contains("link"), "{contact}");
    }
}
