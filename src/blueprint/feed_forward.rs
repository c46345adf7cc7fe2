//! What an arm is commanded beside positions: the limits of its efforts, and what is fed forward to it, with the model
//! that this is computed with: that of `model_path`, else a robot of the planner or of a Cartesian task, or a built-in
//! one.

use nalgebra::{Matrix3, UnitQuaternion, Vector3};

use crate::blueprint::arms::Hardware;
use crate::blueprint::planner_files::file;
use crate::blueprint::resolve::{Arm, Checker, Task, TaskRobot};
use crate::blueprint::schema::HardwareEntry;
use crate::blueprint::tool_speed::known_robot;
use dimos_control::config::{EffortConfig, FeedForward};
use dimos_control::task_body::Demand;
use dimos_core::arm::{EffortLimits, Impedance, Load};
use dimos_core::joint::MAX_DOF;
use dimos_planner::planning::scene::config::PlannerConfig;
use dimos_robot::dynamics::{Dynamics, GRAVITY, massless};
use dimos_robot::kinematics::Kinematics;
use dimos_robot::model::{Inertial, RobotModel};
use dimos_robot::{Source, load};
use dimos_yaml::{Diag, Located, NodeId, quote};

/// Largest angle between two directions of gravity that count as one [rad].
const ALIKE: f64 = 0.01;

/// What an arm is commanded beside positions.
#[derive(Debug, Clone, PartialEq)]
pub struct ArmEffort {
    /// Limits of efforts.
    pub limits: EffortLimits,
    /// What is fed forward.
    pub feed_forward: FeedForward,
    /// What that is computed with.
    robot: Option<Weighed>,
}

/// A model whose weight is computed.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Weighed {
    pub(super) robot: TaskRobot,
    /// Link of the flange, where the load is.
    pub(super) flange: Option<String>,
    /// Gravity in the frame of the model's root [m/s²].
    pub(super) gravity: [f64; 3],
    pub(super) load: Option<Load>,
}

/// Where the model of an arm may be found.
#[derive(Clone, Copy)]
pub(super) struct KnownRobots<'a> {
    /// Its joints among those of all arms.
    pub(super) joints: &'a [usize],
    pub(super) tasks: &'a [Task],
    pub(super) planner: Option<&'a PlannerConfig>,
}

/// Sets what every arm is commanded beside positions.
pub(super) fn resolve(
    checker: &mut Checker<'_>,
    entries: &[Located<HardwareEntry>],
    hardware: &mut Hardware,
    tasks: &[Task],
    planner: Option<&PlannerConfig>,
) {
    let mut first = 0;
    for (index, arm) in hardware.arms.iter_mut().enumerate() {
        let joints: Vec<usize> = (first..first + arm.joints.len()).collect();
        first += arm.joints.len();
        let Some(entry) = entries.iter().find(|entry| entry.hardware_id.value == arm.hardware_id) else { continue };
        let complies = |task: &&Task| task.spec.demand == Demand::Impedance && task.arms.contains(&index);
        let task = tasks.iter().find(complies).map(|task| task.name.as_str());
        let known = KnownRobots { joints: &joints, tasks, planner };
        arm.effort = of_arm(checker, entry, arm, task, known);
    }
}

/// Returns it for one arm. `task`: a task that needs efforts.
fn of_arm(
    checker: &mut Checker<'_>,
    entry: &Located<HardwareEntry>,
    arm: &Arm,
    task: Option<&str>,
    known: KnownRobots<'_>,
) -> Option<ArmEffort> {
    let feed_forward = entry.feed_forward.as_ref().map_or(FeedForward::None, |given| given.value);
    let limit = [&entry.limits.effort, &entry.limits.effort_rate].into_iter().flatten().map(|given| given.at).next();
    let wanted = (feed_forward != FeedForward::None).then_some(entry.feed_forward.as_ref()).flatten();
    let at = wanted.map(|given| given.at).or(limit);
    if at.is_none() && task.is_none() {
        let unused = entry.model_path.as_ref().map(|given| given.at);
        let has_body = ["sim", "physics"].iter().try_fold(&arm.options, |options, key| options.get(key)).is_some();
        if let Some(unused) = unused.filter(|_| !has_body) {
            let diag = Diag::error("`model_path` has no use without `feed_forward`");
            checker.error(unused, diag.hint("add `feed_forward: gravity` or `feed_forward: dynamics`, or remove it"));
        }
        return None;
    }
    let at = at.unwrap_or(entry.hardware_id.at);
    if let Some(objection) = arm.setpoint.effort.objection() {
        let diag = Diag::error(format!("{} is given no efforts", quote(&arm.adapter_type))).note(objection);
        checker.error(at, diag.hint("remove `feed_forward` and the limits of efforts; see `dimos list-adapters`"));
        return None;
    }
    let robot = robot(checker, entry, arm, known);
    let model = match &robot {
        Some(robot) if checker.assets.source_awaited(&robot.robot.source) => None,
        Some(robot) => Some(load(&robot.robot.source).into_model()),
        None => None,
    };
    let model = match model {
        Some(Err(what)) => {
            checker.error(at, Diag::error(format!("the model of {} cannot be read: {what}", arm.hardware_id)));
            return None;
        }
        Some(Ok(model)) => Some(model),
        None => None,
    };
    if let (Some(robot), Some(model), Some(given)) = (&robot, &model, wanted) {
        check(checker, given.at, arm, robot, model)?;
    } else if let (None, Some(given), false) = (&robot, wanted, checker.incomplete) {
        let diag = Diag::error(format!("no model of {} is known, so its weight is not either", arm.hardware_id));
        checker.error(given.at, diag.hint("add `model_path: FILE.urdf` to this arm, or a robot to `planner`"));
        return None;
    }
    let limits = limits(checker, at, arm, robot.as_ref().zip(model.as_ref()), task)?;
    Some(ArmEffort { limits, feed_forward, robot: robot.filter(|_| wanted.is_some()) })
}

/// Returns the limits of efforts: the blueprint's, else the model's.
fn limits(
    checker: &mut Checker<'_>,
    at: NodeId,
    arm: &Arm,
    model: Option<(&Weighed, &RobotModel)>,
    task: Option<&str>,
) -> Option<EffortLimits> {
    let mut limits = EffortLimits { max: [0.0; MAX_DOF], rate: [0.0; MAX_DOF] };
    let of_model = |j: usize| {
        let (robot, model) = model?;
        let joint = model.joints.get(model.joint_index(robot.robot.joints.get(j)?)?)?;
        Some(joint.limits.effort).filter(|effort| effort.is_finite() && *effort > 0.0)
    };
    let slots = limits.max.iter_mut().zip(&mut limits.rate);
    for (j, ((name, given), (max, rate))) in arm.joints.iter().zip(&arm.limits).zip(slots).enumerate() {
        let Some(most) = given.effort.or_else(|| of_model(j)) else {
            let because = task.map_or(String::new(), |task| format!(", and task {task} commands it"));
            let diag = Diag::error(format!("the highest effort of {} is not known{because}", quote(name)));
            checker.error(at, diag.hint("give it in Nm, or N for a linear joint: `limits: {effort: NUMBER}`"));
            return None;
        };
        (*max, *rate) = (most, given.effort_rate.unwrap_or(EffortLimits::RATE * most));
    }
    Some(limits)
}

/// Checks that the weight of an arm can be computed with a model.
fn check(checker: &mut Checker<'_>, at: NodeId, arm: &Arm, robot: &Weighed, model: &RobotModel) -> Option<()> {
    let known = |name: &&String| {
        let joint = model.joint_index(name).and_then(|joint| model.joints.get(joint));
        joint.is_some_and(|joint| joint.is_independent())
    };
    if robot.robot.joints.len() != arm.joints.len() || !robot.robot.joints.iter().all(|name| known(&name)) {
        let diag = Diag::error(format!("the joints of the model are not those of {}", arm.hardware_id));
        checker.error(at, diag.hint("a model names them as the blueprint does, or has as many that move"));
        return None;
    }
    let weightless = massless(model);
    if !weightless.is_empty() {
        let diag = Diag::error(format!("the model has no mass of {}", weightless.join(", ")));
        checker.error(at, diag.hint("a model with an `inertial` in each of these links is needed: `model_path`"));
        return None;
    }
    let flange = robot.flange.as_ref().is_some_and(|flange| model.link_index(flange).is_some());
    if robot.load.is_some() && !flange {
        let diag = Diag::error("the model has no flange, where the payload is");
        checker.error(at, diag.hint("name it: `flange_link` of the robot in `planner`"));
        return None;
    }
    Some(())
}

/// Returns the model of an arm, how gravity acts on it, and its load; `None`: none is known.
pub(super) fn robot(
    checker: &mut Checker<'_>,
    entry: &Located<HardwareEntry>,
    arm: &Arm,
    known: KnownRobots<'_>,
) -> Option<Weighed> {
    let mut planned = known.planner.into_iter().flat_map(|planner| &planner.robots);
    let planned = planned.find(|robot| arm.joints.iter().all(|joint| robot.coordinator_joints.contains(joint)));
    let known = known_robot(arm, known.joints, known.tasks, planned);
    let robot = match &entry.model_path {
        Some(path) => {
            let source = Source { path: file(checker, path.at, path), ..Source::default() };
            let joints = names(&source, arm, known.as_ref());
            let base = known.as_ref().and_then(|known| known.base.clone());
            let (link, tool, fixed) = (String::new(), None, Default::default());
            TaskRobot { source, joints, link, tool, base, fixed }
        }
        None => known?,
    };
    let flange = planned.and_then(|planned| planned.flange_link.clone());
    let flange = flange.or_else(|| arm.tool.model.map(|(_, flange)| flange.to_owned()));
    let at_base = gravity(checker, entry, arm, robot.base.as_ref().map(|(_, pose)| pose.rotation))?;
    let turned = robot.base.as_ref().map_or(UnitQuaternion::identity(), |(link, _)| base_in_root(&robot, link));
    Some(Weighed { gravity: (turned * at_base).into(), flange, load: arm.setup.payload, robot })
}

/// Returns the model's names of an arm's joints: those that are known, the arm's own, else those that move, in order.
fn names(source: &Source, arm: &Arm, known: Option<&TaskRobot>) -> Vec<String> {
    let Ok(model) = load(source).into_model() else { return arm.joints.clone() };
    let has = |names: &&Vec<String>| names.iter().all(|name| model.joint_index(name).is_some());
    let own = || model.joints.iter().filter(|joint| joint.is_independent()).map(|joint| joint.name.clone()).collect();
    let named = known.map(|known| &known.joints).into_iter().chain([&arm.joints]);
    { named }.find(has).cloned().unwrap_or_else(own)
}

/// Returns the orientation of a robot's base link in the frame of its root.
fn base_in_root(robot: &TaskRobot, link: &str) -> UnitQuaternion<f64> {
    let Ok(model) = load(&robot.source).into_model() else { return UnitQuaternion::identity() };
    let poses = model.link_poses(&model.positions(&Default::default()));
    model.link_index(link).and_then(|link| poses.get(link)).map_or(UnitQuaternion::identity(), |pose| pose.rotation)
}

/// Returns gravity in the frame of the base [m/s²]: by how the planner has placed it, by its mounting, else upright.
fn gravity(
    checker: &mut Checker<'_>,
    entry: &Located<HardwareEntry>,
    arm: &Arm,
    placed: Option<UnitQuaternion<f64>>,
) -> Option<Vector3<f64>> {
    let down = Vector3::from(GRAVITY);
    let placed = placed.map(|base| base.inverse() * down);
    let mounted = arm.setup.gravity.map(|unit| Vector3::from(unit) * down.norm());
    if let (Some(placed), Some(mounted), Some(mounting)) = (placed, mounted, &entry.mounting)
        && placed.angle(&mounted) > ALIKE
    {
        let degrees = placed.angle(&mounted).to_degrees();
        let what = format!("by `mounting`, gravity is {degrees:.1}° from where `base_pose` of the planner has it");
        checker.error(mounting.at, Diag::error(what).hint("both place the same base: correct one of them"));
        return None;
    }
    Some(mounted.or(placed).unwrap_or(down))
}

impl Arm {
    /// Returns what it is commanded beside positions, if anything. `impedance`: how it is held in impedance mode. The
    /// error names a problem of its model.
    pub fn effort_config(&self, impedance: Option<Impedance>) -> Result<Option<EffortConfig>, String> {
        let Some(effort) = &self.effort else { return Ok(None) };
        let ArmEffort { limits, feed_forward, .. } = *effort;
        let dynamics = effort.robot.as_ref().map(Weighed::dynamics).transpose()?;
        Ok(Some(EffortConfig { limits, feed_forward, dynamics, impedance }))
    }
}

impl Arm {
    /// Returns what the weight of the arm is computed with, without a load, and the link of its flange. The error says
    /// what is not known.
    pub fn unloaded_dynamics(&self) -> Result<(Dynamics, usize), String> {
        let known = self.effort.as_ref().and_then(|effort| effort.robot.clone()).or_else(|| self.placed_robot());
        let known = known.ok_or("no model of it is known")?;
        let model = load(&known.robot.source).into_model()?;
        let weightless = massless(&model);
        if !weightless.is_empty() {
            return Err(format!("the model has no mass of {}", weightless.join(", ")));
        }
        let named = known.flange.clone().or_else(|| self.tool.model.map(|(_, flange)| flange.to_owned()));
        let flange = named.as_ref().and_then(|flange| model.link_index(flange));
        let flange = flange.ok_or("the model has no flange: name it by `flange_link` of the robot in `planner`")?;
        Ok((Weighed { load: None, ..known }.dynamics()?, flange))
    }

    /// Returns its model as the planner or its mounting has placed it.
    fn placed_robot(&self) -> Option<Weighed> {
        if let Some(body) = &self.body {
            return Some(body.robot.clone());
        }
        let robot = self.tool_robot.as_ref()?.robot.clone();
        let down = Vector3::from(GRAVITY);
        let mounted = self.setup.gravity.map(|unit| Vector3::from(unit) * down.norm());
        let placed = robot.base.as_ref().map(|(_, pose)| pose.rotation.inverse() * down);
        let turned = robot.base.as_ref().map_or(UnitQuaternion::identity(), |(link, _)| base_in_root(&robot, link));
        let gravity = (turned * mounted.or(placed).unwrap_or(down)).into();
        Some(Weighed { flange: Some(robot.link.clone()), gravity, load: None, robot })
    }
}

impl Weighed {
    /// Reads the model, and compiles it for the tick.
    fn dynamics(&self) -> Result<Dynamics, String> {
        let model = load(&self.robot.source).into_model()?;
        let joint = |name: &String| model.joint_index(name).ok_or_else(|| format!("the model has no joint {name:?}"));
        let joints = self.robot.joints.iter().map(joint).collect::<Result<Vec<_>, _>>()?;
        let fixed = self.robot.fixed.iter().map(|(name, at)| (name.clone(), *at)).collect();
        let kinematics = Kinematics::new(&model, &joints, &model.positions(&fixed));
        let mut dynamics = Dynamics::new(&model, kinematics.map_err(|e| e.to_string())?);
        dynamics.set_gravity(self.gravity);
        let flange = self.flange.as_ref().and_then(|flange| model.link_index(flange));
        if let Some((load, flange)) = self.load.as_ref().zip(flange) {
            dynamics.set_load(flange, Some(&inertial(load)));
        }
        Ok(dynamics)
    }
}

pub(super) fn inertial(load: &Load) -> Inertial {
    let [xx, xy, xz, yy, yz, zz] = load.inertia;
    let [x, y, z] = load.center;
    let origin = nalgebra::Isometry3::translation(x, y, z);
    Inertial { origin, mass: load.mass, inertia: Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz) }
}
