//! How a run comes up.

use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::sync::mpsc::{Sender, channel};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use super::arms::{self, BroughtUp};
use super::dispatch::{Courier, Dispatcher, REQUEST_RING, log_of};
use super::planner_link::command_limits;
use super::planner_port::PlannerPort;
use super::service::{Service, ServiceParts};
use super::service_manager::ServiceManager;
use super::watchdog::Watchdog;
use super::{Ending, Handle, Options, Record, Run, StartError};
use crate::arm::ArmState;
use crate::blueprint::{Arm, Blueprint};
use crate::clock::{Clock, MonotonicClock, WallOffset};
use crate::control::config::{ArmConfig, CONTROL_VERSION, CoordinatorConfig, TaskConfig, TaskKind};
use crate::control::coordinator::Coordinator;
use crate::control::request::Request;
use crate::control::task::Task;
use crate::control::task_spec::{TaskSpec, TaskTable};
use crate::control::tick_loop::{self, Pulse, TickPorts};
use crate::hardware::device;
use crate::joint::MAX_DOF;
use crate::planning::config::PlannerConfig;
use crate::planning::setup::Setup;
use crate::recording::files;
use crate::recording::log_writer::LogAttachment;
use crate::recording::notes::{self, Notes};
use crate::recording::recorder::{Note, Notice, Recorder, RecorderConfig};
use crate::recording::space;
use crate::rpc::report::StatusReport;
use crate::rpc::server::Server;
use crate::rpc::streams::Streams;
use crate::rt::host;
use crate::rt::slot::slot;
use crate::rt::wake::Wake;
use crate::telemetry::describe::{ArmNames, Names, Severity};
use crate::telemetry::{ArmSample, Cause, Phase, Sample, TaskView, TickSample};

/// So many seconds of samples fit into the recorder's ring.
const RING_SECONDS: f64 = 5.0;
/// How often an enabled arm is asked for again that is not ready yet.
const ASK_AGAIN: Duration = Duration::from_millis(100);
/// How long enabled arms get until they are ready.
const READY_LIMIT: Duration = Duration::from_secs(2);

impl Run {
    /// Starts a run. When this fails, everything that had been started is stopped again and nothing has moved.
    pub fn start(blueprint: &Blueprint, mut options: Options) -> Result<Self, StartError> {
        let name = options.name.clone().unwrap_or_else(|| blueprint.name.clone());
        let claim = options.folder.claim(&name).map_err(|e| StartError::other(&e, e.hint()))?;
        let (grants, latency) = host::prepare_process(options.hold_latency);
        let wall = WallOffset::take(&MonotonicClock);
        let log = log_path(blueprint, &options, &name, wall)?;
        if let Some(log) = &log {
            space::check(log, blueprint.recording.min_free.0).map_err(|e| split_hint(&e.to_string()))?;
        }
        let names = names_of(blueprint);
        // Before any arm is touched: a robot's description that is wrong costs nothing but its message.
        let robots = blueprint.planner.as_ref().map(robots).transpose()?;
        let (task_configs, tasks) = tasks(blueprint).map_err(|what| StartError::Blueprint {
            what,
            hint: "`dimos model check FILE` shows all that is wrong with a model".to_owned(),
        })?;
        let pulse = Arc::new(Pulse::default());
        let (notes, noted) = notes::channel();

        let device_notes = {
            let (notes, names) = (notes.clone(), names.clone());
            move |arm: usize, note: device::Note| tell_device_note(&notes, &names, arm, note)
        };
        let BroughtUp { mut arms, slots, connected } = arms::bring_up(blueprint, &pulse.beat, device_notes)?;
        let config = coordinator_config(blueprint, &connected, task_configs);
        let limits = command_limits(&names, &config);
        let planner = blueprint.planner.as_ref().zip(robots);
        let planner = planner.map(|(config, setup)| PlannerPort::start(config, setup, &limits, options.solver.take()));
        let planner = planner.transpose().map_err(|what| {
            arms.release();
            StartError::other(
                what,
                "the model's limits, the arm's, and `limits` in the blueprint must have room in common",
            )
        })?;

        let samples = ring_size(&config);
        let (mut sample_producer, mut sample_consumer) = rtrb::RingBuffer::new(samples);
        touch(&mut sample_producer, &mut sample_consumer);
        let (request_producer, request_consumer) = rtrb::RingBuffer::new(REQUEST_RING);
        let (reply_producer, reply_consumer) = rtrb::RingBuffer::new(2 * REQUEST_RING);
        let (retired_producer, retired_consumer) = rtrb::RingBuffer::new(REQUEST_RING + 2 * config.tasks.len());
        let empty = ArmSample {
            arm: 0,
            state: ArmState::default(),
            command: crate::arm::ArmCommand::default(),
            phase: Phase::Unknown,
            cause: Cause::None,
        };
        let (arm_writers, arm_readers) = config.arms.iter().map(|_| slot(empty)).unzip();
        let (task_writers, task_readers) = config.tasks.iter().map(|_| slot(TaskView::default())).unzip();
        let reply_wake = wake()?;

        let streams = Streams::default();
        let dispatcher = Arc::new(Dispatcher::new(request_producer, notes.clone()));
        let (endings, ended) = channel();
        let fail = |arms: &mut arms::Arms, error: StartError| {
            arms.release();
            error
        };
        let record = RecorderConfig {
            path: log.clone(),
            run: name.clone(),
            names: names.clone(),
            frame_id: blueprint.coordinator.joint_state_frame_id.clone(),
            attachments: attachments(blueprint, &config),
            metadata: metadata(blueprint),
            wall,
            min_free: blueprint.recording.min_free.0,
        };
        let parts = ServiceParts {
            run: name.clone(),
            blueprint: blueprint.clone(),
            config: config.clone(),
            names: names.clone(),
            connected: connected.iter().map(|(c, _)| c.clone()).collect(),
            devices: arms.devices.clone(),
            dispatcher: dispatcher.clone(),
            pulse: pulse.clone(),
            streams: streams.clone(),
            arm_views: Mutex::new(arm_readers),
            task_views: Mutex::new(task_readers),
            grants,
            wall,
            log: log.clone(),
            endings: endings.clone(),
            planner,
        };
        let service = Arc::new_cyclic(|me| Service::new(parts, me.clone()));
        let notice = {
            let (service, wall) = (service.clone(), wall);
            move |notice: Notice<'_>| service.notice(notice, wall)
        };
        let recorder = Recorder::start(record, sample_consumer, noted, notice)
            .map_err(|e| fail(&mut arms, split_hint(&e.to_string())))?;
        service.set_recorder(recorder.stats());
        retain(blueprint, &log);

        let ports = TickPorts {
            states: slots.states,
            commands: slots.commands,
            wakes: arms.devices.iter().map(|d| d.wake()).collect(),
            dues: arms.devices.iter().map(|d| d.due()).collect(),
            requests: request_consumer,
            replies: reply_producer,
            reply_wake: reply_wake.clone(),
            retired: retired_producer,
            samples: sample_producer,
            arm_views: arm_writers,
            task_views: task_writers,
            pulse: pulse.clone(),
        };
        let publish = {
            let service = service.clone();
            move |ticked| {
                service.publish(ticked);
                service.report_late_stops(wall);
            }
        };
        let io = |what: &str, e: std::io::Error| StartError::other(format!("no {what} thread: {e}"), "see ulimit -u");
        let courier = Courier::start(dispatcher.clone(), reply_wake, reply_consumer, retired_consumer, publish)
            .map_err(|e| fail(&mut arms, io("courier", e)))?;
        let tick = spawn_tick(&config, tasks, ports, options.probe.take(), endings.clone())
            .map_err(|e| fail(&mut arms, io("tick", e)))?;
        let manager = options.service_manager.take();
        let alive = signs_of_life(manager.as_ref());
        let watchdog = Watchdog::start(pulse.beat.clone(), config.period(), endings.clone(), alive)
            .map_err(|e| fail(&mut arms, io("watchdog", e)))?;
        let mut run = Self {
            arms,
            pulse,
            tick: Some(tick),
            watchdog,
            dispatcher,
            courier: Some(courier),
            recorder: Some(recorder),
            server: None,
            handle: Handle { service },
            endings: (endings, ended),
            manager,
            _latency: latency,
        };
        if let Err(error) = run.enable(blueprint) {
            run.stop();
            return Err(error);
        }
        if blueprint.rpc.enabled {
            match Server::start(claim, run.handle.service.clone()) {
                Ok(server) => run.server = Some(server),
                Err(e) => {
                    let what = format!("the socket cannot be opened: {e}");
                    run.stop();
                    return Err(StartError::other(what, "see the folder's rights, or set rpc.enabled: false"));
                }
            }
        } else {
            run.handle.service.keep(claim);
        }
        if let Some(manager) = &run.manager {
            manager.ready(&in_short(&run.status()));
        }
        Ok(run)
    }

    fn enable(&self, blueprint: &Blueprint) -> Result<(), StartError> {
        let which = || blueprint.arms.iter().enumerate().filter(|(_, a)| a.auto_enable).map(|(i, _)| i);
        self.arms.enable(blueprint, which())?;
        let limit = Instant::now() + READY_LIMIT;
        let mut ask = Instant::now();
        let settled = |arm: usize, a: &Arm| match self.handle.service.phase(arm) {
            Phase::Ready => true,
            phase => !a.auto_enable && phase != Phase::Unknown,
        };
        while !blueprint.arms.iter().enumerate().all(|(i, a)| settled(i, a)) {
            let now = Instant::now();
            if now >= limit {
                break; // The banner and `status` say how far it came.
            }
            if now >= ask {
                ask = now + ASK_AGAIN;
                let waiting =
                    |&arm: &usize| !matches!(self.service.phase(arm), Phase::Activating | Phase::Ready | Phase::Held);
                for arm in which().filter(waiting) {
                    let request = Request::Ready { arm: arm as u16 };
                    let log = log_of(&request);
                    // Whether it was taken shows in the arm's phase. On a busy host the state may not be fresh just now.
                    let _ = self.dispatcher.send(request, log);
                }
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        Ok(())
    }
}

/// The planner's robots, with what must be said of them.
pub(super) fn robots(config: &PlannerConfig) -> Result<Setup, StartError> {
    let setup = Setup::load(config).map_err(|what| StartError::Blueprint {
        what,
        hint: "`dimos model check FILE` shows all that is wrong with a model".to_owned(),
    })?;
    for (robot, [a, b]) in &setup.always_touching {
        tracing::warn!("robot {robot}: {a} and {b} touch in every pose: they are not checked against each other");
    }
    Ok(setup)
}

/// What the watchdog does at each look that finds the tick alive.
fn signs_of_life(manager: Option<&ServiceManager>) -> Box<dyn FnMut() + Send> {
    match manager.map(ServiceManager::signs_of_life) {
        Some(Ok(alive)) => Box::new(alive),
        Some(Err(e)) => {
            tracing::warn!("the service manager's watchdog is not fed: {e}");
            Box::new(|| {})
        }
        None => Box::new(|| {}),
    }
}

/// A run in a line.
fn in_short(report: &StatusReport) -> String {
    let arms: Vec<String> = report.arms.iter().map(|a| format!("{} {}", a.hardware_id, a.phase)).collect();
    let simulated = if report.simulated { ", SIMULATED" } else { "" };
    format!("{}: {}{simulated}", report.run, arms.join(", "))
}

fn wake() -> Result<Wake, StartError> {
    Wake::new().map_err(|e| StartError::other(format!("no eventfd: {e}"), "see ulimit -n"))
}

fn spawn_tick(
    config: &CoordinatorConfig,
    tasks: Vec<Task>,
    ports: TickPorts,
    probe: Option<tick_loop::Probe>,
    endings: Sender<Ending>,
) -> std::io::Result<std::thread::JoinHandle<()>> {
    let (coordinator, period) = (Coordinator::new(config, tasks), config.period());
    std::thread::Builder::new().name("tick".into()).stack_size(host::STACK).spawn(move || {
        let ran = catch_unwind(AssertUnwindSafe(|| {
            tick_loop::run(coordinator, ports, period, &MonotonicClock, probe);
        }));
        if let Err(panic) = ran {
            let text = panic.downcast_ref::<&str>().map(|s| (*s).to_owned());
            let text = text.or_else(|| panic.downcast_ref::<String>().cloned()).unwrap_or_default();
            let _ = endings.send(Ending::Fault(format!("the tick thread panicked: {text}")));
        }
    })
}

/// Touches every page of the ring, so that no page fault comes while it is filled for the first time.
fn touch(producer: &mut rtrb::Producer<Sample>, consumer: &mut rtrb::Consumer<Sample>) {
    while producer.push(Sample::Tick(TickSample::default())).is_ok() {}
    if let Ok(chunk) = consumer.read_chunk(consumer.slots()) {
        let (first, second) = chunk.as_slices();
        host::lock_pages(first);
        host::lock_pages(second);
        chunk.commit_all();
    }
}

fn ring_size(config: &CoordinatorConfig) -> usize {
    let per_tick = config.arms.len() + 1;
    512 + (per_tick as f64 * config.rate * RING_SECONDS) as usize
}

fn names_of(blueprint: &Blueprint) -> Names {
    Names {
        arms: blueprint
            .arms
            .iter()
            .map(|a| ArmNames { hardware_id: a.hardware_id.clone(), joints: a.joints.clone() })
            .collect(),
        tasks: blueprint.tasks.iter().map(|t| t.name.clone()).collect(),
    }
}

/// What the blueprint's tasks are to the coordinator. The robots of those that move an end effector are read here.
fn tasks(blueprint: &Blueprint) -> Result<(Vec<TaskConfig>, Vec<Task>), String> {
    let config = |task: &crate::blueprint::Task| -> Result<TaskConfig, String> {
        let robot = task.robot.as_ref().map(|robot| robot.kinematics().map(Box::new)).transpose();
        let robot = robot.map_err(|what| format!("task {}: {what}", task.name))?;
        Ok(TaskConfig {
            name: task.name.clone(),
            kind: TaskKind { name: task.spec.name.to_owned(), params: task.params.clone(), robot },
            joints: task.joints.iter().map(|&j| j as u16).collect(),
            priority: task.priority,
            auto_start: task.auto_start,
        })
    };
    let configs = blueprint.tasks.iter().map(config).collect::<Result<Vec<_>, _>>()?;
    let types: Vec<TaskSpec> = blueprint.tasks.iter().map(|task| task.spec).collect();
    let tasks = TaskTable::with(&types).build(&configs)?;
    Ok((configs, tasks))
}

fn coordinator_config(
    blueprint: &Blueprint,
    connected: &[(device::Connected, crate::joint::JointLimits)],
    tasks: Vec<TaskConfig>,
) -> CoordinatorConfig {
    let arms = blueprint.arms.iter().zip(connected);
    CoordinatorConfig {
        version: CONTROL_VERSION,
        rate: blueprint.coordinator.tick_rate,
        arms: arms
            .map(|(arm, (said, limits))| ArmConfig {
                name: arm.hardware_id.clone(),
                dof: arm.joints.len().min(MAX_DOF),
                limits: limits.clone(),
                modes: said.info.modes.to_vec(),
                gripper: arm.adapter.gripper,
                own_velocity: said.limits.velocity_max.clone(),
                read_period: said.read_period,
                write_period: said.write_period,
                supervision: arm.supervision,
            })
            .collect(),
        tasks,
    }
}

fn log_path(
    blueprint: &Blueprint,
    options: &Options,
    run: &str,
    wall: WallOffset,
) -> Result<Option<PathBuf>, StartError> {
    match &options.record {
        Record::Off => Ok(None),
        Record::To(path) => Ok(Some(path.clone())),
        Record::AsBlueprint if !blueprint.recording.enabled => Ok(None),
        Record::AsBlueprint => {
            let folder = log_folder(blueprint).ok_or_else(|| {
                StartError::other("no folder for the log: neither XDG_STATE_HOME nor HOME is set", "use --record FILE")
            })?;
            Ok(Some(files::new_log_path(&folder, run, wall.wall(MonotonicClock.now()))))
        }
    }
}

fn log_folder(blueprint: &Blueprint) -> Option<PathBuf> {
    blueprint.recording.directory.as_ref().map(PathBuf::from).or_else(files::log_folder)
}

/// Removes the oldest logs beyond what the blueprint keeps.
fn retain(blueprint: &Blueprint, log: &Option<PathBuf>) {
    let folder = log_folder(blueprint).filter(|f| log.as_deref().and_then(|l| l.parent()) == Some(f));
    if let (Some(folder), 1..) = (folder, blueprint.recording.keep)
        && let Err(e) = files::retain(&folder, blueprint.recording.keep as usize)
    {
        tracing::warn!("old logs were not removed: {e}");
    }
}

/// The blueprint as read and as resolved, and what the coordinator was made from: with these and its messages a log
/// can be run again.
fn attachments(blueprint: &Blueprint, config: &CoordinatorConfig) -> Vec<LogAttachment> {
    let yaml = |name: String, text: &str| LogAttachment {
        name,
        media_type: "application/yaml".to_owned(),
        data: text.as_bytes().to_vec(),
    };
    let mut all = vec![yaml("blueprint.yaml".to_owned(), &blueprint.source_yaml)];
    all.extend(blueprint.sources.iter().map(|(name, text)| yaml(format!("source/{name}"), text)));
    all.push(LogAttachment {
        name: "coordinator.json".to_owned(),
        media_type: "application/json".to_owned(),
        // Plain structs with string keys always encode.
        data: serde_json::to_vec_pretty(config).unwrap_or_default(),
    });
    all
}

fn metadata(blueprint: &Blueprint) -> BTreeMap<String, String> {
    BTreeMap::from([
        ("blueprint".to_owned(), blueprint.name.clone()),
        ("tick_rate".to_owned(), blueprint.coordinator.tick_rate.to_string()),
        ("dimos_version".to_owned(), crate::VERSION.to_owned()),
        ("simulated".to_owned(), blueprint.arms.iter().any(|a| a.simulated).to_string()),
    ])
}

fn tell_device_note(notes: &Notes, names: &Names, arm: usize, note: device::Note) {
    let id = names.arm(arm as u16);
    let (severity, text) = match note {
        device::Note::Began(text) => (Severity::Warn, format!("{id}: {text}")),
        device::Note::Over(text) => (Severity::Info, format!("{id}: over: {text}")),
    };
    // One line per episode, without DIMOS_LOG=info.
    match severity {
        Severity::Info => tracing::info!("{text}"),
        _ => tracing::warn!("{text}"),
    }
    let stamp = MonotonicClock.now();
    // Only a run that is ending has no recorder any more.
    let _ = notes.send(Note::ArmText { arm: arm as u16, text: text.clone() });
    let _ = notes.send(Note::Log { severity, stamp, text });
}

fn split_hint(text: &str) -> StartError {
    let (what, hint) = text.split_once("\nhint: ").unwrap_or((text, "run with --no-record"));
    StartError::other(what, hint)
}
