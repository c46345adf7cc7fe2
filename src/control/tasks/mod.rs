//! The types of tasks.

pub mod servo;
pub mod trajectory;
pub mod velocity;
