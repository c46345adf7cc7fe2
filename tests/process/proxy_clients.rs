//! Who may command an arm through a loopback port: programs of this user that speak the protocol, and no web page or
//! other user, who can connect as well.

use std::io::{ErrorKind, Read, Write};
use std::net::{Ipv4Addr, TcpListener, TcpStream};
use std::process::{Command, Stdio};
use std::time::Duration;

use rustix::thread::CapabilitySet;

use crate::support::loopback::own_address;
use crate::support::program::{Home, Started, eventually};
use crate::support::skip::{skip_port_502, skip_privileged};

/// A uid that is not that of the tests.
const ANOTHER: &str = "65534";

/// A run of an xArm's emulator and the proxy, at its address.
struct Cell {
    home: Home,
    _run: Started,
    proxy: Started,
    host: Ipv4Addr,
}

impl Cell {
    /// `None` where port 502 needs a privilege.
    fn start() -> Option<Self> {
        let host = own_address();
        if TcpListener::bind((host, 502)).is_err() {
            skip_port_502();
            return None;
        }
        let home = Home::new();
        let run = home.run("coordinator-xarm6 --sim --no-record");
        eventually("ready", || home.status()["arms"][0]["phase"] == "ready");
        let proxy = home.start(&format!("proxy xarm --listen {host}"));
        proxy.until("Ctrl-C ends it");
        Some(Self { home, _run: run, proxy, host })
    }

    fn connect(&self) -> TcpStream {
        let stream = TcpStream::connect((self.host, 502)).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(5))).unwrap();
        stream
    }

    /// The arm is not commanded, and is where it was.
    fn is_untouched(&self, before: &[f64]) {
        let status = self.home.status();
        assert!(status["arms"][0]["commander"].is_null(), "{status}");
        let moved = self.home.positions("arm").iter().zip(before).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(moved < 1e-4, "it moved by {moved} rad");
    }
}

/// A request to a register.
fn frame(register: u8, payload: &[u8]) -> Vec<u8> {
    [&[0x41, 0x42, 0, 2, 0, payload.len() as u8 + 1, register], payload].concat()
}

/// Requests that enable the arm and move its first joint by 0.4 rad.
fn moves(from: &[f64]) -> Vec<u8> {
    let target = [&[from[0] + 0.4], &from[1..], &[0.0, 0.5, 5.0, 0.0]].concat();
    let target: Vec<u8> = target.iter().flat_map(|value| (*value as f32).to_le_bytes()).collect();
    [frame(16, &[]), frame(11, &[8, 1]), frame(19, &[0]), frame(12, &[0]), frame(23, &target)].concat()
}

/// The rest of what the peer sends, which closes the connection.
fn closed(mut stream: TcpStream) -> Vec<u8> {
    let mut rest = Vec::new();
    match stream.read_to_end(&mut rest) {
        Ok(_) => {}
        // Closed before all was read.
        Err(error) => assert_eq!(error.kind(), ErrorKind::ConnectionReset, "the connection stays open"),
    }
    rest
}

/// A request as a browser sends it for a page of any site.
fn posted(host: Ipv4Addr, body: &[u8]) -> Vec<u8> {
    let head = format!(
        "POST / HTTP/1.1\r\nHost: {host}:502\r\nConnection: keep-alive\r\nContent-Length: {}\r\nContent-Type: \
         text/plain;charset=UTF-8\r\nOrigin: http://a.test\r\nSec-Fetch-Mode: no-cors\r\n\r\n",
        body.len()
    );
    [head.as_bytes(), body].concat()
}

#[test]
fn a_web_page_moves_no_arm_through_the_proxy() {
    let Some(cell) = Cell::start() else { return };
    let before = cell.home.positions("arm");
    for _ in 0..2 {
        let mut page = cell.connect();
        page.write_all(&posted(cell.host, &moves(&before))).unwrap();
        assert_eq!(closed(page), b"", "no answer");
    }
    std::thread::sleep(Duration::from_millis(500));
    cell.is_untouched(&before);
    // A stopped arm stays stopped.
    cell.home.dimos("stop").with(0);
    let mut page = cell.connect();
    page.write_all(&posted(cell.host, &moves(&before))).unwrap();
    assert_eq!(closed(page), b"");
    std::thread::sleep(Duration::from_millis(500));
    assert_eq!(cell.home.status()["arms"][0]["phase"], "held");
}

#[test]
fn noise_after_a_request_ends_the_connection_and_nothing_behind_it_counts() {
    let Some(cell) = Cell::start() else { return };
    let before = cell.home.positions("arm");
    for noise in [&b"noise"[..], b"\r\n\r\n", &[0xFF; 6], &[0, 1, 0, 2, 0, 0]] {
        let mut client = cell.connect();
        client.write_all(&[&frame(1, &[])[..], noise, &moves(&before)].concat()).unwrap();
        let answer = closed(client);
        assert!(answer.is_empty() || answer.starts_with(&[0x41, 0x42, 0, 2]), "{answer:?}");
    }
    std::thread::sleep(Duration::from_millis(500));
    cell.is_untouched(&before);
    // A program of this user that speaks the protocol is served.
    let mut client = cell.connect();
    client.write_all(&moves(&before)).unwrap();
    eventually("it moves", || (cell.home.positions("arm")[0] - before[0]).abs() > 0.1);
}

/// What another user reads who sends these bytes to a port: the number of bytes, once the port has closed the
/// connection; `None` if this process cannot be another user.
fn sent_by_another_user(host: Ipv4Addr, port: u16, bytes: &[u8]) -> Option<String> {
    let escaped: String = bytes.iter().map(|byte| format!("\\x{byte:02x}")).collect();
    let script = format!("exec 3<>/dev/tcp/{host}/{port} || exit 9; printf '{escaped}' >&3; timeout 5 cat <&3 | wc -c");
    let mut command = Command::new("setpriv");
    command.args(["--reuid", ANOTHER, "--clear-groups", "bash", "-c", &script]).current_dir("/");
    let ended = command.stdin(Stdio::null()).output().ok()?;
    if !ended.status.success() || ended.stdout.is_empty() {
        skip_privileged("another user (setpriv)", CapabilitySet::SETUID);
        return None;
    }
    Some(String::from_utf8(ended.stdout).unwrap().trim().to_owned())
}

#[test]
fn another_user_commands_no_arm_through_the_proxy() {
    let Some(cell) = Cell::start() else { return };
    let before = cell.home.positions("arm");
    let Some(read) = sent_by_another_user(cell.host, 502, &moves(&before)) else { return };
    assert_eq!(read, "0");
    cell.proxy.until("a program of another user was disconnected");
    assert_eq!(sent_by_another_user(cell.host, 30_000, &[]).unwrap(), "0", "no reports");
    std::thread::sleep(Duration::from_millis(500));
    cell.is_untouched(&before);
}

#[test]
fn another_user_commands_no_arm_through_a_shims_port() {
    let home = Home::new();
    let (host, port) = (own_address(), 9_770);
    let tree = env!("CARGO_MANIFEST_DIR");
    let mut shim = Command::new("python3");
    shim.arg(format!("{tree}/assets/python/dimos_shim.py")).args(["sim_arm:SimArmAdapter", "--at"]);
    shim.arg(format!("tcp:{host}:{port}")).args(["--address", "sim", "--dof", "6"]).stdin(Stdio::null());
    home.settle(&mut shim).current_dir(format!("{tree}/tests/python")).env("PYTHONPYCACHEPREFIX", home.path());
    let shim = Started::of(&mut shim);
    shim.until("Ctrl-C ends it");
    let hello = b"{\"id\": 1, \"do\": \"hello\"}\n";
    let mut ours = TcpStream::connect((host, port)).unwrap();
    ours.write_all(hello).unwrap();
    let mut reply = [0; 8];
    ours.read_exact(&mut reply).unwrap();
    assert_eq!(&reply, b"{\"id\": 1");
    drop(ours);
    if let Some(read) = sent_by_another_user(host, port, hello) {
        assert_eq!(read, "0");
    }
}
