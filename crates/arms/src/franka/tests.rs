//! The adapter against the emulated controller.

use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use serde_json::json;

use super::SPEC;
use super::adapter::FrankaAdapter;
use super::emulator::{Datagram, FrankaEmulator};
use super::protocol::DOF;
use dimos_core::arm::{Load, StopPoint};
use dimos_core::joint::ControlMode;
use dimos_hardware::adapter::{AdapterError, Cartesian, Gripper, JointReading, ManipulatorAdapter, Payload, Stop};
use dimos_hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};
use dimos_hardware::sim::faults::{Fault, FaultKind};

/// An adapter and its controller, which waits for late commands: the computer of a test may be busy.
fn arm(mut options: serde_json::Value) -> (FrankaAdapter, FrankaEmulator) {
    let sim = options.as_object_mut().unwrap().entry("sim").or_insert(json!({}));
    sim.as_object_mut().unwrap().entry("command_wait").or_insert(json!(0.1));
    let mut config = AdapterConfig { hardware_id: "arm".into(), address: String::new(), dof: DOF, options };
    let emulator = FrankaEmulator::start(&config, &EmulatorAddress::InProcess).unwrap();
    config.address = emulator.address();
    (FrankaAdapter::new(&config).unwrap(), emulator)
}

/// One that is connected and enabled.
fn ready(options: serde_json::Value) -> (FrankaAdapter, FrankaEmulator) {
    let (mut adapter, emulator) = arm(options);
    adapter.connect().unwrap();
    adapter.activate().unwrap();
    (adapter, emulator)
}

/// Waits for the next state, as the device thread does. Returns false after 50 ms without one.
fn next(adapter: &mut FrankaAdapter) -> bool {
    let timeout = Timespec { tv_sec: 0, tv_nsec: 50_000_000 };
    let came = poll(&mut [PollFd::from_borrowed_fd(adapter.state_fd().unwrap(), PollFlags::IN)], Some(&timeout));
    let _ = adapter.read_joints(&mut JointReading::default());
    came.is_ok_and(|ready| ready > 0)
}

fn until(adapter: &mut FrankaAdapter, mut done: impl FnMut(&mut FrankaAdapter) -> bool) {
    let began = Instant::now();
    while !done(adapter) {
        assert!(began.elapsed() < Duration::from_secs(10));
        next(adapter);
    }
}

/// Passes time of the controller's clock.
fn pass(adapter: &mut FrankaAdapter, time: Duration) {
    let cycle = |adapter: &FrankaAdapter| adapter.session.as_ref().unwrap().state.id;
    let end = cycle(adapter) + time.as_millis() as u64;
    until(adapter, |adapter| cycle(adapter) >= end);
}

fn positions(adapter: &mut FrankaAdapter) -> [f64; DOF] {
    let mut positions = [0.0; DOF];
    adapter.read_joint_positions(&mut positions).unwrap();
    positions
}

fn pass_states(adapter: &mut FrankaAdapter, count: usize) {
    for _ in 0..count {
        next(adapter);
    }
}

/// A smooth way from 0 to 1 in time from 0 to 1.
fn ease(t: f64) -> f64 {
    let t = t.clamp(0.0, 1.0);
    t * t * t * (10.0 + t * (6.0 * t - 15.0))
}

/// Moves all joints by `way` [rad], with a setpoint after every `every`-th state.
fn stream(adapter: &mut FrankaAdapter, way: f64, every: usize, seconds: f64) -> [f64; DOF] {
    let start = positions(adapter);
    let steps = (seconds * 1000.0 / every as f64) as usize;
    let at = |i: usize| start.map(|q| q + way * ease(i as f64 / steps as f64));
    for i in 0..steps {
        adapter.write_joint_positions(&at(i), 1.0).unwrap();
        pass_states(adapter, every);
    }
    adapter.write_joint_positions(&at(steps), 1.0).unwrap();
    at(steps)
}

fn text(error: AdapterError) -> String {
    error.to_string()
}

#[test]
fn setpoints_at_any_rate_arrive() {
    for model in ["fr3", "fer"] {
        let (mut adapter, emulator) = ready(json!({"model": model}));
        for (every, way) in [(1, 0.3), (2, -0.3), (4, 0.2), (10, -0.2), (33, 0.1)] {
            // As long as it takes to see that setpoints come after every state, or do not.
            let here = positions(&mut adapter);
            for _ in 0..if every == 1 { 100 } else { 20 } {
                adapter.write_joint_positions(&here, 1.0).unwrap();
                pass_states(&mut adapter, every);
            }
            let goal = stream(&mut adapter, way, every, 0.8);
            until(&mut adapter, |adapter| positions(adapter).iter().zip(&goal).all(|(a, b)| (a - b).abs() < 1e-3));
            assert_eq!(adapter.read_error().unwrap(), (0, String::new()), "{model}, every {every}");
        }
        let (figures, (counts, _)) = (emulator.figures(), adapter.link_quality().unwrap());
        println!("{model}: {figures:?} {counts:?}");
        assert!(figures.lost * 10 < figures.moved, "{figures:?}");
        assert_eq!(adapter.deactivate(&StopPoint::default()), Ok(()));
    }
}

#[test]
fn a_setpoint_after_each_state_is_its_answer() {
    let (mut adapter, emulator) = ready(json!({}));
    let here = positions(&mut adapter);
    let write = |adapter: &mut FrankaAdapter| {
        next(adapter);
        adapter.write_joint_positions(&here, 1.0).unwrap();
        adapter.session.as_ref().unwrap().motion.as_ref().unwrap().follower.is_direct()
    };
    let began = Instant::now();
    while !write(&mut adapter) {
        assert!(began.elapsed() < Duration::from_secs(10));
    }
    emulator.record();
    let before = adapter.link_quality().unwrap().0.answers;
    for _ in 0..100 {
        write(&mut adapter);
    }
    let answers = adapter.link_quality().unwrap().0.answers - before;
    // One each, unless the computer was busy.
    assert!((50..=101).contains(&answers), "{answers}");
    std::thread::sleep(Duration::from_millis(5));
    let command = |datagram| match datagram {
        Datagram::Command(bytes) => Some(bytes),
        Datagram::State(_) => None,
    };
    let commands: Vec<Vec<u8>> = emulator.traffic().into_iter().filter_map(command).collect();
    let ids: Vec<&[u8]> = commands.iter().map(|bytes| &bytes[..8]).collect();
    assert!(ids.windows(2).all(|pair| pair[0] != pair[1]), "no state is answered twice");
    assert!(commands.iter().all(|bytes| bytes.len() == 371));
}

#[test]
fn enabling_holds_and_a_stop_ends_it() {
    let (mut adapter, emulator) = ready(json!({}));
    let start = positions(&mut adapter);
    pass(&mut adapter, Duration::from_millis(300));
    assert!(positions(&mut adapter).iter().zip(&start).all(|(a, b)| (a - b).abs() < 1e-6));
    assert!(adapter.read_enabled().unwrap());
    stream(&mut adapter, 0.1, 1, 0.3);
    assert_eq!(adapter.write_stop(&StopPoint::default()), Ok(Stop::Confirmed));
    assert!(adapter.read_enabled().unwrap(), "still enabled");
    let here = positions(&mut adapter);
    let refused = adapter.write_joint_positions(&here, 1.0).map_err(text);
    assert_eq!(refused, Err("the arm was stopped: enable it again".into()));
    assert_eq!(adapter.foreign_change(), None);
    let moved = emulator.figures().moved;
    pass(&mut adapter, Duration::from_millis(50));
    assert_eq!(emulator.figures().moved, moved, "no motion runs");
    adapter.activate().unwrap();
    stream(&mut adapter, -0.1, 1, 0.5);
    adapter.write_enable(false).unwrap();
    assert!(!adapter.read_enabled().unwrap());
    let refused = adapter.write_joint_positions(&here, 1.0).map_err(text);
    assert_eq!(refused, Err("the arm is disabled".into()));
}

#[test]
fn velocities_are_kept_and_end_on_their_own() {
    let (mut adapter, _emulator) = ready(json!({}));
    adapter.set_control_mode(ControlMode::Velocity).unwrap();
    let start = positions(&mut adapter);
    for i in 0..300 {
        adapter.write_joint_velocities(&[0.002 * f64::from(i.min(100)), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]).unwrap();
        next(&mut adapter);
    }
    let mut velocities = [0.0; DOF];
    adapter.read_joint_velocities(&mut velocities).unwrap();
    assert!((velocities[0] - 0.2).abs() < 0.02, "{velocities:?}");
    pass(&mut adapter, Duration::from_millis(500));
    adapter.read_joint_velocities(&mut velocities).unwrap();
    assert!(velocities[0].abs() < 1e-3, "{velocities:?}");
    assert!(positions(&mut adapter)[0] > start[0] + 0.04);
    let refused = text(adapter.write_joint_positions(&start, 1.0).unwrap_err());
    assert_eq!(refused, "the arm is in velocity mode");
    adapter.set_control_mode(ControlMode::ServoPosition).unwrap();
    stream(&mut adapter, -0.05, 1, 0.4);
}

#[test]
fn a_reflex_is_reported_and_cleared_without_a_motion() {
    let options = json!({"collision_torques": [30, 30, 30, 30, 15, 15, 15], "collision_forces": [40, 40, 40, 9, 9, 9],
        "joint_impedance": [2000, 2000, 2000, 2000, 1500, 1500, 1500]});
    let (mut adapter, emulator) = ready(options);
    let (stiffness, thresholds) = emulator.settings();
    assert_eq!((stiffness[0], stiffness[6], thresholds[0]), (2000.0, 1500.0, 30.0));
    emulator.push([25.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    stream(&mut adapter, 0.05, 1, 0.3);
    emulator.push([31.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    until(&mut adapter, |adapter| adapter.read_error().unwrap().0 != 0);
    let (code, what) = adapter.read_error().unwrap();
    assert!(code == 7 && what.starts_with("joint_reflex"), "{code} {what}");
    assert_eq!(adapter.foreign_change(), None, "the arm itself is the cause");
    let here = positions(&mut adapter);
    assert!(matches!(adapter.write_joint_positions(&here, 1.0), Err(AdapterError::Fault { code: 7, .. })));
    assert!(matches!(adapter.activate(), Err(AdapterError::Fault { .. })));
    emulator.push([0.0; DOF]);
    pass(&mut adapter, Duration::from_millis(100));
    let here = positions(&mut adapter);
    adapter.write_clear_errors().unwrap();
    assert_eq!(adapter.read_error().unwrap(), (0, String::new()));
    pass(&mut adapter, Duration::from_millis(100));
    assert!(positions(&mut adapter).iter().zip(&here).all(|(a, b)| (a - b).abs() < 1e-4), "nothing moved");
    assert!(adapter.write_joint_positions(&here, 1.0).is_err(), "it must be enabled again");
    adapter.activate().unwrap();
    stream(&mut adapter, 0.05, 1, 0.3);
}

#[test]
fn the_user_stop_and_guiding_are_reported_and_not_undone() {
    let (mut adapter, emulator) = ready(json!({}));
    emulator.user_stop(true);
    until(&mut adapter, |adapter| adapter.read_error().unwrap().0 != 0);
    assert_eq!(adapter.read_error().unwrap().1, "the user stop is pressed");
    let refused = text(adapter.write_clear_errors().unwrap_err());
    assert!(refused.contains("\nhint: release the button"), "{refused}");
    emulator.user_stop(false);
    until(&mut adapter, |adapter| adapter.read_error().unwrap().0 == 0);
    assert!(!adapter.read_enabled().unwrap());
    adapter.activate().unwrap();
    emulator.guide(true);
    until(&mut adapter, |adapter| adapter.foreign_change().is_some());
    assert!(adapter.foreign_change().unwrap().contains("guided by hand"));
    let refused = text(adapter.activate().unwrap_err());
    assert!(refused.contains("\nhint: release its guiding button"), "{refused}");
    emulator.guide(false);
    until(&mut adapter, |adapter| adapter.activate().is_ok());
    assert_eq!(adapter.foreign_change(), None);
}

#[test]
fn without_answers_the_controller_ends_the_motion() {
    let (mut adapter, emulator) = ready(json!({"sim": {"command_wait": 0.0}}));
    pass(&mut adapter, Duration::from_millis(50));
    // As if this process hung.
    std::thread::sleep(Duration::from_millis(100));
    until(&mut adapter, |adapter| adapter.read_error().unwrap().0 != 0);
    let (code, what) = adapter.read_error().unwrap();
    assert!(code == 26 && what.starts_with("communication_constraints_violation"), "{code} {what}");
    assert_eq!(emulator.figures().longest_loss, 20);
    adapter.write_clear_errors().unwrap();
    adapter.activate().unwrap();
}

#[test]
fn a_network_that_loses_repeats_and_reorders_is_survived() {
    let (mut adapter, emulator) =
        ready(json!({"sim": {"lose": 0.05, "repeat": 0.05, "reorder": 0.05, "drift": 200.0}}));
    for (way, every) in [(0.2, 1), (-0.2, 10)] {
        let goal = stream(&mut adapter, way, every, 1.0);
        until(&mut adapter, |adapter| positions(adapter).iter().zip(&goal).all(|(a, b)| (a - b).abs() < 1e-3));
    }
    assert_eq!(adapter.read_error().unwrap(), (0, String::new()));
    let (counts, success) = adapter.link_quality().unwrap();
    assert!(counts.lost_answers + counts.unanswered > 20, "{counts:?}");
    assert!(success < 1.0 && success > 0.5, "{success}");
    assert!(emulator.figures().lost > 20);
}

#[test]
fn the_load_is_set_between_motions() {
    let (mut adapter, _emulator) = ready(json!({}));
    let load = Load { mass: 1.5, center: [0.0, 0.01, 0.05], inertia: [0.01, 0.001, 0.002, 0.02, 0.003, 0.03] };
    adapter.write_payload(&load).unwrap();
    let found = adapter.read_payload().unwrap().unwrap();
    assert!(load.agrees_with(&found) && (found.inertia[4] - 0.003).abs() < 1e-6, "{found:?}");
    stream(&mut adapter, 0.05, 1, 0.3);
    let heavy = Load { mass: 30.0, ..load };
    assert_eq!(text(adapter.write_payload(&heavy).unwrap_err()), "the controller refuses SetLoad: invalid argument");
    assert_eq!(adapter.read_error().unwrap().0, 0);
}

/// What the payload of a blueprint is: tool and workpiece together.
#[test]
fn the_end_effector_of_desk_does_not_count_twice() {
    let (mut adapter, _emulator) = ready(json!({"sim": {"hand_in_desk": true}}));
    let hand = adapter.read_payload().unwrap().unwrap();
    assert!((hand.mass - 0.73).abs() < 1e-6 && (hand.center[2] - 0.03).abs() < 1e-6, "{hand:?}");
    let workpiece = Load { mass: 0.5, center: [0.0, 0.02, 0.12], inertia: [1e-3, 0.0, 0.0, 1e-3, 0.0, 1e-3] };
    for all in [hand.plus(&workpiece), Load { inertia: [0.0; 6], ..hand.plus(&workpiece) }, hand] {
        adapter.write_payload(&all).unwrap();
        let (found, set) = (adapter.read_payload().unwrap().unwrap(), adapter.session.as_ref().unwrap().state.load);
        assert!(all.agrees_with(&found), "{found:?} instead of {all:?}");
        assert!((set.mass - (all.mass - 0.73)).abs() < 1e-6, "SetLoad got {set:?}");
    }
    let refused = text(adapter.write_payload(&workpiece).unwrap_err());
    assert!(refused.contains("already counts 0.730 kg") && refused.contains("\nhint: "), "{refused}");
}

#[test]
fn the_hand_moves_grasps_and_must_be_homed() {
    let (mut adapter, emulator) = ready(json!({"gripper": true}));
    until(&mut adapter, |adapter| adapter.read_gripper_position().unwrap() == Some(0.04));
    adapter.write_gripper_position(0.06).unwrap();
    until(&mut adapter, |adapter| adapter.read_gripper_position().unwrap() == Some(0.06));
    emulator.place_object(Some(0.03));
    adapter.write_gripper_position(0.0).unwrap();
    until(&mut adapter, |adapter| adapter.read_gripper_position().unwrap() == Some(0.03));
    assert!(text(adapter.write_gripper_position(0.2).unwrap_err()).contains("opens 0 to 0.080 m"));
    assert!(text(adapter.write_gripper_position_with_force(0.01, 71.0).unwrap_err()).contains("1 to 70 N"));
    adapter.write_gripper_position(0.05).unwrap();
    until(&mut adapter, |adapter| adapter.read_gripper_position().unwrap() == Some(0.05));
    adapter.write_gripper_position_with_force(0.01, 30.0).unwrap();
    until(&mut adapter, |adapter| adapter.read_gripper_position().unwrap() == Some(0.03));
    emulator.set_homed(false);
    let homed = |adapter: &mut FrankaAdapter| adapter.write_gripper_position(0.05);
    until(&mut adapter, |adapter| homed(adapter).is_err());
    assert!(text(homed(&mut adapter).unwrap_err()).contains("\nhint: home it"));
}

#[test]
fn another_arm_is_refused_and_named() {
    let config = |model: &str, address: String| AdapterConfig {
        hardware_id: "arm".into(),
        address,
        dof: DOF,
        options: json!({"model": model}),
    };
    let emulator = FrankaEmulator::start(&config("fr3", String::new()), &EmulatorAddress::InProcess).unwrap();
    let mut adapter = FrankaAdapter::new(&config("fer", emulator.address())).unwrap();
    let refused = text(adapter.connect().unwrap_err());
    assert!(refused.contains("the model FER has version 5") && refused.contains("has version 10"), "{refused}");
    emulator.inject(Fault::new(FaultKind::WrongModel)).unwrap();
    std::thread::sleep(Duration::from_millis(20));
    let mut adapter = FrankaAdapter::new(&config("fr3", emulator.address())).unwrap();
    let refused = text(adapter.connect().unwrap_err());
    assert!(refused.contains("expected the model FR3, found fp3"), "{refused}");
}

#[test]
fn identity_pose_and_limits() {
    let (mut adapter, _emulator) = ready(json!({"full_range": true}));
    let limits = adapter.get_limits().unwrap();
    // 36 mrad before its end joint 1 may not move towards it; 95 % of the published speed.
    assert!((limits.position_upper[0] - 2.8444).abs() < 1e-4 && (limits.velocity_max[4] - 4.997).abs() < 1e-3);
    let pose = adapter.read_cartesian_position().unwrap().unwrap().tcp;
    assert!((0.3..1.2).contains(&pose.xyz.iter().map(|v| v * v).sum::<f64>().sqrt()), "{pose:?}");
    assert_eq!(adapter.get_info().firmware_version.as_deref(), Some("FCI 10"));
    let mut reading = JointReading::default();
    next(&mut adapter);
    adapter.read_joints(&mut reading).unwrap();
    assert_eq!(reading.device_ns.unwrap() % 1_000_000, 0);
    let far = positions(&mut adapter).map(|q| q + 0.5);
    assert!(text(adapter.write_joint_positions(&far, 1.0).unwrap_err()).contains("is farther than 0.3 rad"));
    let config = |options| AdapterConfig { hardware_id: "arm".into(), address: "127.0.0.1".into(), dof: DOF, options };
    for (options, named) in [
        (json!({"cutoff_frequency": 0}), "cutoff_frequency"),
        (json!({"joint_impedance": [1, 2]}), "joint_impedance"),
        (json!({"collision_torques": [9, 9, 9, 9, 9, 9, 9]}), "collision_forces"),
        (json!({"sim": {"lose": 2}}), "sim.lose"),
    ] {
        assert_eq!((SPEC.check)(&config(options)).unwrap_err().option, named);
    }
}

#[test]
fn the_flange_is_where_it_is_whatever_end_effector_is_set() {
    for (model, tolerance) in [("fr3", 1e-5), ("fer", 1e-9)] {
        let (mut plain, _emulator) = ready(json!({"model": model}));
        let flange = plain.read_cartesian_position().unwrap().unwrap().flange().unwrap();
        let hand = [0.0, 0.0, 0.1034, 0.0, 0.0, -0.785];
        let (mut adapter, emulator) = arm(json!({"model": model, "sim": {"end_effector": hand}}));
        adapter.connect().unwrap();
        let far = |adapter: &mut FrankaAdapter| {
            let stated = adapter.read_cartesian_position().unwrap().unwrap();
            let of =
                |pose: dimos_core::arm::Pose| (pose.isometry().inverse() * flange.isometry()).translation.vector.norm();
            (of(stated.flange().unwrap()), of(stated.tcp))
        };
        let (off, tool) = far(&mut adapter);
        assert!(off < tolerance && (tool - 0.1034).abs() < 1e-5, "{model}: {off} m, tool {tool} m");
        // A client sets its end effector in the frame of the nominal one: SetNEToEE.
        let mut client = std::net::TcpStream::connect(emulator.address()).unwrap();
        let header = [if model == "fer" { 9_u32 } else { 8 }, 77, 12 + 128].map(u32::to_le_bytes).concat();
        let longer = nalgebra::Isometry3::<f64>::translation(0.0, 0.0, 0.05).to_homogeneous();
        let values: Vec<u8> = longer.iter().flat_map(|value| value.to_le_bytes()).collect();
        std::io::Write::write_all(&mut client, &[header, values].concat()).unwrap();
        until(&mut adapter, |adapter| (far(adapter).1 - 0.1534).abs() < 1e-5);
        assert!(far(&mut adapter).0 < tolerance, "{model}: {:?}", far(&mut adapter));
    }
}
