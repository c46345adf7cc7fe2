use proptest::prelude::*;

use super::commands::Command;
use super::frame::{Arrived, PRIVATE, Response, Status, WATCHED, scan};
use super::gripper::{GripperKind, Rtu, decode_position};
use super::identity::{Firmware, decode_version};
use super::report::{self, Health, Kind, Motion, Motors};
use crate::xarm::golden::{self, DEGREES, POSE, TORQUES, VELOCITIES, WRENCH, bytes};
use dimos_hardware::transport::tcp::Scan;

fn near(a: &[f64], b: &[f64]) -> bool {
    a.len() == b.len() && a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-6)
}

#[test]
fn requests_are_the_golden_bytes() {
    let joints = DEGREES.map(f64::to_radians);
    let velocities = [1.5, 0.0, 0.0, 0.0, 0.0, -0.5, 0.0];
    for (command, transaction, protocol, golden) in [
        (Command::Version, 1, PRIVATE, golden::VERSION),
        (Command::Enable(true), 2, WATCHED, golden::ENABLE),
        (Command::SetMode { mode: 1, detect: true }, 3, WATCHED, golden::SET_MODE),
        (Command::SetMode { mode: 1, detect: false }, 3, PRIVATE, golden::SET_MODE_OLD),
        (Command::SetState(0), 4, WATCHED, golden::READY),
        (Command::Servo(joints), 5, WATCHED, golden::SERVO),
        (Command::MoveJoints { joints, speed: 0.5, acceleration: 8.0 }, 6, WATCHED, golden::MOVE_JOINTS),
        (Command::MoveLine { pose: POSE, speed: 100.0, acceleration: 2000.0 }, 7, WATCHED, golden::MOVE_LINE),
        (Command::Velocity { joints: velocities, duration: Some(0.2) }, 8, WATCHED, golden::VELOCITY),
        (Command::Tool(Rtu::go(GripperKind::Xarm, 850, 50, None)), 9, WATCHED, golden::GRIPPER_GO),
        (Command::Tool(Rtu::read_position()), 10, WATCHED, golden::GRIPPER_READ),
        (Command::ReadToolBoard(0x0A0B), 11, WATCHED, golden::TOOL_BAUD),
        (Command::SetLoad([1.5, 0.0, -10.0, 80.0]), 12, WATCHED, golden::SET_LOAD),
        (Command::GetError, 65535, WATCHED, golden::GET_ERROR),
    ] {
        assert_eq!(command.encode(transaction, protocol, &mut [0; 64]), bytes(golden), "{command:?}");
    }
    assert_eq!(Rtu::go(GripperKind::XarmG2, 0, 50, None).bytes(), bytes(golden::GRIPPER_G2));
    // Speeds: of the motor [rpm]; of the fingers [mm/s] as the vendor's SDK converts 225, and 15 where less is asked.
    assert_eq!(Rtu::speed(Some(0.5)).bytes(), bytes("0810030300010209c4"));
    let speed = |fraction| Rtu::go(GripperKind::XarmG2, 0, 50, Some(fraction)).bytes()[9..11].to_vec();
    assert_eq!((speed(1.0), speed(0.01)), (3765_u16.to_be_bytes().to_vec(), 578_u16.to_be_bytes().to_vec()));
}

fn response(golden: &str, transaction: u16, register: u8) -> Response {
    let frame = bytes(golden);
    for end in 0..frame.len() {
        let part = scan(&frame[..end], WATCHED, |t, r| (t, r) == (transaction, register));
        assert_eq!(part, Scan::More, "{end} bytes");
    }
    match scan(&frame, WATCHED, |t, r| (t, r) == (transaction, register)) {
        Scan::Take(n, Arrived::Response(response)) if n == frame.len() => response,
        other => panic!("{other:?}"),
    }
}

#[test]
fn responses_are_read_from_the_golden_bytes() {
    let version = response(golden::VERSION_REPLY, 1, 1);
    let (identity, firmware) = decode_version(version.data()).unwrap();
    assert_eq!((identity.axes, identity.kind, identity.serial.as_str()), (6, 6, "XI1305"));
    assert_eq!((firmware, version.status.not_ready()), (Firmware([2, 5, 1]), true));
    assert_eq!(response(golden::SERVO_REPLY, 5, 29).status, Status(0));
    assert_eq!(response(golden::MOVE_REPLY, 6, 23).data(), [0, 1]);
    let error = response(golden::ERROR_REPLY, 65535, 15);
    assert_eq!((error.data(), error.status.error(), error.status.warning()), (&[31, 0][..], true, false));
    let gripper = response(golden::GRIPPER_READ_REPLY, 10, 124);
    let data = Rtu::read_position().answered(gripper.data()).unwrap();
    assert_eq!(decode_position(data), Some(425));
    assert_eq!(Rtu::read_error().answered(&[9, 8, 0x83, 2]), None, "the gripper refuses");
    assert!(Rtu::enable().answered(&[9, 8, 16, 1, 0, 0, 1]).is_some());
}

#[test]
fn what_answers_nothing_is_skipped() {
    let reply = bytes(golden::SERVO_REPLY);
    assert_eq!(scan(&reply, WATCHED, |_, _| false), Scan::Take(reply.len(), Arrived::Stray));
    let noise = bytes("00ff6e000200000000");
    let whole: Vec<u8> = noise.iter().chain(&reply).copied().collect();
    let (mut at, asked) = (0, |t, r| (t, r) == (5, 29));
    while let Scan::Skip(n) = scan(&whole[at..], WATCHED, asked) {
        at += n;
    }
    assert!(matches!(scan(&whole[at..], WATCHED, asked), Scan::Take(8, Arrived::Response(_))), "at {at}");
}

#[test]
fn reports_are_read_from_the_golden_bytes() {
    let q = DEGREES.map(f64::to_radians);
    let motion = Motion::decode_full(&golden::full()).unwrap();
    assert_eq!((motion.time_us, motion.state, motion.mode), (Some(123_456_789), 1, 1));
    assert!(near(&motion.position, &q) && near(&motion.velocity.unwrap(), &VELOCITIES));
    assert!(near(&motion.torque, &TORQUES) && near(&motion.pose, &POSE) && near(&motion.wrench.unwrap(), &WRENCH));
    let motion = Motion::decode_real(&golden::real()).unwrap();
    assert_eq!((motion.time_us, motion.state, motion.mode, motion.velocity), (None, 1, 4, None));
    assert!(near(&motion.position, &q) && near(&motion.torque, &TORQUES) && near(&motion.pose, &POSE));
    assert_eq!(Motion::decode_real(&golden::real()[..87]).unwrap().wrench, None, "an old firmware");
    let health = Health::decode(&golden::normal()).unwrap();
    assert_eq!(health, Health { enabled: 0x3F, error: 31, warning: 11, ..health });
}

#[test]
fn a_rich_report_adds_the_motors_as_far_as_the_firmware_has_them() {
    let mut rich = golden::normal();
    assert_eq!(Health::decode(&rich).unwrap().motors, None);
    rich.resize(252, 0);
    rich[115..119].copy_from_slice(&1.5_f32.to_le_bytes());
    rich[127..131].copy_from_slice(&80.0_f32.to_le_bytes());
    rich[245..252].copy_from_slice(&[31, 32, 33, 34, 35, 36, 0xF6]);
    let health = Health::decode(&rich).unwrap();
    let temperature = [31, 32, 33, 34, 35, 36, -10];
    assert_eq!((health.load[0], health.load[3]), (1.5, 80.0));
    assert_eq!(health.motors, Some(Motors { temperature, voltage: None, current: None }), "an older firmware");
    rich.resize(587, 0);
    rich[341..343].copy_from_slice(&4812_u16.to_be_bytes());
    rich[353..355].copy_from_slice(&4790_u16.to_be_bytes());
    rich[355..359].copy_from_slice(&(-0.5_f32).to_le_bytes());
    let motors = Health::decode(&rich).unwrap().motors.unwrap();
    assert_eq!(motors.voltage, Some([48.12, 0.0, 0.0, 0.0, 0.0, 0.0, 47.9]));
    assert_eq!(motors.current.map(|current| current[0]), Some(-0.5));
}

#[test]
fn a_full_report_may_be_as_short_as_the_vendors_page_has_it() {
    let short = golden::full_784();
    let Scan::Take(784, (784, motion)) = report::scan(&short, Kind::Full, None, Motion::decode_full) else {
        panic!("784 bytes are a report")
    };
    assert_eq!(Some(motion), Motion::decode_full(&golden::full()), "the last 20 bytes are not read");
    let cut = [&735_u32.to_be_bytes()[..], &short[4..735]].concat();
    assert_eq!(report::scan(&cut, Kind::Full, None, Motion::decode_full), Scan::Skip(1), "the wrench is missing");
}

#[test]
fn damaged_reports_are_skipped_up_to_the_next() {
    let good = golden::full();
    let decode = Motion::decode_full;
    assert_eq!(report::scan(&good[..803], Kind::Full, None, decode), Scan::More);
    assert!(matches!(report::scan(&good, Kind::Full, None, decode), Scan::Take(804, _)));
    assert_eq!(report::scan(&good, Kind::Full, Some(900), decode), Scan::Skip(1), "the length never changes");
    assert_eq!(report::scan(&golden::real(), Kind::Full, None, decode), Scan::Skip(1), "another report");
    let mut nan = good.clone();
    nan[116..120].copy_from_slice(&f32::NAN.to_le_bytes());
    let mut far = good.clone();
    far[116..120].copy_from_slice(&100_f32.to_le_bytes());
    for damaged in [nan, far] {
        assert_eq!(report::scan(&damaged, Kind::Full, Some(804), decode), Scan::Skip(1));
    }
    let cut: Vec<u8> = [&good[..402], &good, &good].concat();
    let (mut at, mut found) = (0, 0);
    loop {
        match report::scan(&cut[at..], Kind::Full, Some(804), decode) {
            Scan::Skip(n) => at += n,
            Scan::Take(n, _) => (at, found) = (at + n, found + 1),
            Scan::More => break,
        }
        if at >= cut.len() {
            break;
        }
    }
    assert!((1..=2).contains(&found), "at most one good report is lost with the cut one: {found}");
}

#[test]
fn pulses_are_what_the_page_says() {
    let (g1, g2) = (GripperKind::Xarm, GripperKind::XarmG2);
    assert_eq!((g1.pulses(0.0), g1.pulses(0.04), g1.pulses(0.085)), (0, 400, 850));
    assert_eq!((g2.pulses(0.0), g2.pulses(0.016), g2.pulses(0.04), g2.pulses(0.084)), (0, 152, 383, 850));
    for kind in [g1, g2] {
        for opening in [0.0, 0.01, 0.05, 0.084] {
            assert!((kind.opening(kind.pulses(opening)) - opening).abs() < 1e-4, "{kind:?} {opening}");
        }
    }
}

#[test]
fn versions_are_compared_as_versions() {
    let parse = |text| Firmware::parse(text).unwrap();
    assert!(parse("v1.12.10").at_least(1, 8, 6) && !parse("1.12.10").at_least(2, 1, 0));
    assert!(parse("2.10.0-beta").at_least(2, 9, 9));
    assert_eq!(Firmware::parse("x"), None);
    assert_eq!(decode_version(b"HTTP/1.1 400"), None);
}

proptest! {
    #[test]
    fn no_bytes_make_a_decoder_panic(noise in proptest::collection::vec(any::<u8>(), 0..1200), head in 0..3usize) {
        let heads: [&[u8]; 3] = [&[], &[0, 5, 0, 3, 0, 40], &[0, 0, 3, 0x24]];
        let data = [heads[head], &noise].concat();
        if let Scan::Skip(n) | Scan::Take(n, _) = scan(&data, WATCHED, |_, _| true) {
            prop_assert!(n >= 1 && n <= data.len());
        }
        if let Scan::Skip(n) | Scan::Take(n, _) = report::scan(&data, Kind::Full, None, Motion::decode_full) {
            prop_assert!(n >= 1 && n <= data.len());
        }
        let _ = (Motion::decode_real(&data), Health::decode(&data), decode_version(&data));
        let _ = Rtu::read_position().answered(&data).and_then(decode_position);
    }
}
