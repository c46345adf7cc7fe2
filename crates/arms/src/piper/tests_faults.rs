//! What goes wrong with the arm and its bus, and what the adapter makes of it. The numbers are rows of the fault table.

use std::time::{Duration, Instant};

use super::adapter::PiperAdapter;
use super::emulator::PiperEmulator;
use super::golden;
use super::protocol::DOF;
use super::tests::{START, activate, at, config, connected, farthest, ids, pair, read, two, until};
use dimos_core::arm::StopPoint;
use dimos_core::joint::ControlMode;
use dimos_hardware::adapter::{AdapterError, Gripper, ManipulatorAdapter, Stop};
use dimos_hardware::registry::Emulator;
use dimos_hardware::sim::faults::{Fault, FaultKind};
use dimos_hardware::transport::can::{self, CanAddress, CanFrame, CanPort};

/// Somebody else on the computer's end of the bus.
pub(super) fn other(emulator: &PiperEmulator) -> Box<dyn CanPort> {
    can::open("other", &CanAddress::parse(&emulator.address()).unwrap(), &[]).unwrap()
}

/// Waits for an error of `read_joints`.
pub(super) fn failure(arm: &mut PiperAdapter) -> AdapterError {
    let end = Instant::now() + Duration::from_secs(10);
    loop {
        match read(arm) {
            Err(error) => return error,
            Ok(_) => assert!(Instant::now() < end, "no error within 10 s"),
        }
        std::thread::sleep(Duration::from_millis(2));
    }
}

#[test]
fn f05_silence_is_noticed_by_the_age_of_the_state() {
    let (emulator, mut arm) = connected();
    activate(&emulator, &mut arm);
    emulator.inject(Fault::new(FaultKind::Silent).lasting(60.0)).unwrap();
    let error = failure(&mut arm);
    assert!(matches!(&error, AdapterError::Timeout(text) if text.contains("no state for")), "{error}");
    assert!(arm.is_connected(), "it may come back");
    emulator.record();
    assert_eq!(arm.write_joint_positions(&START, 0.1), Err(AdapterError::Busy), "it counts as not written");
    assert!(arm.write_stop(&StopPoint::default()).is_err(), "an arm is not sent back to where it was long ago");
    assert_eq!(ids(&emulator), [0u16; 0], "nothing goes out to an arm that is silent");
    until("the end of the connection", || read(&mut arm).is_err() && !arm.is_connected());
    let start = Instant::now();
    let error = arm.connect().unwrap_err().to_string();
    assert!(error.contains("nothing was heard") && error.contains("\nhint: is the arm powered"), "{error}");
    assert!(start.elapsed() < Duration::from_secs(3));
}

#[test]
fn f05_speeds_that_are_old_are_not_told() {
    let (emulator, mut arm) = connected();
    assert!(read(&mut arm).unwrap().velocity.is_some());
    emulator.mute(Some(0x252..=0x252));
    until("the silence of motor 2", || read(&mut arm).unwrap().velocity.is_none());
    assert!(read(&mut arm).unwrap().effort.is_none());
    let mut values = [7.0; DOF];
    assert_eq!((arm.read_joint_velocities(&mut values), values), (Ok(false), [7.0; DOF]));
    assert_eq!((arm.read_joint_efforts(&mut values), values), (Ok(false), [7.0; DOF]));
    assert_eq!(arm.write_stop(&StopPoint::default()), Ok(Stop::Sent), "nothing shows that motor 2 is at rest");
    emulator.mute(None);
    until("news of it", || read(&mut arm).unwrap().velocity.is_some());
    assert_eq!(arm.write_stop(&StopPoint::default()), Ok(Stop::Confirmed));
}

#[test]
fn f05_drivers_that_fall_silent_are_named_and_the_arm_can_still_be_stopped() {
    let (emulator, mut arm) = connected();
    activate(&emulator, &mut arm);
    emulator.mute(Some(0x263..=0x264));
    // Each reports at its own time: both have been silent for long enough then.
    std::thread::sleep(Duration::from_millis(400));
    let error = failure(&mut arm);
    let AdapterError::Timeout(text) = &error else { panic!("{error:?}") };
    assert!(text.ends_with("the drivers of joints 3, 4 have said nothing for 300 ms"), "{text}");
    assert_eq!(
        arm.write_joint_positions(&START, 0.1),
        Err(AdapterError::Busy),
        "whether its motors are on is not known"
    );
    emulator.record();
    assert!(arm.write_stop(&at(&START)).is_ok() && arm.is_connected());
    until("the hold", || ids(&emulator) == [0x151, 0x155, 0x156, 0x157]);
    let off = arm.write_enable(false).unwrap_err().to_string();
    assert_eq!(off, "arm: the drivers of joints 3, 4 have said nothing for 1000 ms");
    emulator.mute(None);
    until("all of them", || read(&mut arm).is_ok());
    assert_eq!(arm.read_enabled(), Ok(false));
}

#[test]
fn a_stall_passes() {
    let (emulator, mut arm) = connected();
    emulator.inject(Fault::new(FaultKind::Stall).lasting(0.5)).unwrap();
    assert!(matches!(failure(&mut arm), AdapterError::Timeout(_)));
    until("the end of the stall", || {
        if !arm.is_connected() {
            let _ = arm.connect();
        }
        read(&mut arm).is_ok()
    });
}

#[test]
fn a_leader_is_told_with_the_remedy_and_nothing_is_sent_but_questions() {
    let (emulator, mut arm) = pair(serde_json::json!({ "sim": { "faults": [{ "kind": "leader" }] } }));
    emulator.record();
    let error = arm.connect().unwrap_err();
    let AdapterError::Rejected(text) = error else { panic!("{error:?}") };
    assert!(text.contains("this arm leads others") && text.contains("\nhint: ") && text.contains("0xFC"), "{text}");
    assert!(!arm.is_connected());
    assert!(ids(&emulator).iter().all(|id| [0x472, 0x4AF].contains(id)));
    other(&emulator).send(&[golden::frame("470#FC00000000000000")]).unwrap();
    until("a follower", || arm.connect().is_ok());
}

#[test]
fn f12_zeros_are_no_pose_to_hold() {
    // Zeros from the start: the arm can be read, not enabled.
    let faults = serde_json::json!([{ "kind": "zero_state", "duration": 1000 }]);
    let (emulator, mut arm) = pair(serde_json::json!({ "sim": { "faults": faults } }));
    arm.connect().unwrap();
    until("zeros", || read(&mut arm).unwrap().position == [0.0; 16]);
    emulator.record();
    let error = arm.activate().unwrap_err().to_string();
    assert!(error.contains("every joint reads exactly 0") && error.contains("\nhint: "), "{error}");
    assert_eq!(ids(&emulator), [0u16; 0]);
    assert_eq!(read(&mut arm).unwrap().valid, None, "whether they are measured is not known");
    // Zeros in between: not believed.
    let (emulator, mut arm) = connected();
    emulator.inject(Fault::new(FaultKind::ZeroState).times(5)).unwrap();
    for _ in 0..40 {
        assert!(farthest(&read(&mut arm).unwrap().position, &START) < 1e-4);
        std::thread::sleep(Duration::from_millis(2));
    }
    assert!(arm.counts().0.damaged >= 5);
    assert_eq!(read(&mut arm).unwrap().valid, Some(true));
}

#[test]
fn positions_are_measured_when_the_joints_answer_their_controller() {
    let (emulator, mut arm) = connected();
    assert_eq!(read(&mut arm).unwrap().valid, Some(true));
    // Joint 6 is silent, as the controller reports it.
    emulator.mute(Some(0x2A1..=0x2A1));
    let mut port = other(&emulator);
    until("the report", || {
        port.send(&[golden::frame("2A1#0000000000000020")]).unwrap();
        read(&mut arm).unwrap().valid == Some(false)
    });
    emulator.mute(None);
    until("joint 6", || read(&mut arm).unwrap().valid == Some(true));
    // The drivers have not said anything yet.
    emulator.mute(Some(0x261..=0x266));
    until("empty drivers", || {
        for joint in 1..=6 {
            port.send(&[CanFrame::new(0x260 + joint, &[0; 8])]).unwrap();
        }
        read(&mut arm).unwrap().valid == Some(false)
    });
}

#[test]
fn f12_an_arm_that_sags_holds_where_it_is_then() {
    let (emulator, mut arm) = connected();
    emulator.inject(Fault { amount: 0.04, ..Fault::new(FaultKind::Sag) }).unwrap();
    activate(&emulator, &mut arm);
    let last: Vec<CanFrame> = emulator.trace().iter().map(|(_, f)| *f).filter(|f| f.id == 0x155).collect();
    let held = f64::from(two(last.last().unwrap())[1]).to_radians() / 1000.0;
    assert!((held - emulator.joints().0[1]).abs() < 0.04, "{held}");
    assert!(farthest(&emulator.joints().0, &START) < 0.05);
}

#[test]
fn f15_f16_an_estop_is_told_and_never_reset_from_here() {
    let (emulator, mut arm) = connected();
    activate(&emulator, &mut arm);
    other(&emulator).send(&[golden::frame("150#0100000000000000")]).unwrap();
    until("the E-stop", || {
        read(&mut arm).unwrap();
        arm.read_error().unwrap().0 == 1
    });
    emulator.record();
    let refusals = [
        arm.write_joint_positions(&START, 0.1),
        arm.write_clear_errors(),
        arm.write_enable(true),
        arm.write_gripper_position(0.01),
    ];
    for refused in refusals {
        let Err(AdapterError::Fault { code: 1, text }) = refused else { panic!("{refused:?}") };
        assert!(text.starts_with("E-stop") && text.contains("\nhint: "), "{text}");
    }
    arm.write_stop(&StopPoint::default()).unwrap();
    assert_eq!((ids(&emulator), emulator.power_drops()), (vec![], 0), "nothing was sent");
    // Somebody resets the arm: it has fallen, and stays off until it is enabled.
    other(&emulator).send(&[golden::frame("150#0200000000000000")]).unwrap();
    until("the reset", || {
        read(&mut arm).unwrap();
        arm.read_error().unwrap().0 == 0
    });
    assert_eq!((emulator.power_drops(), arm.read_enabled()), (1, Ok(false)));
}

#[test]
fn f19_faults_have_code_and_text_and_are_cleared_without_a_fall() {
    let (emulator, mut arm) = connected();
    activate(&emulator, &mut arm);
    emulator.inject(Fault::new(FaultKind::ErrorCode).code(7)).unwrap();
    until("the collision", || {
        read(&mut arm).unwrap();
        arm.read_error() == Ok((7, "collision".into()))
    });
    let refused = arm.write_joint_positions(&START, 0.1).unwrap_err();
    assert_eq!(refused.to_string(), "fault 7: collision");
    emulator.record();
    arm.write_clear_errors().unwrap();
    assert_eq!(emulator.trace().iter().map(|(_, f)| *f).collect::<Vec<_>>(), [golden::frame(golden::CLEAR)]);
    assert_eq!((arm.read_error(), arm.read_enabled()), (Ok((0, String::new())), Ok(true)));
    assert!(farthest(&emulator.joints().0, &START) < 1e-3, "it held all the time");
    arm.write_joint_positions(&START, 0.1).unwrap();
}

#[test]
fn f19_faults_of_the_gripper_are_told_and_cleared_where_it_is_used() {
    let (emulator, mut arm) = connected();
    for on in [false, true] {
        if on {
            activate(&emulator, &mut arm);
            arm.write_gripper_position(0.03).unwrap();
            until("the gripper", || {
                read(&mut arm).unwrap();
                arm.read_gripper_position().unwrap().unwrap() == 0.03
            });
        }
        let opening = arm.read_gripper_position().unwrap().unwrap();
        emulator.inject(Fault::new(FaultKind::ErrorCode).code(402)).unwrap();
        until("overcurrent", || {
            read(&mut arm).unwrap();
            arm.read_error() == Ok((402, "gripper: overcurrent".into()))
        });
        assert!(matches!(arm.write_gripper_position(0.05), Err(AdapterError::Fault { code: 402, .. })));
        emulator.record();
        arm.write_clear_errors().unwrap();
        assert_eq!(arm.read_error(), Ok((0, String::new())));
        let frames: Vec<CanFrame> = emulator.trace().iter().map(|(_, f)| *f).collect();
        assert_eq!(frames[0], golden::frame(golden::CLEAR));
        let stroke = (opening * 1e6).round() as i32;
        assert_eq!((two(&frames[1])[0], frames[1].data[6], frames.len()), (stroke, if on { 3 } else { 2 }, 2));
    }
    arm.write_gripper_position(0.05).unwrap();
    let (emulator, mut arm) = pair(serde_json::json!({}));
    drop(arm);
    let without = config(&emulator.address(), serde_json::json!({ "gripper": "none" }));
    arm = PiperAdapter::new(&without).unwrap();
    arm.connect().unwrap();
    emulator.inject(Fault::new(FaultKind::ErrorCode).code(402)).unwrap();
    let end = Instant::now() + Duration::from_millis(200);
    while Instant::now() < end {
        read(&mut arm).unwrap();
        assert_eq!(arm.read_error(), Ok((0, String::new())), "the gripper is not used");
    }
}

#[test]
fn modes_that_are_not_emulated_are_said_so() {
    for frame in ["151#010400AD00000000", "151#0105320000000000", "151#0102320000000000", "15A#0000000000000000"] {
        let (emulator, mut arm) = connected();
        other(&emulator).send(&[golden::frame(frame)]).unwrap();
        until("the refusal", || {
            read(&mut arm).unwrap();
            arm.read_error().unwrap().0 == 10
        });
        arm.write_clear_errors().unwrap();
    }
}

#[test]
fn two_commanders_do_not_take_turns() {
    let (emulator, mut arm) = connected();
    activate(&emulator, &mut arm);
    other(&emulator).send(&golden::MOVE_JOINTS.map(golden::frame)).unwrap();
    until("the refusal", || {
        let refused = arm.write_joint_positions(&START, 0.1).err();
        refused.is_some_and(|error| error.to_string().contains("another program commands this arm\nhint: "))
    });
    assert!(arm.write_stop(&StopPoint::default()).is_ok(), "a stop is always sent");
    until("the other to be gone", || {
        read(&mut arm).unwrap();
        arm.write_clear_errors().is_ok() && arm.write_joint_positions(&START, 0.1).is_ok()
    });
    assert_eq!(arm.get_control_mode(), ControlMode::Position);
}

#[test]
fn an_arm_that_is_being_taught_is_left_alone() {
    let (emulator, mut arm) = connected();
    activate(&emulator, &mut arm);
    other(&emulator).send(&[golden::frame("150#0000010000000000")]).unwrap();
    until("teaching", || {
        read(&mut arm).unwrap();
        arm.read_state().unwrap().mode == 2
    });
    until("the reason", || {
        let error = arm.write_joint_positions(&START, 0.1).unwrap_err().to_string();
        error.contains("the arm is controlled by its teach button\nhint: ")
    });
    assert_ne!(arm.get_control_mode(), ControlMode::Position, "the mode shows it");
    assert_eq!(arm.read_error(), Ok((0, String::new())), "which is no error");
}

#[test]
fn f37_a_blocked_joint_shows_in_its_positions() {
    let (emulator, mut arm) = connected();
    activate(&emulator, &mut arm);
    emulator.inject(Fault { joint: 1, ..Fault::new(FaultKind::Blocked).lasting(60.0) }).unwrap();
    let mut target = START;
    (target[0], target[5]) = (0.4, 0.3);
    arm.write_joint_positions(&target, 1.0).unwrap();
    until("joint 6", || (read(&mut arm).unwrap().position[5] - 0.3).abs() < 1e-4);
    assert!((emulator.joints().0[0] - START[0]).abs() < 0.02);
    assert_eq!(arm.write_stop(&StopPoint::default()), Ok(Stop::Confirmed));
    assert!(emulator.inject(Fault::new(FaultKind::Panic)).is_err());
}
