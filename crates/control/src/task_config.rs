//! Configuration of a task, and its form in a log.

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::task_leader::LeaderJoint;
use super::task_robot::TaskKinematics;
use super::task_spec::to_value;

/// One task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Stored", into = "Stored")]
pub struct TaskConfig {
    /// Its name.
    pub name: String,
    /// Its type and parameters.
    pub kind: TaskKind,
    /// Its joints: indices over all arms' joints, in the blueprint's order.
    pub joints: Vec<u16>,
    /// The higher priority wins a joint.
    pub priority: i32,
    /// Whether it starts when all arms are ready.
    pub auto_start: bool,
}

/// Type of a task, with its parameters.
#[derive(Debug, Clone, PartialEq)]
pub struct TaskKind {
    /// The type: the name of a row of the table.
    pub name: String,
    /// The parameters of the type, defaults filled in.
    pub params: Value,
    /// The robot whose end effector it moves, if the type moves one.
    pub robot: Option<Box<TaskKinematics>>,
    /// The joint of another arm that each of its joints follows, if the type has a leader.
    pub leader: Vec<LeaderJoint>,
}

impl TaskKind {
    /// Creates the kind of a type that moves joints.
    pub fn new(name: &str, params: &impl Serialize) -> Self {
        Self { name: name.to_owned(), params: to_value(params), robot: None, leader: Vec::new() }
    }

    /// Adds the joints that its joints follow, in their order.
    #[must_use]
    pub fn led_by(mut self, leader: Vec<LeaderJoint>) -> Self {
        self.leader = leader;
        self
    }

    /// Adds the robot whose end effector it moves.
    #[must_use]
    pub fn of_robot(mut self, robot: TaskKinematics) -> Self {
        self.robot = Some(Box::new(robot));
        self
    }
}

/// A task in `coordinator.json`.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Stored {
    name: String,
    /// One entry: the type, and its parameters.
    kind: Map<String, Value>,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    robot: Option<Box<TaskKinematics>>,
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    leader: Vec<LeaderJoint>,
    joints: Vec<u16>,
    priority: i32,
    auto_start: bool,
}

impl From<TaskConfig> for Stored {
    fn from(task: TaskConfig) -> Self {
        let TaskConfig { name, kind, joints, priority, auto_start } = task;
        let (robot, leader) = (kind.robot, kind.leader);
        Self { name, kind: Map::from_iter([(kind.name, kind.params)]), robot, leader, joints, priority, auto_start }
    }
}

impl TryFrom<Stored> for TaskConfig {
    type Error = String;

    fn try_from(stored: Stored) -> Result<Self, String> {
        let Stored { name, kind, mut robot, leader, joints, priority, auto_start } = stored;
        let mut kinds = kind.into_iter();
        let (Some((kind, mut params)), None) = (kinds.next(), kinds.next()) else {
            return Err(format!("task {name} has not one type"));
        };
        if robot.is_none() {
            robot = among(&mut params).map_err(|e| format!("task {name}: {e}"))?;
        }
        Ok(Self { name, kind: TaskKind { name: kind, params, robot, leader }, joints, priority, auto_start })
    }
}

/// Removes the robot from the parameters, which contain it in older logs.
fn among(params: &mut Value) -> Result<Option<Box<TaskKinematics>>, serde_json::Error> {
    let Some(params) = params.as_object_mut().filter(|params| params.contains_key("kinematics")) else {
        return Ok(None);
    };
    let robot = ["kinematics", "link", "root", "base"].into_iter();
    let robot: Map<String, Value> = robot.filter_map(|key| params.remove_entry(key)).collect();
    serde_json::from_value(Value::Object(robot)).map(Some)
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::super::task_spec::TaskTable;
    use super::*;
    use dimos_robot::kinematics::Kinematics;
    use dimos_robot::{Source, load};

    fn robot() -> TaskKinematics {
        let model = load(&Source::new("builtin:yourarm")).into_model().unwrap();
        TaskKinematics::new(Kinematics::whole(&model).unwrap(), model.link_index("flange").unwrap())
    }

    fn task(kind: TaskKind) -> TaskConfig {
        TaskConfig { name: "t".into(), kind, joints: (0..6).collect(), priority: 10, auto_start: false }
    }

    #[test]
    fn every_built_in_task_is_read_from_its_log_as_it_was() {
        for spec in TaskTable::builtin().rows() {
            let joint = |joint| LeaderJoint { joint, scale: -0.1, offset: 0.3, endless: false };
            let leader = if spec.has_leader() { (6..12).map(joint).collect() } else { Vec::new() };
            let kind = TaskKind::new(spec.name, &(spec.params.default)()).led_by(leader);
            let written = task(if spec.robot { kind.of_robot(robot()) } else { kind });
            let text = serde_json::to_string(&written).unwrap();
            let read: TaskConfig = serde_json::from_str(&text).unwrap();
            assert_eq!(read, written, "{text}");
            TaskTable::builtin().build(&[read]).unwrap();
        }
    }

    #[test]
    fn a_robot_among_the_parameters_of_an_older_log_is_found() {
        let mut params = json!({
            "timeout": 0.3, "max_linear_velocity": 0.25, "max_angular_velocity": 1.0, "max_linear_acceleration": 1.0,
            "max_angular_acceleration": 4.0, "max_tracking_error": 0.1745
        });
        let own = params.clone();
        let mut compiled = serde_json::to_value(robot()).unwrap();
        compiled.as_object_mut().unwrap().remove("tool").expect("newer logs have it");
        params.as_object_mut().unwrap().extend(compiled.as_object().unwrap().clone());
        let old = json!({"name": "t", "kind": {"eef_twist": params}, "joints": [0, 1, 2, 3, 4, 5], "priority": 10,
                         "auto_start": false});
        let read: TaskConfig = serde_json::from_value(old).unwrap();
        let kind = TaskKind::new("eef_twist", &own);
        assert_eq!(read, task(kind.of_robot(robot())));
        TaskTable::builtin().build(&[read]).unwrap();
    }

    #[test]
    fn a_task_of_an_unknown_type_is_refused_with_the_types_that_there_are() {
        let unknown = task(TaskKind::new("dance", &json!({})));
        let error = TaskTable::builtin().build(&[unknown]).unwrap_err();
        assert!(error.contains("task t") && error.contains("`dance`") && error.contains("trajectory"), "{error}");
        let two = json!({"name": "t", "kind": {"servo": {}, "velocity": {}}, "joints": [], "priority": 1,
                         "auto_start": false});
        assert!(serde_json::from_value::<TaskConfig>(two).unwrap_err().to_string().contains("not one type"));
    }
}
