//! The table of task types: one row per type, defined in the folder of the type. The `tasks` of a blueprint are checked
//! against it, and the tasks of runs and replays are built from it.

use schemars::{JsonSchema, Schema, SchemaGenerator};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;
use thiserror::Error;

use super::config::{TaskConfig, TaskKinematics};
use super::task::Task;
use super::task_body::{Demand, TargetKind, TaskBody};
use super::task_leader::LeaderJoint;
use super::tasks::TABLE;
use dimos_core::joint::ControlMode;
use dimos_yaml as yaml;
use dimos_yaml::{Lost, Missing, NodeId, Tree};

/// One row of the table.
#[derive(Debug, Clone, Copy)]
pub struct TaskSpec {
    /// `type` in a blueprint.
    pub name: &'static str,
    /// Purpose, as the end of a sentence: `executes trajectories`.
    pub about: &'static str,
    /// Its parameters.
    pub params: ParamsSpec,
    /// Kinds of targets that it takes.
    pub takes: &'static [TargetKind],
    /// Meaning of its claims.
    pub demand: Demand,
    /// Whether it moves an end effector: [`RobotParams`](super::task_robot::RobotParams) are among its parameters then,
    /// and `build` gets the robot's kinematics.
    pub robot: bool,
    /// Builds a body from its parameters. The error describes a parameter that does not fit the task.
    pub build: fn(&TaskSetup<'_>) -> Result<Box<dyn TaskBody>, BuildError>,
}

impl TaskSpec {
    /// Returns whether it takes this kind of target.
    pub fn takes(&self, kind: TargetKind) -> bool {
        self.takes.contains(&kind)
    }

    /// Returns whether it follows another arm: [`LeaderParams`](super::task_leader::LeaderParams) are then among its
    /// parameters, and `build` gets the leader's joints.
    pub fn has_leader(&self) -> bool {
        (self.params.keys)().contains(&"leader")
    }

    /// Returns the control modes of which an arm needs at least one.
    pub fn modes(&self) -> &'static [ControlMode] {
        match self.demand {
            Demand::Nothing => &[],
            Demand::Positions => &[ControlMode::ServoPosition, ControlMode::Position],
            Demand::Velocities => &[ControlMode::Velocity],
            Demand::Impedance => &[ControlMode::Impedance],
        }
    }
}

/// The parameters of a task type: how they are read from a blueprint, their defaults, and their JSON Schema.
#[derive(Debug, Clone, Copy)]
pub struct ParamsSpec {
    /// Reads a group of a blueprint, adds every mistake in it to the tree's diagnostics, and returns the parameters
    /// with defaults filled in, and the keys that could not be read.
    pub read: fn(&mut Tree, NodeId) -> (Option<Value>, Lost),
    /// The defaults.
    pub default: fn() -> Value,
    /// Their JSON Schema.
    pub schema: fn(&mut SchemaGenerator) -> Schema,
    /// Their keys, in the order of the type.
    pub keys: fn() -> &'static [&'static str],
}

impl ParamsSpec {
    /// Creates the parameters of type `T`, which must `deny_unknown_fields` and have a default for each field.
    pub const fn of<T: Serialize + DeserializeOwned + Default + JsonSchema>() -> Self {
        Self {
            read: |tree, node| {
                let (value, lost) = yaml::read::<T>(tree, node, Missing::Report);
                (value.map(|value| to_value(&value)), lost)
            },
            default: || to_value(&T::default()),
            schema: |generator| generator.subschema_for::<T>(),
            keys: yaml::keys::<T>,
        }
    }
}

/// Returns parameters as JSON. Plain structs always encode; others are rejected when the task is built.
pub(super) fn to_value(params: &impl Serialize) -> Value {
    serde_json::to_value(params).unwrap_or_default()
}

/// Input for building a body.
#[derive(Debug, Clone, Copy)]
pub struct TaskSetup<'a> {
    /// The task's joints: indices over all arms' joints.
    pub joints: &'a [u16],
    /// The parameters.
    pub params: &'a Value,
    /// The robot whose end effector the task moves, if its type moves one.
    pub robot: Option<&'a TaskKinematics>,
    /// The joint that each joint of the task follows, if its type has a leader.
    pub leader: &'a [LeaderJoint],
}

impl TaskSetup<'_> {
    /// Returns the parameters as the type's struct.
    pub fn params<T: DeserializeOwned>(&self) -> Result<T, BuildError> {
        T::deserialize(self.params).map_err(|e| BuildError::new("", e.to_string()))
    }
}

/// Parameters that do not fit the task.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("{what}")]
pub struct BuildError {
    /// The wrong key; empty: the parameters as a whole.
    pub key: &'static str,
    /// The problem.
    pub what: String,
    /// The hint.
    pub hint: Option<String>,
}

impl BuildError {
    /// Creates an error at a key.
    pub fn new(key: &'static str, what: impl Into<String>) -> Self {
        Self { key, what: what.into(), hint: None }
    }

    /// Adds a hint.
    #[must_use]
    pub fn hint(mut self, hint: impl Into<String>) -> Self {
        self.hint = Some(hint.into());
        self
    }
}

/// A table of task types: the built-in rows and those of the program that embeds this crate.
#[derive(Debug, Clone, Default)]
pub struct TaskTable {
    more: Vec<TaskSpec>,
}

impl TaskTable {
    /// Returns the table of the built-in types.
    pub const fn builtin() -> Self {
        Self { more: Vec::new() }
    }

    /// Returns the built-in types and `more`, which replace rows of the same name.
    pub fn with(more: &[TaskSpec]) -> Self {
        Self { more: more.to_vec() }
    }

    /// Returns all rows, in table order.
    pub fn rows(&self) -> impl Iterator<Item = &TaskSpec> {
        let replaced = move |row: &&TaskSpec| !self.more.iter().any(|m| m.name == row.name);
        TABLE.iter().filter(replaced).chain(&self.more)
    }

    /// Returns the row with this name.
    pub fn get(&self, name: &str) -> Option<&TaskSpec> {
        self.rows().find(|row| row.name == name)
    }

    /// Returns all names, in table order.
    pub fn names(&self) -> Vec<&'static str> {
        self.rows().map(|row| row.name).collect()
    }

    /// Builds the tasks of a coordinator. The error names the task and the problem.
    pub fn build(&self, tasks: &[TaskConfig]) -> Result<Vec<Task>, String> {
        let task = |(index, task): (usize, &TaskConfig)| {
            let made = self.body(task).map(|(spec, body)| Task::new(index as u16, task, spec, body));
            made.map_err(|what| format!("task {}: {what}", task.name))
        };
        tasks.iter().enumerate().map(task).collect()
    }

    fn body(&self, task: &TaskConfig) -> Result<(&TaskSpec, Box<dyn TaskBody>), String> {
        let kind = &task.kind;
        let Some(spec) = self.get(&kind.name) else {
            let there = self.names().join(", ");
            return Err(format!("this program has no task type `{}`, only {there}", kind.name));
        };
        match &kind.robot {
            Some(robot) => robot.check(task.joints.len())?,
            None if spec.robot => return Err("the kinematics of its robot are missing".to_owned()),
            None => {}
        }
        if spec.has_leader() && kind.leader.len() != task.joints.len() {
            return Err("the joints of its leader are missing".to_owned());
        }
        let robot = kind.robot.as_deref();
        let setup = TaskSetup { joints: &task.joints, params: &kind.params, robot, leader: &kind.leader };
        let body = (spec.build)(&setup).map_err(|e| match e.key {
            "" => e.what,
            key => format!("{key}: {}", e.what),
        })?;
        Ok((spec, body))
    }
}
