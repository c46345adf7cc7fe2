//! The way of a joint from a setpoint over the next one to rest, as its limiter decelerates it.

/// A joint's next step, and its deceleration from there.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct JointStep {
    /// Present setpoint [rad].
    pub from: f64,
    /// Next setpoint [rad].
    pub to: f64,
    /// Velocity with which the next one is passed [rad/s].
    pub velocity: f64,
    /// Decrease of the velocity per tick [rad/s].
    pub decrease: f64,
    /// How far the joint may be from its setpoint [rad]: in velocity mode, where positions are only measured.
    pub spread: f64,
}

impl JointStep {
    /// Returns a joint that remains where it is.
    pub fn at(position: f64) -> Self {
        Self { from: position, to: position, ..Self::default() }
    }

    /// Returns whether it moves.
    pub fn moves(&self) -> bool {
        self.from != self.to || self.velocity != 0.0
    }

    /// Returns the number of ticks to rest, the next one included.
    pub fn ticks(&self) -> f64 {
        1.0 + self.braking_ticks()
    }

    /// Number of ticks after the next one in which it still moves: the velocity falls in steps.
    fn braking_ticks(&self) -> f64 {
        if self.velocity == 0.0 {
            return 0.0;
        }
        // Without a deceleration it would never rest: as long as any motion lasts.
        (self.velocity.abs() / self.decrease.max(1e-9)).ceil() - 1.0
    }

    /// Returns the position at a time in ticks of `dt` [s] [rad]: setpoints are met at whole ticks, and approached
    /// evenly between them.
    pub fn position(&self, time: f64, dt: f64) -> f64 {
        self.course(dt)(time)
    }

    /// Returns the position as a function of the time: for many times of one step.
    pub fn course(&self, dt: f64) -> impl Fn(f64) -> f64 {
        let (step, ticks) = (*self, self.braking_ticks());
        move |time| step.position_within(time, dt, ticks)
    }

    fn position_within(&self, time: f64, dt: f64, braking_ticks: f64) -> f64 {
        if time <= 1.0 {
            return self.from + (self.to - self.from) * time;
        }
        let time = (time - 1.0).min(braking_ticks);
        let whole = time.floor();
        let speed = self.velocity.abs();
        // The k-th step has the speed less k decreases.
        let way = speed * whole - self.decrease * whole * (whole + 1.0) / 2.0
            + (time - whole) * (speed - self.decrease * (whole + 1.0));
        self.to + (way * dt).copysign(self.velocity)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::limit::Limiter;
    use dimos_core::joint::JointBounds;

    #[test]
    fn it_is_the_way_that_the_limiter_takes() {
        let dt = 0.01;
        let bounds = JointBounds { lower: -10.0, upper: 10.0, velocity: 2.0, acceleration: 7.0, ..JointBounds::NONE };
        for k in -40..=40 {
            let velocity = 0.05 * f64::from(k);
            let mut limiter = Limiter::new(bounds);
            limiter.rewind(0.3, velocity);
            let step = JointStep { from: 0.2, to: 0.3, velocity, decrease: 7.0 * dt, spread: 0.0 };
            assert_eq!(step.position(0.5, dt), 0.25);
            let mut ticks = 1.0;
            let mut last = limiter.position();
            while !limiter.at_rest() {
                ticks += 1.0;
                let q = limiter.hold_position(dt);
                assert!((step.position(ticks, dt) - q).abs() < 1e-12, "{velocity}: tick {ticks}");
                assert!((step.position(ticks - 0.5, dt) - 0.5 * (q + last)).abs() < 1e-12, "{velocity}: {ticks}");
                last = q;
            }
            assert!((ticks - step.ticks()).abs() <= 1.0 && step.position(1e9, dt) == step.position(ticks, dt));
        }
    }
}
