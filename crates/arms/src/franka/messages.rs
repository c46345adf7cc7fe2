//! The messages of captures. Commands of a motion answer states by their number: played again they answer nothing.

use super::protocol::gripper;
use super::protocol::state::State;
use super::protocol::{Interface, PORT};
use dimos_hardware::transport::Scan;
use dimos_hardware::transport::tcp::Endpoint;
use dimos_hardware::wire::{Message, Place, Wire, no_checksum, whole};

/// How captures of this arm are read.
pub const WIRE: Wire = Wire {
    connections: |address| {
        let Ok(arm) = Endpoint::parse(address, PORT) else { return Vec::new() };
        let hand = Endpoint { host: arm.host.clone(), port: arm.port.saturating_add(1) };
        let udp = |name: &'static str| (name, name.to_owned());
        vec![("arm", arm.to_string()), (HAND, hand.to_string()), udp(STATES), udp(HAND_STATES)]
    },
    scan,
    mend: no_checksum,
};

const HAND: &str = "gripper";
/// Connections of datagrams: states of the arm and of its gripper.
pub(super) const STATES: &str = "udp";
pub(super) const HAND_STATES: &str = "gripper udp";

fn scan(place: Place<'_>, bytes: &[u8]) -> Scan<Message> {
    match (place.connection, place.sent) {
        (STATES, true) => whole(bytes, Message::named("command")),
        (STATES, false) => {
            let of = |interface| State::decode(interface, bytes).is_some();
            whole(bytes, Message::named("state").decoded(of(Interface::Five) || of(Interface::Ten)))
        }
        (HAND_STATES, _) => whole(bytes, Message::named("gripper state").decoded(gripper::state(bytes).is_some())),
        // The gripper's numbers have two bytes: command u16, number u32, length u32.
        (HAND, _) => service(place, bytes, 2),
        _ => service(place, bytes, 4),
    }
}

fn service(place: Place<'_>, bytes: &[u8], width: usize) -> Scan<Message> {
    let header = width + 8;
    let Some(head) = bytes.get(..header) else { return Scan::More };
    let number = |at: usize, width: usize| {
        let bytes = head.get(at..at + width).unwrap_or_default();
        bytes.iter().rev().fold(0_usize, |number, byte| number << 8 | usize::from(*byte))
    };
    let (code, length) = (number(0, width), number(width + 4, 4));
    if !(header..1 << 20).contains(&length) || code > 64 {
        return Scan::Skip(1);
    }
    let Some(content) = bytes.get(header..length) else { return Scan::More };
    let what = if place.connection == HAND { "gripper command" } else { "command" };
    Scan::Take(
        length,
        match (place.sent, content.first()) {
            (true, _) => Message::named(format!("{what} {code}")),
            (false, Some(status)) => Message::named(format!("{what} {code} answer")).status((*status).into()),
            (false, None) => Message::named(format!("{what} {code} answer")).decoded(false),
        },
    )
}
