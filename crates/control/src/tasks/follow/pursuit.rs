//! The motion of a joint to where it is to be, and along with it: within limits of velocity, acceleration and jerk, and
//! inside the joint's range.

use dimos_core::joint::braking_speed;

/// Limits of a joint's motion.
#[derive(Debug, Clone, Copy)]
pub struct Caps {
    /// Highest speed [rad/s].
    pub velocity: f64,
    /// Highest acceleration [rad/s²].
    pub acceleration: f64,
    /// Acceleration with which it brakes to its target [rad/s²].
    pub braking: f64,
    /// Highest jerk [rad/s³].
    pub jerk: f64,
    /// Speed per distance from the target [1/s].
    pub gain: f64,
}

/// Range of a joint, and its own acceleration.
#[derive(Debug, Clone, Copy)]
pub struct Room {
    /// Lowest position [rad].
    pub lower: f64,
    /// Highest position [rad].
    pub upper: f64,
    /// Its acceleration where it is too fast for its caps or its range [rad/s²]; at least that of the caps.
    pub acceleration: f64,
}

/// State of a joint: what is commanded.
#[derive(Debug, Clone, Copy, Default)]
pub struct Pursuit {
    /// [rad]
    pub position: f64,
    /// [rad/s]
    pub velocity: f64,
    /// [rad/s²]
    acceleration: f64,
}

impl Pursuit {
    /// Continues from a command.
    pub fn rebase(&mut self, position: f64, velocity: f64) {
        *self = Self { position, velocity, acceleration: 0.0 };
    }

    /// Moves for `dt` [s] towards a target that is at `position` [rad] at the end of it and moves at `velocity`
    /// [rad/s]. `None`: to rest.
    pub fn advance(&mut self, target: Option<(f64, f64)>, caps: &Caps, room: &Room, dt: f64) {
        let wanted = target.map_or(0.0, |(position, velocity)| {
            let behind = position - velocity * dt - self.position;
            let fastest = braking_speed(behind.abs(), caps.braking, dt);
            velocity + within(caps.gain * behind, fastest)
        });
        let wanted = within(wanted, if target.is_some() { caps.velocity } else { 0.0 });
        let change = wanted - self.velocity;
        if self.velocity.abs() > caps.velocity || target.is_none() {
            // Too fast: decelerates like the joints of a stream that has ended.
            self.acceleration = within(change / dt, room.acceleration);
        } else {
            // The highest acceleration from which the velocity arrives without overshoot, critically damped with the
            // gain near the target.
            let arriving = braking_speed(change.abs(), caps.jerk, dt);
            let damped = change.abs() / (0.25 / caps.gain + dt);
            let asked = caps.acceleration.min(arriving).min(damped).copysign(change);
            self.acceleration += within(asked - self.acceleration, caps.jerk * dt);
        }
        // Never faster than it can stop inside its range.
        let up = braking_speed((room.upper - self.position).max(0.0), room.acceleration, dt);
        let down = braking_speed((self.position - room.lower).max(0.0), room.acceleration, dt);
        let inside = (self.velocity + self.acceleration * dt).min(up).max(-down);
        self.acceleration = within((inside - self.velocity) / dt, room.acceleration);
        self.velocity += self.acceleration * dt;
        self.position = (self.position + self.velocity * dt).max(room.lower).min(room.upper);
    }
}

/// The value between `-most` and `most`. Unlike `clamp` it cannot panic.
pub fn within(value: f64, most: f64) -> f64 {
    value.max(-most).min(most)
}

#[cfg(test)]
mod tests {
    use super::*;

    const DT: f64 = 0.01;
    const ROOM: Room = Room { lower: -2.0, upper: 2.0, acceleration: 4.0 };
    const SLOW: Caps = Caps { velocity: 0.3, acceleration: 1.0, braking: 0.3, jerk: 5.0, gain: 2.0 };

    /// Moves for this time [s] and returns the largest speed, acceleration and jerk.
    fn watched(joint: &mut Pursuit, seconds: f64, caps: &Caps, mut target: impl FnMut(f64) -> (f64, f64)) -> [f64; 3] {
        let mut most = [0.0f64; 3];
        for k in 1..=(seconds / DT) as u32 {
            let before = *joint;
            joint.advance(Some(target(f64::from(k) * DT)), caps, &ROOM, DT);
            let acceleration = (joint.velocity - before.velocity) / DT;
            let figures = [joint.velocity, acceleration, (acceleration - before.acceleration) / DT];
            most.iter_mut().zip(figures).for_each(|(most, figure)| *most = most.max(figure.abs()));
        }
        most
    }

    #[test]
    fn a_far_target_is_reached_within_the_caps_and_without_overshoot() {
        let mut joint = Pursuit::default();
        let [velocity, acceleration, jerk] = watched(&mut joint, 6.0, &SLOW, |_| (1.0, 0.0));
        assert!(velocity <= 0.3 + 1e-12 && velocity > 0.299, "{velocity}");
        assert!(acceleration <= 1.0 + 1e-9 && jerk <= 5.0 + 1e-6, "{acceleration} {jerk}");
        assert!((joint.position - 1.0).abs() < 1e-4 && joint.position <= 1.0, "{}", joint.position);
    }

    #[test]
    fn a_moving_target_is_caught_up_with_and_followed() {
        let mut joint = Pursuit::default();
        let [velocity, ..] = watched(&mut joint, 6.0, &SLOW, |t| (0.3 + 0.2 * t, 0.2));
        assert!(velocity <= 0.3 + 1e-12, "{velocity}");
        assert!((joint.position - 1.5).abs() < 0.01 && (joint.velocity - 0.2).abs() < 0.01, "{joint:?}");
    }

    #[test]
    fn it_brakes_before_the_end_of_its_range() {
        let mut joint = Pursuit { position: 1.0, velocity: 1.4, acceleration: 0.0 };
        let fast = Caps { velocity: 1.5, acceleration: 4.0, braking: 3.6, jerk: 800.0, gain: 15.0 };
        let [_, acceleration, _] = watched(&mut joint, 2.0, &fast, |t| (1.0 + 1.4 * t, 1.4));
        assert!(acceleration <= 4.0 + 1e-9, "{acceleration}");
        assert!((joint.position - 2.0).abs() < 1e-9 && joint.velocity.abs() < 1e-9, "{joint:?}");
    }

    #[test]
    fn without_a_target_it_decelerates_to_rest() {
        let mut joint = Pursuit { position: 0.0, velocity: 1.0, acceleration: 0.0 };
        (0..26).for_each(|_| joint.advance(None, &SLOW, &ROOM, DT));
        assert!(joint.velocity.abs() < 1e-12 && (joint.position - 0.12).abs() < 0.01, "{joint:?}");
    }
}
