//! Runs without threads or time: ideal arms, the coordinator on a clock that is set forward, and the real recorder.
//! Ten minutes take seconds.

use std::collections::{BTreeMap, VecDeque};
use std::path::Path;
use std::time::Duration;

use dimos::arm::{ArmState, GripperInfo, Link, Supervision, VelocitySource};
use dimos::clock::{Mono, WallOffset};
use dimos::control::config::{ArmConfig, CONFIG_VERSION, CoordinatorConfig, TaskConfig, TaskKind, TrajectoryParams};
use dimos::control::coordinator::{Coordinator, TickTime};
use dimos::control::request::{Envelope, Motion, Request};
use dimos::control::task_spec::TaskTable;
use dimos::joint::{ControlMode, JointLimits, make_joints};
use dimos::recording::log_writer::LogAttachment;
use dimos::recording::notes::{Notes, channel};
use dimos::recording::recorder::{Note, Recorder, RecorderConfig};
use dimos::recording::storage::Storage;
use dimos::recording::tcp_log::TcpChains;
use dimos::runtime::log_of;
use dimos::telemetry::describe::{ArmNames, Names};
use dimos::telemetry::{Origin, Sample, TaskView, TickSample};
use dimos::trajectory::{JointTrajectory, Spline};
use serde_json::json;

/// Ticks are this long.
pub const PERIOD: Duration = Duration::from_millis(10);
/// The first tick's deadline, in monotonic and in Unix time.
const START: (Mono, u64) = (Mono(1_000_000_000), 1_795_270_590_000_000_000);

/// One arm `arm` with a trajectory task `traj_arm`.
pub fn one_arm(dof: usize) -> CoordinatorConfig {
    let arm = ArmConfig {
        tool: None,
        effort: None,
        name: "arm".into(),
        dof,
        limits: JointLimits::uniform(dof, 3.0, 2.0).with_defaults(),
        modes: vec![ControlMode::ServoPosition, ControlMode::Velocity],
        gripper: true,
        gripper_info: GripperInfo { force_range: Some((0.0, 40.0)), ..Default::default() },
        own_velocity: Vec::new(),
        read_period: Duration::from_millis(10),
        write_period: Duration::from_millis(10),
        supervision: Supervision { stale_after: Duration::from_millis(50), ..Supervision::default() },
    };
    let task = TaskConfig {
        name: "traj_arm".into(),
        kind: TaskKind::new("trajectory", &TrajectoryParams::default()),
        joints: (0..dof as u16).collect(),
        priority: 10,
        auto_start: false,
    };
    CoordinatorConfig { version: CONFIG_VERSION, rate: 100.0, arms: vec![arm], tasks: vec![task] }
}

/// A run on a clock that is set forward.
pub struct VirtualRun {
    pub coordinator: Coordinator,
    /// States for the next tick. An enabled arm follows its commands one period later.
    pub states: Vec<ArmState>,
    /// What the tasks showed after the last tick.
    pub tasks: Vec<TaskView>,
    /// The next tick.
    pub tick: u64,
    /// Number of samples that the next tick reports as lost to the recorder.
    pub dropped: u32,
    config: CoordinatorConfig,
    names: Names,
    now: Mono,
    ring: rtrb::Producer<Sample>,
    /// The way to the recorder besides the ticks.
    pub notes: Notes,
    inbox: VecDeque<Envelope>,
    next_id: u64,
    recorder: Recorder,
    /// Models of the tool centre points, for the log.
    pub tcps: TcpChains,
}

impl VirtualRun {
    /// Begins a run and its log.
    pub fn start(config: &CoordinatorConfig, log: &Path) -> Self {
        Self::start_with(&TaskTable::builtin(), config, log)
    }

    /// The same with the task types of a table.
    pub fn start_with(table: &TaskTable, config: &CoordinatorConfig, log: &Path) -> Self {
        Self::start_stored(table, config, Some(log), Storage::default())
    }

    /// The same with a log that is stored in this way, or without one.
    pub fn start_stored(table: &TaskTable, config: &CoordinatorConfig, log: Option<&Path>, storage: Storage) -> Self {
        let arm = |a: &ArmConfig| ArmNames { hardware_id: a.name.clone(), joints: make_joints(&a.name, a.dof) };
        let names = Names {
            arms: config.arms.iter().map(arm).collect(),
            tasks: config.tasks.iter().map(|t| t.name.clone()).collect(),
        };
        let attachment = LogAttachment {
            name: "coordinator.json".into(),
            media_type: "application/json".into(),
            data: serde_json::to_vec(config).unwrap(),
        };
        let tcps = TcpChains::default();
        let record = RecorderConfig {
            path: log.map(Path::to_owned),
            run: "virtual".into(),
            names: names.clone(),
            frame_id: "coordinator".into(),
            attachments: vec![attachment],
            metadata: BTreeMap::from([("config_version".to_owned(), config.version.to_string())]),
            tcps: tcps.clone(),
            wall: WallOffset::of(START.0, START.1),
            storage,
        };
        let (ring, samples) = rtrb::RingBuffer::new(64 * 1024);
        let (notes, noted) = channel();
        let recorder = Recorder::start(record, samples, noted, |_| {}).unwrap();
        let state = |arm: &ArmConfig| ArmState {
            dof: arm.dof,
            velocity_source: VelocitySource::Measured,
            mode: ControlMode::ServoPosition,
            enabled: true,
            link: Link::Up,
            ..ArmState::default()
        };
        Self {
            coordinator: Coordinator::new(config, table.build(&config.tasks).unwrap()),
            states: config.arms.iter().map(state).collect(),
            tasks: vec![TaskView::default(); config.tasks.len()],
            tick: 0,
            dropped: 0,
            config: config.clone(),
            names,
            now: START.0,
            ring,
            notes,
            inbox: VecDeque::new(),
            next_id: 1,
            recorder,
            tcps,
        }
    }

    /// Asks something of the next tick.
    pub fn ask(&mut self, request: Request) {
        self.ask_from(request, None);
    }

    /// Asks something that a client requested.
    pub fn ask_from(&mut self, request: Request, origin: Option<Origin>) {
        let logged = log_of(&request);
        self.send_logged(request, origin, logged);
    }

    /// Asks for a trajectory.
    pub fn execute(&mut self, task: u16, trajectory: &JointTrajectory) {
        let all: Vec<&String> = self.names.arms.iter().flat_map(|a| &a.joints).collect();
        let index = |name| all.iter().position(|j| *j == name).unwrap() as u16;
        let joints = trajectory.joint_names.iter().map(index).collect();
        let motion = Motion { id: self.next_id, joints, spline: Spline::new(trajectory).unwrap(), until: None };
        let logged = json!({"execute": {"task": task, "motion": motion.id, "trajectory": trajectory}});
        self.send_logged(Request::Execute { task, motion: Box::new(motion) }, None, logged);
    }

    fn send_logged(&mut self, request: Request, origin: Option<Origin>, logged: serde_json::Value) {
        let (id, stamp) = (self.next_id, self.now);
        self.next_id += 1;
        self.notes.send(Note::Request { id, stamp, origin, json: logged.to_string() }).unwrap();
        self.inbox.push_back(Envelope { id, origin, request });
    }

    /// One tick.
    pub fn step(&mut self) {
        self.overrun(0);
    }

    /// One tick, after this number of skipped ones.
    pub fn overrun(&mut self, skipped: u32) {
        self.now = self.now.after(PERIOD * skipped);
        let next = self.now.after(PERIOD);
        for state in &mut self.states {
            state.seq += 1;
            state.stamp = self.now.before(Duration::from_micros(1500));
        }
        let late_ns = 20_000 + u64::from(skipped) * PERIOD.as_nanos() as u64;
        let time = TickTime { now: self.now, next, skipped, late_ns, woke_late_ns: late_ns };
        let output = self.coordinator.tick(time, &self.states, || self.inbox.pop_front());
        let (tick, dropped) = (self.tick, std::mem::take(&mut self.dropped));
        let (deadline, overrun_ns) = (self.now, late_ns);
        let timing = TickSample { tick, deadline, next, late_ns, compute_ns: 5_000, skipped, overrun_ns, dropped };
        let arms = output.arms.iter().map(|a| Sample::Arm(*a));
        let events = output.events.iter().map(|e| Sample::Event(tick, *e));
        for sample in arms.chain(events).chain([Sample::Tick(timing)]) {
            while self.ring.is_full() {
                std::thread::yield_now();
            }
            self.ring.push(sample).unwrap();
        }
        let period = PERIOD.as_secs_f64();
        for ((state, command), arm) in self.states.iter_mut().zip(&output.commands).zip(&self.config.arms) {
            let Some(mode) = command.mode.filter(|_| state.enabled) else { continue };
            (state.mode, state.written) = (mode, command.seq);
            for j in 0..arm.dof {
                let before = state.position[j];
                state.position[j] = match mode {
                    ControlMode::Velocity => before + command.values[j] * period,
                    _ => command.values[j],
                };
                state.velocity[j] = (state.position[j] - before) / period;
            }
        }
        self.tasks.clone_from(&output.tasks);
        self.now = next;
        self.tick += 1;
    }

    /// Waits until the recorder has taken all samples, as it does between the ticks of a run in real time.
    pub fn recorded(&self) {
        while self.ring.slots() < self.ring.buffer().capacity() {
            std::thread::yield_now();
        }
    }

    /// Returns the time of the next tick.
    pub fn now(&self) -> Mono {
        self.now
    }

    /// Closes the log.
    pub fn finish(self) {
        self.recorder.finish().unwrap();
    }
}
