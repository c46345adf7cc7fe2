//! Requests that change the planner's world: add, move, remove, attach, detach. [`PlannerPort::objects`] has the
//! objects as given, the planner thread's world has their shapes; both change together.

use std::path::PathBuf;

use nalgebra::Isometry3;

use super::planner_port::{PlannerPort, isometry, positions_of, robot_index, run_blocking, spec};
use super::service::internal;
use crate::collision::Solid;
use crate::collision::world::{Attached, Obstacle, World};
use crate::planning::config::{ObjectConfig, ObjectShape};
use crate::planning::planning_scene::{PlannedRobot, obstacle};
use crate::robot::kinematics::{frame, pose};
use crate::rpc::api::{self, Done, Moment, ShapeSpec, WorldObject};
use crate::rpc::{Code, RpcError};
use crate::sync::lock;

impl PlannerPort {
    pub(super) fn attach(&self, call: &api::Attach, moment: &Moment) -> Result<Done, RpcError> {
        self.measured(moment);
        let setup = &*self.thread.now();
        let index = robot_index(setup, &call.robot)?;
        let robot = setup.robots.get(index).ok_or_else(internal)?;
        let mut object = named(self, &call.name)?;
        let link = call.link.clone().unwrap_or_else(|| robot.config.end_effector_link.clone());
        for link in &call.touch_links {
            link_index(robot, link)?;
        }
        let at = link_pose(robot, &link, moment)?.inverse() * isometry(&object.pose);
        let held = |world: &mut World| {
            let stood = world.remove(&call.name)?;
            let solid = Solid { frame: frame(&at), ..stood.solid.clone() };
            let taken = world.attach(Attached {
                name: call.name.clone(),
                robot: index,
                link: link.clone(),
                solids: vec![solid],
                touch_links: call.touch_links.clone(),
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
        lock(&self.objects).insert(call.name.clone(), object);
        Ok(Done {})
    }

    pub(super) fn detach(&self, name: &str, moment: &Moment) -> Result<Done, RpcError> {
        let mut object = known(self, name)?;
        let Some([robot, link]) = object.held_by.take() else {
            return Err(wrong(format!("no robot holds {name}")));
        };
        self.measured(moment);
        let setup = &*self.thread.now();
        let robot = setup.robots.get(robot_index(setup, &robot)?).ok_or_else(internal)?;
        let at = link_pose(robot, &link, moment)? * isometry(&object.pose);
        let let_go = |world: &mut World| {
            let held = world.detach(name)?;
            let solids = held.solids.into_iter();
            solids
                .map(|solid| Solid { frame: frame(&at), ..solid })
                .try_for_each(|solid| world.add(Obstacle { name: name.to_owned(), solid, padding: held.padding }))
        };
        self.thread.world(let_go).map_err(|e| wrong(e.to_string()))?;
        object.pose = spec(&at);
        lock(&self.objects).insert(name.to_owned(), object);
        Ok(Done {})
    }

    /// Adds an object to the world. Reads its file on another thread: it may be large.
    pub(super) async fn put(&self, object: WorldObject) -> Result<Done, RpcError> {
        not_held(self, &object.name)?;
        let config = configured(&object, isometry(&object.pose));
        let made = run_blocking(move || obstacle(&config)).await?.map_err(wrong)?;
        // Another client may have attached it meanwhile.
        not_held(self, &object.name)?;
        self.thread.world(|world| world.put(made)).map_err(|e| wrong(e.to_string()))?;
        lock(&self.objects).insert(object.name.clone(), object);
        Ok(Done {})
    }

    pub(super) fn move_to(&self, call: &api::WorldMove) -> Result<Done, RpcError> {
        let mut object = named(self, &call.name)?;
        let at = frame(&isometry(&call.pose));
        self.thread.world(|world| world.move_to(&call.name, at)).map_err(|e| wrong(e.to_string()))?;
        object.pose = call.pose;
        lock(&self.objects).insert(call.name.clone(), object);
        Ok(Done {})
    }

    pub(super) fn remove(&self, name: Option<&str>) -> Result<Done, RpcError> {
        let mut gone: Vec<String> = Vec::new();
        match name {
            Some(name) => gone.push(named(self, name)?.name),
            None => gone.extend(lock(&self.objects).values().filter(|o| o.held_by.is_none()).map(|o| o.name.clone())),
        }
        for name in gone {
            self.thread.world(|world| world.remove(&name)).map_err(|e| wrong(e.to_string()))?;
            lock(&self.objects).remove(&name);
        }
        Ok(Done {})
    }
}

/// Returns the present pose of a robot's link in the frame `map`.
fn link_pose(robot: &PlannedRobot, link: &str, moment: &Moment) -> Result<Isometry3<f64>, RpcError> {
    let index = link_index(robot, link)?;
    let kinematics = &robot.body.kinematics;
    let mut frames = kinematics.frames();
    let joints = positions_of(&robot.config.name, &robot.config.coordinator_joints, moment)?;
    kinematics.forward_from(&robot.body.base, &joints, &mut frames);
    Ok(pose(&kinematics.link_frame(index, &frames)))
}

fn wrong(what: impl Into<String>) -> RpcError {
    RpcError::new(Code::InvalidParams, what)
}

fn unknown_object(port: &PlannerPort, name: &str) -> RpcError {
    let names: Vec<String> = lock(&port.objects).keys().cloned().collect();
    RpcError::unknown(Code::UnknownObject, "object", name, &names)
}

fn link_index(robot: &PlannedRobot, link: &str) -> Result<usize, RpcError> {
    let names: Vec<&str> = robot.model.links.iter().map(|link| link.name.as_str()).collect();
    let unknown = || RpcError::unknown(Code::InvalidParams, "link", link, &names);
    robot.model.link_index(link).ok_or_else(unknown)
}

/// Returns an object that no robot holds.
fn named(port: &PlannerPort, name: &str) -> Result<WorldObject, RpcError> {
    not_held(port, name)?;
    known(port, name)
}

fn known(port: &PlannerPort, name: &str) -> Result<WorldObject, RpcError> {
    // Not in one expression: the lock would still be held when the error path locks again.
    let object = lock(&port.objects).get(name).cloned();
    object.ok_or_else(|| unknown_object(port, name))
}

fn not_held(port: &PlannerPort, name: &str) -> Result<(), RpcError> {
    let holder = lock(&port.objects).get(name).and_then(|object| object.held_by.clone());
    match holder {
        Some([robot, _]) => {
            Err(wrong(format!("{robot} holds {name}")).hint(format!("`dimos world detach {name}` lets go of it")))
        }
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
pub(super) fn typed(object: &ObjectConfig) -> WorldObject {
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
