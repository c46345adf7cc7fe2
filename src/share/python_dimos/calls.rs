//! The calls of a `ControlCoordinator`, read from the pickles of their arguments.

use super::arguments::Arguments;
use super::gripper::Scale;
use super::names::{Names, TRAJECTORY_TASK};
use super::pickle_node::{Class, Id, Node, Pickled};
use super::pickle_reader::read;
use super::python_error::PythonError;
use super::results::{GRIPPER_COMMANDS, TRAJECTORY_COMMANDS, no_command};
use super::trajectories;
use crate::rpc::api::Execute;

/// Methods that pass live Python objects, or change what is the blueprint's.
const UNSUPPORTED: [&str; 11] = [
    "add_hardware",
    "add_task",
    "get_stream_descriptors",
    "get_task",
    "peek_stream",
    "remove_hardware",
    "remove_task",
    "set_activated",
    "set_dry_run",
    "set_module_ref",
    "set_transport",
];

/// A call.
#[derive(Debug, Clone, PartialEq)]
pub enum Call {
    /// Names of the joints.
    ListJoints,
    /// Names of the arms.
    ListHardware,
    /// Names of the tasks.
    ListTasks,
    /// Names of the tasks that are active.
    ActiveTasks,
    /// Positions of the joints.
    Positions,
    /// Number of ticks.
    TickCount,
    /// What a task's commands are.
    DescribeTask(String),
    /// Nothing: a program elsewhere neither begins nor ends a run.
    Nothing,
    /// The skills of the module: none.
    Skills,
    /// Clears the state of tasks that have such: none.
    ResetRuntimeState,
    /// A command of a task that is not there.
    UnknownTask,
    /// Executes a trajectory; the error says why it is not valid.
    Execute(Result<Execute, String>),
    /// Ends the motions of trajectory tasks.
    Cancel,
    /// State of the newest motion.
    State,
    /// State and progress of the newest motion.
    Status,
    /// Position of a gripper, as a fraction of its range or in its unit.
    GripperPosition(String, Scale),
    /// Sets a gripper; `None`: not one number.
    SetGripper(String, Scale, Option<f64>),
    /// Stops all arms, or asks to clear that.
    EStop(bool),
}

/// Which connection to the run answers a call.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Lane {
    /// None: what is known here.
    Here,
    /// The one that reads.
    Reads,
    /// The one that commands.
    Moves,
    /// The one that ends motion, which waits for no other.
    Ends,
}

impl Call {
    /// Returns which connection answers it.
    pub fn lane(&self) -> Lane {
        match self {
            Self::ActiveTasks | Self::State | Self::Status | Self::GripperPosition(..) => Lane::Reads,
            Self::Execute(Ok(_)) | Self::SetGripper(..) => Lane::Moves,
            Self::Cancel | Self::EStop(true) => Lane::Ends,
            _ => Lane::Here,
        }
    }

    /// Reads a call. `coordinator`: its name, for messages.
    pub fn read(coordinator: &str, method: &str, payload: &[u8], names: &Names) -> Result<Self, PythonError> {
        // Their arguments may be anything.
        if UNSUPPORTED.contains(&method) {
            let text = format!(
                "{coordinator} is a run of the dimos binary: it has no {method}(); its blueprint has the \
                arms and the tasks"
            );
            return Err(PythonError::unsupported(text));
        }
        let nothing = match method {
            "list_joints" => Some(Self::ListJoints),
            "list_hardware" => Some(Self::ListHardware),
            "list_tasks" => Some(Self::ListTasks),
            "get_active_tasks" => Some(Self::ActiveTasks),
            "get_joint_positions" => Some(Self::Positions),
            "get_tick_count" => Some(Self::TickCount),
            "get_skills" => Some(Self::Skills),
            "build" | "start" | "stop" => Some(Self::Nothing),
            "cancel_trajectory" => Some(Self::Cancel),
            _ => None,
        };
        let known = ["execute_trajectory", "task_invoke", "describe_task", "set_estop", "reset_runtime_state"];
        if nothing.is_none() && !known.contains(&method) {
            let shown: String = method.chars().take(80).collect();
            return Err(PythonError::attribute(format!("'{coordinator}' object has no attribute '{shown}'")));
        }
        let pickled = read(payload)?;
        let arguments = Arguments::of(&pickled)?;
        if let Some(call) = nothing {
            arguments.bind(method, [], 0)?;
            return Ok(call);
        }
        match method {
            "execute_trajectory" => {
                let [trajectory] = arguments.bind(method, ["trajectory"], 1)?;
                execute(&pickled, trajectory, names)
            }
            "describe_task" => {
                let [task] = arguments.bind(method, ["task_name"], 1)?;
                Ok(Self::DescribeTask(text(&pickled, task, "task_name")?.to_owned()))
            }
            "set_estop" => {
                let [estopped] = arguments.bind(method, ["estopped"], 1)?;
                Ok(Self::EStop(pickled.truth(estopped.unwrap_or_default(), "estopped")?))
            }
            "reset_runtime_state" => {
                arguments.bind(method, ["reactivate"], 0)?;
                Ok(Self::ResetRuntimeState)
            }
            _ => {
                let [task, command, named] = arguments.bind(method, ["task_name", "method", "kwargs"], 2)?;
                let (task, command) = (text(&pickled, task, "task_name")?, text(&pickled, command, "method")?);
                let named = named.filter(|_| !arguments.is_none(named));
                task_command(&pickled, (task, command), named, names)
            }
        }
    }
}

/// Reads a command of a task. `named`: its arguments; `None`: none.
fn task_command(
    pickled: &Pickled<'_>,
    (task, command): (&str, &str),
    named: Option<Id>,
    names: &Names,
) -> Result<Call, PythonError> {
    let is_trajectory = task == TRAJECTORY_TASK && !names.trajectory_tasks.is_empty();
    let gripper = names.gripper(task);
    let commands = match (is_trajectory, gripper) {
        (true, _) => TRAJECTORY_COMMANDS,
        (false, Some(_)) => GRIPPER_COMMANDS,
        (false, None) => return Ok(Call::UnknownTask),
    };
    if !commands.iter().any(|(name, _)| *name == command) {
        return Err(PythonError::attribute(no_command(task, command, &commands)));
    }
    let arguments = match named {
        Some(named) => Arguments::of_dict(pickled, &[], named)?,
        None => Arguments::empty(pickled),
    };
    let place = format!("task_invoke('{task}', '{command}')");
    let arm = gripper.map(|gripper| gripper.arm.clone()).unwrap_or_default();
    let scale = if command.ends_with("_normalized") { Scale::Normalized } else { Scale::Native };
    match command {
        "execute" => {
            // The run knows its own positions.
            let [trajectory, _] = arguments.bind(&place, ["trajectory", "current_positions"], 2)?;
            execute(pickled, trajectory, names)
        }
        "get_status" => arguments.bind(&place, ["t_now"], 1).map(|_| Call::Status),
        "get_state" => arguments.bind(&place, [], 0).map(|_| Call::State),
        "cancel" => arguments.bind(&place, [], 0).map(|_| Call::Cancel),
        "get_position" | "get_normalized" => arguments.bind(&place, [], 0).map(|_| Call::GripperPosition(arm, scale)),
        _ => {
            let [values, _] = arguments.bind(&place, ["values", "t_now"], 1)?;
            let value = match pickled.items(values.unwrap_or_default(), "values")? {
                [value] => Some(pickled.number(*value, "a value of values")?),
                _ => None,
            };
            Ok(Call::SetGripper(arm, scale, value.filter(|value| value.is_finite())))
        }
    }
}

fn execute(pickled: &Pickled<'_>, trajectory: Option<Id>, names: &Names) -> Result<Call, PythonError> {
    let id = trajectory.unwrap_or_default();
    match pickled.node(id) {
        Node::None => Ok(Call::Execute(Err("the trajectory is missing".to_owned()))),
        Node::Object { class: Class::JointTrajectory, .. } => {
            Ok(Call::Execute(trajectories::execute(pickled, id, names)?))
        }
        _ => Err(PythonError::of_type(format!("trajectory is a {}, must be a JointTrajectory", pickled.kind(id)))),
    }
}

fn text<'p>(pickled: &Pickled<'p>, id: Option<Id>, what: &str) -> Result<&'p str, PythonError> {
    Ok(pickled.text(id.unwrap_or_default(), what)?)
}

#[cfg(test)]
mod tests {
    use super::super::pickle_writer::{Value, texts, write};
    use super::*;

    fn names() -> Names {
        let gripper = super::super::names::Gripper { arm: "arm".into(), range: Some([0.0, 0.08]) };
        Names { grippers: vec![gripper], trajectory_tasks: vec!["traj".into()], ..Names::default() }
    }

    fn call(method: &str, positional: Vec<Value>, named: Vec<(&'static str, Value)>) -> Result<Call, PythonError> {
        let pickle = write(&Value::Tuple(vec![Value::Tuple(positional), Value::Dict(named)]));
        Call::read("ControlCoordinator", method, &pickle, &names())
    }

    #[test]
    fn arguments_are_bound_as_python_binds_them() {
        let task = || Value::from("arm_gripper");
        let values = || Value::Dict(vec![("values", Value::List(vec![Value::Int(1)]))]);
        let set = Call::SetGripper("arm".into(), Scale::Normalized, Some(1.0));
        assert_eq!(call("task_invoke", vec![task(), "set_normalized".into(), values()], vec![]).unwrap(), set);
        let named = vec![("kwargs", values()), ("method", "set_normalized".into()), ("task_name", task())];
        assert_eq!(call("task_invoke", vec![], named).unwrap(), set);
        let none = call("task_invoke", vec![task(), "get_position".into(), Value::None], vec![]).unwrap();
        assert_eq!(none, Call::GripperPosition("arm".into(), Scale::Native));
        for (positional, named, says) in [
            (vec![], vec![], "task_invoke: missing a required argument: 'task_name'"),
            (vec![task(), "x".into()], vec![("task_name", task())], "multiple values for argument 'task_name'"),
            (vec![task(), "x".into()], vec![("now", Value::None)], "unexpected argument(s) ['now']"),
            (vec![Value::None; 4], vec![], "takes 3 arguments, got 4"),
            (vec![Value::Int(1), "x".into()], vec![], "task_name is a int, must be a str"),
        ] {
            let error = call("task_invoke", positional, named).unwrap_err();
            assert!(error.class == "TypeError" && error.text.contains(says), "{error:?}");
        }
    }

    #[test]
    fn what_ends_motion_has_a_lane_of_its_own() {
        let task =
            |command: &str| call("task_invoke", vec!["joint_trajectory".into(), command.into()], vec![]).unwrap();
        assert_eq!(task("cancel").lane(), Lane::Ends);
        assert_eq!(task("get_state").lane(), Lane::Reads);
        assert_eq!(call("set_estop", vec![Value::Bool(true)], vec![]).unwrap().lane(), Lane::Ends);
        assert_eq!(call("set_estop", vec![Value::Bool(false)], vec![]).unwrap().lane(), Lane::Here);
        assert_eq!(call("list_joints", vec![], vec![]).unwrap().lane(), Lane::Here);
        assert_eq!(call("set_estop", vec![Value::Int(1)], vec![]).unwrap_err().class, "TypeError");
        let odd = vec![
            "joint_trajectory".into(),
            "execute".into(),
            Value::Dict(vec![("trajectory", texts(["x"])), ("current_positions", Value::None)]),
        ];
        assert!(call("task_invoke", odd, vec![]).unwrap_err().text.contains("must be a JointTrajectory"));
    }
}
