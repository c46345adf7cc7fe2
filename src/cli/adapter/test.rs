//! `dimos adapter test NAME`: an adapter against its arm. On a real one nothing is enabled and nothing moves, unless
//! that is asked for; on the emulator the whole suite runs.

use std::io::{self, IsTerminal};
use std::path::PathBuf;
use std::time::Duration;

use anyhow::Context;
use indicatif::{ProgressBar, ProgressStyle};

use super::super::ask;
use super::super::exit::{Exit, Failure, Result};
use super::super::follow::Signals;
use super::super::output;
use super::choice::{Choice, not_started};
use super::first_day;
use super::peripheral;
use super::report::{Arm, Limits, Report, Row};
use crate::runtime::arm::device_lock::{self, DeviceLock};
use dimos_core::joint::ControlMode;
use dimos_hardware::adapter::{AdapterError, ManipulatorAdapter, ManipulatorInfo};
use dimos_hardware::conformance::lag::Lag;
use dimos_hardware::conformance::{Check, Made, Subject, checks, figures, first_motion, run_all};
use dimos_hardware::registry::{AdapterConfig, AdapterSpec, Emulator, EmulatorAddress, Registry, SIM};
use dimos_rpc::run_dir::RunDir;

/// For how long the state is watched.
const WATCH: Duration = Duration::from_secs(2);

/// Arguments of `adapter test`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Without --allow-motion nothing is enabled and nothing moves. With it, and only when no check failed, after a question, \
each joint goes 2° to either side and back, one after the other, at 5 % of its top speed; whatever is odd, and Ctrl-C, ends that by a stop.
With --lag this motion is streamed as setpoints, and the lag is measured: the time from a setpoint to the motion that follows it.
With --first-day ten minutes of steps measure what only the arm can tell, slow to fast: each is asked for (y, n ends, s skips), Ctrl-C \
stops the arm and keeps what was measured. --report then writes the file for `dimos adapter replay`, without serial number.
Stay within reach of the arm's own E-stop button.

Exit codes: 0 all passed, 1 something failed, 2 usage, 3 the arm cannot be reached.")]
pub struct Args {
    /// The adapter and its options.
    #[command(flatten)]
    pub choice: Choice,
    /// Where the arm is, as in a blueprint; `sim` for its emulator
    #[arg(long)]
    pub address: Option<String>,
    /// Move each joint a little, slowly
    #[arg(long, group = "motion")]
    pub allow_motion: bool,
    /// Measure the lag by a small slow motion of each joint; a real arm needs --allow-motion too
    #[arg(long)]
    pub lag: bool,
    /// Measure what only the arm can tell, in steps, slow to fast; each is asked for
    #[arg(long, group = "motion", conflicts_with = "lag")]
    pub first_day: bool,
    /// Do not ask before the motion, or before the steps
    #[arg(long, requires = "motion")]
    pub yes: bool,
    /// Make only the checks, or the steps, with this in their names
    #[arg(long, value_name = "TEXT")]
    pub only: Option<String>,
    /// Write the report: as Markdown, or of a first day the file for `adapter replay`
    #[arg(long, value_name = "FILE")]
    pub report: Option<PathBuf>,
    /// Print JSON
    #[arg(long)]
    pub json: bool,
}

/// An arm to test: what its adapter is made from, and what must live as long as the test.
pub(super) struct Bench {
    pub(super) subject: Subject,
    /// The address in full.
    pub(super) address: String,
    pub(super) emulator: Option<Box<dyn Emulator>>,
    _lock: Option<DeviceLock>,
}

/// Runs the verb.
pub fn run(args: &Args, registry: &Registry) -> Result {
    if let Some(peripheral) = registry.peripheral(&args.choice.name) {
        return peripheral::test(args, peripheral);
    }
    let row = args.choice.row(registry)?;
    if args.first_day {
        return first_day::run(args, &row);
    }
    let chosen: Vec<&'static Check> =
        checks().filter(|check| args.only.as_ref().is_none_or(|text| check.name.contains(text))).collect();
    if chosen.is_empty() {
        let names: Vec<_> = checks().map(|check| check.name).collect();
        return Err(Failure::usage("no check has such a name").hint(names.join(", ")));
    }
    // A terminal that is closed must stop the arm too.
    let signals = Signals::watch_with_hangup();
    let bench = args.bench(&row)?;
    if args.lag && bench.subject.real && !args.allow_motion {
        return Err(Failure::usage("--lag moves the arm").hint("add --allow-motion"));
    }
    let mut adapter = (row.create)(&bench.subject.config).map_err(|e| Failure::of(Exit::Usage, e))?;
    let unreachable = |e: AdapterError| {
        let failure = Failure::of(Exit::Hardware, e);
        let hint = format!("is it powered, and is the address right ({})?", row.address.form);
        if failure.hint.is_none() && bench.subject.real { failure.hint(hint) } else { failure }
    };
    adapter.connect().map_err(unreachable)?;
    let limits = adapter.get_limits().map_err(unreachable)?;
    let figures = figures::measure(&mut *adapter, WATCH).map_err(unreachable)?;
    let info = adapter.get_info();
    adapter.disconnect();
    let checks = args.check(&bench.subject, chosen, &signals).into_iter().map(Row::of).collect();
    let mut report = Report {
        adapter: row.name.to_owned(),
        address: bench.address.clone(),
        simulated: bench.emulator.is_some(),
        when: jiff::Timestamp::from_second(jiff::Timestamp::now().as_second()).unwrap_or_default().to_string(),
        dimos: crate::VERSION,
        arm: arm(&row, info.clone()),
        figures: Some(figures),
        limits: Limits::from(&limits),
        checks,
        passed: false,
        motion: None,
        lag: None,
    };
    if !args.json {
        report.print(); // before the motion: the user who confirms it knows the result so far
    }
    let moved = match report.count("failed") {
        _ if !(args.allow_motion || args.lag) || signals.last().is_some() => Ok((None, None)),
        0 => args.motion(&mut *adapter, &info, &bench, &signals).map(|(motion, lag)| (Some(motion), lag)),
        1 => Err(Failure::new(Exit::Failed, "not moved: 1 check failed")),
        failed => Err(Failure::new(Exit::Failed, format!("not moved: {failed} checks failed"))),
    };
    (report.motion, report.lag) = moved.as_ref().ok().cloned().unwrap_or_default();
    report.passed = report.count("failed") == 0
        && report.motion.as_ref().is_none_or(|motion| motion.odd.is_none())
        && report.lag.as_ref().is_none_or(Lag::complete);
    args.publish(&report)?;
    moved?;
    match signals.last() {
        Some(signal) => Ok(Exit::by_signal(signal)),
        None if report.passed => Ok(Exit::Ok),
        None => Err(Failure::new(Exit::Failed, report.verdict())),
    }
}

impl Args {
    /// Finds the arm, or starts its emulator.
    pub(super) fn bench(&self, row: &AdapterSpec) -> Result<Bench> {
        let subject = |config: AdapterConfig, real| Subject { config, real, ..Subject::emulated(row) };
        match self.address.as_deref().map(str::trim) {
            Some(SIM) if row.emulate.is_some() => {
                let (emulator, config) = self.emulate(row)?;
                let address = config.address.clone();
                Ok(Bench { subject: subject(config, false), address, emulator: Some(emulator), _lock: None })
            }
            None | Some("") if row.address.required => {
                let failure = Failure::usage(format!("where is the arm? {} needs --address", row.name));
                let form = row.address.form;
                Err(failure.hint(match row.emulate {
                    Some(_) => format!("--address {form}, or --address {SIM} for its emulator"),
                    None => format!("--address {form}"),
                }))
            }
            None | Some("" | SIM) => {
                let config = self.made(row, "")?;
                Ok(Bench { subject: subject(config, false), address: String::new(), emulator: None, _lock: None })
            }
            Some(address) => {
                let full = (row.address.check)(address)
                    .map_err(|e| Failure::usage(format!("--address {address}: {e}")).hint(row.address.form))?;
                let config = self.made(row, &full)?;
                let lock = device_lock::take(row.name, &full, RunDir::standard().is_closed())
                    .map_err(|e| Failure::new(Exit::Hardware, e.to_string()).hint(e.hint()))?;
                Ok(Bench { subject: subject(config, true), address: full, emulator: None, _lock: Some(lock) })
            }
        }
    }

    /// A configuration from which an adapter can be made.
    fn made(&self, row: &AdapterSpec, address: &str) -> Result<AdapterConfig> {
        let config = self.choice.config(row, address)?;
        let several = self.choice.dof.is_none() && row.dof.0 != row.dof.1;
        if several && row.address.required && self.choice.model.is_none() {
            let what = format!("how many joints has it? {} allows {}", row.name, super::choice::joints(row));
            return Err(Failure::usage(what).hint(format!("--dof {}, say", config.dof)));
        }
        Ok(config)
    }

    /// Starts the emulator, and says what an adapter for it is made from.
    fn emulate(&self, row: &AdapterSpec) -> Result<(Box<dyn Emulator>, AdapterConfig)> {
        let mut config = self.choice.config(row, SIM)?;
        let start = row.emulate.ok_or(AdapterError::Unsupported);
        let emulator = start.and_then(|start| start(&config, &EmulatorAddress::InProcess)).map_err(not_started)?;
        config.address = emulator.address();
        Ok((emulator, config))
    }

    /// Makes the checks, showing how far it is.
    fn check(&self, subject: &Subject, chosen: Vec<&'static Check>, signals: &Signals) -> Vec<Made> {
        let bar = self.bar(chosen.len() as u64);
        let made = run_all(
            subject,
            &chosen,
            &|check, _| {
                bar.set_message(check.name);
                bar.inc(1);
            },
            &|| signals.last().is_some(),
        );
        bar.finish_and_clear();
        made
    }

    fn bar(&self, length: u64) -> ProgressBar {
        let seen = !self.json && io::stderr().is_terminal();
        let bar = if seen { ProgressBar::new(length) } else { ProgressBar::hidden() };
        if let Ok(style) = ProgressStyle::with_template("[{bar:30}] {pos}/{len} {msg}") {
            bar.set_style(style.progress_chars("=> "));
        }
        bar
    }

    /// The small slow motion, and the lag where it is measured.
    fn motion(
        &self,
        adapter: &mut dyn ManipulatorAdapter,
        info: &ManipulatorInfo,
        bench: &Bench,
        signals: &Signals,
    ) -> Result<(first_motion::Motion, Option<Lag>)> {
        if self.lag && !info.modes.contains(&ControlMode::ServoPosition) {
            let modes = info.modes.iter().map(|mode| mode.name()).collect::<Vec<_>>().join(", ");
            let what = format!("not moved: no lag to measure, {} has no servo_position mode", info.model);
            return Err(Failure::new(Exit::Failed, what).hint(format!("its modes: {modes}")));
        }
        connect_to_move(adapter)?;
        adapter.disconnect();
        let (model, dof) = (&info.model, info.dof);
        if bench.subject.real && !self.yes {
            output::note(format_args!(
                "The motors of {model} at {} will come on. Then each of its {dof} joints goes {:.0}° to either side and \
                 back, first +, then −, at {:.0} % of its top speed, not collision-checked.\n\
                 Clear the space around it, keep out of it, and stay within reach of its E-stop button. Ctrl-C stops it.",
                bench.address,
                first_motion::REACH.to_degrees(),
                100.0 * first_motion::SPEED,
            ));
            confirm(signals)?;
        }
        // Once more: much can happen while a question waits for its answer.
        connect_to_move(adapter)?;
        let quiet = self.json;
        let (interrupted, mut tell) = (
            || signals.last().is_some(),
            |what: &str| {
                if !quiet {
                    output::note(what);
                }
            },
        );
        let (motion, lag) = if self.lag {
            let (motion, lag) = first_motion::measure_lag(adapter, bench.subject.row.lag, &interrupted, &mut tell);
            (motion, Some(lag))
        } else {
            (first_motion::run_first_motion(adapter, &interrupted, &mut tell), None)
        };
        adapter.disconnect();
        Ok((motion, lag))
    }

    /// Printed first: a file that cannot be written must not cost what was found.
    fn publish(&self, report: &Report) -> Result<()> {
        if self.json {
            output::json(report);
        } else {
            report.conclude();
        }
        let Some(path) = &self.report else { return Ok(()) };
        Ok(std::fs::write(path, report.markdown()).with_context(|| format!("--report {}", path.display()))?)
    }
}

/// Connects to an arm that is to be moved; fails if something prevents moving it from its position.
fn connect_to_move(adapter: &mut dyn ManipulatorAdapter) -> Result<()> {
    adapter.connect().map_err(|e| Failure::of(Exit::Hardware, e))?;
    let Err(why) = first_motion::refusal(adapter) else { return Ok(()) };
    adapter.disconnect();
    Err(Failure::of(Exit::Failed, format!("not moved: {why}")))
}

/// Asks, where somebody can answer.
fn confirm(signals: &Signals) -> Result<()> {
    if !io::stdin().is_terminal() || !io::stderr().is_terminal() {
        return Err(Failure::usage("the motion cannot be confirmed: stdin is not a terminal").hint("add --yes"));
    }
    output::note("Type yes to continue:");
    if ask::line(signals).as_deref() == Some("yes") {
        return Ok(());
    }
    Err(match signals.last() {
        Some(signal) => Failure::new(Exit::by_signal(signal), "not moved: interrupted"),
        None => Failure::new(Exit::Failed, "not moved: the answer was not yes"),
    })
}

fn arm(row: &AdapterSpec, info: ManipulatorInfo) -> Arm {
    Arm {
        vendor: info.vendor,
        model: info.model,
        dof: info.dof,
        firmware: info.firmware_version,
        serial: info.serial_number,
        modes: info.modes.iter().map(|mode| mode.name()).collect(),
        wire_units: row.wire_units,
        native_rate_hz: info.native_rate,
        holds_when_disabled: info.holds_when_disabled,
    }
}
