//! A straight line of the tool, as joint positions close to each other, for arms of a run: it has no lines of its own
//! that pass its limits.

use nalgebra::Isometry3;

use super::super::model::VELOCITY;
use super::kinematics::Links;
use dimos_hardware::sim::reach::Chain;

/// Largest step along a line [m, rad].
const STEP: f64 = 0.005;
/// Maximum number of steps.
const STEPS: f64 = 1000.0;
/// Largest change of a joint in a step [rad]: a line through a singular pose has none.
const LARGEST_TURN: f64 = 0.2;
/// Slowest speed of a line [m/s].
const SLOWEST: f64 = 1e-3;

/// Joint positions [rad] along a line, and how far the tool goes per joint turn.
#[derive(Debug, Clone, PartialEq)]
pub struct Line {
    points: Vec<[f64; 7]>,
    /// Smallest turn of the fastest joint per way of the tool, over the steps [rad/m].
    turn_per_way: f64,
}

impl Line {
    /// Returns the line from the pose of `tool` at joints [rad] to `goal`; `None` where the arm cannot follow it.
    pub fn new(chain: Links, tool: &Isometry3<f64>, from: &[f64; 7], goal: &Isometry3<f64>) -> Option<Self> {
        let start = chain.forward(from) * tool;
        let way = (goal.translation.vector - start.translation.vector).norm();
        let turn = start.rotation.angle_to(&goal.rotation);
        let steps = (way.max(turn * 0.1) / STEP).ceil().clamp(1.0, STEPS) as usize;
        let mut line = Self { points: Vec::with_capacity(steps), turn_per_way: f64::INFINITY };
        let mut joints = *from;
        for step in 1..=steps {
            let part = step as f64 / steps as f64;
            let place = start.translation.vector.lerp(&goal.translation.vector, part);
            let pose = Isometry3::from_parts(place.into(), start.rotation.try_slerp(&goal.rotation, part, 1e-9)?);
            let next = chain.inverse(&(pose * tool.inverse()), &joints)?;
            let turned = next.iter().zip(joints).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            if turned > LARGEST_TURN {
                return None;
            }
            let moved = way / steps as f64;
            if moved > 1e-6 {
                line.turn_per_way = line.turn_per_way.min(turned / moved);
            }
            joints = next;
            line.points.push(joints);
        }
        Some(line)
    }

    /// Returns the joint positions along it [rad]; the last is its end.
    pub fn points(&self) -> &[[f64; 7]] {
        &self.points
    }

    /// Returns the joint speed [rad/s] with which the tool is nowhere faster than `speed` [m/s].
    pub fn joint_speed(&self, speed: f64) -> f64 {
        let speed = speed.max(SLOWEST);
        // A line without length is a turn, with the same fraction of the top speed.
        if self.turn_per_way.is_finite() { speed * self.turn_per_way } else { speed.min(1.0) * VELOCITY }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Translation3;

    use super::super::super::model::Model;
    use super::*;

    #[test]
    fn the_tool_stays_on_the_line_and_below_its_speed() {
        let (chain, from) = (Links::of(Model::Xarm6), [0.1, -0.6, -0.8, 0.05, 1.4, 0.1, 0.0]);
        let tool = Isometry3::translation(0.0, 0.0, 0.1);
        let start = chain.forward(&from) * tool;
        let goal = Translation3::new(0.05, 0.1, -0.02) * start;
        let line = Line::new(chain, &tool, &from, &goal).unwrap();
        let way = goal.translation.vector - start.translation.vector;
        let (mut before, cap) = (from, line.joint_speed(0.1));
        for point in line.points() {
            let pose = chain.forward(point) * tool;
            let along = pose.translation.vector - start.translation.vector;
            assert!(along.cross(&way.normalize()).norm() < 1e-5, "off the line: {along:?}");
            assert!(pose.rotation.angle_to(&start.rotation) < 1e-5);
            let step = (pose.translation.vector - (chain.forward(&before) * tool).translation.vector).norm();
            let turned = point.iter().zip(before).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            assert!(step / (turned / cap) < 0.1 + 1e-3, "{} m/s", step / (turned / cap));
            before = *point;
        }
        assert!((chain.forward(&before) * tool).translation.vector.metric_distance(&goal.translation.vector) < 1e-5);
    }

    #[test]
    fn a_goal_out_of_reach_has_no_line() {
        let from = [0.1, -0.6, -0.8, 0.05, 1.4, 0.1, 0.0];
        let chain = Links::of(Model::Xarm6);
        let goal = Translation3::new(2.0, 0.0, 0.0) * chain.forward(&from);
        assert_eq!(Line::new(chain, &Isometry3::identity(), &from, &goal), None);
    }
}
