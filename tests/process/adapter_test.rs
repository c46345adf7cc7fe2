//! `dimos adapter test` with the real binary, against emulators that record every request.

use std::io::{Read as _, Write as _};

use dimos::arms::yourarm::emulator::wire::Request;
use dimos::arms::yourarm::emulator::{SimOptions, YourArmEmulator};
use dimos::hardware::registry::Emulator;
use dimos::hardware::sim::faults::{Fault, FaultKind};
use rustix::process::Signal;
use rustix::pty::{OpenptFlags, openpt, ptsname, unlockpt};

use crate::support::program;
use crate::support::program::Home;

/// Pose at power-up [deg], as it goes over the wire.
const START: [f32; 6] = [0.0, -17.188734, 34.37747, 0.0, 45.836624, 0.0];

/// An emulator that the program takes for a real arm.
fn arm(options: &SimOptions) -> (YourArmEmulator, String) {
    let emulator = YourArmEmulator::with(options).unwrap();
    emulator.record();
    let address = emulator.address();
    (emulator, address)
}

fn requests(emulator: &YourArmEmulator) -> Vec<Request> {
    emulator.trace().iter().map(|received| received.request).collect()
}

#[test]
fn checks_run_on_the_emulator_and_are_reported() {
    let home = Home::new();
    // All of them are run by `adding_an_arm`, and for every arm by `conformance`.
    let report = home.dimos("adapter test yourarm --address sim --only stop --report r.md --json").with(0).json();
    assert_eq!((&report["simulated"], &report["passed"]), (&true.into(), &true.into()));
    let checks = report["checks"].as_array().unwrap();
    let count = |outcome: &str| checks.iter().filter(|check| check["outcome"] == outcome).count();
    assert_eq!(count("failed"), 0, "{checks:#?}");
    assert!(count("passed") >= 8, "{checks:#?}");
    assert!(report["figures"]["rate"].as_f64().unwrap() > 20.0);
    assert_eq!(report["arm"]["serial"], "YA6-00042");
    let text = std::fs::read_to_string(home.path().join("r.md")).unwrap();
    for part in ["# yourarm SIMULATED", "0 failed", "| passed | stop_ends_motion |", "- serial: YA6-00042"] {
        assert!(text.contains(part), "no {part:?} in\n{text}");
    }
    let mock = home.dimos("adapter test mock --dof 2 --only stop --json").with(0).json();
    assert_eq!((&mock["simulated"], &mock["arm"]["dof"]), (&false.into(), &2.into()));
}

#[test]
fn a_real_arm_is_only_read() {
    let (emulator, address) = arm(&SimOptions::default());
    let home = Home::new();
    let ended = home.dimos(&format!("adapter test yourarm --address {address}")).with(0);
    for part in [
        "yourarm at 127.0.0.1:",
        "firmware     2.1.3",
        "nothing was moved",
        "skipped  61 more",
        " on this arm: activation_holds, ",
    ] {
        assert!(ended.out.contains(part), "no {part:?} in\n{}", ended.out);
    }
    let asked = requests(&emulator);
    assert!(asked.len() > 50);
    let harmless = |request: &Request| {
        use Request::{GetIo, GetJointStatus, GetMounting, GetOffsets, GetPayload, GetState, Hello};
        matches!(request, Hello | GetState(_) | GetIo | GetJointStatus | GetMounting | GetOffsets | GetPayload)
    };
    assert!(asked.iter().all(harmless), "{:?}", asked.iter().find(|request| !harmless(request)));
}

#[test]
fn the_small_motion_stays_small_and_leaves_the_arm_as_it_was() {
    let (emulator, address) = arm(&SimOptions::default());
    let home = Home::new();
    let line = format!("adapter test yourarm --address {address} --only row --allow-motion --yes --json");
    let report = home.dimos(&line).with(0).json();
    let ways = report["motion"]["ways"].as_array().unwrap();
    assert_eq!(ways.len(), 12, "six joints in two modes: {ways:#?}");
    for way in ways {
        let degrees = |field: &str| way[field].as_f64().unwrap().to_degrees();
        assert!((degrees("up") - 2.0).abs() < 0.3 && (degrees("down") + 2.0).abs() < 0.3, "{way}");
        assert!(degrees("back").abs() < 0.3 && degrees("others") < 0.01, "{way}");
    }
    assert_eq!(report["motion"]["left"], "motors off, as they were found");
    let mut moves = 0;
    for request in requests(&emulator) {
        let target = match request {
            Request::MoveJoints(speed, target) => {
                assert!(speed <= 5.001, "{speed} % of the top speed");
                target
            }
            Request::ServoJoints(target) => target,
            Request::Setpoint(setpoint) => setpoint.joints,
            Request::VelocityJoints(_) | Request::MoveCartesian(..) | Request::Gripper(_) | Request::Grip(..) => {
                panic!("{request:?}")
            }
            _ => continue,
        };
        moves += 1;
        let off: Vec<f32> = target.iter().zip(START).map(|(a, b)| (a - b).abs()).collect();
        assert!(off.iter().all(|off| *off < 2.01), "{target:?}");
        assert!(off.iter().filter(|off| **off > 0.01).count() <= 1, "more than one joint: {target:?}");
    }
    assert!(moves > 100, "{moves} moves");
    assert!(!emulator.enabled());
}

/// The accuracy is tested where the lag is computed; here, what goes over the wire, as far as the second joint.
#[test]
fn the_lag_of_an_arm_is_measured_by_a_small_stream() {
    let (emulator, address) = arm(&SimOptions::default());
    let home = Home::new();
    let line = format!("adapter test yourarm --address {address} --only row --lag");
    home.dimos(&line).with(2).says(&["--lag moves the arm", "hint: add --allow-motion"]);
    assert!(!requests(&emulator).iter().any(|request| matches!(request, Request::Enable(_))));
    let test = home.start(&format!("{line} --allow-motion --yes"));
    test.until("lag of joint 2");
    test.end(Signal::INT).with(130);
    let streamed = |request: &Request| match request.setpoint() {
        Some(target) => target.iter().zip(START).all(|(a, b)| (a - b).abs() < 2.01),
        None => !request.moves(),
    };
    let asked = requests(&emulator);
    assert!(asked.iter().all(streamed), "{asked:?}");
    assert!(asked.iter().filter(|request| request.moves()).count() > 100, "{asked:?}");
    assert!(!emulator.enabled());
}

/// What is measured is what was emulated. A mock arm needs no confirmation: nothing can be damaged.
#[test]
fn the_lag_of_a_mock_is_measured_without_a_question() {
    let home = Home::new();
    let line = "adapter test mock --dof 1 --option lag=0.037 --only row --lag --json --report r.md";
    let report = home.dimos(line).with(0).json();
    let lag = &report["lag"];
    let median = lag["median"].as_f64().unwrap();
    assert!((median - 0.037).abs() < 0.002, "{lag:#}");
    assert!(lag["largest"].as_f64().unwrap() >= median && lag["row"] == 0.02, "{lag:#}");
    assert_eq!(lag["joints"].as_array().unwrap().len(), 1);
    let text = std::fs::read_to_string(home.path().join("r.md")).unwrap();
    assert!(text.contains(" ms (row: 20 ms; set hardware.arm.lag: 0.0"), "{text}");
}

#[test]
fn without_a_terminal_nothing_moves() {
    let (emulator, address) = arm(&SimOptions::default());
    let home = Home::new();
    let line = format!("adapter test yourarm --address {address} --only row --allow-motion");
    home.dimos(&line).with(2).says(&["will come on", "E-stop", "not a terminal", "hint: add --yes"]);
    assert!(!requests(&emulator).iter().any(|request| matches!(request, Request::Enable(_))));
    home.dimos(&format!("adapter test yourarm --address {address} --yes")).with(2);
}

#[test]
fn an_interruption_stops_the_arm() {
    let (emulator, address) = arm(&SimOptions::default());
    let home = Home::new();
    let test = home.start(&format!("adapter test yourarm --address {address} --only row --allow-motion --yes"));
    test.until("joint 2 in position mode");
    let ended = test.end(Signal::INT).with(130);
    assert!(ended.out.contains("interrupted; stopped there"), "{}", ended.out);
    let asked = requests(&emulator);
    let last = asked.iter().rposition(Request::moves).unwrap();
    assert!(asked[last..].contains(&Request::Stop), "{:?}", &asked[last..]);
    assert!(!emulator.enabled());
    let before = emulator.joints().0;
    std::thread::sleep(std::time::Duration::from_millis(100));
    assert_eq!(emulator.joints().0, before);
}

/// An arm that fails a check is not moved by the same adapter.
#[test]
fn no_motion_when_a_check_failed() {
    let (emulator, address) = arm(&SimOptions::default());
    let home = Home::new();
    // When the arm has been reached and its state was watched, another one answers for a moment.
    emulator.inject(Fault::new(FaultKind::WrongModel).at(1.9).times(3)).unwrap();
    let line = format!("adapter test yourarm --address {address} --allow-motion --yes --report r.md");
    let ended = home.dimos(&line).with(1).says(&["error: not moved: 3 checks failed"]);
    assert!(ended.out.contains("3 failed") && ended.out.contains("; nothing was moved"), "{}", ended.out);
    assert!(ended.out.contains("failed   "), "{}", ended.out);
    assert!(std::fs::read_to_string(home.path().join("r.md")).unwrap().contains("| failed | "));
    assert!(!requests(&emulator).iter().any(|request| matches!(request, Request::Enable(_))));
}

/// The program at the question before the motion, and the other end of its terminal.
fn asked(home: &Home, address: &str) -> (std::process::Child, std::fs::File) {
    let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
    unlockpt(&master).unwrap();
    let name = ptsname(&master, Vec::new()).unwrap();
    let terminal = std::fs::File::options().read(true).write(true).open(name.to_str().unwrap()).unwrap();
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_dimos"));
    command.args(["adapter", "test", "yourarm", "--address", address, "--only", "row", "--allow-motion"]);
    home.settle(&mut command);
    command.stdin(terminal.try_clone().unwrap()).stdout(std::process::Stdio::null()).stderr(terminal);
    let test = command.spawn().unwrap();
    drop(command);
    let (mut master, mut said) = (std::fs::File::from(master), String::new());
    while !said.contains("Type yes") {
        let mut bytes = [0; 1024];
        let count = master.read(&mut bytes).unwrap();
        said += &String::from_utf8_lossy(&bytes[..count]);
    }
    (test, master)
}

fn code(test: &mut std::process::Child) -> Option<i32> {
    let mut status = None;
    program::eventually("it ends", || {
        status = test.try_wait().unwrap();
        status.is_some()
    });
    status.unwrap().code()
}

/// The arm may change while a question waits for its answer.
#[test]
fn the_arm_is_checked_again_after_the_question() {
    let (emulator, address) = arm(&SimOptions::default());
    let home = Home::new();
    let (mut test, mut terminal) = asked(&home, &address);
    emulator.inject(Fault::new(FaultKind::ErrorCode).code(2)).unwrap();
    terminal.write_all(b"yes\n").unwrap();
    assert_eq!(code(&mut test), Some(1));
    let mut said = vec![0; 4096];
    let count = terminal.read(&mut said).unwrap();
    let said = String::from_utf8_lossy(&said[..count]);
    assert!(said.contains("not moved: it is in error 2"), "{said}");
    assert!(!requests(&emulator).iter().any(|request| matches!(request, Request::Enable(_))));
}

/// Reading a line continues after a signal; the question must end.
#[test]
fn an_interrupt_at_the_question_means_no() {
    let (emulator, address) = arm(&SimOptions::default());
    let home = Home::new();
    let (mut test, _terminal) = asked(&home, &address);
    rustix::process::kill_process(rustix::process::Pid::from_child(&test), Signal::INT).unwrap();
    assert_eq!(code(&mut test), Some(130));
    assert!(!requests(&emulator).iter().any(|request| matches!(request, Request::Enable(_))));
}

/// A terminal that is closed must not leave an arm in motion, with its motors on.
#[test]
fn a_closed_terminal_stops_the_arm() {
    let (emulator, address) = arm(&SimOptions::default());
    let home = Home::new();
    let test = home.start(&format!("adapter test yourarm --address {address} --only row --allow-motion --yes"));
    test.until("joint 2 in position mode");
    let ended = test.end(Signal::HUP);
    assert!(ended.out.contains("interrupted; stopped there"), "{:?} {}", ended.code, ended.out);
    let asked = requests(&emulator);
    let last = asked.iter().rposition(Request::moves).unwrap();
    assert!(asked[last..].contains(&Request::Stop), "{:?}", &asked[last..]);
    assert!(!emulator.enabled());
}

#[test]
fn results_are_printed_even_if_the_report_cannot_be_written() {
    let home = Home::new();
    let ended = home.dimos("adapter test mock --only row --report nowhere/report.md").with(1);
    assert!(ended.says(&["--report nowhere/report.md"]).out.contains("row_is_complete"));
}

#[test]
fn an_error_in_motion_ends_it() {
    let (emulator, address) = arm(&SimOptions::default());
    let home = Home::new();
    let test = home.start(&format!("adapter test yourarm --address {address} --only row --allow-motion --yes"));
    test.until("joint 3 in position mode");
    emulator.inject(Fault::new(FaultKind::ErrorCode).code(2)).unwrap();
    let ended = test.wait().with(1).says(&["error: ", "the motion was ODD and was stopped"]);
    assert!(ended.out.contains("2: collision detected; stopped there"), "{}", ended.out);
    let asked = requests(&emulator);
    let last = asked.iter().rposition(Request::moves).unwrap();
    assert!(asked[last..].contains(&Request::Stop), "{:?}", &asked[last..]);
}

#[test]
fn a_pose_too_near_a_limit_is_refused() {
    let pose = vec![0.0, 0.0, 149.0_f64.to_radians(), 0.0, 0.0, 0.0];
    let near = SimOptions { initial_positions: pose, ..SimOptions::default() };
    let (emulator, address) = arm(&near);
    let home = Home::new();
    let line = format!("adapter test yourarm --address {address} --only row --allow-motion --yes");
    home.dimos(&line)
        .with(1)
        .says(&["joint 3 at 149.00° has 1.00° to its upper limit", "hint: move the arm to the middle of its range"]);
    assert!(!requests(&emulator).iter().any(|request| matches!(request, Request::Enable(_))));
}

#[test]
fn mistakes_are_reported_with_their_exit_code() {
    let home = Home::new();
    let dimos = |line: &str| home.dimos(line);
    dimos("adapter test yourarm").with(2).says(&["needs --address", "--address sim"]);
    dimos("adapter test yuorarm --address sim").with(2).says(&["mock, yourarm", "did you mean yourarm?"]);
    dimos("adapter test yourarm --address a:b:c").with(2).says(&["--address a:b:c", "HOST[:PORT]"]);
    dimos("adapter test yourarm --address sim --option sped=1").with(2).says(&["unknown field `sped`"]);
    dimos("adapter test yourarm --address sim --dof 7").with(2).says(&["6 joints, not 7"]);
    dimos("adapter test yourarm --address sim --only xyzzy").with(2).says(&["stop_ends_motion"]);
    dimos("adapter test yourarm --address 127.0.0.1:1").with(3).says(&["127.0.0.1:1", "hint: is it powered"]);

    let (emulator, address) = arm(&SimOptions::default());
    let run = home.run(&format!("coordinator-yourarm --no-record --set hardware.arm.address={address}"));
    let taken = dimos(&format!("adapter test yourarm --address {address}")).with(3);
    taken.says(&["is in use by process", "hint: end the run or verb"]);
    run.end(Signal::TERM);
    dimos(&format!("adapter test yourarm --address {address} --only row")).with(0);
    // When the arm has been reached and its state was watched, another one answers.
    emulator.inject(Fault::new(FaultKind::WrongModel).at(1.9).lasting(60.0)).unwrap();
    let failed = dimos(&format!("adapter test yourarm --address {address}")).with(1);
    let failed = failed.says(&["checks passed, ", " not run: for emulators only"]);
    assert!(failed.out.contains("connect: yourarm at 127.0.0.1"), "{}", failed.out);
    assert!(failed.out.contains("failed   reads_agree"), "{}", failed.out);
}
