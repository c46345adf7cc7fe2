//! The rows of the adapter table as the coordinator gets them, for tests in virtual time.

use std::sync::LazyLock;
use std::time::Duration;

use dimos::arm::{Supervision, Topology};
use dimos::control::config::{ArmConfig, TaskKinematics};
use dimos::hardware::registry::AdapterConfig;
use dimos::joint::{ControlMode, MAX_DOF};
use dimos::robot::kinematics::Kinematics;
use dimos::robot::{Source, load};

/// One row with one of its numbers of joints.
#[derive(Debug, Clone)]
pub struct Row {
    pub name: &'static str,
    pub native_rate: f64,
    /// Its stop is another goal: it has no stop of its own.
    pub goal_only: bool,
    /// For a tick at [`Row::at`]'s rate.
    pub arm: ArmConfig,
    /// Of its end effector, where a description is built in.
    pub robot: Option<TaskKinematics>,
}

/// All rows, in the table's order. Rows with several numbers of joints are here with 6, and xArm with 7, too.
pub fn rows() -> &'static [Row] {
    static ROWS: LazyLock<Vec<Row>> = LazyLock::new(|| {
        let table = dimos::arms::registry();
        let mut rows = Vec::new();
        for spec in table.rows() {
            let mut numbers = vec![6usize.clamp(spec.dof.0, spec.dof.1)];
            if spec.name == "xarm" {
                numbers.push(7);
            }
            for dof in numbers {
                let config = AdapterConfig {
                    hardware_id: "arm".to_owned(),
                    address: String::new(),
                    dof,
                    options: serde_json::Value::Null,
                };
                let checked = (spec.check)(&config).unwrap();
                let mut topology = [spec.topology; MAX_DOF];
                topology.iter_mut().zip(&checked.topology).for_each(|(all, one): (&mut Topology, _)| *all = *one);
                let supervision = Supervision {
                    accuracy: spec.accuracy,
                    lag: spec.lag,
                    stale_after: spec.stale_after,
                    tracking_tolerance: Supervision::TRACKING_TOLERANCE,
                    accept_zero_pose: false,
                    droop: spec.droop,
                    relief: spec.relief,
                    outside: spec.outside,
                    gap_tolerance: spec.gap_tolerance,
                    after_gap: spec.after_gap,
                    topology,
                };
                let limits = checked.limits.with_defaults();
                let arm = ArmConfig {
                    tool: None,
                    effort: None,
                    name: "arm".to_owned(),
                    dof,
                    own_velocity: limits.velocity_max.clone(),
                    limits,
                    modes: spec.modes.to_vec(),
                    gripper: false,
                    gripper_info: Default::default(),
                    read_period: Duration::ZERO,
                    write_period: Duration::ZERO,
                    supervision,
                };
                let robot = match (spec.name, dof) {
                    ("franka", _) => Some("fr3"),
                    ("ur", _) => Some("ur5e"),
                    ("piper", _) => Some("piper"),
                    ("xarm", 7) => Some("xarm7"),
                    ("xarm", _) => Some("xarm6"),
                    ("yourarm", _) => Some("yourarm"),
                    _ => None,
                };
                let goal_only = matches!(spec.name, "piper" | "so101");
                let robot = robot.map(kinematics);
                rows.push(Row { name: spec.name, native_rate: spec.native_rate, goal_only, arm, robot });
            }
        }
        rows
    });
    &ROWS
}

/// The kinematics of a built-in robot up to its last link.
fn kinematics(name: &str) -> TaskKinematics {
    let model = load(&Source::new(format!("builtin:{name}"))).into_model().unwrap();
    let whole = Kinematics::whole(&model).unwrap();
    let last = whole.links() - 1;
    TaskKinematics::new(whole, last)
}

impl Row {
    /// Returns the tick rates that it allows [Hz].
    pub fn rates(&self) -> Vec<f64> {
        [100.0, 250.0, 500.0, 1000.0].into_iter().filter(|rate| *rate <= self.native_rate).collect()
    }

    /// Returns the row for a tick at this rate [Hz], with the periods that a device thread has.
    pub fn at(&self, rate: f64) -> Self {
        let tick = Duration::from_secs_f64(1.0 / rate);
        let own = Duration::from_secs_f64(1.0 / self.native_rate);
        let mut row = self.clone();
        row.arm.read_period = tick.min(Duration::from_millis(10)).max(own);
        row.arm.write_period = tick.max(own.min(Duration::from_millis(20)));
        row
    }

    pub fn has_velocity(&self) -> bool {
        self.arm.modes.contains(&ControlMode::Velocity)
    }

    /// Returns a pose well inside the ranges: the middle, or the built-in robot's if it has one.
    pub fn middle(&self) -> Vec<f64> {
        let l = &self.arm.limits;
        let bounds = l.position_lower.iter().zip(&l.position_upper).enumerate();
        // The middle of a range of several turns; an elbow that is bent, so that poses can be left in all directions.
        bounds
            .map(|(j, (low, high))| 0.5 * (low + high) + 0.15 * (high - low).min(3.0) * [0.5, -1.0, 1.0][j % 3])
            .collect()
    }
}
