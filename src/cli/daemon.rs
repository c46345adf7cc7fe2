//! `dimos run -d`: the run in a process of its own, without a terminal. The command returns when the arms are up, or
//! with the reason why they are not.
//!
//! ```text
//! dimos run -d ──starts──▶ dimos run --text-log FILE     stdin: a socket, until the arms are up; then /dev/null
//!      ▲                        │                        stdout, stderr: the text log
//!      └──── one line: up, or why not                    a session of its own: no terminal can end it
//! ```

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::fs::{File, OpenOptions};
use std::io::{self, BufRead, BufReader, Write};
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use serde::{Deserialize, Serialize};

use super::exit::{Exit, Failure, Result};
use super::run::Args;
use super::run_record::last_lines;
use super::{check, output};
use crate::blueprint::Catalog;
use crate::recording::files::{self, KEPT_LOGS};
use crate::rpc::place;
use crate::rpc::report::StatusReport;

/// The last line of the banner of a run without a terminal.
pub const HOW_TO_END: &str = "dimos down ends it, controlled.";

/// A run that is up, for whoever started it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Up {
    /// Its name.
    pub run: String,
    /// Its process.
    pub pid: u32,
    /// Whether any arm is simulated.
    pub simulated: bool,
    /// The phase of each arm.
    pub arms: BTreeMap<String, String>,
    /// Its log, if one is written.
    pub log: Option<String>,
    /// Its text log.
    pub text_log: PathBuf,
    /// Its socket, if it has one.
    pub socket: Option<PathBuf>,
    /// The run that it attached to, where it is a planner and no run.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub attached: Option<String>,
}

/// What the new process says when it is up, or cannot be.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Word {
    Up(Up),
    Failed { exit: u8, what: String, hint: Option<String> },
}

/// Starts the run in a process of its own, and waits until it is up.
pub fn start(args: &Args, catalog: Catalog<'_>) -> Result {
    // Mistakes are shown here, where someone looks, with the colours of a terminal.
    let loaded = check::load_to_run(&args.blueprint, &args.overrides(), catalog)?;
    let Some(blueprint) = &loaded.blueprint else { return Err(check::refuse(&loaded)) };
    check::print_warnings(&loaded);
    let run = args.name.as_ref().unwrap_or(&blueprint.name);
    place::check_name(run).map_err(|e| Failure::new(Exit::Failed, e.to_string()).hint(e.hint()))?;
    let text_log = new_text_log(run)?;
    let failed = |e: io::Error| Failure::new(Exit::Failed, format!("the run's process cannot be started: {e}"));
    let (mut child, ours) = spawn(&text_log).map_err(failed)?;
    let mut line = String::new();
    let word = match BufReader::new(ours).read_line(&mut line) {
        Ok(_) => serde_json::from_str(&line).ok(),
        Err(_) => None,
    };
    match word {
        Some(Word::Up(up)) => {
            print(&up, args.json);
            Ok(Exit::Ok)
        }
        Some(Word::Failed { exit, what, hint }) => {
            let _ = child.wait();
            // All that it could tell is told here.
            let _ = std::fs::remove_file(&text_log);
            Err(Failure { exit: Exit::of(exit), what, hint })
        }
        None => Err(died(run, &mut child, &text_log)),
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
        let hint = "the folder must be writable; XDG_STATE_HOME may name another";
        Failure::new(Exit::Failed, format!("{}: {e}", path.display())).hint(hint)
    })?;
    Ok(path)
}

/// Starts this program again, with the same arguments. Its stdin is one end of a socket; the other end is returned.
fn spawn(text_log: &Path) -> io::Result<(Child, UnixStream)> {
    let (ours, theirs) = UnixStream::pair()?;
    let log = OpenOptions::new().append(true).open(text_log)?;
    let mut command = Command::new(std::env::current_exe()?);
    command.args(arguments(std::env::args_os(), text_log));
    command.stdin(Stdio::from(OwnedFd::from(theirs))).stdout(log.try_clone()?).stderr(log);
    // The command keeps their end open, and with it hides that they are gone, until it is dropped here.
    Ok((command.spawn()?, ours))
}

/// The arguments that this program got, with the text log behind the verb.
fn arguments(own: impl Iterator<Item = OsString>, text_log: &Path) -> Vec<OsString> {
    let mut arguments: Vec<OsString> = own.skip(1).collect();
    let behind_verb = arguments.len().min(1);
    arguments.splice(behind_verb..behind_verb, ["--text-log".into(), text_log.into()]);
    arguments
}

fn died(run: &str, child: &mut Child, text_log: &Path) -> Failure {
    let how = child.wait().map_or_else(|e| e.to_string(), |status| status.to_string());
    let mut what = format!("{run} crashed while it started ({how})");
    for line in last_lines(text_log) {
        what += &format!("\n  {line}");
    }
    Failure::new(Exit::Failed, what).hint(format!("its text log: {}", text_log.display()))
}

fn print(up: &Up, json: bool) {
    if json {
        return output::json(up);
    }
    let simulated = if up.simulated { "  SIMULATED" } else { "" };
    let what = if up.attached.is_some() { "planner " } else { "run     " };
    output::line(format_args!("{what}  {}{simulated}", up.run));
    output::line(format_args!("pid       {}", up.pid));
    if let Some(run) = &up.attached {
        output::line(format_args!("text log  {}", up.text_log.display()));
        return output::note(format_args!("attached to run {run}; dimos down {} ends it", up.run));
    }
    for (arm, phase) in &up.arms {
        output::line(format_args!("arm       {arm}: {phase}"));
    }
    output::line(format_args!("log       {}", up.log.as_deref().unwrap_or("none is written")));
    output::line(format_args!("text log  {}", up.text_log.display()));
    output::note(format_args!("dimos status shows it, dimos logs -f follows it, dimos down {} ends it", up.run));
}

/// The way back to the command that started this process.
pub struct Starter {
    stream: UnixStream,
    text_log: PathBuf,
}

impl Starter {
    /// Leaves the terminal: a session of its own, nothing on stdin.
    pub fn detach(text_log: &Path) -> Result<Self> {
        let leave = || {
            let stream = UnixStream::from(rustix::io::fcntl_dupfd_cloexec(rustix::stdio::stdin(), 3)?);
            rustix::stdio::dup2_stdin(File::open("/dev/null")?)?;
            // Fails for the leader of a process group only, which then has no terminal to lose.
            let _ = rustix::process::setsid();
            io::Result::Ok(stream)
        };
        let stream = leave().map_err(|e| Failure::new(Exit::Failed, format!("the terminal cannot be left: {e}")))?;
        Ok(Self { stream, text_log: text_log.to_owned() })
    }

    /// Says that the run is up, or the planner attached to that run; `false` when nobody waits for it any more.
    pub fn up(self, report: &StatusReport, socket: Option<&Path>, attached: Option<&str>) -> bool {
        let text_log = self.text_log.clone();
        let up = Up {
            run: report.run.clone(),
            pid: report.pid,
            simulated: report.simulated,
            arms: report.arms.iter().map(|arm| (arm.hardware_id.clone(), arm.phase.clone())).collect(),
            log: report.log.clone(),
            text_log,
            socket: socket.map(PathBuf::from),
            attached: attached.map(str::to_owned),
        };
        self.say(&Word::Up(up)).is_ok()
    }

    /// Says why the run is not up.
    pub fn failed(self, failure: &Failure) {
        let Failure { exit, what, hint } = failure.clone();
        // Who has gone does not want to know.
        let _ = self.say(&Word::Failed { exit: exit as u8, what, hint });
    }

    fn say(mut self, word: &Word) -> io::Result<()> {
        let line = serde_json::to_string(word)? + "\n";
        self.stream.write_all(line.as_bytes())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_new_process_gets_the_same_arguments() {
        let own = ["/bin/dimos", "run", "-d", "x", "--", "y"].map(OsString::from);
        let expected = ["run", "--text-log", "f.log", "-d", "x", "--", "y"].map(OsString::from);
        assert_eq!(arguments(own.into_iter(), Path::new("f.log")), expected);
    }
}
