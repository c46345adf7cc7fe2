//! The messages of captures.

use super::frame::{self, Frame};
use super::protocol::{self, Hello, Io, PORT, State};
use dimos_hardware::transport::Scan;
use dimos_hardware::transport::tcp::Endpoint;
use dimos_hardware::wire::{Message, Place, Wire};

/// Names by opcode, as on the sheet.
const NAMES: [(u8, &str); 22] = [
    (0x01, "HELLO"),
    (0x02, "GET_STATE"),
    (0x03, "SET_MODE"),
    (0x04, "ENABLE"),
    (0x05, "CLEAR_ERROR"),
    (0x06, "STOP"),
    (0x10, "MOVE_JOINTS"),
    (0x11, "SERVO_JOINTS"),
    (0x12, "VELOCITY_JOINTS"),
    (0x13, "MOVE_CARTESIAN"),
    (0x14, "SETPOINT"),
    (0x20, "GRIPPER"),
    (0x21, "SET_PAYLOAD"),
    (0x22, "GET_PAYLOAD"),
    (0x23, "SET_MOUNTING"),
    (0x24, "GET_MOUNTING"),
    (0x25, "GRIP"),
    (0x30, "GET_IO"),
    (0x31, "SET_DIGITAL"),
    (0x32, "SET_ANALOG"),
    (0x40, "GET_JOINT_STATUS"),
    (0x41, "GET_OFFSETS"),
];

/// How captures of this arm are read.
pub const WIRE: Wire = Wire {
    connections: |address| Endpoint::parse(address, PORT).map(|at| vec![("arm", at.to_string())]).unwrap_or_default(),
    scan,
    mend: |_, message| frame::seal(message),
};

fn scan(place: Place<'_>, bytes: &[u8]) -> Scan<Message> {
    frame::any(bytes).map(|Frame { opcode, payload, .. }| {
        let known = NAMES.iter().find(|(code, _)| *code == opcode & !frame::REPLY);
        let name = known.map_or_else(|| format!("{opcode:#04x}"), |(_, name)| (*name).to_owned());
        match payload.split_first() {
            _ if place.sent => Message::named(name),
            Some((0, data)) => Message::named(format!("{name} reply")).decoded(takes(opcode & !frame::REPLY, data)),
            // Compared by how often that happens, not as another kind of message.
            Some((status, data)) => Message::named(format!("{name} reply"))
                .status((*status).into())
                .decoded(protocol::decode_refusal(data).is_some()),
            None => Message::named(format!("{name} reply")).decoded(false),
        }
    })
}

/// Returns whether the adapter understands the data of a good reply.
fn takes(opcode: u8, data: &[u8]) -> bool {
    match opcode {
        0x01 => Hello::decode(data).is_some(),
        0x02 => State::decode(data).is_some(),
        0x22 => protocol::decode_floats::<10>(data).is_some(),
        0x24 => protocol::decode_floats::<3>(data).is_some(),
        0x41 => protocol::decode_floats::<6>(data).is_some(),
        0x30 => Io::decode(data).is_some(),
        0x40 => protocol::decode_drives(data).is_some(),
        _ => data.is_empty(),
    }
}
