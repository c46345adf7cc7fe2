//! `dimos arm calibrate ADAPTER`: the middle pose and the range of each joint, led by hand with the motors off.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::Context;

use super::super::ask::{self, Typed};
use super::super::exit::{Exit, Failure, Result};
use super::super::follow::Signals;
use super::super::output;
use super::bus::{self, failure};
use super::live_table::{Place, Seen, lines};
use dimos_core::message::Message;
use dimos_hardware::adapter::{AdapterError, AdapterResult};
use dimos_hardware::registry::Registry;
use dimos_hardware::service::Service;

/// How often positions are read and shown.
const PERIOD: Duration = Duration::from_millis(50);
/// A smaller range was not recorded: the joint was not moved [part of a turn].
const SMALLEST: f64 = 0.025;
/// End of the name of a calibration that is not written to the motors yet.
const PART: &str = "part";

/// Arguments of `arm calibrate`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
The motors are off and nothing moves the arm: you do. Nothing is written before the ranges are complete; Ctrl-C changes nothing.
Then the calibration is saved as FILE.part (of an SO-101: in LeRobot's format), written to the motors, read back, and renamed to FILE.
If writing fails, FILE.part remains: --restore FILE.part writes it again. A run uses the file with the adapter's option `calibration`.")]
pub struct Args {
    #[command(flatten)]
    bus: bus::BusArgs,
    /// Calibration file to write
    #[arg(long, value_name = "FILE", required_unless_present = "restore")]
    file: Option<PathBuf>,
    /// Write the calibration of this file to the motors instead, as after the exchange of one or a failed write
    #[arg(long, value_name = "FILE", conflicts_with_all = ["file", "force"])]
    restore: Option<PathBuf>,
    /// Overwrite the calibration file
    #[arg(long)]
    force: bool,
    /// Ask nothing: the arm is in its middle pose now, its motors may be switched off, and ranges are recorded for the
    /// time of --record-for
    #[arg(long)]
    yes: bool,
    /// With --yes: record ranges for this time: 30s, 2m
    #[arg(long, value_name = "TIME", default_value = "30s", requires = "yes", value_parser = super::super::arguments::duration)]
    record_for: Duration,
}

/// Runs the verb.
pub fn run(args: &Args, registry: &Registry) -> Result {
    if let Some(file) = args.file.as_ref().filter(|file| file.exists() && !args.force) {
        let what = format!("{} exists", file.display());
        return Err(Failure::usage(what).hint("--force overwrites it; --restore writes it to the motors"));
    }
    if !args.yes {
        ask::needs_terminal("--yes asks nothing; see `dimos arm calibrate --help`")?;
    }
    let signals = Signals::watch_with_hangup();
    let mut bus = args.bus.open(registry)?;
    bus.identify()?;
    bus.release(&signals, args.yes)?;
    match (&args.restore, &args.file) {
        (Some(file), _) => restore(&mut *bus.service, file),
        (None, Some(file)) => args.calibrate(&mut *bus.service, file, &signals),
        (None, None) => Err(Failure::usage("no file is given").hint("--file FILE")),
    }
}

fn restore(arm: &mut dyn Service, file: &Path) -> Result {
    let changed = write_and_read_back(arm, file).map_err(failure)?;
    match changed.as_slice() {
        [] => output::note(format_args!("the motors have the calibration of {} already", file.display())),
        changed => output::note(format_args!("written and read back: {}", changed.join(", "))),
    }
    if file.extension().is_some_and(|end| end == PART) {
        let whole = file.with_extension("");
        output::note(format_args!("now give the file its name: mv {} {}", file.display(), whole.display()));
    }
    Ok(Exit::Ok)
}

/// Writes a calibration to the motors, and sees that they have kept it: what was kept is not written again. Returns the
/// names of the motors that had another one.
fn write_and_read_back(arm: &mut dyn Service, file: &Path) -> AdapterResult<Vec<&'static str>> {
    let changed = arm.write_calibration(file)?;
    match arm.write_calibration(file)?.as_slice() {
        [] => Ok(changed),
        lost => Err(AdapterError::Rejected(format!(
            "motors do not keep the calibration that is written to them: {}\nhint: see whether their memory is locked",
            lost.join(", ")
        ))),
    }
}

impl Args {
    fn calibrate(&self, arm: &mut dyn Service, file: &Path, signals: &Signals) -> Result {
        if !self.yes {
            ask::enter(signals, "Bring every joint to the middle of its range")?;
        }
        arm.take_middle().map_err(failure)?;
        let names = |endless: bool| {
            let motors = arm.motors().iter().filter(|motor| motor.range.is_some() == endless);
            motors.map(|motor| motor.name).collect::<Vec<_>>().join(", ")
        };
        let (by_hand, endless) = (names(false), names(true));
        output::note(format_args!(
            "Move these joints through their whole range, one after the other: {by_hand}{}{}",
            if endless.is_empty() { String::new() } else { format!("; also {endless}, where it has end stops") },
            if self.yes { "" } else { "; then press Enter (Ctrl-C ends this)" }
        ));
        let (seen, turn) = (self.record(arm, signals)?, arm.counts_per_turn());
        let mut ranges = Vec::new();
        for (motor, seen) in arm.motors().iter().zip(&seen) {
            let (low, high) = seen.range(motor, turn);
            if f64::from(high - low) < SMALLEST * f64::from(turn) {
                let what = format!("{} was not moved: its range is {} counts", motor.name, high - low);
                return Err(Failure::new(Exit::Failed, what).hint("nothing was written; calibrate again"));
            }
            ranges.push((low, high));
        }
        let text = arm.calibration(&ranges).map_err(failure)?;
        let mut part = file.as_os_str().to_owned();
        part.push(format!(".{PART}"));
        let part = PathBuf::from(part);
        if let Err(error) = write(&part, &text) {
            // The recording must not be lost.
            output::line(text);
            let hint = "no motor was changed; save the text above as a file, and write it with --restore";
            return Err(error.hint(hint));
        }
        write_and_read_back(arm, &part).map_err(|error| self.not_written(error, &part))?;
        std::fs::rename(&part, file)
            .with_context(|| format!("the motors are calibrated, but {} cannot be renamed", part.display()))?;
        lines(arm.motors(), &seen, turn).iter().for_each(output::line);
        output::note(format_args!("written to the motors, read back, and saved: {}", file.display()));
        output::note(format_args!("in a blueprint: options: {{calibration: {}}}", absolute(file).display()));
        Ok(Exit::Ok)
    }

    /// The failure after a calibration was saved, and not or not completely written to the motors.
    fn not_written(&self, error: AdapterError, part: &Path) -> Failure {
        let Message { what, hint } = Message::of(&error);
        let cause = hint.map_or_else(String::new, |hint| format!("{hint}; "));
        let exit = failure(error).exit;
        Failure::new(exit, format!("{what}; the recording is saved: {}", part.display())).hint(format!(
            "{cause}to write it again: dimos arm calibrate {} --restore {}",
            self.bus,
            part.display()
        ))
    }

    /// Records positions until Enter, or for a time.
    fn record(&self, arm: &mut dyn Service, signals: &Signals) -> Result<Vec<Seen>> {
        let mut seen: Vec<Seen> = arm.positions().map_err(failure)?.into_iter().map(Seen::at).collect();
        let (began, mut place) = (Instant::now(), Place::default());
        let turn = arm.counts_per_turn();
        ask::discard_typed();
        loop {
            for ((motor, seen), position) in arm.motors().iter().zip(&mut seen).zip(arm.positions().map_err(failure)?) {
                seen.take(position, turn);
                if seen.passed && motor.range.is_none() {
                    let what = format!("{} passed the end of its turn: its middle was not where it began", motor.name);
                    return Err(
                        Failure::new(Exit::Failed, what).hint("nothing was written; begin again in the middle pose")
                    );
                }
            }
            place.draw(&lines(arm.motors(), &seen, turn));
            if signals.last().is_some() {
                return Err(ask::interrupted(signals));
            }
            if self.yes {
                if began.elapsed() >= self.record_for {
                    return Ok(seen);
                }
                std::thread::sleep(PERIOD);
                continue;
            }
            match ask::typed(PERIOD) {
                Typed::Line(_) => return Ok(seen),
                Typed::Nothing => {}
                Typed::End => return Err(ask::interrupted(signals)),
            }
        }
    }
}

fn write(file: &Path, text: &str) -> Result<()> {
    let wrong = || file.display().to_string();
    if let Some(folder) = file.parent().filter(|folder| !folder.as_os_str().is_empty()) {
        std::fs::create_dir_all(folder).with_context(wrong)?;
    }
    Ok(std::fs::write(file, text).with_context(wrong)?)
}

fn absolute(file: &Path) -> PathBuf {
    file.canonicalize().unwrap_or_else(|_| file.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_hardware::service::Motor;

    const MOTORS: &[Motor] = &[Motor { name: "pan", id: 1, range: None }, Motor { name: "lift", id: 2, range: None }];

    /// Motors that say that they were written; those from `forgets` on keep nothing.
    struct Motors {
        forgets: usize,
        written: usize,
    }

    impl Service for Motors {
        fn motors(&self) -> &'static [Motor] {
            MOTORS
        }
        fn identify(&mut self) -> AdapterResult<String> {
            Ok("two motors".to_owned())
        }
        fn powered(&mut self) -> AdapterResult<Vec<&'static str>> {
            Ok(Vec::new())
        }
        fn release(&mut self) -> AdapterResult<()> {
            Ok(())
        }
        fn write_calibration(&mut self, _file: &Path) -> AdapterResult<Vec<&'static str>> {
            let others = MOTORS.iter().enumerate().filter(|(at, _)| self.written == 0 || *at >= self.forgets);
            let names = others.map(|(_, motor)| motor.name).collect();
            self.written += 1;
            Ok(names)
        }
    }

    #[test]
    fn motors_that_forget_what_is_written_are_named() {
        let mut good = Motors { forgets: 2, written: 0 };
        let changed = write_and_read_back(&mut good, Path::new("arm.json")).unwrap();
        assert_eq!((changed, good.written), (vec!["pan", "lift"], 2));
        let mut forgetful = Motors { forgets: 1, written: 0 };
        let error = write_and_read_back(&mut forgetful, Path::new("arm.json")).unwrap_err();
        assert!(Message::of(&error).what.ends_with("written to them: lift"), "{error}");
    }
}
