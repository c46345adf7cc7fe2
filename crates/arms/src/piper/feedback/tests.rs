//! Feedback from single frames: sets, implausible values, errors, firmware.

use super::super::protocol::{DOF, Driver, FeedbackFrame, Gripper, Motor, Status};
use super::Feedback;
use dimos_core::clock::Mono;

const fn ms(n: u64) -> Mono {
    Mono(1_000_000_000 + n * 1_000_000)
}

fn joints(feedback: &mut Feedback, part: usize, value: i32, at: Mono) {
    feedback.take(FeedbackFrame::Joints(part, [value, value]), at);
}

#[test]
fn a_set_is_three_frames_of_one_burst_in_order() {
    let mut feedback = Feedback::default();
    (0..3).for_each(|part| joints(&mut feedback, part, 1, ms(part as u64)));
    assert_eq!((feedback.joints, feedback.joints_at), ([1; 6], ms(2)));
    // Each of the three lost in turn: no set.
    for lost in 0..3 {
        (0..3).filter(|part| *part != lost).for_each(|part| joints(&mut feedback, part, 7, ms(10)));
    }
    assert_eq!(feedback.joints, [1; 6]);
    // Frames of two bursts.
    joints(&mut feedback, 0, 8, ms(20));
    joints(&mut feedback, 1, 8, ms(20));
    joints(&mut feedback, 2, 9, ms(25));
    assert_eq!((feedback.joints, feedback.counts.sets), ([1; 6], 1));
    (0..3).for_each(|part| joints(&mut feedback, part, -5, ms(30)));
    assert_eq!((feedback.joints, feedback.joints_at), ([-5; 6], ms(30)));
    // Farther than the arm can move in that time.
    (0..3).for_each(|part| joints(&mut feedback, part, 60_000, ms(35)));
    assert_eq!((feedback.joints, feedback.counts.damaged), ([-5; 6], 1));
    assert!(feedback.disputed(ms(35)));
}

#[test]
fn sudden_zeros_and_impossible_positions_are_rejected() {
    let mut feedback = Feedback::default();
    let mut at = 1;
    let mut set = |value: i32| {
        at += 200;
        (0..3).for_each(|part| joints(&mut feedback, part, value, ms(at)));
        feedback.joints[0]
    };
    assert_eq!(set(0), 0, "the first set may be zero: activation checks it again");
    assert_eq!(set(40_000), 40_000);
    assert_eq!(set(0), 40_000);
    assert_eq!(set(400_000), 40_000);
    assert_eq!(set(4_000), 4_000);
    assert_eq!(set(0), 0, "close to zero, zero is plausible");
    assert_eq!(feedback.counts.damaged, 2);
}

#[test]
fn errors_have_a_code_and_a_text_each() {
    let mut feedback = Feedback::default();
    assert_eq!((feedback.error_code(), feedback.error_text()), (0, String::new()));
    let hot = Driver { motor_temperature: 84, status: 0x40 | 0b10, ..Driver::default() };
    feedback.take(FeedbackFrame::Driver(2, hot), ms(0));
    assert_eq!((feedback.error_code(), feedback.error_text()), (331, "joint 3: motor too hot (84 °C)".into()));
    feedback.take(FeedbackFrame::Status(Status { limits: 0b10, silent: 0b100000, ..Status::default() }), ms(0));
    assert_eq!(feedback.error_code(), 206);
    feedback.take(FeedbackFrame::Status(Status { arm: 9, limits: 0b10, ..Status::default() }), ms(0));
    let text = "a joint is in error; joint 2 beyond its limits; joint 3: motor too hot (84 °C)";
    assert_eq!((feedback.error_code(), feedback.error_text()), (9, text.into()));
    feedback.take(FeedbackFrame::Status(Status { arm: 12, ..Status::default() }), ms(0));
    assert_eq!(feedback.error_code(), 331, "teaching is not an error");
    let closed_too_hard = Gripper { status: 0xC0 | 0b100100, ..Gripper::default() };
    let mut feedback = Feedback::default();
    feedback.take(FeedbackFrame::Gripper(closed_too_hard), ms(0));
    assert_eq!((feedback.error_code(), feedback.error_text()), (0, String::new()), "the gripper is not used");
    feedback.gripper_used = true;
    let text = "gripper: overcurrent; gripper: driver error";
    assert_eq!((feedback.error_code(), feedback.error_text()), (402, text.into()));
    feedback.take(FeedbackFrame::Driver(2, hot), ms(0));
    let text = "joint 3: motor too hot (84 °C); gripper: overcurrent; gripper: driver error";
    assert_eq!((feedback.error_code(), feedback.error_text()), (331, text.into()));
}

#[test]
fn the_firmware_version_is_assembled_from_frames() {
    let mut feedback = Feedback::default();
    for (piece, length) in [(b"\0H-V1.2-", 8), (b"1 S-V1.6", 8), (b"-3\0\0\0\0\0\0", 2)] {
        assert_eq!(feedback.firmware(), None);
        feedback.take(FeedbackFrame::Firmware(*piece, length), ms(0));
    }
    assert_eq!(feedback.firmware(), Some((1, 6, 3)));
    (0..1000).for_each(|_| feedback.take(FeedbackFrame::Firmware([b'x'; 8], 8), ms(0)));
    assert_eq!(feedback.firmware(), Some((1, 6, 3)));
}

#[test]
fn feedback_is_complete_when_every_frame_has_arrived() {
    let mut feedback = Feedback::default();
    (0..3).for_each(|part| joints(&mut feedback, part, 1, ms(0)));
    feedback.take(FeedbackFrame::Status(Status::default()), ms(0));
    for joint in 0..DOF {
        assert!(!feedback.complete());
        feedback.take(FeedbackFrame::Motor(joint, Motor::default()), ms(0));
        feedback.take(FeedbackFrame::Driver(joint, Driver { status: 0x40, ..Driver::default() }), ms(0));
    }
    assert!(feedback.complete() && feedback.enabled() && !feedback.disabled());
}
