//! A robot model or a blueprint in the live view: its joints are where the page puts them. Nothing is connected.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Mutex;

use nalgebra::Isometry3;
use serde_json::{Value, json};

use super::super::check::{self, robots::commanded};
use super::super::exit::{Failure, Result};
use super::super::model::chain::end_of_arm;
use super::super::model::{self, With};
use super::super::output;
use crate::blueprint::{Blueprint, Catalog, Overrides, Summary};
use crate::runtime::tool::kinematics::use_kept;
use crate::runtime::world_object;
use crate::view::{Scene, Shown, ShownArm, ShownRobot, Subject, robots, value};
use dimos_core::joint::JointLimits;
use dimos_core::pose::to_xyz_rpy;
use dimos_core::sync::lock;
use dimos_planner::collision::{CheckSettings, ExactChecker};
use dimos_planner::planning::scene::config::{ObjectConfig, PlannerConfig, RobotConfig};
use dimos_planner::planning::scene::ignored_pairs::IgnoredPair;
use dimos_planner::planning::scene::planning_scene::PlanningScene;
use dimos_robot::kinematics::pose;
use dimos_robot::urdf::Meshes;
use dimos_robot::{Source, load};
use dimos_rpc::api::WorldObject;

/// Pairs closer than this are shown [m].
const CLOSE: f64 = 0.05;

/// A robot model or a blueprint.
pub struct Posed {
    kind: &'static str,
    shown: Shown,
    objects: Vec<ObjectConfig>,
    /// The robots with a checker of their collisions, or why there is none.
    setup: std::result::Result<(PlanningScene, Mutex<ExactChecker>), String>,
}

impl Posed {
    /// Reads a robot model.
    pub fn model(file: &Path, with: &With) -> Result<Self> {
        let source = with.source(file, Meshes::Mark);
        let (robot, loaded) = model::robot(load(&source), file)?;
        let independent = || robot.independent_joints().into_iter().filter_map(|index| robot.joints.get(index));
        let names = || independent().map(|joint| joint.name.clone());
        let tip = robot.links.get(end_of_arm(&robot)).map_or("", |link| &link.name).to_owned();
        // A pose of a group leaves the other joints where they are closest to zero.
        let rest = |joint: &dimos_robot::Joint| 0.0_f64.max(joint.limits.lower).min(joint.limits.upper);
        let poses = loaded.semantics.poses.iter().map(|pose| {
            let own = |name: &str| pose.positions.iter().find(|(joint, _)| joint == name).map(|(_, q)| *q);
            let all = independent().map(|joint| own(&joint.name).unwrap_or_else(|| rest(joint)));
            (pose.name.clone(), all.collect())
        });
        let shown = ShownRobot {
            name: robot.name.clone(),
            base_link: None,
            base_pose: Isometry3::identity(),
            tip,
            joints: names().zip(names()).collect(),
            moved_by_others: Vec::new(),
            fixed: Vec::new(),
            poses: poses.collect(),
            gripper: None,
            source,
        };
        let config = PlannerConfig { robots: vec![alone(&shown, String::new())?], ..PlannerConfig::default() };
        let arm = (robot.name.clone(), names().collect());
        let setup = PlanningScene::load(&config);
        if let Err(why) = &setup {
            output::note(format_args!("warning: collisions are not checked: {why}"));
        }
        Ok(Self::new("model", robot.name.clone(), vec![shown], vec![arm], Vec::new(), setup))
    }

    /// Reads a blueprint.
    pub fn blueprint(name: &str, catalog: Catalog<'_>) -> Result<Self> {
        let loaded = check::load_to_run(name, &Overrides::default(), catalog)?;
        let Some(blueprint) = &loaded.blueprint else { return Err(check::mistakes(&loaded)) };
        check::print_warnings(&loaded);
        let mut blueprint = blueprint.clone();
        use_kept(&mut blueprint).iter().for_each(|line| output::note(format_args!("model: {line}")));
        let blueprint = &blueprint;
        let shown = robots(blueprint);
        if shown.is_empty() {
            let what = format!("the blueprint {} has no robot model: there is nothing to show", blueprint.name);
            return Err(Failure::usage(what).hint("a planner's robots, and tasks that move an end effector, have one"));
        }
        let config = planned(blueprint, &shown)?;
        let setup = PlanningScene::load(&config).and_then(|setup| setup.within(&commanded(&Summary::of(blueprint))));
        let setup = setup.map_err(Failure::usage)?;
        let arms = blueprint.arms.iter().map(|arm| (arm.hardware_id.clone(), arm.joints.clone())).collect();
        Ok(Self::new("blueprint", blueprint.name.clone(), shown, arms, config.objects, Ok(setup)))
    }

    fn new(
        kind: &'static str,
        name: String,
        robots: Vec<ShownRobot>,
        arms: Vec<(String, Vec<String>)>,
        objects: Vec<ObjectConfig>,
        setup: std::result::Result<PlanningScene, String>,
    ) -> Self {
        let limits = |joints: &[String]| {
            let mut limits = JointLimits::default();
            let of = |joint: &String| {
                let robots = setup.iter().flat_map(|setup| &setup.robots);
                let mut all = robots.flat_map(|robot| robot.config.coordinator_joints.iter().zip(&robot.limits));
                all.find(|(own, _)| *own == joint).map(|(_, limits)| *limits)
            };
            for own in joints.iter().map(of) {
                let pick = |value: Option<f64>| value.unwrap_or(f64::INFINITY);
                limits.position_lower.push(pick(own.map(|own| own.lower)));
                limits.position_upper.push(pick(own.map(|own| own.upper)));
                limits.velocity_max.push(pick(own.map(|own| own.velocity)));
                limits.acceleration_max.push(pick(own.and_then(|own| own.acceleration)));
            }
            limits
        };
        let arm = |(name, joints): (String, Vec<String>)| ShownArm {
            limits: limits(&joints),
            adapter: String::new(),
            address: String::new(),
            simulated: true,
            gripper: None,
            name,
            joints,
        };
        let arms = arms.into_iter().map(arm).collect();
        let shown = Shown { name, simulated: true, planner: false, robots, arms };
        let checked = setup.map(|setup| {
            let checker = ExactChecker::new(setup.world.snapshot(), CheckSettings::default()).with_margin(CLOSE);
            (setup, Mutex::new(checker))
        });
        Self { kind, shown, objects, setup: checked }
    }

    /// Returns what is close at joint positions, and where the tool centre points are, as JSON.
    fn pose(&self, query: &str) -> std::result::Result<String, String> {
        let (setup, checker) = self.setup.as_ref().map_err(Clone::clone)?;
        let number = |text: &str| text.parse::<f64>().ok().filter(|q| q.is_finite());
        let q: Option<Vec<f64>> = value(query, "q").unwrap_or_default().split(',').map(number).collect();
        let dof: usize = setup.robots.iter().map(|robot| robot.joints.len()).sum();
        let q =
            q.filter(|q| q.len() == dof).ok_or_else(|| format!("q must be {dof} positions, separated by commas"))?;
        let mut close = lock(checker).closer_than_padding(&q);
        close.sort_by(|(_, a), (_, b)| a.distance.total_cmp(&b.distance));
        let pairs = close
            .iter()
            .map(|(_, contact)| json!({"links": [contact.link, contact.other], "distance": contact.distance}));
        let mut rest = q.as_slice();
        let tcp = setup.robots.iter().zip(&self.shown.robots).map(|(robot, shown)| {
            let (own, others) = rest.split_at(robot.joints.len().min(rest.len()));
            rest = others;
            let at = pose(&robot.tcp_pose(own));
            let ((xyz, rpy), quat) = (to_xyz_rpy(&at), at.rotation.coords);
            let quat = [quat.x, quat.y, quat.z, quat.w];
            json!({"robot": shown.name, "link": robot.config.tcp_name(), "xyz": xyz, "rpy": rpy, "quat": quat})
        });
        let tcp: Vec<Value> = tcp.collect();
        Ok(json!({"pairs": pairs.collect::<Vec<_>>(), "tcp": tcp}).to_string())
    }

    /// Returns the pairs of links that are never checked, each with the reason.
    fn ignored(&self) -> Vec<[String; 3]> {
        let Ok((setup, _)) = &self.setup else { return Vec::new() };
        let robots: Vec<usize> = (0..setup.robots.len()).collect();
        let pairs = setup.ignored_pairs(&setup.world, &robots).into_iter();
        pairs.map(|IgnoredPair { links: [a, b], reason }| [a, b, reason]).collect()
    }
}

impl Subject for Posed {
    fn scene(&self) -> Scene {
        let objects: Vec<WorldObject> = self.objects.iter().map(world_object).collect();
        let scene = Scene::read(&self.shown, self.kind).with("objects", &json!(objects));
        let unchecked = self.setup.as_ref().err();
        scene.with("ignored", &json!(self.ignored())).with("unchecked", &json!(unchecked))
    }

    fn object(&self, name: &str) -> Option<WorldObject> {
        self.objects.iter().find(|object| object.name == name).map(world_object)
    }

    fn answer(&self, path: &str, query: &str) -> Option<std::result::Result<String, String>> {
        (path == "pose").then(|| self.pose(query))
    }
}

/// Returns the planner of a blueprint; without one, the robots of its tasks, as a planner would read them.
fn planned(blueprint: &Blueprint, shown: &[ShownRobot]) -> Result<PlannerConfig> {
    let mut planner = blueprint.planner.clone().unwrap_or_default();
    for robot in shown.get(planner.robots.len()..).unwrap_or_default() {
        planner.robots.push(alone(robot, robot.name.clone())?);
    }
    Ok(planner)
}

/// Returns a robot that no planner has, with its own limits.
fn alone(robot: &ShownRobot, name: String) -> Result<RobotConfig> {
    let Source { path, packages, xacro_args, srdf, joint_limits, places, .. } = robot.source.clone();
    let loaded = load(&Source { meshes: Meshes::Ignore, ..robot.source.clone() });
    let model = loaded.into_model().map_err(Failure::usage)?;
    let (coordinator_joints, joints) = robot.joints.iter().cloned().unzip();
    Ok(RobotConfig {
        name,
        model_path: path,
        packages,
        xacro_args,
        srdf,
        joint_limits,
        places,
        shapes: BTreeMap::new(),
        convert_meshes: true,
        base_pose: robot.base_pose,
        base_link: model.links.first().map(|link| link.name.clone()).unwrap_or_default(),
        end_effector_link: robot.tip.clone(),
        tool: None,
        flange_link: None,
        controller_base: None,
        allows_mismatch: false,
        joints,
        coordinator_joints,
        unplanned: BTreeMap::new(),
        gripper_joint: None,
        task: None,
        exclusions: Vec::new(),
        max_velocity: f64::INFINITY,
        max_acceleration: f64::INFINITY,
        max_jerk: None,
        named_poses: BTreeMap::new(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn json(text: &str) -> Value {
        serde_json::from_str(text).unwrap()
    }

    #[test]
    fn a_model_reports_what_touches_and_its_tool_centre_point() {
        let posed = Posed::model(Path::new("builtin:yourarm"), &With::default()).unwrap();
        let free = json(&posed.pose("q=0,-0.3,0.6,0,0.8,0").unwrap());
        assert!(
            free["pairs"].as_array().unwrap().iter().all(|pair| pair["distance"].as_f64().unwrap() > 0.0),
            "{free}"
        );
        let robot = load(&Source::new("builtin:yourarm")).into_model().unwrap();
        let at = |q: [f64; 6]| {
            let named = robot.joints.iter().filter(|j| j.is_independent()).map(|j| j.name.clone()).zip(q).collect();
            robot.link_poses(&robot.positions(&named))[robot.link_index("flange").unwrap()].translation.vector
        };
        let xyz: [f64; 3] = serde_json::from_value(free["tcp"][0]["xyz"].clone()).unwrap();
        assert!((nalgebra::Vector3::from(xyz) - at([0.0, -0.3, 0.6, 0.0, 0.8, 0.0])).norm() < 1e-9);
        let folded = json(&posed.pose("q=0,0,2.6,0,1.9,0").unwrap());
        assert!(folded["pairs"][0]["distance"].as_f64().unwrap() < 0.0, "{folded}");
        for wrong in ["", "q=", "q=0", "q=0,0,0,0,0,nan", "q=0,0,0,0,0,0,0"] {
            assert!(posed.pose(wrong).unwrap_err().contains("6 positions"), "{wrong}");
        }
        let scene = json(&posed.scene().json);
        assert_eq!((&scene["kind"], &scene["unchecked"]), (&json!("model"), &Value::Null));
        let limit = &scene["robots"][0]["limits"]["joint1"];
        assert!(limit["lower"].as_f64().unwrap() < 0.0 && limit["velocity"].is_number(), "{limit}");
        let ignored = scene["ignored"].as_array().unwrap();
        assert!(ignored.iter().any(|pair| pair[2] == "neighbours"), "{ignored:?}");
    }

    #[test]
    fn a_blueprint_has_its_obstacles_and_poses_and_all_robots_are_checked() {
        let catalog = dimos_arms::registry().with(&[]);
        let posed = Posed::blueprint("yourarm-planner", Catalog::from(&catalog)).unwrap();
        let scene = json(&posed.scene().json);
        assert_eq!((&scene["kind"], &scene["name"]), (&json!("blueprint"), &json!("yourarm-planner")));
        assert!(scene["robots"][0]["groups"]["home"].is_array() && scene["objects"].is_array(), "{scene}");
        let joints = scene["robots"][0]["joints"].as_object().unwrap().len();
        let pose = json(&posed.pose(&format!("q={}", vec!["0"; joints].join(","))).unwrap());
        assert_eq!(pose["tcp"].as_array().unwrap().len(), 1);
        let first = scene["objects"][0]["name"].as_str();
        assert_eq!(first.and_then(|name| posed.object(name)).map(|object| object.name).as_deref(), first);
        let task = Posed::blueprint("coordinator-yourarm", Catalog::from(&catalog)).unwrap();
        assert!(task.pose("q=0,0,0,0,0,0").is_ok() && task.scene().json.contains("\"tip\":\"flange\""));
    }
}
