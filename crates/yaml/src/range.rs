//! Numbers that are checked where they enter. Used as `deserialize_with`, so that fields stay plain numbers and the
//! mistake is shown at the number.

use serde::de::{Deserialize, Deserializer, Error};

/// The lowest and highest control rate [Hz].
pub const TICK_RATE: (f64, f64) = (1.0, 2000.0);

fn number<'de, D: Deserializer<'de>>(d: D, wanted: &str, good: fn(f64) -> bool) -> Result<f64, D::Error> {
    let value = f64::deserialize(d)?;
    if !value.is_finite() || !good(value) {
        return Err(D::Error::custom(format!("{value} is out of range\nhint: give {wanted}")));
    }
    Ok(value)
}

/// A control rate.
pub fn tick_rate<'de, D: Deserializer<'de>>(d: D) -> Result<f64, D::Error> {
    number(d, "a rate from 1 to 2000 Hz", |v| (TICK_RATE.0..=TICK_RATE.1).contains(&v))
}

/// Zero or more.
pub fn non_negative<'de, D: Deserializer<'de>>(d: D) -> Result<f64, D::Error> {
    number(d, "0 or more", |v| v >= 0.0)
}

/// More than zero.
pub fn positive<'de, D: Deserializer<'de>>(d: D) -> Result<f64, D::Error> {
    number(d, "a number above 0", |v| v > 0.0)
}

/// More than zero, where it is given.
pub fn maybe_positive<'de, D: Deserializer<'de>>(d: D) -> Result<Option<f64>, D::Error> {
    positive(d).map(Some)
}

/// A delay of an arm [s], where it is given.
pub fn maybe_lag<'de, D: Deserializer<'de>>(d: D) -> Result<Option<f64>, D::Error> {
    number(d, "a time from 0 to 1 s", |v| (0.0..=1.0).contains(&v)).map(Some)
}

/// An age limit of states [s], where it is given.
pub fn maybe_age<'de, D: Deserializer<'de>>(d: D) -> Result<Option<f64>, D::Error> {
    number(d, "a time from 0.02 to 2 s", |v| (0.02..=2.0).contains(&v)).map(Some)
}
