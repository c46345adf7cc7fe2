//! `dimos adapter emulate` with the real binary: an emulator in one process, its client in another.

use dimos::joint::ControlMode;
use rustix::process::Signal;

use crate::support::loopback::own_address;
use crate::support::program::{Home, Started, eventually};
use crate::support::skip::skip_port_502;

/// An emulator that is up.
fn emulate(home: &Home, arguments: &str) -> Started {
    let emulator = home.start(&format!("adapter emulate {arguments}"));
    emulator.until("Ctrl-C ends it");
    // The last line of stdout, which another thread collects.
    emulator.until("  blueprint  adapter_type: ");
    emulator
}

#[test]
fn a_run_in_another_process_moves_the_emulated_arm() {
    let (home, address) = (Home::new(), own_address());
    let emulator = emulate(&home, &format!("yourarm --bind {address}"));
    let said = emulator.out();
    let command = said.lines().find_map(|line| line.trim().strip_prefix("reach it")).unwrap().trim().to_owned();
    assert_eq!(command, format!("dimos run coordinator-yourarm --address arm={address}"));
    assert!(said.contains("yourarm SIMULATED at"), "{said}");

    let run = home.run(&format!("{} --no-record", command.strip_prefix("dimos run ").unwrap()));
    home.dimos("move arm 0.1 -0.2 0.5 0 0.7 0.1").with(0);
    let positions = home.positions("arm");
    for (is, wanted) in positions.iter().zip([0.1, -0.2, 0.5, 0.0, 0.7, 0.1]) {
        assert!((is - wanted).abs() < 1e-3, "{positions:?}");
    }
    // The end of the emulator is the end of the connection, and no end of the run.
    emulator.end(Signal::INT).with(130);
    eventually("the run says so", || home.dimos("status --json").with(0).out.contains("connection"));
    run.end(Signal::TERM);
}

#[test]
fn a_scripted_fault_occurs() {
    let (home, address) = (Home::new(), own_address());
    home.write("faults.yaml", "- {at: 0.5, kind: error_code, code: 3}\n");
    let emulator = emulate(&home, &format!("yourarm --bind {address} --fault faults.yaml --fault at=1e5,kind=estop"));
    let mut adapter = dimos::arms::create("yourarm", &address.to_string(), 6).unwrap();
    adapter.connect().unwrap();
    adapter.activate().unwrap();
    adapter.set_control_mode(ControlMode::Position).unwrap();
    let mut error = (0, String::new());
    eventually("the error", || {
        error = adapter.read_error().unwrap();
        error.0 != 0
    });
    assert_eq!(error.0, 3);
    adapter.disconnect();
    emulator.until("the client is gone");
    let trace = emulator.end(Signal::TERM).with(143).err;
    let at = |what: &str| {
        let line = trace.lines().find(|line| line.ends_with(what)).unwrap_or_else(|| panic!("{what}: {trace}"));
        line.split_whitespace().find_map(|word| word.parse::<f64>().ok()).unwrap()
    };
    let (came, struck) = (at(" s  a client connected"), at(" s  the fault error_code begins"));
    assert!(struck >= came + 0.5 && at(" s  the client is gone") >= struck, "{trace}");
    assert!(!trace.contains("estop"), "{trace}");
}

#[test]
fn the_faults_of_an_arm_are_listed() {
    let home = Home::new();
    let listed = |arm: &str| home.dimos(&format!("adapter emulate {arm} --fault list")).with(0).out;
    let (yourarm, remote) = (listed("yourarm"), listed("remote"));
    assert!(yourarm.contains("power_loss") && yourarm.contains("garbage") && !yourarm.contains("leader"), "{yourarm}");
    assert!(
        remote.contains("frozen") && !remote.contains("garbage") && remote.contains("time stamps included"),
        "{remote}"
    );
    if cfg!(feature = "can") {
        let piper = listed("piper");
        assert!(piper.contains("leader") && !piper.contains("bus_off"), "{piper}");
    }
}

#[test]
fn what_cannot_be_is_refused() {
    let home = Home::new();
    for (arguments, says) in [
        ("mock", "mock has no emulator"),
        ("yourarm --bind 10.0.0.1", "not a loopback address"),
        ("yourarm --pty", "speaks TCP"),
        ("yourarm --can vcan0", "speaks TCP"),
        ("yourarm --can vcan0 --pty", "cannot be used with"),
        ("yourarm --fault at=1,kind=panic", "cannot play the fault \"panic\"; it can play \"stall\""),
        ("yourarm --fault at=1,kind=explode", "unknown variant `explode`"),
        ("yourarm --fault nowhere.yaml", "--fault nowhere.yaml"),
        ("yourarm --fault nonsense", "hint: one fault, like at=2,kind=stall"),
        ("yourarm --option sim.initial_positions=[9,0,0,0,0,0]", "within the joint limits"),
        ("yourarm --model yourarm7", "unknown field `model`"),
        ("yourarm --dof 7", "6 joints, not 7"),
        ("nobodysarm", "there are mock, yourarm"),
    ] {
        let address = own_address();
        let place = if arguments.contains("--") { String::new() } else { format!(" --bind {address}") };
        home.dimos(&format!("adapter emulate {arguments}{place} --duration 1s")).with(2).says(&[says]);
    }
}

/// A pseudo-terminal gets another number at each start; the link has the same path.
#[test]
fn a_link_gives_a_pseudo_terminal_a_path_that_stays() {
    let home = Home::new();
    let link = home.path().join("so101");
    for _ in 0..2 {
        let emulator = emulate(&home, "so101 --link so101");
        assert!(emulator.out().contains(&format!("so101 SIMULATED at {}\n", link.display())), "{}", emulator.out());
        let run = home.run(&format!("coordinator-so101 --address arm={} --no-record", link.display()));
        home.dimos("move arm 0.1 0 0 0 0").with(0);
        run.end(Signal::TERM).with(143);
        // A crash leaves the link behind.
        emulator.signal(Signal::KILL);
        let _ = emulator.wait();
        assert!(link.is_symlink());
    }
    emulate(&home, "so101 --link so101").end(Signal::INT).with(130);
    assert!(!link.is_symlink());
    home.write("file", "kept");
    home.dimos("adapter emulate so101 --link file").with(2).says(&["--link file: there is a file already"]);
    assert_eq!(std::fs::read_to_string(home.path().join("file")).unwrap(), "kept");
    home.dimos("adapter emulate so101 --link a --bind 127.0.0.1").with(2).says(&["cannot be used with"]);
}

#[test]
fn what_it_says_fits_the_model() {
    let (home, address) = (Home::new(), own_address());
    if std::net::TcpListener::bind((address, 502)).is_err_and(|e| e.kind() == std::io::ErrorKind::PermissionDenied) {
        return skip_port_502();
    }
    for (model, blueprint) in [("lite6", Some("coordinator-lite6")), ("xarm850", None)] {
        let line = format!("adapter emulate xarm --model {model} --bind {address} --duration 100ms");
        let said = home.dimos(&line).with(0).out;
        assert!(said.contains(&format!("--dof 6 --model {model}\n")), "{said}");
        assert!(said.contains(&format!("options: {{model: {model}}}")), "{said}");
        assert_eq!(said.contains("reach it"), blueprint.is_some(), "{said}");
        assert!(blueprint.is_none_or(|name| said.contains(&format!("dimos run {name} "))), "{said}");
    }
}

#[test]
fn the_printed_run_reaches_an_arm_with_a_gripper_and_without() {
    let (home, address) = (Home::new(), own_address());
    if std::net::TcpListener::bind((address, 502)).is_err_and(|e| e.kind() == std::io::ErrorKind::PermissionDenied) {
        return skip_port_502();
    }
    for option in ["", " --option gripper=xarm", " --option gripper=xarm_g2", " --option gripper=lite6"] {
        let emulator = emulate(&home, &format!("xarm --model xarm6 --bind {address}{option}"));
        let said = emulator.out();
        let line = said.lines().find_map(|line| line.trim().strip_prefix("reach it   dimos run ")).unwrap();
        let run = home.run(&format!("{line} --no-record"));
        assert_eq!(home.status()["arms"][0]["link"], "up", "{line}");
        run.end(Signal::TERM).with(143);
        let line = said.lines().find_map(|line| line.trim().strip_prefix("check it   dimos ")).unwrap();
        assert!(line.ends_with(&format!("--model xarm6{option}")), "{line}");
        emulator.end(Signal::INT).with(130);
    }
}

#[test]
fn a_program_finds_the_address_and_an_end() {
    let (home, address) = (Home::new(), own_address());
    let started =
        home.dimos(&format!("adapter emulate yourarm --bind {address} --duration 100ms --json")).with(0).json();
    assert!(started["address"].as_str().unwrap().starts_with(&format!("{address}:")), "{started}");
    assert_eq!(
        (&started["event"], &started["simulated"], &started["dof"]),
        (&"started".into(), &true.into(), &6.into())
    );
    // Its port is free again, and taken while it is used.
    let first = emulate(&home, &format!("yourarm --bind {address}"));
    let again = format!("adapter emulate yourarm --bind {address} --duration 1s");
    home.dimos(&again).with(3).says(&["cannot listen at", "hint: use another loopback address"]);
    first.end(Signal::INT).with(130);
}
