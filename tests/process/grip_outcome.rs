//! What became of a gripper command: judged by the run, awaited by the command line, between waypoints, with objects of
//! the planner's world; and gripper targets beside those of the joints.

use dimos::arms::yourarm::emulator::{SimOptions, YourArmEmulator};
use dimos::hardware::registry::Emulator;
use dimos::hardware::sim::faults::{Fault, FaultKind};
use dimos::rpc::api::{Chunk, Servo, Status};

use crate::support::program::{Home, eventually};

const BLUEPRINT: &str = "
name: grips
include: [yourarm-planner]
tasks:
  - {name: chunk_arm, type: chunk, joint_names: {hardware: arm}, priority: 20}
  - {name: servo_arm, type: servo, joint_names: {hardware: arm}, priority: 15}
";

fn home() -> (Home, YourArmEmulator) {
    let (home, arm) = (Home::new(), YourArmEmulator::with(&SimOptions::default()).unwrap());
    home.write("grips.yaml", BLUEPRINT);
    (home, arm)
}

fn held_by(home: &Home, name: &str) -> Option<String> {
    let world = home.dimos("world list --json").with(0).json();
    let objects = world["objects"].as_array().unwrap().clone();
    let object = objects.into_iter().find(|object| object["name"] == name).unwrap();
    object["held_by"][0].as_str().map(str::to_owned)
}

#[test]
fn the_outcome_is_awaited_and_objects_are_attached_only_when_they_are_held() {
    let (home, arm) = home();
    let _run = home.run(&format!("grips.yaml --no-record --set hardware.arm.address={}", arm.address()));
    let said = home.dimos("arm gripper arm open").with(0).out;
    assert!(said.starts_with("arm: gripper open at 0.0800 m, force 0.00 N, after 0."), "{said}");
    home.dimos("arm gripper arm 0.04").with(0).shows(&["gripper reached 0.0400 m"]);
    home.dimos("arm gripper arm close").with(0).shows(&["gripper closed at 0.0000 m"]);
    home.dimos("arm gripper arm open --no-wait").with(0).shows(&["arm: gripper to 0.0800 m"]);
    home.dimos("arm gripper arm open --timeout 0.01").with(1).says(&["still move after 0.01 s", "hint: "]);
    home.dimos("arm gripper arm open --speed 0.5").with(1).says(&["no speed control", "[UNSUPPORTED]"]);

    // Attach: nothing is attached that is not held, and a wrong name moves nothing.
    home.dimos("arm gripper arm open").with(0);
    home.dimos("arm gripper arm close --attach cup").with(2).says(&["no object cup", "hint: "]);
    home.dimos("arm gripper arm open --detach").with(1).says(&["arm holds no object", "hint: "]);
    home.dimos("world add cup --sphere 0.02 --at 0.266 0 0.314").with(0);
    home.dimos("arm gripper arm close --attach cup").with(1).says(&["closed at 0.0000 m", "cup is not attached"]);
    assert_eq!(held_by(&home, "cup"), None);
    home.dimos("arm gripper arm open").with(0);
    arm.put_object(0.03);
    // What is held is at the fingers.
    home.dimos("world add box --sphere 0.02 --at 0.266 0.4 0.314").with(0);
    let far = home.dimos("arm gripper arm close --attach box").with(1);
    far.says(&["box is 0.383 m from flange of arm: it is not what the gripper holds", "dimos world attach box arm"]);
    assert_eq!(held_by(&home, "box"), None);
    let grip = home.dimos("arm gripper arm close --force 12.5 --attach cup --json").with(0).json();
    assert_eq!((&grip["outcome"], &grip["attached"][0]), (&"holding".into(), &"cup".into()), "{grip}");
    assert!((grip["position"].as_f64().unwrap() - 0.03).abs() < 1e-6 && grip["force"] == 12.5, "{grip}");
    assert_eq!(held_by(&home, "cup").as_deref(), Some("arm"));
    home.dimos("arm gripper arm close --attach cup").with(1).says(&["cup is held already", "dimos world detach cup"]);
    home.dimos("arm gripper arm open --detach").with(0).shows(&["gripper open at 0.0800 m", "cup detached"]);
    assert_eq!(held_by(&home, "cup"), None);

    // Blocked on the way: exit 1, and the position is the measured one.
    arm.put_object(0.0);
    home.dimos("arm gripper arm 0.02").with(0);
    arm.inject(Fault::new(FaultKind::GripperBlocked).lasting(60.0)).unwrap();
    let blocked = home.dimos("arm gripper arm open").with(1);
    blocked.says(&["gripper blocked at 0.0200 m", "on the way to 0.0800 m", "hint: "]);
    home.dimos("stop arm").with(0);
    home.dimos("arm gripper arm open").with(1).says(&["ARM_LATCHED"]);
}

#[test]
fn gripper_actions_between_waypoints_are_awaited_and_end_the_motion_when_they_fail() {
    let (home, arm) = home();
    let _run = home.run(&format!("grips.yaml --no-record --set hardware.arm.address={}", arm.address()));
    home.dimos("arm gripper arm open").with(0);
    home.dimos("world add cup --sphere 0.02 --at 0.2607 0.0528 0.314").with(0);
    let through = "0.2,-0.3,0.6,0,0.8,0 gripper:close:cup home gripper:open:cup 0.1,-0.3,0.6,0,0.8,0 --speed 1";
    arm.put_object(0.03);
    let moved = home.dimos(&format!("move arm --through {through}")).with(0);
    let moved = moved.shows(&["holding an object at 0.0300 m", "cup attached", "open at 0.0800 m", "cup detached"]);
    assert_eq!(moved.out.matches("COMPLETED").count(), 3, "{}", moved.out);

    // Nothing to hold: the motion ends where it is, and says so.
    arm.put_object(0.0);
    let ended = home.dimos(&format!("move arm --through {through}")).with(1);
    let ended = ended.says(&["cup is not attached", "the motion ends here"]);
    assert_eq!(ended.out.matches("COMPLETED").count(), 1, "{}", ended.out);
    let joint = home.dimos("state --json").with(0).json()["arms"][0]["joints"][0]["position"].as_f64().unwrap();
    assert!((joint - 0.2).abs() < 0.01, "it is at the first waypoint: {joint}");
    // What is wrong is found before anything moves.
    home.dimos("move arm --through gripper:open home nowhere").with(2).says(&["no named pose nowhere"]);
    let at = home.positions("arm");
    for (action, wrong) in [("gripper:0.5", "cannot go to 0.5 m"), ("gripper:close:cap", "did you mean `cup`?")] {
        home.dimos(&format!("move arm --through home {action} home")).with(2).says(&[wrong, "nothing has moved"]);
    }
    assert!(at.iter().zip(home.positions("arm")).all(|(a, b)| (a - b).abs() < 1e-3));
    home.dimos("move arm --through home gripper:ajar").with(2).says(&["`open` or `close`"]);
    home.dimos("plan arm --through home gripper:close zero").with(2).says(&["a plan has no gripper actions"]);
}

#[test]
fn chunks_and_streams_have_gripper_targets_and_late_ones_are_counted() {
    let (home, arm) = home();
    let run = home.run(&format!("grips.yaml --set hardware.arm.address={}", arm.address()));
    let mut client = home.client();
    let state = home.dimos("state --json").with(0).json()["arms"][0].clone();
    let here: Vec<f64> =
        state["joints"].as_array().unwrap().iter().map(|joint| joint["position"].as_f64().unwrap()).collect();
    let opening = || home.dimos("state --json").with(0).json()["arms"][0]["gripper"].as_f64().unwrap();

    let chunk = |start: Option<f64>, gripper: Vec<f64>| Chunk {
        task: "chunk_arm".into(),
        actions: vec![here.clone(); gripper.len()],
        period: 0.05,
        start,
        gripper: Some(gripper),
    };
    let reply = client.call(chunk(None, (0..20).map(|k| 0.04 + 0.002 * k as f64).collect())).unwrap();
    assert_eq!(reply.actions, 20);
    eventually("the gripper follows the chunk to its end", || (opening() - 0.078).abs() < 1e-3);
    // Half of it is over: those actions are dropped and counted, for the gripper as well.
    let stamp = home.dimos("state --json").with(0).json()["stamp"].as_f64().unwrap();
    let late = client.call(chunk(Some(stamp - 0.5), vec![0.05; 20])).unwrap().late as u64;
    assert!((10..20).contains(&late), "{late}");
    eventually("the rest of it is taken", || (opening() - 0.05).abs() < 1e-3);
    let task = client.call(Status {}).unwrap().tasks.into_iter().find(|task| task.name == "chunk_arm").unwrap();
    let counts = task.stream.unwrap();
    assert_eq!((counts.actions, counts.gripper_targets), (40, 40));
    assert!(counts.late_actions >= late && (late..20).contains(&counts.late_gripper_targets), "{counts:?}");
    home.dimos("status").with(0).shows(&["chunk_arm was sent 40 actions"]);

    let wrong = client.call(chunk(None, vec![0.05, 0.2])).unwrap_err();
    assert!(wrong.to_string().contains("goes from 0 to 0.08 m, not to 0.2 m"), "{wrong}");
    let servo = |gripper| Servo { gripper: Some(gripper), ..Servo::new("servo_arm", here.clone()) };
    eventually("the chunk has ended", || client.call(servo(0.01)).is_ok());
    eventually("the gripper follows the stream", || (opening() - 0.01).abs() < 1e-3);
    home.write("targets.txt", &format!("{here:?}\n").replace(']', ", 0.03]").repeat(5));
    drop(client); // and its lease
    home.dimos("task stream servo_arm targets.txt").with(2).says(&["7 numbers for 6 joints"]);
    home.dimos("task stream servo_arm targets.txt --gripper").with(0);
    eventually("the gripper is in the file, too", || (opening() - 0.03).abs() < 1e-3);
    home.dimos("down").with(0);
    drop(run);
    let [log] = &home.logs()[..] else { panic!("one log") };
    home.dimos(&format!("replay {} --verify", log.display())).with(0).shows(&["reproducible"]);
}

/// Of an xArm only the position is measured, of a Piper the torque, too. A jaw of an SO-101 that is stuck holds.
#[test]
fn other_arms_hold_what_is_between_their_fingers() {
    let object = r#"[{"kind":"object","amount":0.03,"duration":600}]"#;
    let stuck = r#"[{"kind":"blocked","joint":6,"duration":600}]"#;
    for (run, faults, expected) in [
        ("coordinator-xarm6", object, "holding an object at 0.030"),
        ("coordinator-piper", object, "holding an object at 0.0300 m, force 1.00 Nm"),
        ("coordinator-so101", stuck, "holding an object at "),
    ] {
        let home = Home::new();
        let _run = home.run(&format!("{run} --sim --no-record --set hardware.arm.options.sim.faults={faults}"));
        home.dimos("arm gripper arm close").with(0).shows(&[expected]);
    }
}
