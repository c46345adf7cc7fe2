//! Checks the names in a job against a run, or a blueprint, before anything moves: arms, poses, inputs, outputs,
//! objects.

use std::collections::BTreeMap;

use super::step::{Act, Job, Motion, Step};
use super::times::all;
use crate::cli::exit::Result;
use crate::cli::goal::has_planner;
use crate::cli::grip;
use dimos_core::written;
use dimos_rpc::api::{Attach, PlanGoal, Planner, Poses, RobotReport, State, Status, World};
use dimos_rpc::client::Client;
use dimos_rpc::report::{ArmReport, ArmStateReport};
use dimos_yaml::{NodeId, did_you_mean, quote};

/// How far beyond a limit a goal is left to the planner [rad].
const BEYOND: f64 = 0.05;

/// What a run has, or a blueprint.
pub struct Names {
    /// Whether it is a run; of a blueprint, less is known.
    pub(super) is_live: bool,
    /// Its arms.
    pub arms: Vec<ArmReport>,
    /// Whether it has a planner.
    pub planner: bool,
    /// Joints of each arm, in order.
    pub(super) joints: BTreeMap<String, Vec<String>>,
    pub(super) robots: Vec<RobotReport>,
    pub(super) poses: BTreeMap<String, dimos_rpc::api::SavedPose>,
    pub(super) objects: Vec<String>,
}

/// A mistake: where, what, hint.
type Mistake = (NodeId, String, Option<String>);

impl Names {
    /// Asks a run.
    pub fn of(client: &mut Client) -> Result<Self> {
        let planner = has_planner(client)?;
        let arms = client.call(Status {})?.arms;
        let poses = client.call(Poses {})?.poses;
        let robots = if planner { client.call(Planner {})?.robots } else { Vec::new() };
        let objects = if planner { client.call(World {})?.objects } else { Vec::new() };
        let objects = objects.into_iter().map(|object| object.name).collect();
        let own = |arm: ArmStateReport| (arm.hardware_id, arm.joints.into_iter().map(|joint| joint.name).collect());
        let joints = client.call(State {})?.arms.into_iter().map(own).collect();
        Ok(Self { is_live: true, joints, arms, planner, robots, poses, objects })
    }

    /// Returns an arm.
    pub fn arm(&self, name: &str) -> Option<&ArmReport> {
        self.arms.iter().find(|arm| arm.hardware_id == name)
    }

    /// Gives every step of a job its arm, and reports the names that are not known.
    pub fn check(&self, job: &mut Job) -> Result<()> {
        if let ("", [only]) = (job.arm.as_str(), self.arms.as_slice()) {
            job.arm.clone_from(&only.hardware_id);
        }
        let arm = job.arm.clone();
        job.steps.iter_mut().chain(&mut job.on_fault).for_each(|step| name_arm(step, &arm));
        let mut steps = Vec::new();
        all(&job.steps, &mut steps);
        all(&job.on_fault, &mut steps);
        let mistakes: Vec<Mistake> = steps.into_iter().filter_map(|step| self.mistake(step)).collect();
        mistakes.into_iter().for_each(|(at, what, hint)| job.report(at, what, hint));
        job.verdict()
    }

    fn whose(&self) -> &'static str {
        if self.is_live { "run" } else { "blueprint" }
    }

    fn mistake(&self, step: &Step) -> Option<Mistake> {
        let say = |what: String, hint: Option<String>| Some((step.at, what, hint));
        let whose = self.whose();
        let unknown = |kind: &str, name: &str, known: &mut dyn Iterator<Item = &str>| {
            say(format!("the {whose} has no {kind} {}", quote(name)), did_you_mean(name, known, "it has"))
        };
        match &step.act {
            Act::Repeat { .. } | Act::Wait(_) => return None,
            Act::Attach(_) | Act::Detach(_) if !self.planner => {
                return say(format!("this {whose} has no planner, which knows objects"), None);
            }
            Act::Attach(Attach { name, .. }) | Act::Detach(name) if self.is_live && !self.objects.contains(name) => {
                return unknown("object", name, &mut self.objects.iter().map(String::as_str));
            }
            Act::Detach(_) => return None,
            _ => {}
        }
        let names = &mut self.arms.iter().map(|arm| arm.hardware_id.as_str());
        if step.arm.is_empty() {
            let all: Vec<&str> = names.collect();
            return say(format!("which arm? the {whose} has {}", all.join(", ")), Some("name it: `arm: …`".into()));
        }
        let Some(arm) = self.arm(&step.arm) else { return unknown("arm", &step.arm, names) };
        let levels = |kind: &str| {
            let io = arm.io.as_ref();
            match kind {
                "di" => io.map_or(0, |io| io.digital_inputs.len()),
                "do" => io.map_or(0, |io| io.digital_outputs.len()),
                _ => io.map_or(0, |io| io.analog_outputs.len()),
            }
        };
        let missing = |name: &str| {
            let (kind, number) = name.split_at_checked(2)?;
            let count = levels(kind);
            let known = number.parse::<usize>().is_ok_and(|number| number < count);
            let has = if count == 0 { "none".to_owned() } else { format!("{kind}0 to {kind}{}", count - 1) };
            (!known).then(|| (step.at, format!("{} has no {name}", step.arm), Some(format!("it has {has}"))))
        };
        match &step.act {
            Act::Move(motion) => self.motion(step, motion, arm),
            _ if !self.is_live => None,
            Act::Gripper { to, force, object, .. } => {
                let wrong = grip::impossible(arm, *to, *force).map(|(what, hint)| (step.at, what, hint));
                wrong.or_else(|| match object.is_some() && arm.gripper_range.is_none() {
                    true => say(format!("the gripper of {} cannot tell whether it holds something", step.arm), None),
                    false => None,
                })
            }
            Act::Input { input, .. } => missing(input),
            Act::Output(outputs) => outputs.keys().find_map(|name| missing(name)),
            _ => None,
        }
    }

    fn motion(&self, step: &Step, motion: &Motion, arm: &ArmReport) -> Option<Mistake> {
        let say = |what: String, hint: &str| Some((step.at, what, Some(hint.to_owned())));
        if !motion.direct && !self.planner {
            let hint = "run a planner blueprint; or write `direct: true`: not collision-checked";
            return say(format!("this {} has no planner", self.whose()), hint);
        }
        for act in &motion.on_path {
            if act.waypoint.is_some_and(|number| number > motion.through.len()) {
                let what = format!("on_path: the motion has {} waypoints before its goal", motion.through.len());
                return say(what, "waypoints are counted from 1");
            }
        }
        let count = arm.position_limits.len();
        for goal in motion.through.iter().chain([&motion.goal]) {
            match goal {
                PlanGoal { joints: Some(joints), .. } if joints.len() != count => {
                    let what = format!("{} has {count} joints, the goal {} values", step.arm, joints.len());
                    return say(what, "give one position [rad] per joint, base first");
                }
                PlanGoal { joints: Some(joints), .. } if beyond(joints, arm).is_some() => {
                    let (number, position) = beyond(joints, arm).unwrap_or_default();
                    let [lower, upper] = arm.position_limits.get(number).copied().unwrap_or_default();
                    let limits = format!("its limits are {lower:.4} to {upper:.4} rad");
                    let hint = written::degrees(position).unwrap_or(limits);
                    let name = self.joints.get(&step.arm).and_then(|joints| joints.get(number));
                    let name = name.map_or("a joint", String::as_str);
                    return say(format!("{name} at {position} rad is outside its limits"), &hint);
                }
                PlanGoal { named: Some(name), .. } if self.is_live && self.named(&step.arm, name).is_none() => {
                    let robots = self.robots.iter().filter(|robot| robot.name == step.arm);
                    let names = robots.flat_map(|robot| robot.named_poses.keys()).chain(self.poses.keys());
                    let hint = did_you_mean(name, names.map(String::as_str), "it has");
                    let hint = hint.unwrap_or_else(|| "save where the arm is: dimos pose save NAME".into());
                    return say(format!("the run has no pose {} of {}", quote(name), step.arm), &hint);
                }
                _ => {}
            }
        }
        None
    }

    /// Returns the positions of an arm's joints in a saved pose, or one of the blueprint [rad].
    pub fn named(&self, arm: &str, name: &str) -> Option<Vec<f64>> {
        let joints = self.joints.get(arm)?;
        if let Some(saved) = self.poses.get(name).and_then(|pose| pose.get(arm)) {
            return joints.iter().map(|joint| saved.get(joint).copied()).collect();
        }
        let robot = self.robots.iter().find(|robot| robot.name == arm)?;
        let values = robot.named_poses.get(name)?;
        let value = |joint| values.get(robot.joints.iter().position(|j| j == joint)?).copied();
        joints.iter().map(value).collect()
    }
}

/// Returns the number of the first joint that a goal sends outside its limits, and its position [rad].
fn beyond(joints: &[f64], arm: &ArmReport) -> Option<(usize, f64)> {
    // The planner ends a motion at the limit if its goal is a little beyond.
    let outside = |(position, [lower, upper]): (&f64, &[f64; 2])| !(lower - BEYOND..=upper + BEYOND).contains(position);
    let number = joints.iter().zip(&arm.position_limits).position(outside)?;
    Some((number, *joints.get(number)?))
}

/// Gives a step and its nested steps their arm.
fn name_arm(step: &mut Step, arm: &str) {
    if step.arm.is_empty() {
        arm.clone_into(&mut step.arm);
    }
    match &mut step.act {
        Act::Move(motion) => {
            motion.through.iter_mut().chain([&mut motion.goal]).for_each(|goal| goal.robot.clone_from(&step.arm));
            let grips =
                motion.on_path.iter_mut().filter_map(|act| act.gripper.as_mut().map(|gripper| &mut gripper.arm));
            grips.filter(|own| own.is_empty()).for_each(|own| own.clone_from(&step.arm));
            let outputs = motion.on_path.iter_mut().filter_map(|act| act.output.as_mut().map(|output| &mut output.arm));
            outputs.filter(|own| own.is_empty()).for_each(|own| own.clone_from(&step.arm));
        }
        Act::Attach(attach) => attach.robot.clone_from(&step.arm),
        Act::Repeat { steps, .. } => steps.iter_mut().for_each(|step| name_arm(step, arm)),
        _ => {}
    }
}
