//! `dimos adapter test --first-day` with the real binary: it must find what was planted in the emulators, and its
//! report must play. Judged by the figures, by what an emulator received, and by what is in the file.

use std::io::{Read as _, Write as _};
use std::path::Path;

use dimos::arms::yourarm::emulator::wire::Request;
use dimos::arms::yourarm::emulator::{SimOptions, YourArmEmulator};
use dimos::hardware::conformance::first_day::STEPS;
use dimos::hardware::conformance::first_day::report::Report;
use dimos::hardware::registry::Emulator;
use rustix::process::Signal;
use rustix::pty::{OpenptFlags, openpt, ptsname, unlockpt};
use serde_json::Value;

use crate::support::program::{self, Home};

/// Runs the program for as long as a tour takes, and returns what it printed.
fn run(home: &Home, line: &str) -> String {
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_dimos"));
    let ended = home.settle(command.args(line.split_whitespace())).output().unwrap();
    assert!(ended.status.success(), "{line}: {}", String::from_utf8_lossy(&ended.stderr));
    String::from_utf8(ended.stdout).unwrap()
}

/// The report of a tour.
fn tour(home: &Home, arguments: &str) -> Value {
    serde_json::from_str(&run(home, &format!("adapter test {arguments} --first-day --json"))).unwrap()
}

fn step<'r>(report: &'r Value, name: &str) -> &'r Value {
    let steps = report["steps"].as_array().unwrap();
    steps.iter().find(|step| step["step"] == name).unwrap_or_else(|| panic!("no step {name}: {report:#}"))
}

fn figure(report: &Value, name: &str, beginning: &str) -> f64 {
    let step = step(report, name);
    let figures = step["figures"].as_array().unwrap();
    let found = figures.iter().find(|figure| figure["name"].as_str().unwrap().starts_with(beginning));
    found.unwrap_or_else(|| panic!("no {beginning}: {step:#}"))["value"].as_f64().unwrap()
}

/// Within a tenth of what was planted.
fn found(report: &Value, name: &str, beginning: &str, planted: f64) {
    let found = figure(report, name, beginning);
    assert!((found - planted).abs() <= 0.1 * planted, "{beginning}: {found}, not {planted}: {:#}", step(report, name));
}

const PLANTED: &str = "--option sim.lag=0.06 --option sim.controller.deceleration=4 \
                       --option sim.controller.gap_tolerance=0.04 --option sim.controller.reports_commanded=false";

/// The whole tour on one arm: every step is measured or says why not, and the report plays without a difference.
#[test]
fn the_whole_tour_finds_what_was_planted_and_its_report_plays() {
    let home = Home::new();
    let report = tour(&home, &format!("yourarm --address sim {PLANTED} --report arm.day"));
    found(&report, "lag", "lag", 60.0);
    found(&report, "stops", "deceleration of a stop", 4.0);
    found(&report, "gaps", "gap tolerance", 40.0);
    found(&report, "gaps", "deceleration after a gap", 4.0);
    assert!(step(&report, "measured")["detail"].as_str().unwrap().contains("MEASURED"), "{report:#}");
    for made in report["steps"].as_array().unwrap() {
        let detail = made["detail"].as_str().unwrap();
        let expected = match made["step"].as_str().unwrap() {
            "tool_speed" | "program" => "skipped",
            _ => "measured",
        };
        assert_eq!(made["outcome"], expected, "{made:#}");
        assert!(
            !detail.is_empty()
                && made["figures"].as_array().is_some_and(|all| (expected == "skipped") == all.is_empty())
        );
    }
    assert_eq!(report["steps"].as_array().unwrap().len(), STEPS.len());
    let errors = step(&report, "errors")["detail"].as_str().unwrap().to_owned();
    assert!(
        errors.contains("E-stop: ") && errors.contains("cable out: ") && errors.contains("not: safeguard"),
        "{errors}"
    );
    let lag_line = &step(&report, "lag")["figures"][0]["line"];
    assert!(lag_line.as_str().unwrap().starts_with("hardware.arm.lag: 0.0"), "{lag_line}");

    // The serial number is in no line of the file.
    let text = zstd::decode_all(std::fs::File::open(home.path().join("arm.day")).unwrap()).unwrap();
    let text = String::from_utf8(text).unwrap();
    let hex: String = b"YA6-00042".iter().map(|byte| format!("{byte:02x}")).collect();
    assert!(!text.contains("YA6-00042") && !text.contains(&hex) && text.contains("303030303030303030"));
    assert!(text.lines().count() > 1000, "{} lines", text.lines().count());

    let played: Value = serde_json::from_str(&run(&home, "adapter replay arm.day --json")).unwrap();
    let state = &played["kinds"]["arm: GET_STATE reply"];
    assert!(state["arm"].as_u64().unwrap() > 500 && state["wrong"] == 0, "{state:#}");
    assert_eq!(played["damaged"][0], 0, "{played:#}");
}

/// What an arm does and the emulator does not is a difference, and so is a message that the decoder does not take.
#[test]
fn a_report_of_another_arm_differs() {
    let home = Home::new();
    tour(&home, "yourarm --address sim --only power --report arm.day");
    let path = home.path().join("arm.day");
    run(&home, "adapter replay arm.day");
    let (report, chunks) = Report::read(&path).unwrap();
    let mut other = chunks.clone();
    let reply = other.iter_mut().find(|chunk| !chunk.sent && chunk.bytes.len() > 60).unwrap();
    // The controller reports seven joints: its checksum is right, and the decoder does not take it.
    reply.bytes[8 + 1 + 8 + 3] = 7;
    let end = reply.bytes.len() - 2;
    let crc = reply.bytes[..end].iter().fold(0xFFFF_u16, |crc, byte| {
        (0..8).fold(
            crc ^ (u16::from(*byte) << 8),
            |crc, _| if crc & 0x8000 != 0 { (crc << 1) ^ 0x1021 } else { crc << 1 },
        )
    });
    reply.bytes[end..].copy_from_slice(&crc.to_le_bytes());
    report.write(&other, &path).unwrap();
    let differs = home.dimos("adapter replay arm.day").with(1).says(&["error: the emulator differs from the arm"]);
    assert!(differs.out.contains("decoder does not take 1 of them"), "{}", differs.out);
    std::fs::write(&path, b"nothing").unwrap();
    home.dimos("adapter replay arm.day").with(2).says(&["arm.day"]);
}

/// One arm on a serial line: its stop is a goal.
#[test]
fn a_tour_on_a_serial_line() {
    let home = Home::new();
    let report = tour(
        &home,
        "so101 --address sim --only s --report arm.day --option sim.lag=0.08 --option sim.controller.gap_tolerance=0.1",
    );
    assert!(step(&report, "measured")["detail"].as_str().unwrap().contains("MEASURED"), "{report:#}");
    assert_eq!(step(&report, "gaps")["outcome"], "measured", "{report:#}");
    // The servos' steps of 0.09° are 10 ms at the lowest of the three speeds.
    let bridged = figure(&report, "gaps", "gap tolerance");
    assert!((75.0..125.0).contains(&bridged), "{bridged}");
    run(&home, "adapter replay arm.day");
}

#[test]
fn a_tour_on_a_can_bus() {
    let home = Home::new();
    let report = tour(
        &home,
        "piper --address sim --only a --report arm.day --option sim.lag=0.06 --option sim.controller.gap_tolerance=0.05",
    );
    found(&report, "lag", "lag", 60.0);
    found(&report, "gaps", "gap tolerance", 50.0);
    assert!(step(&report, "measured")["detail"].as_str().unwrap().contains("MEASURED"), "{report:#}");
    run(&home, "adapter replay arm.day");
}

/// Each of the others: what is known of its controller is found.
#[test]
fn a_tour_on_an_xarm() {
    let home = Home::new();
    // The limit of this model, not of the one with as many joints.
    let lite = tour(&home, "xarm --model lite6 --address sim --only tool_speed");
    assert_eq!(figure(&lite, "tool_speed", "limit of the tool's speed"), 0.475);
    let report = tour(
        &home,
        "xarm --model xarm6 --address sim --only ga --option sim.controller.gap_tolerance=0.03 --report arm.day",
    );
    found(&report, "gaps", "gap tolerance", 30.0);
    run(&home, "adapter replay arm.day");
    let stops = tour(&home, "xarm --model xarm6 --address sim --only stops --option sim.controller.deceleration=5");
    found(&stops, "stops", "deceleration of a stop", 5.0);
}

/// Our program on the controller keeps the velocity for 20 ms after an order and then decelerates. It goes to a
/// setpoint in a period and two steps, so it passes the last one later than that.
#[test]
fn a_tour_on_a_ur() {
    let home = Home::new();
    let report = tour(&home, "ur --model ur5e --address sim --only p --report arm.day");
    assert_eq!(step(&report, "program")["outcome"], "measured", "{report:#}");
    let bridged = figure(&report, "gaps", "gap tolerance");
    assert!((8.0..22.0).contains(&bridged), "{bridged}");
    let line = step(&report, "gaps").to_string();
    assert!(line.contains("after_gap: decelerates"), "{line}");
    run(&home, "adapter replay arm.day");
}

/// The controller extrapolates 19 lost commands, and ends the motion with an error at the 20th.
#[test]
fn a_tour_on_a_franka() {
    let home = Home::new();
    let report = tour(&home, "franka --address sim --only ga --option sim.lag=0.03 --report arm.day");
    found(&report, "gaps", "gap tolerance", 20.0);
    assert!(step(&report, "gaps").to_string().contains("after_gap: faults"), "{report:#}");
    run(&home, "adapter replay arm.day");
}

#[test]
fn a_tour_on_a_remote_arm() {
    let home = Home::new();
    let report = tour(&home, "remote --dof 6 --address sim --only a --option sim.lag=0.05 --report arm.day");
    found(&report, "lag", "lag", 50.0);
    run(&home, "adapter replay arm.day");
}

/// An emulator that reports its setpoints instead of measurements is named, on every transport.
#[test]
fn commanded_positions_that_pose_as_measured_are_named() {
    let home = Home::new();
    for arm in ["yourarm", "xarm --model xarm6", "piper", "so101", "ur --model ur5e", "remote --dof 6"] {
        let line = format!("{arm} --address sim --only measured --option sim.controller.reports_commanded=true");
        let report = tour(&home, &line);
        let detail = step(&report, "measured")["detail"].as_str().unwrap();
        assert!(detail.contains("COMMANDED"), "{arm}: {report:#}");
    }
}

/// Starts a tour at a terminal, with the other end of it.
fn asked(home: &Home, address: &str, only: &str) -> (std::process::Child, std::fs::File) {
    let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
    unlockpt(&master).unwrap();
    let name = ptsname(&master, Vec::new()).unwrap();
    let terminal = std::fs::File::options().read(true).write(true).open(name.to_str().unwrap()).unwrap();
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_dimos"));
    command.args([
        "adapter",
        "test",
        "yourarm",
        "--address",
        address,
        "--first-day",
        "--only",
        only,
        "--report",
        "arm.day",
    ]);
    home.settle(&mut command);
    command.stdin(terminal.try_clone().unwrap()).stdout(std::process::Stdio::null()).stderr(terminal);
    (command.spawn().unwrap(), std::fs::File::from(master))
}

fn until(terminal: &mut std::fs::File, what: &str) -> String {
    let mut said = String::new();
    while !said.contains(what) {
        let mut bytes = [0; 1024];
        let count = terminal.read(&mut bytes).unwrap();
        said += &String::from_utf8_lossy(&bytes[..count]);
    }
    said
}

fn code(test: &mut std::process::Child) -> Option<i32> {
    let mut status = None;
    program::eventually("it ends", || {
        status = test.try_wait().unwrap();
        status.is_some()
    });
    status.unwrap().code()
}

fn outcomes(path: &Path) -> Vec<(String, &'static str)> {
    let report = Report::read_head(path).unwrap();
    report.steps.into_iter().map(|made| (made.step, made.outcome.name())).collect()
}

#[test]
fn each_step_is_asked_for_and_nothing_moves_without_a_yes() {
    let emulator = YourArmEmulator::with(&SimOptions::default()).unwrap();
    emulator.record();
    let home = Home::new();
    let (mut test, mut terminal) = asked(&home, &emulator.address(), "s");
    let said = until(&mut terminal, "n = end here:");
    assert!(said.contains("E-stop button") && said.contains("up to 60°"), "{said}");
    terminal.write_all(b"s\n").unwrap();
    until(&mut terminal, "n = end here:");
    terminal.write_all(b"y\n").unwrap();
    until(&mut terminal, "n = end here:");
    terminal.write_all(b"n\n").unwrap();
    assert_eq!(code(&mut test), Some(0));
    let steps = outcomes(&home.path().join("arm.day"));
    let expected = ["skipped", "measured", "skipped", "skipped", "skipped", "skipped"];
    assert_eq!(steps.iter().map(|(_, outcome)| *outcome).collect::<Vec<_>>(), expected, "{steps:?}");
    let moved = emulator.trace().iter().any(|received| received.request.moves());
    assert!(!moved, "tool_speed was skipped, seams only reads");
}

#[test]
fn without_a_terminal_the_tour_is_refused() {
    let emulator = YourArmEmulator::with(&SimOptions::default()).unwrap();
    emulator.record();
    let home = Home::new();
    let line = format!("adapter test yourarm --address {} --first-day", emulator.address());
    home.dimos(&line).with(2).says(&["not a terminal", "hint: add --yes"]);
    assert!(emulator.trace().is_empty());
    home.dimos("adapter test yourarm --address sim --first-day --allow-motion").with(2);
    home.dimos("adapter test yourarm --address sim --first-day --only nothing").with(2).says(&["tool_speed, seams"]);
}

/// Ctrl-C in motion: the arm's own stop, and what was measured is kept.
#[test]
fn an_interruption_stops_the_arm_and_keeps_the_figures() {
    let emulator = YourArmEmulator::with(&SimOptions::default()).unwrap();
    emulator.record();
    let home = Home::new();
    let line =
        format!("adapter test yourarm --address {} --first-day --yes --only ga --report arm.day", emulator.address());
    let test = home.start(&line);
    test.until("left out for 3 ms");
    test.end(Signal::INT).with(130);
    let asked: Vec<Request> = emulator.trace().iter().map(|received| received.request).collect();
    let last = asked.iter().rposition(Request::moves).unwrap();
    assert!(asked[last..].contains(&Request::Stop), "{:?}", &asked[last..]);
    assert!(!emulator.enabled());
    let report = Report::read_head(&home.path().join("arm.day")).unwrap();
    let gaps = report.steps.iter().find(|made| made.step == "gaps").unwrap();
    assert_eq!(gaps.outcome.name(), "interrupted");
    assert!(gaps.figures.iter().any(|figure| figure.name.contains("through 1 ms")), "{gaps:?}");
}
