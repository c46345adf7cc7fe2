//! Masses of a simulated arm: its joints sag under their weight as far as their position control lets them, and in
//! impedance mode they move as stiffness, damping and efforts make them.

use super::plant_joint::Joint;
use dimos_core::joint::Joints;

/// Viscous friction of a joint with masses [Nm·s/rad].
const FRICTION: f64 = 0.5;
/// Smaller changes of the sag are none: the joint is at rest [rad].
const SETTLED: f64 = 1e-9;

/// The masses of an arm.
#[derive(Debug, Clone, Copy)]
pub struct Masses {
    /// Returns the efforts that hold the joints against gravity at positions [rad or m]. Written apart from the
    /// program's own dynamics, so that a mistake which both share still shows.
    pub gravity: fn(&Joints) -> Joints,
    /// Inertia of each joint about its axis, that of its motor included [kg·m²].
    pub inertia: Joints,
    /// Stiffness of the arm's own position control [Nm/rad]; infinite: it has an integral part, and does not sag.
    pub stiffness: f64,
}

/// What drives a joint in impedance mode.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Drive {
    /// Position [rad] and velocity [rad/s] of its setpoint.
    pub position: f64,
    /// Velocity of its setpoint [rad/s].
    pub velocity: f64,
    /// Stiffness [Nm/rad].
    pub stiffness: f64,
    /// Damping [Nm·s/rad].
    pub damping: f64,
    /// Effort beside those [Nm].
    pub effort: f64,
}

impl Drive {
    /// Returns the effort of the motor of a joint at a position [rad] and velocity [rad/s].
    pub fn total(&self, position: f64, velocity: f64) -> f64 {
        self.stiffness * (self.position - position) + self.damping * (self.velocity - velocity) + self.effort
    }
}

impl Masses {
    /// Returns whether the arm sags under its own position control.
    pub(super) fn sags(&self) -> bool {
        self.stiffness.is_finite()
    }
}

impl Joint {
    /// Moves by forces for a step of `h` [s]: those of the drive, of friction, and of the weight, which `gravity` holds
    /// [Nm].
    pub(super) fn swing(&mut self, drive: &Drive, gravity: f64, inertia: f64, h: f64) {
        let free = drive.stiffness * (drive.position - self.position) + drive.damping * drive.velocity + drive.effort;
        // Damping and friction at the end of the step, which is stable however strong they are.
        let damped = (drive.damping + FRICTION) * h / inertia;
        self.velocity = (self.velocity + (free - gravity) * h / inertia) / (1.0 + damped);
        self.velocity = self.velocity.max(-self.velocity_max).min(self.velocity_max);
        self.travel(h);
    }

    /// Moves the place where the position control stops: below its target by what the weight takes, without the
    /// effort that is commanded beside it [Nm].
    pub(super) fn settle(&mut self, gravity: f64, effort: f64, stiffness: f64) {
        let sag = (effort - gravity) / stiffness;
        if (sag - self.sag).abs() > SETTLED {
            self.target = (self.target + sag - self.sag).max(self.lower).min(self.upper);
            self.sag = sag;
        }
    }
}
