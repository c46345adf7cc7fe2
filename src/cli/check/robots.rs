//! The planner's robots in `dimos check`. Reads descriptions and shapes like a run.

use std::collections::BTreeMap;

use serde::Serialize;
use serde_json::{Value, json};

use crate::blueprint::{Blueprint, JointSummary, Summary};
use crate::cli::output::{self, Table};
use crate::planning::config::JointBounds;
use crate::planning::planning_scene::{PlannedRobot, PlanningScene};

/// A planned robot.
#[derive(Debug, Serialize)]
pub(super) struct Robot {
    name: String,
    model: String,
    end_effector_link: String,
    joints: Vec<Joint>,
    named_poses: Vec<String>,
    /// Gripper joints without a measurement: assumed fully open.
    taken_as_open: Vec<String>,
    /// Pairs of links that touch in every configuration.
    always_touching: Vec<[String; 2]>,
}

/// A joint with the limits of its motions; `None` if there is none.
#[derive(Debug, Serialize)]
struct Joint {
    model: String,
    coordinator: String,
    lower: Option<f64>,
    upper: Option<f64>,
    velocity: Option<f64>,
    acceleration: Option<f64>,
    jerk: Option<f64>,
}

/// Returns the robots of a blueprint, none while assets are missing; the error is the one that a run would report.
pub(super) fn of(blueprint: &Blueprint) -> Result<Vec<Robot>, String> {
    // The contents of an asset are unknown until it is downloaded.
    let Some(planner) = blueprint.planner.as_ref().filter(|_| blueprint.awaited_assets().is_empty()) else {
        return Ok(Vec::new());
    };
    // With the velocity, acceleration and jerk limits of the run's arms.
    let setup = PlanningScene::load(planner)?.within(&commanded(&Summary::of(blueprint)))?;
    Ok(setup.robots.iter().map(|planned| robot(planned, &setup)).collect())
}

/// Returns the commanded limits of a blueprint's joints, as far as they are known without the arms.
pub(in crate::cli) fn commanded(summary: &Summary) -> BTreeMap<String, JointBounds> {
    let bounds = |joint: &JointSummary| {
        // Position ranges are shown as in the model, beside those of the arm.
        let position = [f64::NEG_INFINITY, f64::INFINITY];
        let velocity = joint.velocity.map_or(f64::INFINITY, |limit| limit.value);
        JointBounds { position, velocity, acceleration: joint.acceleration.value, jerk: joint.jerk.value }
    };
    summary.arms.iter().flat_map(|arm| &arm.joints).map(|joint| (joint.name.clone(), bounds(joint))).collect()
}

fn robot(planned: &PlannedRobot, setup: &PlanningScene) -> Robot {
    let (config, finite) = (&planned.config, |value: f64| Some(value).filter(|v| v.is_finite()));
    let names = config.joints.iter().zip(&config.coordinator_joints);
    let joints = names.zip(&planned.limits).map(|((model, coordinator), limits)| Joint {
        model: model.clone(),
        coordinator: coordinator.clone(),
        lower: finite(limits.lower),
        upper: finite(limits.upper),
        velocity: finite(limits.velocity),
        acceleration: limits.acceleration,
        jerk: limits.jerk,
    });
    let touching = setup.always_touching.iter().filter(|(name, _)| *name == config.name);
    Robot {
        name: config.name.clone(),
        model: config.model_path.display().to_string(),
        end_effector_link: config.end_effector_link.clone(),
        joints: joints.collect(),
        named_poses: config.named_poses.keys().cloned().collect(),
        taken_as_open: planned.taken_as_open().into_iter().map(|(name, _)| name).collect(),
        always_touching: touching.map(|(_, pair)| pair.clone()).collect(),
    }
}

/// Adds a run's start-up error to the problems; returns whether the blueprint is still valid.
pub(super) fn refuse(problems: &mut Value, what: &str) -> Value {
    if let Some(problems) = problems.as_array_mut() {
        problems.push(json!({"severity": "error", "message": what}));
    }
    json!(false)
}

pub(super) fn print(robot: &Robot) {
    output::line("");
    output::line(format_args!("robot {}: {}, planned to {}", robot.name, robot.model, robot.end_effector_link));
    let mut table = Table::new(&["  JOINT", "OF THE MODEL", ">LOWER", ">UPPER", ">/s", ">/s²", ">/s³"]);
    for joint in &robot.joints {
        let limits = [joint.lower, joint.upper, joint.velocity, joint.acceleration, joint.jerk];
        let mut cells = vec![format!("  {}", joint.coordinator), joint.model.clone()];
        cells.extend(limits.iter().map(|limit| output::number(*limit, 3)));
        table.row(cells);
    }
    table.print();
    if !robot.named_poses.is_empty() {
        output::line(format_args!("  named poses: {}", robot.named_poses.join(", ")));
    }
    for joint in &robot.taken_as_open {
        output::line(format_args!("  {joint} is assumed fully open: its position is not measured"));
        output::line("  hint: gripper_joint: {joint: …, closed: …, open: …} lets it follow the gripper");
    }
    for [a, b] in &robot.always_touching {
        output::line(format_args!(
            "  warning: {a} and {b} touch in every configuration: they are not checked against each other"
        ));
    }
    if !robot.always_touching.is_empty() {
        let hint = "allow the pair in collision_exclusion_pairs or the SRDF, or correct the shapes";
        output::line(format_args!("  hint: {hint}"));
    }
}
