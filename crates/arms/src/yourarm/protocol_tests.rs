use super::*;
use crate::yourarm::frame::{Reply, Status, scan};
use crate::yourarm::golden::{self, JOINTS, POSE, bytes};
use dimos_hardware::transport::tcp::Scan;
use proptest::prelude::*;

const VELOCITIES: WireJoints = [1.0, -2.0, 3.0, -4.0, 5.0, -6.0];

#[test]
fn setpoints_have_what_they_command_and_nothing_else() {
    let bare = Setpoint {
        time_us: 1,
        valid_ms: 0,
        joints: [JOINTS, VELOCITIES],
        acceleration: None,
        torque: None,
        gains: None,
    };
    let full = Setpoint {
        time_us: 123_456_789,
        valid_ms: 40,
        acceleration: Some([0.5, -0.5, 1.0, -1.0, 2.0, -2.0]),
        torque: Some([8.0, -7.0, 6.0, -5.0, 4.0, -3.0]),
        gains: Some([[100.0, 90.0, 80.0, 70.0, 60.0, 50.0], [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]]),
        ..bare
    };
    let mut frame = [0; MAX_FRAME];
    assert_eq!(encode(&Command::Setpoint(full), 23, &mut frame), bytes(golden::SETPOINT));
    assert_eq!(encode(&Command::Setpoint(bare), 24, &mut frame), bytes(golden::SETPOINT_BARE));
    assert_eq!(encode(&Command::SetMode(Mode::Impedance), 25, &mut frame), bytes(golden::SET_MODE_IMPEDANCE));
}

#[test]
fn commands_are_the_golden_bytes() {
    let mut frame = [0; MAX_FRAME];
    for (command, sequence, golden) in [
        (Command::Hello, 1, golden::HELLO),
        (Command::GetState, 21, golden::GET_STATE_AND_FORCE),
        (Command::SetMode(Mode::Servo), 3, golden::SET_MODE),
        (Command::Enable(true), 4, golden::ENABLE),
        (Command::ClearError, 5, golden::CLEAR_ERROR),
        (Command::Stop, 0xFFFE, golden::STOP),
        (Command::MoveJoints { speed: 25.0, joints: JOINTS }, 7, golden::MOVE_JOINTS),
        (Command::ServoJoints(JOINTS), 8, golden::SERVO_JOINTS),
        (Command::VelocityJoints([1.5, 0.0, 0.0, 0.0, 0.0, -90.0]), 9, golden::VELOCITY_JOINTS),
        (Command::MoveCartesian { speed: 50.0, pose: POSE }, 10, golden::MOVE_CARTESIAN),
        (Command::Gripper(42.5), 11, golden::GRIPPER),
        (Command::Grip(42.5, 12.5), 22, golden::GRIP),
        (Command::SetPayload(golden::LOAD), 15, golden::SET_PAYLOAD),
        (Command::GetPayload, 16, golden::GET_PAYLOAD),
        (Command::SetMounting([0.0, 0.0, 1.0]), 17, golden::SET_MOUNTING),
        (Command::GetMounting, 18, golden::GET_MOUNTING),
        (Command::GetJointStatus, 19, golden::GET_JOINT_STATUS),
        (Command::GetOffsets, 20, golden::GET_OFFSETS),
        (Command::GetIo, 12, golden::GET_IO),
        (Command::SetDigital(3, true), 13, golden::SET_DIGITAL),
        (Command::SetAnalog(1, 2.5), 14, golden::SET_ANALOG),
    ] {
        assert_eq!(encode(&command, sequence, &mut frame), bytes(golden), "{}", command.name());
    }
}

#[test]
fn replies_are_read_from_the_golden_bytes() {
    let reply = bytes(golden::HELLO_REPLY);
    let Scan::Take(length, reply_to_hello) = scan(&reply, 0x01, 1) else { panic!("no reply") };
    let serial = "YA6-00042".to_owned();
    let hello = Hello { model: MODEL.into(), dof: 6, firmware: [2, 1, 3], serial };
    assert_eq!((length, Hello::decode(reply_to_hello.data)), (reply.len(), Some(hello)));

    let reply = bytes(golden::STATE_AND_FORCE_REPLY);
    let Scan::Take(_, state) = scan(&reply, 0x02, 21) else { panic!("no reply") };
    let expected = State {
        time_us: 123_456_789,
        state: 2,
        mode: Mode::Servo,
        enabled: true,
        gripper_fitted: true,
        error: 0,
        positions: JOINTS,
        velocities: [1.0, -2.0, 3.0, -4.0, 5.0, -6.0],
        torques: [0.5, -0.5, 1.0, -1.0, 2.0, -2.0],
        gripper: 42.5,
        pose: POSE,
        gripper_force: 12.25,
    };
    assert_eq!((State::decode(state.data), State::decode(&state.data[..114])), (Some(expected), None));

    let reply = bytes(golden::IN_ERROR_REPLY);
    let Scan::Take(_, refusal) = scan(&reply, 0x11, 8) else { panic!("no reply") };
    assert_eq!((refusal.status, decode_refusal(refusal.data)), (Status::Refused(IN_ERROR), Some(2)));
    let reply = bytes(golden::IO_REPLY);
    let Scan::Take(_, io) = scan(&reply, 0x30, 12) else { panic!("no reply") };
    let expected =
        Io { digital_inputs: 0xFD, digital_outputs: 8, analog_inputs: [1.5, -0.25], analog_outputs: [0.0, 2.5] };
    assert_eq!((Io::decode(io.data), Io::decode(&io.data[1..])), (Some(expected), None));
    let reply = bytes(golden::PAYLOAD_REPLY);
    let Scan::Take(_, load) = scan(&reply, 0x22, 16) else { panic!("no reply") };
    let decoded = decode_floats::<10>(load.data).unwrap();
    assert!(decoded.iter().zip(golden::LOAD).all(|(a, b)| (a - b).abs() < 1e-8), "{decoded:?}");
    assert_eq!(decode_floats::<9>(load.data), None);
    let reply = bytes(golden::MOUNTING_REPLY);
    let Scan::Take(_, gravity) = scan(&reply, 0x24, 18) else { panic!("no reply") };
    assert_eq!(decode_floats(gravity.data), Some([0.0, 0.0, -1.0]));
    let reply = bytes(golden::JOINT_STATUS_REPLY);
    let Scan::Take(_, drives) = scan(&reply, 0x40, 19) else { panic!("no reply") };
    let expected: Vec<Drive> = (0..6)
        .map(|i| Drive {
            temperature: 30.5 + f64::from(i),
            current: 0.25 * f64::from(i),
            voltage: 48.0,
            load: if i == 2 { -12.5 } else { 5.0 },
            error: if i == 5 { 7 } else { 0 },
        })
        .collect();
    assert_eq!(decode_drives(drives.data).unwrap().to_vec(), expected);
    assert_eq!(decode_drives(&drives.data[1..]), None);
    let reply = bytes(golden::OFFSETS_REPLY);
    let Scan::Take(_, offsets) = scan(&reply, 0x41, 20) else { panic!("no reply") };
    assert_eq!(decode_floats(offsets.data), Some(golden::OFFSETS));
    let reply = bytes(golden::NO_CHANNEL_REPLY);
    let Scan::Take(_, refusal) = scan(&reply, 0x31, 13) else { panic!("no reply") };
    assert_eq!((refusal.status, status_text(10)), (Status::Refused(10), "there is no such channel"));
    let reply = bytes(golden::STOP_REPLY);
    assert_eq!(scan(&reply, 0x06, 0xFFFE), Scan::Take(11, Reply { status: Status::Ok, data: &[] }));
}

#[test]
fn noise_damage_and_foreign_replies_are_skipped() {
    let good = bytes(golden::STOP_REPLY);
    assert_eq!(scan(&good, 0x06, 1), Scan::Skip(good.len()), "another sequence number");
    assert_eq!(scan(&good, 0x05, 0xFFFE), Scan::Skip(good.len()), "another command");
    assert_eq!(scan(b"noiseYA", 0x06, 0xFFFE), Scan::Skip(5));
    assert_eq!(scan(b"Y", 0x06, 0xFFFE), Scan::More);
    for i in 0..good.len() {
        assert_eq!(scan(&good[..i], 0x06, 0xFFFE), Scan::More, "{i} bytes of a frame");
        let mut damaged = good.clone();
        damaged[i] ^= 0x10;
        assert!(!matches!(scan(&damaged, 0x06, 0xFFFE), Scan::Take(..)), "byte {i} damaged");
    }
}

#[test]
fn a_state_that_is_not_finite_or_has_other_joints_is_refused() {
    let mut data = bytes(golden::STATE_AND_FORCE_REPLY)[9..127].to_vec();
    assert!(State::decode(&data).is_some());
    assert!(State::decode(&data[..117]).is_none());
    data[11] = 7;
    assert!(State::decode(&data).is_none(), "7 joints");
    data[11] = 6;
    data[14..18].copy_from_slice(&f32::NAN.to_le_bytes());
    assert!(State::decode(&data).is_none(), "NaN");
}

proptest! {
    #[test]
    fn no_bytes_make_a_decoder_panic(noise in proptest::collection::vec(any::<u8>(), 0..300), magic: bool) {
        let mut data = if magic { vec![b'Y', b'A', 1, 0x86] } else { vec![] };
        data.extend(noise);
        match scan(&data, 0x06, 1) {
            Scan::More => prop_assert!(data.is_empty() || data[0] == b'Y'),
            Scan::Skip(n) | Scan::Take(n, _) => prop_assert!(n >= 1 && n <= data.len()),
        }
        let _ = (Hello::decode(&data), State::decode(&data), Io::decode(&data), decode_drives(&data), decode_refusal(&data));
    }
}
