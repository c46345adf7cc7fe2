//! Uses of logs: replay through the coordinator with comparison, or as a motion for arms.
//!
//! ```text
//! log ─▶ recorded (who ran) ─▶ inputs (tick by tick) ─▶ verify: Coordinator::tick ─▶ the same commands?
//!                           └▶ motion (what was commanded) ─▶ onto: a run of a blueprint that follows it
//!                                              └▶ retrace: the way back of an arm
//! ```

pub mod compare;
pub mod fit;
pub mod grips;
mod inputs;
pub mod motion;
pub mod onto;
pub mod recorded;
mod requests;
pub mod retrace;
pub mod verify;
pub mod what_if;
