//! Waits for the end of a motion: shows progress, cancels on Ctrl-C, and shows the final error of each joint.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread::sleep;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressFinish, ProgressStyle};

use super::arguments::connect;
use super::banner;
use super::exit::{Exit, Failure, Result};
use super::output::{self, Table, Tone, fixed, signed, toned};
use dimos_core::telemetry::texts::percent;
use dimos_rpc::api::{Cancel, Going, Motion, Status};
use dimos_rpc::client::Client;
use dimos_rpc::report::{Deviation, MotionReport};

/// Poll period.
const POLL_PERIOD: Duration = Duration::from_millis(20);
/// Maximum wait for a cancelled motion to end.
const REST_TIMEOUT: Duration = Duration::from_secs(10);
/// Largest width of the progress bar, and the columns that the text behind it takes.
const BAR: usize = 40;
const BAR_TEXT: usize = 24;
/// Final error below which a joint counts as on target [rad].
const ON_TARGET: f64 = 0.01;

/// The last signal received while a verb watches for signals; 0 = none.
pub struct Signals(Arc<AtomicUsize>);

/// Where the reports of a motion are: in that of a request `go`, or not.
#[derive(Debug, Clone, Copy)]
pub enum Followed {
    /// It was requested without one.
    Motion,
    /// In the report of this request `go`.
    Going(u64),
}

impl Followed {
    fn report(self, client: &mut Client, motion: u64) -> Result<MotionReport> {
        let steps = match self {
            Self::Motion => Vec::new(),
            Self::Going(going) => client.call(Going { going })?.steps,
        };
        let reported = steps.into_iter().flat_map(|step| step.motions).find(|report| report.motion == motion);
        // One that continues another may be new.
        Ok(reported.map_or_else(|| client.call(Motion { motion }), Ok)?)
    }
}

/// Prints the end of a motion, and fails if it did not reach its goal. A signal has cancelled it.
pub fn end(client: &mut Client, (report, cancelled): (MotionReport, Option<i32>), json: bool) -> Result {
    print(&report, json);
    verdict(client, &report, cancelled)
}

/// Fails if a motion did not reach its goal. A signal has cancelled it.
pub fn verdict(client: &mut Client, report: &MotionReport, cancelled: Option<i32>) -> Result {
    match cancelled {
        Some(signal) => Ok(Exit::by_signal(signal)),
        None => completed(client, report).map(|()| Exit::Ok),
    }
}

/// Returns an error if a motion that has ended did not reach its goal.
pub fn completed(client: &mut Client, report: &MotionReport) -> Result<()> {
    if report.state == "COMPLETED" {
        return Ok(());
    }
    let why = report.error.as_deref().unwrap_or("it ended before its goal");
    let failure = Failure::new(Exit::Failed, format!("motion {}: {}: {why}", report.motion, report.state));
    let hint = held(client).unwrap_or_else(|| "`dimos status` shows what the arm and the task wait for".into());
    Err(failure.hint(hint))
}

/// Waits for the end of a motion, with a progress bar named `title` on a terminal. A signal sends `cancel` first.
/// Returns its report, and the signal.
pub fn watch(
    client: &mut Client,
    followed: Followed,
    motion: u64,
    cancel: &Cancel,
    title: &str,
    signals: &Signals,
) -> Result<(MotionReport, Option<i32>)> {
    let bar = ProgressBar::new(1000).with_finish(ProgressFinish::AndClear);
    // What is left beside the title, and the text behind the bar.
    let room = output::columns(std::io::stderr())
        .map_or(BAR, |columns| usize::from(columns).saturating_sub(title.chars().count() + BAR_TEXT).clamp(4, BAR));
    if let Ok(style) = ProgressStyle::with_template(&format!("{{prefix}} [{{bar:{room}}}] {{percent:>3}} % {{msg}}")) {
        bar.set_style(style.progress_chars("=> "));
    }
    bar.set_prefix(title.to_owned());
    let mut cancelled: Option<Instant> = None;
    let (mut motion, mut paused) = (motion, false);
    let report = loop {
        let report = followed.report(client, motion)?;
        if let Some(next) = report.next.filter(|_| report.done) {
            let why = report.error.unwrap_or_default();
            bar.suspend(|| output::note(format_args!("motion {motion}: {why}; continued as motion {next}")));
            motion = next;
            continue;
        }
        bar.set_position((report.progress.clamp(0.0, 1.0) * 1000.0) as u64);
        let slowed =
            report.speed_fraction.map_or_else(String::new, |at| format!(", its controller at {}", percent(at)));
        let left = format!("{:.1} s left{slowed}", report.remaining.max(0.0));
        // A script or a log has no progress bar that shows why nothing moves.
        let pauses = report.speed.as_ref().is_some_and(|speed| speed.paused);
        if pauses && !std::mem::replace(&mut paused, pauses) && bar.is_hidden() {
            output::note(format_args!("motion {motion} is paused until `dimos resume`"));
        }
        paused = pauses;
        bar.set_message(match &report.speed {
            Some(speed) if speed.paused => format!("{left}, PAUSED (dimos resume)"),
            Some(speed) => format!("{left} at {} of the speed", percent(speed.fraction)),
            None => left,
        });
        if report.done {
            break report;
        }
        if cancelled.is_none() && signals.last().is_some() {
            bar.suspend(|| output::note(format_args!("cancelling motion {motion}: the arm decelerates")));
            let run = client.run().to_owned();
            client.call_urgently(|| connect(Some(&run)), cancel)?;
            cancelled = Some(Instant::now());
        }
        if cancelled.is_some_and(|since| since.elapsed() > REST_TIMEOUT) {
            bar.finish_and_clear();
            let what = format!("motion {motion} was cancelled, but has not ended after {} s", REST_TIMEOUT.as_secs());
            return Err(Failure::new(Exit::Failed, what).hint("dimos stop holds the arm at once"));
        }
        sleep(POLL_PERIOD);
    };
    bar.finish_and_clear();
    Ok((report, signals.last().filter(|_| cancelled.is_some())))
}

/// Returns which arms of the run are held and why, with the way out; `None` without one.
pub fn held(client: &mut Client) -> Option<String> {
    let arms = client.call(Status {}).ok()?.arms;
    let held = arms.iter().filter(|arm| arm.phase == "held");
    let lines = held.filter_map(|arm| {
        let name = &arm.hardware_id;
        Some(format!("{name} is held: {}; dimos arm reset {name}, then dimos arm enable {name}", banner::cause(arm)?))
    });
    Some(lines.collect::<Vec<_>>().join("; ")).filter(|text| !text.is_empty())
}

impl Signals {
    /// Catches SIGINT and SIGTERM from now on. Call it before a motion begins, so that no motion begins after a Ctrl-C.
    pub fn watch() -> Self {
        let seen = Arc::new(AtomicUsize::new(0));
        for signal in [libc::SIGINT, libc::SIGTERM] {
            // If this fails, a signal ends the program as usual and the motion continues.
            let _ = signal_hook::flag::register_usize(signal, seen.clone(), signal as usize);
        }
        Self(seen)
    }

    /// Also catches SIGHUP: for a program whose exit ends a run.
    pub fn watch_with_hangup() -> Self {
        let signals = Self::watch();
        let _ = signal_hook::flag::register_usize(libc::SIGHUP, signals.0.clone(), libc::SIGHUP as usize);
        signals
    }

    /// Fails if a signal was received. Call it right before the request that begins a motion.
    pub fn check(&self) -> Result<()> {
        match self.last() {
            Some(signal) => Err(Failure::new(Exit::by_signal(signal), "interrupted: no motion was started")),
            None => Ok(()),
        }
    }

    /// Returns the last signal received.
    pub fn last(&self) -> Option<i32> {
        Some(self.0.load(Ordering::Relaxed) as i32).filter(|signal| *signal != 0)
    }
}

fn print(report: &MotionReport, json: bool) {
    if json {
        return output::json(report);
    }
    output::line(format_args!("motion {}: {} after {:.2} s", report.motion, report.state, report.elapsed));
    show_deviation(report.deviation.as_deref().unwrap_or_default());
}

/// Prints the final errors of the joints.
pub fn show_deviation(deviation: &[Deviation]) {
    if deviation.is_empty() {
        return;
    }
    let mut table = Table::new(&["JOINT", ">TARGET rad", ">REACHED rad", ">OFF BY rad", ">?OFF BY deg"]);
    for joint in deviation {
        let off = joint.error();
        let tone = if off.abs() <= ON_TARGET { Tone::Good } else { Tone::Warning };
        table.row([
            joint.joint.as_str().into(),
            fixed(joint.target, 4).into(),
            fixed(joint.actual, 4).into(),
            toned(signed(off, 4), tone),
            toned(signed(off.to_degrees(), 3), tone),
        ]);
    }
    table.print();
}
