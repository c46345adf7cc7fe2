//! Snapshot of a world, laid out for collision checks: links as solids on moving frames, the pairs to check, obstacles
//! at their poses. Immutable.

use std::sync::Arc;

use glamx::{DAffine3, DVec3};

use dimos_robot::kinematics::Kinematics;
use dimos_robot::model::{Limits, RobotModel};

use super::cover;
use super::proven_apart::ProvenApart;
use super::shape::{Core, Placed, Solid};
use super::world::{Robot, World};

/// A link or a held object, with its data for collision checks.
#[derive(Debug, Clone)]
pub struct LinkShape {
    /// Name, prefixed with the robot's name if it has one.
    pub name: String,
    /// Index of its robot, or of the robot that holds it.
    pub(super) robot: usize,
    /// Index of its frame.
    pub(super) frame: usize,
    /// Solids in that frame, padding included in their radii.
    pub(super) solids: Vec<Solid>,
    /// Bounding ball in that frame.
    pub(super) ball: (DVec3, f64),
    /// Whether it moves at all.
    pub(super) moves: bool,
    /// For each joint, the maximum motion of any of its points [m/rad or m/m].
    pub(super) levers: Vec<f64>,
}

/// Two links that must not touch.
#[derive(Debug, Clone)]
pub struct LinkPair {
    /// Index of the first.
    pub a: usize,
    /// Index of the second.
    pub b: usize,
    /// For each joint, their maximum relative motion [m/rad or m/m].
    pub(super) levers: Vec<f64>,
}

/// An obstacle at its pose.
#[derive(Debug, Clone)]
pub struct PlacedObstacle {
    /// Its name.
    pub name: String,
    /// Geometry and pose; padding is included in its radius.
    pub(super) solid: Solid,
    /// Bounding box of its core.
    pub(super) guard: (DAffine3, DVec3),
    /// Whether the core equals that box: for boxes, capsules and spheres.
    pub(super) boxy: bool,
}

impl PlacedObstacle {
    pub(super) fn placed(&self) -> Placed<'_> {
        let frame = self.solid.frame;
        match &self.solid.core {
            Core::Point => Placed::Point(frame.translation),
            Core::Segment { half } => {
                let along = frame.matrix3.z_axis * *half;
                Placed::Segment(frame.translation - along, frame.translation + along)
            }
            Core::Box { half } => Placed::Box(frame, *half),
            Core::Cylinder { half, radius } => Placed::Cylinder(frame, *half, *radius),
            Core::Hull(hull) => Placed::Hull(frame, hull),
            Core::Mesh(mesh) => Placed::Mesh(frame, mesh),
            Core::Cloud(cloud) => Placed::Cloud(frame, cloud),
        }
    }
}

/// A robot of a scene: indices of its joints and frames among those of all robots.
#[derive(Debug, Clone)]
pub struct SceneRobot {
    /// Its name.
    pub name: String,
    /// Its model.
    pub model: Arc<RobotModel>,
    /// Its joints.
    pub kinematics: Arc<Kinematics>,
    /// Pose of its root in the world.
    pub base: DAffine3,
    /// Distance from its links that padding adds [m].
    pub(super) apart: f64,
    /// Index of its first joint in a configuration.
    pub first_joint: usize,
    pub(super) first_frame: usize,
}

/// A world at the time of the snapshot.
#[derive(Debug, Clone, Default)]
pub struct Scene {
    pub(super) robots: Vec<SceneRobot>,
    pub(super) links: Vec<LinkShape>,
    pub(super) pairs: Vec<LinkPair>,
    pub(super) obstacles: Vec<PlacedObstacle>,
    /// Links and obstacles, by index, that may touch.
    pub(super) touch: Vec<(usize, usize)>,
    pub(super) limits: Vec<Limits>,
    turns: Vec<bool>,
    joint_names: Vec<String>,
    pub(super) frames: usize,
}

/// Data to decide which pairs to check: robot, link index in its model, body, and whether it is held.
struct Origin {
    robot: usize,
    link: usize,
    body: usize,
    reach: f64,
    held: Option<usize>,
}

impl Scene {
    pub(super) fn of(world: &World) -> Self {
        let mut scene = Self::default();
        let mut origins = Vec::new();
        for robot in world.robots() {
            scene.robots.push(SceneRobot {
                name: robot.name.clone(),
                model: robot.model.clone(),
                kinematics: robot.kinematics.clone(),
                base: robot.base,
                apart: robot.apart,
                first_joint: scene.limits.len(),
                first_frame: scene.frames,
            });
            scene.limits.extend_from_slice(robot.kinematics.limits());
            scene.turns.extend(robot.kinematics.turns());
            let full = |name: &String| full_name(&robot.name, name);
            scene.joint_names.extend(robot.kinematics.names().iter().map(full));
            scene.frames += robot.kinematics.bodies();
        }
        for (r, robot) in world.robots().iter().enumerate() {
            for (l, solids) in robot.solids.iter().enumerate() {
                let name = robot.model.links.get(l).map_or("", |link| &link.name);
                scene.add_link(&mut origins, name, (r, l), robot, solids, robot.padding, None);
            }
        }
        for (h, held) in world.held().iter().enumerate() {
            let Some(robot) = world.robots().get(held.robot) else { continue };
            let Some(link) = robot.model.link_index(&held.link) else { continue };
            let padding = held.padding.max(robot.padding);
            scene.add_link(&mut origins, &held.name, (held.robot, link), robot, &held.solids, padding, Some(h));
        }
        scene.make_pairs(world, &origins);
        scene.obstacles = world.obstacles().iter().map(place).collect();
        for (l, link) in scene.links.iter().enumerate() {
            let touched = world.obstacles().iter().enumerate().filter(|(_, o)| world.may_touch(&link.name, &o.name));
            scene.touch.extend(touched.map(|(o, _)| (l, o)));
        }
        scene
    }

    /// Returns how far the robot of a link may be from its model [m].
    pub(super) fn apart(&self, link: usize) -> f64 {
        let robot = self.links.get(link).and_then(|link| self.robots.get(link.robot));
        robot.map_or(0.0, |robot| robot.apart)
    }

    #[allow(clippy::too_many_arguments, reason = "one caller per kind of link")]
    fn add_link(
        &mut self,
        origins: &mut Vec<Origin>,
        name: &str,
        (r, link): (usize, usize),
        robot: &Robot,
        solids: &[Solid],
        padding: f64,
        held: Option<usize>,
    ) {
        let Some(own) = self.robots.get(r).filter(|_| !solids.is_empty()) else { return };
        let kinematics = &robot.kinematics;
        let (body, place) = (kinematics.body_of(link), kinematics.offset_of(link));
        let mut solids: Vec<Solid> = solids.iter().map(|s| s.clone().at(place * s.frame)).collect();
        solids.iter_mut().for_each(|s| s.radius += padding);
        let ball = cover::ball_of_link(&solids);
        let reach = ball.0.length() + ball.1;
        let mut levers = vec![0.0; self.limits.len()];
        add_levers(kinematics, own.first_joint, kinematics.levers(body, reach), &mut levers);
        let name = full_name(&robot.name, name);
        let frame = own.first_frame + body;
        self.links.push(LinkShape { name, robot: r, frame, solids, ball, moves: body != 0, levers });
        origins.push(Origin { robot: r, link, body, reach, held });
    }

    fn make_pairs(&mut self, world: &World, origins: &[Origin]) {
        for (b, second) in origins.iter().enumerate() {
            for (a, first) in origins[..b].iter().enumerate() {
                if may_touch(world, first, second) {
                    continue;
                }
                let mut levers = vec![0.0; self.limits.len()];
                for (one, other) in [(first, second), (second, first)] {
                    let Some(robot) = self.robots.get(one.robot) else { continue };
                    // Joints that carry both do not move them relative to each other.
                    let both = |body: usize| {
                        one.robot == other.robot && robot.kinematics.ancestors(other.body).any(|o| o == body)
                    };
                    let mut own = robot.kinematics.levers(one.body, one.reach);
                    own.retain(|(body, _)| !both(*body));
                    add_levers(&robot.kinematics, robot.first_joint, own, &mut levers);
                }
                self.pairs.push(LinkPair { a, b, levers });
            }
        }
    }

    /// Returns the number of joints in a configuration.
    pub fn dof(&self) -> usize {
        self.limits.len()
    }

    /// Returns the limits of the joints.
    pub fn limits(&self) -> &[Limits] {
        &self.limits
    }

    /// Returns which joints are continuous.
    pub fn turns(&self) -> &[bool] {
        &self.turns
    }

    /// Returns the names of the joints, prefixed with the robot's name if it has one.
    pub fn joint_names(&self) -> &[String] {
        &self.joint_names
    }

    /// Returns the robots.
    pub fn robots(&self) -> &[SceneRobot] {
        &self.robots
    }

    /// Returns the links with solids, and held objects.
    pub fn links(&self) -> &[LinkShape] {
        &self.links
    }

    /// Returns the pairs of links that must not touch.
    pub fn pairs(&self) -> &[LinkPair] {
        &self.pairs
    }

    /// Returns the obstacles.
    pub fn obstacles(&self) -> &[PlacedObstacle] {
        &self.obstacles
    }

    /// Returns whether any link is decided by triangles.
    pub(super) fn has_surfaces(&self) -> bool {
        let has = |solid: &Solid| match &solid.core {
            Core::Hull(hull) => hull.surface().is_some(),
            Core::Mesh(_) => true,
            _ => false,
        };
        self.links.iter().any(|link| link.solids.iter().any(has))
    }

    /// Returns a buffer for [`Scene::forward`].
    pub fn frames(&self) -> Vec<DAffine3> {
        vec![DAffine3::IDENTITY; self.frames]
    }

    /// Computes the frames of all bodies of all robots, in the world's frame.
    pub fn forward(&self, q: &[f64], frames: &mut [DAffine3]) {
        for robot in &self.robots {
            let own = q.get(robot.first_joint..).unwrap_or_default();
            let bodies = frames.get_mut(robot.first_frame..robot.first_frame + robot.kinematics.bodies());
            robot.kinematics.forward_from(&robot.base, own, bodies.unwrap_or_default());
        }
    }
}

pub(super) fn full_name(robot: &str, name: &str) -> String {
    if robot.is_empty() { name.to_owned() } else { format!("{robot}/{name}") }
}

fn add_levers(kinematics: &Kinematics, first_joint: usize, own: Vec<(usize, f64)>, levers: &mut [f64]) {
    for (body, lever) in own {
        if let Some((variable, factor)) = kinematics.drive(body) {
            levers[first_joint + variable] += lever * factor.abs();
        }
    }
}

/// Returns whether two links are never checked against each other: welded together, neighbours, an allowed pair, or
/// held.
fn may_touch(world: &World, a: &Origin, b: &Origin) -> bool {
    if a.robot != b.robot {
        return false;
    }
    let Some(robot) = world.robots().get(a.robot) else { return true };
    let held = |x: &Origin| x.held.and_then(|h| world.held().get(h));
    let name = |x: &Origin| robot.model.links.get(x.link).map_or("", |l| l.name.as_str());
    let touches = |x: &Origin, other: &str| held(x).is_some_and(|h| h.touch_links.iter().any(|t| t == other));
    if a.held.is_some() || b.held.is_some() {
        return a.body == b.body || touches(a, name(b)) || touches(b, name(a));
    }
    unchecked(robot, a.link, b.link).is_some()
}

/// Why two links of a robot are never checked against each other.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Unchecked {
    /// No joint that moves is between them.
    Fixed,
    /// They are parent and child.
    Neighbours,
    /// The pair is allowed.
    Allowed,
    /// They are proven to keep this distance at every configuration [m].
    Apart(f64),
}

/// Returns why two links of a robot, by index, are never checked against each other; `None` if they are.
pub fn unchecked(robot: &Robot, a: usize, b: usize) -> Option<Unchecked> {
    let name = |link: usize| robot.model.links.get(link).map_or("", |link| link.name.as_str());
    let parent = |link: usize| robot.model.parent_joint(link).map(|joint| joint.parent);
    let is = |(x, y): &(String, String)| (x == name(a) && y == name(b)) || (x == name(b) && y == name(a));
    if robot.kinematics.body_of(a) == robot.kinematics.body_of(b) {
        Some(Unchecked::Fixed)
    } else if parent(a) == Some(b) || parent(b) == Some(a) {
        Some(Unchecked::Neighbours)
    } else if robot.allowed.iter().any(is) {
        Some(Unchecked::Allowed)
    } else {
        let own = |pair: &&ProvenApart| pair.links == [a, b] || pair.links == [b, a];
        robot.proven.iter().find(own).map(|pair| Unchecked::Apart(pair.distance))
    }
}

fn place(obstacle: &super::world::Obstacle) -> PlacedObstacle {
    let mut solid = obstacle.solid.clone();
    solid.radius += obstacle.padding;
    let mut placed =
        PlacedObstacle { name: obstacle.name.clone(), guard: (solid.frame, DVec3::ZERO), boxy: true, solid };
    placed.guard = match &placed.solid.core {
        Core::Point => (placed.solid.frame, DVec3::ZERO),
        Core::Segment { half } => (placed.solid.frame, DVec3::new(0.0, 0.0, *half)),
        Core::Box { half } => (placed.solid.frame, *half),
        _ => {
            placed.boxy = false;
            placed.placed().guard().unwrap_or(placed.guard)
        }
    };
    placed
}
