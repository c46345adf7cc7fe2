//! The robot's description, as far as clients use it: joints with their limits.

use std::fmt::Write;

use crate::hardware::arms::franka::model::JointRange;

/// Writes the description of a robot.
pub(super) fn of(name: &str, ranges: &[JointRange]) -> String {
    let mut text = format!("<?xml version=\"1.0\"?>\n<robot name=\"{name}\">\n<link name=\"link0\"/>\n");
    for (i, range) in ranges.iter().enumerate() {
        let (joint, (offset, deceleration)) = (i + 1, range.braking.unwrap_or_default());
        let JointRange { lower, upper, velocity, .. } = range;
        let _ = writeln!(
            text,
            "<link name=\"link{joint}\"/>\n<joint name=\"joint{joint}\" type=\"revolute\">\n<parent link=\"link{i}\"/>\n\
             <child link=\"link{joint}\"/>\n<axis xyz=\"0 0 1\"/>\n<limit effort=\"87\" lower=\"{lower}\" \
             upper=\"{upper}\" velocity=\"{velocity}\"/>\n<position_based_velocity_limits velocity_offset=\"{offset}\" \
             deceleration_limit=\"{deceleration}\"/>\n</joint>"
        );
    }
    text + "</robot>\n"
}
