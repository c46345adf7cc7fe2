//! The body behind an emulated arm (`options.sim.physics`, `--sim=physics`): its model, how gravity acts on it, what it
//! carries, and the planner's obstacles around it.

use dimos_hardware::sim::physics::Scene;
use dimos_planner::planning::scene::config::{ObjectConfig, ObjectShape, PlannerConfig};
use dimos_robot::load;
use dimos_robot::mjcf::{Fixture, mjcf};
use dimos_robot::model::{Geometry, Joint, JointKind, Limits, Link, MeshFile, RobotModel};
use dimos_yaml::{Diag, Located};
use nalgebra::{Isometry3, Vector3};

use crate::blueprint::arms::Hardware;
use crate::blueprint::feed_forward::{KnownRobots, Weighed, inertial, robot};
use crate::blueprint::resolve::{Arm, Checker, Task};
use crate::blueprint::schema::HardwareEntry;

/// The body of an arm.
#[derive(Debug, Clone)]
pub struct ArmBody {
    pub(super) robot: Weighed,
    objects: Vec<ObjectConfig>,
}

/// Sets the bodies of emulated arms.
pub(super) fn resolve(
    checker: &mut Checker<'_>,
    entries: &[Located<HardwareEntry>],
    hardware: &mut Hardware,
    tasks: &[Task],
    planner: Option<&PlannerConfig>,
) {
    let mut first = 0;
    for arm in &mut hardware.arms {
        let joints: Vec<usize> = (first..first + arm.joints.len()).collect();
        first += arm.joints.len();
        let given = ["sim", "physics"].iter().try_fold(&arm.options, |options, key| options.get(key));
        if !arm.simulated || given.is_none_or(serde_json::Value::is_null) {
            continue;
        }
        let Some(entry) = entries.iter().find(|entry| entry.hardware_id.value == arm.hardware_id) else { continue };
        let known = KnownRobots { joints: &joints, tasks, planner };
        let objects = planner.map(|planner| planner.objects.clone()).unwrap_or_default();
        match robot(checker, entry, arm, known) {
            Some(robot) => arm.body = Some(ArmBody { robot, objects }),
            None if checker.incomplete => {}
            None => {
                let diag = Diag::error(format!("no model of {} is known, so it has no body", arm.hardware_id));
                let hint = "add `model_path: FILE.urdf` to this arm, or a robot to `planner`; or run with --sim";
                checker.error(entry.hardware_id.at, diag.hint(hint));
            }
        }
    }
}

impl Arm {
    /// Returns its body and what is around it; `None`: its joints have no mass. The error names a problem of its model.
    pub fn scene(&self) -> Result<Option<Scene>, String> {
        self.body.as_ref().map(ArmBody::scene).transpose()
    }
}

impl ArmBody {
    fn scene(&self) -> Result<Scene, String> {
        let Weighed { robot, flange, gravity, load: carried } = &self.robot;
        let mut model = load(&robot.source).into_model()?;
        let poses = model.link_poses(&model.positions(&Default::default()));
        let base = robot.base.as_ref().and_then(|(link, pose)| Some((model.link_index(link)?, pose)));
        // The root's pose in the frame `map`.
        let root = base.and_then(|(link, pose)| Some(pose * poses.get(link)?.inverse()));
        let arms: Vec<usize> = robot.joints.iter().filter_map(|name| model.joint_index(name)).collect();
        if arms.len() != robot.joints.len() {
            return Err("its model does not have its joints".to_owned());
        }
        let others: Vec<usize> = model.independent_joints().into_iter().filter(|own| !arms.contains(own)).collect();
        let at = model.positions(&robot.fixed.iter().map(|(name, at)| (name.clone(), *at)).collect());
        model.fix(others, &at);
        if let Some((load, flange)) = carried.as_ref().zip(flange.as_ref().and_then(|name| model.link_index(name))) {
            carry(
                &mut model,
                flange,
                Link { name: "payload".into(), inertial: Some(inertial(load)), ..Link::default() },
            );
        }
        let to_root = root.unwrap_or_else(Isometry3::identity).inverse();
        let fixtures: Vec<Fixture> = self.objects.iter().filter_map(|object| fixture(object, &to_root)).collect();
        let effort = |name: &String| model.joint_index(name).and_then(|joint| model.joints.get(joint));
        let efforts = robot.joints.iter().map(|name| effort(name).map_or(0.0, |joint| joint.limits.effort));
        let efforts = efforts.map(|most| if most.is_finite() { most } else { 0.0 }).collect();
        Ok(Scene { mjcf: mjcf(&model, *gravity, &fixtures)?, joints: robot.joints.clone(), efforts })
    }
}

/// Fixes a link to another one.
fn carry(model: &mut RobotModel, parent: usize, link: Link) {
    let (name, child) = (format!("{}_joint", link.name), model.links.len());
    model.links.push(link);
    model.joints.push(Joint {
        name,
        kind: JointKind::Fixed,
        parent,
        child,
        origin: Isometry3::identity(),
        axis: Vector3::x_axis(),
        limits: Limits::NONE,
        mimic: None,
    });
}

/// Returns an obstacle of the planner without its padding; a cloud of points is none: it has no inside.
fn fixture(object: &ObjectConfig, to_root: &Isometry3<f64>) -> Option<Fixture> {
    let geometry = match &object.shape {
        ObjectShape::Box(size) => Geometry::Box { size: Vector3::from(*size) },
        ObjectShape::Sphere(radius) => Geometry::Sphere { radius: *radius },
        ObjectShape::Cylinder([radius, length]) => Geometry::Cylinder { radius: *radius, length: *length },
        ObjectShape::Mesh(path) => {
            let uri = path.display().to_string();
            Geometry::Mesh(MeshFile { uri, path: Some(path.clone()), scale: Vector3::repeat(1.0) })
        }
        ObjectShape::Cloud(_) => return None,
    };
    Some(Fixture { name: object.name.clone(), geometry, pose: to_root * object.pose })
}
