use std::time::Duration;

use super::controller::Controller;
use super::report::{Kind, Snapshot};
use super::wire;
use super::*;
use crate::xarm::golden::{self, DEGREES, POSE, TORQUES, VELOCITIES, WRENCH, bytes};
use dimos_core::clock::Mono;
use dimos_hardware::sim::arm::Delivery;
use dimos_hardware::sim::stream;
use dimos_hardware::transport::tcp::Scan;

pub(super) fn controller() -> Controller<SimArm> {
    Controller::new(Model::Xarm6, [2, 5, 1], GripperKind::Xarm, &SimOptions::default(), Mono(1)).unwrap()
}

/// The response to a golden request, at a time [s].
fn answer(controller: &mut Controller<SimArm>, request: &[u8], at: f64) -> Vec<u8> {
    assert_eq!(wire::scan(&request[..request.len() - 1]), Some(Scan::More));
    assert_eq!(wire::scan(request), Some(Scan::Take(request.len(), ())));
    let mut out = Vec::new();
    controller.handle(&wire::parts(request).unwrap(), false, Mono(1).after(Duration::from_secs_f64(at)), &mut out);
    out
}

/// A request to a register.
pub(super) fn ask(controller: &mut Controller<SimArm>, register: u8, payload: &[u8], at: f64) -> (u8, Vec<u8>) {
    let request = [&[0, 1, 0, 3, 0, payload.len() as u8 + 1, register], payload].concat();
    let reply = answer(controller, &request, at);
    (reply[7], reply[8..].to_vec())
}

/// Motors on, ready in a mode.
pub(super) fn ready(controller: &mut Controller<SimArm>, mode: u8) {
    ask(controller, 11, &[8, 1], 0.0);
    ask(controller, 19, &[mode, 0], 0.0);
    ask(controller, 12, &[0], 0.0);
}

#[test]
fn golden_requests_get_golden_responses() {
    // Near the golden setpoint: a jump to it would be too fast.
    let near = DEGREES.iter().take(6).map(|degrees| (degrees + 1.0).to_radians()).collect();
    let options = SimOptions { initial_positions: near, ..SimOptions::default() };
    let mut arm = Controller::new(Model::Xarm6, [2, 5, 1], GripperKind::Xarm, &options, Mono(1)).unwrap();
    assert_eq!(answer(&mut arm, &bytes(golden::VERSION), 0.0), bytes(golden::VERSION_REPLY));
    answer(&mut arm, &bytes(golden::ENABLE), 0.0);
    assert!(arm.arm.enabled());
    answer(&mut arm, &bytes(golden::SET_MODE), 0.0);
    answer(&mut arm, &bytes(golden::READY), 0.0);
    assert_eq!((arm.mode, arm.reported_state()), (1, 2));
    assert_eq!(answer(&mut arm, &bytes(golden::SERVO), 0.0), bytes(golden::SERVO_REPLY));
    arm.advance(Mono(3_000_000_000));
    let off = arm.seven().iter().zip(DEGREES).map(|(q, d)| (q - d.to_radians()).abs()).fold(0.0, f64::max);
    assert!(off < 1e-6, "it follows the setpoint");
    ready(&mut arm, 0);
    assert_eq!(answer(&mut arm, &bytes(golden::MOVE_JOINTS), 3.0), bytes(golden::MOVE_REPLY));
    ready(&mut arm, 4);
    answer(&mut arm, &bytes(golden::VELOCITY), 4.0);
    arm.advance(Mono(4_150_000_000));
    assert!((arm.arm.joints().1[0] - 1.5).abs() < 0.05, "{:?}", arm.arm.joints().1);
    arm.advance(Mono(5_000_000_000));
    assert_eq!(arm.arm.joints().1, [0.0; 16], "its time is over");
    assert_eq!(answer(&mut arm, &bytes(golden::GRIPPER_READ), 5.0), bytes(golden::GRIPPER_READ_REPLY));
    arm.fail(31);
    assert_eq!(answer(&mut arm, &bytes(golden::GET_ERROR), 5.0), bytes(golden::ERROR_REPLY));
}

#[test]
fn reports_are_the_golden_bytes() {
    let snapshot = Snapshot {
        time_us: 123_456_789,
        state: 1,
        mode: 1,
        queued: 3,
        position: DEGREES.map(|v| v.to_radians() as f32),
        velocity: VELOCITIES.map(|v| v as f32),
        torque: TORQUES.map(|v| v as f32),
        pose: POSE.map(|v| v as f32),
        enabled: 0x3F,
        error: 31,
        warning: 11,
        sensitivity: [3, 4],
        motion: [10_000.0, 50_000.0, 20.0, 20.0],
        wrench: WRENCH.map(|v| v as f32),
        ..Snapshot::default()
    };
    let mut out = Vec::new();
    Kind::Full.write(&snapshot, &mut out);
    out[200..228].fill(0); // currents: the emulator's own affair
    assert_eq!(out, golden::full());
    Kind::Real.write(&Snapshot { mode: 4, ..snapshot }, &mut out);
    assert_eq!(out, golden::real());
    let stopped = Snapshot { state: 4, queued: 0, ..snapshot };
    Kind::Normal.write(&stopped, &mut out);
    assert_eq!(out, golden::normal());
    Kind::Rich.write(&Snapshot { firmware: [2, 5, 1], axes: 6, kind: 6, ..stopped }, &mut out);
    assert_eq!(
        (out.len(), &out[..4], &out[145..149], &out[151..158]),
        (587, &[0, 0, 2, 0x4B][..], &[6, 6, 0xAA, 0x55][..], &b"v2.5.1\0"[..])
    );
    assert_eq!(out[4..145], golden::normal()[4..145], "it begins like the normal one");
}

#[test]
fn a_sign_of_life_is_not_answered_and_what_is_no_request_ends_the_connection() {
    assert_eq!(wire::scan(&bytes("0000000100020000")), Some(Scan::Skip(8)), "the heartbeat of old clients");
    assert_eq!(wire::scan(&[0, 1, 0]), Some(Scan::More));
    for noise in [&b"GET"[..], b"GET / HTTP", &[0, 1, 0, 4], &[0, 1, 0, 2, 0, 0], &[0, 1, 0, 2, 2, 0]] {
        assert_eq!(wire::scan(noise), None, "{noise:?}");
    }
    let mut arm = controller();
    for port in [0, SECOND] {
        let answer = &mut Vec::new();
        let hung_up = stream::Controller::serve_port(&mut arm, port, b"POST", Mono(0), answer);
        assert_eq!((hung_up, answer.len()), (Scan::Take(4, Delivery::HangUp), 0));
    }
}

#[test]
fn modes_and_states_are_those_of_the_sheet() {
    let mut arm = controller();
    assert_eq!((arm.reported_state(), arm.mode), (4, 0), "switched on");
    assert_eq!(ask(&mut arm, 12, &[0], 0.0).0 & 0x10, 0x10, "not ready without motors");
    ask(&mut arm, 11, &[8, 1], 0.0);
    assert_eq!(arm.reported_state(), 5, "a system reset");
    ask(&mut arm, 19, &[1, 0], 0.0);
    ask(&mut arm, 12, &[0], 0.0);
    assert_eq!((arm.mode, ask(&mut arm, 13, &[], 0.0).1), (1, vec![2]), "never 0");
    ask(&mut arm, 19, &[4, 0], 0.0);
    assert_eq!((arm.mode, arm.reported_state()), (0, 5), "silently mode 0");
    ask(&mut arm, 19, &[4, 0], 0.0);
    assert_eq!(arm.mode, 4, "but not from state 5");
    ask(&mut arm, 12, &[0], 0.0);
    ask(&mut arm, 37, &[2], 0.0);
    assert_eq!((arm.mode, arm.reported_state()), (0, 5), "a new sensitivity drops the mode");
    ask(&mut arm, 12, &[4], 0.0);
    assert_eq!(arm.reported_state(), 4);
    ask(&mut arm, 11, &[3, 0], 0.0);
    assert!(!arm.arm.enabled() && arm.motors() == 0b11_1011);
}

#[test]
fn queued_moves_follow_one_another_pause_and_end() {
    let mut arm = controller();
    ready(&mut arm, 0);
    let start = arm.seven();
    let payload = |d: f64| {
        let joints: Vec<f32> = start.iter().take(6).map(|q| (q + d) as f32).chain([0.0, 3.0, 8.0, 0.0]).collect();
        joints.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>()
    };
    assert_eq!(ask(&mut arm, 23, &payload(0.2), 0.0), (0, vec![0, 1]));
    assert_eq!(ask(&mut arm, 23, &payload(-0.1), 0.0), (0, vec![0, 2]));
    arm.advance(Mono(150_000_000));
    assert_eq!((arm.reported_state(), ask(&mut arm, 14, &[], 0.15).1), (1, vec![0, 1]));
    ask(&mut arm, 12, &[3], 0.15);
    arm.advance(Mono(1_000_000_000));
    let paused = arm.seven();
    assert_eq!(arm.reported_state(), 3);
    assert!(arm.arm.joints().1.iter().all(|v| *v == 0.0) && (paused[0] - start[0]).abs() < 0.19);
    ask(&mut arm, 12, &[0], 1.0);
    arm.advance(Mono(4_000_000_000));
    assert!((arm.seven()[0] - (start[0] - 0.1)).abs() < 1e-6, "the second after the first");
    assert_eq!(arm.reported_state(), 2);
    let infinite = f32::INFINITY.to_le_bytes().repeat(5);
    let one = [&0.5_f32.to_le_bytes()[..], &infinite, &[0; 4], &3_f32.to_le_bytes(), &[0; 8]].concat();
    ask(&mut arm, 23, &one, 4.0);
    arm.advance(Mono(8_000_000_000));
    assert!((arm.seven()[0] - 0.5).abs() < 1e-6 && (arm.seven()[1] - (start[1] - 0.1)).abs() < 1e-6);
}

#[test]
fn wrong_requests_raise_what_the_sheet_says() {
    let mut arm = controller();
    ready(&mut arm, 0);
    assert_eq!(ask(&mut arm, 250, &[], 0.0).0, 0x28, "no success for the vendor's client");
    assert_eq!(ask(&mut arm, 15, &[], 0.0).1, [0, 13], "unknown register");
    assert_eq!(ask(&mut arm, 23, &[1, 2, 3], 0.0).0, 0x28);
    assert_eq!(ask(&mut arm, 15, &[], 0.0).1, [0, 12], "bad parameter");
    let far: Vec<u8> =
        [5000_f32, 0.0, 0.0, 0.0, 0.0, 0.0, 100.0, 2000.0, 0.0].iter().flat_map(|v| v.to_le_bytes()).collect();
    ask(&mut arm, 21, &far, 0.0);
    assert_eq!(ask(&mut arm, 15, &[], 0.0).1, [0, 14], "no solution");
    ask(&mut arm, 17, &[], 0.0);
    let beyond: Vec<u8> =
        [9_f32, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 10.0, 0.0].iter().flat_map(|v| v.to_le_bytes()).collect();
    assert_eq!(ask(&mut arm, 23, &beyond, 0.0).0, 0x50);
    assert_eq!(ask(&mut arm, 15, &[], 0.0).1, [23, 0], "beyond a limit");
    ask(&mut arm, 16, &[], 0.0);
    assert_eq!((arm.error(), arm.reported_state()), (0, 5));
    arm.press_estop();
    ask(&mut arm, 16, &[], 0.0);
    assert_eq!((arm.error(), arm.motors()), (1, 0), "not while it is pressed");
    arm.arm.release_estop();
    ask(&mut arm, 16, &[], 0.0);
    ask(&mut arm, 124, &[9, 7, 3, 0, 0, 0, 1], 0.0);
    assert_eq!(arm.error(), 19, "no device with that number at the tool");
}

#[test]
fn wrong_options_are_refused() {
    let start = |options: serde_json::Value, dof| {
        let config = AdapterConfig { hardware_id: "arm".into(), address: String::new(), dof, options };
        XArmEmulator::start(&config, &EmulatorAddress::InProcess).err().map(|e| e.to_string()).unwrap_or_default()
    };
    assert_eq!(start(serde_json::json!({}), 6), "");
    assert!(start(serde_json::json!({"model": "xarm7"}), 6).contains("xArm 7 has 7 joints, not 6"));
    assert!(
        start(serde_json::json!({"sim": {"initial_positions": [0, 0, 9, 0, 0, 0]}}), 6)
            .contains("initial_positions must be 6 positions [rad] within the joint limits: joint 3")
    );
    assert!(start(serde_json::json!({"sim": {"firmware": "new"}}), 6).contains("not a version"));
    assert!(start(serde_json::json!({"sim": {"faults": [{"kind": "panic"}]}}), 6).contains("cannot play"));
    let denied = io::Error::from(io::ErrorKind::PermissionDenied);
    let text = cannot_listen(WHO, "127.0.0.5:502".parse().unwrap(), &denied).to_string();
    assert!(text.contains("\nhint: ") && text.contains("ip_unprivileged_port_start=502"), "{text}");
    let config =
        AdapterConfig { hardware_id: "arm".into(), address: String::new(), dof: 6, options: serde_json::json!({}) };
    let outside = XArmEmulator::start(&config, &EmulatorAddress::Bind("10.0.0.1".parse().unwrap()));
    assert!(outside.err().unwrap().to_string().contains("not a loopback address"));
}
