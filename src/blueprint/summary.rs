//! Summary of a blueprint for `dimos check`: arms, joint limits with their origins, tasks.

use serde::Serialize;
use serde_json::Value;

use crate::blueprint::peripherals::ArmPeripheral;
use crate::blueprint::resolve::{Arm, Blueprint};
use crate::blueprint::schema::{CoordinatorConfig, OnExit};
use dimos_core::joint::{DEFAULT_ACCELERATION, DEFAULT_JERK};
use dimos_core::named::named;

named! {
    /// Origin of a value.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
    #[serde(rename_all = "lowercase")]
    pub enum Origin {
        /// The adapter states it.
        Adapter = "adapter",
        /// The blueprint sets it.
        Blueprint = "blueprint",
        /// Neither of them sets it.
        Default = "default",
    }
}

/// A limit and its origin.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Limit {
    /// The limit; its unit is that of the field.
    pub value: f64,
    /// Origin.
    pub from: Origin,
}

/// A joint and its effective limits.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct JointSummary {
    /// Its name.
    pub name: String,
    /// Lowest position [rad]; absent if neither adapter nor blueprint states one.
    pub position_lower: Option<Limit>,
    /// Highest position [rad].
    pub position_upper: Option<Limit>,
    /// Highest speed [rad/s].
    pub velocity: Option<Limit>,
    /// Highest acceleration [rad/s²].
    pub acceleration: Limit,
    /// Highest jerk [rad/s³].
    pub jerk: Limit,
}

/// A gripper or a sensor with its own connection.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PeripheralSummary {
    /// The part of the arm that it is: `gripper` or `force_torque`.
    pub part: &'static str,
    /// The adapter's name.
    pub adapter: String,
    /// Address.
    pub address: String,
    /// Whether it is an emulator.
    pub simulated: bool,
}

/// An arm.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ArmSummary {
    /// Its name.
    pub hardware_id: String,
    /// The adapter's name.
    pub adapter: String,
    /// Level to which the adapter has been proven.
    pub level: String,
    /// Address; empty if none is needed.
    pub address: String,
    /// Whether it is an emulator.
    pub simulated: bool,
    /// Whether the motors are enabled at the start.
    pub auto_enable: bool,
    /// What happens to the motors at the end.
    pub on_exit: OnExit,
    /// Origin of `on_exit`.
    pub on_exit_from: Origin,
    /// Where the arm goes before its motors are disabled [rad]; empty if it does not.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub park_pose: Vec<f64>,
    /// Whether the arm keeps its pose when its motors are disabled.
    pub holds_when_disabled: bool,
    /// Highest speed of its tool [m/s]; absent if neither its manual nor the blueprint limits that.
    pub tcp_velocity: Option<Limit>,
    /// Whether a model of the arm is known, so that this limit is kept.
    pub tcp_velocity_is_kept: bool,
    /// Its gripper and its sensor, where they have their own connections.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub peripherals: Vec<PeripheralSummary>,
    /// Its joints.
    pub joints: Vec<JointSummary>,
}

/// A task.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TaskSummary {
    /// Its name.
    pub name: String,
    /// Its type.
    #[serde(rename = "type")]
    pub kind: String,
    /// Its parameters, defaults filled in.
    pub params: Value,
    /// The joints it commands.
    pub joints: Vec<String>,
    /// The arms of these joints.
    pub arms: Vec<String>,
    /// Priority: the higher number wins a joint.
    pub priority: i32,
    /// Whether it is started with the run.
    pub auto_start: bool,
}

/// Summary of a blueprint.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Summary {
    /// Its name.
    pub name: String,
    /// Its description.
    pub description: String,
    /// The files it was read from, the main one first.
    pub files: Vec<String>,
    /// The control loop.
    pub coordinator: CoordinatorConfig,
    /// The arms.
    pub arms: Vec<ArmSummary>,
    /// The tasks.
    pub tasks: Vec<TaskSummary>,
    /// Names of the planning robots.
    pub planner_robots: Vec<String>,
}

impl Summary {
    /// Creates the summary of a blueprint.
    pub fn of(blueprint: &Blueprint) -> Self {
        let joints = blueprint.joint_names();
        let tasks = blueprint.tasks.iter().map(|task| TaskSummary {
            name: task.name.clone(),
            kind: task.spec.name.to_owned(),
            params: task.params.clone(),
            joints: task.joints.iter().filter_map(|i| joints.get(*i)).map(|j| (*j).to_owned()).collect(),
            arms: task.arms.iter().filter_map(|i| blueprint.arms.get(*i)).map(|a| a.hardware_id.clone()).collect(),
            priority: task.priority,
            auto_start: task.auto_start,
        });
        let robots = blueprint.planner.iter().flat_map(|p| p.robots.iter().map(|r| r.name.clone()));
        Self {
            name: blueprint.name.clone(),
            description: blueprint.description.clone(),
            files: blueprint.sources.iter().map(|(name, _)| name.clone()).collect(),
            coordinator: blueprint.coordinator.clone(),
            arms: blueprint.arms.iter().map(arm).collect(),
            tasks: tasks.collect(),
            planner_robots: robots.collect(),
        }
    }
}

fn arm(arm: &Arm) -> ArmSummary {
    ArmSummary {
        hardware_id: arm.hardware_id.clone(),
        adapter: arm.adapter_type.clone(),
        level: arm.adapter.level.name().to_owned(),
        address: arm.address.clone(),
        simulated: !arm.is_real(),
        auto_enable: arm.auto_enable,
        on_exit: arm.on_exit,
        on_exit_from: if arm.on_exit_given { Origin::Blueprint } else { Origin::Default },
        park_pose: arm.park_pose.clone(),
        holds_when_disabled: arm.adapter.holds_when_disabled,
        tcp_velocity: arm.tcp_velocity.map(|value| Limit {
            value,
            from: if arm.tool.velocity == Some(value) { Origin::Adapter } else { Origin::Blueprint },
        }),
        tcp_velocity_is_kept: matches!(arm.tool_limit(), Ok(Some(_))),
        peripherals: arm.peripherals.iter().map(peripheral).collect(),
        joints: (0..arm.joints.len()).map(|joint| joint_summary(arm, joint)).collect(),
    }
}

fn peripheral(own: &ArmPeripheral) -> PeripheralSummary {
    PeripheralSummary {
        part: own.row.part.name(),
        adapter: own.row.name.to_owned(),
        address: own.address.clone(),
        simulated: own.is_simulated(),
    }
}

fn joint_summary(arm: &Arm, joint: usize) -> JointSummary {
    let own = &arm.own_limits;
    let given = arm.limits.get(joint).copied().unwrap_or_default();
    let pick = |given: Option<f64>, own: &[f64]| {
        let own = own.get(joint).map(|value| Limit { value: *value, from: Origin::Adapter });
        given.map(|value| Limit { value, from: Origin::Blueprint }).or(own)
    };
    let or = |limit: Option<Limit>, value: f64| limit.unwrap_or(Limit { value, from: Origin::Default });
    JointSummary {
        name: arm.joints.get(joint).cloned().unwrap_or_default(),
        position_lower: pick(given.position_lower, &own.position_lower),
        position_upper: pick(given.position_upper, &own.position_upper),
        velocity: pick(given.velocity, &own.velocity_max),
        acceleration: or(pick(given.acceleration, &own.acceleration_max), DEFAULT_ACCELERATION),
        jerk: or(pick(given.jerk, &own.jerk_max), DEFAULT_JERK),
    }
}
