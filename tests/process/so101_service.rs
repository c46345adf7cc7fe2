//! `dimos arm find-port`, `setup-motors`, `calibrate` and `configure`, as a person uses them: in a terminal, with the
//! emulated servos of an SO-101 on another one.

use std::os::unix::fs::symlink;

use dimos::arms::so101::calibration::{Calibration, NAMES};
use dimos::arms::so101::emulator::{Servos, start};
use dimos::hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};
use dimos::hardware::sim::arm::HasArm;
use dimos::hardware::sim::faults::{Fault, FaultKind};
use dimos::hardware::sim::serial_server::SerialServer;
use dimos::hardware::transport::serial::SerialLink;
use serde_json::{Value, json};

use crate::support::program::{Home, eventually};
use crate::support::terminal::Terminal;

/// Starts the emulator with these settings.
fn emulate(sim: Value) -> SerialServer<Servos> {
    let options = json!({ "sim": sim });
    let config = AdapterConfig { hardware_id: "arm".into(), address: String::new(), dof: 5, options };
    start(&config, &EmulatorAddress::Pty).unwrap()
}

/// A hand moves a joint to an end of its range.
fn push(servos: &dyn Emulator, joint: usize, amount: f64) {
    servos.inject(Fault { joint, amount, ..Fault::new(FaultKind::Pushed) }).unwrap();
}

/// The same, until the table shows it.
fn push_seen(terminal: &Terminal, servos: &dyn Emulator, joint: usize, amount: f64) {
    let row = || terminal.text().lines().rfind(|line| line.starts_with(NAMES[joint - 1])).map(str::to_owned);
    let before = row();
    push(servos, joint, amount);
    eventually("the table shows the joint's position", || row() != before);
}

#[test]
fn an_arm_is_calibrated_by_hand_with_its_motors_off() {
    let home = Home::new();
    let servos = emulate(json!({"initial_positions": [0.1, -0.3, 0.2, 0.0, 0.5, 0.4]}));
    let line = format!("arm calibrate so101 --address {} --file mine/arm.json", servos.address());
    home.dimos(&line).with(2).says(&["stdin is not a terminal", "--yes asks nothing"]);

    // Ctrl-C in the table changes nothing.
    let terminal = Terminal::new(100, 30);
    let begun = terminal.start(&home, &line);
    terminal.until("Bring every joint to the middle of its range, then press Enter");
    terminal.keys("\n");
    terminal.until("shoulder_pan");
    terminal.keys("\x03");
    begun.wait().with(130);
    assert_eq!(servos.with(|servos, _| servos.byte(0, 31)), 0);
    assert!(!home.path().join("mine").exists());

    let terminal = Terminal::new(100, 30);
    let begun = terminal.start(&home, &line);
    terminal.until("Bring every joint to the middle of its range, then press Enter");
    terminal.keys("\n");
    terminal.until("Move these joints through their whole range");
    terminal.until("gripper        2047  2047  2047");
    // Both ends of the first joint, as its encoder shows them with the new offset: the table shows them live.
    push(&servos, 1, -10.0);
    terminal.until("shoulder_pan    730   730  2047");
    // A hand is slower than that: no joint turns by half a turn between two readings.
    push_seen(&terminal, &servos, 1, 1.5);
    push(&servos, 1, 10.0);
    terminal.until("shoulder_pan    730  3234  3234");
    for joint in [2, 3, 4, 6] {
        [-10.0, 1.0, 10.0].into_iter().for_each(|amount| push_seen(&terminal, &servos, joint, amount));
    }
    terminal.until("gripper        1672  2924  2924");
    terminal.keys("\n");
    begun.wait().with(0);
    terminal.until("written to the motors, read back, and saved: mine/arm.json");

    let path = home.path().join("mine/arm.json");
    let [pan, .., roll, gripper] = Calibration::read(&path, 1).unwrap();
    // The middle of the travel is that of the turn.
    assert_eq!((pan.homing_offset, pan.range_min, pan.range_max), (1, 795, 3299));
    assert_eq!((roll.range_min, roll.range_max), (0, 4095), "it was not led");
    assert_eq!((gripper.id, gripper.range_min, gripper.range_max), (6, 1421, 2673));
    let registers = servos.with(|servos, _| [31, 9, 10, 11, 12, 55].map(|address| servos.byte(0, address)));
    assert_eq!(registers, [1, 795u16.to_le_bytes()[0], 795u16.to_le_bytes()[1], 3299u16.to_le_bytes()[0], 12, 1]);
    assert!(!servos.with(|servos, _| servos.arm().enabled()), "no motor was switched on");
    home.dimos(&line).with(2).says(&["mine/arm.json exists", "--force"]);

    // A joint that was not moved has no range; nothing is written.
    let again = format!("{line} --force --yes --record-for 100ms");
    home.dimos(&again).with(1).says(&["shoulder_pan was not moved: its range is 0 counts", "nothing was written"]);
    assert_eq!(Calibration::read(&path, 1).unwrap()[0], pan);
    let restore = format!("arm calibrate so101 --address {} --yes --restore mine/arm.json", servos.address());
    home.dimos(&restore).with(0).says(&["the motors have the calibration of mine/arm.json already"]);
}

#[test]
fn a_recording_outlives_a_failed_write() {
    let home = Home::new();
    let servos = emulate(json!({"initial_positions": [0.1, -0.3, 0.2, 0.0, 0.5, 0.4]}));
    servos.with(|servos, _| servos.wear_out(2, true));
    let terminal = Terminal::new(200, 30);
    let begun = terminal.start(&home, &format!("arm calibrate so101 --address {} --file arm.json", servos.address()));
    terminal.until("Bring every joint to the middle of its range, then press Enter");
    terminal.keys("\n");
    terminal.until("gripper        2047  2047  2047");
    for joint in [1, 2, 3, 4, 6] {
        [-10.0, 1.5, 10.0].into_iter().for_each(|amount| push_seen(&terminal, &servos, joint, amount));
    }
    terminal.keys("\n");
    begun.wait().with(3);
    terminal.until("servo 3 (elbow_flex) keeps");
    terminal.until("the recording is saved: arm.json.part");
    let restore = format!("arm calibrate so101 --address {} --restore arm.json.part", servos.address());
    terminal.until(&format!("to write it again: dimos {restore}"));
    assert!(!home.path().join("arm.json").exists());
    assert!(servos.with(|servos, _| servos.stored(0, 31) != 0 && servos.stored(3, 31) == 0), "half written");

    servos.with(|servos, _| servos.wear_out(2, false));
    home.dimos(&format!("{restore} --yes"))
        .with(0)
        .says(&["written and read back: elbow_flex, ", "mv arm.json.part arm.json"]);
    let [pan, _, elbow, ..] = Calibration::read(&home.path().join("arm.json.part"), 1).unwrap();
    let stored = |servo| servos.with(|servos, _| i32::from(servos.stored(servo, 9)));
    assert_eq!((stored(0), stored(2)), (pan.range_min & 0xFF, elbow.range_min & 0xFF));
}

#[test]
fn an_early_enter_and_the_end_of_input_renumber_no_motor() {
    let home = Home::new();
    let servos = emulate(json!({"ids": [0, 0, 0, 0, 0, 1]}));
    let numbers = || servos.with(|servos, _| [4, 5].map(|servo| servos.stored(servo, 5)));
    let terminal = Terminal::new(120, 40);
    let begun = terminal.start(&home, &format!("arm setup-motors so101 --address {}", servos.address()));
    terminal.until("Connect only the motor of gripper to the board, then press Enter");
    // The second Enter comes while the first motor is set up.
    terminal.keys("\n\n");
    terminal.until("Connect only the motor of wrist_roll to the board, then press Enter");
    std::thread::sleep(std::time::Duration::from_millis(1000));
    assert!(!terminal.text().contains("wrist_roll: number"), "{}", terminal.text());
    assert_eq!(numbers()[1], 6);
    // The cable is still in the gripper's motor.
    terminal.keys("\n");
    terminal.until("the motor on the board is that of gripper, number 6, set up before");
    terminal.until("connect the motor of wrist_roll instead");
    assert_eq!(numbers()[1], 6);
    servos.with(|servos, _| [(5, 0), (4, 1)].into_iter().for_each(|(servo, id)| servos.plug(servo, id)));
    let question = || terminal.text().matches("Connect only the motor of wrist_roll").count();
    eventually("the question again", || question() == 2);
    terminal.keys("\n");
    terminal.until("wrist_roll: number 5");
    terminal.until("Connect only the motor of wrist_flex to the board, then press Enter");
    terminal.keys("\x04");
    begun.wait().with(1);
    terminal.until("its input ended (Ctrl-D)");
    assert_eq!(terminal.text().matches("Connect only the motor of wrist_flex").count(), 1);
}

#[test]
fn motors_stay_on_until_the_settings_may_be_written() {
    let home = Home::new();
    let servos = emulate(json!({"factory": true}));
    let on = |servos: &SerialServer<Servos>| servos.with(|servos, _| servos.arm().enabled());
    servos.with(|servos, _| (1..=6).for_each(|id| servos.execute(id, 0x03, &[40, 1], &mut Vec::new())));
    assert!(on(&servos));
    let line = format!("arm configure so101 --address {}", servos.address());
    let terminal = Terminal::new(120, 40);
    let begun = terminal.start(&home, &line);
    terminal.until("Check these settings, which are written with the motors off, then press Enter");
    assert!(on(&servos));
    terminal.keys("\x03");
    begun.wait().with(130);
    assert!(on(&servos), "without consent they stay on");

    let terminal = Terminal::new(120, 40);
    let begun = terminal.start(&home, &line);
    terminal.until("Check these settings");
    terminal.keys("\n");
    terminal.until("Support the arm: it drops when its motors are switched off, then press Enter");
    assert!(on(&servos));
    terminal.keys("\n");
    begun.wait().with(0);
    terminal.until("9 settings were written and read back");
    assert!(!on(&servos));
}

#[test]
fn the_motors_of_a_new_arm_get_their_numbers() {
    let home = Home::new();
    let servos = emulate(json!({"ids": [1, 0, 0, 0, 0, 1], "factory": true}));
    let terminal = Terminal::new(100, 40);
    let begun = terminal.start(&home, &format!("arm setup-motors so101 --address {}", servos.address()));
    let asked = |name: &str, times: usize| {
        let question = format!("Connect only the motor of {name} to the board, then press Enter");
        eventually("the question", || terminal.text().matches(&question).count() == times);
    };
    asked("gripper", 1);
    terminal.keys("\n");
    terminal.until("2 servos answer: [1, 1]");
    asked("gripper", 2);
    for (motor, name) in NAMES.iter().enumerate().rev() {
        servos.with(|servos, _| (0..6).for_each(|other| servos.plug(other, u8::from(other == motor))));
        asked(name, if *name == "gripper" { 2 } else { 1 });
        terminal.keys("\n");
        terminal.until(&format!("{name}: number {} (was 1, at 1000000 bit/s)", motor + 1));
    }
    begun.wait().with(0);
    let both = |motors: &str| format!("arm setup-motors so101 --address {} --yes {motors}", servos.address());
    home.dimos(&both("--motor gripper --motor wrist_roll")).with(2);
    home.dimos(&both("--motor elbow")).with(2).says(&["no motor named \"elbow\"", "elbow_flex"]);
    home.dimos(&both("--motor shoulder_pan")).with(0);

    // All together now, with the settings of the factory.
    servos.with(|servos, _| (0..6).for_each(|servo| servos.plug(servo, servo as u8 + 1)));
    let configure = |more: &str| home.dimos(&format!("arm configure so101 --address {} {more}", servos.address()));
    let found = configure("--check --json").with(1).says(&["9 settings have another value"]).json();
    let first = json!({"motor": "shoulder_pan", "name": "P coefficient", "register": 21, "found": 32, "wanted": 16});
    assert_eq!(found[0], first);
    configure("").with(2).says(&["stdin is not a terminal"]);
    configure("--yes").with(0).says(&["9 settings were written and read back"]);
    configure("--check").with(0).says(&["all settings are as the adapter wants them"]);
}

#[test]
fn the_port_of_an_arm_is_found() {
    let home = Home::new();
    let (servos, other) = (emulate(json!({})), emulate(json!({"ids": [0, 0, 0, 0, 0, 0]})));
    let (here, there) = (servos.address(), other.address());
    let ask = home.dimos(&format!("arm find-port --ask so101 --port {here} --port {there}")).with(0);
    let answer = |port: &str| ask.out.lines().find(|line| line.split(' ').next() == Some(port)).unwrap().to_owned();
    assert!(answer(&here).ends_with("SO-101: 6 servos STS3215, firmware 3.10"), "{}", ask.out);
    assert!(answer(&there).contains("servo 1 (shoulder_pan)"), "{}", ask.out);
    home.dimos(&format!("arm find-port --ask so101 --port {there}")).with(3).says(&["no so101 answers"]);
    home.dimos(&format!("arm find-port --ask piper --port {there}")).with(2).says(&["adapters with such a bus: so101"]);

    // A port in use: by another verb under another name of the same port, and by a program without our locks.
    let link = home.path().join("pci-0000:00:14.0-usb-0:1:1.0-port0");
    symlink(&here, &link).unwrap();
    let terminal = Terminal::new(140, 30);
    let holder = terminal.start(&home, &format!("arm setup-motors so101 --address {}@1000000", link.display()));
    terminal.until("Connect only the motor of gripper");
    let find = format!("arm find-port --ask so101 --port {here}");
    let process = format!("is in use by process {}", holder.pid());
    home.dimos(&find).with(3).shows(&[&process]).says(&["no so101 answers", "`dimos down` ends one"]);
    terminal.keys("\x03");
    holder.wait().with(130);
    let taken = SerialLink::connect("test", &here, 1_000_000, std::time::Duration::from_secs(1)).unwrap();
    home.dimos(&find).with(3).shows(&["another program uses it"]).says(&[&format!("`fuser -v {here}`")]);
    drop(taken);
    home.dimos(&find).with(0);

    // The cable: a link that disappears, and comes back with another name.
    let [first, second, third] = ["port-a", "port-b", "port-c"].map(|name| home.path().join(name));
    symlink(&here, &first).unwrap();
    symlink(&there, &second).unwrap();
    let ports = [&first, &second, &third].map(|port| format!("--port {}", port.display())).join(" ");
    let terminal = Terminal::new(140, 30);
    let begun = terminal.start(&home, &format!("arm find-port {ports}"));
    terminal.until("Unplug the arm's USB cable, then press Enter");
    std::fs::remove_file(&first).unwrap();
    terminal.keys("\n");
    terminal.until("port-a is gone. Plug the arm in again");
    symlink(&here, &third).unwrap();
    terminal.until("port-c");
    begun.wait().with(0);
}
