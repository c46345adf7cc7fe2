//! Checks a job where no run is live: against what a blueprint has, or only for what no arm does.

use super::names::Names;
use super::step::{Act, Job, Step};
use super::times::all;
use crate::blueprint::{ArmSummary, Catalog, Overrides, Summary};
use crate::cli::check;
use crate::cli::exit::Result;
use dimos_core::written;
use dimos_rpc::api::RobotReport;
use dimos_rpc::report::ArmReport;
use dimos_yaml::NodeId;

impl Names {
    /// Takes what a blueprint has: arms, joints with their limits, poses. Saved poses, inputs, outputs, grippers and
    /// objects are those of a run.
    pub fn of_blueprint(name: &str, catalog: Catalog<'_>) -> Result<Self> {
        let loaded = check::load(name, &Overrides::default(), catalog)?;
        let Some(blueprint) = loaded.blueprint.as_ref().filter(|_| loaded.errors() == 0) else {
            return Err(check::mistakes(&loaded));
        };
        let summary = Summary::of(blueprint);
        let robots = blueprint.planner.iter().flat_map(|planner| &planner.robots).map(|robot| RobotReport {
            name: robot.name.clone(),
            end_effector_link: robot.end_effector_link.clone(),
            tool: None,
            joints: robot.coordinator_joints.clone(),
            limits: Vec::new(),
            task: robot.task.clone(),
            named_poses: robot.named_poses.clone(),
        });
        let joints = |arm: &ArmSummary| arm.joints.iter().map(|joint| joint.name.clone()).collect();
        Ok(Self {
            is_live: false,
            arms: summary.arms.iter().map(known_of).collect(),
            planner: blueprint.planner.is_some(),
            joints: summary.arms.iter().map(|arm| (arm.hardware_id.clone(), joints(arm))).collect(),
            robots: robots.collect(),
            poses: Default::default(),
            objects: Vec::new(),
        })
    }
}

/// Returns what is known of an arm that is not connected.
fn known_of(arm: &ArmSummary) -> ArmReport {
    let limits = arm.joints.iter().map(|joint| {
        let (lower, upper) = (joint.position_lower, joint.position_upper);
        [lower.map_or(f64::NEG_INFINITY, |l| l.value), upper.map_or(f64::INFINITY, |l| l.value)]
    });
    ArmReport { hardware_id: arm.hardware_id.clone(), position_limits: limits.collect(), ..ArmReport::default() }
}

/// Reports joint positions that are probably in degrees, where no limits are known.
pub fn doubt_positions(job: &mut Job) {
    let mut steps = Vec::new();
    all(&job.steps, &mut steps);
    all(&job.on_fault, &mut steps);
    let mistakes: Vec<(NodeId, String, String)> = steps.into_iter().filter_map(degrees).collect();
    mistakes.into_iter().for_each(|(at, what, hint)| job.report(at, what, Some(hint)));
}

fn degrees(step: &Step) -> Option<(NodeId, String, String)> {
    let Act::Move(motion) = &step.act else { return None };
    let goals = motion.through.iter().chain([&motion.goal]).filter_map(|goal| goal.joints.as_ref());
    let mut positions = goals.flat_map(|joints| joints.iter().enumerate());
    let (number, position, hint) = positions.find_map(|(i, q)| Some((i + 1, q, written::degrees(*q)?)))?;
    let hint = format!("{hint}; for an arm that turns that far: --blueprint NAME");
    Some((step.at, format!("joint {number} at {position} rad is more than a turn"), hint))
}
