//! `dimos arm teach ARM`: lets an arm be led by hand; with `--record`, writes the led motion to a file
//! and takes the arm over again.

use std::fs::File;
use std::io::{self, BufRead, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::sleep;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressFinish};

use super::super::arguments::{duration, hertz};
use super::super::exit::{Exit, Failure, Result};
use super::super::follow::Signals;
use super::super::output;
use super::ArmArgs;
use dimos_core::telemetry::Phase;
use dimos_rpc::api::{ArmTakeOver, ArmTeach, State, Status};
use dimos_rpc::client::{Client, ClientError};
use dimos_rpc::report::ArmStateReport;
use dimos_rpc::{Code, RpcError};

/// Highest rate of samples [Hz].
const MAX_HZ: f64 = 200.0;
/// Period of looking whether the arm is still led.
const CHECK: Duration = Duration::from_millis(250);
/// Maximum wait for a hand to hold the arm still.
const STILL_LIMIT: Duration = Duration::from_secs(30);
/// Pause between two attempts to take the arm over.
const RETRY: Duration = Duration::from_millis(200);

/// Arguments of `arm teach`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Without --record the arm stays led until `dimos arm enable ARM`; meanwhile `dimos pose save NAME` keeps poses.

  dimos arm teach arm --record wipe.csv    Enter or Ctrl-C ends it
  dimos move arm --path wipe.csv")]
pub struct Args {
    #[command(flatten)]
    which: ArmArgs,
    /// The arm is supported: required for an arm that is led with its motors off, because it falls otherwise
    #[arg(long)]
    support_the_arm: bool,
    /// Write the led motion to this CSV file, then hold the arm where it is
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
    /// Samples per second [Hz]
    #[arg(long, value_name = "HZ", default_value_t = 50.0, value_parser = hertz, requires = "record")]
    hz: f64,
    /// End the recording after this time: 10s, or a number of seconds
    #[arg(long, value_name = "TIME", value_parser = duration, requires = "record")]
    duration: Option<Duration>,
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let (arm, json) = (&args.which.arm, args.which.target_run.json);
    let mut client = args.which.target_run.connect()?;
    // Before the arm is led: with a file that cannot be written nothing changes.
    let mut file = args.record.as_deref().map(NewFile::create).transpose()?;
    let signals = Signals::watch();
    let reply = client.call(ArmTeach { arm: arm.clone(), support_the_arm: args.support_the_arm })?;
    if !json {
        output::line(format_args!("{arm}: {}", reply.note.as_deref().unwrap_or(&reply.phase)));
    }
    let (Some(new), Some(path)) = (&mut file, &args.record) else {
        if json {
            output::json(&reply);
        } else {
            output::note(format_args!("hold it still, then: dimos arm enable {arm}"));
        }
        return Ok(Exit::Ok);
    };
    let recorded = record(&mut client, args, BufWriter::new(&new.file), &signals);
    new.keep = true;
    // Refused if the arm is no longer led: another client has stopped or disabled it.
    let taken = take_over(&mut client, arm);
    let (samples, seconds) = recorded.map_err(|e| e.hint(format!("{} ends there", path.display())))?;
    taken?;
    if json {
        output::json(&serde_json::json!({"arm": arm, "file": path, "samples": samples, "seconds": seconds}));
    } else {
        output::line(format_args!("{}: {samples} samples in {seconds:.1} s; {arm}: ready", path.display()));
        output::note(format_args!("to play it: dimos move {arm} --path {}", path.display()));
    }
    Ok(signals.last().map_or(Exit::Ok, Exit::by_signal))
}

/// A file that did not exist. It is removed again unless the arm was led.
struct NewFile<'a> {
    file: File,
    path: &'a Path,
    keep: bool,
}

impl<'a> NewFile<'a> {
    fn create(path: &'a Path) -> Result<Self> {
        let file = File::create_new(path).map_err(|e| match e.kind() {
            io::ErrorKind::AlreadyExists => Failure::usage(format!("{} exists already", path.display()))
                .hint("a recording is never overwritten: choose another name, or remove the file"),
            _ => Failure::usage(format!("cannot create {}: {e}", path.display())),
        })?;
        Ok(Self { file, path, keep: false })
    }
}

impl Drop for NewFile<'_> {
    fn drop(&mut self) {
        if !self.keep {
            // A file that stays is in the way of the next attempt only.
            let _ = std::fs::remove_file(self.path);
        }
    }
}

/// Writes samples until Enter, a signal or the end of the time. Returns their number, and the time [s].
fn record(client: &mut Client, args: &Args, mut file: impl Write, signals: &Signals) -> Result<(usize, f64)> {
    let enter = Arc::new(AtomicBool::new(false));
    let pressed = enter.clone();
    // It ends with the program: a read of the terminal cannot be interrupted.
    std::thread::spawn(move || {
        let read = io::stdin().lock().read_line(&mut String::new());
        pressed.store(read.is_ok_and(|bytes| bytes > 0), Ordering::Relaxed);
    });
    let bar = ProgressBar::new_spinner().with_finish(ProgressFinish::AndClear);
    let (begun, period) = (Instant::now(), Duration::from_secs_f64(1.0 / args.hz.min(MAX_HZ)));
    let (mut next, mut samples, mut last, mut checked) = (begun, 0, f64::NEG_INFINITY, Duration::ZERO);
    let failed = |e: io::Error| Failure::new(Exit::Failed, format!("the recording cannot be written: {e}"));
    while signals.last().is_none() && !enter.load(Ordering::Relaxed) {
        let elapsed = begun.elapsed();
        if args.duration.is_some_and(|limit| elapsed >= limit) {
            break;
        }
        if elapsed >= checked {
            checked = elapsed + CHECK;
            still_led(client, &args.which.arm)?;
        }
        let state = own(client, &args.which.arm)?;
        if samples == 0 {
            let names: Vec<&str> = state.joints.iter().map(|joint| joint.name.as_str()).collect();
            writeln!(file, "time,{}", names.join(",")).map_err(failed)?;
        }
        let time = elapsed.as_secs_f64();
        if let Some(row) = row(&state).filter(|_| time > last) {
            let zero = if samples == 0 { time } else { 0.0 };
            last = time;
            writeln!(file, "{:.4},{row}", time - zero).map_err(failed)?;
            samples += 1;
        }
        bar.set_message(format!("recording {time:.1} s; Enter ends it"));
        bar.tick();
        next = (next + period).max(Instant::now());
        sleep(next.saturating_duration_since(Instant::now()));
    }
    bar.finish_and_clear();
    file.flush().map_err(failed)?;
    Ok((samples, begun.elapsed().as_secs_f64()))
}

/// Returns the state of the arm.
fn own(client: &mut Client, arm: &str) -> Result<ArmStateReport> {
    let state = client.call(State {})?.arms.into_iter().find(|state| state.hardware_id == arm);
    state.ok_or_else(|| Failure::new(Exit::Failed, format!("{arm} is gone")))
}

/// Fails if the arm is no longer led.
fn still_led(client: &mut Client, arm: &str) -> Result<()> {
    let report = client.call(Status {})?.arms.into_iter().find(|report| report.hardware_id == arm);
    let phase = report.map_or_else(String::new, |report| report.phase);
    match phase == Phase::Led.name() {
        true => Ok(()),
        false => Err(Failure::new(Exit::Failed, format!("{arm} is no longer led: {phase}"))
            .hint("`dimos status` shows the cause")),
    }
}

fn row(state: &ArmStateReport) -> Option<String> {
    let positions: Option<Vec<String>> =
        state.joints.iter().map(|joint| Some(format!("{:.6}", joint.position?))).collect();
    Some(positions?.join(","))
}

/// Takes the arm over as soon as it is held still.
fn take_over(client: &mut Client, arm: &str) -> Result<()> {
    let begun = Instant::now();
    let mut asked = false;
    loop {
        match client.call(ArmTakeOver { arm: arm.to_owned() }) {
            Ok(_) => return Ok(()),
            Err(ClientError::Refused(RpcError { code: Code::ArmNotReady, .. })) if begun.elapsed() < STILL_LIMIT => {
                if !std::mem::replace(&mut asked, true) {
                    output::note(format_args!("hold {arm} still: it is taken over at rest"));
                }
                sleep(RETRY);
            }
            Err(error) => return Err(Failure::from(error).hint(format!("hold it still, then: dimos arm enable {arm}"))),
        }
    }
}
