//! `dimos status`: all runs in one line each, or one in full.

use serde::Serialize;

use super::arguments::{Target, connect_to, place};
use super::arm::parts::{gripper_line, io_lines, joint_lines, payload_text};
use super::arm::tool::tcp_text;
use super::attach;
use super::banner::{self, at_exit};
use super::exit::{Exit, Result};
use super::other_users;
use super::output::{self, Table, Tone, number, span, toned};
use super::run_record::{RunRecord, RunState};
use super::speed::describe;
use dimos_rpc::api::{SpeedReport, Status};
use dimos_rpc::client::ClientError;
use dimos_rpc::report::{ArmReport, Percentiles, PlannerStatus, StatusReport, TaskReport};
use dimos_rpc::report::{LED_BY_CONTROLLER, end_of_lead};
use dimos_rpc::run_dir::LiveRun;

/// Arguments of `status`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
What needs attention comes first: arms that are held, faults, tasks that were aborted, a log that ended, real-time measures \
that the system did not grant to a run with a real arm. -v adds what is read, counted and measured, with the ranges of the \
gripper and the link whose pose is printed.")]
pub struct Args {
    /// Run to show in full
    #[arg(value_name = "RUN", conflicts_with = "run")]
    pub name: Option<String>,
    /// Add condition of the joints, inputs and outputs, counters, and p99.9 of the timing
    #[arg(short, long)]
    pub verbose: bool,
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

/// An entry of the overview. Every entry has a name under `run`, `pid`, `state`, `arms` and `log`.
#[derive(Serialize)]
#[serde(untagged)]
enum RunEntry {
    Answered {
        state: &'static str,
        #[serde(flatten)]
        report: Box<StatusReport>,
    },
    NoReply {
        run: String,
        pid: u32,
        state: &'static str,
        error: String,
        arms: [(); 0],
        log: Option<String>,
    },
    Failed(FailedRun),
    /// A planner in its own process without its run.
    Waits {
        run: String,
        pid: u32,
        state: &'static str,
        arms: [(); 0],
        log: Option<String>,
    },
}

/// A run that crashed, or that a fault or the end of its log ended, and that has not been started again.
#[derive(Serialize)]
struct FailedRun {
    /// `crashed`, `fault` or `log_ended`.
    state: &'static str,
    arms: [(); 0],
    /// The run and its end.
    #[serde(flatten)]
    record: RunRecord,
    /// Whether it crashed without recording its end; otherwise a fault or the end of its log ended it.
    crashed: bool,
    /// The last lines of its text log.
    last_words: Vec<String>,
}

/// Runs the verb: the named run, or the only one, in full; several as a list. `--json` without a name always prints a
/// list.
pub fn run(args: &Args) -> Result {
    let target = Target { run: args.name.clone().or(args.target_run.run.clone()), ..args.target_run };
    let mut runs = target.named_or_all().map_err(|failure| {
        let dead = target.run.as_deref().and_then(RunRecord::failure_of);
        dead.unwrap_or(failure)
    })?;
    if target.run.is_some() || (runs.len() == 1 && !target.json) {
        let Some(run) = runs.pop() else { return Ok(Exit::Ok) };
        let report = request_status(&run);
        match &report {
            Ok(report) if target.json => output::json(report),
            Ok(report) => print(report, args.verbose),
            Err(_) => {}
        }
        if target.run.is_none() {
            failed_runs(&[run]).iter().for_each(print_failed);
            note_others(false);
        }
        report?;
    } else {
        let found_none = runs.is_empty();
        overview(runs, target.json);
        note_others(found_none);
    }
    Ok(Exit::Ok)
}

/// Says which runs of this computer are not shown.
fn note_others(found_none: bool) {
    for other in other_users::runs() {
        output::note(format_args!("note: run {other} is live; only that user sees its status"));
    }
    other_users::note_unseen(found_none);
}

/// Returns the runs that failed and have not been started again.
fn failed_runs(live: &[LiveRun]) -> Vec<FailedRun> {
    // The records are those of this computer.
    if place().is_some() {
        return Vec::new();
    }
    let dead = RunRecord::all().into_iter().filter(|r| !live.iter().any(|l| l.name == r.run) && r.ended_abnormally());
    let failed = |record: RunRecord| {
        let state = match record.state() {
            RunState::Crashed => "crashed",
            RunState::Ended(end) if Exit::of(end.exit) == Exit::Log => "log_ended",
            _ => "fault",
        };
        FailedRun { state, arms: [], crashed: state == "crashed", last_words: record.last_words(), record }
    };
    dead.map(failed).collect()
}

fn print_failed(failed: &FailedRun) {
    output::line("");
    output::line(failed.record.describe_end().unwrap_or_default());
    failed.last_words.iter().for_each(|text| output::wrapped(format_args!("  {text}")));
}

fn request_status(run: &LiveRun) -> std::result::Result<StatusReport, ClientError> {
    let _slow = output::note_if_slow(run, "still waiting; `dimos stop` may not reach it either");
    connect_to(run)?.call(Status {})
}

fn overview(runs: Vec<LiveRun>, json: bool) {
    let failed_runs = failed_runs(&runs);
    // At once: each of many runs on other computers takes a few milliseconds.
    let replies: Vec<_> = std::thread::scope(|scope| {
        let asked: Vec<_> = runs.iter().map(|run| scope.spawn(|| request_status(run))).collect();
        asked.into_iter().filter_map(|reply| reply.join().ok()).collect()
    });
    let answers = runs.into_iter().zip(replies).map(|(run, reply)| match reply {
        Ok(report) => RunEntry::Answered { state: "live", report: Box::new(report) },
        Err(error) => RunEntry::NoReply {
            run: run.name,
            pid: run.pid,
            state: "no_reply",
            error: error.to_string(),
            arms: [],
            log: None,
        },
    });
    let mut found: Vec<RunEntry> = answers.chain(failed_runs.into_iter().map(RunEntry::Failed)).collect();
    let waiting = waiting(found.iter().filter_map(answered));
    let state = "waiting_planner";
    found.extend(waiting.into_iter().map(|p| RunEntry::Waits { run: p.name, pid: p.pid, state, arms: [], log: None }));
    if json {
        return output::json(&found);
    }
    if found.is_empty() {
        return output::note("no run of this user is live\nhint: start one: dimos run coordinator-yourarm");
    }
    let mut table = Table::new(&["RUN", ">PID", "UP", "BLUEPRINT", "~ARMS"]);
    let mut logs: Vec<(&str, String)> = Vec::new();
    for found in &found {
        match found {
            RunEntry::Answered { report: r, .. } => {
                let arms: Vec<String> = r.arms.iter().map(|a| format!("{} {}", a.hardware_id, a.phase)).collect();
                logs.extend(r.log.clone().map(|log| (r.run.as_str(), log)));
                let arms = format!("{} {}", arms.join(", "), r.standing()).trim_end().to_owned();
                table.row([r.run.clone(), r.pid.to_string(), span(r.uptime), r.blueprint.clone(), arms]);
            }
            RunEntry::NoReply { run, pid, error, .. } => {
                let [pid, error] = [pid.to_string(), error.clone()];
                table.row([run.as_str(), &pid, "-", "-", &error]);
            }
            RunEntry::Failed(FailedRun { record, state, .. }) => {
                let how = match *state {
                    "crashed" => "CRASHED",
                    "log_ended" => "LOG ENDED",
                    _ => "FAULT",
                };
                let how = toned(how, Tone::Bad);
                logs.extend(record.log.as_ref().map(|log| (record.run.as_str(), log.display().to_string())));
                let [run, pid, blueprint] = [record.run.clone(), record.pid.to_string(), record.blueprint.clone()];
                table.row([run.into(), pid.into(), "-".into(), blueprint.into(), how]);
            }
            RunEntry::Waits { run, pid, .. } => {
                let pid = pid.to_string();
                table.row([run.as_str(), &pid, "-", "-", "a planner waiting for its run"]);
            }
        }
    }
    table.print();
    logs.iter().for_each(|(run, log)| output::wrapped(format_args!("  {run}: log {log}")));
    let planners: Vec<_> =
        found.iter().filter_map(answered).filter_map(|r| Some((r.run.as_str(), r.planner.as_ref()?))).collect();
    if !planners.is_empty() {
        output::line("");
        print_planners(planners.into_iter());
    }
    for found in &found {
        if let RunEntry::Failed(failed) = found {
            print_failed(failed);
        }
    }
}

/// Returns the report of a run that answered.
fn answered(entry: &RunEntry) -> Option<&StatusReport> {
    if let RunEntry::Answered { report, .. } = entry { Some(report) } else { None }
}

fn print(r: &StatusReport, verbose: bool) {
    output::line(banner::heading(r));
    let trouble = attention(r);
    trouble.iter().for_each(|text| output::wrapped(format_args!("  ! {text}")));
    let blueprint = &r.blueprint;
    output::wrapped(format_args!("  pid {}, up {}, blueprint {blueprint}, dimos {}", r.pid, span(r.uptime), r.version));
    output::wrapped(format_args!("  log {}", r.log.as_deref().unwrap_or("none")));
    if let Some(address) = &r.view {
        output::wrapped(format_args!("  view {}", banner::view_without_token(address)));
    }
    r.metrics.iter().for_each(|url| output::wrapped(format_args!("  metrics {url}")));
    if let Some(share) = &r.share {
        let clients = if share.clients.is_empty() { "no clients".to_owned() } else { share.clients.join(", ") };
        if !share.endpoints.is_empty() {
            output::wrapped(format_args!("  shared at {}: {clients}", share.endpoints.join(", ")));
        }
        for face in &share.faces {
            let what = match &face.reason {
                Some(reason) => format!("DOES NOT SERVE: {reason}"),
                None if face.command => "its programs may move the arms".to_owned(),
                None => "its programs read".to_owned(),
            };
            output::wrapped(format_args!("  shared with {} as {}: {what}", face.face, face.name));
        }
    }
    if let Some(recorder) = r.recorder.as_ref().filter(|recorder| verbose || recorder.dropped > 0) {
        output::wrapped(format_args!("  {} messages logged, {} dropped", recorder.messages, recorder.dropped));
    }
    output::line("");
    print_arms(&r.arms, verbose);
    if r.speed != SpeedReport::default() {
        output::line("");
        output::line(describe(&r.speed));
    }
    output::line("");
    print_tasks(&r.tasks);
    output::line("");
    if let Some(planner) = &r.planner {
        print_planners([(r.run.as_str(), planner)].into_iter());
        output::line("");
    }
    print_timing(r, verbose);
}

/// Returns what needs attention, most urgent first, each with what to do if that is known.
fn attention(r: &StatusReport) -> Vec<String> {
    let mut lines = trouble(r);
    let needed = r.realtime.iter().filter(|measure| !measure.granted && !banner::is_simulated(r));
    lines.extend(needed.flat_map(banner::realtime));
    lines
}

/// Returns what of it may change during a run.
pub(super) fn trouble(r: &StatusReport) -> Vec<String> {
    let mut lines = Vec::new();
    for arm in &r.arms {
        let name = &arm.hardware_id;
        if let Some(cause) = banner::cause(arm) {
            lines.push(format!("{name} is {}: {cause}", arm.phase));
            if arm.phase == "held" {
                lines.push(format!("  hint: dimos arm reset {name}, then dimos arm enable {name}"));
            }
        }
        if arm.phase == "led" {
            let by = arm.led_by.as_deref().unwrap_or_default();
            let leader = if by == LED_BY_CONTROLLER { "by its own controller" } else { "by hand" };
            lines.push(format!("{name} is led {leader}: it gets no setpoints"));
            lines.push(format!("  hint: {}", end_of_lead(name, by)));
        }
        if let Some(error) = &arm.error {
            lines.push(format!("{name} reports error {}: {}", error.code, error.text));
        }
        for (what, hint) in arm.peripherals.iter().filter_map(|own| own.attention(name)) {
            lines.extend([what, format!("  hint: {hint}")]);
        }
        if arm.stop_pending {
            lines.push(format!("{name}: a stop is pending; it is sent after the reconnect"));
        }
        for joint in &arm.joints {
            if let Some(code) = joint.error.filter(|code| *code != 0) {
                lines.push(format!("the drive of {} reports error {code}", joint.name));
            }
        }
        if arm.link != "up" {
            lines.push(format!("{name}: its connection is {}", arm.link));
        }
    }
    lines.extend(r.arms.iter().filter_map(|arm| banner::slowed(&arm.hardware_id, arm.speed_fraction)));
    if r.speed.paused {
        lines.push("all motions are paused: nothing moves until `dimos resume`".to_owned());
    }
    // What held an arm that is ready again is over.
    let is_over = |task: &TaskReport| {
        let ready = r.arms.iter().filter(|arm| arm.phase == "ready");
        let why = task.reason.as_deref().unwrap_or_default();
        ready.map(|arm| format!("{} is held", arm.hardware_id)).any(|held| why.starts_with(&held))
    };
    for task in r.tasks.iter().filter(|task| matches!(task.state.as_str(), "ABORTED" | "FAULT") && !is_over(task)) {
        let why = task.reason.as_deref().unwrap_or("unknown reason");
        lines.push(format!("{} is {}: {why}", task.name, task.state));
    }
    if let Some(error) = r.planner.as_ref().and_then(|planner| planner.error.as_ref()) {
        lines.push(format!("planner: {error}"));
    }
    if let Some(error) = r.recorder.as_ref().and_then(|recorder| recorder.error.as_ref()) {
        lines.push(format!("the log ENDED: {error}"));
    }
    lines
}

/// Returns the planners in their own processes that are attached to none of these runs.
fn waiting<'r>(runs: impl Iterator<Item = &'r StatusReport>) -> Vec<LiveRun> {
    let attached = runs.filter_map(|run| run.planner.as_ref()?.attached.as_ref()?.pid).collect::<Vec<_>>();
    let live = if place().is_some() { Vec::new() } else { attach::live() };
    live.into_iter().filter(|planner| !attached.contains(&(planner.pid as i32))).collect()
}

/// Prints the planners of runs as a table, with the run if there are several.
fn print_planners<'r>(planners: impl Iterator<Item = (&'r str, &'r PlannerStatus)>) {
    let mut table = Table::new(&["PLANNER", "STATE", "RUN", "ROBOTS"]);
    let mut errors = Vec::new();
    for (run, planner) in planners {
        let tone = match planner.state.as_str() {
            "FAULT" => Tone::Bad,
            "PLANNING" => Tone::Warning,
            _ => Tone::Good,
        };
        let name = planner.attached.as_ref().map_or_else(
            || "built-in".to_owned(),
            |process| process.pid.map_or(process.name.clone(), |pid| format!("{} (pid {pid})", process.name)),
        );
        table.row([name.into(), toned(&planner.state, tone), run.into(), planner.robots.join(", ").into()]);
        errors.extend(planner.error.as_ref());
    }
    table.print();
    errors.iter().for_each(|error| output::wrapped(format_args!("  {error}")));
}

fn print_arms(arms: &[ArmReport], verbose: bool) {
    let mut table = Table::new(&["ARM", "PHASE", "LINK", "MOTORS", "MODE", ">?AGE ms", ">?RATE Hz", ">?NATIVE Hz"]);
    for arm in arms {
        let good = |well: bool| if well { Tone::Good } else { Tone::Bad };
        let phase_tone = match arm.phase.as_str() {
            "ready" => Tone::Good,
            "held" => Tone::Bad,
            _ => Tone::Warning,
        };
        table.row([
            arm.hardware_id.as_str().into(),
            toned(&arm.phase, phase_tone),
            toned(&arm.link, good(arm.link == "up")),
            if arm.enabled { "on" } else { "off" }.into(),
            arm.mode.as_str().into(),
            number(arm.state_age_ms, 1).into(),
            number(arm.measured_rate_hz, 1).into(),
            format!("{:.0}", arm.native_rate_hz).into(),
        ]);
    }
    table.print();
    for arm in arms {
        let name = &arm.hardware_id;
        let standing = banner::standing(arm.simulated, &arm.address);
        output::wrapped(format_args!("  {name}: {standing}, {}; at exit: {}", arm.adapter, at_exit(arm)));
        for own in &arm.peripherals {
            let place = if own.simulated { "SIMULATED".to_owned() } else { format!("at {}", own.address) };
            let condition = own.condition.as_deref().unwrap_or("lost").replace('_', " ");
            output::wrapped(format_args!("  {name}: {} {} {place}: {condition}", own.part_text(), own.adapter));
        }
        if let Some(codes) = arm.device_state.as_ref().filter(|_| verbose) {
            let (state, mode) = (codes.state, codes.mode);
            output::wrapped(format_args!("  {name}: device state {state}, mode {mode} (the vendor's numbers)"));
        }
        for line in joint_lines(&arm.joints).iter().filter(|_| verbose) {
            output::wrapped(format_args!("  {name}: {line}"));
        }
        if let Some(line) = gripper_line(arm).filter(|_| verbose) {
            output::wrapped(format_args!("  {name}: {line}"));
        }
        if let Some(tcp) = arm.tcp.as_ref().filter(|_| verbose) {
            output::wrapped(format_args!("  {name}: poses in map are those of {}", tcp_text(tcp)));
        }
        if !arm.simulated && arm.identity.is_none() {
            output::wrapped(format_args!(
                "  {name}: identity unknown: the arm has no serial number that this program reads"
            ));
        }
        for (about, note) in arm.notes() {
            output::wrapped(format_args!("  {name}: {about}: {note}"));
        }
        if let Some(load) = arm.payload.as_ref().filter(|load| verbose || load.mass > 0.0) {
            output::wrapped(format_args!("  {name}: payload {}", payload_text(load)));
        }
        if let Some(io) = arm.io.as_ref().filter(|_| verbose) {
            io_lines(io).iter().for_each(|line| output::wrapped(format_args!("  {name}: {line}")));
        }
        for fault in &arm.faults {
            let over = if fault.over { "over" } else { "active" };
            let (ago, count) = (span(fault.since), fault.count);
            output::wrapped(format_args!("  {name} {ago} ago, {count}×, {over}: {}", fault.text));
        }
        if let Some(c) = &arm.commander {
            let process = c.pid.map(|pid| format!(" (pid {pid})")).unwrap_or_default();
            let held = span(c.held_for);
            output::wrapped(format_args!("  {name} is commanded by {}{process} for {held}", c.program));
        }
        let counted: Vec<String> = arm
            .counters
            .iter()
            .filter(|(_, n)| **n > 0)
            .map(|(what, n)| format!("{n} {}", what.replace('_', " ")))
            .collect();
        if verbose && !counted.is_empty() {
            output::wrapped(format_args!("  {name} counted {}", counted.join(", ")));
        }
    }
}

/// Prints the tasks as a table.
pub(super) fn print_tasks(tasks: &[TaskReport]) {
    let mut table = Table::new(&["TASK", "TYPE", ">?PRIORITY", "STATE", ">?DONE", "?JOINTS"]);
    for task in tasks {
        let tone = match task.state.as_str() {
            "ABORTED" | "FAULT" => Tone::Bad,
            "CANCELLING" => Tone::Warning,
            _ => Tone::Good,
        };
        table.row([
            task.name.as_str().into(),
            task.kind.as_str().into(),
            task.priority.to_string().into(),
            toned(&task.state, tone),
            task.progress.map_or_else(|| "-".into(), |p| format!("{:.0} %", p * 100.0)).into(),
            joints(&task.joints).into(),
        ]);
    }
    table.print();
    for task in tasks {
        if let Some(reason) = &task.reason {
            output::wrapped(format_args!("  {} is {}: {reason}", task.name, task.state));
        }
        if let Some(distance) = task.distance {
            let text = format!("{distance:.3} rad ({:.1}°) from its leader", distance.to_degrees());
            output::wrapped(format_args!("  {} is {text}", task.name));
        }
        if let Some(bound) = &task.bound {
            output::wrapped(format_args!("  {} is limited by {bound}", task.name));
        }
        if let Some(sent) = &task.stream {
            let counts = [
                ("actions", sent.actions, sent.late_actions),
                ("gripper targets", sent.gripper_targets, sent.late_gripper_targets),
            ];
            let sent = counts.iter().filter(|(_, count, _)| *count > 0);
            let sent: Vec<_> =
                sent.map(|(what, count, late)| format!("{count} {what}, {late} of them late and dropped")).collect();
            output::wrapped(format_args!("  {} was sent {}", task.name, sent.join("; ")));
        }
    }
}

/// Shortens joint names: the first, and the end of the last.
fn joints(names: &[String]) -> String {
    match names {
        [first, _, .., last] => {
            let same = first.chars().zip(last.chars()).take_while(|(a, b)| a == b).count();
            format!("{first} … {} ({})", last.chars().skip(same).collect::<String>(), names.len())
        }
        few => few.join(" "),
    }
}

fn print_timing(r: &StatusReport, verbose: bool) {
    let t = &r.ticks;
    let clocked = if t.clock.starts_with("device") { format!(", {}", t.clock) } else { String::new() };
    let heading = format!("TICK {:.0} Hz{clocked}", r.tick_rate);
    let shown = |[p50, p99, p99_9, max]: [String; 4]| match verbose {
        true => vec![p50, p99, p99_9, max],
        false => vec![p50, p99, max],
    };
    let headings: Vec<String> =
        [heading].into_iter().chain(shown(["p50", "p99", "p99.9", "max"].map(|q| format!(">{q} µs")))).collect();
    let mut table = Table::new(&headings.iter().map(String::as_str).collect::<Vec<_>>());
    let mut row = |what: &str, p: &Percentiles| {
        let figures = shown([p.p50, p.p99, p.p99_9, p.max].map(|v| format!("{v:.1}")));
        table.row([what.to_owned()].into_iter().chain(figures));
    };
    row("lateness", &t.lateness_us);
    row("compute", &t.compute_us);
    table.print();
    output::wrapped(format_args!("  ticks: {}, overruns: {}, periods skipped: {}", t.count, t.overruns, t.skipped));
    if !clocked.is_empty() {
        output::wrapped(format_args!("  ticks without a state of the arm that clocks them: {}", t.without_state));
    }
    for text in r
        .realtime
        .iter()
        .filter(|measure| verbose && (measure.granted || banner::is_simulated(r)))
        .flat_map(banner::realtime)
    {
        output::wrapped(format_args!("  {text}"));
    }
}
