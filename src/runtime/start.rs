//! The start of a run, in stages. Each stage owns what it has started and releases it when dropped: a start that fails
//! leaves nothing behind, at any stage.
//!
//! ```text
//! Prepared ─────────▶ Connected ───────────▶ Run ───────────────────────────────▶ enabled ─▶ listening
//! name, log, models   devices, arms' limits  recorder, outcomes, tick, watchdog   motors     socket, live view
//! ```
//!
//! Only the live view may fail: the run starts without it, with a warning.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::mpsc::{Sender, channel};
use std::time::{Duration, Instant};

use super::arm::ArmLinks;
use super::arm::arms::{self, Arms, BroughtUp, Slots, full_address};
use super::arm::control_config::{coordinator_config, efforts, names_of, tasks, tools};
use super::arm::device_lock::is_this_computer;
use super::arm::wires::wires;
use super::client::dispatch::{Dispatcher, OutcomeThread};
use super::client::in_process;
use super::client::tick_link::TickLink;
use super::facts::Facts;
use super::gripper::Grippers;
use super::lifecycle::Lifecycle;
use super::log::Journal;
use super::log::log_file::{attachments, log_device_note, log_path, metadata, no_log, retain, storage};
use super::log::metrics;
use super::motion::going::Goings;
use super::motion::motions::Motions;
use super::motion::streams::Streams;
use super::plan::guard_worlds::{GuardEnds, GuardWorlds};
use super::plan::planner_link::command_limits;
use super::plan::{PlannerPort, Plans};
use super::service_manager::ServiceManager;
use super::tick::Tick;
use super::tick_source::source;
use super::tool::Tools;
use super::tool::kinematics::{self, Known};
use super::watchdog::Watchdog;
use super::{Ending, Handle, Options, Run, Service, StartError};
use crate::blueprint::Blueprint;
use crate::view::{self, Shown, View};
use dimos_control::config::{CoordinatorConfig, TaskConfig};
use dimos_control::task::Task;
use dimos_control::tick_loop::Pulse;
use dimos_core::clock::{MonotonicClock, WallOffset};
use dimos_core::joint::JointLimits;
use dimos_core::telemetry::Sample;
use dimos_core::telemetry::describe::Names;
use dimos_hardware::device;
use dimos_log::files;
use dimos_log::notes::{self, NoteReceiver, Notes};
use dimos_log::recorder::{Notice, Recorder, RecorderConfig};
use dimos_planner::planning::scene::config::PlannerConfig;
use dimos_planner::planning::scene::planning_scene::{PlanningScene, fixed_contacts};
use dimos_robot::calibrated::Places;
use dimos_rpc::report::StatusReport;
use dimos_rpc::run_dir::Claim;
use dimos_rpc::server::Server;
use dimos_rt::host::{self, Grant, LatencyHold};

/// Minimum time between two looks for values of an arm that change slowly.
const DETAILS_PERIOD: Duration = Duration::from_millis(50);

impl Run {
    /// Starts a run. On failure everything is stopped again, and nothing has moved.
    pub fn start(blueprint: &Blueprint, options: Options) -> Result<Self, StartError> {
        let view = options.view;
        // If a later stage fails, the run ends before its name is released.
        let prepared = Prepared::new(blueprint, options)?;
        let metrics = metrics::bind(blueprint)?;
        let (claim, mut run) = prepared.connect()?.start()?;
        run.enable(blueprint)?;
        run.handle.service().check_models();
        if blueprint.rpc.enabled {
            let server = Server::start(claim, run.handle.service().clone()).map_err(|e| {
                let hint = "see the folder's rights, or set rpc.enabled: false";
                StartError::other(format!("the socket cannot be opened: {e}"), hint)
            })?;
            run.server = Some(server);
            if view {
                run.serve_view();
            }
        } else {
            claim.refuse_clients();
            run.handle.service().lifecycle.keep(claim);
        }
        run.metrics = metrics.map(|bound| metrics::serve(bound, run.handle.service())).transpose()?;
        if let Some(manager) = &run.manager {
            manager.ready(&status_line(&run.status()));
        }
        Ok(run)
    }

    /// Serves the live view, if the blueprint has one.
    fn serve_view(&mut self) {
        let service = self.handle.service().clone();
        let blueprint = &service.facts.blueprint;
        let claim = self.server.as_ref().map(Server::claim);
        let Some((config, claim)) = view::config_of(blueprint).zip(claim) else { return };
        let shown = Shown::of_run(self.name(), blueprint, self.config());
        match View::start(&config, shown, &claim.far_socket(), &claim.files()) {
            Ok(view) => {
                self.handle.service().journal.set_view(view.address());
                self.view = Some(view);
            }
            Err(why) => tracing::warn!("no live view: {why}"),
        }
    }

    fn enable(&self, blueprint: &Blueprint) -> Result<(), StartError> {
        let which = blueprint.arms.iter().enumerate().filter(|(_, arm)| arm.auto_enable).map(|(i, _)| i);
        self.arms.enable(blueprint, which)?;
        in_process::wait_for(self.handle.service().first_ready());
        Ok(())
    }
}

/// A run with its name claimed and its blueprint checked. No arm was contacted.
struct Prepared {
    blueprint: Blueprint,
    options: Options,
    name: String,
    names: Names,
    log: Option<PathBuf>,
    wall: WallOffset,
    robots: Option<PlanningScene>,
    task_configs: Vec<TaskConfig>,
    tasks: Vec<Task>,
    grants: Vec<Grant>,
    latency: Option<LatencyHold>,
    claim: Claim,
}

impl Prepared {
    fn new(blueprint: &Blueprint, options: Options) -> Result<Self, StartError> {
        let name = options.name.clone().unwrap_or_else(|| blueprint.name.clone());
        let claim = options.folder.claim(&name).map_err(|e| StartError::other(&e, e.hint()))?;
        let claim = claim.or_in(files::log_folder().map(|folder| folder.join("run")));
        let (grants, latency) = host::prepare_process(options.hold_latency);
        let wall = WallOffset::take(&MonotonicClock);
        let log = log_path(blueprint, &options, &name, wall)?;
        let robots = blueprint.planner.as_ref().map(robots).transpose()?;
        let (task_configs, tasks) = tasks(blueprint).map_err(wrong_model)?;
        let names = names_of(blueprint);
        let blueprint = blueprint.clone();
        Ok(Self { blueprint, options, name, names, log, wall, robots, task_configs, tasks, grants, latency, claim })
    }

    fn connect(mut self) -> Result<Connected, StartError> {
        let pulse = Arc::new(Pulse::default());
        let (notes, noted) = notes::channel();
        let device_notes = {
            let (notes, names) = (notes.clone(), self.names.clone());
            move |arm: usize, note: device::Note| log_device_note(&notes, &names, arm, note)
        };
        let BroughtUp { arms, slots, connected } =
            arms::bring_up(&self.blueprint, self.options.folder.is_closed(), &pulse.beat, device_notes)?;
        for (arm, (said, _)) in self.blueprint.arms.iter_mut().zip(&connected) {
            if let Some(bridging) = said.bridging {
                arm.supervision.gap_tolerance = bridging.tolerance;
                arm.supervision.after_gap = bridging.after;
            }
            let own = said.reduction.as_ref().and_then(|reduction| reduction.tool_velocity);
            arm.tcp_velocity = arm.tcp_velocity.into_iter().chain(own).reduce(f64::min);
        }
        let kinematics = self.calibrate(&connected)?;
        let tools = tools(&self.blueprint).map_err(wrong_model)?;
        let added = (tools, efforts(&self.blueprint, &connected)?);
        let config = coordinator_config(&self.blueprint, &connected, std::mem::take(&mut self.task_configs), added);
        let planner = self.blueprint.planner.as_ref().zip(self.robots.take()).map(|(planner, setup)| {
            let limits = command_limits(&self.names, &config, &self.blueprint.arms);
            PlannerPort::start(planner, setup, &limits, self.options.solver.take()).map_err(|what| {
                let hint = "the model's limits, the arm's, and `limits` in the blueprint must overlap";
                StartError::other(what, hint)
            })
        });
        let planner = planner.transpose()?;
        let connected = connected.into_iter().map(|(connected, _)| connected).collect();
        Ok(Connected { arms, slots, connected, kinematics, config, planner, pulse, notes, noted, prepared: self })
    }

    /// Puts the dimensions of the connected arms into the models. Returns what is to be said of each.
    fn calibrate(&mut self, connected: &[(device::Connected, JointLimits)]) -> Result<Vec<Option<String>>, StartError> {
        let about = self.blueprint.arms.iter().zip(connected);
        let known: Vec<_> = about.map(|(arm, (about, _))| Known::connected(arm, about)).collect();
        let before = self.blueprint.clone();
        let notes = kinematics::correct(&mut self.blueprint, &known);
        let robots_of = |blueprint: &Blueprint| {
            let planned = blueprint.planner.iter().flat_map(|planner| &planner.robots);
            planned.map(|robot| (robot.places.clone(), robot.controller_base.clone())).collect::<Vec<_>>()
        };
        let tasks_of = |blueprint: &Blueprint| -> Vec<Places> {
            blueprint.tasks.iter().filter_map(|task| Some(task.robot.as_ref()?.source.places.clone())).collect()
        };
        // Models are read again only where they have changed.
        if robots_of(&before) != robots_of(&self.blueprint) || tasks_of(&before) != tasks_of(&self.blueprint) {
            self.robots = self.blueprint.planner.as_ref().map(robots).transpose()?;
            (self.task_configs, self.tasks) = tasks(&self.blueprint).map_err(wrong_model)?;
        }
        Ok(notes)
    }
}

/// A run with connected arms. Fields are dropped in this order: the arms before the name.
struct Connected {
    arms: Arms,
    slots: Slots,
    connected: Vec<device::Connected>,
    kinematics: Vec<Option<String>>,
    config: CoordinatorConfig,
    planner: Option<PlannerPort>,
    pulse: Arc<Pulse>,
    notes: Notes,
    noted: NoteReceiver,
    prepared: Prepared,
}

impl Connected {
    /// Starts the threads. If one cannot be started, the previous ones end.
    fn start(self) -> Result<(Claim, Run), StartError> {
        // Dropped in reverse order: the arms before the name.
        let Self { prepared, mut arms, slots, connected, kinematics, config, planner, pulse, notes, noted } = self;
        let source = source(&prepared.blueprint, &mut arms, &connected)?;
        let margin = prepared.blueprint.guard.filter(|_| planner.is_some());
        let (ports, ends) = wires(&config, slots, &arms, source, pulse.clone(), margin.is_some())?;
        let guard = match (&planner, margin, ends.guard) {
            (Some(port), Some(margin), Some(ends)) => Some(guard(port, &prepared.names, margin, ends)?),
            _ => None,
        };
        let dispatcher = Arc::new(Dispatcher::new(ends.requests, notes));
        let (endings, ended) = channel();
        let tools = prepared.blueprint.tasks.iter().map(|task| task.robot.as_ref()?.tool).collect();
        let facts = Facts {
            run: prepared.name.clone(),
            blueprint: prepared.blueprint.clone(),
            config: config.clone(),
            names: prepared.names.clone(),
            connected,
            kinematics,
            // Once, as it may wait for the name of a host.
            local: { &prepared.blueprint.arms }
                .iter()
                .map(|arm| !arm.is_real() || is_this_computer(&full_address(arm)))
                .collect(),
            grants: prepared.grants.clone(),
            wall: prepared.wall,
            log: prepared.log.clone(),
            text: prepared.options.text.clone(),
        };
        let devices = arms.devices.clone();
        let service = Arc::new_cyclic(|me| Service {
            tick: TickLink::new(dispatcher.clone(), pulse.clone(), ends.arm_views, ends.task_views),
            grippers: Grippers::new(devices.len()),
            tools: Tools::new(tools, devices.len()),
            arms: ArmLinks::new(devices, arms.peripherals.clone(), arms.serials.clone()),
            motions: Motions::default(),
            goings: Goings::default(),
            streams: Streams::new(facts.config.tasks.len()),
            plans: Plans::new(planner, guard.clone()),
            journal: Journal::default(),
            lifecycle: Lifecycle::new(endings.clone()),
            facts,
            me: me.clone(),
        });
        let recorder = start_recorder(&prepared, &config, ends.samples, noted, &service)?;
        let publish = publisher(service.clone(), prepared.wall);
        service.log_calibration();
        let outcomes = OutcomeThread::start(dispatcher.clone(), ends.reply_wake, ends.replies, ends.retired, publish);
        let outcomes = outcomes.map_err(no_thread("outcomes"))?;
        let Options { probe, service_manager: manager, .. } = prepared.options;
        let tick = Tick::start(&config, prepared.tasks, ports, probe, endings.clone()).map_err(no_thread("tick"))?;
        if let Some(guard) = guard {
            guard.run(&Arc::downgrade(&service)).map_err(no_thread("guard"))?;
        }
        let watchdog = start_watchdog(&pulse, &config, &endings, manager.as_ref())?;
        let run = Run {
            arms,
            tick,
            watchdog,
            outcomes: Some(outcomes),
            recorder: Some(recorder),
            view: None,
            metrics: None,
            server: None,
            handle: Handle::new(service),
            endings: (endings, ended),
            manager,
            _latency: prepared.latency,
        };
        Ok((prepared.claim, run))
    }
}

fn start_recorder(
    prepared: &Prepared,
    config: &CoordinatorConfig,
    samples: rtrb::Consumer<Sample>,
    noted: NoteReceiver,
    service: &Arc<Service>,
) -> Result<Recorder, StartError> {
    let (blueprint, wall) = (&prepared.blueprint, prepared.wall);
    service.log_tcps();
    let mut attachments = attachments(blueprint, config);
    let storage = storage(blueprint, &prepared.options);
    if prepared.log.is_some() || storage.fault_log.is_some() {
        attachments.extend(service.log_robots());
        service.log_world();
    }
    let record = RecorderConfig {
        path: prepared.log.clone(),
        run: prepared.name.clone(),
        names: prepared.names.clone(),
        frame_id: blueprint.coordinator.joint_state_frame_id.clone(),
        attachments,
        metadata: metadata(blueprint, config),
        tcps: service.journal.tcps(),
        wall,
        storage,
    };
    let receiver = service.clone();
    let notice = move |notice: Notice<'_>| receiver.notice(notice, wall);
    let recorder = Recorder::start(record, samples, noted, notice).map_err(no_log)?;
    service.journal.set_recorder(recorder.stats());
    retain(blueprint, &prepared.log);
    Ok(recorder)
}

/// Returns the work of the outcome thread at each wake-up.
fn publisher(service: Arc<Service>, wall: WallOffset) -> impl FnMut(bool) + Send + 'static {
    let mut details_due = Instant::now();
    move |woken| {
        service.tick.made();
        service.publish(woken);
        service.tick.send_lease_ends();
        service.command_gripper_targets();
        service.judge_grips();
        if Instant::now() >= details_due {
            service.log_details();
            service.log_tcps();
            service.check_models();
            service.log_world();
            details_due = Instant::now() + DETAILS_PERIOD;
        }
        service.report_late_stops(wall);
    }
}

fn start_watchdog(
    pulse: &Pulse,
    config: &CoordinatorConfig,
    endings: &Sender<Ending>,
    manager: Option<&ServiceManager>,
) -> Result<Watchdog, StartError> {
    let alive = watchdog_ping(manager);
    let watchdog = Watchdog::start(pulse.beat.clone(), config.period(), endings.clone(), alive);
    watchdog.map_err(no_thread("watchdog"))
}

fn guard(port: &PlannerPort, names: &Names, margin: f64, ends: GuardEnds) -> Result<Arc<GuardWorlds>, StartError> {
    GuardWorlds::start(port, names, margin, ends).map(Arc::new).map_err(|what| {
        let hint = "set guard.enabled: false to run without the collision guard";
        StartError::other(format!("no collision guard: {what}"), hint)
    })
}

fn no_thread(name: &'static str) -> impl FnOnce(std::io::Error) -> StartError {
    move |error| StartError::other(format!("no {name} thread: {error}"), "see ulimit -u")
}

fn wrong_model(what: String) -> StartError {
    StartError::Blueprint { what, hint: "`dimos model check FILE` shows all that is wrong with a model".to_owned() }
}

/// Loads the planner's robots and logs warnings about them.
pub(in crate::runtime) fn robots(config: &PlannerConfig) -> Result<PlanningScene, StartError> {
    let setup = PlanningScene::load(config).map_err(wrong_model)?;
    for (robot, [a, b]) in &setup.always_touching {
        tracing::warn!(
            "robot {robot}: {a} and {b} touch in every configuration: they are not checked against each other"
        );
    }
    warn_of_fixed_contacts(&fixed_contacts(&setup.world));
    Ok(setup)
}

/// Warns of pairs in contact that no motion changes.
pub(in crate::runtime) fn warn_of_fixed_contacts(pairs: &[[String; 2]]) {
    for [a, b] in pairs {
        tracing::warn!("{a} and {b} touch, and no planned joint moves them: they are not checked against each other");
    }
}

/// Returns the watchdog's work at each check that finds the tick alive.
fn watchdog_ping(manager: Option<&ServiceManager>) -> Box<dyn FnMut() + Send> {
    match manager.map(ServiceManager::watchdog_ping) {
        Some(Ok(alive)) => Box::new(alive),
        Some(Err(e)) => {
            tracing::warn!("the service manager's watchdog is not fed: {e}");
            Box::new(|| {})
        }
        None => Box::new(|| {}),
    }
}

/// Returns a line about the run.
fn status_line(report: &StatusReport) -> String {
    let arms: Vec<String> = report.arms.iter().map(|a| format!("{} {}", a.hardware_id, a.phase)).collect();
    let standing = Some(report.standing()).filter(|text| !text.is_empty());
    let parts: Vec<&str> = arms.iter().map(String::as_str).chain(standing).collect();
    format!("{}: {}", report.run, parts.join(", "))
}
