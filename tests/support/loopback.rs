//! Loopback addresses of tests: two tests that run at the same time never have the same one.

use std::io::ErrorKind;
use std::net::Ipv4Addr;
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixDatagram};
use std::sync::{Mutex, PoisonError};

/// Returns an address that no other test on this computer has now. This process keeps it until it ends.
pub fn own_address() -> Ipv4Addr {
    // An abstract socket names each address that is taken: the kernel removes it with its process.
    static TAKEN: Mutex<Vec<UnixDatagram>> = Mutex::new(Vec::new());
    let mut taken = TAKEN.lock().unwrap_or_else(PoisonError::into_inner);
    // Processes begin apart, so that an address is not used again while its ports are still in TIME_WAIT.
    let first = std::process::id().wrapping_mul(61).wrapping_add(taken.len() as u32);
    for n in 0..10_000 {
        let address = numbered(first.wrapping_add(n));
        let name = SocketAddr::from_abstract_name(format!("dimos-test-address-{address}")).unwrap();
        match UnixDatagram::bind_addr(&name) {
            Ok(socket) => {
                taken.push(socket);
                return address;
            }
            Err(error) if error.kind() == ErrorKind::AddrInUse => {}
            Err(error) => panic!("{address}: {error}"),
        }
    }
    panic!("no free loopback address");
}

/// Address number `n` of 127.64.0.2 to 127.254.255.251. Any 12 million consecutive numbers give different addresses.
/// Tests that need a fixed address use one below 127.64.0.0.
pub fn numbered(n: u32) -> Ipv4Addr {
    let (last, rest) = (n % 250, n / 250);
    Ipv4Addr::new(127, 64 + (rest / 256 % 191) as u8, (rest % 256) as u8, 2 + last as u8)
}
