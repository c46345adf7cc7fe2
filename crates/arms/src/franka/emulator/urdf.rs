//! The robot's description, as far as clients use it: joints with their limits, and what libfranka computes its model
//! from: masses, and frames under the names that it looks for, the last of them `link8` at the flange.

use std::fmt::Write;

use crate::franka::model::{JointRange, Model};

/// A link: mass [kg], centre of mass [m], inertia about it: xx, xy, xz, yy, yz, zz [kg·m²].
type Link = (f64, [f64; 3], [f64; 6]);

/// The links of an FR3 from the base on, as its vendor publishes them (franka_description, Apache-2.0; rounded).
const LINKS: [Link; 8] = [
    (2.3966, [-0.0172, 0.0004, 0.0745], [0.0090, 0.0, 0.0020, 0.0115, 0.0, 0.0085]),
    (2.927465, [4.1e-7, -0.018125, -0.038604], [0.023927, 1.3318e-5, -1.1405e-4, 0.022482, -0.0019950, 0.0063501]),
    (2.935537, [0.003183, -0.074322, 0.008815], [0.041939, 2.0257e-4, 0.0040778, 0.025145, -0.0042252, 0.061702]),
    (2.244901, [0.040702, -0.004820, -0.028973], [0.024101, 0.0024047, -0.0028563, 0.019741, -0.0021042, 0.019044]),
    (2.615596, [-0.045910, 0.063049, -0.008519], [0.034530, 0.013226, 0.010151, 0.028882, -9.7628e-4, 0.041255]),
    (2.327121, [-0.001604, 0.029254, -0.097297], [0.051610, -0.0057152, -0.0035673, 0.047877, 0.010674, 0.016424]),
    (1.817038, [0.059713, -0.041029, -0.010169], [0.0054123, 0.0061935, 0.0014219, 0.014058, -0.0013141, 0.016081]),
    (0.627143, [0.004523, 0.008626, -0.016163], [2.1092e-4, -2.4333e-5, 4.5645e-5, 1.7719e-4, 8.7441e-5, 5.9932e-5]),
];

/// Writes the description of a robot.
pub(super) fn of(name: &str, ranges: &[JointRange]) -> String {
    let mut text = format!("<?xml version=\"1.0\"?>\n<robot name=\"{name}\">\n");
    for (i, link) in LINKS.iter().enumerate() {
        write_link(&mut text, i, link);
    }
    for (i, range) in ranges.iter().enumerate() {
        let (joint, (offset, deceleration)) = (i + 1, range.braking.unwrap_or_default());
        let JointRange { lower, upper, velocity, .. } = range;
        let origin = Model::link(i, 0.0).unwrap_or_default();
        let ([x, y, z], (roll, pitch, yaw)) = (origin.translation.vector.into(), origin.rotation.euler_angles());
        let (x, y, z): (f64, f64, f64) = (x, y, z);
        let _ = writeln!(
            text,
            "<joint name=\"joint{joint}\" type=\"revolute\">\n<origin xyz=\"{x} {y} {z}\" rpy=\"{roll} {pitch} {yaw}\"/>\n\
             <parent link=\"link{i}\"/>\n<child link=\"link{joint}\"/>\n<axis xyz=\"0 0 1\"/>\n<limit effort=\"87\" \
             lower=\"{lower}\" upper=\"{upper}\" velocity=\"{velocity}\"/>\n<position_based_velocity_limits \
             velocity_offset=\"{offset}\" deceleration_limit=\"{deceleration}\"/>\n</joint>"
        );
    }
    let flange = Model::FLANGE;
    text + &format!(
        "<link name=\"link8\"/>\n<joint name=\"joint8\" type=\"fixed\">\n<origin xyz=\"0 0 {flange}\" rpy=\"0 0 0\"/>\n\
         <parent link=\"link7\"/>\n<child link=\"link8\"/>\n</joint>\n</robot>\n"
    )
}

fn write_link(text: &mut String, number: usize, (mass, [x, y, z], [xx, xy, xz, yy, yz, zz]): &Link) {
    let _ = writeln!(
        text,
        "<link name=\"link{number}\">\n<inertial>\n<origin xyz=\"{x} {y} {z}\" rpy=\"0 0 0\"/>\n<mass value=\"{mass}\"/>\n\
         <inertia ixx=\"{xx}\" ixy=\"{xy}\" ixz=\"{xz}\" iyy=\"{yy}\" iyz=\"{yz}\" izz=\"{zz}\"/>\n</inertial>\n</link>"
    );
}
