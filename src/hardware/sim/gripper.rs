//! Gripper of a simulated arm.

/// A gripper with finite speed.
#[derive(Debug, Clone, Copy)]
pub struct Gripper {
    /// Opening [m].
    pub position: f64,
    target: f64,
    max: f64,
    speed: f64,
}

impl Gripper {
    /// Creates a gripper that opens to `max` [m] at `speed` [m/s]; initially half open.
    pub fn new(max: f64, speed: f64) -> Self {
        Self { position: max / 2.0, target: max / 2.0, max, speed }
    }

    /// Moves to an opening [m].
    pub fn move_to(&mut self, target: f64) {
        if target.is_finite() {
            self.target = target.clamp(0.0, self.max);
        }
    }

    /// Stops where it is.
    pub fn stop(&mut self) {
        self.target = self.position;
    }

    /// Returns whether it is moving.
    pub fn moving(&self) -> bool {
        self.position != self.target
    }

    /// Advances by `dt` [s].
    pub fn advance(&mut self, dt: f64) {
        let reach = self.speed * dt.max(0.0);
        let error = self.target - self.position;
        self.position = if error.abs() <= reach { self.target } else { self.position + reach.copysign(error) };
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
}
