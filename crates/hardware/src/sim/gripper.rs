//! Gripper of a simulated arm.

use super::faults::{Fault, FaultKind};

/// The faults of a gripper.
pub const FAULTS: [FaultKind; 2] = [FaultKind::Object, FaultKind::GripperBlocked];

/// A gripper with finite speed. It presses on an object between its fingers with the largest force that it was given.
#[derive(Debug, Clone, Copy)]
pub struct Gripper {
    /// Position [m or rad].
    pub position: f64,
    /// Largest force, in the unit of its force; 0 for a gripper without force control.
    pub max_force: f64,
    target: f64,
    max: f64,
    speed: f64,
    /// Position at which the fingers touch an object; 0 without one.
    object: f64,
    /// Fraction of its speed with which it moves.
    fraction: f64,
    /// A fault keeps the fingers where they are.
    blocked: bool,
    /// The object is that of a fault with a duration.
    lent: bool,
}

impl Gripper {
    /// Creates a gripper that opens to `max` [m or rad] at `speed` [m/s or rad/s]; initially half open.
    pub fn new(max: f64, speed: f64) -> Self {
        Self {
            position: max / 2.0,
            max_force: 0.0,
            target: max / 2.0,
            max,
            speed,
            object: 0.0,
            fraction: 1.0,
            blocked: false,
            lent: false,
        }
    }

    /// Sets the fraction of its speed with which it moves.
    pub fn set_speed(&mut self, fraction: f64) {
        self.fraction = fraction.clamp(0.0, 1.0);
    }

    /// Plays the faults `object` and `gripper_blocked` that are due: `take` returns them. Call it whenever the arm is
    /// advanced.
    pub fn play(&mut self, mut take: impl FnMut(FaultKind) -> Option<Fault>) {
        self.blocked = take(FaultKind::GripperBlocked).is_some();
        match take(FaultKind::Object) {
            Some(fault) => {
                self.put_object(fault.amount);
                self.lent = fault.duration > 0.0;
            }
            None if std::mem::take(&mut self.lent) => self.put_object(0.0),
            None => {}
        }
    }

    /// Returns the same gripper with a largest force.
    pub fn with_force(self, max_force: f64) -> Self {
        Self { max_force, ..self }
    }

    /// Moves to a position [m or rad].
    pub fn move_to(&mut self, target: f64) {
        if target.is_finite() {
            self.target = target.clamp(0.0, self.max);
        }
    }

    /// Stops where it is; a grip is kept.
    pub fn stop(&mut self) {
        if !self.gripping() {
            self.target = self.position;
        }
    }

    /// Rests where it is, without pressing on an object.
    pub fn rest(&mut self) {
        self.target = self.position;
    }

    /// Puts an object of this width [m or rad] between the fingers, if they are wide enough open; 0 takes it away.
    pub fn put_object(&mut self, width: f64) {
        self.object = width.clamp(0.0, self.position);
    }

    /// Returns whether it is moving.
    pub fn moving(&self) -> bool {
        self.position != self.target && !self.gripping()
    }

    /// Returns the force on the object [unit of its force]: 0 unless it grips one.
    pub fn force(&self) -> f64 {
        if self.gripping() { self.max_force } else { 0.0 }
    }

    /// Advances by `dt` [s].
    pub fn advance(&mut self, dt: f64) {
        if self.blocked {
            return;
        }
        let (reach, goal) = (self.fraction * self.speed * dt.max(0.0), self.target.max(self.object));
        let error = goal - self.position;
        self.position = if error.abs() <= reach { goal } else { self.position + reach.copysign(error) };
    }

    /// Returns whether it presses on an object.
    pub fn gripping(&self) -> bool {
        self.position == self.object && self.target < self.object
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gripper_has_a_finite_speed() {
        let mut gripper = Gripper::new(0.08, 0.1);
        gripper.move_to(1.0);
        gripper.advance(0.1);
        assert!((gripper.position - 0.05).abs() < 1e-12);
        assert!(gripper.moving());
        gripper.advance(10.0);
        assert_eq!((gripper.position, gripper.moving()), (0.08, false));
    }

    #[test]
    fn an_object_stops_the_fingers_and_feels_the_largest_force() {
        let mut gripper = Gripper::new(0.08, 0.1).with_force(12.0);
        gripper.put_object(0.03);
        gripper.move_to(0.01);
        gripper.advance(0.05);
        assert!(gripper.moving() && gripper.force() == 0.0, "on the way");
        gripper.advance(1.0);
        assert_eq!((gripper.position, gripper.moving(), gripper.force()), (0.03, false, 12.0));
        gripper.stop();
        assert_eq!(gripper.force(), 12.0, "a stop keeps the grip");
        gripper.move_to(0.05);
        gripper.advance(1.0);
        assert_eq!((gripper.position, gripper.force()), (0.05, 0.0));
    }
}
