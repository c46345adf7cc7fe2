//! Helpers shared by adapters.

use serde::{Deserialize, Deserializer};

use crate::adapter::{AdapterError, AdapterResult};
use crate::registry::AdapterConfig;

/// Copies the first values into `out`, which has one element per joint.
pub fn fill(out: &mut [f64], values: &[f64]) {
    out.iter_mut().zip(values).for_each(|(to, value)| *to = *value);
}

/// Returns the values of a command for N joints; `Rejected` unless there is one finite value per joint.
pub fn finite<const N: usize>(values: &[f64]) -> AdapterResult<[f64; N]> {
    match <[f64; N]>::try_from(values) {
        Ok(values) if values.iter().all(|value| value.is_finite()) => Ok(values),
        _ => Err(AdapterError::Rejected(format!("expected {N} finite values, one per joint"))),
    }
}

/// Returns a commanded value that is within its range; `Rejected` otherwise, with `what` it is and its unit.
pub fn within(what: &str, value: f64, (least, most): (f64, f64), unit: &str) -> AdapterResult<f64> {
    if (least..=most).contains(&value) {
        return Ok(value);
    }
    Err(AdapterError::Rejected(format!("{what} {value} {unit} is not within {least} to {most} {unit}")))
}

/// Reads an option that is a fraction above 0 and at most 1, for `#[serde(deserialize_with = "fraction")]`.
pub fn fraction<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    above_zero(deserializer, 1.0)
}

/// Reads an option above 0 and at most `max`.
pub fn above_zero<'de, D: Deserializer<'de>>(deserializer: D, max: f64) -> Result<f64, D::Error> {
    let value = f64::deserialize(deserializer)?;
    if value > 0.0 && value <= max {
        Ok(value)
    } else {
        Err(serde::de::Error::custom(format!("{value} is not above 0 and at most {max}")))
    }
}

/// Returns a device's error with its text.
pub fn fault(code: u16, text: &str) -> AdapterError {
    AdapterError::Fault { code: code.into(), text: text.to_owned() }
}

impl AdapterConfig {
    /// Parses the address; the error names the arm.
    pub fn parse_address<A>(&self, parse: impl FnOnce(&str) -> Result<A, String>) -> AdapterResult<A> {
        parse(&self.address).map_err(|e| AdapterError::Rejected(format!("{}: address: {e}", self.hardware_id)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn commands_have_a_finite_number_per_joint() {
        assert_eq!(finite::<2>(&[1.0, -2.0]), Ok([1.0, -2.0]));
        for bad in [&[1.0][..], &[1.0, 2.0, 3.0], &[1.0, f64::NAN], &[f64::INFINITY, 0.0]] {
            let error = finite::<2>(bad).unwrap_err().to_string();
            assert_eq!(error, "expected 2 finite values, one per joint", "{bad:?}");
        }
        let mut out = [9.0; 2];
        fill(&mut out, &[1.0, 2.0, 3.0]);
        assert_eq!(out, [1.0, 2.0]);
    }

    #[test]
    fn a_bad_address_names_the_arm() {
        let config = |address: &str| AdapterConfig {
            hardware_id: "left".into(),
            address: address.into(),
            dof: 6,
            options: serde_json::Value::Null,
        };
        let number = |text: &str| text.parse::<u16>().map_err(|e| e.to_string());
        assert_eq!(config("17").parse_address(number), Ok(17));
        let refused = config("x").parse_address(number).unwrap_err().to_string();
        assert!(refused.starts_with("left: address: invalid digit"), "{refused}");
    }
}
