//! `dimos run` of a planner blueprint while a live run has its arms: the planner attaches to that run and starts no
//! hardware. Ends by a signal, its duration, or `dimos down` with its name; the run continues.

use std::io::IsTerminal;
use std::path::Path;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::time::Duration;

use serde_json::json;

use super::arguments::{Target, connect_to, is_place_given, place};
use super::banner;
use super::exit::{Exit, Failure, Result};
use super::run::Args;
use super::run_record::RunRecord;
use super::text_log::Terminal;
use crate::blueprint::Blueprint;
use crate::metrics::{AttachedFigures, Bound, Metrics};
use crate::offline::RobotConfig;
use crate::runtime::tool::kinematics::use_kept;
use crate::runtime::{AttachedPlanner, Ending, LinkEvent, bind_metrics};
use crate::share::Relay;
use crate::view::{self, Shown, View};
use dimos_core::clock;
use dimos_rpc::api::{State, Status};
use dimos_rpc::client::{self, Client, ClientError};
use dimos_rpc::report::{ArmReport, StatusReport};
use dimos_rpc::run_dir::{Claim, LiveRun, RunDir};

/// A planner attached to a run, in its own process.
pub struct Attached {
    name: String,
    blueprint: String,
    run: LiveRun,
    /// The arms of the run.
    arms: Vec<ArmReport>,
    planner: AttachedPlanner,
    view: Option<View>,
    metrics: Option<Metrics>,
    /// The way to a run on another computer.
    _relay: Option<Relay>,
    /// Its name among the planners; released when it ends.
    _claim: Claim,
    ending: (Sender<Ending>, Receiver<Ending>),
}

/// Returns the run that a blueprint's planner attaches to; `None` if it starts its own.
pub fn chosen(args: &Args, blueprint: &Blueprint) -> Result<Option<LiveRun>> {
    // Only `--at`: a place in the environment does not decide where a run starts.
    if let Some(place) = place().filter(|_| is_place_given()) {
        return at_place(place, args, blueprint).map(Some);
    }
    let folder = RunDir::standard();
    let run = match (&args.attach, &blueprint.planner) {
        (Some(_), None) => {
            return Err(Failure::usage(format!("{} has no planner to attach", blueprint.name))
                .hint("`dimos list-blueprints` shows those with planners"));
        }
        (Some(name), _) => Some(named_run(client::find(&folder, Some(name))?, args, blueprint)?),
        (None, None) => None,
        (None, Some(_)) if args.standalone => None,
        (None, Some(_)) => matching_run(folder.runs().map_err(ClientError::from)?, args, blueprint)?,
    };
    if run.is_some() && args.record.is_some() {
        let failure = Failure::usage("an attached planner writes no log; its run does");
        return Err(failure.hint("omit --record, or start a separate run with --standalone"));
    }
    Ok(run)
}

/// Returns the run at a place that a planner attaches to.
fn at_place(place: &str, args: &Args, blueprint: &Blueprint) -> Result<LiveRun> {
    if blueprint.planner.is_none() {
        let what = format!("a run starts on the computer of its arms, and {} has no planner to attach", blueprint.name);
        return Err(Failure::usage(what).hint("omit --at; on another computer, start it there: through ssh"));
    }
    if args.standalone || args.record.is_some() {
        let option = if args.standalone { "--standalone" } else { "--record" };
        return Err(Failure::usage(format!("with --at a planner is attached to a run: omit {option}")));
    }
    let target = Target { run: args.attach.clone(), json: args.json };
    let mut runs = target.named_or_all()?;
    if args.attach.is_some()
        && let Some(run) = runs.pop()
    {
        return named_run(run, args, blueprint);
    }
    let names: Vec<String> = runs.iter().map(|run| run.name.clone()).collect();
    matching_run(runs, args, blueprint)?.ok_or_else(|| {
        let what = match names.is_empty() {
            true => format!("{place} shares no run with this client"),
            false => format!("no run at {place} has the arms of {}: {}", blueprint.name, names.join(", ")),
        };
        Failure::new(Exit::Failed, what).hint("--attach RUN says what a run lacks; `dimos status --at` lists them")
    })
}

fn named_run(run: LiveRun, args: &Args, blueprint: &Blueprint) -> Result<LiveRun> {
    let status = connect_to(&run)?.call(Status {})?;
    let Mismatch { missing, .. } = mismatch(&status, args, blueprint);
    if missing.is_empty() {
        return Ok(run);
    }
    let what = format!("the planner of {} does not fit run {}: {}", blueprint.name, run.name, missing.join("; "));
    Err(Failure::new(Exit::Failed, what).hint(format!("`dimos status --run {}` shows what the run has", run.name)))
}

fn matching_run(runs: Vec<LiveRun>, args: &Args, blueprint: &Blueprint) -> Result<Option<LiveRun>> {
    let mut fit: Vec<(LiveRun, StatusReport)> = Vec::new();
    for run in runs {
        // A run that does not answer is starting or shutting down.
        let asked = connect_to(&run).and_then(|mut client| client.call(Status {}));
        let Ok(status) = asked else { continue };
        let Mismatch { missing, differs } = mismatch(&status, args, blueprint);
        if missing.is_empty() && differs.is_empty() {
            fit.push((run, status));
        }
    }
    let names: Vec<&str> = fit.iter().map(|(run, _)| run.name.as_str()).collect();
    if fit.len() > 1 {
        return Err(Failure::usage(format!("several runs own the planner's arms: {}", names.join(", ")))
            .hint("select one with --attach RUN, or start a separate run with --standalone"));
    }
    let Some((run, status)) = fit.pop() else { return Ok(None) };
    match status.planner.and_then(|planner| planner.attached) {
        None => Ok(Some(run)),
        Some(other) => {
            let process = other.pid.map(|pid| format!(" (pid {pid})")).unwrap_or_default();
            let what = format!("run {} has a planner already: {}{process}", run.name, other.name);
            let hint = format!("`dimos down {}` ends it; --standalone starts a separate run", other.name);
            Err(Failure::new(Exit::Failed, what).hint(hint))
        }
    }
}

/// Why a run does not match a planner.
struct Mismatch {
    /// Missing parts.
    missing: Vec<String>,
    /// Parts that differ; --attach accepts these.
    differs: Vec<String>,
}

fn mismatch(run: &StatusReport, args: &Args, blueprint: &Blueprint) -> Mismatch {
    let mut mismatch = Mismatch { missing: Vec::new(), differs: Vec::new() };
    let robots = blueprint.planner.iter().flat_map(|planner| &planner.robots);
    let moved = |arm: &&crate::blueprint::Arm| {
        let joints = robots.clone().flat_map(|robot| &robot.coordinator_joints);
        arm.joints.iter().any(|joint| joints.clone().any(|j| j == joint))
    };
    for arm in blueprint.arms.iter().filter(moved) {
        let id = &arm.hardware_id;
        match run.arms.iter().find(|a| a.hardware_id == *id) {
            None => mismatch.missing.push(format!("no arm {id}")),
            Some(its) if its.adapter != arm.adapter_type => {
                mismatch.differs.push(format!("{id} is of type {}, not {}", its.adapter, arm.adapter_type));
            }
            Some(its) if args.changes.sim.is_some() && !its.simulated => {
                mismatch.differs.push(format!("{id} is not simulated"))
            }
            Some(its) => {
                let asked = args.changes.address.iter().rfind(|(arm, _)| arm == id).map(|(_, address)| address);
                if let Some(asked) = asked.filter(|asked| **asked != its.address) {
                    mismatch.differs.push(format!("{id} is at {}, not {asked}", its.address));
                }
            }
        }
    }
    mismatch.missing.extend(robots.clone().filter_map(|robot| missing_task(run, robot)));
    if run.planner.as_ref().is_some_and(|planner| planner.attached.is_none()) {
        mismatch.missing.push("it has its own planner".to_owned());
    }
    mismatch
}

fn missing_task(run: &StatusReport, robot: &RobotConfig) -> Option<String> {
    let name = robot.task.as_ref()?;
    let Some(task) = run.tasks.iter().find(|task| task.name == *name && task.takes("execute")) else {
        return Some(format!("no trajectory task {name}"));
    };
    let missing = robot.coordinator_joints.iter().find(|joint| !task.joints.contains(joint))?;
    Some(format!("task {name} does not move {missing}"))
}

impl Attached {
    /// Attaches a blueprint's planner to a run.
    pub fn start(args: &Args, blueprint: &Blueprint, mut run: LiveRun, terminal: &Terminal) -> Result<Self> {
        let relay = run.at.as_deref().map(|place| Relay::start(place, &run.name)).transpose()?;
        if let Some(relay) = &relay {
            run.socket = relay.socket().to_owned();
        }
        let name = args.name.clone().unwrap_or_else(|| blueprint.name.clone());
        let claim = RunDir::standard().planners().claim(&name);
        let claim = claim.map_err(|e| Failure::new(Exit::Failed, e.to_string()).hint(e.hint()))?;
        // The arms are connected in the run: their dimensions are those that were kept.
        let mut blueprint = blueprint.clone();
        use_kept(&mut blueprint).iter().for_each(|line| terminal.note(format!("  model      {line}")));
        let blueprint = &blueprint;
        let bound = bind(blueprint, &run, terminal)?;
        let config = blueprint.planner.clone().unwrap_or_default();
        let (terminal, json) = (terminal.clone(), args.json);
        let on_event = {
            let (name, run) = (name.clone(), run.name.clone());
            move |turn: LinkEvent| {
                let (event, line, why) = match turn {
                    LinkEvent::Back => ("attached", format!("attached to run {run} again"), None),
                    LinkEvent::Fault(why) => {
                        let line = format!("planner {name}: FAULT: run {run}: {why}; retrying");
                        ("fault", line, Some(why))
                    }
                };
                terminal.note(line);
                if json {
                    terminal.json(&json!({"event": event, "planner": name, "run": run, "why": why}));
                }
            }
        };
        let planner = AttachedPlanner::start(&name, &config, &run.socket, on_event)
            .map_err(|e| Failure::new(Exit::Failed, e.to_string()).hint(e.hint()))?;
        let started = clock::wall_now() as f64 * 1e-9;
        let figures = planner.figures(AttachedFigures {
            planner: name.clone(),
            blueprint: blueprint.name.clone(),
            run: run.name.clone(),
            started,
            ..AttachedFigures::default()
        });
        let metrics = bound.map(|bound| bound.serve(move |form| Some(figures()?.text(form)))).transpose();
        let metrics = metrics.map_err(|e| {
            Failure::new(Exit::Failed, format!("the metrics cannot be served: {e}")).hint("see ulimit -u")
        })?;
        let reports = Client::connect(&run.name, &run.socket)
            .and_then(|mut client| Ok((client.call(Status {})?, client.call(State {})?)));
        let view = reports.as_ref().ok().filter(|_| !args.no_view).and_then(|(status, state)| {
            let (config, shown) = (view::config_of(blueprint)?, Shown::of_attached(blueprint, status, state));
            let served = View::start(&config, shown, &run.socket, &claim.files());
            served.inspect_err(|why| tracing::warn!("no live view: {why}")).ok()
        });
        let arms = reports.map(|(status, _)| status.arms).unwrap_or_default();
        let (blueprint, ending) = (blueprint.name.clone(), channel());
        Ok(Self { name, blueprint, run, arms, planner, view, metrics, _relay: relay, _claim: claim, ending })
    }

    /// Returns the URL of its live view, with the token, if it serves one.
    pub fn view_url(&self) -> Option<&str> {
        self.view.as_ref().map(View::url)
    }

    /// Returns the planner's status for run records.
    pub fn report(&self) -> StatusReport {
        StatusReport {
            run: self.name.clone(),
            pid: std::process::id(),
            version: crate::VERSION.to_owned(),
            blueprint: self.blueprint.clone(),
            ..StatusReport::default()
        }
    }

    /// Returns the run that it is attached to.
    pub fn run(&self) -> &str {
        &self.run.name
    }

    /// Returns a sender with which other threads end it.
    pub fn endings(&self) -> Sender<Ending> {
        self.ending.0.clone()
    }

    /// Serves until a signal or the duration ends it.
    pub fn keep_up(self, terminal: &Terminal, args: &Args, text_log: Option<&Path>) -> Result {
        let record = RunRecord::begin(&self.report(), text_log);
        let url = self.view_url().filter(|_| text_log.is_none() && std::io::stderr().is_terminal());
        self.print_banner(terminal, url, args.json && text_log.is_none());
        let ending = match args.duration {
            Some(limit) => self.ending.1.recv_timeout(limit),
            None => self.ending.1.recv().map_err(|_| RecvTimeoutError::Disconnected),
        };
        let ending = ending.unwrap_or(Ending::Duration);
        let exit = match &ending {
            Ending::Signal(signal) => Exit::by_signal(*signal),
            _ => Exit::Ok,
        };
        let why = super::run::why(&ending);
        if args.json && text_log.is_none() {
            terminal.json(&json!({"event": "ended", "planner": self.name, "run": self.run.name, "why": why}));
        } else {
            terminal
                .note(format_args!("{why}: planner {} ended; run {} continues without it", self.name, self.run.name));
        }
        record.end(exit, why, Vec::new());
        terminal.flush();
        Ok(exit)
    }

    fn print_banner(&self, terminal: &Terminal, url: Option<&str>, json: bool) {
        let pid = std::process::id();
        if json {
            let robots: Vec<&str> = self.planner.robots().iter().map(|robot| robot.name.as_str()).collect();
            let mut event =
                json!({"event": "attached", "planner": self.name, "run": self.run.name, "pid": pid, "robots": robots});
            if let Some(metrics) = &self.metrics {
                event["metrics"] = json!(metrics.url());
            }
            return terminal.json(&event);
        }
        terminal.note(format_args!("planner {}  (pid {pid}, dimos {})", self.name, crate::VERSION));
        let place = self.run.at.as_ref().map(|place| format!(" at {place}")).unwrap_or_default();
        terminal.note(format_args!("  attached to run {}{place}", self.run.name));
        for arm in &self.arms {
            let standing = banner::standing(arm.simulated, &arm.address);
            terminal.note(format_args!("  arm        {}: {standing}, {}", arm.hardware_id, arm.adapter));
        }
        for robot in self.planner.robots() {
            let task = robot.task.as_deref().unwrap_or("the task that has its joints");
            terminal.note(format_args!("  robot      {}: {} joints, moved by {task}", robot.name, robot.joints.len()));
        }
        if let Some(view) = &self.view {
            let line = url.map_or_else(|| banner::view_without_token(view.address()), str::to_owned);
            terminal.private(format_args!("  view       {line}"));
        }
        if let Some(metrics) = &self.metrics {
            terminal.note(format_args!("  metrics    {}", metrics.url()));
        }
        terminal.note("Press Ctrl-C to detach; the run continues. In another terminal: dimos plan");
    }
}

/// Takes the address of the planner's metrics, unless its run serves its own there: one blueprint may start both.
fn bind(blueprint: &Blueprint, run: &LiveRun, terminal: &Terminal) -> Result<Option<Bound>> {
    let Some(config) = &blueprint.metrics else { return Ok(None) };
    let status = connect_to(run).and_then(|mut client| client.call(Status {}));
    let of_run = status.ok().and_then(|status| status.metrics).filter(|_| run.at.is_none());
    if of_run.is_some_and(|url| url == format!("http://{}/metrics", config.listen)) {
        terminal.note("  metrics    that address is the run's: --set metrics.listen=127.0.0.1:PORT");
        return Ok(None);
    }
    Ok(bind_metrics(blueprint)?)
}

/// Maximum time for a planner to end after SIGTERM.
const SHUTDOWN_TIMEOUT: Duration = Duration::from_secs(5);

/// Returns the live planners in their own processes.
pub fn live() -> Vec<LiveRun> {
    RunDir::standard().planners().runs().unwrap_or_default()
}

/// Ends a planner, like a signal from its terminal.
pub fn end(planner: &LiveRun, as_json: bool) -> Result {
    use rustix::process::{Pid, PidfdFlags, Signal, pidfd_open, pidfd_send_signal};
    let failed = |what: String| Failure::new(Exit::Failed, format!("planner {}: {what}", planner.name));
    let pid = Pid::from_raw(planner.pid as i32).ok_or_else(|| failed("it is still starting".into()))?;
    // Open a handle on the process first, then check that it still is the planner: pids are reused.
    let process = pidfd_open(pid, PidfdFlags::empty()).map_err(|e| failed(e.to_string()))?;
    if live().contains(planner) {
        pidfd_send_signal(&process, Signal::TERM).map_err(|e| failed(e.to_string()))?;
    }
    let asked = std::time::Instant::now();
    while live().contains(planner) {
        if asked.elapsed() > SHUTDOWN_TIMEOUT {
            return Err(failed(format!("pid {} did not end after SIGTERM", planner.pid)));
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    match as_json {
        true => super::output::json(&json!({"ended": planner.name, "pid": planner.pid})),
        false => super::output::note(format_args!("planner {} ended", planner.name)),
    }
    Ok(Exit::Ok)
}
