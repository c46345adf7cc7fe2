//! The types of tasks.

pub mod cartesian;
pub mod end_effector;
pub mod servo;
pub mod trajectory;
pub mod velocity;
