//! The stop input of an arm, judged by what its controller receives; and its inputs and outputs at the command line.

use dimos::arms::yourarm::emulator::wire::Request;
use dimos::arms::yourarm::emulator::{Received, SimOptions, YourArmEmulator};
use dimos::clock::{Clock, Mono, MonotonicClock};
use dimos::hardware::registry::Emulator;
use dimos::recording::replay::{LogReader, Payload};
use dimos::rpc::api::Move;

use crate::support::program::{Home, Started, eventually};

/// Period of the tick [ns]: long, so that a busy computer does not matter.
const PERIOD: u64 = 50_000_000;

fn up(home: &Home, arm: &YourArmEmulator, stop_input: &str, arguments: &str) -> Started {
    home.write(
        "cell.yaml",
        &format!("include: [coordinator-yourarm]\nhardware: [{{hardware_id: arm, stop_input: {stop_input}}}]\n"),
    );
    home.run(&format!(
        "cell.yaml --set coordinator.tick_rate=20 --set hardware.arm.address={} {arguments}",
        arm.address()
    ))
}

/// Setpoints of joint 1 that the controller received [deg], and when.
fn set_points(trace: &[Received]) -> Vec<(Mono, f64)> {
    let first = |r: &Received| r.request.setpoint().map(|[first, ..]| (r.at, f64::from(first)));
    trace.iter().filter_map(first).collect()
}

#[test]
fn opening_the_stop_input_holds_within_two_periods_and_closing_it_moves_nothing() {
    let (home, arm) = (Home::new(), YourArmEmulator::with(&SimOptions::default()).unwrap());
    let run = up(&home, &arm, "{input: di2}", "");
    arm.record();
    home.client().call(Move::new("arm", [2.0, -0.3, 0.6, 0.0, 0.8, 0.0], 0.2)).unwrap();
    eventually("it moves", || arm.joints().0[0] > 0.6);
    let opened = MonotonicClock.now();
    arm.set_input(2, false);
    eventually("the stop", || arm.trace().iter().any(|r| r.at > opened && r.request == Request::Stop));
    let trace = arm.trace();
    let points = set_points(&trace);
    let steps = || points.windows(2).map(|pair| (pair[1].0, pair[1].1 - pair[0].1));
    let cruise = steps().filter(|(at, _)| *at <= opened).map(|(_, step)| step).fold(0.0, f64::max);
    let slower = steps().find(|(at, step)| *at > opened && *step < 0.98 * cruise).expect("it decelerates").0;
    let after = slower.0 - opened.0;
    assert!(after <= 2 * PERIOD + PERIOD / 2, "the first slower setpoint came after {} ms", after / 1_000_000);

    let refused = home.dimos("arm reset arm").with(1);
    assert!(refused.err.contains("the stop input is open"), "{}", refused.err);
    assert_eq!(home.status()["arms"][0]["cause"]["name"], "stop_input");
    home.dimos("arm io arm").with(0).shows(&["stop input di2: open: the arm is held", "di2=0"]);

    arm.record();
    let rest = arm.joints().0;
    arm.set_input(2, true);
    eventually("it is closed", || home.status()["arms"][0]["io"]["stop_input"]["open"] == false);
    assert_eq!(home.status()["arms"][0]["phase"], "held", "closing does not reset");
    home.dimos("arm reset arm").with(0).says(&["was held: the stop input is open"]);
    assert!(!arm.trace().iter().any(|r| r.request.moves()), "{:?}", arm.trace());
    assert_eq!(arm.joints().0, rest);
    home.dimos("arm enable arm").with(0).shows(&["ready"]);

    home.dimos("down").with(0);
    drop(run);
    let [log] = &home.logs()[..] else { panic!("one log") };
    home.dimos(&format!("replay {} --verify", log.display())).with(0).shows(&["reproducible"]);
    let mut reader = LogReader::open(log).unwrap();
    let (mut open, mut levels) = (0, Vec::new());
    while let Some(entry) = reader.next_entry().unwrap() {
        match entry.data {
            Payload::ArmInput(input) => open += usize::from(input.stop_input_open),
            Payload::ArmIo(io) => levels.push(io.digital_inputs[2]),
            _ => {}
        }
    }
    assert!(open > 2, "{open}");
    assert_eq!(levels, [1, 0, 1], "every change is logged once");
}

#[test]
fn an_arm_is_not_enabled_while_its_stop_input_is_open_or_missing() {
    let (home, arm) = (Home::new(), YourArmEmulator::with(&SimOptions::default()).unwrap());
    let start = |stop_input: &str, code| {
        arm.record();
        let ended = up_fails(&home, &arm, stop_input).with(code);
        assert!(!arm.trace().iter().any(|r| r.request.moves() || r.request == Request::Enable(true)));
        ended.err
    };
    let err = start("{input: di0, open: high}", 3);
    assert!(err.contains("the stop input di0 is open") && err.contains("hint: close it"), "{err}");
    let err = start("{input: di9}", 2);
    assert!(err.contains("no digital input di9") && err.contains("it has di0 to di7"), "{err}");
    let err = start("{input: do1}", 2);
    assert!(err.contains("`do1` is not a digital input") && err.contains("cell.yaml:2:"), "{err}");
}

fn up_fails(home: &Home, arm: &YourArmEmulator, stop_input: &str) -> crate::support::program::Ended {
    home.write(
        "cell.yaml",
        &format!("include: [coordinator-yourarm]\nhardware: [{{hardware_id: arm, stop_input: {stop_input}}}]\n"),
    );
    home.dimos(&format!("run cell.yaml --no-record --set hardware.arm.address={}", arm.address()))
}

#[test]
fn outputs_are_set_and_read_back_at_the_command_line() {
    let (home, arm) = (Home::new(), YourArmEmulator::with(&SimOptions::default()).unwrap());
    let _run = home.run(&format!("coordinator-yourarm --no-record --set hardware.arm.address={}", arm.address()));
    home.dimos("arm io arm").with(0).shows(&["inputs: di0=1 di1=1", "outputs: do0=0", "ai0=0.000 V"]);
    home.dimos("arm io arm --set do3=1 --set ao1=2.5").with(0).shows(&["do3=1", "ao1=2.500 V", "ai1=2.500 V"]);
    assert_eq!(arm.digital_outputs(), 0b1000);
    home.dimos("arm io arm --set do8=1").with(1).says(&["no output do8", "hint: it has do0 to do7"]);
    home.dimos("arm io arm --set di0=1").with(2).says(&["di0 is not an output"]);
    home.dimos("arm io arm --set ao0=11").with(1).says(&["outside the arm's limits"]);
    eventually("status has them", || home.status()["arms"][0]["io"]["digital_outputs"][3] == true);
    // Another connection commands the arm.
    let mut holder = home.client();
    holder.call(dimos::rpc::api::Lease::default()).unwrap();
    home.dimos("arm io arm --set do3=0").with(1).says(&["arm is commanded by"]);
    home.dimos("arm io arm").with(0);
    assert_eq!(arm.digital_outputs(), 0b1000);
}
