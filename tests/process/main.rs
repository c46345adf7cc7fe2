//! The program as users have it: the real binary, whole runs, one beside another.

#[path = "../support/mod.rs"]
mod support;

mod adapter_emulate;
mod adapter_new;
mod adapter_test;
mod adding_an_arm;
#[cfg(feature = "fetch")]
mod assets;
mod back_out;
mod built_in_arms;
mod changed_world;
mod cli_verbs;
mod daemon;
mod device_clock;
mod disk;
mod fault_table;
mod first_run;
mod franka_run;
mod grip_outcome;
mod gripper_force;
mod gripper_joint;
mod jobs;
mod jog;
mod joint_status;
#[cfg(target_arch = "x86_64")]
mod kernels;
mod leader_follower;
mod leases;
mod library;
mod log_verbs;
mod onto;
mod orders;
mod packages;
mod park;
mod payload;
mod planned_log;
mod planner_arms;
mod planner_attach;
mod planner_faults;
mod planner_run;
mod planner_world;
mod poses;
mod python_client;
mod python_dimos;
mod readers;
mod remote_peers;
mod remote_shim;
mod ros;
mod ros2;
mod rpc_page;
mod share;
mod share_again;
mod share_faults;
mod share_tls;
mod share_verbs;
mod small_verbs;
mod so101_service;
mod start_stages;
mod stop_input;
mod stops;
mod superseded;
mod teach;
mod ur_runs;
#[cfg(feature = "view")]
mod view;
mod waypoints;
mod xarm_runs;
