//! Requests that change the planner's world: add, move, remove, attach, detach. [`PlannerPort::objects`] has the
//! objects as given, the planner thread's world has their shapes; both change together, under the lock of the objects.

use std::collections::BTreeMap;
use std::path::PathBuf;

use glamx::DAffine3;
use nalgebra::{Isometry3, Matrix3, Vector3};

use super::PlannerPort;
use super::planner_port::{isometry, positions_of, robot_index, run_blocking, spec};
use crate::runtime::internal;
use crate::runtime::start::warn_of_fixed_contacts;
use dimos_core::sync::lock;
use dimos_planner::collision::pairs;
use dimos_planner::collision::shape::Placed;
use dimos_planner::collision::world::{Attached, Obstacle, World};
use dimos_planner::planning::scene::config::{MAX_OBJECTS, ObjectConfig, ObjectShape};
use dimos_planner::planning::scene::planning_scene::{PlannedRobot, fixed_contacts, obstacle};
use dimos_robot::kinematics::{frame, pose};
use dimos_rpc::api::{self, AttachReply, Done, LoadReport, Moment, ShapeSpec, WorldObject};
use dimos_rpc::{Code, RpcError};

/// The objects by name.
type Objects = BTreeMap<String, WorldObject>;

impl PlannerPort {
    pub(in crate::runtime) fn attach(&self, call: &api::Attach, moment: &Moment) -> Result<AttachReply, RpcError> {
        self.measured(moment);
        let setup = &*self.thread.now();
        let index = robot_index(setup, &call.robot)?;
        let robot = setup.robots.get(index).ok_or_else(internal)?;
        let objects = &mut *lock(&self.objects);
        let mut object = named(objects, &call.name)?;
        let link = call.link.clone().unwrap_or_else(|| robot.config.end_effector_link.clone());
        for link in &call.touch_links {
            link_index(robot, link)?;
        }
        let at = link_pose(robot, &link, moment)?.inverse() * isometry(&object.pose);
        let load = match call.mass {
            Some(mass) => Some(load_of(&object.shape, mass, &(in_flange(robot, &link, moment)? * at))),
            None => None,
        };
        call.within.map_or(Ok(()), |within| self.near_enough(robot, &call.name, within, moment))?;
        let mut touch_links = call.touch_links.clone();
        touch_links.extend(robot.moved_together_with(&link));
        let held = |world: &mut World| {
            let stood = world.remove(&call.name)?;
            let solid = stood.solid.clone().at(frame(&at));
            let taken = world.attach(Attached {
                name: call.name.clone(),
                robot: index,
                link: link.clone(),
                solids: vec![solid],
                touch_links: touch_links.clone(),
                padding: object.padding,
            });
            // An object that cannot be attached stays: no error removes an object from the world.
            if taken.is_err() {
                world.add(stood)?;
            }
            taken
        };
        self.thread.world(held).map_err(|e| wrong(e.to_string()))?;
        object.pose = spec(&at);
        object.held_by = Some([call.robot.clone(), link]);
        objects.insert(call.name.clone(), object);
        Ok(AttachReply { load, payload: None })
    }

    /// Fails if an object is farther than `within` [m] from the tool centre point of a robot.
    fn near_enough(&self, robot: &PlannedRobot, name: &str, within: f64, moment: &Moment) -> Result<(), RpcError> {
        let joints = positions_of(&robot.config.name, &robot.config.coordinator_joints, moment)?;
        let tcp = Placed::Point(robot.tcp_pose(&joints).translation);
        let distance = |world: &mut World| {
            let solid = &world.obstacles().iter().find(|obstacle| obstacle.name == name)?.solid;
            Some(pairs::distance(&tcp, &solid.place(&DAffine3::IDENTITY)) - solid.radius)
        };
        match self.thread.world(distance) {
            Some(distance) if distance > within => {
                let (arm, tcp) = (&robot.config.name, robot.config.tcp_name());
                let what = format!("{name} is {distance:.3} m from {tcp} of {arm}: it is not what the gripper holds");
                let hint = format!(
                    "put it where it is: `dimos world move {name} --at X Y Z`; or attach it from there: `dimos world \
                     attach {name} {arm} --within 1`"
                );
                Err(RpcError::new(Code::WrongObject, what).hint(hint))
            }
            _ => Ok(()),
        }
    }

    pub(in crate::runtime) fn detach(&self, name: &str, moment: &Moment) -> Result<Done, RpcError> {
        self.measured(moment);
        let setup = &*self.thread.now();
        let objects = &mut *lock(&self.objects);
        let mut object = known(objects, name)?;
        let Some([robot, link]) = object.held_by.take() else {
            return Err(RpcError::new(Code::WrongObject, format!("no arm holds {name}")));
        };
        let robot = setup.robots.get(robot_index(setup, &robot)?).ok_or_else(internal)?;
        let at = link_pose(robot, &link, moment)? * isometry(&object.pose);
        let let_go = |world: &mut World| {
            let held = world.detach(name)?;
            let solids = held.solids.into_iter();
            solids
                .map(|solid| solid.at(frame(&at)))
                .try_for_each(|solid| world.add(Obstacle { name: name.to_owned(), solid, padding: held.padding }))
        };
        self.thread.world(let_go).map_err(|e| wrong(e.to_string()))?;
        object.pose = spec(&at);
        objects.insert(name.to_owned(), object);
        Ok(Done {})
    }

    /// Adds an object to the world. Reads its file on another thread: it may be large.
    pub(in crate::runtime) async fn put(&self, object: WorldObject) -> Result<Done, RpcError> {
        not_held(&lock(&self.objects), &object.name)?;
        let config = configured(&object, isometry(&object.pose));
        let made = run_blocking(move || obstacle(&config)).await?.map_err(wrong)?;
        let objects = &mut *lock(&self.objects);
        // Another client may have attached it meanwhile.
        not_held(objects, &object.name)?;
        if objects.len() >= MAX_OBJECTS && !objects.contains_key(&object.name) {
            let error = RpcError::new(Code::TooLarge, format!("the world has {MAX_OBJECTS} objects already"));
            return Err(error.hint("remove some with `dimos world remove`, or describe several by one mesh"));
        }
        let put = |world: &mut World| world.put(made).map(|()| fixed_contacts(world));
        let mut touching = self.thread.world(put).map_err(|e| wrong(e.to_string()))?;
        touching.retain(|pair| pair.contains(&object.name));
        warn_of_fixed_contacts(&touching);
        objects.insert(object.name.clone(), object);
        Ok(Done {})
    }

    pub(in crate::runtime) fn move_to(&self, call: &api::WorldMove) -> Result<Done, RpcError> {
        let objects = &mut *lock(&self.objects);
        let mut object = named(objects, &call.name)?;
        let at = frame(&isometry(&call.pose));
        self.thread.world(|world| world.move_to(&call.name, at)).map_err(|e| wrong(e.to_string()))?;
        object.pose = call.pose;
        objects.insert(call.name.clone(), object);
        Ok(Done {})
    }

    pub(in crate::runtime) fn remove(&self, name: Option<&str>) -> Result<Done, RpcError> {
        let objects = &mut *lock(&self.objects);
        let mut gone: Vec<String> = Vec::new();
        match name {
            Some(name) => gone.push(named(objects, name)?.name),
            None => gone.extend(objects.values().filter(|o| o.held_by.is_none()).map(|o| o.name.clone())),
        }
        for name in gone {
            self.thread.world(|world| world.remove(&name)).map_err(|e| wrong(e.to_string()))?;
            objects.remove(&name);
        }
        Ok(Done {})
    }
}

/// Returns the present pose of a robot's link in the frame `map`.
pub(in crate::runtime) fn link_pose(
    robot: &PlannedRobot,
    link: &str,
    moment: &Moment,
) -> Result<Isometry3<f64>, RpcError> {
    let index = link_index(robot, link)?;
    let kinematics = &robot.body.kinematics;
    let mut frames = kinematics.frames();
    let joints = positions_of(&robot.config.name, &robot.config.coordinator_joints, moment)?;
    kinematics.forward_from(&robot.body.base, &joints, &mut frames);
    Ok(pose(&kinematics.link_frame(index, &frames)))
}

/// Returns the present pose of a robot's link in the frame of its flange.
fn in_flange(robot: &PlannedRobot, link: &str, moment: &Moment) -> Result<Isometry3<f64>, RpcError> {
    let Some(flange) = &robot.config.flange_link else {
        let what = format!("{} has no `flange_link`: a load is measured from the arm's flange", robot.config.name);
        return Err(wrong(what).hint("name the flange's link in `planner.robots`, such as `flange_link: tool0`"));
    };
    Ok(link_pose(robot, flange, moment)?.inverse() * link_pose(robot, link, moment)?)
}

/// Returns a solid body of this shape and mass [kg] as a load; a mesh or a cloud is a point mass at its origin. `at`:
/// its pose in the flange frame.
fn load_of(shape: &ShapeSpec, mass: f64, at: &Isometry3<f64>) -> LoadReport {
    let principal = match shape {
        ShapeSpec::Box([x, y, z]) => [y * y + z * z, x * x + z * z, x * x + y * y].map(|v| v / 12.0),
        ShapeSpec::Sphere(r) => [0.4 * r * r; 3],
        ShapeSpec::Cylinder([r, length]) => {
            let across = (3.0 * r * r + length * length) / 12.0;
            [across, across, 0.5 * r * r]
        }
        ShapeSpec::Mesh(_) | ShapeSpec::Cloud(_) => [0.0; 3],
    };
    let rotation = at.rotation.to_rotation_matrix();
    let inertia = rotation * Matrix3::from_diagonal(&(mass * Vector3::from(principal))) * rotation.inverse();
    let [xx, xy, xz, yy, yz, zz] = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)].map(|at| inertia[at]);
    LoadReport { mass, center: at.translation.vector.into(), inertia: [xx, xy, xz, yy, yz, zz] }
}

fn wrong(what: impl Into<String>) -> RpcError {
    RpcError::new(Code::InvalidParams, what)
}

fn link_index(robot: &PlannedRobot, link: &str) -> Result<usize, RpcError> {
    let names: Vec<&str> = robot.model.links.iter().map(|link| link.name.as_str()).collect();
    let unknown = || RpcError::unknown(Code::InvalidParams, "link", link, &names);
    robot.model.link_index(link).ok_or_else(unknown)
}

/// Returns an object that no robot holds.
fn named(objects: &Objects, name: &str) -> Result<WorldObject, RpcError> {
    not_held(objects, name)?;
    known(objects, name)
}

fn known(objects: &Objects, name: &str) -> Result<WorldObject, RpcError> {
    let unknown = || {
        let names: Vec<&String> = objects.keys().collect();
        RpcError::unknown(Code::UnknownObject, "object", name, &names)
    };
    objects.get(name).cloned().ok_or_else(unknown)
}

fn not_held(objects: &Objects, name: &str) -> Result<(), RpcError> {
    match objects.get(name).and_then(|object| object.held_by.as_ref()) {
        Some([robot, _]) => Err(RpcError::new(Code::WrongObject, format!("{robot} holds {name}"))
            .hint(format!("`dimos world detach {name}` lets go of it"))),
        None => Ok(()),
    }
}

fn configured(object: &WorldObject, pose: Isometry3<f64>) -> ObjectConfig {
    let shape = match &object.shape {
        ShapeSpec::Box(size) => ObjectShape::Box(*size),
        ShapeSpec::Sphere(radius) => ObjectShape::Sphere(*radius),
        ShapeSpec::Cylinder(size) => ObjectShape::Cylinder(*size),
        ShapeSpec::Mesh(path) => ObjectShape::Mesh(PathBuf::from(path)),
        ShapeSpec::Cloud(path) => ObjectShape::Cloud(PathBuf::from(path)),
    };
    ObjectConfig { name: object.name.clone(), shape, pose, padding: object.padding }
}

/// Converts an object of the blueprint to its rpc type.
pub(crate) fn typed(object: &ObjectConfig) -> WorldObject {
    let shape = match &object.shape {
        ObjectShape::Box(size) => ShapeSpec::Box(*size),
        ObjectShape::Sphere(radius) => ShapeSpec::Sphere(*radius),
        ObjectShape::Cylinder(size) => ShapeSpec::Cylinder(*size),
        ObjectShape::Mesh(path) => ShapeSpec::Mesh(path.display().to_string()),
        ObjectShape::Cloud(path) => ShapeSpec::Cloud(path.display().to_string()),
    };
    let pose = spec(&object.pose);
    WorldObject { name: object.name.clone(), shape, pose, padding: object.padding, held_by: None }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use dimos_planner::planning::scene::config::{PlannerConfig, RobotConfig};
    use dimos_planner::planning::scene::planning_scene::PlanningScene;

    /// A planner with the built-in robot and a ball in its world, and its present state.
    fn with_a_ball(at: [f64; 3]) -> (PlannerPort, Moment) {
        with_robot(RobotConfig::yourarm(), at)
    }

    fn with_robot(robot: RobotConfig, at: [f64; 3]) -> (PlannerPort, Moment) {
        let ball = ObjectConfig {
            name: "ball".into(),
            shape: ObjectShape::Sphere(0.02),
            pose: Isometry3::translation(at[0], at[1], at[2]),
            padding: 0.0,
        };
        let (robots, timeout) = (vec![robot], Duration::from_secs(1));
        let config = PlannerConfig { timeout, padding: 0.0, robots, objects: vec![ball], proofs: None };
        let setup = PlanningScene::load(&config).unwrap();
        let joints = setup.robots[0].config.coordinator_joints.iter();
        let moment = Moment {
            plan: 1,
            positions: joints.map(|j| (j.clone(), 0.0)).collect(),
            grippers: BTreeMap::new(),
            ..Moment::default()
        };
        (PlannerPort::start(&config, setup, &BTreeMap::new(), None).unwrap(), moment)
    }

    /// Where a pose that is given relative to the end-effector link is in `map` [m].
    fn in_map(port: &PlannerPort, moment: &Moment, held: &Isometry3<f64>) -> [f64; 3] {
        let robot = &port.thread.setup().robots[0];
        let at = link_pose(robot, &robot.config.end_effector_link, moment).unwrap() * held;
        at.translation.vector.into()
    }

    #[test]
    fn a_load_is_measured_from_the_flange_whatever_the_link_of_pose_goals() {
        let robot = RobotConfig {
            model_path: "builtin:xarm6_gripper".into(),
            base_link: "link_base".into(),
            end_effector_link: "link_tcp".into(),
            flange_link: Some("link_eef".into()),
            ..RobotConfig::yourarm()
        };
        let (port, moment) = with_robot(robot.clone(), [9.0, 0.0, 0.0]);
        let at_tool = link_pose(&port.thread.setup().robots[0], "link_tcp", &moment).unwrap();
        port.move_to(&api::WorldMove { name: "ball".into(), pose: spec(&at_tool) }).unwrap();
        let attach = |name: &str| api::Attach {
            name: name.into(),
            robot: "arm".into(),
            link: None,
            touch_links: Vec::new(),
            mass: Some(2.0),
            within: None,
        };
        let load = port.attach(&attach("ball"), &moment).unwrap().load.unwrap();
        assert!((load.center[2] - 0.172).abs() < 1e-9, "{:?}: its fingers are 172 mm in front of it", load.center);
        // The fingers may touch what they hold, the forearm may not.
        let touching = port.thread.world(|world| world.held()[0].touch_links.clone());
        let may_touch = |link: &str| touching.iter().any(|touching| touching == link);
        assert!(may_touch("left_finger") && may_touch("right_finger") && may_touch("link6"), "{touching:?}");
        assert!(!may_touch("link5") && !may_touch("link_base"), "{touching:?}");

        let (port, moment) = with_robot(RobotConfig { flange_link: None, ..robot }, [0.9, 0.0, 0.0]);
        let refused = port.attach(&attach("ball"), &moment).unwrap_err();
        assert!(refused.message.contains("no `flange_link`"), "{refused}");
        assert!(lock(&port.objects)["ball"].held_by.is_none(), "it was not attached");
    }

    #[test]
    fn an_object_that_is_moved_and_attached_in_parallel_is_held_where_it_is() {
        let (before, after) = ([0.5, 0.0, 0.2], [0.5, 0.3, 0.4]);
        let (port, moment) = with_a_ball(before);
        let to =
            api::WorldMove { name: "ball".into(), pose: spec(&Isometry3::translation(after[0], after[1], after[2])) };
        let attach = api::Attach { name: "ball".into(), robot: "arm".into(), ..api::Attach::default() };
        let moved = std::thread::scope(|scope| {
            // Both requests wait for the world, the move first.
            let moved = port.thread.world(|_| {
                let moved = scope.spawn(|| port.move_to(&to).is_ok());
                std::thread::sleep(Duration::from_millis(100));
                scope.spawn(|| port.attach(&attach, &moment).unwrap());
                std::thread::sleep(Duration::from_millis(100));
                moved
            });
            moved.join().unwrap()
        });
        // On a stalled computer the object may be attached first; then the move is refused.
        let expected = if moved { after } else { before };
        let object = lock(&port.objects)["ball"].clone();
        assert!(object.held_by.is_some(), "{object:?}");
        let in_world = port.thread.world(|world| pose(&world.held()[0].solids[0].frame));
        for held in [in_world, isometry(&object.pose)] {
            let at = in_map(&port, &moment, &held);
            assert!(at.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-9), "{at:?}, not {expected:?}");
        }
    }
}
