//! Whether a motion that was planned before is still free: the world, and robots that it does not move, may have
//! changed since.

use super::ahead::in_the_way;
use super::leaving::passes;
use super::path::between;
use super::setup::Setup;
use super::solve::{Failure, Found, stage};
use crate::collision::world::World;
use crate::collision::{CollisionChecker, Stop};

/// Looks for the contact on a piece of the motion that is not free.
const LOOKS: u32 = 64;

/// Checks a motion in the world as it is now, with all robots where they are now [rad]. A failure says what is in the
/// way.
pub fn review(setup: &Setup, world: &World, found: &Found, positions: &[Vec<f64>], stop: &Stop) -> Result<(), Failure> {
    let mut stage = stage(setup, world, &found.robots, positions, setup.padding)?;
    let checker = &mut stage.checker;
    checker.give_up_again(&found.given_up);
    for pair in found.trajectory.points.windows(2) {
        let [a, b] = pair else { continue };
        let (from, to) = (&a.positions, &b.positions);
        if passes(checker, found.leaving.as_ref(), from, to, stop) {
            continue;
        }
        if stop.is_over() {
            return Err(Failure::new("whether it is still free was not found out in time"));
        }
        let mut at = from.clone();
        let contact = (0..=LOOKS).find_map(|k| {
            between(from, to, f64::from(k) / f64::from(LOOKS), &mut at);
            checker.contacts(&at).into_iter().next()
        });
        let what =
            contact.map_or_else(|| "it is no longer free".to_owned(), |contact| in_the_way(&contact, setup.padding));
        return Err(Failure::new(format!("after {:.2} s, {what}", a.time_from_start)));
    }
    Ok(())
}
