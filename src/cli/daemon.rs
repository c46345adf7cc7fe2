//! `dimos run -d`: the run in its own process, without a terminal. The command returns when the arms are up, or with
//! the reason why they are not.
//!
//! ```text
//! dimos run -d ──starts──▶ dimos run --text-log FILE     stdin: a socket, until the arms are up; then /dev/null
//!      ▲                        │                        stdout, stderr: the text log
//!      └──── one line: up, or the error                  its own session: independent of terminals
//! ```

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fs::{File, OpenOptions};
use std::io::{self, BufRead, BufReader, Write};
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use anyhow::Context;
use serde::{Deserialize, Serialize};

use super::exit::{Exit, Failure, Result};
use super::run::{Args, check_name};
use super::run_record::last_lines;
use super::{banner, check, output};
use crate::blueprint::Catalog;
use dimos_log::files::{self, KEPT_LOGS};
use dimos_rpc::report::{ArmReport, StatusReport};

/// Last line of the banner of a run without a terminal.
pub const HOW_TO_END: &str = "Run `dimos down` for a controlled stop.";

/// A run that is up, as reported to the starting command.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Up {
    /// Name.
    pub run: String,
    /// Process id.
    pub pid: u32,
    /// Whether any arm is simulated.
    pub simulated: bool,
    /// The phase of each arm.
    pub arms: BTreeMap<String, String>,
    /// Addresses of the real arms.
    #[serde(default)]
    pub real_arms: BTreeMap<String, String>,
    /// Why arms are not ready, although their motors were to be enabled.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub causes: BTreeMap<String, String>,
    /// Its log, if one is written.
    pub log: Option<String>,
    /// Its text log.
    pub text_log: PathBuf,
    /// Its socket, if it has one.
    pub socket: Option<PathBuf>,
    /// URL of its live view, with the token, if it is served.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub view: Option<String>,
    /// The run it attached to, if it is a planner.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub attached: Option<String>,
}

/// Message of the new process: up, or failed.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum StartMessage {
    Up(Up),
    Failed { exit: u8, what: String, hint: Option<String> },
}

/// Starts the run in its own process and waits until it is up.
pub fn start(args: &Args, catalog: Catalog<'_>) -> Result {
    // Print mistakes here, on the user's terminal, in colour.
    let loaded = check::load_to_run(&args.blueprint, &args.changes.overrides(), catalog)?;
    let Some(blueprint) = &loaded.blueprint else { return Err(check::refuse(&loaded)) };
    check::print_warnings(&loaded);
    let run = args.name.as_ref().unwrap_or(&blueprint.name);
    check_name(run)?;
    let text_log = new_text_log(run)?;
    let (mut child, ours) = spawn(&text_log).context("cannot start the run's process")?;
    let mut line = String::new();
    let message = match BufReader::new(ours).read_line(&mut line) {
        Ok(_) => serde_json::from_str(&line).ok(),
        Err(_) => None,
    };
    match message {
        Some(StartMessage::Up(up)) => {
            print(&up, args.json);
            not_ready(&up).map_or(Ok(Exit::Ok), Err)
        }
        Some(StartMessage::Failed { exit, what, hint }) => {
            let _ = child.wait();
            // The reply already carries the error.
            let _ = std::fs::remove_file(&text_log);
            Err(Failure::new(Exit::of(exit), what).maybe_hint(hint))
        }
        None => Err(crash_failure(run, &mut child, &text_log)),
    }
}

fn new_text_log(run: &str) -> Result<PathBuf> {
    let folder = files::log_folder().ok_or_else(|| {
        let what = "no folder for the text log: neither XDG_STATE_HOME nor HOME is set";
        Failure::new(Exit::Failed, what).hint("set XDG_STATE_HOME")
    })?;
    let now = u64::try_from(jiff::Timestamp::now().as_nanosecond()).unwrap_or(0);
    let path = files::new_text_log_path(&folder, run, now);
    let make = || {
        std::fs::create_dir_all(&folder)?;
        File::create_new(&path)?;
        files::retain_text_logs(&folder, KEPT_LOGS)
    };
    make().map_err(|e| {
        let hint = "make the folder writable, or set XDG_STATE_HOME to another";
        Failure::new(Exit::Failed, format!("{}: {e}", path.display())).hint(hint)
    })?;
    Ok(path)
}

/// Starts this program again with the same arguments. Its stdin is one end of a socket; returns the other end.
fn spawn(text_log: &Path) -> io::Result<(Child, UnixStream)> {
    let (ours, theirs) = UnixStream::pair()?;
    let log = OpenOptions::new().append(true).open(text_log)?;
    // The child inherits the open file, and with it the mark.
    files::mark_as_being_written(&log);
    let mut command = Command::new(std::env::current_exe()?);
    command.args(arguments(std::env::args_os(), text_log));
    command.stdin(Stdio::from(OwnedFd::from(theirs))).stdout(log.try_clone()?).stderr(log);
    // The command holds the child's end open, which would hide its exit, until it is dropped here.
    Ok((command.spawn()?, ours))
}

/// Returns this program's arguments, with the text log inserted after the verb, which `--at PLACE` may precede.
fn arguments(own: impl Iterator<Item = OsString>, text_log: &Path) -> Vec<OsString> {
    let mut arguments: Vec<OsString> = own.skip(1).collect();
    let before_verb = match arguments.first().and_then(|first| first.to_str()) {
        Some("--at") => 2,
        Some(first) if first.starts_with("--at=") => 1,
        _ => 0,
    };
    let behind_verb = arguments.len().min(before_verb + 1);
    arguments.splice(behind_verb..behind_verb, ["--text-log".into(), text_log.into()]);
    arguments
}

fn crash_failure(run: &str, child: &mut Child, text_log: &Path) -> Failure {
    let how = child.wait().map_or_else(|e| e.to_string(), |status| status.to_string());
    let mut what = format!("{run} crashed during startup ({how})");
    for line in last_lines(text_log) {
        what += &format!("\n  {line}");
    }
    Failure::new(Exit::Failed, what).hint(format!("its text log: {}", text_log.display()))
}

/// Returns the failure of a run that is up with arms that are held; `None` without one.
fn not_ready(up: &Up) -> Option<Failure> {
    let causes: Vec<String> = up.causes.iter().map(|(arm, cause)| format!("{arm} is held: {cause}")).collect();
    let arm = up.causes.keys().next()?;
    let what = format!("run {} is up, but not ready: {}", up.run, causes.join("; "));
    let hint = format!("`dimos arm reset {arm}`, then `dimos arm enable {arm}`; `dimos down {}` ends the run", up.run);
    Some(Failure::new(Exit::Failed, what).hint(hint))
}

fn print(up: &Up, json: bool) {
    if json {
        return output::json(up);
    }
    let what = if up.attached.is_some() { "planner " } else { "run     " };
    let standing = match (up.simulated, up.real_arms.is_empty()) {
        (false, _) => "",
        (true, true) => "  SIMULATED",
        (true, false) => "  PARTLY SIMULATED",
    };
    output::line(format_args!("{what}  {}{standing}", up.run));
    output::line(format_args!("pid       {}", up.pid));
    let view = |url: &String| output::line(format_args!("view      {url}"));
    if let Some(run) = &up.attached {
        output::line(format_args!("text log  {}", up.text_log.display()));
        up.view.iter().for_each(view);
        return output::note(format_args!("attached to run {run}; end it with: dimos down {}", up.run));
    }
    for (arm, phase) in &up.arms {
        let real = up.real_arms.get(arm).map_or_else(String::new, |address| banner::standing(false, address) + ", ");
        output::line(format_args!("arm       {arm}: {real}{phase}"));
    }
    output::line(format_args!("log       {}", up.log.as_deref().unwrap_or("none")));
    output::line(format_args!("text log  {}", up.text_log.display()));
    up.view.iter().for_each(view);
    output::note(format_args!("next: dimos status, dimos logs -f, dimos down {}", up.run));
}

/// Connection to the command that started this process.
pub struct StartingProcess {
    stream: UnixStream,
    text_log: PathBuf,
}

impl StartingProcess {
    /// Leaves the terminal: a new session, stdin is /dev/null.
    pub fn detach(text_log: &Path) -> Result<Self> {
        let leave = || {
            let stream = UnixStream::from(rustix::io::fcntl_dupfd_cloexec(rustix::stdio::stdin(), 3)?);
            rustix::stdio::dup2_stdin(File::open("/dev/null")?)?;
            // Fails only for the leader of a process group, which then has no terminal.
            let _ = rustix::process::setsid();
            io::Result::Ok(stream)
        };
        let stream = leave().context("cannot detach from the terminal")?;
        Ok(Self { stream, text_log: text_log.to_owned() })
    }

    /// Reports that the run is up, or the planner attached to that run; returns whether the command was still waiting.
    /// `view` is the URL of the live view with its token: only that command gets it, not the text log.
    pub fn up(self, report: &StatusReport, socket: Option<&Path>, view: Option<&str>, attached: Option<&str>) -> bool {
        let text_log = self.text_log.clone();
        let up = Up {
            run: report.run.clone(),
            pid: report.pid,
            simulated: report.simulated,
            arms: of_arms(report, |arm| Some(arm.phase.clone())),
            real_arms: of_arms(report, |arm| Some(arm.address.clone()).filter(|_| !arm.simulated)),
            causes: of_arms(report, banner::cause),
            log: report.log.clone(),
            text_log,
            socket: socket.map(PathBuf::from),
            view: view.map(str::to_owned),
            attached: attached.map(str::to_owned),
        };
        self.send(&StartMessage::Up(up)).is_ok()
    }

    /// Reports why the run is not up.
    pub fn failed(self, failure: &Failure) {
        let Failure { exit, what, hint, .. } = failure.clone();
        // Ignore a command that has exited.
        let _ = self.send(&StartMessage::Failed { exit: exit as u8, what, hint });
    }

    fn send(mut self, message: &StartMessage) -> io::Result<()> {
        let line = serde_json::to_string(message)? + "\n";
        self.stream.write_all(line.as_bytes())
    }
}

/// Returns a value of each arm that has one.
fn of_arms(report: &StatusReport, value: fn(&ArmReport) -> Option<String>) -> BTreeMap<String, String> {
    report.arms.iter().filter_map(|arm| Some((arm.hardware_id.clone(), value(arm)?))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_rpc::report::{CauseReport, DeviceError};

    #[test]
    fn the_new_process_gets_the_same_arguments() {
        let own = ["/bin/dimos", "run", "-d", "x", "--", "y"].map(OsString::from);
        let expected = ["run", "--text-log", "f.log", "-d", "x", "--", "y"].map(OsString::from);
        assert_eq!(arguments(own.into_iter(), Path::new("f.log")), expected);
        let own = ["/bin/dimos", "--at", "cell1", "run", "x", "-d"].map(OsString::from);
        let expected = ["--at", "cell1", "run", "--text-log", "f.log", "x", "-d"].map(OsString::from);
        assert_eq!(arguments(own.into_iter(), Path::new("f.log")), expected);
    }

    #[test]
    fn an_arm_that_is_held_is_a_failure_with_its_cause() {
        let cause = CauseReport { name: "device_fault".into(), text: "the arm reports error 1".into(), by: None };
        let error = Some(DeviceError { code: 1, text: "E-stop line open".into() });
        let ready = ArmReport { hardware_id: "left".into(), phase: "ready".into(), ..ArmReport::default() };
        let held =
            ArmReport { hardware_id: "right".into(), phase: "held".into(), cause: Some(cause), error, ..ready.clone() };
        let up = |arms: Vec<ArmReport>| {
            let (ours, theirs) = UnixStream::pair().unwrap();
            let starter = StartingProcess { stream: theirs, text_log: "text.log".into() };
            starter.up(&StatusReport { run: "cell".into(), arms, ..StatusReport::default() }, None, None, None);
            let mut line = String::new();
            BufReader::new(ours).read_line(&mut line).unwrap();
            let StartMessage::Up(up) = serde_json::from_str(&line).unwrap() else { panic!("{line}") };
            up
        };
        assert_eq!(not_ready(&up(vec![ready.clone()])), None);
        let failure = not_ready(&up(vec![ready, held])).unwrap();
        assert_eq!(failure.exit, Exit::Failed);
        let expected = "run cell is up, but not ready: right is held: the arm reports error 1: E-stop line open";
        assert_eq!(failure.what, expected);
    }
}
