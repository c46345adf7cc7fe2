//! A report of a first day has no serial number of the arm.

use dimos_hardware::conformance::first_day::{remove_serial, report::Line};
use dimos_hardware::transport::Scan;
use dimos_hardware::transport::capture::{self, Chunk};
use dimos_hardware::wire::Place;

use crate::yourarm;

/// The serial number of a YourArm is in the reply to HELLO, under a checksum.
#[test]
fn a_serial_number_is_gone_and_its_message_is_still_whole() {
    let emulator = crate::emulate("yourarm", 6).unwrap();
    let mut adapter = crate::create("yourarm", &emulator.address(), 6).unwrap();
    capture::start();
    adapter.connect().unwrap();
    let captured = capture::finish();
    let serial = adapter.get_info().serial_number.unwrap();
    let wire = yourarm::SPEC.wire.unwrap();
    let lines = [Line { name: "arm".into(), datagrams: false, port: None }];
    // Also where it is cut in two.
    let mut chunks: Vec<Chunk> = captured
        .chunks
        .iter()
        .flat_map(|chunk| chunk.bytes.iter().map(|byte| Chunk { bytes: vec![*byte], ..chunk.clone() }))
        .collect();
    assert_eq!(remove_serial(&serial, Some(&wire), &lines, &mut chunks), 1);
    let received: Vec<u8> = chunks.iter().filter(|chunk| !chunk.sent).map(|chunk| chunk.bytes[0]).collect();
    assert_eq!(occurrences(&received, serial.as_bytes()), 0);
    let place = Place { connection: "arm", sent: false };
    let Scan::Take(length, message) = (wire.scan)(place, &received) else { panic!("damaged: {received:?}") };
    assert_eq!((message.name.as_str(), message.wrong), ("HELLO reply", None));
    assert_eq!(occurrences(&received[..length], b"000000000"), 1, "{received:?}");
}

fn occurrences(bytes: &[u8], what: &[u8]) -> usize {
    bytes.windows(what.len()).filter(|window| *window == what).count()
}
