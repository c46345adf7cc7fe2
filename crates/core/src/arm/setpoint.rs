//! A setpoint of all joints as an adapter gets it, and what an arm takes of it.

use serde::{Deserialize, Serialize};

use crate::clock::Mono;
use crate::joint::{ControlMode, Joints, MAX_DOF};

/// A setpoint of all joints. What is `None` is not commanded: it is never zero.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Setpoint {
    /// Positions [rad or m].
    pub position: Joints,
    /// Velocities of the setpoints at that time [rad/s or m/s].
    pub velocity: Joints,
    /// Accelerations of the setpoints at that time [rad/s² or m/s²].
    pub acceleration: Option<Joints>,
    /// Efforts [Nm or N] that the arm adds to those of its own control; in impedance mode to those of stiffness and
    /// damping.
    pub effort: Option<Joints>,
    /// Stiffness of the joints [Nm/rad or N/m], in impedance mode.
    pub stiffness: Option<Joints>,
    /// Damping of the joints [Nm·s/rad or N·s/m], in impedance mode.
    pub damping: Option<Joints>,
    /// The mode that it is for.
    pub mode: ControlMode,
    /// Time of the tick that made it.
    pub at: Mono,
    /// The arm should have another one by this time; beyond it the arm does what its row says of gaps.
    pub expires: Option<Mono>,
}

impl Setpoint {
    /// Creates a setpoint at rest, without anything but positions [rad or m].
    pub fn new(mode: ControlMode, position: Joints, at: Mono) -> Self {
        let (velocity, nothing) = ([0.0; MAX_DOF], None);
        Self {
            position,
            velocity,
            acceleration: nothing,
            effort: nothing,
            stiffness: nothing,
            damping: nothing,
            mode,
            at,
            expires: None,
        }
    }

    /// Returns how long it holds from its tick on [s]; `None`: until the next one.
    pub fn valid_for(&self) -> Option<f64> {
        self.expires.map(|expires| expires.seconds_since(self.at))
    }
}

/// Whether an arm is given a field of setpoints.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Field {
    /// It is.
    Taken,
    /// The vendor's interface has no such field: where that is written, a phrase without full stop.
    Refused(&'static str),
    /// The vendor's interface may have it, and the adapter does not hand it on: why, a phrase without full stop.
    Withheld(&'static str),
}

impl Field {
    /// Returns whether the arm is given it.
    pub fn is_taken(self) -> bool {
        self == Self::Taken
    }

    /// Returns why the arm is not given it: `refused: …`, or `refused by dimos: …`.
    pub fn objection(self) -> Option<String> {
        match self {
            Self::Taken => None,
            Self::Refused(source) => Some(format!("refused: {source}")),
            Self::Withheld(why) => Some(format!("refused by dimos: {why}")),
        }
    }
}

/// What an arm is given of a setpoint besides positions and mode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SetpointFields {
    /// Velocities.
    pub velocity: Field,
    /// Accelerations.
    pub acceleration: Field,
    /// Efforts.
    pub effort: Field,
    /// Stiffness.
    pub stiffness: Field,
    /// Damping.
    pub damping: Field,
    /// The time of the tick.
    pub at: Field,
    /// When it expires.
    pub expires: Field,
}

impl SetpointFields {
    /// All of it.
    pub const ALL: Self = Self::each_as(Field::Taken);

    /// Returns fields that are all alike.
    pub const fn each_as(field: Field) -> Self {
        Self {
            velocity: field,
            acceleration: field,
            effort: field,
            stiffness: field,
            damping: field,
            at: field,
            expires: field,
        }
    }

    /// Returns the fields with their names.
    pub fn named(&self) -> [(&'static str, Field); 7] {
        [
            ("velocity", self.velocity),
            ("acceleration", self.acceleration),
            ("effort", self.effort),
            ("stiffness", self.stiffness),
            ("damping", self.damping),
            ("at", self.at),
            ("expires", self.expires),
        ]
    }
}

impl Default for SetpointFields {
    fn default() -> Self {
        Self::each_as(Field::Withheld("its adapter does not say that it hands this on"))
    }
}

/// How stiffly an arm holds its joints in impedance mode where no task says so, and what it takes at most.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Impedance {
    /// Stiffness with which it holds [Nm/rad or N/m].
    pub stiffness: Joints,
    /// Damping with which it holds [Nm·s/rad or N·s/m].
    pub damping: Joints,
    /// Highest stiffness [Nm/rad or N/m].
    pub stiffness_max: Joints,
    /// Highest damping [Nm·s/rad or N·s/m].
    pub damping_max: Joints,
}

impl Impedance {
    /// The same for all joints: stiffness and damping with which they are held, and the highest of both.
    pub const fn uniform((stiffness, damping): (f64, f64), (stiffness_max, damping_max): (f64, f64)) -> Self {
        Self {
            stiffness: [stiffness; MAX_DOF],
            damping: [damping; MAX_DOF],
            stiffness_max: [stiffness_max; MAX_DOF],
            damping_max: [damping_max; MAX_DOF],
        }
    }
}

/// Highest efforts of an arm's joints, and how fast they may change.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct EffortLimits {
    /// Highest efforts [Nm or N].
    pub max: Joints,
    /// Highest change of efforts [Nm/s or N/s].
    pub rate: Joints,
}

impl EffortLimits {
    /// Default of `rate`, as a part of the highest effort per second: all of it within 0.1 s.
    pub const RATE: f64 = 10.0;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_field_that_is_not_taken_says_whose_refusal_that_is() {
        let fields = SetpointFields {
            effort: Field::Refused("manual, chapter 3"),
            damping: Field::Withheld("not written yet"),
            ..SetpointFields::ALL
        };
        let objections = fields.named().map(|(name, field)| (name, field.objection()));
        assert_eq!(objections[2], ("effort", Some("refused: manual, chapter 3".to_owned())));
        assert_eq!(objections[4], ("damping", Some("refused by dimos: not written yet".to_owned())));
        assert!(objections.iter().filter(|(_, objection)| objection.is_none()).count() == 5);
        assert!(SetpointFields::default().named().iter().all(|(_, field)| !field.is_taken()));
    }

    #[test]
    fn a_setpoint_of_positions_commands_nothing_else() {
        let mut setpoint = Setpoint::new(ControlMode::ServoPosition, [0.1; MAX_DOF], Mono(5));
        assert_eq!((setpoint.effort, setpoint.stiffness, setpoint.valid_for()), (None, None, None));
        setpoint.expires = Some(Mono(20_000_005));
        assert_eq!(setpoint.valid_for(), Some(0.02));
    }
}
