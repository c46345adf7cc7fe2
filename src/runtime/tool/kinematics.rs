//! Puts the factory kinematics of the arms into the models of a run.

use std::path::Path;

use super::kept_kinematics::{self, KeptKinematics};
use crate::blueprint::{Arm, Blueprint};
use dimos_core::arm::FactoryKinematics;
use dimos_hardware::device::Connected;
use dimos_robot::calibrated::{self, Places};
use dimos_robot::urdf::Meshes;
use dimos_robot::{Source, load};

/// What is known of the dimensions of an arm.
pub(in crate::runtime) struct Known {
    kinematics: FactoryKinematics,
    /// Whose they are, for people.
    whose: String,
}

impl Known {
    /// Returns what a connected arm reports, and keeps it; what is kept of an arm that reports nothing is not used: it
    /// may be another arm's.
    pub fn connected(arm: &Arm, about: &Connected) -> Option<Self> {
        let kinematics = about.kinematics.clone()?;
        let serial = about.info.serial_number.clone();
        if let (Some(serial), Some(_), true) = (&serial, &kinematics.actual, arm.is_real()) {
            let (adapter, address) = (arm.adapter_type.clone(), address(arm));
            let kept = KeptKinematics { adapter, address, serial: serial.clone(), kinematics: kinematics.clone() };
            let written = kept_kinematics::folder().map(|folder| kept_kinematics::keep(&folder, &kept));
            if let Some(Err(error)) = written {
                tracing::warn!("the factory kinematics of {} are not kept: {error}", arm.hardware_id);
            }
        }
        Some(Self { kinematics, whose: serial.map_or_else(String::new, |serial| format!(" of serial {serial}")) })
    }

    /// Returns what is kept of the arm that was last connected at this address.
    fn kept(folder: &Path, arm: &Arm) -> Option<Self> {
        let kept = kept_kinematics::find(folder, &arm.adapter_type, &address(arm)).filter(|_| arm.is_real())?;
        Some(Self { whose: format!(" of serial {}, as it was read last", kept.serial), kinematics: kept.kinematics })
    }
}

/// Returns the address of an arm as it is kept: complete.
fn address(arm: &Arm) -> String {
    (arm.adapter.address.check)(&arm.address).unwrap_or_else(|_| arm.address.clone())
}

/// Puts kept kinematics into the models of a blueprint whose arms are not connected by this process. Returns a line for
/// each arm that has some.
pub fn use_kept(blueprint: &mut Blueprint) -> Vec<String> {
    kept_kinematics::folder().map_or_else(Vec::new, |folder| use_kept_in(&folder, blueprint))
}

fn use_kept_in(folder: &Path, blueprint: &mut Blueprint) -> Vec<String> {
    let known: Vec<_> = blueprint.arms.iter().map(|arm| Known::kept(folder, arm)).collect();
    let notes = correct(blueprint, &known);
    let named = blueprint.arms.iter().zip(notes);
    named.filter_map(|(arm, note)| Some(format!("{}: {}", arm.hardware_id, note?))).collect()
}

/// Puts kinematics into the models of a blueprint, one entry per arm. Returns what is to be said of each arm.
pub(in crate::runtime) fn correct(blueprint: &mut Blueprint, known: &[Option<Known>]) -> Vec<Option<String>> {
    let mut notes = Vec::new();
    for (index, known) in known.iter().enumerate() {
        let note = known.as_ref().and_then(|known| correct_arm(blueprint, index, known));
        notes.push(note);
    }
    notes
}

fn correct_arm(blueprint: &mut Blueprint, index: usize, known: &Known) -> Option<String> {
    let Known { kinematics, whose } = known;
    let joints = blueprint.arms.get(index)?.joints.clone();
    let names = blueprint.joint_names().into_iter().map(str::to_owned).collect::<Vec<_>>();
    let mut found: Option<Result<bool, String>> = None;
    let mut put = |source: Source, own: Vec<String>, to: &mut Places| {
        let model = load(&Source { meshes: Meshes::Ignore, places: Places::new(), ..source }).into_model();
        let base = model.as_ref().ok().and_then(|model| {
            let (link, base) = calibrated::controller_base(model, &own, &kinematics.nominal)?;
            Some((model.links.get(link)?.name.clone(), base))
        });
        let places = model.and_then(|model| calibrated::places(&model, &own, kinematics));
        let outcome = places.map(|places| {
            let any = !places.is_empty();
            *to = places;
            any
        });
        found = Some(match found.take() {
            Some(Err(why)) => Err(why),
            _ => outcome,
        });
        base
    };
    for robot in blueprint.planner.iter_mut().flat_map(|planner| &mut planner.robots) {
        let own = |joint: &String| {
            let at = robot.coordinator_joints.iter().position(|other| other == joint);
            at.and_then(|at| robot.joints.get(at)).cloned()
        };
        if let Some(own) = joints.iter().map(own).collect() {
            robot.controller_base = put(robot.source(), own, &mut robot.places);
        }
    }
    for task in &mut blueprint.tasks {
        let Some(robot) = &mut task.robot else { continue };
        let own = |joint: &String| {
            let at = task.joints.iter().position(|other| names.get(*other) == Some(joint));
            at.and_then(|at| robot.joints.get(at)).cloned()
        };
        if let Some(own) = joints.iter().map(own).collect() {
            put(robot.source.clone(), own, &mut robot.source.places);
        }
    }
    let tool = blueprint.arms.get_mut(index).and_then(|arm| arm.tool_robot.as_mut()).map(|tool| &mut tool.robot);
    if let Some(robot) = tool.filter(|robot| robot.joints.len() == joints.len()) {
        put(robot.source.clone(), robot.joints.clone(), &mut robot.source.places);
    }
    match found? {
        Ok(_) if kinematics.actual.is_none() => {
            Some("its controller reports no factory kinematics: it is that of the data sheet".to_owned())
        }
        Ok(false) => None,
        Ok(true) => Some(format!("factory kinematics{whose} (checksum {})", short(&kinematics.checksum))),
        Err(why) => Some(format!("the factory kinematics{whose} do not fit the model, which is left as it is: {why}")),
    }
}

/// Returns the beginning of a checksum, which is enough to compare it.
fn short(checksum: &str) -> &str {
    checksum.get(..16).unwrap_or(checksum)
}

#[cfg(test)]
#[path = "kinematics_tests.rs"]
mod tests;
