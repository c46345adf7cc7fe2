//! Planning scene: robots and world, built from a planner's configuration. Reads descriptions, finds joints and links,
//! builds collision geometry.

use std::collections::{BTreeMap, HashMap};
use std::path::Path;
use std::sync::Arc;

use glamx::{DAffine3, DVec3};
use nalgebra::Isometry3;

use super::config::{CLOUD_RADIUS, ObjectConfig, ObjectShape, PlannerConfig, RobotConfig};
use super::ignored_pairs::{IgnoredPair, of_robot};
use super::proofs;
use super::stage_cache::StageCache;
use super::unplanned_joints::{Measured, idle};
use crate::collision::allowed_pairs::always_touching;
use crate::collision::body::{MeshMode, solids, solids_of, surface};
use crate::collision::cloud::Cloud;
use crate::collision::world::{Obstacle, Robot, World};
use crate::collision::{CheckSettings, ExactChecker, Solid, ply};
use crate::planning::settings::PlannerSettings;
use dimos_core::joint::{CommandLimits, DEFAULT_ACCELERATION};
use dimos_robot::kinematics::tool_speed::ToolSpeed;
use dimos_robot::kinematics::{Kinematics, KinematicsError, frame};
use dimos_robot::load;
use dimos_robot::mesh::{Mesh, Size};
use dimos_robot::model::{Limits, RobotModel};

/// Sampled configurations for the search of links that always touch.
const SAMPLES: usize = 200;
/// Links that touch in more than this part of the configurations count as always touching.
const ALWAYS_RATIO: f64 = 0.99;

/// Maximum size of a point cloud file [bytes].
const MAX_CLOUD: u64 = 256 << 20;

/// A planned robot.
#[derive(Debug, Clone)]
pub struct PlannedRobot {
    /// Its configuration.
    pub config: RobotConfig,
    /// Its model, limited further by the configuration.
    pub model: Arc<RobotModel>,
    /// Indices of the planned joints in the model.
    pub joints: Vec<usize>,
    /// Index of the end-effector link in the model.
    pub end_effector: usize,
    /// Limits of the planned joints.
    pub limits: Vec<Limits>,
    /// Highest speed of its tool and its flange [m/s].
    pub tcp_velocity: Option<f64>,
    /// Positions of the joints that are not planned, among those of all joints of the model [rad or m].
    pub rest: Vec<f64>,
    /// Its collision geometry at its base pose, with all planned joints.
    pub body: Robot,
    /// Pairs of links that its SRDF allows, each with its reason.
    pub(in crate::planning) disabled: Vec<([String; 2], String)>,
}

/// All robots and the world around them.
#[derive(Debug, Clone)]
pub struct PlanningScene {
    /// The robots, in the order of the configuration.
    pub robots: Vec<PlannedRobot>,
    /// The initial world. Its robots are those above, in the same order.
    pub world: World,
    /// Settings of the planner.
    pub settings: PlannerSettings,
    /// Distance that plans keep from obstacles and other arms [m].
    pub padding: f64,
    /// Pairs of links that touch in every configuration, with the robot's name; they are not checked.
    pub always_touching: Vec<(String, [String; 2])>,
    /// Pairs of links that are not checked, for each robot.
    pub(in crate::planning) ignored: Vec<Vec<IgnoredPair>>,
    /// Checkers of recent requests.
    pub(in crate::planning) staged: StageCache,
}

impl PlanningScene {
    /// Loads all descriptions. The error names the robot or object and lists everything wrong with its description.
    pub fn load(config: &PlannerConfig) -> Result<Self, String> {
        let mut world = World::new();
        let mut robots = Vec::new();
        for robot in &config.robots {
            let made = PlannedRobot::load(robot).map_err(|e| format!("robot {:?}: {e}", robot.name))?;
            world.add_robot(made.body.clone()).map_err(|e| format!("robot {:?}: {e}", robot.name))?;
            robots.push(made);
        }
        for object in &config.objects {
            let added = obstacle(object).and_then(|o| world.add(o).map_err(|e| e.to_string()));
            added.map_err(|e| format!("object {:?} of the world: {e}", object.name))?;
        }
        let mut setup = Self {
            robots,
            world,
            settings: PlannerSettings::default(),
            padding: config.padding,
            always_touching: Vec::new(),
            ignored: Vec::new(),
            staged: StageCache::default(),
        };
        setup.allow_always_touching_pairs();
        setup.prove_apart(config.proofs.as_deref());
        setup.ignored = setup.robots.iter().map(|robot| setup.ignored_of(robot)).collect();
        Ok(setup)
    }

    /// Adds the limits of the arms that execute the motions, by the coordinator's joint names, so that no plan exceeds
    /// them. The error names a joint whose limits do not overlap.
    pub fn within(mut self, bounds: &BTreeMap<String, CommandLimits>) -> Result<Self, String> {
        for robot in &mut self.robots {
            robot.narrow(bounds).map_err(|e| format!("robot {:?}: {e}", robot.config.name))?;
        }
        self.world = self.world.with_robots(self.robots.iter().map(|robot| robot.body.clone()).collect());
        Ok(self)
    }

    /// Returns the index of a robot by name.
    pub fn robot(&self, name: &str) -> Option<usize> {
        self.robots.iter().position(|robot| robot.config.name == name)
    }

    fn ignored_of(&self, robot: &PlannedRobot) -> Vec<IgnoredPair> {
        let own = |(name, pair): &(String, [String; 2])| (*name == robot.config.name).then(|| pair.clone());
        let always: Vec<[String; 2]> = self.always_touching.iter().filter_map(own).collect();
        of_robot(robot, &always, &robot.disabled)
    }

    /// Proves pairs of links that stay close, or finds them proven in the folder of earlier proofs.
    fn prove_apart(&mut self, folder: Option<&Path>) {
        for robot in &mut self.robots {
            robot.body.proven = proofs::of_robot(&robot.body, &robot.config.joints, folder);
        }
        self.world = self.world.with_robots(self.robots.iter().map(|robot| robot.body.clone()).collect());
    }

    /// Allows pairs of links that touch in every configuration: checking them would forbid all motion. They are
    /// reported by name.
    fn allow_always_touching_pairs(&mut self) {
        for robot in &mut self.robots {
            for pair in always_touch(&robot.body) {
                self.always_touching.push((robot.config.name.clone(), pair.clone()));
                robot.body.allowed.push(pair.into());
            }
        }
        self.world = self.world.with_robots(self.robots.iter().map(|robot| robot.body.clone()).collect());
    }
}

/// Returns the pairs of links of one robot that touch in every configuration without being allowed, by name.
pub fn always_touch(robot: &Robot) -> Vec<[String; 2]> {
    let mut alone = World::new();
    // Without the robot's name, links keep their own names.
    if alone.add_robot(Robot { name: String::new(), ..robot.clone() }).is_err() {
        return Vec::new();
    }
    // Reference configuration: zero, clamped to the limits.
    let home: Vec<f64> = robot.kinematics.limits().iter().map(|l| 0.0_f64.max(l.lower).min(l.upper)).collect();
    let suspects = always_touching(&alone.snapshot(), &home, SAMPLES, 0).into_iter();
    let always = suspects.filter(|suspect| suspect.share > ALWAYS_RATIO);
    always.map(|suspect| [suspect.contact.link, suspect.contact.other]).collect()
}

/// Returns the pairs in contact of a world that no planned joint moves, by name: they are not checked.
pub fn fixed_contacts(world: &World) -> Vec<[String; 2]> {
    ExactChecker::new(world.snapshot(), CheckSettings::default()).fixed_contacts()
}

/// Builds a robot with all independent joints planned, alone in the world.
pub fn whole(model: RobotModel, allowed: Vec<(String, String)>) -> Result<Robot, String> {
    Ok(Robot {
        name: String::new(),
        kinematics: Arc::new(Kinematics::whole(&model).map_err(|e| e.to_string())?),
        solids: solids(&model, MeshMode::Hull).map_err(|e| e.to_string())?,
        model: Arc::new(model),
        base: DAffine3::IDENTITY,
        padding: 0.0,
        apart: 0.0,
        allowed,
        proven: Vec::new(),
    })
}

impl PlannedRobot {
    fn load(config: &RobotConfig) -> Result<Self, String> {
        let mut loaded = load(&config.source());
        let semantics = std::mem::take(&mut loaded.semantics);
        let mut model = loaded.into_model()?;
        if let Some((link, mesh)) = model.collada_collision().filter(|_| !config.convert_meshes) {
            return Err(format!(
                "link {:?} has the collision mesh {:?}, and Collada files are not converted",
                link.name, mesh.uri
            ));
        }
        let joints = config.joints.iter().map(|name| joint(&model, name)).collect::<Result<Vec<_>, _>>()?;
        for &index in &joints {
            if let Some(joint) = model.joints.get_mut(index) {
                let own = joint.limits.acceleration.unwrap_or(DEFAULT_ACCELERATION.max(config.max_acceleration));
                joint.limits.velocity = joint.limits.velocity.min(config.max_velocity);
                joint.limits.acceleration = Some(own.min(config.max_acceleration));
                let jerks = [joint.limits.jerk, config.max_jerk].into_iter().flatten();
                joint.limits.jerk = jerks.reduce(f64::min);
            }
        }
        let link = |name: &str| {
            let names = model.links.iter().map(|link| link.name.as_str());
            let hint = || dimos_yaml::did_you_mean(name, names, "its links").unwrap_or_default();
            model.link_index(name).ok_or_else(|| format!("there is no link {name:?}; {}", hint()))
        };
        let (base, end_effector) = (link(&config.base_link)?, link(&config.end_effector_link)?);
        config.flange_link.as_deref().map(link).transpose()?;
        let shape = |link: &str| config.shapes.get(link).copied().unwrap_or_default();
        let solids = solids_of(&model, shape).map_err(|e| e.to_string())?;
        let idle = idle(config, &model, &joints, &Measured::default(), &[]);
        let posed = model.positions(&idle);
        let kinematics = compiled(&model, &joints, &posed, end_effector, config.tool.as_ref());
        let kinematics = kinematics.map_err(|e| e.to_string())?;
        let limits = kinematics.limits().to_vec();
        let base_in_model = model.link_poses(&posed).get(base).copied().unwrap_or_default();
        let model = Arc::new(model);
        let body = Robot {
            name: config.name.clone(),
            model: model.clone(),
            kinematics: Arc::new(kinematics),
            solids,
            base: frame(&(config.base_pose * base_in_model.inverse())),
            padding: 0.0,
            apart: 0.0,
            allowed: config.exclusions.iter().cloned().chain(semantics.disabled_pairs()).collect(),
            proven: Vec::new(),
        };
        let outside = |pose: &[f64]| pose.iter().zip(&limits).position(|(q, l)| !(l.lower..=l.upper).contains(q));
        for (name, pose) in &config.named_poses {
            if let Some(at) = outside(pose) {
                return Err(format!("the named pose {name:?} is outside the limits of {}", config.joints[at]));
            }
        }
        let mut config = config.clone();
        // Skips named poses of the SRDF that this robot cannot take; those of the configuration win.
        for (name, pose) in semantics.poses_of(&config.joints).into_iter().filter(|(_, pose)| outside(pose).is_none()) {
            config.named_poses.entry(name.to_owned()).or_insert(pose);
        }
        let disabled = { semantics.disabled }.into_iter().map(|pair| ([pair.a, pair.b], pair.reason)).collect();
        Ok(Self { config, model, joints, end_effector, limits, tcp_velocity: None, rest: posed, body, disabled })
    }

    fn narrow(&mut self, bounds: &BTreeMap<String, CommandLimits>) -> Result<(), String> {
        let mut model = (*self.model).clone();
        for (&index, name) in self.joints.iter().zip(&self.config.coordinator_joints) {
            let (Some(joint), Some(b)) = (model.joints.get_mut(index), bounds.get(name)) else { continue };
            self.tcp_velocity = b.tcp_velocity.into_iter().chain(self.tcp_velocity).reduce(f64::min);
            let (own, [lower, upper]) = (joint.limits, b.position);
            if own.upper.min(upper) <= own.lower.max(lower) {
                return Err(format!(
                    "{name} ranges from {:.3} to {:.3} rad in the model and from {lower:.3} to {upper:.3} rad in the \
                     coordinator: the ranges do not overlap",
                    own.lower, own.upper
                ));
            }
            joint.limits.lower = own.lower.max(lower);
            joint.limits.upper = own.upper.min(upper);
            joint.limits.velocity = own.velocity.min(b.velocity);
            joint.limits.acceleration = Some(own.acceleration.map_or(b.acceleration, |a| a.min(b.acceleration)));
            joint.limits.jerk = Some(own.jerk.map_or(b.jerk, |jerk| jerk.min(b.jerk)));
        }
        let kinematics = self.compiled(&model, &self.rest).map_err(|e| e.to_string())?;
        self.limits = kinematics.limits().to_vec();
        self.model = Arc::new(model);
        self.body = Robot { model: self.model.clone(), kinematics: Arc::new(kinematics), ..self.body.clone() };
        Ok(())
    }

    /// Returns the index of the tool centre point in the kinematics of [`body`](Self::body): the frame of every pose of
    /// the robot. Without a tool it coincides with the end-effector link.
    pub fn tcp(&self) -> usize {
        self.model.links.len()
    }

    /// Returns what measures the speed of its tool and its flange.
    pub fn tool_speed(&self) -> ToolSpeed {
        let flange = self.config.flange_link.as_ref().and_then(|link| self.model.link_index(link));
        let links = flange.into_iter().chain([self.tcp()]).collect();
        ToolSpeed::new((*self.body.kinematics).clone(), links)
    }

    /// Returns the pose of the tool centre point in the frame `map` at these positions of the planned joints [rad].
    pub fn tcp_pose(&self, positions: &[f64]) -> DAffine3 {
        let kinematics = &self.body.kinematics;
        let mut frames = kinematics.frames();
        kinematics.forward_from(&self.body.base, positions, &mut frames);
        kinematics.link_frame(self.tcp(), &frames)
    }

    /// Returns the pose of the base link in the frame `map`.
    pub fn base_pose(&self) -> DAffine3 {
        frame(&self.config.base_pose)
    }

    /// Replaces the tool.
    pub fn set_tool(&mut self, tool: Option<Isometry3<f64>>) {
        self.config.tool = tool;
        let (tcp, offset) = (self.tcp(), tool_frame(tool.as_ref()));
        Arc::make_mut(&mut self.body.kinematics).move_frame(tcp, self.end_effector, &offset);
    }

    /// Compiles the kinematics of the planned joints, with the tool centre point.
    pub(in crate::planning) fn compiled(
        &self,
        model: &RobotModel,
        rest: &[f64],
    ) -> Result<Kinematics, KinematicsError> {
        compiled(model, &self.joints, rest, self.end_effector, self.config.tool.as_ref())
    }

    /// Builds the robot's collision geometry with all joints fixed at these positions.
    pub fn fixed_at(&self, positions: &[f64]) -> Result<Robot, String> {
        let mut named: HashMap<String, f64> =
            self.model.joints.iter().zip(&self.rest).map(|(joint, q)| (joint.name.clone(), *q)).collect();
        named.extend(self.config.joints.iter().cloned().zip(positions.iter().copied()));
        let rest = self.model.positions(&named);
        let kinematics = Kinematics::new(&self.model, &[], &rest).map_err(|e| e.to_string())?;
        Ok(Robot { kinematics: Arc::new(kinematics), ..self.body.clone() })
    }
}

fn tool_frame(tool: Option<&Isometry3<f64>>) -> DAffine3 {
    tool.map_or(DAffine3::IDENTITY, frame)
}

/// Compiles a model for these joints, with the tool centre point as one more link.
pub(in crate::planning) fn compiled(
    model: &RobotModel,
    joints: &[usize],
    rest: &[f64],
    link: usize,
    tool: Option<&Isometry3<f64>>,
) -> Result<Kinematics, KinematicsError> {
    let mut kinematics = Kinematics::new(model, joints, rest)?;
    kinematics.attach_frame(link, &tool_frame(tool));
    Ok(kinematics)
}

fn joint(model: &RobotModel, name: &str) -> Result<usize, String> {
    let names = model.joints.iter().map(|joint| joint.name.as_str());
    let hint = || dimos_yaml::did_you_mean(name, names, "its joints").unwrap_or_default();
    model.joint_index(name).ok_or_else(|| format!("there is no joint {name:?}; {}", hint()))
}

/// Builds an obstacle from its description; reads its file if it has one.
pub fn obstacle(object: &ObjectConfig) -> Result<Obstacle, String> {
    let at = frame(&object.pose);
    let solid = match &object.shape {
        ObjectShape::Box(size) => Solid::cuboid(DVec3::from_array(*size), at),
        ObjectShape::Sphere(radius) => Solid::sphere(*radius, at),
        ObjectShape::Cylinder([radius, length]) => Solid::cylinder(*radius, *length, at),
        ObjectShape::Mesh(path) => {
            let mesh = Mesh::read(path, nalgebra::Vector3::repeat(1.0))?;
            Size::of_object(&mesh, path)?;
            surface(&mesh, at)
        }
        ObjectShape::Cloud(path) => {
            let about = std::fs::metadata(path).map_err(|e| format!("{}: {e}", path.display()))?;
            if !about.is_file() || about.len() > MAX_CLOUD {
                return Err(format!("{}: not a file of at most {} MiB", path.display(), MAX_CLOUD >> 20));
            }
            let data = std::fs::read(path).map_err(|e| format!("{}: {e}", path.display()))?;
            let points = ply::read(&data).map_err(|e| format!("{}: {e}", path.display()))?;
            let cloud = Cloud::new(points).ok_or_else(|| format!("{}: no points", path.display()))?;
            Solid::cloud(Arc::new(cloud), CLOUD_RADIUS, at)
        }
    };
    let solid = solid.map_err(|e| e.to_string())?;
    // Now, so that the first plan does not wait for it.
    solid.cover();
    Ok(Obstacle { name: object.name.clone(), solid, padding: object.padding })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::planning::scene::config::GripperJoint;
    use dimos_robot::kinematics::pose;

    const ON_A_SLIDE: &str = r#"<robot name="r"><link name="root"/><link name="base"/><link name="l"/>
<joint name="slide" type="prismatic"><parent link="root"/><child link="base"/><axis xyz="1 0 0"/>
<limit lower="0" upper="0.3" velocity="1" effort="1"/></joint>
<joint name="j" type="revolute"><parent link="base"/><child link="l"/><axis xyz="0 0 1"/>
<limit lower="-2" upper="2" velocity="1" effort="1"/></joint></robot>"#;

    #[test]
    fn the_base_link_is_at_its_pose_if_a_joint_before_it_is_not_at_zero() {
        let folder = tempfile::tempdir().unwrap();
        let model_path = folder.path().join("slide.urdf");
        std::fs::write(&model_path, ON_A_SLIDE).unwrap();
        let config = RobotConfig {
            model_path,
            base_pose: Isometry3::translation(1.0, 2.0, 3.0),
            base_link: "base".into(),
            end_effector_link: "l".into(),
            flange_link: None,
            joints: vec!["j".into()],
            coordinator_joints: vec!["arm_j".into()],
            gripper_joint: Some(GripperJoint { joint: "slide".into(), closed: 0.0, open: 0.2 }),
            ..RobotConfig::yourarm()
        };
        let robot = PlannedRobot::load(&config).unwrap();
        let kinematics = &robot.body.kinematics;
        let mut frames = kinematics.frames();
        kinematics.forward_from(&robot.body.base, &[0.0], &mut frames);
        let is_at = pose(&kinematics.link_frame(robot.model.link_index("base").unwrap(), &frames));
        assert!((is_at.translation.vector - config.base_pose.translation.vector).norm() < 1e-9, "{is_at}");
    }
}
