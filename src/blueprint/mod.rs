//! Blueprints: YAML files that define the arms, tasks, planner and log of a run.
//!
//! ```text
//! name ─▶ registry (which file) ─▶ load (includes, --set, --sim) ─▶ schema (as written) ─▶ resolve (checked, indices)
//!                                     └────────── every mistake with its position: Loaded::render ───────────┘
//! ```

mod arms;
mod assets;
mod catalog;
mod endpoints;
mod feed_forward;
mod include;
mod json_schema;
mod limits;
mod load;
mod park;
mod parts;
mod peripherals;
mod physics;
pub mod planner;
mod planner_check;
mod planner_files;
mod planner_models;
mod registry;
mod resolve;
mod ros;
pub mod schema;
pub mod share;
pub mod size;
mod summary;
mod task_leaders;
mod task_pos;
mod task_robots;
mod tasks;
mod tick_clock;
mod tool_speed;

pub use catalog::Catalog;
pub use dimos_control::task_spec::{TaskSpec, TaskTable};
pub use endpoints::{FoxgloveConfig, MetricsConfig, WebOrigin};
pub use json_schema::{full_schema, json_schema};
pub use limits::{JointOverride, LimitsEntry};
pub use load::{Loaded, Overrides, load, load_from};
pub use parts::{InputLevel, MountingEntry, PayloadEntry, StopInputEntry};
pub use peripherals::{ArmPeripheral, PeripheralEntry};
pub use registry::{FindError, Found, Listing, SearchPath, Source, embed, find, list, names};
pub use resolve::{Arm, Blueprint, Task, TaskRobot, UsedAsset};
pub use schema::{Compression, CoordinatorConfig, GuardConfig, OnExit, RecordingConfig, RpcConfig};
pub use summary::{ArmSummary, JointSummary, Limit, Origin, PeripheralSummary, Summary, TaskSummary};
pub use tick_clock::TickClock;
pub use tool_speed::ToolRobot;
