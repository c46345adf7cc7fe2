//! What a log has for 3D viewers besides motion: the robots with their meshes, and the objects of the world.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::runtime::Service;
use crate::runtime::plan::planner_port::isometry;
use dimos_core::bounded;
use dimos_core::clock::{Clock, MonotonicClock};
use dimos_core::sync::lock;
use dimos_log::display_messages::{ColorRGBA, Marker, MarkerArray};
use dimos_log::log_writer::LogAttachment;
use dimos_log::messages::{Point, Pose, Quaternion, Vector3};
use dimos_log::recorder::Note;
use dimos_log::robots::{LoggedGripper, LoggedRobot, LoggedRobots};
use dimos_planner::planning::scene::planning_scene::PlannedRobot;
use dimos_robot::kinematics::pose;
use dimos_robot::load;
use dimos_robot::model::{Geometry, RobotModel};
use dimos_rpc::api::{ShapeSpec, WorldObject};

/// Maximum size of all meshes that are attached to a log [bytes].
const MAX_MESHES: usize = 8 << 20;

/// The objects of the world that were logged last: the change count of the world, and the objects.
pub(in crate::runtime) type LoggedWorld = Option<(u64, BTreeMap<String, WorldObject>)>;

/// The robots of a run, with the names of its joints.
pub(in crate::runtime) struct Described {
    pub robots: Arc<LoggedRobots>,
    /// All of them in one URDF; `None` without a model.
    pub urdf: Option<String>,
}

impl Service {
    /// Logs the robots, before the first tick. Returns files to attach: their description and meshes.
    pub(in crate::runtime) fn log_robots(&self) -> Vec<LogAttachment> {
        let Described { robots, urdf: Some(description) } = self.described() else { return Vec::new() };
        let urdf = LogAttachment {
            name: "robot_description.urdf".to_owned(),
            media_type: "application/xml".to_owned(),
            data: description.clone().into_bytes(),
        };
        let meshes = meshes(&robots.combined());
        let (robots, description) = (robots.clone(), description.clone());
        self.tick.dispatcher().note(Note::Robots { stamp: MonotonicClock.now(), robots, description });
        std::iter::once(urdf).chain(meshes).collect()
    }

    /// Returns the robots of the run. They are named and described once, when they are first needed.
    pub(in crate::runtime) fn described(&self) -> &Described {
        self.journal.described.get_or_init(|| {
            let robots = Arc::new(LoggedRobots::new(self.modelled()));
            let urdf = match urdf_rs::write_to_string(&urdf_rs::Robot::from(&robots.combined())) {
                Ok(urdf) => Some(urdf).filter(|_| !robots.is_empty()),
                Err(e) => {
                    tracing::warn!("the robots have no description: {e}");
                    None
                }
            };
            Described { robots, urdf }
        })
    }

    /// Returns the robots of the planner in this process; without one, those of tasks that have a model.
    fn modelled(&self) -> Vec<LoggedRobot> {
        if let Some(port) = self.plans.port() {
            return port.setup().robots.iter().filter_map(|robot| self.planned(robot)).collect();
        }
        let tasks = self.facts.config.tasks.iter().zip(&self.facts.blueprint.tasks);
        let modelled = tasks.filter_map(|(config, task)| {
            let (kinematics, robot) = (config.kind.robot.as_ref()?, task.robot.as_ref()?);
            // The blueprint was checked with it: it is known to be readable.
            let mut model = load(&robot.source).model?;
            let fixed = robot.fixed.iter().map(|(name, position)| (name.clone(), *position)).collect();
            let rest = model.positions(&fixed);
            model.fix({ robot.fixed.keys() }.filter_map(|name| model.joint_index(name)).collect::<Vec<_>>(), &rest);
            let names = config.joints.iter().map(|joint| self.facts.names.joint(*joint));
            let joints = robot.joints.iter().zip(&config.joints).zip(names);
            let joints = joints.map(|((own, index), name)| Some((model.joint_index(own)?, usize::from(*index), name)));
            Some(LoggedRobot {
                name: self.arm_of(usize::from(*config.joints.first()?))?.1,
                joints: joints.collect::<Option<_>>()?,
                root: pose(&kinematics.root.frame()),
                moved_by_others: Vec::new(),
                rest,
                gripper: None,
                end_effector: model.link_index(&robot.link)?,
                model,
            })
        });
        modelled.collect()
    }

    fn planned(&self, robot: &PlannedRobot) -> Option<LoggedRobot> {
        let all: Vec<&String> = self.facts.names.arms.iter().flat_map(|arm| &arm.joints).collect();
        let in_run =
            |(index, name): (usize, &str)| Some((index, all.iter().position(|own| *own == name)?, name.to_owned()));
        let own = robot.joints.iter().copied().zip(robot.config.coordinator_joints.iter().map(String::as_str));
        let joints: Vec<_> = own.map(in_run).collect::<Option<_>>()?;
        let others = robot.moved_by_others();
        let others = others.map(|(model, name)| in_run((robot.model.joint_index(model)?, name)));
        let moved_by_others = others.collect::<Option<_>>()?;
        let gripper = robot.config.gripper_joint.as_ref().and_then(|driven| {
            let (arm, _) = self.arm_of(joints.first()?.1)?;
            let range = self.facts.gripper_info(arm)?.range?;
            let joint = robot.model.joint_index(&driven.joint)?;
            Some(LoggedGripper { arm, joint, range: [range, (driven.closed, driven.open)] })
        });
        Some(LoggedRobot {
            name: robot.config.name.clone(),
            model: robot.model_with_fixed(),
            moved_by_others,
            root: pose(&robot.body.base),
            rest: robot.rest.clone(),
            end_effector: robot.end_effector,
            joints,
            gripper,
        })
    }

    /// Returns the arm that has a joint: its index and name.
    fn arm_of(&self, joint: usize) -> Option<(usize, String)> {
        let mut joints = 0;
        self.facts.names.arms.iter().enumerate().find_map(|(index, arm)| {
            joints += arm.joints.len();
            (joint < joints).then(|| (index, arm.hardware_id.clone()))
        })
    }

    /// Logs the objects of the world that have changed.
    pub(in crate::runtime) fn log_world(&self) {
        let Some(port) = self.plans.port() else { return };
        let mut logged = lock(&self.journal.world);
        let known = logged.as_ref().map(|(version, _)| *version);
        let Some((version, objects)) = port.objects_unless(known) else { return };
        let before = logged.replace((version, objects.clone())).map(|(_, objects)| objects).unwrap_or_default();
        let gone = before.keys().filter(|name| !objects.contains_key(*name));
        let gone = gone.map(|name| Marker { ns: namespace(name), action: 2, ..Marker::default() });
        let changed = objects.values().filter(|object| before.get(&object.name) != Some(object));
        let robots = self.described().robots.clone();
        let markers: Vec<Marker> = gone.chain(changed.map(|object| marker(object, &robots))).collect();
        if !markers.is_empty() {
            let markers = MarkerArray { markers };
            self.tick.dispatcher().note(Note::Markers { stamp: MonotonicClock.now(), markers });
        }
    }
}

fn namespace(object: &str) -> String {
    format!("world/{object}")
}

/// Returns the marker of an object.
fn marker(object: &WorldObject, robots: &LoggedRobots) -> Marker {
    let at = isometry(&object.pose);
    let ([x, y, z], turn) = (at.translation.vector.into(), at.rotation.coords);
    let mut marker = Marker {
        ns: namespace(&object.name),
        pose: Pose {
            position: Point { x, y, z },
            orientation: Quaternion { x: turn.x, y: turn.y, z: turn.z, w: turn.w },
        },
        color: ColorRGBA { r: 0.6, g: 0.6, b: 0.65, a: 0.8 },
        ..Marker::default()
    };
    marker.header.frame_id = "map".to_owned();
    if let Some([robot, link]) = &object.held_by {
        marker.header.frame_id = robots.frame(robot, link).unwrap_or_else(|| link.clone());
        marker.frame_locked = true;
        marker.color = ColorRGBA { r: 0.9, g: 0.6, b: 0.2, a: 0.8 };
    }
    let (kind, [x, y, z]) = match &object.shape {
        ShapeSpec::Box(size) => (1, *size),
        ShapeSpec::Sphere(radius) => (2, [2.0 * radius; 3]),
        ShapeSpec::Cylinder([radius, length]) => (3, [2.0 * radius, 2.0 * radius, *length]),
        ShapeSpec::Mesh(path) => {
            marker.mesh_resource = format!("file://{path}");
            (10, [1.0; 3])
        }
        // Its points may be hundreds of megabytes: only its name is shown.
        ShapeSpec::Cloud(_) => {
            marker.text.clone_from(&object.name);
            (9, [0.05; 3])
        }
    };
    (marker.r#type, marker.scale) = (kind, Vector3 { x, y, z });
    marker
}

/// Returns the visual meshes of all robots, named by their URLs, up to [`MAX_MESHES`].
fn meshes(all: &RobotModel) -> Vec<LogAttachment> {
    let mut files = BTreeMap::new();
    for shape in all.links.iter().flat_map(|link| &link.visuals) {
        if let Geometry::Mesh(mesh) = &shape.geometry {
            files.insert(&mesh.uri, mesh.path.as_deref());
        }
    }
    let (mut room, mut left_out, mut attached) = (MAX_MESHES, 0, Vec::new());
    for (uri, path) in files {
        let Some(data) = path.and_then(|path| bounded::read(path, room as u64).ok()) else {
            left_out += 1;
            continue;
        };
        room -= data.len();
        let kind = uri.rsplit('.').next().unwrap_or_default().to_ascii_lowercase();
        attached.push(LogAttachment { name: uri.clone(), media_type: format!("model/{kind}"), data });
    }
    if left_out > 0 {
        tracing::info!("{left_out} meshes are not attached to the log: not found, or beyond {} MiB", MAX_MESHES >> 20);
    }
    attached
}
