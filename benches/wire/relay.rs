//! A relay between an xArm's emulator and its adapter, which writes the time at which it forwards a report into the
//! report's first joint.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::time::Duration;

use dimos::arms::xarm::address::Address;
use dimos::rt::host;

use crate::timed::moment;

/// Length of a report of port 30000, and the offset of its first measured joint (a float, little-endian).
const FULL: usize = 804;
const FIRST_JOINT: usize = 116;
/// Report ports of a controller.
const PORTS: u16 = 4;

/// Forwards the reports of the emulator at `address`; returns the address at which an adapter finds both.
pub fn start(address: &str) -> Result<String, String> {
    let theirs = Address::parse(address)?;
    let (first, listeners) = adjacent().ok_or("no four free ports side by side")?;
    for (offset, listener) in (0..).zip(listeners) {
        let upstream = theirs.report(offset).to_string();
        std::thread::spawn(move || {
            // One adapter per port; it connects once.
            if let (Ok((down, _)), Ok(up)) = (listener.accept(), TcpStream::connect(upstream)) {
                let _ = down.set_nodelay(true);
                let _ = up.set_read_timeout(Some(Duration::from_secs(2)));
                host::enter_realtime(host::EMULATOR_PRIORITY);
                forward(up, down, offset == 0);
            }
        });
    }
    Ok(format!("{}:{first}", theirs.control))
}

fn adjacent() -> Option<(u16, Vec<TcpListener>)> {
    (0..50).find_map(|_| {
        let first = TcpListener::bind("127.0.0.1:0").ok()?;
        let port = first.local_addr().ok()?.port();
        let rest: Option<Vec<_>> =
            (1..PORTS).map(|k| TcpListener::bind(("127.0.0.1", port.checked_add(k)?)).ok()).collect();
        Some((port, std::iter::once(first).chain(rest?).collect()))
    })
}

fn forward(mut up: TcpStream, mut down: TcpStream, stamped: bool) {
    let mut packet = [0; FULL];
    loop {
        let read = if stamped { up.read_exact(&mut packet).map(|()| FULL) } else { up.read(&mut packet) };
        let Ok(n @ 1..) = read else { return };
        if stamped && let Some(place) = packet.get_mut(FIRST_JOINT..FIRST_JOINT + 4) {
            place.copy_from_slice(&((moment() * 1e3) as f32).to_le_bytes());
        }
        if down.write_all(packet.get(..n).unwrap_or_default()).is_err() {
            return;
        }
    }
}
