//! Shows a motion that the run carries out as a whole (`go`): its plans, motions and grips as they happen. A signal
//! cancels it.

use std::thread::sleep;
use std::time::{Duration, Instant};

use serde_json::json;

use super::arguments::connect;
use super::exit::{Exit, Failure, Result};
use super::follow::{Followed, Signals, end, verdict, watch};
use super::goal::{Planned, no_plan, planning_bar, show};
use super::output;
use dimos_rpc::api::{Cancel, Go, GoBegun, GoOutcome, GoStep, GoStepReport, Going, GoingReport, Until};
use dimos_rpc::client::{Client, ClientError};
use dimos_rpc::report::MotionReport;
use dimos_rpc::{Code, RpcError};

/// Poll period.
const POLL_PERIOD: Duration = Duration::from_millis(20);
/// Maximum wait for the outcome of a request whose last motion has ended.
const OUTCOME_TIMEOUT: Duration = Duration::from_secs(2);

/// Why a step did not begin to move.
pub enum NotBegun {
    /// The run refused it.
    Refused(ClientError),
    /// There is no plan.
    NoPlan(Failure),
    /// A signal came before.
    Interrupted(Failure),
}

impl From<ClientError> for NotBegun {
    fn from(error: ClientError) -> Self {
        Self::Refused(error)
    }
}

impl From<NotBegun> for Failure {
    fn from(not_begun: NotBegun) -> Self {
        match not_begun {
            NotBegun::Refused(error) => error.into(),
            NotBegun::NoPlan(failure) | NotBegun::Interrupted(failure) => failure,
        }
    }
}

/// A step whose motion has begun.
pub struct Begun {
    /// Its plan, if the run has made one for it.
    pub planned: Option<Planned>,
    /// What the run replied.
    pub reply: GoBegun,
    /// The force to expect at most [N].
    pub peak: Option<f64>,
}

/// Requests one step.
pub fn go(client: &mut Client, step: GoStep) -> std::result::Result<u64, ClientError> {
    client.call(Go { steps: vec![step], ..Go::default() }).map(|reply| reply.going)
}

/// Waits until the motion of a step has begun. Prints its plan if `shows_plan`. A signal ends the whole.
pub fn begin(
    client: &mut Client,
    (going, step): (u64, usize),
    signals: Option<&Signals>,
    shows_plan: bool,
) -> std::result::Result<Begun, NotBegun> {
    let bar = planning_bar();
    let (mut cancelled, mut shown) = (false, false);
    loop {
        let GoingReport { mut steps, done, error, .. } = client.call(Going { going })?;
        let report = if step < steps.len() { steps.swap_remove(step) } else { GoStepReport::default() };
        if let Some(planning) = report.planning.as_ref().filter(|planning| planning.state == "PLANNING") {
            bar.set_message(format!("{:.1} s", planning.elapsed));
            bar.tick();
        }
        let signal = signals.and_then(Signals::last);
        let no_plan = report.planning.as_ref().filter(|planning| planning.summary.is_none()).map(no_plan);
        let planned = report.planning.and_then(Planned::of);
        if let Some(planned) = planned.as_ref().filter(|_| shows_plan && !std::mem::replace(&mut shown, true)) {
            bar.suspend(|| show(planned));
        }
        if let Some(reply) = report.begun {
            return Ok(Begun { planned, reply, peak: report.peak });
        }
        if done {
            bar.finish_and_clear();
            return Err(match (signal, planned, no_plan, error) {
                (Some(signal), None, Some(_), _) => {
                    let what = "planning was cancelled: nothing has moved";
                    NotBegun::Interrupted(Failure::new(Exit::by_signal(signal), what))
                }
                (Some(signal), ..) => {
                    NotBegun::Interrupted(Failure::new(Exit::by_signal(signal), "interrupted: no motion was started"))
                }
                (None, None, Some(no_plan), _) => NotBegun::NoPlan(no_plan),
                (None, .., error) => NotBegun::Refused(ClientError::Refused(error.unwrap_or_else(no_reason))),
            });
        }
        if signal.is_some() && !std::mem::replace(&mut cancelled, true) {
            cancel(client, going)?;
        }
        sleep(POLL_PERIOD);
    }
}

/// Waits for the end of a motion that has begun, with a progress bar of that title. A signal cancels it. Returns its
/// report, and the signal.
pub fn follow(
    client: &mut Client,
    going: u64,
    begun: &GoBegun,
    title: &str,
    signals: &Signals,
) -> Result<(MotionReport, Option<i32>)> {
    let cancel = Cancel { going: Some(going), ..Cancel::default() };
    watch(client, Followed::Going(going), begun.motion(), &cancel, title, signals)
}

/// As [`follow`]; prints the end, and fails if the motion did not get to its goal. As JSON it is the outcome of the
/// request, if this was its last motion.
pub fn finish(client: &mut Client, going: u64, begun: &GoBegun, signals: &Signals, json: bool) -> Result {
    let (report, cancelled) = follow(client, going, begun, begun.task(), signals)?;
    let outcome = if json { outcome(client, going, report.motion)? } else { None };
    let Some(outcome) = outcome else { return end(client, (report, cancelled), json) };
    output::json(&outcome);
    verdict(client, &report, cancelled)
}

/// As [`finish`], for a motion that awaits conditions: prints which has ended it, and fails if none of those has that
/// were awaited.
pub fn finish_until(
    client: &mut Client,
    (going, until): (u64, &Until),
    begun: &GoBegun,
    signals: &Signals,
    json: bool,
) -> Result {
    let (report, cancelled) = follow(client, going, begun, begun.task(), signals)?;
    let Some(outcome) = outcome(client, going, report.motion)? else {
        return end(client, (report, cancelled), json);
    };
    match json {
        true => output::json(&outcome),
        false => {
            let how = report.error.as_deref().unwrap_or("its goal came first");
            output::line(format_args!("motion {}: {how}, after {:.2} s", report.motion, report.elapsed));
        }
    }
    verdict(client, &report, cancelled)?;
    match cancelled {
        Some(signal) => Ok(Exit::by_signal(signal)),
        None if until.is_awaited(outcome.ended_by) => Ok(Exit::Ok),
        None => Ok(Exit::Failed),
    }
}

/// Returns the outcome of a request whose motion has ended; `None` if it continues with another step.
pub fn outcome(client: &mut Client, going: u64, motion: u64) -> Result<Option<GoOutcome>> {
    let began = Instant::now();
    while began.elapsed() < OUTCOME_TIMEOUT {
        let GoingReport { steps, outcome, .. } = client.call(Going { going })?;
        if outcome.is_some() {
            return Ok(outcome.filter(|outcome| outcome.motion.as_ref().is_some_and(|last| last.motion == motion)));
        }
        if steps.last().is_none_or(|step| step.motions.last().is_none_or(|last| last.motion != motion)) {
            break;
        }
        sleep(POLL_PERIOD);
    }
    Ok(None)
}

/// Waits for the outcome of a step that grips, and prints it. A signal ends the whole; the fingers continue.
pub fn grip(client: &mut Client, (going, step): (u64, usize), signals: &Signals, json: bool) -> Result<()> {
    loop {
        let GoingReport { mut steps, done, error, .. } = client.call(Going { going })?;
        let is_over = done || steps.len() > step + 1;
        let report = if step < steps.len() { steps.swap_remove(step) } else { GoStepReport::default() };
        match (report.grip, signals.last()) {
            (Some(grip), None) if is_over && error.is_none() => {
                let (what, names) = match &report.attached[..] {
                    [] => ("detached", &report.detached),
                    _ => ("attached", &report.attached),
                };
                match json {
                    false if names.is_empty() => output::line(format_args!("{}: {}", grip.arm, grip.text())),
                    false => output::line(format_args!("{}: {}; {} {what}", grip.arm, grip.text(), names.join(", "))),
                    true => {
                        let mut value = json!(grip);
                        if !names.is_empty() {
                            value[what] = json!(names);
                        }
                        output::json(&value);
                    }
                }
                return Ok(());
            }
            (Some(grip), Some(signal)) => {
                cancel(client, going)?;
                let (arm, target, unit) = (&grip.arm, grip.target, &grip.unit);
                let what = format!("interrupted: the gripper of {arm} continues to {target:.4} {unit}");
                return Err(Failure::new(Exit::by_signal(signal), what).hint(format!("dimos stop {arm} holds it")));
            }
            (None, Some(signal)) => {
                cancel(client, going)?;
                return Err(Failure::new(Exit::by_signal(signal), "interrupted: no motion was started"));
            }
            (_, None) if done => return Err(grip_failure(error.unwrap_or_else(no_reason))),
            _ => sleep(POLL_PERIOD),
        }
    }
}

/// Returns why a grip failed. What the run judges is no refusal: it has no code.
pub fn grip_failure(error: RpcError) -> Failure {
    let is_judged = matches!(error.code, Code::GripFailed | Code::UnknownObject | Code::UnknownRobot);
    let failure = Failure::from(ClientError::Refused(error));
    if is_judged { Failure { code: String::new(), ..failure } } else { failure }
}

fn no_reason() -> RpcError {
    RpcError::new(Code::Internal, "the run gives no reason")
}

fn cancel(client: &mut Client, going: u64) -> std::result::Result<(), ClientError> {
    let run = client.run().to_owned();
    let cancel = Cancel { going: Some(going), ..Cancel::default() };
    client.call_urgently(|| connect(Some(&run)), &cancel).map(drop)
}
