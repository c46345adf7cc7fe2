use super::super::golden::{self, JOINTS, POSE, frame};
use super::*;

#[test]
fn commands_are_the_golden_bytes() {
    assert_eq!(joint_targets(25, Follow::Smooth, JOINTS), golden::MOVE_JOINTS.map(frame));
    assert_eq!(joint_targets(200, Follow::Direct, JOINTS)[0], frame(golden::MOVE_DIRECT));
    assert_eq!(pose_target(50, POSE), golden::MOVE_POSE.map(frame));
    assert_eq!(gripper_target(42_500, 1000), frame(golden::GRIPPER));
    let clear = [clear_gripper(42_500, 1000, true), clear_gripper(0, 1000, false)];
    assert_eq!(clear, golden::CLEAR_GRIPPER.map(frame));
    assert_eq!(gripper_target(0, 9999).data[4..6], [0x13, 0x88], "5 Nm at most");
    assert_eq!(enable(true), frame(golden::ENABLE));
    assert_eq!(enable(false), frame(golden::DISABLE));
    assert_eq!(clear_errors(), frame(golden::CLEAR));
    assert_eq!(ask_limits(2), frame(golden::ASK_LIMITS));
    assert_eq!(ask_firmware(), frame(golden::ASK_FIRMWARE));
}

#[test]
fn feedback_is_read_from_the_golden_bytes() {
    let read = |text| decode(&frame(text));
    let status = Status { control: 1, arm: 4, mode: 1, teaching: 0, limits: 0b10, silent: 0b100000 };
    assert_eq!(read(golden::STATUS), FeedbackFrame::Status(status));
    for part in 0..3 {
        let two = |all: [i32; 6]| [all[2 * part], all[2 * part + 1]];
        assert_eq!(read(golden::POSE_FEEDBACK[part]), FeedbackFrame::Pose(part, two(POSE)));
        assert_eq!(read(golden::JOINT_FEEDBACK[part]), FeedbackFrame::Joints(part, two(JOINTS)));
    }
    let gripper = Gripper { stroke: 42_500, torque: -500, status: 0xC0 };
    assert_eq!(read(golden::GRIPPER_FEEDBACK), FeedbackFrame::Gripper(gripper));
    assert_eq!(read(golden::MOTOR_1), FeedbackFrame::Motor(0, Motor { speed: -1500, current: 2000 }));
    assert_eq!(read(golden::MOTOR_6), FeedbackFrame::Motor(5, Motor { speed: 1, current: -1 }));
    let driver = Driver { voltage: 240, driver_temperature: 45, motor_temperature: -5, status: 0xC0 };
    assert_eq!(read(golden::DRIVER_3), FeedbackFrame::Driver(2, driver));
    assert!(driver.enabled());
    assert_eq!(read(golden::LIMITS_3), FeedbackFrame::Limits(2, MotorLimits { upper: 0, lower: -1700, speed: 3000 }));
    assert_eq!(read(golden::FIRMWARE), FeedbackFrame::Firmware(*b"S-V1.6-3", 8));
    for leader in ["151#01", "155#", "157#0000000000000000", "159#00", "3A5#0000000000000000"] {
        assert_eq!(read(leader), FeedbackFrame::Leader);
    }
    for command in ["150#02", golden::MOVE_POSE[1], golden::ENABLE, golden::CLEAR, "15A#00", "470#FC", "474#01"] {
        assert_eq!(read(command), FeedbackFrame::Command);
    }
    for other in
        [golden::ACK_ENABLE, golden::ACCELERATION_3, golden::ASK_LIMITS, "000#", "2A0#00", "2A9#00", "7FF#FFFF"]
    {
        assert_eq!(read(other), FeedbackFrame::Other);
    }
}

#[test]
fn short_frames_and_every_identifier_are_survived() {
    for id in 0..=0xFFFF {
        for len in [0, 1, 7, 8, 255] {
            let feedback = decode(&CanFrame { id, len, data: [0xFF; 8] });
            let whole = matches!(id, 0x2A1..=0x2A8 | 0x251..=0x256 | 0x261..=0x266 | 0x473);
            assert_eq!(feedback == FeedbackFrame::Damaged, whole && len != 8 || id == 0x473, "{id:X} {len}");
        }
    }
}

#[test]
fn every_error_has_words() {
    let unknown = arm_text(255);
    assert!((0..=15).all(|code| arm_text(code) != unknown) && arm_text(16) == unknown);
    assert!((0..=7).all(|control| control_text(control) != control_text(8)));
    assert!((0..8).all(|bit| driver_text(bit).is_some() == (bit != 6)));
    assert!((0..8).all(|bit| gripper_text(bit).is_some() == (bit < 6)));
}

/// Prints how fast frames are read; the figure of a debug build is a lower bound.
#[test]
fn reading_a_second_of_frames_takes_far_less_than_a_second() {
    use super::super::feedback::Feedback;
    use dimos_core::clock::Mono;
    let burst: Vec<CanFrame> =
        [golden::STATUS, golden::GRIPPER_FEEDBACK, golden::MOTOR_1, golden::MOTOR_6, golden::DRIVER_3]
            .into_iter()
            .chain(golden::POSE_FEEDBACK)
            .chain(golden::JOINT_FEEDBACK)
            .map(frame)
            .collect();
    let mut feedback = Feedback::default();
    let began = std::time::Instant::now();
    let rounds = 20_000;
    for round in 0..rounds {
        burst.iter().for_each(|frame| feedback.take(decode(frame), Mono(5_000_000 * (round + 1))));
    }
    let seconds = began.elapsed().as_secs_f64();
    assert_eq!(feedback.counts.sets, rounds);
    println!("{:.1} million frames/s", feedback.counts.decoded as f64 / seconds / 1e6);
    assert!(feedback.counts.decoded as f64 / seconds > 30_400.0, "ten times what an arm sends");
}
