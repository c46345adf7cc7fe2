//! One joint of a [`super::plant::Plant`].

use super::weight::Drive;

/// Maximum idle time that an ideal joint may make up for in one jump [s].
pub(super) const CREDIT: f64 = 0.1;
/// Part of the acceleration that a joint plans to brake with; the rest is needed to stop after a whole number of steps.
const BRAKING: f64 = 0.85;
/// Thresholds below which a joint has reached its target [rad, rad/s].
const ARRIVED: (f64, f64) = (1e-7, 1e-4);

/// State and limits of a joint.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Joint {
    pub position: f64,
    pub velocity: f64,
    /// Whether its motor is on.
    pub on: bool,
    /// Target position [rad] or velocity [rad/s].
    pub target: f64,
    /// The last servo setpoint [rad].
    pub setpoint: f64,
    /// Average distance from a setpoint to the next [rad].
    pub step: f64,
    /// Speed of the setpoints, from the last two [rad/s].
    pub pace: f64,
    pub lower: f64,
    pub upper: f64,
    pub velocity_max: f64,
    pub acceleration: f64,
    /// Time in which an ideal joint has not moved although it could have [s].
    pub credit: f64,
    pub blocked: bool,
    /// Velocity at which a hand moves it [rad/s].
    pub hand: f64,
    /// Where it stops when it falls [rad]; `None`: friction holds it.
    pub rest: Option<f64>,
    /// How far above the target that was commanded it stops: below it under its weight [rad].
    pub sag: f64,
    /// What drives it in impedance mode, and the effort beside its position control.
    pub force: Drive,
}

/// Returns the speed from which a joint can still stop within `distance` [rad], braking at `acceleration` [rad/s²] in
/// steps of `h` [s].
pub(super) fn braking_speed(distance: f64, acceleration: f64, h: f64) -> f64 {
    let acceleration = acceleration * BRAKING;
    let dv = acceleration * h;
    let speed = 0.5 * ((dv * dv + 8.0 * acceleration * distance).sqrt() - dv);
    speed.min(distance / h)
}

impl Joint {
    pub fn travel(&mut self, h: f64) {
        self.position += self.velocity * h;
        if self.position < self.lower || self.position > self.upper {
            self.position = self.position.clamp(self.lower, self.upper);
            self.velocity = 0.0;
        }
    }

    pub fn accelerate(&mut self, velocity: f64, acceleration: f64, h: f64) {
        let dv = acceleration * h;
        self.velocity += (velocity - self.velocity).clamp(-dv, dv);
        self.travel(h);
    }

    /// Moves towards the target, at most at speed `top`, with first-order lag (0 = none), able to stop in time. For a
    /// target that moves at `pace` [rad/s], it stops relative to the target.
    pub fn approach(&mut self, top: f64, lag: f64, pace: f64, acceleration: f64, h: f64) {
        let error = self.target - self.position;
        let arrived = error.abs() < ARRIVED.0 && self.velocity.abs() < ARRIVED.1.max(acceleration * h);
        if arrived && pace == 0.0 {
            (self.position, self.velocity) = (self.target, 0.0);
            return;
        }
        let wanted = error.abs() / lag.max(h);
        let brake = braking_speed(error.abs(), acceleration, h) + (pace * error.signum()).max(0.0);
        self.accelerate(wanted.min(brake).min(top).copysign(error), acceleration, h);
    }

    /// Moves an ideal joint between setpoints: at top speed to the setpoint, then at rest.
    pub fn follow(&mut self, pause: bool, h: f64) {
        let error = self.target - self.position;
        if error != 0.0 {
            let step = error.clamp(-self.velocity_max * h, self.velocity_max * h);
            self.position = if step == error { self.target } else { self.position + step };
            self.velocity = step / h;
            self.credit = 0.0;
        } else {
            self.credit = (self.credit + h).min(CREDIT);
            if pause {
                self.velocity = 0.0;
            }
        }
    }

    pub fn fallen(&self) -> bool {
        self.rest.is_none_or(|rest| self.position == rest)
    }

    pub fn fall(&mut self, speed: f64, h: f64) {
        let way = self.rest.map_or(0.0, |rest| rest - self.position);
        if way.abs() <= speed * h {
            (self.position, self.velocity) = (self.position + way, 0.0);
        } else {
            self.velocity = speed.copysign(way);
            self.travel(h);
        }
    }
}
