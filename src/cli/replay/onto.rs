//! `dimos replay LOG --onto BLUEPRINT`: the arms of a blueprint follow the motion of a log.

use std::collections::BTreeMap;
use std::io::{self, IsTerminal};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::Context;
use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;

use super::ReplayArgs;
use super::player::Part as Span;
use crate::blueprint::{Blueprint, Catalog};
use crate::cli::exit::{Exit, Failure, Result};
use crate::cli::follow::{Signals, show_deviation};
use crate::cli::text_log::Terminal;
use crate::cli::{banner, check, output};
use crate::replay::fit::fit;
use crate::replay::grips::RecordedGrip;
use crate::replay::motion::RecordedMotion;
use crate::replay::onto::{Approach, Plan, check as check_limits, is_real, plan};
use crate::replay::recorded::RecordedError;
use crate::runtime::{Ended, Ending, Options, Record, Run};
use dimos_core::trajectory::JointTrajectory;
use dimos_rpc::RpcError;
use dimos_rpc::api::{self, ArmEnable, Cancel, Execute, Gripper, Move, Point, State, Trajectory};
use dimos_rpc::report::{Deviation, MotionReport, StateReport};

/// Fraction of the highest speed for the approach to the start of the motion.
const APPROACH_SPEED: f64 = 0.2;
/// Poll period.
const POLL_PERIOD: Duration = Duration::from_millis(50);
/// Maximum wait for the arms' first states.
const FIRST_STATE_TIMEOUT: Duration = Duration::from_secs(2);
/// Maximum time for a cancelled motion to end.
const REST_TIMEOUT: Duration = Duration::from_secs(10);

/// Drives the arms of a blueprint along a part of a log.
pub fn run(args: &ReplayArgs, onto: &str, log: &Path, span: &Span, catalog: Catalog<'_>) -> Result {
    let loaded = check::load_to_run(onto, &args.onto.changes.overrides(), catalog)?;
    let Some(mut blueprint) = loaded.blueprint.clone() else { return Err(check::refuse(&loaded)) };
    check::print_warnings(&loaded);
    let motion = RecordedMotion::read(log, span.from, span.to).map_err(|e| match e {
        RecordedError::Lacks { .. } => Failure::of(Exit::Log, e),
        e => split(e),
    })?;
    if motion.lost > 0 {
        output::note(format_args!("warning: {} ticks are missing in the log: straight lines bridge them", motion.lost));
    }
    let plan = plan(&blueprint, &fit(&motion).scaled(args.rate)).map_err(split)?;
    refuse_real_arms(&blueprint, args.onto.allow_motion)?;
    let terminal = Terminal::start().context("cannot start the thread of the text log")?;
    let signals = Signals::watch_with_hangup();
    // The motors are enabled after the limits have been checked.
    let wanted: Vec<bool> = blueprint.arms.iter().map(|arm| arm.auto_enable).collect();
    blueprint.arms.iter_mut().for_each(|arm| arm.auto_enable = false);
    let run = Run::start(&blueprint, options(args))?;
    let show = Show { bars: !args.json && io::stderr().is_terminal(), quiet: args.json };
    let grips = motion.grips.as_slice();
    let driver =
        Driver { run: &run, blueprint: &blueprint, plan: &plan, grips, signals: &signals, show, rate: args.rate };
    let result = driver.drive(&wanted);
    let ended = run.stop();
    terminal.flush();
    print_summary(&result, &ended, args.json);
    for arm in ended.arms.iter().filter(|_| !args.json) {
        output::note(format_args!("{}: {}", arm.hardware_id, banner::after_exit(arm, &ended)));
    }
    result.map(|_| Exit::Ok).or_else(|end| match end {
        End::Failed(failure) => Err(failure),
        End::Signal(signal) => Ok(Exit::by_signal(signal)),
    })
}

fn options(args: &ReplayArgs) -> Options {
    let record = match &args.onto.record {
        Some(path) => Record::To(path.clone()),
        None if args.onto.no_record => Record::Off,
        None => Record::AsBlueprint,
    };
    Options { name: args.onto.name.clone(), record, ..Options::default() }
}

fn refuse_real_arms(blueprint: &Blueprint, allowed: bool) -> Result<()> {
    let real: Vec<&str> = blueprint.arms.iter().filter(|a| is_real(a)).map(|a| a.hardware_id.as_str()).collect();
    if real.is_empty() || allowed {
        return Ok(());
    }
    let what = format!("{} of {} are real arms", real.join(", "), blueprint.name);
    Err(Failure::usage(what).hint("clear the workspace and add --allow-motion, or simulate with --sim"))
}

/// Splits a hint off an error's text: a usage error.
fn split(error: impl std::fmt::Display) -> Failure {
    Failure::of(Exit::Usage, error)
}

/// Why the motion ended early.
enum End {
    Failed(Failure),
    Signal(i32),
}

impl From<Failure> for End {
    fn from(failure: Failure) -> Self {
        Self::Failed(failure)
    }
}

impl From<RpcError> for End {
    fn from(error: RpcError) -> Self {
        let what = format!("{} [{}]", error.message, error.code.name());
        Self::Failed(Failure::new(Exit::Failed, what).maybe_hint(error.hint))
    }
}

struct Show {
    bars: bool,
    quiet: bool,
}

impl Show {
    fn note(&self, text: std::fmt::Arguments<'_>) {
        if !self.quiet {
            output::note(text);
        }
    }
}

struct Driver<'a> {
    run: &'a Run,
    blueprint: &'a Blueprint,
    plan: &'a Plan,
    grips: &'a [RecordedGrip],
    signals: &'a Signals,
    show: Show,
    rate: f64,
}

impl Driver<'_> {
    fn drive(&self, wanted: &[bool]) -> std::result::Result<Vec<Deviation>, End> {
        let state = self.first_states()?;
        self.check_limits()?;
        let grips = self.possible_grips(&state);
        for (arm, wanted) in self.blueprint.arms.iter().zip(wanted) {
            if *wanted || self.plan.approaches.iter().any(|a| a.arm == arm.hardware_id) {
                self.run.call(ArmEnable::new(arm.hardware_id.clone()))?;
            }
        }
        // The approaches and the motion are one request of the user's.
        let run = self.run.until_interrupted();
        for approach in &self.plan.approaches {
            let target = target(approach, &state);
            let go = Move::direct(approach.arm.clone(), target, APPROACH_SPEED);
            let begun = run.call(go)?;
            let (arm, duration) = (&approach.arm, begun.duration);
            self.show.note(format_args!("approach: {arm} moves to the start of the motion, {duration:.1} s, directly"));
            self.follow(&[begun.motion], "approach", &[])?;
        }
        let parts = self.plan.parts.iter();
        let requests: Vec<Execute> = parts
            .map(|p| Execute { trajectory: sent(&p.trajectory), task: Some(p.task.clone()), retraces_to: None })
            .collect();
        let mut motions = Vec::new();
        let mut refused = None;
        for begun in run.call_together(&requests) {
            match begun {
                Ok(begun) => motions.push(begun.motion),
                Err(e) => refused = Some(e),
            }
        }
        if let Some(e) = refused {
            self.cancel(&motions)?;
            return Err(e.into());
        }
        let duration = self.plan.parts.first().map_or(0.0, |p| p.trajectory.duration());
        let (joints, rate) = (self.plan.parts.iter().map(|p| p.trajectory.joint_names.len()).sum::<usize>(), self.rate);
        self.show.note(format_args!("motion: {joints} joints, {duration:.1} s at rate {rate}, not collision-checked"));
        let reports = self.follow(&motions, "motion", &grips)?;
        Ok(reports.into_iter().flat_map(|report| report.deviation.unwrap_or_default()).collect())
    }

    /// Waits until every arm has reported its state.
    fn first_states(&self) -> std::result::Result<StateReport, End> {
        let limit = Instant::now() + FIRST_STATE_TIMEOUT;
        loop {
            let state = self.run.call(State {})?;
            let unknown = state.arms.iter().find(|arm| arm.joints.iter().any(|j| j.position.is_none()));
            match unknown {
                None => return Ok(state),
                Some(arm) if Instant::now() >= limit => {
                    let what = format!("{} reports no position", arm.hardware_id);
                    let hint = "start this blueprint with `dimos run` and check `dimos status`";
                    return Err(Failure::new(Exit::Hardware, what).hint(hint).into());
                }
                Some(_) => std::thread::sleep(Duration::from_millis(5)),
            }
        }
    }

    fn check_limits(&self) -> std::result::Result<(), End> {
        let joints: Vec<String> = self.blueprint.arms.iter().flat_map(|arm| arm.joints.clone()).collect();
        let verdict = check_limits(self.plan, self.run.config(), &joints).map_err(|e| split(e.to_string()))?;
        let Some(worst) = verdict.broken.first() else { return Ok(()) };
        let more = verdict.broken.len() - 1;
        let others = if more > 0 { format!(" ({more} more limits exceeded)") } else { String::new() };
        let hint = if worst.limit == "position" {
            "limits are those of the arm, narrowed by `limits` in the blueprint; select another part of the log"
                .to_owned()
        } else {
            // Rounded down, otherwise it would be rejected again.
            let possible = (self.rate * verdict.possible_rate * 1000.0).floor() / 1000.0;
            format!("slow it down with --rate {possible}; if the part begins or ends in motion, select other ends")
        };
        let what = format!("{worst}{others}; nothing has moved");
        Err(Failure::new(Exit::Failed, what).hint(hint).into())
    }

    /// Returns the recorded gripper commands for arms with a gripper, and prints how many others are left out.
    fn possible_grips(&self, state: &StateReport) -> Vec<&RecordedGrip> {
        let grips = |arm: &str| state.arms.iter().any(|a| a.hardware_id == arm && a.gripper_unit.is_some());
        let possible: Vec<_> = self.grips.iter().filter(|grip| grips(&grip.arm)).collect();
        let others = self.grips.len() - possible.len();
        if others > 0 {
            self.show.note(format_args!("warning: {others} gripper commands of the log are left out: no such gripper"));
        }
        possible
    }

    /// Sends the gripper commands whose time has come; of several, the last of each arm.
    fn grip(&self, due: &[&RecordedGrip]) -> std::result::Result<(), End> {
        for (k, grip) in due.iter().enumerate() {
            if due.iter().skip(k + 1).all(|later| later.arm != grip.arm) {
                let (arm, position) = (grip.arm.clone(), grip.position);
                let (force, speed) = (grip.force, grip.speed);
                self.run.call(Gripper { arm, position, force, speed, timeout: None })?;
            }
        }
        Ok(())
    }

    /// Waits for the end of all motions, and sends gripper commands at their times. A failure of one, or a signal,
    /// cancels the others.
    fn follow(
        &self,
        motions: &[u64],
        what: &'static str,
        mut grips: &[&RecordedGrip],
    ) -> std::result::Result<Vec<MotionReport>, End> {
        let bar = if self.show.bars { ProgressBar::new(1000) } else { ProgressBar::hidden() };
        if let Ok(style) = ProgressStyle::with_template("{prefix} [{bar:40}] {percent:>3} % {msg}") {
            bar.set_style(style.progress_chars("=> "));
        }
        bar.set_prefix(what);
        let result = loop {
            let reports = self.reports(motions)?;
            let elapsed = reports.iter().map(|r| r.elapsed).fold(0.0, f64::max) * self.rate;
            let (due, later) = grips.split_at(grips.partition_point(|grip| grip.time <= elapsed));
            grips = later;
            if let Err(refused) = self.grip(due) {
                break Err(refused);
            }
            let slowest = reports.iter().map(|r| r.progress).fold(1.0, f64::min);
            bar.set_position((slowest.clamp(0.0, 1.0) * 1000.0) as u64);
            bar.set_message(format!("{:.1} s left", reports.iter().map(|r| r.remaining).fold(0.0, f64::max)));
            if let Some(failed) = reports.iter().find(|r| r.done && r.state != "COMPLETED") {
                let why = failed.error.clone().unwrap_or_else(|| "it ended before its goal".to_owned());
                let failure =
                    Failure::new(Exit::Failed, format!("the {what} on {}: {}: {why}", failed.task, failed.state));
                break Err(End::Failed(failure.hint("see the log of this run for the cause")));
            }
            if reports.iter().all(|r| r.done) {
                break Ok(reports);
            }
            if let Some(signal) = self.signals.last() {
                break Err(End::Signal(signal));
            }
            match self.run.wait_for_end(Some(POLL_PERIOD)) {
                Ending::Duration => {}
                Ending::Fault(fault) => break Err(End::Failed(Failure::new(Exit::Fault, fault))),
                _ => break Err(End::Failed(Failure::new(Exit::Failed, "shutdown requested".to_owned()))),
            }
        };
        bar.finish_and_clear();
        if let Err(End::Signal(_)) = &result {
            self.show.note(format_args!("cancelling: the arms decelerate"));
        }
        if result.is_err() {
            self.cancel(motions)?;
        }
        result
    }

    fn reports(&self, motions: &[u64]) -> std::result::Result<Vec<MotionReport>, End> {
        motions.iter().map(|&motion| Ok(self.run.call(api::Motion { motion })?)).collect()
    }

    /// Cancels motions and waits for their end. A motion that cannot be cancelled ends with the run.
    fn cancel(&self, motions: &[u64]) -> std::result::Result<(), End> {
        let limit = Instant::now() + REST_TIMEOUT;
        if self.run.call(Cancel::default()).is_ok() {
            while Instant::now() < limit && !self.reports(motions)?.iter().all(|r| r.done) {
                std::thread::sleep(POLL_PERIOD);
            }
        }
        Ok(())
    }
}

/// Returns a full target: joints outside the motion keep their positions.
fn target(approach: &Approach, state: &StateReport) -> Vec<f64> {
    let arm = state.arms.iter().find(|arm| arm.hardware_id == approach.arm);
    let present = |j: usize| arm.and_then(|arm| arm.joints.get(j)?.position).unwrap_or(f64::NAN);
    approach.target.iter().enumerate().map(|(j, target)| target.unwrap_or_else(|| present(j))).collect()
}

fn sent(trajectory: &JointTrajectory) -> Trajectory {
    let points = trajectory.points.iter().map(|p| Point {
        time_from_start: p.time_from_start,
        positions: p.positions.to_vec(),
        velocities: Some(p.velocities.to_vec()),
        accelerations: None,
    });
    Trajectory { joint_names: trajectory.joint_names.clone(), points: points.collect() }
}

fn print_summary(result: &std::result::Result<Vec<Deviation>, End>, ended: &Ended, json: bool) {
    #[derive(Serialize)]
    struct Line<'a> {
        event: &'static str,
        completed: bool,
        deviation: BTreeMap<&'a str, f64>,
        troubles: &'a [String],
        log: Option<&'a PathBuf>,
    }
    let deviation = result.as_ref().map(Vec::as_slice).unwrap_or_default();
    if json {
        let deviation = deviation.iter().map(|d| (d.joint.as_str(), d.error())).collect();
        let (troubles, log, completed) = (ended.troubles.as_slice(), ended.log.as_ref(), result.is_ok());
        return output::json(&Line { event: "replayed", completed, deviation, troubles, log });
    }
    if result.is_ok() {
        output::line("motion: COMPLETED");
        show_deviation(deviation);
    }
    for trouble in &ended.troubles {
        output::note(format_args!("warning: {trouble}"));
    }
    if let Some(log) = &ended.log {
        output::note(format_args!("log: {}", log.display()));
    }
}
