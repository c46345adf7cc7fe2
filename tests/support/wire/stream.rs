//! The gate in a stream of bytes: TCP connections and a serial line.

use std::collections::VecDeque;
use std::net::{Ipv4Addr, Shutdown, TcpListener, TcpStream};
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use dimos::hardware::transport::serial::Pty;
use dimos::rt::host;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{Mode, OFlags};
use rustix::io::Errno;

use super::{Decoder, Gate, NewDecoder, Passage, TRICKLE, Way};
use crate::support::loopback::own_address;

/// How often a thread looks whether the wire is gone.
const LOOK: Duration = Duration::from_millis(20);

/// Listening sockets or a pseudo-terminal in front of an emulator. Ends when it is dropped.
pub struct Proxy {
    pub address: String,
    closing: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

impl Proxy {
    /// In front of a controller with one port at `upstream`.
    pub fn tcp(upstream: &str, gate: &Gate, decoder: NewDecoder) -> Self {
        let (listener, address) = listen(&[0]);
        let mut proxy = Self { address: address.to_string(), closing: Arc::default(), threads: Vec::new() };
        let port = listener[0].local_addr().unwrap().port();
        proxy.address = format!("{address}:{port}");
        proxy.serve(listener, &[upstream.to_owned()], gate, Some(decoder));
        proxy
    }

    /// In front of an xArm's controller at `HOST:CONTROL:REPORT`: its control port and its four report ports.
    pub fn xarm(upstream: &str, gate: &Gate, decoder: NewDecoder) -> Self {
        let parts: Vec<&str> = upstream.split(':').collect();
        let (host, first) = (parts[0], parts[2].parse::<u16>().unwrap());
        let mut ports = vec![format!("{host}:{}", parts[1])];
        ports.extend((0..4).map(|k| format!("{host}:{}", first + k)));
        let (listeners, address) = listen(&[5502, 30000, 30001, 30002, 30003]);
        let mut proxy = Self { address: format!("{address}:5502:30000"), closing: Arc::default(), threads: Vec::new() };
        proxy.serve(listeners, &ports, gate, Some(decoder));
        proxy
    }

    /// In front of a controller of Universal Robots whose first port is that of `upstream`: RTDE, which carries the
    /// commands, the dashboard, and the script's ports.
    pub fn ur(upstream: &str, gate: &Gate, decoder: NewDecoder) -> Self {
        let (host, first) = upstream.rsplit_once(':').unwrap();
        let first = first.parse::<u16>().unwrap();
        let ports = [5, 0, 2, 3, 4].map(|k| format!("{host}:{}", first + k));
        let (listeners, address) = listen(&[5, 0, 2, 3, 4].map(|k| 29999 + k));
        let mut proxy = Self { address: format!("{address}:29999"), closing: Arc::default(), threads: Vec::new() };
        proxy.serve(listeners, &ports, gate, Some(decoder));
        proxy
    }

    /// In front of a controller on the serial line `upstream`.
    pub fn serial(upstream: &str, gate: &Gate, decoder: NewDecoder) -> Self {
        let pty = Arc::new(Pty::open().unwrap());
        let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let arm = Arc::new(rustix::fs::open(upstream, flags, Mode::empty()).unwrap());
        let mut proxy = Self { address: pty.path().to_owned(), closing: Arc::default(), threads: Vec::new() };
        let connection = gate.new_connection();
        for way in [Way::ToArm, Way::FromArm] {
            let ends = Ends::Serial(pty.clone(), arm.clone());
            proxy.pump(ends, way, connection, gate, (way == Way::ToArm).then(|| decoder.clone()));
        }
        proxy
    }

    /// One thread takes the clients of all ports; each has two more. The first port carries the commands.
    fn serve(&mut self, listeners: Vec<TcpListener>, upstream: &[String], gate: &Gate, decoder: Option<NewDecoder>) {
        for (i, (listener, upstream)) in listeners.into_iter().zip(upstream).enumerate() {
            let (closing, gate, upstream) = (self.closing.clone(), gate.clone(), upstream.clone());
            let decoder = decoder.clone().filter(|_| i == 0);
            self.threads.push(std::thread::spawn(move || {
                let mut clients = Proxy { address: String::new(), closing: closing.clone(), threads: Vec::new() };
                while !closing.load(Ordering::Relaxed) {
                    if !readable(&listener, LOOK) {
                        continue;
                    }
                    let Ok((run, _)) = listener.accept() else { continue };
                    // An arm that is not there is one that hangs up.
                    let Ok(arm) = TcpStream::connect(&upstream) else { continue };
                    for stream in [&run, &arm] {
                        stream.set_nodelay(true).unwrap();
                        stream.set_nonblocking(true).unwrap();
                    }
                    let connection = gate.new_connection();
                    let (run, arm) = (Arc::new(run), Arc::new(arm));
                    for way in [Way::ToArm, Way::FromArm] {
                        let ends = Ends::Tcp(run.clone(), arm.clone());
                        clients.pump(ends, way, connection, &gate, decoder.clone().filter(|_| way == Way::ToArm));
                    }
                }
                // Dropped here: waits for the pumps.
            }));
        }
    }

    fn pump(&mut self, ends: Ends, way: Way, connection: usize, gate: &Gate, decoder: Option<NewDecoder>) {
        let taps = decoder.map(|new| [new(), new()]);
        let (closing, gate) = (self.closing.clone(), gate.clone());
        let pump = Pump { ends, way, connection, gate, taps, held: VecDeque::new(), ended: false };
        self.threads.push(std::thread::spawn(move || {
            host::enter_realtime(host::EMULATOR_PRIORITY);
            pump.run(&closing);
        }));
    }
}

impl Drop for Proxy {
    fn drop(&mut self) {
        if !self.address.is_empty() {
            self.closing.store(true, Ordering::Relaxed);
        }
        self.threads.drain(..).for_each(|thread| drop(thread.join()));
    }
}

/// Listens at these ports of an address that has all of them free; 0 is any.
fn listen(ports: &[u16]) -> (Vec<TcpListener>, Ipv4Addr) {
    for _ in 0..50 {
        let address = own_address();
        let all: Result<Vec<_>, _> = ports.iter().map(|port| TcpListener::bind((address, *port))).collect();
        if let Ok(all) = all {
            return (all, address);
        }
    }
    panic!("no address with these ports free: {ports:?}");
}

/// The two ends of a connection: the run's, the arm's.
enum Ends {
    Tcp(Arc<TcpStream>, Arc<TcpStream>),
    Serial(Arc<Pty>, Arc<OwnedFd>),
}

impl Ends {
    /// Waits for bytes and takes them; `None` at the end of the stream.
    fn read(&self, way: Way, room: &mut [u8], timeout: Duration) -> Option<usize> {
        let from = |fd: BorrowedFd<'_>, room: &mut [u8]| {
            if !readable(&fd, timeout) {
                return Some(0);
            }
            match rustix::io::read(fd, room) {
                Ok(0) => None,
                Ok(n) => Some(n),
                Err(Errno::AGAIN | Errno::INTR) => Some(0),
                Err(_) => None,
            }
        };
        match (self, way) {
            (Self::Tcp(run, _), Way::ToArm) => from(run.as_fd(), room),
            (Self::Tcp(_, arm), Way::FromArm) => from(arm.as_fd(), room),
            (Self::Serial(run, _), Way::ToArm) => from(run.as_fd(), room),
            (Self::Serial(_, arm), Way::FromArm) => from(arm.as_fd(), room),
        }
    }

    /// Writes all of it, or finds the other end gone.
    fn write(&self, way: Way, mut bytes: &[u8]) -> bool {
        let began = Instant::now();
        while !bytes.is_empty() && began.elapsed() < Duration::from_secs(5) {
            let written = match (self, way) {
                (Self::Tcp(_, arm), Way::ToArm) => rustix::io::write(arm, bytes),
                (Self::Tcp(run, _), Way::FromArm) => rustix::io::write(run, bytes),
                (Self::Serial(_, arm), Way::ToArm) => rustix::io::write(arm, bytes),
                (Self::Serial(run, _), Way::FromArm) => rustix::io::write(run, bytes),
            };
            match written {
                Ok(n) => bytes = &bytes[n..],
                Err(Errno::AGAIN | Errno::INTR) => std::thread::sleep(Duration::from_micros(200)),
                Err(_) => return false,
            }
        }
        bytes.is_empty()
    }

    fn close(&self) {
        if let Self::Tcp(run, arm) = self {
            let _ = run.shutdown(Shutdown::Both);
            let _ = arm.shutdown(Shutdown::Both);
        }
    }
}

fn readable(fd: &impl AsFd, timeout: Duration) -> bool {
    let timeout = Timespec { tv_sec: timeout.as_secs() as i64, tv_nsec: timeout.subsec_nanos().into() };
    poll(&mut [PollFd::new(fd, PollFlags::IN)], Some(&timeout)).is_ok_and(|n| n > 0)
}

/// Carries bytes one way.
struct Pump {
    ends: Ends,
    way: Way,
    connection: usize,
    gate: Gate,
    /// Of what the run sends, and of what is delivered.
    taps: Option<[Decoder; 2]>,
    held: VecDeque<u8>,
    /// The sender has hung up. What it sent before is still on its way.
    ended: bool,
}

impl Pump {
    fn run(mut self, closing: &AtomicBool) {
        let mut room = [0; 4096];
        let mut next_byte = Instant::now();
        while !closing.load(Ordering::Relaxed) {
            let (passage, left) = self.gate.passage(self.way);
            let wait = match passage {
                Passage::Trickle => TRICKLE.min(LOOK),
                _ => left.unwrap_or(LOOK).min(LOOK),
            };
            if self.ended {
                // Nothing more comes; a stall is waited for.
                if passage != Passage::Pass {
                    std::thread::sleep(wait);
                }
            } else {
                match self.ends.read(self.way, &mut room, wait) {
                    Some(n) => self.take(&room[..n]),
                    None => self.ended = true,
                }
            }
            // What has come meanwhile goes the way of the moment at which it came.
            match self.gate.passage(self.way).0 {
                Passage::Keep => {}
                Passage::Lose => self.held.clear(),
                Passage::Trickle => {
                    if Instant::now() >= next_byte && !self.held.is_empty() {
                        next_byte = Instant::now() + TRICKLE;
                        self.deliver(1);
                    }
                }
                Passage::Pass => {
                    if !self.deliver(usize::MAX) || self.ended {
                        break;
                    }
                }
            }
        }
        self.ends.close();
    }

    fn take(&mut self, bytes: &[u8]) {
        if bytes.is_empty() {
            return;
        }
        self.held.extend(bytes);
        if let Some([sent, _]) = &mut self.taps {
            let mut found = Vec::new();
            sent(bytes, &mut found);
            self.gate.note_sent(self.connection, found.into_iter());
        }
    }

    fn deliver(&mut self, most: usize) -> bool {
        let bytes: Vec<u8> = self.held.drain(..most.min(self.held.len())).collect();
        if bytes.is_empty() {
            return true;
        }
        if let Some([_, delivered]) = &mut self.taps {
            let mut found = Vec::new();
            delivered(&bytes, &mut found);
            // Before the arm has them: where it truly is, it is without them.
            self.gate.note_delivered(self.connection, found.into_iter());
        }
        self.gate.note_bytes(self.connection, self.way, &bytes);
        self.ends.write(self.way, &bytes)
    }
}
