//! The messages of captures.

use super::SPEC;
use super::protocol::{self, STATE, Servo};
use dimos_hardware::transport::Scan;
use dimos_hardware::wire::{Message, Place, Wire};

/// How captures of this arm are read.
pub const WIRE: Wire = Wire {
    connections: |address| {
        let full = (SPEC.address.check)(address).unwrap_or_else(|_| address.to_owned());
        let path = full.rsplit_once('@').map_or(full.as_str(), |(path, _)| path);
        vec![("bus", path.to_owned())]
    },
    scan,
    mend: |_, message| {
        if let Some((check, content)) = message.split_last_mut() {
            *check = protocol::sum(content.get(2..).unwrap_or_default());
        }
    },
};

fn scan(place: Place<'_>, bytes: &[u8]) -> Scan<Message> {
    let (found, data) = match bytes.first_chunk::<4>() {
        Some([0xFF, 0xFF, id, length]) if *id != 0xFF => (*id, usize::from(*length).saturating_sub(2)),
        Some(_) => return Scan::Skip(1),
        None => return Scan::More,
    };
    protocol::scan(bytes, found..=found, data).map(|status| match place.sent {
        // An instruction has the same frame, with its number where a status has its error.
        true => Message::named(match status.error {
            0x01 => "ping".to_owned(),
            0x02 => format!("read {}", address(status.data)),
            0x03 => format!("write {}", address(status.data)),
            0x82 => format!("sync read {}", address(status.data)),
            0x83 => format!("sync write {}", address(status.data)),
            other => format!("instruction {other:#04x}"),
        }),
        false => Message::named(format!("status of {data} bytes"))
            .status(status.error.into())
            .decoded(data != usize::from(STATE.1) || Servo::decode(status.data).is_some()),
    })
}

fn address(parameters: &[u8]) -> String {
    parameters.first().map_or_else(|| "without an address".to_owned(), u8::to_string)
}
