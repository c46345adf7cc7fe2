//! The messages of captures.

use super::address::{Address, Service};
use super::protocol::primary::{self, Packet};
use super::protocol::rtde::HEADER;
use super::protocol::state::Recipe;
use super::robot_api;
use dimos_hardware::transport::Scan;
use dimos_hardware::wire::{Message, Place, Wire, line, no_checksum};

/// How captures of this arm are read.
pub const WIRE: Wire = Wire {
    connections: |address| {
        let Ok(address) = Address::parse(address) else { return Vec::new() };
        let services = [
            (DASHBOARD, Service::Dashboard),
            (PRIMARY, Service::Primary),
            (RTDE, Service::Rtde),
            (ROBOT_API, Service::RobotApi),
        ];
        services.map(|(name, service)| (name, address.port(service).to_string())).to_vec()
    },
    scan,
    mend: no_checksum,
};

const DASHBOARD: &str = "dashboard";
const PRIMARY: &str = "primary";
const RTDE: &str = "rtde";
const ROBOT_API: &str = "robot api";

fn scan(place: Place<'_>, bytes: &[u8]) -> Scan<Message> {
    match place.connection {
        // A request by its words, a response by its first word: what follows is the arm's.
        DASHBOARD if place.sent => line(bytes, |text| Message::named(text.trim())),
        DASHBOARD => line(bytes, |text| {
            let first = text.split([' ', ':']).next().unwrap_or_default().trim();
            let number = !first.is_empty() && first.bytes().all(|byte| byte.is_ascii_digit());
            Message::named(if number { "a number" } else { first })
        }),
        PRIMARY if place.sent => line(bytes, |_| Message::named("line of script")),
        PRIMARY => primary::scan(bytes).map(|packet| {
            Message::named(match packet {
                Packet::Version(..) => "version",
                Packet::About(_) => "state with a configuration or kinematics",
                Packet::Error { .. } => "error",
                Packet::Exception { .. } => "exception",
                Packet::Other => "another packet",
            })
        }),
        ROBOT_API if place.sent => {
            robot_api::request(bytes).map(|(method, path, _)| Message::named(format!("{method} {path}")))
        }
        ROBOT_API => robot_api::answer(bytes).map(|(status, _)| Message::named(format!("answer {status}"))),
        _ => rtde(place, bytes),
    }
}

fn rtde(place: Place<'_>, bytes: &[u8]) -> Scan<Message> {
    let [high, low, kind, ..] = bytes else { return Scan::More };
    let length = usize::from(u16::from_be_bytes([*high, *low]));
    if length < HEADER || !kind.is_ascii_alphabetic() {
        return Scan::Skip(1);
    }
    let Some(content) = bytes.get(HEADER..length) else { return Scan::More };
    let message = Message::named(format!("{} of {length} bytes", char::from(*kind)));
    // All values of a newer controller can be decoded; of an older one with fewer values only the length is known.
    let recipe = Recipe::default();
    let all = !place.sent && *kind == b'U' && length == recipe.length();
    let takes = !all || content.split_first().is_some_and(|(_, values)| recipe.decode(values).is_some());
    Scan::Take(length, message.decoded(takes))
}
