//! The coordinator on a virtual clock, between arms in memory and a list of requests. Every command that goes out
//! is checked here against what no command may ever do; the tests look at the rest.

// The check compares several lists joint by joint.
#![allow(clippy::needless_range_loop, reason = "joints are indices into several arrays at once")]

use std::collections::VecDeque;
use std::time::Duration;

use dimos::arm::{ArmCommand, ArmState, Link, Supervision};
use dimos::clock::Mono;
use dimos::control::config::*;
use dimos::control::coordinator::{Coordinator, TickTime};
use dimos::control::request::{Envelope, Motion, Request};
use dimos::control::task_spec::TaskTable;
use dimos::joint::{ControlMode, JointLimits, POSITION_MARGIN, joints_of};
use dimos::telemetry::{ArmSample, Event, Origin, Outcome, Phase, TaskView};
use dimos::trajectory::{JointTrajectory, Spline, TrajectoryPoint};

pub use super::sim_arm::SimArm;

pub const V_MAX: f64 = 1.5;
pub const A_MAX: f64 = 4.0;
pub const RANGE: f64 = 2.0;
/// A setpoint that is slower rests [rad/s].
const RESTS: f64 = 1e-6;
/// Commands stay inside the range by the margin.
pub const SOFT: f64 = RANGE - POSITION_MARGIN;

pub struct Rig {
    pub config: CoordinatorConfig,
    pub coordinator: Coordinator,
    pub arms: Vec<SimArm>,
    pub now: Mono,
    pub ticks: u64,
    pub inbox: VecDeque<Envelope>,
    /// All events, with the number of their tick.
    pub events: Vec<(u64, Event)>,
    /// The commands of the last tick.
    pub commands: Vec<ArmCommand>,
    pub samples: Vec<ArmSample>,
    pub tasks: Vec<TaskView>,
    /// Number of interruptions of all arms.
    pub epoch: u64,
    /// Ids of the motions that were given back.
    pub retired: Vec<u64>,
    /// Called with `true` before and `false` after the coordinator's tick.
    pub around: fn(bool),
    /// How late the next tick wakes, beyond the periods that it skips.
    pub late: Duration,
    /// Whether every command is checked.
    pub checked: bool,
    /// Time that the last command covered [s].
    covered: f64,
    wire: Vec<Wire>,
    next_id: u64,
}

/// The last command to an arm.
#[derive(Debug, Clone)]
struct Wire {
    mode: Option<ControlMode>,
    values: Vec<f64>,
    velocity: Vec<f64>,
    /// How far out it may be: the range, or where it was seeded.
    lowest: Vec<f64>,
    highest: Vec<f64>,
}

pub fn arm(name: &str, dof: usize) -> ArmConfig {
    let mut limits = JointLimits::uniform(dof, RANGE, V_MAX).with_defaults();
    limits.acceleration_max = vec![A_MAX; dof];
    ArmConfig {
        tool: None,
        effort: None,
        name: name.to_owned(),
        dof,
        limits,
        modes: vec![ControlMode::Position, ControlMode::ServoPosition, ControlMode::Velocity],
        gripper: true,
        gripper_info: Default::default(),
        own_velocity: Vec::new(),
        read_period: Duration::from_millis(10),
        write_period: Duration::from_millis(10),
        supervision: Supervision { stale_after: Duration::from_millis(30), ..Supervision::default() },
    }
}

pub fn task(name: &str, kind: TaskKind, joints: impl IntoIterator<Item = u16>, priority: i32) -> TaskConfig {
    TaskConfig { name: name.to_owned(), kind, joints: joints.into_iter().collect(), priority, auto_start: false }
}

pub fn trajectory() -> TaskKind {
    TaskKind::new("trajectory", &TrajectoryParams { path_tolerance: 0.1, ..TrajectoryParams::default() })
}

pub fn servo() -> TaskKind {
    TaskKind::new("servo", &ServoParams::default())
}

pub fn velocity() -> TaskKind {
    TaskKind::new("velocity", &VelocityParams::default())
}

/// A motion through the given points `(time, positions)`, at rest at both ends.
pub fn motion(id: u64, joints: &[u16], points: &[(f64, &[f64])]) -> Box<Motion> {
    let points = points.iter().map(|(t, p)| TrajectoryPoint {
        time_from_start: *t,
        positions: p[..].into(),
        velocities: Default::default(),
        accelerations: Default::default(),
    });
    let names = joints.iter().map(|j| format!("j{j}")).collect();
    let given = JointTrajectory { joint_names: names, points: points.collect() };
    Box::new(Motion { id, joints: joints.to_vec(), spline: Spline::new(&given).unwrap(), until: None })
}

/// Moves all joints from one position to another [rad].
pub fn sweep(id: u64, joints: std::ops::Range<u16>, from: f64, to: f64, seconds: f64) -> Box<Motion> {
    let joints: Vec<u16> = joints.collect();
    let n = joints.len();
    motion(id, &joints, &[(0.0, &vec![from; n]), (seconds, &vec![to; n])])
}

/// One task of the first six joints.
pub fn one(kind: TaskKind) -> Vec<TaskConfig> {
    vec![task("t", kind, 0..6, 10)]
}

impl Rig {
    pub fn new(rate: f64, arms: Vec<ArmConfig>, tasks: Vec<TaskConfig>) -> Self {
        Self::with_types(&TaskTable::builtin(), rate, arms, tasks)
    }

    /// With tasks of a table's types.
    pub fn with_types(table: &TaskTable, rate: f64, arms: Vec<ArmConfig>, tasks: Vec<TaskConfig>) -> Self {
        let config = CoordinatorConfig { version: CONFIG_VERSION, rate, arms, tasks };
        let wire = |a: &ArmConfig| Wire {
            mode: None,
            values: vec![0.0; a.dof],
            velocity: vec![0.0; a.dof],
            lowest: a.limits.position_lower.iter().map(|low| low + POSITION_MARGIN).collect(),
            highest: a.limits.position_upper.iter().map(|high| high - POSITION_MARGIN).collect(),
        };
        Self {
            coordinator: Coordinator::new(&config, table.build(&config.tasks).unwrap()),
            arms: config.arms.iter().map(|a| SimArm::new(a.dof)).collect(),
            now: Mono(1_000_000_000),
            ticks: 0,
            inbox: VecDeque::new(),
            events: Vec::new(),
            commands: vec![ArmCommand::default(); config.arms.len()],
            samples: Vec::new(),
            tasks: Vec::new(),
            epoch: 0,
            retired: Vec::new(),
            around: |_| {},
            late: Duration::ZERO,
            checked: true,
            covered: 1.0 / rate,
            wire: config.arms.iter().map(wire).collect(),
            next_id: 1,
            config,
        }
    }

    /// One 6-joint arm and these tasks at 100 Hz, ready.
    pub fn one_arm(tasks: Vec<TaskConfig>) -> Self {
        let mut rig = Self::new(100.0, vec![arm("arm", 6)], tasks);
        rig.make_ready();
        rig
    }

    /// A 7-joint and a 6-joint arm and these tasks at 100 Hz, ready.
    pub fn two_arms(tasks: Vec<TaskConfig>) -> Self {
        let mut rig = Self::new(100.0, vec![arm("left", 7), arm("right", 6)], tasks);
        rig.make_ready();
        rig
    }

    pub fn dt(&self) -> f64 {
        1.0 / self.config.rate
    }

    pub fn send(&mut self, request: Request) -> u64 {
        self.send_from(None, request)
    }

    /// Sends a request that a client made.
    pub fn send_from(&mut self, origin: Option<Origin>, request: Request) -> u64 {
        let id = self.next_id;
        self.next_id += 1;
        self.inbox.push_back(Envelope { id, origin, request });
        id
    }

    /// The origin of a request that a client makes now.
    pub fn origin(&self, client: u64) -> Option<Origin> {
        Some(Origin { epoch: self.epoch, client })
    }

    /// Sends a request that a client made, makes one tick, and returns its outcome.
    pub fn ask_from(&mut self, origin: Option<Origin>, request: Request) -> Outcome {
        let id = self.send_from(origin, request);
        self.tick();
        self.outcome(id)
    }

    /// Sends a request, makes one tick, and returns its outcome.
    pub fn ask(&mut self, request: Request) -> Outcome {
        let id = self.send(request);
        self.tick();
        self.outcome(id)
    }

    pub fn outcome(&self, id: u64) -> Outcome {
        let of = |(_, e): &(u64, Event)| match e {
            Event::Request(i, outcome) if *i == id => Some(*outcome),
            _ => None,
        };
        self.events.iter().rev().find_map(of).expect("every request is answered")
    }

    pub fn execute(&mut self, task: u16, motion: Box<Motion>) -> Outcome {
        self.ask(Request::Execute { task, motion })
    }

    pub fn servo(&mut self, task: u16, target: &[f64]) -> u64 {
        self.send(Request::Servo { task, target: joints_of(target) })
    }

    pub fn velocity(&mut self, task: u16, target: &[f64]) -> u64 {
        self.send(Request::Velocity { task, target: joints_of(target) })
    }

    /// Enables all arms and waits until they are ready.
    pub fn make_ready(&mut self) {
        self.run(2);
        for i in 0..self.arms.len() {
            assert_eq!(self.ask(Request::Enabled { arm: i as u16, outside: false }), Outcome::Accepted);
        }
        self.run_for(0.3);
        assert!((0..self.arms.len()).all(|i| self.phase(i) == Phase::Ready));
        self.events.clear();
    }

    pub fn phase(&self, arm: usize) -> Phase {
        self.samples[arm].phase
    }

    pub fn tick(&mut self) {
        self.tick_after(0);
    }

    /// Ticks after this number of skipped periods.
    pub fn tick_after(&mut self, skipped: u32) {
        let period = self.config.period();
        self.now = self.now.after(period * (skipped + 1));
        let states: Vec<ArmState> = self.arms.iter_mut().map(|a| a.observe(self.now)).collect();
        self.tick_with(&states, skipped);
        let dt = self.dt();
        for (arm, command) in self.arms.iter_mut().zip(&self.commands) {
            arm.execute_command(command, dt);
        }
    }

    /// Ticks with these states; no arm executes the commands.
    pub fn tick_with(&mut self, states: &[ArmState], skipped: u32) {
        let late_ns = skipped as u64 * self.config.period().as_nanos() as u64;
        let time = TickTime {
            now: self.now,
            next: self.now.after(self.config.period()),
            skipped,
            late_ns,
            woke_late_ns: late_ns + self.late.as_nanos() as u64,
        };
        let inbox = &mut self.inbox;
        (self.around)(true);
        let output = self.coordinator.tick(time, states, || inbox.pop_front());
        (self.around)(false);
        assert_eq!(output.events_lost, 0);
        self.ticks += 1;
        self.events.extend(output.events.iter().map(|e| (self.ticks, *e)));
        self.commands.clone_from(&output.commands);
        self.samples.clone_from(&output.arms);
        self.tasks.clone_from(&output.tasks);
        self.epoch = output.epoch;
        self.retired.extend(output.retired.drain(..).map(|m| m.id));
        if self.checked {
            self.check_wire(skipped);
        }
    }

    /// Carries an arm whose motors are off by hand, as fast as a hand can.
    pub fn carry(&mut self, arm: usize, to: &[f64]) {
        let mut most = 0.0;
        while self.arms[arm].q != to {
            most = f64::min(most + 0.03, 0.15);
            for (q, to) in self.arms[arm].q.iter_mut().zip(to) {
                *q += (to - *q).clamp(-most, most);
            }
            self.tick();
        }
        self.run(2);
    }

    pub fn run(&mut self, ticks: u64) {
        (0..ticks).for_each(|_| self.tick());
    }

    pub fn run_for(&mut self, seconds: f64) {
        self.run((seconds * self.config.rate).round() as u64);
    }

    /// Runs until `done`, for at most this time [s]. Returns the time it took [s].
    pub fn run_until(&mut self, limit: f64, mut done: impl FnMut(&Self) -> bool) -> f64 {
        for k in 0..=(limit * self.config.rate) as u64 {
            if done(self) {
                return k as f64 * self.dt();
            }
            self.tick();
        }
        panic!("not within {limit} s; tasks: {:?}; events: {:?}", self.tasks, self.events);
    }

    pub fn count(&self, wanted: impl Fn(&Event) -> bool) -> usize {
        self.events.iter().filter(|(_, e)| wanted(e)).count()
    }

    pub fn reported(&self, event: Event) -> bool {
        self.events.iter().any(|(_, e)| *e == event)
    }

    /// The position commands of an arm in the last tick.
    pub fn commanded(&self, arm: usize) -> Vec<f64> {
        self.commands[arm].values[..self.arms[arm].dof].to_vec()
    }

    /// The largest speed that an arm's commands of the last tick stand for [rad/s].
    pub fn speed(&self, arm: usize) -> f64 {
        self.wire[arm].velocity.iter().fold(0.0, |s: f64, v| s.max(v.abs()))
    }

    /// Checks the rules that every command must keep.
    fn check_wire(&mut self, skipped: u32) {
        // A single lost period is bridged: the command covers both.
        let dt = if skipped == 1 { 2.0 * self.dt() } else { self.dt() };
        // Velocities are means of a step.
        let between = 0.5 * (dt + std::mem::replace(&mut self.covered, dt));
        for (i, (wire, command)) in self.wire.iter_mut().zip(&self.commands).enumerate() {
            let (sample, arm, limits) = (&self.samples[i], &self.arms[i], &self.config.arms[i].limits);
            let was = wire.clone();
            let at = |what: &str| format!("tick {}: arm {i}: {what}: {command:?} after {was:?}", self.ticks);
            assert!(command.values.iter().all(|v| v.is_finite()) && command.gripper.is_finite(), "{}", at("F07"));
            let values = command.values[..arm.dof].to_vec();
            // Nothing was written for more than two periods: the command is what was written last, from rest.
            let starts = command.start_seq != arm.written_start;
            let unwritten = self.now.since(arm.written_at) > 2 * self.config.period();
            let gap = unwritten && !starts;
            let resting = unwritten || wire.velocity.iter().all(|v| v.abs() < RESTS);
            let Some(mode) = command.mode else {
                let reachable = arm.link == Link::Up && arm.enabled;
                assert!(wire.mode.is_none() || resting || !reachable, "{}", at("let go while it moves"));
                wire.mode = None;
                wire.velocity.fill(0.0);
                continue;
            };
            let may_move = matches!(sample.phase, Phase::Activating | Phase::Ready | Phase::Held | Phase::Standby);
            assert!(may_move && arm.enabled, "{}", at("commanded without power"));
            let switched = wire.mode != Some(mode) || starts;
            if switched {
                let still = arm.state.velocity[..arm.dof].iter().all(|v| v.abs() <= 0.05);
                assert!(resting, "{}", at("F11: mode switched while commands move"));
                assert!(wire.mode.is_none() || still || !arm.reports_velocity, "{}", at("F11: switched in motion"));
                wire.velocity.fill(0.0);
                for j in 0..arm.dof {
                    let q = arm.state.position[j];
                    wire.lowest[j] = q.min(limits.position_lower[j] + POSITION_MARGIN);
                    wire.highest[j] = q.max(limits.position_upper[j] - POSITION_MARGIN);
                }
            }
            for j in 0..arm.dof {
                let to = values[j];
                if gap && mode != ControlMode::Velocity {
                    let rested = wire.velocity[j] == 0.0;
                    let written = arm.written.as_ref().map_or(f64::NAN, |w| w[j]);
                    // A gap that ends in the tick in which the next one begins: a step from rest.
                    let most =
                        if rested { limits.acceleration_max[j] * self.covered * self.covered + 1e-9 } else { 0.0 };
                    wire.velocity[j] = if to == written { 0.0 } else { (to - written) / self.covered };
                    assert!((to - written).abs() <= most, "{}", at("in a gap"));
                    continue;
                }
                let velocity = match (mode == ControlMode::Velocity, switched) {
                    (true, _) => values[j],
                    (false, false) => (values[j] - wire.values[j]) / dt,
                    (false, true) => {
                        let from_here = (values[j] - arm.state.position[j]).abs();
                        let unchanged = wire.mode.is_none() && (values[j] - wire.values[j]).abs() < 1e-12;
                        assert!(from_here <= 0.005 || unchanged, "{}", at("F12: first step"));
                        0.0
                    }
                };
                let change = velocity - wire.velocity[j];
                assert!(velocity.abs() <= limits.velocity_max[j] * (1.0 + 1e-9) + 1e-12, "{}", at("F08 velocity"));
                let most = limits.acceleration_max[j] * between * (1.0 + 1e-6) + 1e-8;
                assert!(change.abs() <= most, "{} joint {j} by {}", at("F08 acceleration"), change / dt);
                wire.velocity[j] = velocity;
                if mode != ControlMode::Velocity {
                    let inside = (wire.lowest[j] - 1e-9..=wire.highest[j] + 1e-9).contains(&values[j]);
                    assert!(inside, "{} joint {j}", at("F09"));
                }
            }
            wire.mode = Some(mode);
            wire.values = values;
        }
    }
}
