//! Test bench of the checks: a coordinator on a virtual clock, one ideal arm, the task under test, and a task of higher
//! priority on one of its joints. For a task that follows another arm, also a leader with its motors off.

use std::collections::VecDeque;
use std::time::Duration;

use crate::config::{
    ArmConfig, CONFIG_VERSION, CoordinatorConfig, EffortConfig, FeedForward, LeaderJoint, TaskConfig, TaskKind,
};
use crate::coordinator::{Coordinator, TickTime};
use crate::request::{Envelope, Goal, Motion, Request};
use crate::task::Task;
use crate::task_body::{Demand, TargetKind};
use crate::task_robot::TaskKinematics;
use crate::task_spec::{TaskSpec, TaskTable};
use crate::tasks::chunk::curve;
use dimos_core::arm::{ArmState, EffortLimits, Impedance, Link, Supervision, VelocitySource};
use dimos_core::clock::Mono;
use dimos_core::joint::{ControlMode, JointLimits, Joints, MAX_DOF, joints_of};
use dimos_core::telemetry::{Event, Outcome, Phase, TaskState};
use dimos_core::trajectory::{JointTrajectory, JointValues, Spline, TrajectoryPoint};
use dimos_robot::kinematics::Kinematics;
use dimos_robot::{Source, load};

const DOF: usize = 6;
/// Initial positions, away from every singular pose of the built-in robot [rad].
const HOME: [f64; DOF] = [0.2, -0.3, 0.9, 0.3, 0.8, 0.1];
/// Tick rate [Hz].
const RATE: f64 = 100.0;
/// Indices of the task under test and of the one with higher priority.
const TESTED: u16 = 0;
const STRONGER: u16 = 1;
/// Joint of the task with higher priority.
pub const CONTESTED: u16 = 0;

/// A coordinator, its arm and its clock.
#[derive(Debug)]
pub struct Bench {
    spec: TaskSpec,
    coordinator: Coordinator,
    robot: TaskKinematics,
    arm: ArmState,
    /// The arm that leads.
    leader: ArmState,
    now: Mono,
    inbox: VecDeque<Envelope>,
    next_id: u64,
    events: Vec<Event>,
    phase: Phase,
    /// Time since the stream of targets began [s].
    streamed: f64,
    trace: Vec<u64>,
    allocations: Option<fn() -> u64>,
    allocated: u64,
}

impl Bench {
    /// An arm that is ready, and a task of this type without a target.
    pub fn new(spec: &TaskSpec, allocations: Option<fn() -> u64>) -> Result<Self, String> {
        let model = load(&Source::new("builtin:yourarm")).into_model()?;
        let flange = model.link_index("flange").ok_or("the built-in robot has no flange")?;
        let robot = TaskKinematics::new(Kinematics::whole(&model).map_err(|e| e.to_string())?, flange);
        let config = config(spec, &robot);
        let tasks = TaskTable::with(&[*spec]).build(&config.tasks)?;
        let arm = ArmState {
            dof: DOF,
            position: joints_of(&HOME),
            velocity: joints_of(&[0.0; DOF]),
            velocity_source: VelocitySource::Measured,
            mode: ControlMode::ServoPosition,
            enabled: true,
            link: Link::Up,
            ..ArmState::default()
        };
        let mut bench = Self {
            spec: *spec,
            coordinator: Coordinator::new(&config, tasks),
            robot,
            arm,
            leader: ArmState { enabled: false, ..arm },
            now: Mono(1_000_000_000),
            inbox: VecDeque::new(),
            next_id: 1,
            events: Vec::new(),
            phase: Phase::Unknown,
            streamed: 0.0,
            trace: Vec::new(),
            allocations,
            allocated: 0,
        };
        bench.tick(0);
        bench.enable()?;
        Ok(bench)
    }

    /// The same from the start.
    pub fn again(&self) -> Result<Self, String> {
        Self::new(&self.spec, self.allocations)
    }

    /// The row under test.
    pub fn spec(&self) -> &TaskSpec {
        &self.spec
    }

    /// The built-in robot, compiled for the arm.
    pub fn robot(&self) -> &TaskKinematics {
        &self.robot
    }

    /// The task under test.
    pub fn task(&self) -> Result<&Task, String> {
        self.coordinator.tasks().first().ok_or_else(|| "the coordinator lost the task".to_owned())
    }

    /// Returns whether the task under test is active.
    pub fn is_active(&self) -> bool {
        self.task().is_ok_and(Task::is_active)
    }

    /// Resets the arm's latch, enables it and waits until it is ready.
    pub fn enable(&mut self) -> Result<(), String> {
        // The leader, if there is one, too: a task may follow no arm that a person has stopped.
        self.ask(Request::Reset { arm: 1 });
        self.ask(Request::Reset { arm: 0 });
        self.ask(Request::Enabled { arm: 0, outside: false });
        self.run(0.5);
        if self.phase == Phase::Ready { Ok(()) } else { Err(format!("the simulated arm is {:?}", self.phase)) }
    }

    /// Runs one tick, after this number of skipped periods.
    pub fn tick(&mut self, skipped: u32) {
        let period = Duration::from_secs_f64(1.0 / RATE);
        self.now = self.now.after(period * (skipped + 1));
        self.arm.seq += 1;
        self.arm.stamp = self.now.before(Duration::from_micros(1500));
        (self.leader.seq, self.leader.stamp) = (self.arm.seq, self.arm.stamp);
        let late_ns = u64::from(skipped) * period.as_nanos() as u64;
        let time = TickTime { now: self.now, next: self.now.after(period), skipped, late_ns, woke_late_ns: late_ns };
        let counted = || self.allocations.map_or(0, |count| count());
        let before = counted();
        let states = [self.arm, self.leader];
        let output = self.coordinator.tick(time, &states, || self.inbox.pop_front());
        self.allocated += counted() - before;
        self.events.extend(&output.events);
        output.retired.clear();
        self.phase = output.arms.first().map_or(Phase::Unknown, |arm| arm.phase);
        let Some(command) = output.commands.first() else { return };
        self.trace.extend(command.values.iter().map(|value| value.to_bits()));
        let Some(mode) = command.mode else { return };
        (self.arm.mode, self.arm.written) = (mode, command.seq);
        for ((q, v), value) in self.arm.position.iter_mut().zip(&mut self.arm.velocity).zip(command.values).take(DOF) {
            let before = *q;
            *q = if mode == ControlMode::Velocity { before + value / RATE } else { value };
            *v = (*q - before) * RATE;
        }
    }

    /// Ticks for this time [s].
    pub fn run(&mut self, seconds: f64) {
        (0..(seconds * RATE).round() as u64).for_each(|_| self.tick(0));
    }

    /// Sends a request and returns its outcome from the next tick.
    pub fn ask(&mut self, request: Request) -> Option<Outcome> {
        let id = self.send(request);
        self.tick(0);
        let of = |event: &Event| match event {
            Event::Request(answered, outcome) if *answered == id => Some(*outcome),
            _ => None,
        };
        self.events.iter().rev().find_map(of)
    }

    fn send(&mut self, request: Request) -> u64 {
        let id = self.next_id;
        self.next_id += 1;
        self.inbox.push_back(Envelope { id, origin: None, request });
        id
    }

    /// Cancels the task under test.
    pub fn cancel(&mut self) -> Option<Outcome> {
        self.ask(Request::Cancel { task: Some(TESTED) })
    }

    /// The kind of target with which the task is moved.
    pub fn usual(&self) -> Result<TargetKind, String> {
        self.spec.takes.first().copied().ok_or_else(|| "it takes no target".to_owned())
    }

    /// Sends the next usual target every other tick for this time [s]. A trajectory is sent once.
    pub fn stream(&mut self, seconds: f64) -> Result<(), String> {
        let kind = self.usual()?;
        for k in 0..(seconds * RATE).round() as u64 {
            if k % 2 == 0 && !(kind == TargetKind::Trajectory && self.is_active()) {
                let target = self.target(kind)?;
                self.send(target);
            }
            self.lead(0.0);
            self.tick(0);
            self.streamed += 1.0 / RATE;
        }
        Ok(())
    }

    /// Moves the leader to the present point of the slow motion, and this much further [rad].
    pub fn lead(&mut self, further: f64) {
        let swing = self.swing() + further;
        self.leader.position = joints_of(&HOME.map(|home| home + swing));
    }

    /// How far the slow motion has moved each joint [rad].
    fn swing(&self) -> f64 {
        0.1 * (1.0 - (std::f64::consts::PI * self.streamed).cos())
    }

    /// The request with the next target of a slow motion.
    pub fn target(&self, kind: TargetKind) -> Result<Request, String> {
        let swing = self.swing();
        let each = |f: &dyn Fn(f64) -> f64| -> Joints { joints_of(&HOME.map(f)) };
        Ok(match kind {
            TargetKind::Trajectory => Request::Execute { task: TESTED, motion: self.motion()? },
            TargetKind::Positions => Request::Servo { task: TESTED, target: each(&|home| home + swing) },
            TargetKind::Velocities => Request::Velocity { task: TESTED, target: each(&|_| 0.2) },
            TargetKind::Chunk => Request::Chunk { task: TESTED, start: self.now, motion: self.chunk()? },
            TargetKind::Pose => {
                let mut frames = self.robot.kinematics.frames();
                self.robot.kinematics.forward(&HOME, &mut frames);
                let flange = self.robot.kinematics.link_frame(self.robot.link, &frames);
                let mut position = flange.translation.to_array();
                position[2] += 0.05;
                let orientation = glamx::DQuat::from_mat3(&flange.matrix3).to_array();
                Request::CartesianTarget { task: TESTED, goal: Goal::Pose { position, orientation } }
            }
            TargetKind::Twist => {
                let goal = Goal::Twist { linear: [0.0, 0.0, 0.05], angular: [0.0; 3], tool: false };
                Request::CartesianTarget { task: TESTED, goal }
            }
            TargetKind::Start => Request::Start { task: TESTED },
        })
    }

    /// Returns the same request with numbers that are not finite; `None`: not possible for this kind.
    pub fn not_finite(kind: TargetKind) -> Option<Request> {
        let (task, odd) = (TESTED, f64::NAN);
        Some(match kind {
            TargetKind::Trajectory | TargetKind::Chunk | TargetKind::Start => return None,
            TargetKind::Positions => Request::Servo { task, target: [odd; MAX_DOF] },
            TargetKind::Velocities => Request::Velocity { task, target: [odd; MAX_DOF] },
            TargetKind::Pose => Request::CartesianTarget {
                task,
                goal: Goal::Pose { position: [0.3, odd, 0.4], orientation: [0.0, 0.0, 0.0, 1.0] },
            },
            TargetKind::Twist => {
                let goal = Goal::Twist { linear: [0.0, f64::INFINITY, 0.0], angular: [odd; 3], tool: true };
                Request::CartesianTarget { task, goal }
            }
        })
    }

    /// A motion of 2 s from where the arm is.
    fn motion(&self) -> Result<Box<Motion>, String> {
        let point = |time: f64, by: f64| TrajectoryPoint {
            time_from_start: time,
            positions: self.positions().map(|q| q + by)[..].into(),
            velocities: [0.0; DOF][..].into(),
            accelerations: JointValues::new(),
        };
        let joint_names = (0..DOF).map(|j| j.to_string()).collect();
        let given = JointTrajectory { joint_names, points: vec![point(0.0, 0.0), point(2.0, 0.3)] };
        let spline = Spline::new(&given).map_err(|e| e.to_string())?;
        Ok(Box::new(Motion { id: self.next_id, joints: (0..DOF as u16).collect(), spline, until: None }))
    }

    /// A chunk of the next second of the swing.
    fn chunk(&self) -> Result<Box<Motion>, String> {
        let period = 1.0 / 30.0;
        let action = |k: u32| {
            let swing = 0.1 * (1.0 - (std::f64::consts::PI * (self.streamed + f64::from(k) * period)).cos());
            HOME.map(|home| home + swing).to_vec()
        };
        let names: Vec<String> = (0..DOF).map(|j| j.to_string()).collect();
        let actions: Vec<Vec<f64>> = (0..30).map(action).collect();
        let limits = JointLimits::uniform(DOF, 2.9, 2.0).with_defaults();
        let spline = Spline::new(&curve(&names, &actions, period, &limits)).map_err(|e| e.to_string())?;
        Ok(Box::new(Motion { id: self.next_id, joints: (0..DOF as u16).collect(), spline, until: None }))
    }

    /// Runs the task of higher priority for this time [s].
    pub fn interfere(&mut self, seconds: f64) {
        for _ in 0..(seconds * RATE).round() as u64 {
            let here = self.arm.position.get(usize::from(CONTESTED)).copied().unwrap_or_default();
            let request = match self.spec.demand {
                Demand::Velocities => Request::Velocity { task: STRONGER, target: joints_of(&[0.0]) },
                _ => Request::Servo { task: STRONGER, target: joints_of(&[here]) },
            };
            self.send(request);
            self.tick(0);
        }
        self.ask(Request::Cancel { task: Some(STRONGER) });
    }

    /// Returns the positions of the joints [rad].
    pub fn positions(&self) -> [f64; DOF] {
        std::array::from_fn(|j| self.arm.position.get(j).copied().unwrap_or_default())
    }

    /// Returns the largest distance of a joint from its initial position [rad].
    pub fn moved(&self) -> f64 {
        self.positions().iter().zip(HOME).fold(0.0, |most, (q, home)| most.max((q - home).abs()))
    }

    /// Returns whether the arm stays at rest for this time [s].
    pub fn rests(&mut self, seconds: f64) -> bool {
        let before = self.positions();
        self.run(seconds);
        self.positions() == before
    }

    /// Returns a refused command, or another fault of the task, since the start.
    pub fn fault(&self) -> Option<String> {
        self.events.iter().find_map(|event| match event {
            Event::Task(TESTED, TaskState::Fault, reason) => Some(format!("its command was refused: {reason:?}")),
            _ => None,
        })
    }

    /// Returns the bits of all commands so far.
    pub fn trace(&self) -> &[u64] {
        &self.trace
    }

    /// Returns the number of allocations inside ticks, if they are counted.
    pub fn allocated(&self) -> u64 {
        self.allocated
    }
}

/// An arm that yields, and is fed nothing forward.
fn effort() -> EffortConfig {
    EffortConfig {
        limits: EffortLimits { max: [20.0; MAX_DOF], rate: [200.0; MAX_DOF] },
        feed_forward: FeedForward::None,
        dynamics: None,
        impedance: Some(Impedance::uniform((100.0, 10.0), (500.0, 50.0))),
    }
}

fn config(spec: &TaskSpec, robot: &TaskKinematics) -> CoordinatorConfig {
    let arm = ArmConfig {
        tool: None,
        effort: Some(Box::new(effort())),
        name: "arm".to_owned(),
        dof: DOF,
        limits: JointLimits::uniform(DOF, 2.9, 2.0).with_defaults(),
        modes: vec![ControlMode::ServoPosition, ControlMode::Velocity, ControlMode::Impedance],
        gripper: false,
        gripper_info: Default::default(),
        own_velocity: Vec::new(),
        read_period: Duration::from_millis(10),
        write_period: Duration::from_millis(10),
        supervision: Supervision::default(),
    };
    let kind = |name: &str, params, robot| TaskKind { name: name.to_owned(), params, robot, leader: Vec::new() };
    let led = |joint| LeaderJoint { joint, scale: 1.0, offset: 0.0, endless: false };
    let leader = if spec.has_leader() { (DOF as u16..2 * DOF as u16).map(led).collect() } else { Vec::new() };
    let task = |name: &str, kind: TaskKind, joints: std::ops::Range<u16>, priority: i32| TaskConfig {
        name: name.to_owned(),
        kind,
        joints: joints.collect(),
        priority,
        auto_start: false,
    };
    let tested = kind(spec.name, (spec.params.default)(), spec.robot.then(|| Box::new(robot.clone())));
    let tested = tested.led_by(leader);
    let stronger = match spec.demand {
        Demand::Velocities => crate::tasks::velocity::SPEC,
        _ => crate::tasks::servo::SPEC,
    };
    let stronger = kind(stronger.name, (stronger.params.default)(), None);
    CoordinatorConfig {
        version: CONFIG_VERSION,
        rate: RATE,
        arms: vec![arm.clone(), ArmConfig { name: "leader".to_owned(), ..arm }],
        tasks: vec![
            task("tested", tested, 0..DOF as u16, 10),
            task("stronger", stronger, CONTESTED..CONTESTED + 1, 20),
        ],
    }
}
