//! Which user is at the other end of a TCP connection within this computer. A port has no permissions: every local user
//! and every web page can connect to it.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, TcpStream};

/// The system's lists of connections.
const TABLES: [&str; 2] = ["/proc/net/tcp", "/proc/net/tcp6"];
/// An established connection, in these lists.
const ESTABLISHED: &str = "01";

/// Returns whether the program at the other end is this user's or root's. `false` if the system does not list it.
pub fn is_ours_or_root(stream: &TcpStream) -> bool {
    let us = rustix::process::geteuid().as_raw();
    uid(stream).is_some_and(|uid| uid == us || uid == 0)
}

/// Returns the uid of the program at the other end; `None` if the system does not list it: another computer's, or one
/// that has disconnected. Reads files of /proc.
pub fn uid(stream: &TcpStream) -> Option<u32> {
    let (ours, theirs) = (canonical(stream.local_addr().ok()?), canonical(stream.peer_addr().ok()?));
    TABLES.iter().find_map(|table| {
        let table = std::fs::read_to_string(table).ok()?;
        table.lines().find_map(|row| owner(row, theirs, ours))
    })
}

/// Returns the uid in a row of a list, if the row is about the connection from `local` to `remote`.
fn owner(row: &str, local: (IpAddr, u16), remote: (IpAddr, u16)) -> Option<u32> {
    let mut columns = row.split_ascii_whitespace().skip(1);
    let is_it = address(columns.next()?)? == local && address(columns.next()?)? == remote;
    // A socket that its program has closed counts as root's; it is not established, and has no inode.
    let open = columns.next()? == ESTABLISHED;
    let uid = columns.nth(3)?.parse().ok()?;
    let inode = columns.nth(1)?;
    (is_it && open && inode != "0").then_some(uid)
}

/// Parses an address of a list: words in the computer's byte order, and the port.
fn address(text: &str) -> Option<(IpAddr, u16)> {
    let (ip, port) = text.split_once(':')?;
    let word = |at: usize| Some(u32::from_str_radix(ip.get(at..at + 8)?, 16).ok()?.to_ne_bytes());
    let ip = match ip.len() {
        8 => Ipv4Addr::from(word(0)?).into(),
        32 => {
            let words = [word(0)?, word(8)?, word(16)?, word(24)?];
            let mut bytes = [0; 16];
            bytes.iter_mut().zip(words.as_flattened()).for_each(|(to, from)| *to = *from);
            Ipv6Addr::from(bytes).to_canonical()
        }
        _ => return None,
    };
    Some((ip, u16::from_str_radix(port, 16).ok()?))
}

fn canonical(address: SocketAddr) -> (IpAddr, u16) {
    (address.ip().to_canonical(), address.port())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::net::TcpListener;

    fn accepted(at: &str, to: impl Fn(u16) -> SocketAddr) -> (TcpStream, TcpStream) {
        let listener = TcpListener::bind(at).unwrap();
        let client = TcpStream::connect(to(listener.local_addr().unwrap().port())).unwrap();
        (listener.accept().unwrap().0, client)
    }

    #[test]
    fn the_other_end_is_found_over_both_protocols() {
        let us = Some(rustix::process::geteuid().as_raw());
        let loopback = |port| SocketAddr::from(([127, 0, 0, 1], port));
        let (server, _client) = accepted("127.0.0.1:0", loopback);
        assert_eq!(uid(&server), us);
        let (server, _client) = accepted("[::]:0", loopback);
        assert_eq!(uid(&server), us, "an IPv4 client of an IPv6 port");
        let (server, _client) = accepted("[::1]:0", |port| SocketAddr::from((Ipv6Addr::LOCALHOST, port)));
        assert_eq!(uid(&server), us);
    }

    #[test]
    fn who_has_disconnected_is_unknown() {
        let (server, client) = accepted("127.0.0.1:0", |port| SocketAddr::from(([127, 0, 0, 1], port)));
        drop(client);
        assert_eq!(uid(&server), None);
        assert!(!is_ours_or_root(&server));
    }

    #[test]
    fn a_row_counts_only_for_an_open_socket_of_this_connection() {
        let (from, to) = (canonical("127.0.0.1:4096".parse().unwrap()), canonical("127.0.0.9:502".parse().unwrap()));
        let hex = |(ip, port): (IpAddr, u16)| {
            let IpAddr::V4(ip) = ip else { panic!() };
            format!("{:08X}:{port:04X}", u32::from_ne_bytes(ip.octets()))
        };
        let row = |state: &str, inode: &str| {
            let ends = format!("{} {}", hex(from), hex(to));
            format!(
                "  7: {ends} {state} 00000000:00000000 00:00000000 00000000  1000        0 {inode} 1 0 20 4 30 10 -1"
            )
        };
        assert_eq!(owner(&row("01", "812"), from, to), Some(1000));
        assert_eq!(owner(&row("01", "812"), to, from), None, "our own end");
        assert_eq!(owner(&row("04", "0"), from, to), None, "closing");
        assert_eq!(owner(&row("01", "0"), from, to), None, "closed");
        assert_eq!(owner("  sl  local_address rem_address   st", from, to), None);
    }
}
