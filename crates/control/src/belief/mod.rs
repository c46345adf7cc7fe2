//! What is believed of an arm's readings: which are accepted, how old they are, whether the arm rests, and whether it
//! follows its setpoints. Nothing else in the program decides that.
//!
//! ```text
//! reading ─▶ plausibility (step, turns, range) ─▶ agreement (position and velocity) ─▶ accepted state ─▶ tracking
//! ```

mod agreement;
mod estimate;
pub mod feedback;
pub mod plausibility;
pub mod setpoints;
pub mod stalls;
mod stillness;
pub mod tracking;
