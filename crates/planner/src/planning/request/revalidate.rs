//! Revalidates a plan: the world or the other robots may have changed since it was planned.

use super::ahead::look_ahead;
use super::pipeline::{PlanFailure, PlannedMotion};
use crate::collision::Stop;
use crate::collision::world::World;
use crate::planning::scene::planning_scene::PlanningScene;

/// Checks a plan's motion against the current world and the current positions of all robots [rad]. The failure
/// describes the contact that blocks it.
pub fn revalidate(
    setup: &PlanningScene,
    world: &World,
    found: &PlannedMotion,
    positions: &[Vec<f64>],
    stop: &Stop,
) -> Result<(), PlanFailure> {
    match look_ahead(setup, world, found, positions, 0.0, stop)? {
        Some(blocked) => Err(PlanFailure::new(format!("after {:.2} s, {}", blocked.free_until, blocked.what))),
        None => Ok(()),
    }
}
