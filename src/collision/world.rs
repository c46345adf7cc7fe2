//! The world that can be changed: robots, obstacles, held objects, allowed pairs. Planning works on its snapshots.

use std::collections::BTreeSet;
use std::sync::Arc;

use glamx::DAffine3;

use crate::robot::kinematics::Kinematics;
use crate::robot::model::RobotModel;

use super::scene::Scene;
use super::shape::Solid;

/// A robot in a world.
#[derive(Debug, Clone)]
pub struct Robot {
    /// Its name: empty for the only robot of a world.
    pub name: String,
    /// Its description.
    pub model: Arc<RobotModel>,
    /// The joints that are planned; the others stand still.
    pub kinematics: Arc<Kinematics>,
    /// The solids of every link, in the links' frames (see [`super::body::solids`]).
    pub solids: Vec<Vec<Solid>>,
    /// Where its root link stands in the world.
    pub base: DAffine3,
    /// More distance that its links keep from obstacles and each other [m].
    pub padding: f64,
    /// Pairs of links that may touch, by name: exclusion pairs and those of the SRDF.
    pub allowed: Vec<(String, String)>,
}

/// Something in the robots' way.
#[derive(Debug, Clone)]
pub struct Obstacle {
    /// Its name, unique in the world.
    pub name: String,
    /// What and where it is, in the world's frame.
    pub solid: Solid,
    /// Distance to keep from it [m].
    pub padding: f64,
}

/// Something that a robot holds.
#[derive(Debug, Clone)]
pub struct Attached {
    /// Its name, unique among links and obstacles.
    pub name: String,
    /// The robot's index.
    pub robot: usize,
    /// The link that holds it, by name.
    pub link: String,
    /// Its solids, in that link's frame.
    pub solids: Vec<Solid>,
    /// Links that it may touch besides the one that holds it.
    pub touch_links: Vec<String>,
    /// Distance to keep from it [m].
    pub padding: f64,
}

/// Why a world cannot be changed so.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum WorldError {
    /// The name is taken.
    #[error("{0:?} is already in the world")]
    Taken(String),
    /// There is no such thing.
    #[error("{0:?} is not in the world")]
    Unknown(String),
    /// A robot has no such link.
    #[error("robot {robot:?} has no link {link:?}")]
    NoLink {
        /// The robot.
        robot: String,
        /// The link.
        link: String,
    },
    /// There is no such robot.
    #[error("there is no robot number {0}")]
    NoRobot(usize),
    /// Padding is negative or not finite.
    #[error("padding must be finite and not negative, not {0}")]
    Padding(f64),
}

/// Robots and what is around them.
#[derive(Debug, Clone, Default)]
pub struct World {
    robots: Vec<Robot>,
    obstacles: Vec<Obstacle>,
    attached: Vec<Attached>,
    /// Links and obstacles that may touch, by name.
    allowed: BTreeSet<(String, String)>,
}

fn check_padding(padding: f64) -> Result<(), WorldError> {
    if padding >= 0.0 && padding.is_finite() { Ok(()) } else { Err(WorldError::Padding(padding)) }
}

impl World {
    /// An empty world.
    pub fn new() -> Self {
        Self::default()
    }

    /// Puts a robot in. Its joints follow those of the robots before it in a configuration.
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

    /// Puts an obstacle in.
    pub fn add(&mut self, obstacle: Obstacle) -> Result<(), WorldError> {
        check_padding(obstacle.padding)?;
        if self.obstacles.iter().any(|o| o.name == obstacle.name) || self.attached(&obstacle.name).is_some() {
            return Err(WorldError::Taken(obstacle.name));
        }
        self.obstacles.push(obstacle);
        Ok(())
    }

    /// Puts an obstacle in place of the one with its name, or adds it.
    pub fn put(&mut self, obstacle: Obstacle) -> Result<(), WorldError> {
        match self.obstacles.iter().position(|o| o.name == obstacle.name) {
            Some(at) => {
                check_padding(obstacle.padding)?;
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
        obstacle.solid.frame = frame;
        Ok(())
    }

    /// Takes an obstacle out.
    pub fn remove(&mut self, name: &str) -> Result<Obstacle, WorldError> {
        let at = self.obstacles.iter().position(|o| o.name == name);
        at.map(|at| self.obstacles.remove(at)).ok_or_else(|| WorldError::Unknown(name.to_owned()))
    }

    /// Takes all obstacles out.
    pub fn clear(&mut self) {
        self.obstacles.clear();
    }

    /// The obstacles, in the order they were put in.
    pub fn obstacles(&self) -> &[Obstacle] {
        &self.obstacles
    }

    /// The same world with other robots in it, one in place of each.
    pub fn with_robots(&self, robots: Vec<Robot>) -> Self {
        Self { robots, ..self.clone() }
    }

    /// The robots.
    pub fn robots(&self) -> &[Robot] {
        &self.robots
    }

    /// What the robots hold.
    pub fn held(&self) -> &[Attached] {
        &self.attached
    }

    fn attached(&self, name: &str) -> Option<usize> {
        self.attached.iter().position(|a| a.name == name)
    }

    /// Fixes an object to a link.
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
        self.attached.push(object);
        Ok(())
    }

    /// Takes a held object away from its robot, and returns it.
    pub fn detach(&mut self, name: &str) -> Result<Attached, WorldError> {
        let at = self.attached(name).ok_or_else(|| WorldError::Unknown(name.to_owned()))?;
        Ok(self.attached.remove(at))
    }

    /// Lets a link, or a held object, and an obstacle touch.
    pub fn allow(&mut self, link: &str, obstacle: &str) {
        self.allowed.insert((link.to_owned(), obstacle.to_owned()));
    }

    /// Whether a link and an obstacle may touch.
    pub fn is_allowed(&self, link: &str, obstacle: &str) -> bool {
        self.allowed.contains(&(link.to_owned(), obstacle.to_owned()))
    }

    /// The world as it is now; what changes later does not change it.
    pub fn snapshot(&self) -> Arc<Scene> {
        Arc::new(Scene::of(self))
    }
}
