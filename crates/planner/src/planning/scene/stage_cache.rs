//! Checkers of recent requests, for requests in the same world: building the collision scene takes longer than most
//! plans.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex};

use super::padded::Padded;
use crate::collision::world::Version;
use dimos_core::sync::lock;
use dimos_robot::kinematics::Kinematics;

/// Maximum number of checkers kept: a request, the check of its plan, and that of a motion under way.
const MAX: usize = 4;

/// Inputs of a checker.
#[derive(Debug, Clone)]
pub(in crate::planning) struct Key {
    /// The world, without its robots.
    pub world: Version,
    /// The joints of each robot with its tool: changed ones are new ones.
    pub robots: Vec<Arc<Kinematics>>,
    /// Indices of the robots that move.
    pub moving: Vec<usize>,
    /// Positions of the robots that do not [rad].
    pub fixed: Vec<Vec<f64>>,
    /// Padding [m].
    pub padding: f64,
    /// Obstacles that the moving robots' end effectors may touch.
    pub touch: Vec<String>,
}

impl PartialEq for Key {
    fn eq(&self, other: &Self) -> bool {
        let same = |(a, b): (&Arc<Kinematics>, &Arc<Kinematics>)| Arc::ptr_eq(a, b);
        self.world == other.world
            && self.moving == other.moving
            && self.fixed == other.fixed
            && self.padding == other.padding
            && self.touch == other.touch
            && self.robots.len() == other.robots.len()
            && self.robots.iter().zip(&other.robots).all(same)
    }
}

/// The checker of all that moves, and one of each moving robot alone.
pub(in crate::planning) type Checkers = (Padded, Vec<Padded>);

/// The newest checkers, shared by the copies of a scene.
#[derive(Debug, Clone, Default)]
pub(in crate::planning) struct StageCache(Arc<Mutex<VecDeque<(Key, Checkers)>>>);

impl StageCache {
    /// Returns a copy of the checkers of a key, made by `make` if they are not kept.
    pub fn get<E>(&self, key: Key, make: impl FnOnce() -> Result<Checkers, E>) -> Result<Checkers, E> {
        let kept = lock(&self.0).iter().find(|(other, _)| *other == key).map(|(_, checkers)| checkers.clone());
        if let Some(checkers) = kept {
            return Ok(checkers);
        }
        let made = make()?;
        let mut kept = lock(&self.0);
        kept.truncate(MAX - 1);
        kept.push_front((key, made.clone()));
        Ok(made)
    }
}
