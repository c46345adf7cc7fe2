//! Built-in robots: descriptions written for this project from published dimensions and limits, with primitive shapes.

use std::sync::OnceLock;

/// Prefix of a built-in robot's name in place of a path: `builtin:xarm6`.
pub const PREFIX: &str = "builtin:";

macro_rules! robots {
    ($($name:literal),* $(,)?) => {
        /// Names of the robots shipped with this crate.
        pub const NAMES: &[&str] = &[$($name),*];
        const TEXTS: &[&str] =
            &[$(include_str!(concat!(env!("CARGO_MANIFEST_DIR"), "/robots/", $name, ".urdf"))),*];
    };
}

robots!(
    "fer",
    "fr3",
    "lite6",
    "lite6_gripper",
    "piper",
    "piper_gripper",
    "so101",
    "ur5e",
    "xarm5",
    "xarm5_gripper",
    "xarm6",
    "xarm6_gripper",
    "xarm7",
    "xarm7_gripper",
    "xarm850",
    "xarm850_gripper",
    "yourarm",
    "yourarm_gripper",
);

/// Robots added by a program that embeds this crate.
static EMBEDDED: OnceLock<Vec<(&str, &str)>> = OnceLock::new();

/// Adds named descriptions, which win over the shipped ones. Call it once, first thing in `main`.
pub fn embed(more: Vec<(&'static str, &'static str)>) {
    let _ = EMBEDDED.set(more);
}

fn more() -> impl Iterator<Item = (&'static str, &'static str)> {
    EMBEDDED.get().into_iter().flatten().copied()
}

/// Returns the URDF of a built-in or embedded robot.
pub fn text(name: &str) -> Option<&'static str> {
    let shipped = || NAMES.iter().copied().zip(TEXTS.iter().copied());
    more().chain(shipped()).find(|(own, _)| *own == name).map(|(_, text)| text)
}

/// Returns all names, shipped and embedded.
pub fn names() -> impl Iterator<Item = &'static str> {
    NAMES.iter().copied().chain(more().map(|(name, _)| name))
}
