//! Another client changes the arm's mode or power: it is reported and not undone. Two calls of the vendor's SDK, as
//! frames, with pauses between them; from a program that this computer receives, and from one that it does not.

use std::time::{Duration, Instant};

use super::adapter::PiperAdapter;
use super::golden::frame;
use super::tests::{START, activate, connected, farthest, read, until};
use dimos_core::arm::StopPoint;
use dimos_core::joint::ControlMode;
use dimos_hardware::adapter::ManipulatorAdapter;
use dimos_hardware::registry::Emulator;
use dimos_hardware::transport::can::{self, CanAddress, CanFrame};

/// Two calls of the SDK.
type Calls = (&'static [&'static str], &'static [&'static str]);

/// `MotionCtrl_2(1, 0, 50)`, `EndPoseCtrl(…)`: a pose 20 mm above the start.
const POSE: Calls =
    (&["151#0100320000000000"], &["152#0001D169000035A6", "153#0005D9B3FFFD73AA", "154#00012ECBFFFD8FA0"]);
/// `MotionCtrl_1(0, 0, 1)` and `MotionCtrl_1(0, 0, 2)`: hand guiding begins and ends.
const GUIDING: Calls = (&["150#0000010000000000"], &["150#0000020000000000"]);
/// `DisableArm(7)`, `EnableArm(7)`.
const POWER: Calls = (&["471#0701000000000000"], &["471#0702000000000000"]);

const PAUSES: [Duration; 3] = [Duration::ZERO, Duration::from_millis(5), Duration::from_millis(200)];

/// Streams as the device thread does, until the arm is not as ordered. Returns whether the mode showed it.
fn stream_until_changed(arm: &mut PiperAdapter) -> bool {
    let end = Instant::now() + Duration::from_secs(10);
    loop {
        read(arm).unwrap();
        assert_eq!(arm.read_error().unwrap().0, 0, "no error");
        let changed = arm.get_control_mode() != ControlMode::ServoPosition;
        if changed || !arm.read_enabled().unwrap() {
            return changed;
        }
        let _ = arm.write_joint_positions(&START, 1.0);
        assert!(Instant::now() < end, "nothing shows the change");
        std::thread::sleep(Duration::from_millis(10));
    }
}

fn interfere(calls: Calls, pause: Duration, heard: bool) {
    let (emulator, mut arm) = connected();
    activate(&emulator, &mut arm);
    arm.set_control_mode(ControlMode::ServoPosition).unwrap();
    for _ in 0..5 {
        read(&mut arm).unwrap();
        arm.write_joint_positions(&START, 1.0).unwrap();
        std::thread::sleep(Duration::from_millis(10));
    }
    until("an empty bus", || {
        let before = emulator.trace().len();
        std::thread::sleep(Duration::from_millis(5));
        emulator.trace().len() == before
    });
    emulator.record();
    let address = CanAddress::parse(&emulator.address()).unwrap();
    let mut port = can::open("sdk", &address, &[]).unwrap();
    let changed = std::thread::scope(|scope| {
        scope.spawn(|| {
            for (i, part) in [calls.0, calls.1].into_iter().enumerate() {
                let frames: Vec<CanFrame> = part.iter().map(|text| frame(text)).collect();
                match heard {
                    true => drop(port.send(&frames).unwrap()),
                    false => frames.iter().for_each(|frame| emulator.execute_unheard(frame)),
                }
                if i == 0 {
                    std::thread::sleep(pause);
                }
            }
        });
        stream_until_changed(&mut arm)
    });
    assert!(changed || calls == POWER, "the mode shows it");
    let what = format!("{calls:?} {pause:?} heard: {heard}");
    // It is not undone: no frame restores the mode or switches motors, and nothing more is written.
    let others: Vec<CanFrame> = calls.0.iter().chain(calls.1).map(|text| frame(text)).collect();
    let ours = || emulator.trace().iter().map(|(_, f)| *f).filter(|f| !others.contains(f)).collect::<Vec<_>>();
    assert!(ours().iter().all(|f| (0x155..=0x157).contains(&f.id)), "{what}: {:x?}", ours());
    let before = ours().len();
    let error = arm.write_joint_positions(&START, 1.0).unwrap_err().to_string();
    assert!(
        ["this run did not order", "another program commands", "motors are disabled", "is controlled by"]
            .iter()
            .any(|part| error.contains(part)),
        "{error}"
    );
    assert!(arm.set_control_mode(ControlMode::Position).is_err());
    until("the end of the pause", || {
        std::thread::sleep(pause);
        read(&mut arm).is_ok()
    });
    assert_eq!(ours().len(), before, "{what}: nothing was sent since");
    if calls == POSE {
        until("the other program's target", || {
            read(&mut arm).unwrap();
            farthest(&emulator.joints().0, &START) > 0.02 && emulator.joints().1.iter().all(|v| v.abs() < 1e-3)
        });
        assert_ne!(arm.get_control_mode(), ControlMode::ServoPosition, "until it is enabled again");
    }
    // Enabling takes the arm again, where it is then.
    until("the arm", || {
        let _ = read(&mut arm);
        arm.write_clear_errors().is_ok() && arm.write_enable(true).is_ok()
    });
    assert_eq!((arm.get_control_mode(), arm.read_enabled()), (ControlMode::ServoPosition, Ok(true)));
    let here = read(&mut arm).unwrap().position;
    arm.write_joint_positions(&here[..6], 1.0).unwrap();
}

#[test]
fn a_pose_by_another_program_is_left_alone() {
    PAUSES.iter().for_each(|pause| [true, false].iter().for_each(|heard| interfere(POSE, *pause, *heard)));
}

#[test]
fn hand_guiding_is_left_alone() {
    PAUSES.iter().for_each(|pause| [true, false].iter().for_each(|heard| interfere(GUIDING, *pause, *heard)));
}

#[test]
fn motors_that_another_program_switches_are_left_alone() {
    PAUSES.iter().for_each(|pause| [true, false].iter().for_each(|heard| interfere(POWER, *pause, *heard)));
}

#[test]
fn targets_of_another_program_in_the_same_mode_are_left_alone() {
    let (emulator, mut arm) = connected();
    activate(&emulator, &mut arm);
    arm.set_control_mode(ControlMode::ServoPosition).unwrap();
    let address = CanAddress::parse(&emulator.address()).unwrap();
    can::open("sdk", &address, &[]).unwrap().send(&super::golden::MOVE_JOINTS.map(frame)).unwrap();
    assert!(stream_until_changed(&mut arm));
    assert!(arm.write_joint_positions(&START, 1.0).is_err());
    // A stop is somebody's order, and is sent all the same: where the arm is, not where it was before.
    emulator.record();
    arm.write_stop(&StopPoint::default()).unwrap();
    assert!(emulator.trace().iter().any(|(_, f)| f.id == 0x157));
}
