//! What simulated arms share: a joint plant that moves, and a script of the faults they play.

pub mod faults;
pub mod plant;
