//! Conditions that end a motion before its goal: what the arm's sensor or an input says, a place of the path, a time.

use serde::{Deserialize, Serialize};

use crate::named::named;

named! {
    /// A kind of condition.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
    #[serde(rename_all = "snake_case")]
    pub enum Condition {
        /// The force at the arm's sensor or estimate [N].
        Force = "force",
        /// The torque there [Nm].
        Torque = "torque",
        /// The level of a digital input.
        Input = "input",
        /// The way that the tool has covered [m].
        Distance = "distance",
        /// The time since the motion began [s].
        Time = "time",
    }
}

impl Condition {
    /// Returns the unit of its value; empty for a level.
    pub fn unit(self) -> &'static str {
        match self {
            Self::Force => "N",
            Self::Torque => "Nm",
            Self::Input => "",
            Self::Distance => "m",
            Self::Time => "s",
        }
    }
}

/// What ends a motion before its goal: whichever comes first. `None`: not awaited.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Until {
    /// Index of the arm whose sensor and inputs count.
    pub arm: u16,
    /// Magnitude of the force [N].
    pub force: Option<f64>,
    /// Magnitude of the torque [Nm].
    pub torque: Option<f64>,
    /// Number of a digital input, and its level (`true`: high).
    pub input: Option<(u8, bool)>,
    /// Way that the tool has covered [m], and the time along the path at which it has [s].
    pub distance: Option<(f64, f64)>,
    /// Time since the motion began [s].
    pub time: Option<f64>,
}

/// What an arm feels: what conditions are compared with.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Sensed {
    /// Force and torque at its sensor [N, N, N, Nm, Nm, Nm], less what was tared; `None`: not known at present.
    pub wrench: Option<[f64; 6]>,
    /// Levels of its digital inputs: bit i is input i; `None`: not read.
    pub inputs: Option<u32>,
}

impl Until {
    /// Returns the condition that is met, and what was measured: N, Nm, 1 for high and 0 for low, m, s. An error is
    /// the condition that cannot be judged, because what it needs is not known. `elapsed` is the time along the path
    /// [s], `time` the time since the motion began [s].
    pub fn met(&self, sensed: &Sensed, elapsed: f64, time: f64) -> Result<Option<(Condition, f64)>, Condition> {
        let part = |first: usize| {
            let squares = sensed.wrench.map(|w| w.iter().skip(first).take(3).map(|value| value * value).sum::<f64>());
            squares.map(f64::sqrt).filter(|value| value.is_finite())
        };
        for (limit, first, condition) in [(self.force, 0, Condition::Force), (self.torque, 3, Condition::Torque)] {
            let Some(limit) = limit else { continue };
            let value = part(first).ok_or(condition)?;
            if value >= limit {
                return Ok(Some((condition, value)));
            }
        }
        if let Some((number, high)) = self.input {
            let levels = sensed.inputs.ok_or(Condition::Input)?;
            if (levels.checked_shr(number.into()).unwrap_or(0) & 1 != 0) == high {
                return Ok(Some((Condition::Input, f64::from(u8::from(high)))));
            }
        }
        if let Some((way, _)) = self.distance.filter(|(_, at)| elapsed >= *at) {
            return Ok(Some((Condition::Distance, way)));
        }
        Ok(self.time.filter(|limit| time >= *limit).map(|_| (Condition::Time, time)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_condition_that_is_met_ends_it_and_what_is_unknown_is_said() {
        let until = Until {
            force: Some(5.0),
            torque: Some(1.0),
            input: Some((3, false)),
            distance: Some((0.1, 2.0)),
            time: Some(9.0),
            ..Until::default()
        };
        let feels = |force, torque, inputs| Sensed {
            wrench: Some([0.6 * force, 0.0, -0.8 * force, torque, 0.0, 0.0]),
            inputs: Some(inputs),
        };
        let met = |sensed: &Sensed, elapsed, time| until.met(sensed, elapsed, time);
        assert_eq!(met(&feels(4.9, 0.9, 8), 1.9, 8.9), Ok(None));
        let (condition, value) = met(&feels(6.0, 0.0, 8), 0.0, 0.0).unwrap().unwrap();
        assert!(condition == Condition::Force && (value - 6.0).abs() < 1e-12);
        assert_eq!(met(&feels(0.0, -1.5, 8), 0.0, 0.0), Ok(Some((Condition::Torque, 1.5))));
        assert_eq!(met(&feels(0.0, 0.0, 0), 0.0, 0.0), Ok(Some((Condition::Input, 0.0))));
        assert_eq!(met(&feels(0.0, 0.0, 8), 2.0, 0.0), Ok(Some((Condition::Distance, 0.1))));
        assert_eq!(met(&feels(0.0, 0.0, 8), 0.0, 9.5), Ok(Some((Condition::Time, 9.5))));
        let unknown = [
            (Sensed { wrench: None, inputs: Some(8) }, Condition::Force),
            (Sensed { wrench: Some([f64::NAN; 6]), inputs: Some(8) }, Condition::Force),
            (Sensed { wrench: Some([0.0; 6]), inputs: None }, Condition::Input),
        ];
        for (sensed, condition) in unknown {
            assert_eq!(met(&sensed, 9.0, 9.0), Err(condition));
        }
    }
}
