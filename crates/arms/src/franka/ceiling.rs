//! How fast a joint may go where it is, and how much it may accelerate, so that it can always brake in time: at the top
//! speed, where an FR3's limit falls with the position, and when commands are lost.

use super::model::JointRange;

/// Share of a published limit that commands use.
pub const SHARE: f64 = 0.97;
/// Share of the acceleration with which a joint brakes before an end; the remainder is for the jerk limit.
const BRAKING: f64 = 0.9;
/// How quickly the velocity approaches its limit [1/s]: the acceleration changes by less than the jerk limit then.
const APPROACH: f64 = 200.0;
/// The same for the limit of the user, which does not fall [1/s].
const APPROACH_USER: f64 = 400.0;
/// Times for which the controller continues with constant acceleration when commands are lost [s]: the twentieth lost
/// one ends the motion, and the jerk limit wants 3 ms more. The shorter one is between, where the limit falls in a bow.
const LOST: [f64; 2] = [0.010, 0.023];
/// The ends are this much closer than published [rad]: a joint that creeps there is not to pass them by rounding.
const EDGE: f64 = 0.001;

/// Limits of the user for one joint: velocity [rad/s], acceleration [rad/s²].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct UserLimit {
    /// Velocity [rad/s].
    pub velocity: f64,
    /// Acceleration [rad/s²].
    pub acceleration: f64,
}

impl UserLimit {
    /// No limit.
    pub const NONE: Self = Self { velocity: f64::INFINITY, acceleration: f64::INFINITY };
}

/// Returns the highest velocity toward an end at a distance `room` [rad] from it with which the joint can still follow
/// the limit down to the end, at a share of the limits; and how it grows with the distance [rad/s per rad].
pub fn toward(range: &JointRange, room: f64, share: f64) -> (f64, f64) {
    let (top, braking) = (share * range.velocity, BRAKING * range.acceleration);
    let room = room - EDGE;
    let own = |(offset, deceleration)| (share * offset, share * share * deceleration);
    let (offset, deceleration) = range.braking.map_or((0.0, braking), own);
    let limit = (2.0 * deceleration * room.max(0.0)).sqrt() - offset;
    // Above this velocity the limit falls faster than the joint can brake.
    let fast = braking * offset / (deceleration - braking);
    let (velocity, slope) = if deceleration > braking && limit > fast {
        let there = (fast + offset).powi(2) / (2.0 * deceleration);
        let velocity = (fast * fast + 2.0 * braking * (room - there)).max(0.0).sqrt();
        (velocity, braking / velocity.max(1e-3))
    } else {
        (limit.max(0.0), deceleration / (limit.max(0.0) + offset).max(1e-3))
    };
    if velocity >= top { (top, 0.0) } else { (velocity, slope) }
}

/// Returns the highest acceleration toward the upper end at a position and velocity.
fn highest(range: &JointRange, user: &UserLimit, position: f64, velocity: f64) -> f64 {
    let (room, ahead) = (range.upper - position, velocity.max(0.0));
    let (limit, slope) = toward(range, room, SHARE);
    let mut most = APPROACH * (limit - velocity) - slope * ahead;
    for time in LOST {
        let after = |acceleration: f64| {
            let way = (ahead + 0.5 * acceleration.max(0.0) * time) * time;
            (toward(range, room - way, 1.0).0 - velocity) / time
        };
        most = most.min(after(most.min(after(0.0)).min(range.acceleration)));
    }
    most.min(APPROACH_USER * (user.velocity - velocity))
}

/// Returns the lowest and the highest acceleration at a position and velocity [rad/s²]. The user's acceleration is not
/// in it: braking for an end may need more, and a joint that catches up with setpoints that brake needs more.
pub fn accelerations(range: &JointRange, user: &UserLimit, position: f64, velocity: f64) -> (f64, f64) {
    let most = SHARE * range.acceleration;
    let mirrored = JointRange { lower: -range.upper, upper: -range.lower, ..*range };
    let high = highest(range, user, position, velocity).min(most);
    let low = -highest(&mirrored, user, -position, -velocity).min(most);
    (low, high)
}
