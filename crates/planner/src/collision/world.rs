//! A world that can change: robots, obstacles, held objects. Planning uses its snapshots.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use glamx::DAffine3;

use dimos_robot::kinematics::Kinematics;
use dimos_robot::model::RobotModel;

use super::proven_apart::ProvenApart;
use super::scene::{Scene, full_name};
use super::shape::Solid;

/// A robot in a world.
#[derive(Debug, Clone)]
pub struct Robot {
    /// Name; empty for the only robot of a world.
    pub name: String,
    /// Model.
    pub model: Arc<RobotModel>,
    /// Planned joints; the others are fixed.
    pub kinematics: Arc<Kinematics>,
    /// Solids of every link, in the links' frames (see [`super::body::solids`]).
    pub solids: Vec<Vec<Solid>>,
    /// Pose of the root link in the world.
    pub base: DAffine3,
    /// Additional padding of its links [m].
    pub padding: f64,
    /// Distance that a checker with padding keeps from its links to obstacles and other robots besides: how far the arm
    /// may be from its model [m].
    pub apart: f64,
    /// Allowed collision pairs, by link name: exclusion pairs and those of the SRDF.
    pub allowed: Vec<(String, String)>,
    /// Pairs of its links that are proven apart: they are not checked.
    pub proven: Vec<ProvenApart>,
}

/// An obstacle.
#[derive(Debug, Clone)]
pub struct Obstacle {
    /// Name, unique in the world.
    pub name: String,
    /// Geometry and pose, in the world's frame.
    pub solid: Solid,
    /// Padding [m].
    pub padding: f64,
}

/// An object held by a robot.
#[derive(Debug, Clone)]
pub struct Attached {
    /// Name, unique among links and obstacles.
    pub name: String,
    /// Index of the robot.
    pub robot: usize,
    /// Name of the link that holds it.
    pub link: String,
    /// Solids, in that link's frame.
    pub solids: Vec<Solid>,
    /// Links that it may touch, besides the one that holds it.
    pub touch_links: Vec<String>,
    /// Padding [m].
    pub padding: f64,
}

/// Why a change of the world is rejected.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum WorldError {
    /// The name is in use.
    #[error("{0:?} is already in the world")]
    Taken(String),
    /// The object does not exist.
    #[error("{0:?} is not in the world")]
    Unknown(String),
    /// The robot has no such link.
    #[error("robot {robot:?} has no link {link:?}")]
    NoLink {
        /// The robot.
        robot: String,
        /// The link.
        link: String,
    },
    /// The robot does not exist.
    #[error("no robot with index {0}")]
    NoRobot(usize),
    /// Padding is negative or not finite.
    #[error("padding must be finite and not negative, not {0}")]
    Padding(f64),
}

/// Identifies the obstacles and held objects of a world: worlds of the same version have the same ones.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Version(u64);

impl Version {
    /// Returns one that no world had before.
    fn next() -> Self {
        static LAST: AtomicU64 = AtomicU64::new(0);
        Self(LAST.fetch_add(1, Ordering::Relaxed) + 1)
    }
}

/// Robots and the objects around them.
#[derive(Debug, Clone, Default)]
pub struct World {
    robots: Vec<Robot>,
    obstacles: Vec<Obstacle>,
    attached: Vec<Attached>,
    version: Version,
    /// Links that may touch an obstacle, by name: see [`World::letting_touch`].
    touch: Vec<[String; 2]>,
}

fn check_padding(padding: f64) -> Result<(), WorldError> {
    if padding >= 0.0 && padding.is_finite() { Ok(()) } else { Err(WorldError::Padding(padding)) }
}

impl World {
    /// Creates an empty world.
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds a robot. In a configuration, its joints follow those of the robots before it.
    pub fn add_robot(&mut self, robot: Robot) -> Result<(), WorldError> {
        check_padding(robot.padding)?;
        if self.robots.iter().any(|r| r.name == robot.name) {
            return Err(WorldError::Taken(robot.name));
        }
        for link in robot.allowed.iter().flat_map(|(a, b)| [a, b]) {
            if robot.model.link_index(link).is_none() {
                return Err(WorldError::NoLink { robot: robot.name.clone(), link: link.clone() });
            }
        }
        self.robots.push(robot);
        Ok(())
    }

    /// Adds an obstacle.
    pub fn add(&mut self, obstacle: Obstacle) -> Result<(), WorldError> {
        check_padding(obstacle.padding)?;
        if self.obstacles.iter().any(|o| o.name == obstacle.name) || self.attached(&obstacle.name).is_some() {
            return Err(WorldError::Taken(obstacle.name));
        }
        self.version = Version::next();
        self.obstacles.push(obstacle);
        Ok(())
    }

    /// Replaces the obstacle of the same name, or adds it.
    pub fn put(&mut self, obstacle: Obstacle) -> Result<(), WorldError> {
        match self.obstacles.iter().position(|o| o.name == obstacle.name) {
            Some(at) => {
                check_padding(obstacle.padding)?;
                self.version = Version::next();
                self.obstacles[at] = obstacle;
                Ok(())
            }
            None => self.add(obstacle),
        }
    }

    /// Moves an obstacle.
    pub fn move_to(&mut self, name: &str, frame: DAffine3) -> Result<(), WorldError> {
        let unknown = || WorldError::Unknown(name.to_owned());
        let obstacle = self.obstacles.iter_mut().find(|o| o.name == name).ok_or_else(unknown)?;
        self.version = Version::next();
        obstacle.solid.frame = frame;
        Ok(())
    }

    /// Removes an obstacle.
    pub fn remove(&mut self, name: &str) -> Result<Obstacle, WorldError> {
        let at = self.obstacles.iter().position(|o| o.name == name);
        self.version = Version::next();
        at.map(|at| self.obstacles.remove(at)).ok_or_else(|| WorldError::Unknown(name.to_owned()))
    }

    /// Removes all obstacles.
    pub fn clear(&mut self) {
        self.version = Version::next();
        self.obstacles.clear();
    }

    /// Returns the obstacles, in the order of addition.
    pub fn obstacles(&self) -> &[Obstacle] {
        &self.obstacles
    }

    /// Returns the same world with its robots replaced one by one.
    pub fn with_robots(&self, robots: Vec<Robot>) -> Self {
        Self { robots, ..self.clone() }
    }

    /// Returns the same world, in which the links at and beyond the rigid body of a robot's `tip` (an index in its
    /// model), and what they hold, may touch these obstacles.
    pub fn letting_touch(&self, robot: usize, tip: usize, obstacles: &[String]) -> Self {
        let Some(own) = self.robots.get(robot) else { return self.clone() };
        let body = own.kinematics.body_of(tip);
        let is_outer = |link: usize| {
            let parent = |link: &usize| own.model.parent_joint(*link).map(|joint| joint.parent);
            std::iter::successors(Some(link), parent).any(|link| own.kinematics.body_of(link) == body)
        };
        let links = own.model.links.iter().enumerate().filter(|(link, _)| is_outer(*link)).map(|(_, link)| &link.name);
        let holds = |held: &&Attached| held.robot == robot && own.model.link_index(&held.link).is_some_and(is_outer);
        let outer = links.chain(self.attached.iter().filter(holds).map(|held| &held.name));
        let named = |link: &String| full_name(&own.name, link);
        let mut world = self.clone();
        for link in outer.map(named) {
            world.touch.extend(obstacles.iter().map(|obstacle| [link.clone(), obstacle.clone()]));
        }
        world
    }

    /// Returns whether a link, by its name in a scene, may touch an obstacle.
    pub(super) fn may_touch(&self, link: &str, obstacle: &str) -> bool {
        self.touch.iter().any(|[own, other]| own == link && other == obstacle)
    }

    /// Returns the version of its obstacles and held objects; robots do not count.
    pub fn version(&self) -> Version {
        self.version
    }

    /// Returns the robots.
    pub fn robots(&self) -> &[Robot] {
        &self.robots
    }

    /// Returns the held objects.
    pub fn held(&self) -> &[Attached] {
        &self.attached
    }

    fn attached(&self, name: &str) -> Option<usize> {
        self.attached.iter().position(|a| a.name == name)
    }

    /// Attaches an object to a link.
    pub fn attach(&mut self, object: Attached) -> Result<(), WorldError> {
        check_padding(object.padding)?;
        let robot = self.robots.get(object.robot).ok_or(WorldError::NoRobot(object.robot))?;
        for link in std::iter::once(&object.link).chain(&object.touch_links) {
            if robot.model.link_index(link).is_none() {
                return Err(WorldError::NoLink { robot: robot.name.clone(), link: link.clone() });
            }
        }
        let taken = self.attached(&object.name).is_some()
            || robot.model.link_index(&object.name).is_some()
            || self.obstacles.iter().any(|o| o.name == object.name);
        if taken {
            return Err(WorldError::Taken(object.name));
        }
        self.version = Version::next();
        self.attached.push(object);
        Ok(())
    }

    /// Detaches a held object and returns it.
    pub fn detach(&mut self, name: &str) -> Result<Attached, WorldError> {
        let at = self.attached(name).ok_or_else(|| WorldError::Unknown(name.to_owned()))?;
        self.version = Version::next();
        Ok(self.attached.remove(at))
    }

    /// Returns an immutable snapshot of the current world.
    pub fn snapshot(&self) -> Arc<Scene> {
        Arc::new(Scene::of(self))
    }
}
