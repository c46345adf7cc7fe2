//! Versions of URDF, and what an older one ignores. By the rules of urdfdom, which ROS and Pinocchio use.

use super::Reader;
use crate::xml::Element;
use dimos_yaml::{Diag, quote};

/// The highest minor number that is known.
const NEWEST: u32 = 2;

/// Returns the minor number of a description's version, 1.0 to 1.2; 0 without one. From 1.1 on quaternions count, from
/// 1.2 on limits need both ends, but neither velocity nor effort.
pub fn version(root: &Element) -> Result<u32, String> {
    let Some(version) = root.attribute("version") else { return Ok(0) };
    // As strtoul: blanks and a sign may precede each number, nothing may follow.
    let number = |text: &str| text.trim_start().trim_start_matches('+').parse::<u32>().ok();
    let numbers = version.value.split_once('.').map(|(major, minor)| (number(major), number(minor)));
    match numbers {
        Some((Some(1), Some(minor))) if minor <= NEWEST => Ok(minor),
        _ => Err(format!("unknown version {} of URDF", quote(&version.value))),
    }
}

impl Reader<'_> {
    /// Reports once what else would be said of every joint: quaternions without effect, and soft limits with one.
    pub(super) fn report_what_differs(&mut self) {
        if let [first, ..] = *self.quaternions {
            let what = match self.quaternions.len() {
                1 => "`quat_xyzw` is ignored: it counts from version 1.1 on".to_owned(),
                all => format!("`quat_xyzw` is ignored in {all} origins: it counts from version 1.1 on"),
            };
            let hint = "write <robot name=\"…\" version=\"1.1\">, or give `rpy`";
            self.report(first, Diag::warning(what).hint(hint));
        }
        if let [(first, _), ..] = *self.narrowed {
            let ranges: Vec<&str> = self.narrowed.iter().map(|(_, range)| range.as_str()).collect();
            let what = format!("soft limits (`safety_controller`) narrow {}", ranges.join(", "));
            self.report(first, Diag::warning(what).hint("motions keep to the narrower limits, as in MoveIt"));
        }
    }
}
