//! The bytes on the wire, as they were seen between the vendor's clients and a controller.

use super::protocol::Interface;
use super::protocol::command::{Target, encode, sent};
use super::protocol::gripper;
use super::protocol::service::{Answer, Reader, Service, connect, motion, refusal, request};
use super::protocol::state::State;
use dimos_hardware::transport::Scan;

fn hex(text: &str) -> Vec<u8> {
    let digits: Vec<u8> = text.bytes().filter(u8::is_ascii_hexdigit).collect();
    digits.chunks(2).map(|pair| u8::from_str_radix(std::str::from_utf8(pair).unwrap(), 16).unwrap()).collect()
}

#[test]
fn connecting() {
    // pylibfranka 0.21.3, and panda-python 1.1.1 with libfranka 0.9.2.
    let ours = |interface, port| request(interface, Service::Connect, 0, &connect(interface, port));
    assert_eq!(ours(Interface::Ten, 0x9b40), hex("00000000 00000000 10000000 0a00 409b"));
    assert_eq!(ours(Interface::Five, 0xa743), hex("00000000 00000000 10000000 0500 43a7"));
}

#[test]
fn requests_of_a_motion() {
    let ten = request(Interface::Ten, Service::Move, 3, &motion(Interface::Ten, true));
    assert_eq!((ten.len(), ten[..20].to_vec()), (125, hex("01000000 03000000 7d000000 00000000 01000000")));
    let five = request(Interface::Five, Service::Move, 3, &motion(Interface::Five, false));
    assert_eq!((five.len(), five[..20].to_vec()), (68, hex("01000000 03000000 44000000 00000000 00000000")));
    // 10 m, 3.12 rad, a whole turn.
    assert_eq!(five[20..44], hex("0000000000002440 f6285c8fc2f50840 182d4454fb211940"));
    let recovery = |interface| request(interface, Service::AutomaticErrorRecovery, 1, &[])[0];
    assert_eq!((recovery(Interface::Five), recovery(Interface::Ten)), (12, 10));
    assert_eq!(refusal(Interface::Ten, Service::Move, 8), refusal(Interface::Five, Service::Move, 6));
}

#[test]
fn answers_come_in_parts() {
    let mut reader = Reader::default();
    let bytes = hex("0b000000 07000000 10000000 00 616263");
    assert_eq!(reader.scan(&bytes[..8]), Scan::More);
    assert_eq!(reader.scan(&bytes[..14]), Scan::Take(12, None));
    assert_eq!(reader.scan(&bytes[12..14]), Scan::Take(2, None));
    let answer = Answer { id: 7, status: 0, rest: b"abc".to_vec() };
    assert_eq!(reader.scan(&bytes[14..]), Scan::Take(2, Some(answer)));
    assert_eq!(reader.scan(&hex("00000000 00000000 00000000")), Scan::Skip(1));
}

#[test]
fn commands() {
    let positions = encode(0x0102, &Target::Positions([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, -2.0]), false);
    assert_eq!((sent(Interface::Ten, &positions).len(), sent(Interface::Five, &positions).len()), (371, 370));
    assert_eq!(positions[..16], hex("0201000000000000 000000000000f03f"));
    assert_eq!(positions[56..64], hex("00000000000000c0"));
    assert!(positions[64..].iter().all(|byte| *byte == 0));
    let velocities = encode(1, &Target::Velocities([0.5; 7]), true);
    assert!(velocities[8..64].iter().all(|byte| *byte == 0));
    assert_eq!((velocities[64..72].to_vec(), velocities[313]), (hex("000000000000e03f"), 1));
}

#[test]
fn states() {
    // Every number its own index, so that a wrong place shows.
    for interface in [Interface::Five, Interface::Ten] {
        let mut bytes = 77_u64.to_le_bytes().to_vec();
        let wide = interface == Interface::Five;
        for i in 0..if wide { 284 } else { 320 } {
            if wide { bytes.extend(f64::from(i).to_le_bytes()) } else { bytes.extend((i as f32).to_le_bytes()) }
        }
        bytes.extend([2, 0]);
        bytes.extend((0..41).map(|bit| u8::from(bit == 25)));
        bytes.extend((0..41).map(|bit| u8::from(bit == 6)));
        bytes.push(4);
        if wide {
            bytes.extend(0.5_f64.to_le_bytes())
        } else {
            bytes.extend(0.5_f32.to_le_bytes())
        }
        let state = State::decode(interface, &bytes).unwrap();
        assert_eq!((state.id, state.mode, state.generator, state.controller), (77, 4, 2, 0));
        assert_eq!((state.errors, state.reflex_reason, state.success_rate), (1 << 25, 1 << 6, 0.5));
        assert_eq!((state.q[0], state.q_d[6], state.dq[0], state.dq_d[0]), (147.0, 160.0, 161.0, 168.0));
        assert_eq!((state.ddq_d[0], state.tau[0], state.force[5]), (175.0, 126.0, 220.0));
        assert_eq!((state.load.mass, state.load.inertia[3], state.load.center[2]), (109.0, 114.0, 121.0));
        assert_eq!((state.pose[12], bytes.len()), (12.0, interface.state_length()));
        // In bytes, as the vendor's header of interface 10 has them.
        if !wide {
            assert_eq!((8 + 4 * 147, 8 + 4 * 154, bytes.len()), (596, 624, 1377));
        }
        assert_eq!(State::decode(interface, &bytes[1..]), None);
    }
}

#[test]
fn the_hand() {
    assert_eq!(gripper::request(0, gripper::Request::Connect(0x1234)), hex("0000 00000000 0e000000 0300 3412"));
    let grasp = gripper::request(2, gripper::Request::Grasp(0.0, 0.1, 20.0));
    assert_eq!((grasp.len(), grasp[..10].to_vec()), (50, hex("0200 02000000 32000000")));
    assert_eq!(gripper::scan(&hex("0300 05000000 0c000000 0200")), Scan::Take(12, (5, 2)));
    let state = [&1_u32.to_le_bytes()[..], &0.04_f64.to_le_bytes(), &0.08_f64.to_le_bytes(), &[0, 35, 0]].concat();
    assert_eq!(gripper::state(&state), Some((0.04, 0.08, false)));
    let grasps = [&state[..20], &[1, 35, 0]].concat();
    assert_eq!(gripper::state(&grasps), Some((0.04, 0.08, true)));
}
