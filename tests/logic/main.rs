//! What needs no process, no vendor's program and no real time: the coordinator on a virtual clock, blueprints, models,
//! plans, adapters against their emulators in memory or on this computer's ports.

#[path = "../support/mod.rs"]
mod support;

#[global_allocator]
static ALLOCATOR: dimos::rt::counting::Counting = dimos::rt::counting::Counting;

mod adding_a_task;
mod arm_led;
mod arm_phases;
mod blueprint_fuzz;
mod blueprint_one_mistake;
mod blueprint_reference;
mod blueprint_registry;
mod blueprints;
mod braking;
mod can_bus;
mod cartesian_tasks;
mod checked_models;
mod chunks;
mod conformance;
mod conformance_finds_faults;
mod conformance_pushed;
mod coordinator;
mod curves;
mod device_speed;
mod device_stops;
mod device_streams;
mod dynamics;
mod english;
mod faults;
mod follow;
mod follow_ends;
mod gaps;
mod guard;
mod guards_virtual;
mod help;
mod host_stalls;
mod interruptions;
mod kinematics;
mod layering;
mod lies;
mod log_storage;
mod long_log;
mod model;
mod model_forms;
mod model_verbs;
mod no_alloc;
mod older_logs;
mod pages;
mod path_rules;
mod pauses;
mod peripherals;
mod piper_rest;
mod planned_paths;
mod planning;
mod planning_timing;
mod poses;
mod recorded_streams;
mod relief;
mod robot_models;
mod rpc;
mod speed_override;
mod start_rules;
mod surface;
mod task_conformance;
mod templates;
mod test_support;
mod tick_rules;
mod tool_line;
mod tool_speed;
mod verified;
mod verify;
mod verify_runs;
mod way_blocked;
mod xacro;
mod yaml_reader;
