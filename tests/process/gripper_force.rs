//! Position and force of a gripper, judged by what the arm's controller got and what the log has of it.

use dimos::arms::yourarm::emulator::wire::Request;
use dimos::arms::yourarm::emulator::{SimOptions, YourArmEmulator};
use dimos::hardware::registry::Emulator;
use dimos::recording::replay::{LogReader, Payload};
use serde_json::Value;

use crate::support::program::{Home, eventually};

/// What the controller got of gripper commands since it began to record, in mm and N.
fn orders(arm: &YourArmEmulator) -> Vec<Request> {
    let requests = arm.trace().into_iter().map(|received| received.request);
    requests.filter(|request| matches!(request, Request::Gripper(_) | Request::Grip(..))).collect()
}

#[test]
fn position_and_force_reach_the_arm_and_the_log() {
    let (home, arm) = (Home::new(), YourArmEmulator::with(&SimOptions::default()).unwrap());
    let run = home.run(&format!("coordinator-yourarm --set hardware.arm.address={}", arm.address()));
    let state = || home.dimos("state --json").with(0).json()["arms"][0].clone();
    arm.record();

    // An object 30 mm wide: the fingers stop there and press.
    arm.put_object(0.03);
    let said = home.dimos("arm gripper arm 0.02 --force 12.5").with(0).out;
    assert!(said.starts_with("arm: gripper holding an object at 0.0300 m, force 12.50 N, after "), "{said}");
    let gripping = state();
    assert!((gripping["gripper"].as_f64().unwrap() - 0.03).abs() < 1e-6, "{gripping}");
    assert_eq!((gripping["gripper_unit"].as_str(), gripping["gripper_force_unit"].as_str()), (Some("m"), Some("N")));
    home.dimos("state").with(0).shows(&["gripper  0.0300 m, force 12.50 N"]);
    let shown = "arm: gripper 0.0000 m closed, 0.0800 m open; force 1 to 60 N; measured force 12.50 N";
    home.dimos("status -v").with(0).shows(&[shown]);
    assert_eq!(orders(&arm), [Request::Grip(20.0, 12.5)]);

    // A stop keeps the grip: no further command, the same force.
    home.dimos("stop arm").with(0);
    home.dimos("arm reset arm").with(0);
    home.dimos("arm enable arm").with(0);
    assert_eq!((state()["gripper_force"].as_f64(), orders(&arm).len()), (Some(12.5), 1));

    // Without a force it is the arm's own; the reply says what was commanded.
    arm.put_object(0.0);
    let reply = home.dimos("arm gripper arm 0.05 --no-wait --json").with(0).json();
    assert_eq!(reply, serde_json::json!({"position": 0.05, "unit": "m", "order": 2}));
    let reply = home.dimos("arm gripper arm open --force 60 --json").with(0).json();
    assert_eq!((&reply["target"], &reply["outcome"]), (&0.08.into(), &"open".into()), "{reply}");
    assert_eq!(orders(&arm)[1..], [Request::Gripper(50.0), Request::Grip(80.0, 60.0)]);
    home.dimos("down").with(0);
    drop(run);

    let [log] = &home.logs()[..] else { panic!("one log") };
    let (mut commands, mut asked, mut measured, mut published) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    let mut reader = LogReader::open(log).unwrap();
    while let Some(entry) = reader.next_entry().unwrap() {
        match entry.data {
            Payload::ArmOutput(output) if output.gripper_seq > 0 => {
                commands.push((output.gripper, output.gripper_force));
            }
            Payload::ArmInput(input) => measured.push((input.gripper, input.gripper_force)),
            Payload::Text(text) if entry.topic == "/dimos/requests" => {
                asked.push(serde_json::from_str::<Value>(&text.data).unwrap()["request"].clone())
            }
            Payload::JointState(joints) if entry.topic == "/gripper/arm" => published.push(joints.effort),
            _ => {}
        }
    }
    commands.dedup();
    assert_eq!(commands, [(0.02, vec![12.5]), (0.05, vec![]), (0.08, vec![60.0])]);
    asked.retain(|request| request.get("gripper").is_some());
    let request = |opening: f64| serde_json::json!({"gripper": {"arm": 0, "opening": opening}});
    let mut first = request(0.02);
    first["gripper"]["force"] = 12.5.into();
    assert_eq!(asked[..2], [first, request(0.05)]);
    assert!(measured.iter().any(|(_, force)| *force == [12.5]) && published.iter().any(|force| *force == [12.5]));
    let coordinator = dimos::recording::replay::attachment(log, "coordinator.json").unwrap().unwrap();
    let coordinator: Value = serde_json::from_slice(&coordinator).unwrap();
    let info = serde_json::json!({"unit": "m", "range": [0.0, 0.08], "force_unit": "N", "force_range": [1.0, 60.0]});
    assert_eq!(coordinator["arms"][0]["gripper_info"], info);
    home.dimos(&format!("replay {} --verify", log.display())).with(0).shows(&["reproducible"]);
}

#[test]
fn a_force_that_the_gripper_cannot_have_is_refused_and_moves_nothing() {
    let (home, arm) = (Home::new(), YourArmEmulator::with(&SimOptions::default()).unwrap());
    let _run = home.run(&format!("coordinator-yourarm --no-record --set hardware.arm.address={}", arm.address()));
    arm.record();
    for force in ["0.5", "60.5", "-3"] {
        let refused = home.dimos(&format!("arm gripper arm 0.02 --force {force}")).with(1);
        let range = "hint: give 1 to 60 N, or no force for the one set in the arm";
        refused.says(&[
            &format!("a force of {force} is outside the range of the gripper of arm"),
            "[OUT_OF_LIMITS]",
            range,
        ]);
    }
    home.dimos("arm gripper arm 0.09 --force 10").with(1).says(&["0.09 m is not within 0 to 0.08 m", "hint: "]);
    home.dimos("arm gripper arm 0.02 --force strong").with(2);
    home.dimos("arm gripper arm 0.02 --force nan").with(2);
    assert_eq!(orders(&arm), []);
    assert_eq!(home.status()["arms"][0]["phase"], "ready");
}

#[test]
fn a_rotary_gripper_is_in_radians_and_has_no_force() {
    let home = Home::new();
    let _run = home.run("coordinator-so101 --sim --no-record");
    home.dimos("arm gripper arm 1.2").with(0).shows(&["arm: gripper reached 1.", " rad, after "]);
    let state = || home.dimos("state --json").with(0).json()["arms"][0].clone();
    eventually("the angle", || state()["gripper"].as_f64().is_some_and(|angle| (angle - 1.2).abs() < 3e-3));
    assert_eq!((state()["gripper_unit"].as_str(), state()["gripper_force"].as_f64()), (Some("rad"), None));
    home.dimos("status -v").with(0).shows(&["gripper 0.0000 rad closed, 1.9"]);
    let refused = home.dimos("arm gripper arm 0.5 --force 1").with(1);
    refused.says(&["the gripper of arm has no force control", "[UNSUPPORTED]", "hint: command its position without"]);
    home.dimos("arm gripper arm -0.1").with(1).says(&["rad is not within 0 to 1.9", "[rad]"]);
    let status = home.status()["arms"][0].clone();
    assert_eq!((status["gripper_unit"].as_str(), &status["gripper_force_range"]), (Some("rad"), &Value::Null));
    std::thread::sleep(std::time::Duration::from_millis(300));
    assert!((state()["gripper"].as_f64().unwrap() - 1.2).abs() < 3e-3, "what was refused moved nothing");
}
