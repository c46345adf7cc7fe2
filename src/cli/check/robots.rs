//! The planner's robots in `dimos check`. Reads descriptions and shapes like a run.

use dimos_core::joint::CommandLimits;
use std::collections::BTreeMap;

use serde::Serialize;

use crate::blueprint::{Blueprint, JointSummary, Summary};
use crate::cli::output::{self, Table};
use crate::offline::{ObjectConfig, ObjectShape, PlannedRobot, PlanningScene};
use dimos_robot as robot;
use dimos_robot::Source;
use dimos_robot::mesh::Size;
use dimos_yaml::{Diag, Severity};

/// A planned robot.
#[derive(Debug, Serialize)]
pub(super) struct Robot {
    name: String,
    model: String,
    end_effector_link: String,
    joints: Vec<Joint>,
    named_poses: Vec<String>,
    /// Joints of the model that joints of other arms move, with the coordinator's names.
    moved_by_others: BTreeMap<String, String>,
    /// Joints that nothing is known of, with the widest position, which is assumed [rad or m].
    assumed: BTreeMap<String, f64>,
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

/// Returns what is doubtful in the files of a blueprint's robots and objects: the warnings of `model check` that need
/// them. What is wrong with them is an error of [`of`].
pub(super) fn judge(blueprint: &Blueprint) -> Vec<Diag> {
    if !blueprint.awaited_assets().is_empty() {
        return Vec::new();
    }
    let planner = blueprint.planner.as_ref();
    let planned = planner.iter().flat_map(|planner| &planner.robots).map(|robot| (robot.source(), false));
    // The warnings of their descriptions themselves are not among those of the blueprint.
    let moved = blueprint.tasks.iter().filter_map(|task| task.robot.as_ref()).filter(|robot| robot.base.is_none());
    let mut sources: Vec<(Source, bool)> = Vec::new();
    for (source, whole) in planned.chain(moved.map(|robot| (robot.source.clone(), true))) {
        if !sources.iter().any(|(known, _)| *known == source) {
            sources.push((source, whole));
        }
    }
    let mut diags: Vec<Diag> = Vec::new();
    for (source, whole) in sources {
        let mut loaded = robot::load(&source);
        let Some(model) = loaded.model.take() else { continue };
        let known = if whole { 0 } else { loaded.reports().len() };
        robot::judge(&mut loaded, &model);
        let reports = loaded.reports();
        let listed = reports.iter().filter(|report| report.severity == Severity::Warning).count();
        let more = loaded.warnings() - listed;
        for report in reports.into_iter().skip(known).filter(|report| report.severity == Severity::Warning) {
            diags.push(Diag::warning(report.placed()).maybe_hint(report.hint));
        }
        if more > 0 {
            diags.push(Diag::warning(format!("{more} more warnings about {}", source.path.display())));
        }
    }
    let objects = planner.iter().flat_map(|planner| &planner.objects);
    diags.extend(objects.filter_map(|object: &ObjectConfig| match &object.shape {
        ObjectShape::Mesh(path) => Size::read(path).ok()?.doubt_of_object(&object.name, path),
        _ => None,
    }));
    diags
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
pub(in crate::cli) fn commanded(summary: &Summary) -> BTreeMap<String, CommandLimits> {
    let bounds = |joint: &JointSummary| {
        // Position ranges are shown as in the model, beside those of the arm.
        let position = [f64::NEG_INFINITY, f64::INFINITY];
        let velocity = joint.velocity.map_or(f64::INFINITY, |limit| limit.value);
        CommandLimits {
            position,
            velocity,
            acceleration: joint.acceleration.value,
            jerk: joint.jerk.value,
            tcp_velocity: None,
        }
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
        moved_by_others: planned.moved_by_others().map(|(model, ours)| (model.to_owned(), ours.to_owned())).collect(),
        assumed: planned.assumed().into_iter().collect(),
        always_touching: touching.map(|(_, pair)| pair.clone()).collect(),
    }
}

pub(super) fn print(robot: &Robot) {
    output::line("");
    output::line(format_args!("robot {}: {}, planned to {}", robot.name, robot.model, robot.end_effector_link));
    let mut table = Table::new(&["  JOINT", "OF THE MODEL", ">LOWER", ">UPPER", ">?/s", ">?/s²", ">?/s³"]);
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
    for (model, ours) in &robot.moved_by_others {
        output::line(format_args!("  {model} is where {ours} is measured"));
    }
    for (joint, position) in &robot.assumed {
        output::line(format_args!("  {joint} is assumed at its widest, {position:.4}: nothing measures it"));
        output::line(format_args!(
            "  hint: fixed_joints: {{{joint}: {position:.4}}} if it stays there, gripper_joint if a gripper drives it"
        ));
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
