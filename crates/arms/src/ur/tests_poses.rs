//! Poses of flange and tool, and the arm's own kinematics, against the emulated controller.

use nalgebra::Matrix4;
use serde_json::{Value, json};

use super::DOF;
use super::adapter::UrAdapter;
use super::emulator::UrEmulator;
use super::tests::{arm, positions, until};
use dimos_core::arm::ControllerPose;
use dimos_core::arm::test_dh::{FAR_AWAY, product as flange};
use dimos_hardware::adapter::{Cartesian, ManipulatorAdapter};

/// The pose that a controller states, with the joints at which it does.
fn stated(adapter: &mut UrAdapter) -> ([f64; DOF], ControllerPose) {
    (positions(adapter), adapter.read_cartesian_position().unwrap().unwrap())
}

/// How far a pose is from a matrix [m, rad].
fn off(pose: &dimos_core::arm::Pose, matrix: &Matrix4<f64>) -> (f64, f64) {
    let is = pose.isometry().to_homogeneous();
    let far = (0..3).map(|i| (is[(i, 3)] - matrix[(i, 3)]).powi(2)).sum::<f64>().sqrt();
    let trace: f64 = (0..3).flat_map(|i| (0..3).map(move |j| (i, j))).map(|(i, j)| is[(i, j)] * matrix[(i, j)]).sum();
    (far, ((trace - 1.0) / 2.0).clamp(-1.0, 1.0).acos())
}

fn connected(sim: Value) -> (UrAdapter, UrEmulator) {
    let (mut adapter, emulator) = arm(json!({"sim": sim}));
    adapter.connect().unwrap();
    (adapter, emulator)
}

#[test]
fn the_flange_is_where_it_is_whatever_tool_is_set() {
    let nominal = super::model::Model::Ur5e.dh();
    for tool in [[0.0; 6], [0.01, -0.02, 0.17, 0.3, -0.2, 1.0]] {
        let (mut adapter, _emulator) = connected(json!({"tcp_offset": tool}));
        let (q, stated) = stated(&mut adapter);
        let (far, turned) = off(&stated.flange().unwrap(), &flange(&nominal, &q));
        assert!(far < 1e-6 && turned < 1e-6, "{tool:?}: {far} m, {turned} rad");
        let is_at_tool = off(&stated.tcp, &flange(&nominal, &q)).0 > 0.1;
        assert_eq!(is_at_tool, tool[2] > 0.1, "its own pose is that of the tool: {stated:?}");
    }
}

#[test]
fn without_the_tool_offset_the_flange_is_not_known() {
    for (software, known) in [("5.4.0", false), ("5.5.0", false), ("5.5.1", true), ("5.11.6", true)] {
        let (mut adapter, _emulator) = connected(json!({"software": software, "tcp_offset": [0, 0, 0.1, 0, 0, 0]}));
        let (_, stated) = stated(&mut adapter);
        assert_eq!(stated.flange().is_some(), known, "{software}");
        assert_eq!(stated.missing().is_none(), known, "{software}");
    }
}

#[test]
fn a_tool_that_a_program_sets_is_taken_out() {
    use std::io::Write;
    let (mut adapter, emulator) = connected(json!({}));
    let before = stated(&mut adapter).1;
    let address: std::net::SocketAddr = dimos_hardware::registry::Emulator::address(&emulator).parse().unwrap();
    let mut script = std::net::TcpStream::connect((address.ip(), address.port() + 2)).unwrap();
    script.write_all(b"sec set():\n  set_tcp(p[0.0, 0.0, 0.2, 0.0, 0.0, 0.0])\nend\n").unwrap();
    until(&mut adapter, |adapter| stated(adapter).1.tcp != before.tcp);
    let after = stated(&mut adapter).1;
    let moved = after.flange().unwrap().isometry().inverse() * before.flange().unwrap().isometry();
    assert!(moved.translation.vector.norm() < 1e-9, "{moved}");
}

#[test]
fn the_controller_states_its_own_kinematics_and_its_flange_follows_them() {
    let mut small = super::model::Model::Ur5e.dh();
    small.iter_mut().for_each(|dh| (dh.theta, dh.a, dh.d) = (dh.theta + 0.002, dh.a + 0.001, dh.d - 0.001));
    for own in [small, FAR_AWAY] {
        let sim = json!({"kinematics": own, "tcp_offset": [0, 0, 0.1, 0, 0, 0]});
        let (mut adapter, _emulator) = connected(sim);
        let found = adapter.factory_kinematics().unwrap();
        assert_eq!(found.actual.as_deref(), Some(&own[..]), "every bit");
        assert_eq!(found.nominal, super::model::Model::Ur5e.dh());
        assert_eq!(found.checksum.len(), 48);
        let (q, stated) = stated(&mut adapter);
        let (far, turned) = off(&stated.flange().unwrap(), &flange(&own, &q));
        assert!(far < 1e-6 && turned < 1e-6, "{far} m, {turned} rad");
    }
}
