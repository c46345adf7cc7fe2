//! The limiter of a joint, the last stage before the wire: every command is finite, inside the position range, and
//! within the velocity and acceleration limits. A request within limits passes unchanged, bit for bit. A faster one is
//! followed as closely as the limits allow, without overshoot. A jump is refused.

use super::config::JUMP;
use dimos_core::joint::{JointBounds, POSITION_MARGIN, braking_speed};
use dimos_core::telemetry::LimitKind;

/// Highest speed of a joint on its way back into its range [rad/s].
pub const WAY_BACK: f64 = 0.1;
/// A slower command is at rest [rad/s].
const AT_REST: f64 = 1e-6;
/// Slack for rounding: a command at its limit is not "limited".
const ROUNDING: f64 = 1e-9;

/// Why a command is refused.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Refusal {
    /// NaN or infinite.
    NonFinite,
    /// Too far from the previous request or command: the step [rad].
    Jump(f64),
}

/// A command within limits.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limited {
    /// The command [rad] or [rad/s].
    pub value: f64,
    /// The limit that changed it, and the request [rad, rad/s or rad/s²].
    pub by: Option<(LimitKind, f64)>,
}

/// The limiter of one joint, with its last command.
#[derive(Debug, Clone, Copy)]
pub struct Limiter {
    bounds: JointBounds,
    /// Last commanded position [rad].
    position: f64,
    /// Last commanded velocity [rad/s].
    velocity: f64,
    /// Last requested position, while the same task continues to request.
    request: Option<f64>,
    /// Filtered velocity of the requests [rad/s].
    request_velocity: f64,
    /// Time that the last command covered [s]; 0: it began a start.
    covered: f64,
}

impl Limiter {
    /// Creates the limiter of a joint at rest at 0; `seed` it before use.
    pub fn new(bounds: JointBounds) -> Self {
        Self { bounds, position: 0.0, velocity: 0.0, request: None, request_velocity: 0.0, covered: 0.0 }
    }

    /// Returns its bounds.
    pub fn bounds(&self) -> &JointBounds {
        &self.bounds
    }

    /// Returns the last commanded position [rad].
    pub fn position(&self) -> f64 {
        self.position
    }

    /// Returns the last commanded velocity [rad/s].
    pub fn velocity(&self) -> f64 {
        self.velocity
    }

    /// Starts at rest at this position [rad].
    pub fn seed(&mut self, position: f64) {
        *self = Self { position, ..Self::new(self.bounds) };
    }

    /// Slows the command that follows `before` down to this velocity [rad/s], as far as the acceleration limit lets it.
    pub fn slow_to(&mut self, velocity: f64, before: &Self) {
        let change = self.bounds.acceleration * between(before.covered, self.covered);
        self.velocity = velocity.clamp(before.velocity - change, before.velocity + change);
        self.position = before.position + self.velocity * self.covered;
    }

    /// Brakes more than that, where the joint would otherwise leave its range: a joint that brakes together with slower
    /// ones may be too fast for what is left of it.
    pub fn keep_inside(&mut self, before: &Self) {
        let change = self.bounds.acceleration * between(before.covered, self.covered);
        let (lower, upper) = before.range();
        let (slowest, fastest) = before.speeds_inside(lower, upper, before.position, self.covered);
        let inside = self.velocity.clamp(slowest, fastest);
        if inside != self.velocity {
            self.velocity = inside.clamp(before.velocity - change, before.velocity + change);
            self.position = (before.position + self.velocity * self.covered).clamp(lower, upper);
        }
    }

    /// Returns the time that the last command covered, of the arm's own time [s]; 0: it began a start, or the arm's
    /// controller had stopped.
    pub fn covered(&self) -> f64 {
        self.covered
    }

    /// Commands the same for another `dt` [s].
    pub fn repeat(&mut self, dt: f64) {
        self.covered = dt;
    }

    /// Lets the velocity decrease by `decrease` [rad/s] per step; the position stays.
    pub fn brake_in_place(&mut self, decrease: f64, dt: f64) {
        let decrease = decrease * (self.time_to(dt) / dt);
        self.velocity = self.braked(decrease);
    }

    /// Goes back to the last written command: later ones did not reach the arm. Requests continue.
    pub fn rewind(&mut self, position: f64, velocity: f64) {
        (self.position, self.velocity) = (position, velocity);
    }

    /// Returns why a requested position [rad] must be refused, if so. `new_task`: another task requests it, so its step
    /// counts from the last command.
    pub fn refuses(&self, target: f64, new_task: bool) -> Option<Refusal> {
        if !target.is_finite() {
            return Some(Refusal::NonFinite);
        }
        let step = target - self.request.filter(|_| !new_task).unwrap_or(self.position);
        (step.abs() > JUMP).then_some(Refusal::Jump(step))
    }

    /// Checks a request during a gap without following it. The step of the next request counts from it.
    pub fn check_request(&mut self, target: f64) -> Result<(), Refusal> {
        match self.refuses(target, false) {
            Some(refusal) => Err(refusal),
            None => {
                self.request = Some(target);
                Ok(())
            }
        }
    }

    /// Sets the command of a relief, which keeps the joint's limits itself [rad, rad/s], `dt` [s] after the last one.
    pub fn relieve(&mut self, position: f64, velocity: f64, dt: f64) {
        self.forget_request();
        (self.position, self.velocity, self.covered) = (position, velocity, dt);
    }

    /// Corrects the position that velocities have led to by a measurement [rad].
    pub fn correct(&mut self, by: f64) {
        self.position += by;
    }

    /// Returns the highest speed from the present position [rad/s]: a joint outside its range goes back slowly.
    pub fn velocity_limit(&self) -> f64 {
        let outside = self.bounds.excess(self.position) > POSITION_MARGIN;
        if outside { self.bounds.velocity.min(WAY_BACK) } else { self.bounds.velocity }
    }

    /// Returns whether the commanded velocity is 0, or what rounding leaves of it.
    pub fn at_rest(&self) -> bool {
        self.velocity.abs() <= AT_REST
    }

    /// Forgets the last request: the step of the next one counts from the last command.
    pub fn forget_request(&mut self) {
        self.request = None;
        self.request_velocity = 0.0;
    }

    /// Returns the position to command for a requested position [rad], `dt` [s] after the last command. `speed`:
    /// fraction of the velocity limit that applies, 0 to 1.
    pub fn follow_position(&mut self, target: f64, dt: f64, speed: f64) -> Result<Limited, Refusal> {
        if let Some(refusal) = self.refuses(target, false) {
            return Err(refusal);
        }
        let step = target - self.request.unwrap_or(self.position);
        // A command equal to the last request may follow any request within limits; otherwise it must approach the
        // requests at their own velocity.
        let in_step = self.request.is_none_or(|last| last == self.position);
        if self.request.is_some() {
            self.request_velocity += 0.5 * (step / dt - self.request_velocity);
        }
        self.request = Some(target);

        let (lower, upper) = self.range();
        let goal = target.clamp(lower, upper);
        let asked = (goal - self.position) / dt;
        let b = JointBounds { velocity: self.velocity_limit() * speed, ..self.bounds };
        let change = b.acceleration * self.time_to(dt);
        let possible = asked.abs() <= b.velocity * (1.0 + ROUNDING)
            && (asked - self.velocity).abs() <= change * (1.0 + ROUNDING) + ROUNDING
            && (in_step || (asked - self.request_velocity).abs() <= change)
            && self.stops_inside(asked, if asked < 0.0 { self.position - lower } else { upper - self.position }, dt);
        let by = if goal != target {
            Some((LimitKind::Position, target))
        } else if possible {
            None
        } else if asked.abs() > b.velocity {
            Some((LimitKind::Velocity, asked))
        } else {
            Some((LimitKind::Acceleration, (asked - self.velocity) / dt))
        };
        if possible {
            self.velocity = asked;
            self.position = goal;
            return Ok(Limited { value: goal, by });
        }
        let (slowest, fastest) = self.speeds_inside(lower, upper, self.position, dt);
        // The velocity of the requests, plus the highest one from which the command can brake until it meets them.
        let pace = self.request_velocity.clamp(-b.velocity, b.velocity);
        let behind = goal - self.position - pace * dt;
        let wanted = pace + behind.signum() * self.braking_speed(behind.abs(), dt);
        self.velocity = wanted
            .clamp(-b.velocity, b.velocity)
            .clamp(slowest, fastest)
            .clamp(self.velocity - change, self.velocity + change);
        self.position = (self.position + self.velocity * dt).clamp(lower, upper);
        Ok(Limited { value: self.position, by })
    }

    /// Returns the velocity to command for a requested velocity [rad/s]. `at`: lowest and highest position that the
    /// joint may have by now [rad], given the commands since it was measured. `speed`: fraction of the velocity limit
    /// that applies, 0 to 1.
    pub fn follow_velocity(&mut self, target: f64, at: (f64, f64), dt: f64, speed: f64) -> Result<Limited, Refusal> {
        if !target.is_finite() {
            return Err(Refusal::NonFinite);
        }
        self.forget_request();
        let b = JointBounds { velocity: self.velocity_limit() * speed, ..self.bounds };
        let change = b.acceleration * self.time_to(dt);
        let slowest = self.speeds_inside(b.lower, b.upper, at.0, dt).0;
        let fastest = self.speeds_inside(b.lower, b.upper, at.1, dt).1;
        let capped = target.clamp(-b.velocity, b.velocity);
        let inside = capped.clamp(slowest, fastest);
        let before = self.velocity;
        self.velocity = inside.clamp(self.velocity - change, self.velocity + change);
        self.position += self.velocity * dt;
        // In the unit of the limit: the position that the commanded velocity leads to, the acceleration to reach it.
        let by = if capped != target {
            Some((LimitKind::Velocity, target))
        } else if inside != capped {
            Some((LimitKind::Position, (at.0 + at.1) / 2.0 + target * dt))
        } else if self.velocity != inside {
            Some((LimitKind::Acceleration, (target - before) / dt))
        } else {
            None
        };
        Ok(Limited { value: self.velocity, by })
    }

    /// Returns the time from the middle of the last step to that of one of `dt` [s]: velocities are means of a step.
    fn time_to(&mut self, dt: f64) -> f64 {
        between(std::mem::replace(&mut self.covered, dt), dt)
    }

    /// Returns the position to command without a request: decelerates to rest, then holds.
    pub fn hold_position(&mut self, dt: f64) -> f64 {
        self.decelerate(self.bounds.acceleration * dt, dt);
        self.position
    }

    /// Decelerates to rest by `decrease` [rad/s] per step, then holds.
    pub fn decelerate(&mut self, decrease: f64, dt: f64) {
        self.forget_request();
        let decrease = decrease * (self.time_to(dt) / dt);
        self.velocity = self.braked(decrease);
        let (lower, upper) = self.range();
        self.position = (self.position + self.velocity * dt).clamp(lower, upper);
    }

    /// Decelerates from an earlier command instead of the latest one. The request remains the one that was followed
    /// last, so that the step of the next one counts from it.
    pub fn decelerate_from(&mut self, before: &Self, decrease: f64, dt: f64) {
        let (request, request_velocity) = (self.request, self.request_velocity);
        *self = *before;
        self.decelerate(decrease, dt);
        (self.request, self.request_velocity) = (request, request_velocity);
    }

    /// Returns the velocity after the next step of a deceleration to rest by `decrease` [rad/s] per step.
    pub fn braked(&self, decrease: f64) -> f64 {
        self.velocity - self.velocity.clamp(-decrease, decrease)
    }

    /// Returns the range of commanded positions: a joint outside its limits may stay or move in, not further out.
    pub fn range(&self) -> (f64, f64) {
        (self.bounds.lower.min(self.position), self.bounds.upper.max(self.position))
    }

    /// Returns the lowest and highest velocity from which the joint can stop inside its range [rad/s].
    fn speeds_inside(&self, lower: f64, upper: f64, at: f64, dt: f64) -> (f64, f64) {
        (-self.braking_speed((at - lower).max(0.0), dt), self.braking_speed((upper - at).max(0.0), dt))
    }

    /// Returns whether the joint can stop from this speed [rad/s] within `room` [rad].
    fn stops_inside(&self, speed: f64, room: f64, dt: f64) -> bool {
        let (v, a) = (speed.abs(), self.bounds.acceleration);
        // Braking in steps of `dt` takes at most v²/2a + v dt/2 + a dt²/8; most joints are further from their limits.
        room >= v * v / (2.0 * a) + v * dt + a * dt * dt || v <= self.braking_speed(room.max(0.0), dt) + ROUNDING
    }

    /// See [`braking_speed`].
    fn braking_speed(&self, distance: f64, dt: f64) -> f64 {
        braking_speed(distance, self.bounds.acceleration, dt)
    }
}

/// Returns the time between the middles of two steps [s]; of the second alone if it is the first of a start.
fn between(last: f64, dt: f64) -> f64 {
    if last > 0.0 { 0.5 * (last + dt) } else { dt }
}

#[cfg(test)]
#[path = "limit_tests.rs"]
mod tests;
