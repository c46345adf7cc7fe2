//! Prepares a recorded motion for the arms of a blueprint: which task follows which part, where each arm starts, and
//! whether its limits allow the motion. `cli::replay::onto` executes it.

use serde::Serialize;
use thiserror::Error;

use crate::blueprint::{Arm, Blueprint};
use dimos_control::config::CoordinatorConfig;
use dimos_control::task_body::TargetKind;
use dimos_core::joint::JointBounds;
use dimos_core::trajectory::{JointTrajectory, Spline, TrajectoryError, TrajectoryPoint};

/// Maximum values in one trajectory: it is checked, logged and held in memory as a whole.
const MAX_VALUES: usize = 300_000;
/// Factor by which limits may be exceeded, for rounding.
const SLACK: f64 = 1.001;

/// Why the arms of a blueprint cannot follow a motion.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum OntoError {
    /// The log has no motion.
    #[error(
        "the log has no motion to follow: no joint has a position in every tick\nhint: select another part of the log"
    )]
    Nothing,
    /// A joint of the log is not in the blueprint.
    #[error(
        "the log moves {joint}, which the blueprint {blueprint} does not have\nhint: joints are matched by name; the blueprint has {has}"
    )]
    NoSuchJoint {
        /// The joint.
        joint: String,
        /// The blueprint.
        blueprint: String,
        /// The joints of the blueprint.
        has: String,
    },
    /// No task can follow the motion.
    #[error(
        "no trajectory task of the blueprint covers the joints of {arm}\n\
         hint: add one: `tasks: [{{name: traj_{arm}, type: trajectory, joint_names: {{hardware: {arm}}}}}]`"
    )]
    NoTask {
        /// The arm.
        arm: String,
    },
    /// The motion is too long.
    #[error(
        "the motion has {0} values (limit {MAX_VALUES})\nhint: select a part of it with --start-offset and --duration"
    )]
    TooLong(usize),
    /// The motion is not a valid trajectory.
    #[error("the arms cannot follow the motion: {0}\nhint: select another part of the log")]
    Trajectory(#[from] TrajectoryError),
}

/// A limit that the motion exceeds.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LimitViolation {
    /// The joint.
    pub joint: String,
    /// `position`, `velocity` or `acceleration`.
    pub limit: &'static str,
    /// Maximum value of the motion [rad, rad/s or rad/s²].
    pub reaches: f64,
    /// The limit.
    pub allowed: f64,
    /// The excess.
    pub by: f64,
}

impl LimitViolation {
    fn unit(&self) -> &'static str {
        match self.limit {
            "position" => "rad",
            "velocity" => "rad/s",
            _ => "rad/s²",
        }
    }
}

impl std::fmt::Display for LimitViolation {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { joint, limit, reaches, allowed, by } = self;
        let unit = self.unit();
        write!(f, "{joint} exceeds its {limit} limit by {by:.4} {unit}: {reaches:.4} of {allowed:.4} {unit}")
    }
}

/// A part of the motion, for one task.
#[derive(Debug, Clone, PartialEq)]
pub struct Part {
    /// The task.
    pub task: String,
    /// The motion.
    pub trajectory: JointTrajectory,
}

/// Motion of an arm to the start of the recorded motion.
#[derive(Debug, Clone, PartialEq)]
pub struct Approach {
    /// The arm.
    pub arm: String,
    /// Target of each joint [rad]; `None`: the joint stays where it is.
    pub target: Vec<Option<f64>>,
}

/// Execution plan of a motion.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// First, the arms move to the start one after the other.
    pub approaches: Vec<Approach>,
    /// Then all parts start together.
    pub parts: Vec<Part>,
}

/// Returns whether an arm of a blueprint is real: neither emulated nor a mock.
pub fn is_real(arm: &Arm) -> bool {
    arm.is_real()
}

/// Assigns a motion to the arms and tasks of a blueprint, joint by joint of the same name.
pub fn plan(blueprint: &Blueprint, motion: &JointTrajectory) -> Result<Plan, OntoError> {
    let Some(first) = motion.points.first().filter(|_| !motion.joint_names.is_empty()) else {
        return Err(OntoError::Nothing);
    };
    let size = motion.points.len() * motion.joint_names.len();
    if size > MAX_VALUES {
        return Err(OntoError::TooLong(size));
    }
    let all: Vec<&String> = blueprint.arms.iter().flat_map(|arm| &arm.joints).collect();
    if let Some(joint) = motion.joint_names.iter().find(|joint| !all.contains(joint)) {
        let has = all.iter().map(|j| j.as_str()).collect::<Vec<_>>().join(", ");
        return Err(OntoError::NoSuchJoint { joint: joint.clone(), blueprint: blueprint.name.clone(), has });
    }
    let value = |joint: &String| motion.joint_names.iter().position(|j| j == joint).map(|k| first.positions[k]);
    let driven = |arm: &&Arm| arm.joints.iter().any(|j| value(j).is_some());
    let approaches = (blueprint.arms.iter().filter(driven))
        .map(|arm| Approach { arm: arm.hardware_id.clone(), target: arm.joints.iter().map(value).collect() })
        .collect();
    // Prefers one task for all joints, so that they stay synchronized; otherwise one per arm.
    let parts = match task_for(blueprint, &motion.joint_names, &all) {
        Some(task) => vec![Part { task, trajectory: motion.clone() }],
        None => (blueprint.arms.iter().filter(driven))
            .map(|arm| {
                let own = only(motion, |joint| arm.joints.contains(joint));
                let task = task_for(blueprint, &own.joint_names, &all);
                let task = task.ok_or_else(|| OntoError::NoTask { arm: arm.hardware_id.clone() })?;
                Ok(Part { task, trajectory: own })
            })
            .collect::<Result<_, OntoError>>()?,
    };
    for part in &parts {
        part.trajectory.validate()?;
    }
    Ok(Plan { approaches, parts })
}

fn task_for(blueprint: &Blueprint, joints: &[String], all: &[&String]) -> Option<String> {
    let covers = |task: &&crate::blueprint::Task| {
        let has = |name: &String| task.joints.iter().any(|&j| all.get(j).is_some_and(|joint| *joint == name));
        task.spec.takes(TargetKind::Trajectory) && joints.iter().all(has)
    };
    blueprint.tasks.iter().find(covers).map(|task| task.name.clone())
}

/// Returns the motion of some of its joints.
fn only(motion: &JointTrajectory, wanted: impl Fn(&String) -> bool) -> JointTrajectory {
    let chosen: Vec<usize> = (0..motion.joint_names.len()).filter(|&k| wanted(&motion.joint_names[k])).collect();
    let pick = |values: &[f64]| chosen.iter().filter_map(|&k| values.get(k).copied()).collect();
    let points = motion.points.iter().map(|p| TrajectoryPoint {
        time_from_start: p.time_from_start,
        positions: pick(&p.positions),
        velocities: pick(&p.velocities),
        accelerations: pick(&p.accelerations),
    });
    let points = points.collect();
    JointTrajectory { joint_names: chosen.iter().map(|&k| motion.joint_names[k].clone()).collect(), points }
}

/// Result of checking a motion against the arms' limits.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct LimitCheck {
    /// Limits that it exceeds: positions first, then the others, worst first.
    pub broken: Vec<LimitViolation>,
    /// Speed factor at which velocities and accelerations stay within the limits; 1 if they already do.
    pub possible_rate: f64,
}

/// Checks a motion against the limits of all arms. `joints` are the names of all joints, arm by arm.
pub fn check(plan: &Plan, config: &CoordinatorConfig, joints: &[String]) -> Result<LimitCheck, TrajectoryError> {
    let limits = config.arms.iter().flat_map(|arm| (0..arm.dof).map(move |j| (&arm.limits, j)));
    let bounds: Vec<JointBounds> = limits
        .map(|(l, j)| {
            JointBounds::inside(l.position_lower[j], l.position_upper[j], l.velocity_max[j], l.acceleration_max[j])
        })
        .collect();
    let mut positions = Vec::new();
    let mut others: Vec<(f64, LimitViolation)> = Vec::new();
    let mut possible_rate = 1.0f64;
    for part in &plan.parts {
        let spline = Spline::new(&part.trajectory)?;
        for (k, joint) in part.trajectory.joint_names.iter().enumerate() {
            let found = joints.iter().position(|j| j == joint).and_then(|j| bounds.get(j));
            let (Some(b), e) = (found, spline.extremes(k)) else { continue };
            let broken = |limit, reaches: f64, allowed: f64| {
                let by = (reaches - allowed).abs();
                LimitViolation { joint: joint.clone(), limit, reaches, allowed, by }
            };
            if e.lowest < b.lower - 1e-6 {
                positions.push(broken("position", e.lowest, b.lower));
            }
            if e.highest > b.upper + 1e-6 {
                positions.push(broken("position", e.highest, b.upper));
            }
            for (limit, reaches, allowed, rate) in [
                ("velocity", e.fastest, b.velocity, b.velocity / e.fastest),
                ("acceleration", e.steepest, b.acceleration, (b.acceleration / e.steepest).sqrt()),
            ] {
                if reaches > allowed * SLACK + 1e-9 {
                    others.push((rate, broken(limit, reaches, allowed)));
                    possible_rate = possible_rate.min(rate);
                }
            }
        }
    }
    positions.sort_by(|a, b| b.by.total_cmp(&a.by));
    others.sort_by(|a, b| a.0.total_cmp(&b.0));
    let broken = positions.into_iter().chain(others.into_iter().map(|(_, broken)| broken)).collect();
    Ok(LimitCheck { broken, possible_rate })
}
