//! Revalidates a plan: the world or the other robots may have changed since it was planned.

use super::ahead::describe_contact;
use super::path::between;
use super::pipeline::{PlanFailure, PlannedMotion, stage};
use super::planning_scene::PlanningScene;
use super::start_contact::passes;
use crate::collision::world::World;
use crate::collision::{CollisionChecker, Stop};

/// Collision checks along a blocked piece to find its contact.
const SAMPLES: u32 = 64;

/// Checks a plan's motion against the current world and the current positions of all robots [rad]. The failure
/// describes the contact that blocks it.
pub fn revalidate(
    setup: &PlanningScene,
    world: &World,
    found: &PlannedMotion,
    positions: &[Vec<f64>],
    stop: &Stop,
) -> Result<(), PlanFailure> {
    let mut stage = stage(setup, world, &found.robots, positions, found.padding)?;
    let checker = &mut stage.checker;
    checker.give_up_again(&found.given_up);
    for pair in found.trajectory.points.windows(2) {
        let [a, b] = pair else { continue };
        let (from, to) = (&a.positions, &b.positions);
        if passes(checker, found.escape_path.as_ref(), from, to, stop) {
            continue;
        }
        if stop.is_over() {
            return Err(PlanFailure::new("no time left to check whether the plan is still valid"));
        }
        let mut at = from.clone();
        let contact = (0..=SAMPLES).find_map(|k| {
            between(from, to, f64::from(k) / f64::from(SAMPLES), &mut at);
            checker.contacts(&at).into_iter().next()
        });
        let what = contact.map_or_else(
            || "the plan is no longer collision-free".to_owned(),
            |contact| describe_contact(&contact, found.padding),
        );
        return Err(PlanFailure::new(format!("after {:.2} s, {what}", a.time_from_start)));
    }
    Ok(())
}
