//! The messages of captures.

use super::address::Address;
use super::protocol::frame::{self, Arrived, PRIVATE};
use super::protocol::report::{self, Health, Kind, Motion};
use dimos_hardware::transport::Scan;
use dimos_hardware::wire::{Message, Place, Wire, no_checksum};

/// How captures of this arm are read.
pub const WIRE: Wire = Wire {
    connections: |address| {
        let Ok(at) = Address::parse(address) else { return Vec::new() };
        let report = |kind: Kind| at.report(kind.offset()).to_string();
        vec![
            ("control", at.control.to_string()),
            ("second control", at.second().to_string()),
            (FULL, report(Kind::Full)),
            (RICH, report(Kind::Rich)),
            (REAL, report(Kind::Real)),
        ]
    },
    scan,
    mend: no_checksum,
};

const FULL: &str = "full report";
const RICH: &str = "rich report";
const REAL: &str = "real report";

fn scan(place: Place<'_>, bytes: &[u8]) -> Scan<Message> {
    let report = |(length, ()): (usize, ())| Message::named(format!("{} of {length} bytes", place.connection));
    match place.connection {
        FULL => report::scan(bytes, Kind::Full, None, |packet| Motion::decode_full(packet).map(drop)).map(report),
        REAL => report::scan(bytes, Kind::Real, None, |packet| Motion::decode_real(packet).map(drop)).map(report),
        RICH => report::scan(bytes, Kind::Rich, None, |packet| Health::decode(packet).map(drop)).map(report),
        _ => control(place, bytes),
    }
}

fn control(place: Place<'_>, bytes: &[u8]) -> Scan<Message> {
    let Some([_, _, p0, p1, l0, l1, register]) = bytes.first_chunk::<7>() else { return Scan::More };
    let length = usize::from(u16::from_be_bytes([*l0, *l1]));
    let name = format!("register {register}");
    if !place.sent {
        let protocol = u16::from_be_bytes([*p0, *p1]);
        let protocol = if matches!(protocol, 2 | 3) { protocol } else { PRIVATE };
        return frame::scan(bytes, protocol, |_, _| true).map(|arrived| match arrived {
            Arrived::Response(response) => {
                Message::named(format!("{name} response")).status(i64::from(response.status.invalid()))
            }
            Arrived::Stray => Message::named("stray"),
        });
    }
    match length {
        0 => Scan::Skip(1),
        _ if bytes.len() >= 6 + length => Scan::Take(6 + length, Message::named(name)),
        _ => Scan::More,
    }
}
