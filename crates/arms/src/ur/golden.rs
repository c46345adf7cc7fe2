//! The bytes on the wire, as they were seen between `ur_rtde` and a controller.

use super::protocol::inputs::{self, Order};
use super::protocol::rtde::{VERSION, encode, kind, recipe, reply};
use super::protocol::state::Recipe;
use dimos_hardware::transport::Scan;

fn hex(text: &str) -> Vec<u8> {
    let digits: Vec<u8> = text.bytes().filter(u8::is_ascii_hexdigit).collect();
    digits.chunks(2).map(|pair| u8::from_str_radix(std::str::from_utf8(pair).unwrap(), 16).unwrap()).collect()
}

#[test]
fn the_handshake() {
    assert_eq!(encode(kind::PROTOCOL, &VERSION.to_be_bytes()), hex("0005 56 0002"));
    assert_eq!(reply(&hex("0004 56 01"), kind::PROTOCOL, <[u8]>::to_vec), Scan::Take(4, vec![1]));
    assert_eq!(encode(kind::SOFTWARE, &[]), hex("0003 76"));
    let version = hex("0013 76 00000005 0000000b 00000000 00000000");
    let found = reply(&version, kind::SOFTWARE, |content| content[..8].to_vec());
    assert_eq!(found, Scan::Take(19, hex("00000005 0000000b")));
    assert_eq!(encode(kind::START, &[]), hex("0003 53"));
    assert_eq!(reply(&hex("0004 53 01"), kind::START, <[u8]>::to_vec), Scan::Take(4, vec![1]));
}

#[test]
fn recipes() {
    let outputs = recipe(Some(500.0), "timestamp,actual_q");
    assert_eq!(outputs[..11], hex("001d 4f 407f400000000000"));
    assert_eq!(&outputs[11..], b"timestamp,actual_q");
    assert_eq!(recipe(None, "input_int_register_24")[..3], hex("0018 49"));
    // The name of every value, with the header, fits into what a controller takes.
    assert!(recipe(Some(500.0), &Recipe::default().names()).len() < 2048);
}

#[test]
fn an_order() {
    let order = inputs::order(1, 5, Order::Servo([0.0, -1.5, 2.0, 0.0, 0.0, 0.5]), &[0.0; 6]);
    let expected = "003c 55 01 00000005 00000001 0000000000000000 bff8000000000000 4000000000000000 \
                    0000000000000000 0000000000000000 3fe0000000000000";
    assert_eq!(order[..], hex(expected));
}
