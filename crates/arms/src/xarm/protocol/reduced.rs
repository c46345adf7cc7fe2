//! Reduced mode: limits that the controller keeps while it is on. Register 53 answers with the bytes that the report of
//! port 30002 has at its end: u8 on | 6 · i16 boundary [mm] | f32 [mm/s] | f32 [rad/s] | 14 · f32 ranges [rad] | u8
//! boundary on | u8. Firmware before 1.2.11 has the first 21 of them.

use super::take;

/// Length of the settings.
pub const LENGTH: usize = 79;

/// The settings of reduced mode, and whether it is on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reduced {
    /// Whether it is on.
    pub on: bool,
    /// Highest speed of the tool [mm/s].
    pub line_speed: f64,
    /// Highest speed of a joint [rad/s].
    pub joint_speed: f64,
    /// Lowest and highest position of each joint [rad]; older firmware does not report them.
    pub ranges: Option<[[f64; 2]; 7]>,
    /// Whether the tool must stay inside the safety boundary, also without reduced mode, alike.
    pub fence: Option<bool>,
}

impl Reduced {
    /// Decodes the settings; `None` if they are incomplete or cannot be believed.
    pub fn decode(data: &[u8]) -> Option<Self> {
        let [on @ 0..=1] = take::bytes(data, 0)? else { return None };
        let [line_speed, joint_speed] = take::floats(data, 13)?;
        let ranges = take::floats::<14>(data, 21).map(|values| {
            let mut ranges = [[0.0; 2]; 7];
            ranges.as_flattened_mut().copy_from_slice(&values);
            ranges
        });
        let fence = take::bytes(data, 77).map(|[on]| on == 1);
        Some(Self { on: on == 1, line_speed, joint_speed, ranges, fence })
    }
}
