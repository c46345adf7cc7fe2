//! The robots in the box: descriptions written for this project from published dimensions and limits, with shapes
//! made of primitives.

/// What marks the name of one of them in place of a path: `builtin:xarm6`.
pub const PREFIX: &str = "builtin:";

macro_rules! robots {
    ($($name:literal),*) => {
        /// Their names.
        pub const NAMES: &[&str] = &[$($name),*];

        /// The URDF of one.
        pub fn text(name: &str) -> Option<&'static str> {
            match name {
                $($name => Some(include_str!(concat!("../../assets/robots/", $name, ".urdf"))),)*
                _ => None,
            }
        }
    };
}

robots!(
    "lite6",
    "lite6_gripper",
    "piper",
    "piper_gripper",
    "xarm5",
    "xarm5_gripper",
    "xarm6",
    "xarm6_gripper",
    "xarm7",
    "xarm7_gripper",
    "xarm850",
    "xarm850_gripper",
    "yourarm",
    "yourarm_gripper"
);
