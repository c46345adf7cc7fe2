//! Reduced mode as the adapter reads it.

use std::io::{Read, Write};
use std::net::TcpStream;

use serde_json::json;

use super::tests::{pair, read, until};
use dimos_hardware::adapter::ManipulatorAdapter;
use dimos_hardware::registry::Emulator;

#[test]
fn what_another_client_sets_narrows_the_limits_and_a_change_shows() {
    let (emulator, mut arm) = pair(6, json!({}));
    let mut client = TcpStream::connect(emulator.address().rsplit_once(':').unwrap().0).unwrap();
    let mut send = |register: u8, payload: &[u8]| {
        let head = [0, 1, 0, 2, 0, payload.len() as u8 + 1, register];
        client.write_all(&[&head[..], payload].concat()).unwrap();
        assert_ne!(client.read(&mut [0; 64]).unwrap(), 0);
    };
    arm.connect().unwrap();
    let own = arm.get_limits().unwrap();
    let reduction = arm.reduction().unwrap();
    assert_eq!((reduction.tool_velocity, reduction.text.as_str()), (None, "reduced mode is off"));
    send(47, &300_f32.to_le_bytes());
    send(48, &0.25_f32.to_le_bytes());
    send(50, &[1]);
    until("the report", || {
        read(&mut arm).unwrap();
        arm.reduction_changed()
    });
    let limits = arm.get_limits().unwrap();
    assert!(!arm.reduction_changed(), "once");
    assert_eq!((limits.velocity_max, &limits.position_upper), (vec![0.25; 6], &own.position_upper));
    let reduction = arm.reduction().unwrap();
    assert!((reduction.tool_velocity.unwrap() - 0.285).abs() < 1e-9, "{reduction:?}");
    let text = "reduced mode is on: joints 0.25 rad/s, tool 0.28 m/s, with its joint ranges";
    assert_eq!(reduction.text, text);
    send(59, &[1]);
    until("the boundary", || {
        read(&mut arm).unwrap();
        arm.reduction().unwrap().text.contains("the safety boundary is on")
    });
    arm.disconnect();
    arm.connect().unwrap();
    assert_eq!(arm.get_limits().unwrap().velocity_max, [0.25; 6]);
}
