//! `dimos adapter test NAME --first-day`: the steps with a person at the terminal, and their report.

use std::io::{self, IsTerminal};

use anyhow::Context;
use serde_json::Value;

use super::super::ask;
use super::super::exit::{Exit, Failure, Result};
use super::super::follow::Signals;
use super::super::output::{self, Table, fixed};
use super::test::{Args, Bench};
use dimos_hardware::adapter::{AdapterError, JointReading};
use dimos_hardware::conformance::first_day::report::{Line, Report};
use dimos_hardware::conformance::first_day::{self, Answer, Made, Outcome, Person, STEPS, Step, remove_serial};
use dimos_hardware::conformance::first_motion;
use dimos_hardware::registry::AdapterSpec;
use dimos_hardware::transport::capture::{self, Capture};

/// The person at the terminal, if there is one.
struct Terminal<'a> {
    signals: &'a Signals,
    /// Whether steps are asked for.
    asks: bool,
    /// Whether somebody is at the arm.
    there: bool,
}

impl Person for Terminal<'_> {
    fn ask(&mut self, step: &Step, about: &str) -> Answer {
        output::note(format_args!("{}: {about}", step.name));
        if !self.asks {
            return Answer::Yes;
        }
        loop {
            ask::discard_typed();
            output::note("  make this step? y = yes, s = skip it, n = end here:");
            match ask::line(self.signals).as_deref() {
                Some("y" | "yes") => return Answer::Yes,
                Some("s" | "skip") => return Answer::Skip,
                Some("n" | "no") | None => return Answer::End,
                Some(_) => {}
            }
        }
    }

    fn tell(&mut self, text: &str) {
        output::note(format_args!("  {text}"));
    }

    fn is_there(&self) -> bool {
        self.there
    }
}

/// Runs the steps.
pub fn run(args: &Args, row: &AdapterSpec) -> Result {
    let chosen = |step: &Step| args.only.as_ref().is_none_or(|text| step.name.contains(text));
    if !STEPS.iter().any(chosen) {
        let names: Vec<_> = STEPS.iter().map(|step| step.name).collect();
        return Err(Failure::usage("no step has such a name").hint(names.join(", ")));
    }
    // A terminal that is closed must stop the arm too.
    let signals = Signals::watch_with_hangup();
    let bench = args.bench(row)?;
    let asks = bench.subject.real && !args.yes;
    if asks {
        ask::needs_terminal("add --yes, and keep out of the reach of the arm")?;
    }
    if let Some(path) = &args.report {
        // Ten minutes at an arm must not be lost to a folder that is not there.
        std::fs::File::create(path).with_context(|| format!("--report {}", path.display()))?;
    }
    capture::start();
    let (report, mut capture, serial) = measure(row, &bench, &signals, &chosen, asks)?;
    let wire = row.wire.as_ref();
    if let Some(serial) = &serial {
        remove_serial(serial, wire, &report.connections, &mut capture.chunks);
    }
    publish(args, &report);
    if let Some(path) = &args.report {
        report.write(&capture.chunks, path).with_context(|| format!("--report {}", path.display()))?;
        let count = capture.chunks.len();
        output::note(format_args!(
            "{} has the figures and {count} captured chunks; send it, or play it:",
            path.display()
        ));
        output::note(format_args!("dimos adapter replay {}", path.display()));
    }
    if let Some(signal) = signals.last() {
        return Ok(Exit::by_signal(signal));
    }
    let failed: Vec<&str> =
        report.steps.iter().filter(|step| step.outcome == Outcome::Failed).map(|step| step.step.as_str()).collect();
    match failed[..] {
        [] => Ok(Exit::Ok),
        _ => Err(Failure::new(Exit::Failed, format!("steps failed: {}", failed.join(", ")))),
    }
}

/// Makes the steps. Returns the report without serial number, what was captured, and the serial number.
fn measure(
    row: &AdapterSpec,
    bench: &Bench,
    signals: &Signals,
    chosen: &dyn Fn(&Step) -> bool,
    asks: bool,
) -> Result<(Report, Capture, Option<String>)> {
    let unreachable = |e: AdapterError| Failure::of(Exit::Hardware, e);
    let mut config = bench.subject.config.clone();
    if let Some(emulator) = &bench.emulator {
        config.address = emulator.address();
    }
    let mut adapter = (row.create)(&config).map_err(|e| Failure::of(Exit::Usage, e))?;
    adapter.connect().map_err(unreachable)?;
    if let Err(why) = first_motion::refusal(&mut *adapter) {
        adapter.disconnect();
        return Err(Failure::of(Exit::Failed, format!("not moved: {why}")));
    }
    if asks {
        output::note(format_args!(
            "The motors of {} at {} will come on, and one joint will move by up to 60°, not collision-checked.\n\
             Clear the space around it, keep out of it, and stay within reach of its E-stop button. Ctrl-C stops it.",
            adapter.get_info().model,
            bench.address,
        ));
    }
    let mut reading = JointReading::default();
    let info = adapter.get_info();
    let mut person = Terminal { signals, asks, there: asks && io::stdin().is_terminal() };
    let steps = adapter.read_joints(&mut reading).and_then(|()| {
        let (adapter, emulator) = (&mut *adapter, bench.emulator.as_deref());
        let subject = first_day::Subject { adapter, emulator, row, config: &config };
        first_day::run(subject, chosen, &mut person, &|| signals.last().is_some())
    });
    adapter.disconnect();
    let steps = steps.map_err(unreachable)?;
    let pose: Vec<f64> = reading.position.iter().take(info.dof).copied().collect();
    let capture = capture::finish();
    let names = row.wire.map(|wire| (wire.connections)(&config.address)).unwrap_or_default();
    let connections = capture.connections.iter().map(|connection| {
        let known = names.iter().find(|(_, peer)| *peer == connection.peer);
        let name = known.map_or_else(|| "other".to_owned(), |(name, _)| (*name).to_owned());
        Line { name, datagrams: connection.datagrams, port: connection.port }
    });
    let (format, version, dimos) = Report::marks(crate::VERSION);
    let report = Report {
        format,
        version,
        dimos,
        when: jiff::Timestamp::from_second(jiff::Timestamp::now().as_second()).unwrap_or_default().to_string(),
        adapter: row.name.to_owned(),
        simulated: !bench.subject.real,
        vendor: info.vendor,
        model: info.model,
        dof: info.dof,
        firmware: info.firmware_version,
        options: without_paths(&config.options),
        pose,
        steps: steps.into_iter().map(|step| anonymous(step, info.serial_number.as_deref())).collect(),
        connections: connections.collect(),
        cut: capture.cut,
    };
    Ok((report, capture, info.serial_number))
}

/// Removes a serial number from the texts of a step.
fn anonymous(mut step: Made, serial: Option<&str>) -> Made {
    if let Some(serial) = serial.filter(|serial| !serial.is_empty()) {
        step.detail = step.detail.replace(serial, "(serial number)");
    }
    step
}

/// Leaves out options that are files of this computer.
fn without_paths(options: &Value) -> Value {
    match options {
        Value::Object(all) => all
            .iter()
            .filter(|(key, value)| *key != "calibration" && !value.as_str().is_some_and(|text| text.contains('/')))
            .map(|(key, value)| (key.clone(), without_paths(value)))
            .collect::<serde_json::Map<_, _>>()
            .into(),
        other => other.clone(),
    }
}

fn publish(args: &Args, report: &Report) {
    if args.json {
        output::json(report);
        return;
    }
    let simulated = if report.simulated { " SIMULATED" } else { "" };
    let firmware = report.firmware.as_deref().unwrap_or("not reported");
    output::line(format_args!("{} {}{simulated}, firmware {firmware}", report.vendor, report.model));
    let mut table = Table::new(&["STEP", "", "FOUND"]);
    for step in &report.steps {
        table.row([step.step.as_str(), step.outcome.name(), step.detail.as_str()]);
    }
    table.print();
    output::line("");
    let mut table = Table::new(&["FIGURE", ">VALUE", "UNIT", "WHERE IT BELONGS"]);
    for figure in report.steps.iter().flat_map(|step| &step.figures) {
        let line = figure.line.as_deref().unwrap_or_default();
        table.row([figure.name.as_str(), &fixed(figure.value, 3), figure.unit.as_str(), line]);
    }
    table.print();
}
