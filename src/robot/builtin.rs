//! The robots in the box: descriptions written for this project from published dimensions and limits, with shapes
//! made of primitives.

use std::sync::OnceLock;

/// What marks the name of one of them in place of a path: `builtin:xarm6`.
pub const PREFIX: &str = "builtin:";

macro_rules! robots {
    ($($name:literal),*) => {
        /// The names of those in the box.
        pub const NAMES: &[&str] = &[$($name),*];

        fn shipped(name: &str) -> Option<&'static str> {
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

/// Those that the program which embeds this crate brings along.
static MORE: OnceLock<Vec<(&str, &str)>> = OnceLock::new();

/// Lets the names of `more` stand for their texts, before those in the box. For `main`, once, before anything else.
pub fn embed(more: Vec<(&'static str, &'static str)>) {
    let _ = MORE.set(more);
}

fn more() -> impl Iterator<Item = (&'static str, &'static str)> {
    MORE.get().into_iter().flatten().copied()
}

/// The URDF of one, in the box or brought along.
pub fn text(name: &str) -> Option<&'static str> {
    more().find(|(own, _)| *own == name).map(|(_, text)| text).or_else(|| shipped(name))
}

/// All names, those in the box and those brought along.
pub fn names() -> impl Iterator<Item = &'static str> {
    NAMES.iter().copied().chain(more().map(|(name, _)| name))
}
