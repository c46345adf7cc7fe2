//! Test bed for the coordinator: arms that follow their commands, and load for their tasks.

use std::collections::VecDeque;
use std::time::Duration;

use dimos::arm::{ArmCommand, ArmState, Link, Supervision, VelocitySource};
use dimos::clock::Mono;
use dimos::control::config::{
    ArmConfig, CONFIG_VERSION, CartesianParams, CoordinatorConfig, ServoParams, TaskConfig, TaskKind, TaskKinematics,
    TrajectoryParams, VelocityParams,
};
use dimos::control::request::{Envelope, Goal, Motion, Request};
use dimos::control::task::Task;
use dimos::control::task_spec::TaskTable;
use dimos::joint::{ControlMode, JointLimits, Joints, joints_of};
use dimos::robot::kinematics::Kinematics;
use dimos::robot::{Source, load};
use dimos::telemetry::{TaskState, TaskView};
use dimos::trajectory::{JointTrajectory, Spline, TrajectoryPoint};

/// Joints of each arm.
pub const DOF: usize = 7;
/// Number of ticks after which all tasks are active.
pub const SETTLED: u64 = 200;

/// Load of the tasks; one task per arm.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Load {
    /// All arms hold.
    Hold,
    /// All follow trajectories.
    Trajectory,
    /// All follow streams of positions, with a new target in every tick.
    Servo,
    /// All follow streams of velocities, with a new target in every tick.
    Velocity,
    /// All move their end effectors with streams of twists, with a new twist in every tick.
    Twist,
    /// In turn: trajectory, servo, velocity.
    EveryType,
}

/// Arms and their load.
pub struct Bed {
    config: CoordinatorConfig,
    motion: Spline,
    holds: bool,
    sent: u64,
}

impl Bed {
    /// Creates arms under a load, ticking at 100 Hz.
    pub fn new(arms: usize, load: Load) -> Self {
        let limits = JointLimits::uniform(DOF, 3.0, 3.0).with_defaults();
        let arm = |i| ArmConfig {
            tool: None,
            effort: None,
            name: format!("arm{i}"),
            dof: DOF,
            limits: limits.clone(),
            modes: vec![ControlMode::ServoPosition, ControlMode::Velocity],
            gripper: true,
            gripper_info: Default::default(),
            own_velocity: Vec::new(),
            read_period: Duration::from_millis(10),
            write_period: Duration::from_millis(10),
            supervision: Supervision { stale_after: Duration::from_millis(30), ..Supervision::default() },
        };
        let kinds = [
            TaskKind::new("trajectory", &TrajectoryParams { path_tolerance: 0.1, ..TrajectoryParams::default() }),
            TaskKind::new("servo", &ServoParams::default()),
            TaskKind::new("velocity", &VelocityParams::default()),
            TaskKind::new("eef_twist", &CartesianParams::default()).of_robot(xarm7()),
        ];
        let task = |i: usize| TaskConfig {
            name: format!("task{i}"),
            kind: kinds[match load {
                Load::Hold | Load::Trajectory => 0,
                Load::Servo => 1,
                Load::Velocity => 2,
                Load::Twist => 3,
                Load::EveryType => i % 3,
            }]
            .clone(),
            joints: (i * DOF..(i + 1) * DOF).map(|j| j as u16).collect(),
            priority: 10,
            auto_start: false,
        };
        let config = CoordinatorConfig {
            version: CONFIG_VERSION,
            rate: 100.0,
            arms: (0..arms).map(arm).collect(),
            tasks: (0..arms).map(task).collect(),
        };
        Self { config, motion: motion(), holds: load == Load::Hold, sent: 0 }
    }

    /// Returns the coordinator's configuration.
    pub fn config(&self) -> &CoordinatorConfig {
        &self.config
    }

    /// Returns the tasks of this coordinator.
    pub fn tasks(&self) -> Vec<Task> {
        TaskTable::builtin().build(&self.config.tasks).expect("built-in types with their defaults")
    }

    /// Queues the requests of a tick, given the views after the previous one.
    pub fn requests(&mut self, tick: u64, tasks: &[TaskView], queue: &mut VecDeque<Envelope>) {
        if tick == 10 {
            for arm in 0..self.config.arms.len() {
                self.send(Request::Enabled { arm: arm as u16, outside: false }, queue);
            }
        }
        // The arms are ready by then.
        if self.holds || tick < SETTLED / 2 {
            return;
        }
        for t in 0..self.config.tasks.len() {
            let task = t as u16;
            let request = match self.config.tasks[t].kind.name.as_str() {
                "trajectory" if tasks.get(t).is_some_and(|v| v.state == TaskState::Executing) => continue,
                "trajectory" => {
                    let joints = self.config.tasks[t].joints.clone();
                    let motion = Motion { id: self.sent + 1, joints, spline: self.motion.clone(), until: None };
                    Request::Execute { task, motion: Box::new(motion) }
                }
                "servo" => Request::Servo { task, target: swing(tick as f64 / 100.0).0 },
                "velocity" => Request::Velocity { task, target: swing(tick as f64 / 100.0).1 },
                _ => Request::CartesianTarget { task, goal: circle(tick as f64 / 100.0) },
            };
            self.send(request, queue);
        }
    }

    fn send(&mut self, request: Request, queue: &mut VecDeque<Envelope>) {
        self.sent += 1;
        queue.push_back(Envelope { id: self.sent, origin: None, request });
    }

    /// Returns whether all tasks are active.
    pub fn is_busy(&self, tasks: &[TaskView]) -> bool {
        self.holds || tasks.iter().all(|t| t.state == TaskState::Executing)
    }
}

/// An arm of 7 joints and its flange.
fn xarm7() -> TaskKinematics {
    let model = load(&Source::new("builtin:xarm7")).into_model().expect("a built-in description");
    let link = model.link_index("link7").expect("its last link");
    TaskKinematics::new(Kinematics::whole(&model).expect("a tree of joints"), link)
}

/// Returns a twist along a circle, one revolution in 4 s.
fn circle(time: f64) -> Goal {
    let turn = time * std::f64::consts::TAU / 4.0;
    Goal::Twist { linear: [0.02 * turn.cos(), 0.02 * turn.sin(), 0.0], angular: [0.0; 3], tool: false }
}

/// Returns positions and velocities of a swing of 0.2 rad with a period of 4 s.
fn swing(time: f64) -> (Joints, Joints) {
    let turn = std::f64::consts::TAU / 4.0;
    let values = |v| joints_of(&[v; DOF]);
    (values(0.1 * (1.0 - (turn * time).cos())), values(0.1 * turn * (turn * time).sin()))
}

/// Returns a motion of 40 s that ends at its start, with a point every 0.25 s.
fn motion() -> Spline {
    let points = (0..=160).map(|i| f64::from(i) * 0.25).map(|time| {
        let (positions, velocities) = swing(time);
        TrajectoryPoint {
            time_from_start: time,
            positions: positions[..DOF].into(),
            velocities: velocities[..DOF].into(),
            accelerations: Default::default(),
        }
    });
    let joint_names = (0..DOF).map(|j| j.to_string()).collect();
    Spline::new(&JointTrajectory { joint_names, points: points.collect() }).expect("a valid trajectory")
}

/// Returns an arm's state before its first tick: connected, enabled, at zero.
pub fn fresh_arm() -> ArmState {
    ArmState {
        seq: 1,
        dof: DOF,
        velocity_source: VelocitySource::Measured,
        mode: ControlMode::ServoPosition,
        enabled: true,
        link: Link::Up,
        ..ArmState::default()
    }
}

/// Moves an arm to its commanded position.
pub fn follow(state: &mut ArmState, command: &ArmCommand, now: Mono) {
    let dt = now.seconds_since(state.stamp).clamp(1e-6, 0.1);
    match command.mode {
        Some(ControlMode::Velocity) => {
            for (p, v) in state.position.iter_mut().zip(&command.values) {
                *p += v * dt;
            }
            state.velocity = command.values;
        }
        Some(_) => {
            for ((v, p), to) in state.velocity.iter_mut().zip(&state.position).zip(&command.values) {
                *v = (to - p) / dt;
            }
            state.position = command.values;
        }
        None => {}
    }
    state.mode = command.mode.unwrap_or(state.mode);
    state.written = command.seq;
    state.seq += 1;
    state.stamp = now;
}
