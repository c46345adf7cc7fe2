//! What several tests share. Each test binary compiles all of it and uses a part.

#![allow(dead_code, reason = "each test binary uses a part")]

pub mod arm_rows;
pub mod arm_traits;
pub mod busy;
pub mod cable;
pub mod certificates;
pub mod crates;
pub mod delegate;
pub mod fake_arms;
pub mod fake_run;
pub mod file_server;
pub mod gap_arm;
pub mod guarded;
pub mod lies;
pub mod loopback;
pub mod motion_judge;
pub mod network;
pub mod pause_run;
pub mod program;
pub mod python;
pub mod python_dimos;
pub mod recorded;
pub mod rig;
pub mod ros;
pub mod scripted;
pub mod shared;
pub mod sim_arm;
pub mod skip;
pub mod tampered;
pub mod terminal;
pub mod trial;
pub mod trial_script;
pub mod trial_setup;
pub mod true_arm;
pub mod uml;
pub mod usage;
pub mod virtual_run;
pub mod wire;
pub mod wrapped;
