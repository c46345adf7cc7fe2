//! Plans of all arms between random obstacles, judged by somebody else: every path is followed in steps of 1/128 rad
//! with Pinocchio's kinematics and coal's collision checks, which share no code with the planner.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use dimos::collision::{CheckSettings, CollisionChecker, ExactChecker, Stop};
use dimos::planning::search::path_planner::plan;
use dimos::planning::search::settings::PlanSettings;
use dimos::robot::builtin;
use dimos::robot::model::JointKind;
use dimos::robot::random::Random;
use serde_json::{Value, json};

use super::planning::problems::{Arm, Problem, Shapes};
use crate::support::python::{python_with, recheck};
use crate::support::shared::shared;

/// Obstacles about each arm.
const OBSTACLES: usize = 7;

/// Obstacles of all kinds, away from the base.
fn obstacles(random: &mut Random) -> Vec<Value> {
    let mut thing = |number: usize| {
        let mut size = |least, most| random.between(least, most);
        let (kind, sizes) = match number % 3 {
            0 => ("box", vec![size(0.05, 0.3), size(0.05, 0.3), size(0.05, 0.5)]),
            1 => ("sphere", vec![size(0.03, 0.1)]),
            _ => ("cylinder", vec![size(0.02, 0.06), size(0.1, 0.6)]),
        };
        let (angle, away, up) = (random.between(-3.1, 3.1), random.between(0.3, 0.8), random.between(0.0, 0.9));
        let turn = random.between(-1.5, 1.5);
        json!({
            "name": format!("thing{number}"), "type": kind, "size": sizes,
            "position": [away * angle.cos(), away * angle.sin(), up],
            "quat_xyzw": [(0.5 * turn).sin(), 0.0, 0.0, (0.5 * turn).cos()],
        })
    };
    (0..OBSTACLES).map(&mut thing).collect()
}

/// Returns a configuration in which nothing touches.
fn free(checker: &mut ExactChecker, random: &mut Random) -> Option<Vec<f64>> {
    let limits = checker.limits().to_vec();
    let mut any = || limits.iter().map(|l| random.between(l.lower.max(-3.1), l.upper.min(3.1))).collect::<Vec<f64>>();
    (0..1000).map(|_| any()).find(|q| checker.is_free(q))
}

/// Plans for an arm, and has the paths judged; returns their number, and that of the plans that are no straight line.
/// `DIMOS_PLANS`: plans per arm.
fn judged(python: &Path, name: &str, urdf: &Path, package: Option<(&str, &Path)>) -> [usize; 2] {
    let number = std::env::var("DIMOS_PLANS").ok().and_then(|n| n.parse().ok()).unwrap_or(6);
    let packages: BTreeMap<String, PathBuf> = package.iter().map(|(name, at)| ((*name).into(), at.into())).collect();
    let mut arm = Arm::load(urdf, None, packages).unwrap();
    let model = arm.model();
    // A gripper's joints are not planned.
    let moves = |j: &usize| model.joints[*j].kind != JointKind::Prismatic && !model.joints[*j].name.contains("drive");
    let joints: Vec<String> =
        model.independent_joints().into_iter().filter(moves).map(|j| model.joints[j].name.clone()).collect();
    let placed = model
        .joints
        .iter()
        .zip(arm.rest())
        .filter(|(joint, _)| joint.kind != JointKind::Fixed && !joints.contains(&joint.name));
    let rest: serde_json::Map<String, Value> = placed.map(|(joint, at)| (joint.name.clone(), json!(at))).collect();
    let record = |index: usize, things: &[Value], [start, goal]: [&[f64]; 2], ignored: &[[String; 2]]| {
        json!({
            "problem": name, "index": index, "joints": joints, "start": start, "goal": goal, "obstacles": things,
            "ignored": ignored, "rest": rest,
        })
    };
    let read = |record: &Value| -> Problem { serde_json::from_value(record.clone()).unwrap() };
    let empty = read(&record(0, &[], [&[], &[]], &[]));
    let kinematics = Arc::new(arm.kinematics(&empty).unwrap());
    let ignored = arm.allow_always_touching_pairs(&kinematics);
    let (mut random, mut problems, mut rows) = (Random::new(11), Vec::new(), Vec::new());
    let mut searched = 0;
    for index in 0..number {
        let things = obstacles(&mut random);
        let scene = arm.scene(&kinematics, &read(&record(index, &things, [&[], &[]], &ignored)), Shapes::True).unwrap();
        let mut checker = ExactChecker::new(scene, CheckSettings::default());
        let ends = (free(&mut checker, &mut random), free(&mut checker, &mut random));
        let (Some(start), Some(goal)) = ends else { continue };
        let mut settings = PlanSettings { seed: index as u64, refine: 4, ..PlanSettings::default() };
        settings.search.max_samples = 1_000_000;
        let found = plan(&mut checker, &start, std::slice::from_ref(&goal), &settings, &Stop::never());
        let Ok(found) = found else { continue };
        searched += usize::from(!found.straight);
        problems.push(record(index, &things, [&start, &goal], &ignored));
        rows.push(json!({ "problem": name, "index": index, "solved": true, "path": found.path }));
    }
    let said = recheck(python, urdf, package, &problems, &rows);
    assert!(said.contains(": 0 touch; 0 unsolved"), "{name}: {said}");
    println!("{name}: {}", said.trim());
    [rows.len(), searched]
}

#[test]
fn no_path_of_any_arm_touches_anything() {
    let Some(python) = python_with(&["pinocchio", "coal"]) else { return };
    let folder = tempfile::tempdir().unwrap();
    let mut judgements = Vec::new();
    for name in builtin::names() {
        let urdf = folder.path().join(format!("{name}.urdf"));
        std::fs::write(&urdf, builtin::text(name).unwrap()).unwrap();
        judgements.push(judged(&python, name, &urdf, None));
    }
    let Some(models) = shared("models") else { return };
    for name in ["panda", "piper", "xarm6", "xarm7"] {
        let at = models.join(name);
        judgements.push(judged(&python, name, &at.join(format!("{name}.urdf")), Some((name, &at))));
    }
    let [plans, searched] = [0, 1].map(|which| judgements.iter().map(|numbers| numbers[which]).sum::<usize>());
    assert!(plans > 80 && searched > 40, "{plans}, {searched}");
}
