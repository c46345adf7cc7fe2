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
mod clearances;
mod cli_verbs;
mod crate_examples;
mod daemon;
#[cfg(feature = "view")]
mod demo;
mod device_clock;
mod disk;
mod endless_files;
mod escapes;
mod fault_table;
mod first_day;
mod first_run;
mod foreign_logs;
mod foreign_paths;
#[cfg(feature = "view")]
mod foxglove;
mod franka_run;
mod go;
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
mod metrics;
mod moved_by_others;
mod new;
mod onto;
mod orders;
mod other_machine;
mod packages;
mod page_commands;
mod park;
mod payload;
mod planned_log;
mod planner_arms;
mod planner_attach;
mod planner_faults;
mod planner_run;
mod planner_world;
mod poses;
mod proxy_clients;
mod python_client;
mod python_dimos;
mod python_run;
mod readers;
mod readme;
mod remote_peers;
mod remote_shim;
mod ros;
mod rpc_page;
mod runs_found;
mod share;
mod share_again;
mod share_faults;
mod share_tls;
mod share_verbs;
mod small_verbs;
mod so101_line;
mod so101_service;
mod speed;
mod split_logs;
mod start_stages;
mod starved_tick;
mod stop_input;
mod stop_places;
mod stops;
mod superseded;
mod teach;
mod top;
mod units;
mod ur_runs;
#[cfg(feature = "view")]
mod view;
mod waypoints;
mod who;
mod xarm_runs;
