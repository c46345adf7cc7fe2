//! The tool's speed limit: the last stage before the collision guard. A vendor limits the speed of the tool, not only
//! that of each joint: an xArm stops with an error, a UR with a protective stop.
//!
//! A step is taken only if the tool keeps its speed on the step and on the way to rest from it, on which all joints
//! brake together. So a way on which it keeps its speed always remains. Otherwise all joints are slowed by the same
//! factor: the arm keeps its direction.

use serde::{Deserialize, Serialize};

use super::limit::Limiter;
use super::rest::braking;
use super::task_robot::{FramePose, TaskKinematics};
use dimos_core::joint::MAX_DOF;
use dimos_robot::kinematics::tool_speed::ToolSpeed;

/// Share of the limit that is used: between two checked points the tool may be faster.
const SHARE: f64 = 0.995;
/// Points of the way to rest that are checked.
const POINTS: usize = 6;
/// Longest way to rest that counts [s].
const LONGEST: f64 = 2.0;

/// The speed limit of an arm's tool.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ToolLimit {
    /// Highest speed of the tool centre point and of the other links [m/s].
    pub velocity: f64,
    /// The arm and its tool centre point.
    pub robot: TaskKinematics,
    /// Other links whose origins keep the limit, by index: the flange, and the elbow where the vendor limits it.
    pub links: Vec<usize>,
}

impl ToolLimit {
    /// Returns what measures the speed of the tool.
    pub fn speed(&self) -> ToolSpeed {
        let mut kinematics = self.robot.kinematics.clone();
        let tcp = kinematics.attach_frame(self.robot.link, &self.robot.tool.frame());
        ToolSpeed::new(kinematics, self.links.iter().copied().chain([tcp]).collect())
    }
}

/// Limits the speed of an arm's tool.
#[derive(Debug)]
pub struct ToolLimiter {
    velocity: f64,
    speed: ToolSpeed,
    tcp: usize,
    link: usize,
}

impl ToolLimiter {
    /// Creates a limiter.
    pub fn new(limit: &ToolLimit) -> Self {
        let (tcp, link) = (limit.robot.kinematics.links(), limit.robot.link);
        Self { velocity: limit.velocity, speed: limit.speed(), tcp, link }
    }

    /// Replaces the tool.
    pub fn set_tool(&mut self, tool: &FramePose) {
        self.speed.move_frame(self.tcp, self.link, &tool.frame());
    }

    /// Slows the step from `before` to `after` down, if the tool would be too fast. Returns the speed that the tool
    /// would have had [m/s]. Velocities are those of the arm's own time: a controller that slows it may cease to.
    pub fn limit(&mut self, before: &[Limiter], after: &mut [Limiter]) -> Option<f64> {
        let mut fastest = self.fastest(before, after);
        let asked = Some(fastest).filter(|speed| *speed > SHARE * self.velocity)?;
        // Slower, it is elsewhere on its way to rest: the factor is found in few rounds.
        for _ in 0..3 {
            let share = SHARE * self.velocity / fastest;
            for (limiter, before) in after.iter_mut().zip(before) {
                limiter.slow_to(share * limiter.velocity(), before);
            }
            fastest = self.fastest(before, after);
            if fastest <= self.velocity {
                return Some(asked);
            }
        }
        // The joints cannot slow down in this proportion: they brake, on the way that the last step has left.
        let decreases = braking::decreases(before, 1.0);
        for ((limiter, before), decrease) in after.iter_mut().zip(before).zip(decreases) {
            let covered = limiter.covered();
            limiter.decelerate_from(before, decrease * covered, covered);
            limiter.keep_inside(before);
        }
        Some(asked)
    }

    /// Returns the highest speed of the tool on the step and on the way to rest from it [m/s].
    fn fastest(&mut self, before: &[Limiter], after: &[Limiter]) -> f64 {
        let mut velocities = [0.0; MAX_DOF];
        velocities.iter_mut().zip(after).for_each(|(v, limiter)| *v = limiter.velocity());
        if velocities.iter().all(|v| *v == 0.0) {
            return 0.0;
        }
        let longest = braking::time(after).min(LONGEST);
        let mut fastest = 0.0_f64;
        for point in 0..=POINTS {
            // The first is the middle of the step; the others are at equal times until rest, at which nothing moves.
            let (steps, time, part) = match point {
                0 => (0.5, 0.0, 1.0),
                _ => {
                    let passed = (point - 1) as f64 / POINTS as f64;
                    (1.0, longest * passed * (1.0 - 0.5 * passed), 1.0 - passed)
                }
            };
            let (mut q, mut v) = ([0.0; MAX_DOF], velocities);
            for (((q, v), before), after) in q.iter_mut().zip(&mut v).zip(before).zip(after) {
                *q = before.position() + *v * (steps * after.covered() + time);
                *v *= part;
            }
            fastest = fastest.max(self.speed.at(&q, &v));
        }
        fastest
    }
}
