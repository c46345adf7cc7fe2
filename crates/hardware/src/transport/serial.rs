//! A serial line to a controller: 8 data bits, no parity, 1 stop bit, no flow control, any rate that the hardware
//! supports.
//!
//! The line belongs to one program: a second one is refused. DTR and RTS go up when the line is opened, as the kernel
//! always does, and stay up when it is closed: a board that restarts on a change of DTR restarts on the first opening
//! only, and not on each reconnect. Older bytes are discarded.

use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{FlockOperation, Mode, OFlags, flock, open};
use rustix::io::Errno;
use rustix::termios::{
    ControlModes, OptionalActions, QueueSelector, Termios, ioctl_tiocexcl, isatty, tcflush, tcgetattr, tcsetattr,
};

use super::capture::Tap;
use super::incoming::Incoming;
pub use super::incoming::Scan;
pub use super::pty::Pty;
use super::serial_ports;
use crate::adapter::{AdapterError, AdapterResult};

/// Maximum error of the hardware's rate [%]; a character of 10 bits tolerates about twice that.
const RATE_TOLERANCE: u32 = 2;

/// Address of a controller on a serial line: `/dev/ttyUSB0`, `/dev/ttyUSB0@115200`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SerialAddress {
    /// The device.
    pub path: String,
    /// Rate of the line [bit/s].
    pub baud: u32,
}

impl SerialAddress {
    /// Parses `PATH[@BAUD]`; the error is a sentence without full stop. Opens nothing.
    pub fn parse(address: &str, default_baud: u32) -> Result<Self, String> {
        let (path, baud) = match address.rsplit_once('@') {
            None => (address, default_baud),
            Some((path, rate)) => match rate.parse() {
                Ok(baud @ 1200..=4_000_000) => (path, baud),
                _ => return Err(format!("{rate:?} is not a rate (1200 to 4000000 bit/s)")),
            },
        };
        check_path(path)?;
        Ok(Self { path: path.to_owned(), baud })
    }
}

impl std::fmt::Display for SerialAddress {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}@{}", self.path, self.baud)
    }
}

/// Checks that a path can be that of a serial device; the error is a sentence without full stop. Opens nothing.
pub(super) fn check_path(path: &str) -> Result<(), String> {
    if path.starts_with('/') && !path.ends_with('/') && !path.contains('\0') {
        return Ok(());
    }
    Err(format!("{path:?} is not the path of a serial device, such as /dev/ttyUSB0"))
}

/// A serial line with frames in both directions.
#[derive(Debug)]
pub struct SerialLink {
    line: OwnedFd,
    peer: String,
    incoming: Incoming,
    /// Timeout of a write.
    timeout: Duration,
    tap: Tap,
}

impl SerialLink {
    /// Closes the line and discards unsent bytes.
    pub fn abort(self) {
        // A line that cannot be flushed is broken already.
        let _ = self.discard();
    }

    /// Discards unsent bytes.
    pub fn discard(&self) -> AdapterResult<()> {
        tcflush(&self.line, QueueSelector::OFlush).map_err(|e| broken(&self.peer, e))
    }

    /// Opens the serial device at `path` with `baud` [bit/s]. `device` names the arm in messages, `timeout` limits each
    /// write. Does not show whether a controller is connected.
    pub fn connect(device: &str, path: &str, baud: u32, timeout: Duration) -> AdapterResult<Self> {
        let line = open_line(device, path, baud)?;
        let tap = Tap::open(|| path.to_owned(), false, None);
        Ok(Self { line, peer: format!("{device} at {path}"), incoming: Incoming::new(), timeout, tap })
    }

    /// Returns the device and its path, for messages.
    pub fn peer(&self) -> &str {
        &self.peer
    }

    /// Passes all of `bytes` to the system, which sends them at the line's rate. `Timeout` if that is too slow; the
    /// line stays usable.
    pub fn send(&mut self, bytes: &[u8]) -> AdapterResult<()> {
        self.tap.sent(bytes);
        let deadline = Instant::now() + self.timeout;
        let mut rest = bytes;
        while !rest.is_empty() {
            match rustix::io::write(&self.line, rest) {
                Ok(n) => rest = rest.get(n..).unwrap_or_default(),
                Err(Errno::INTR) => {}
                Err(Errno::AGAIN) => {
                    let left = deadline.saturating_duration_since(Instant::now());
                    if left.is_zero() || !wait(&self.line, PollFlags::OUT, left).map_err(|e| broken(&self.peer, e))? {
                        let limit = self.timeout;
                        return Err(AdapterError::Timeout(format!("{} took no bytes within {limit:?}", self.peer)));
                    }
                }
                Err(e) => return Err(broken(&self.peer, e)),
            }
        }
        Ok(())
    }

    /// Waits up to `timeout` for a frame. `scan` gets the received bytes from the first one on, until it takes a frame;
    /// it must skip everything else. `Timeout` leaves the line usable; `Io` does not.
    pub fn receive<T>(&mut self, timeout: Duration, scan: impl FnMut(&[u8]) -> Scan<T>) -> AdapterResult<T> {
        let Self { line, peer, incoming, tap, .. } = self;
        incoming.receive(peer, timeout, scan, |room, left| {
            if wait(&*line, PollFlags::IN, left).map_err(|e| broken(peer, e))? {
                let n = read_line(line, peer, room)?;
                tap.received(room.get(..n).unwrap_or_default());
                Ok(n)
            } else {
                Ok(0)
            }
        })
    }
}

impl SerialLink {
    /// Discards everything received so far.
    pub fn drain(&mut self) -> AdapterResult<()> {
        self.incoming.clear();
        tcflush(&self.line, QueueSelector::IFlush).map_err(|e| broken(&self.peer, e))
    }
}

impl AsFd for SerialLink {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.line.as_fd()
    }
}

/// Opens a serial device for exclusive use, raw, with `baud` [bit/s]. Reads and writes do not block.
pub(super) fn open_line(device: &str, path: &str, baud: u32) -> AdapterResult<OwnedFd> {
    let failed = |why: String| AdapterError::Io(format!("cannot open serial device {path} for {device}: {why}"));
    let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
    let line = open(path, flags, Mode::empty()).map_err(|e| failed(open_error(path, e)))?;
    if !isatty(&line) {
        return Err(failed("it is not a serial device".to_owned()));
    }
    // The first lock excludes programs without locks, except those of root; the second excludes programs that check it.
    ioctl_tiocexcl(&line).map_err(|e| failed(e.to_string()))?;
    flock(&line, FlockOperation::NonBlockingLockExclusive).map_err(|e| failed(open_error(path, e)))?;
    let prepare = || -> rustix::io::Result<u32> {
        let mut settings = tcgetattr(&line)?;
        make_raw(&mut settings);
        settings.set_speed(baud)?;
        tcsetattr(&line, OptionalActions::Now, &settings)?;
        tcflush(&line, QueueSelector::IOFlush)?;
        Ok(tcgetattr(&line)?.output_speed())
    };
    let runs_at = prepare().map_err(|e| failed(e.to_string()))?;
    if u64::from(runs_at.abs_diff(baud)) * 100 > u64::from(baud) * u64::from(RATE_TOLERANCE) {
        return Err(failed(format!("it cannot run at {baud} bit/s, only at {runs_at}")));
    }
    Ok(line)
}

/// Sets 8N1, no flow control, no modem lines, raw bytes; DTR stays up when the line is closed.
pub(super) fn make_raw(settings: &mut Termios) {
    use ControlModes as C;
    settings.make_raw();
    settings.control_modes &= !(C::CSIZE | C::PARENB | C::CSTOPB | C::CRTSCTS | C::HUPCL);
    settings.control_modes |= C::CS8 | C::CREAD | C::CLOCAL;
}

/// Reads what has arrived on a readable line; 0 if nothing has.
pub(super) fn read_line(line: &OwnedFd, peer: &str, room: &mut [u8]) -> AdapterResult<usize> {
    match rustix::io::read(line, room) {
        // End of file: the line was hung up.
        Ok(0) => Err(broken(peer, Errno::IO)),
        Ok(n) => Ok(n),
        Err(Errno::AGAIN | Errno::INTR) => Ok(0),
        Err(e) => Err(broken(peer, e)),
    }
}

/// Waits up to `timeout` until `fd` is readable or writable, or broken, which the next call reports.
pub(super) fn wait(fd: impl AsFd, flags: PollFlags, timeout: Duration) -> rustix::io::Result<bool> {
    let timeout = Timespec { tv_sec: timeout.as_secs() as i64, tv_nsec: timeout.subsec_nanos() as i64 };
    match poll(&mut [PollFd::new(&fd, flags)], Some(&timeout)) {
        Ok(n) => Ok(n > 0),
        Err(Errno::INTR) => Ok(true),
        Err(e) => Err(e),
    }
}

/// Returns the error of a broken line.
pub(super) fn broken(peer: &str, error: Errno) -> AdapterError {
    let why = match error {
        Errno::IO | Errno::NODEV | Errno::NXIO => "the serial device is gone (unplugged?)".to_owned(),
        error => error.to_string(),
    };
    AdapterError::Io(format!("the connection to {peer} broke: {why}"))
}

/// Returns why a serial device cannot be opened, with a hint.
fn open_error(path: &str, error: Errno) -> String {
    match error {
        Errno::NOENT | Errno::NODEV | Errno::NXIO => format!("there is no such device\nhint: {}", list_devices()),
        Errno::ACCESS | Errno::PERM => "permission denied\nhint: join the group that owns serial devices: \
                                        sudo usermod -aG dialout $USER; then log in again"
            .to_owned(),
        Errno::BUSY | Errno::AGAIN => {
            format!("another program uses it\nhint: end it: `dimos status` shows runs, `fuser -v {path}` any program")
        }
        error => error.to_string(),
    }
}

/// Lists the serial devices of this computer.
fn list_devices() -> String {
    let found: Vec<String> = serial_ports::list().into_iter().map(|port| port.path).collect();
    match found.as_slice() {
        [] => "this computer has no serial device; check that the adapter is plugged in".to_owned(),
        found => format!("available serial devices: {}", found.join(", ")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses() {
        let full = |address| SerialAddress::parse(address, 1_000_000).map(|line| line.to_string());
        assert_eq!(full("/dev/ttyUSB0"), Ok("/dev/ttyUSB0@1000000".into()));
        assert_eq!(full("/dev/ttyUSB0@115200"), Ok("/dev/ttyUSB0@115200".into()));
        for bad in ["", "ttyUSB0", "/dev/", "/dev/ttyUSB0@", "/dev/ttyUSB0@fast", "/dev/ttyUSB0@0"] {
            assert!(full(bad).is_err(), "{bad:?}");
        }
    }

    const WAIT: Duration = Duration::from_secs(10);

    fn link(pty: &Pty, baud: u32) -> SerialLink {
        SerialLink::connect("test", pty.path(), baud, WAIT).unwrap()
    }

    /// Lines that end with `\n`.
    fn scan(bytes: &[u8]) -> Scan<Vec<u8>> {
        match bytes.iter().position(|b| *b == b'\n') {
            Some(end) => Scan::Take(end + 1, bytes[..end].to_vec()),
            None => Scan::More,
        }
    }

    #[test]
    fn every_byte_goes_through_as_it_is() {
        let pty = Pty::open().unwrap();
        let mut link = link(&pty, 115_200);
        let bytes: Vec<u8> = (0..=255).collect();
        link.send(&bytes).unwrap();
        let mut got = Vec::new();
        let mut room = [0; 100];
        while got.len() < bytes.len() {
            let n = pty.read(&mut room, WAIT).unwrap();
            assert!(n > 0, "after {} bytes", got.len());
            got.extend_from_slice(&room[..n]);
        }
        assert_eq!(got, bytes);
        assert_eq!(pty.write(&bytes).unwrap(), 256);
        let all = |bytes: &[u8]| if bytes.len() < 256 { Scan::More } else { Scan::Take(256, bytes.to_vec()) };
        assert_eq!(link.receive(WAIT, all), Ok(bytes));
    }

    #[test]
    fn frames_arrive_in_pieces() {
        let pty = Pty::open().unwrap();
        let mut link = link(&pty, 9600);
        for piece in ["on", "e\ntw", "o\nth"] {
            pty.write(piece.as_bytes()).unwrap();
        }
        assert_eq!(link.receive(WAIT, scan), Ok(b"one".to_vec()));
        assert_eq!(link.receive(WAIT, scan), Ok(b"two".to_vec()));
        let late = link.receive(Duration::from_millis(20), scan);
        assert!(matches!(late, Err(AdapterError::Timeout(_))), "{late:?}");
        pty.write(b"ree\n").unwrap();
        assert_eq!(link.receive(WAIT, scan), Ok(b"three".to_vec()), "a timeout loses nothing");
    }

    #[test]
    fn the_line_is_raw_and_has_any_rate() {
        let pty = Pty::open().unwrap();
        for baud in [9600, 57_600, 250_000, 1_000_000, 1_234_567] {
            let link = link(&pty, baud);
            let settings = tcgetattr(&link).unwrap();
            assert_eq!((settings.input_speed(), settings.output_speed()), (baud, baud));
            let modes = settings.control_modes;
            assert!(modes.contains(ControlModes::CS8 | ControlModes::CREAD | ControlModes::CLOCAL), "{modes:?}");
            let bad = ControlModes::PARENB | ControlModes::CSTOPB | ControlModes::CRTSCTS | ControlModes::HUPCL;
            assert!(!modes.intersects(bad), "{modes:?}");
        }
    }

    #[test]
    fn a_second_program_is_refused_until_the_first_ends() {
        let pty = Pty::open().unwrap();
        let first = link(&pty, 9600);
        let error = SerialLink::connect("test", pty.path(), 9600, WAIT).unwrap_err().to_string();
        let what =
            format!("cannot open serial device {} for test: another program uses it\nhint: end it: ", pty.path());
        assert!(error.starts_with(&what), "{error}");
        drop(first);
        link(&pty, 9600);
    }

    #[test]
    fn bytes_from_before_the_opening_are_discarded() {
        let pty = Pty::open().unwrap();
        pty.write(b"old\n").unwrap();
        let mut link = link(&pty, 9600);
        pty.write(b"new\n").unwrap();
        assert_eq!(link.receive(WAIT, scan), Ok(b"new".to_vec()));
    }

    #[test]
    fn received_bytes_can_be_discarded() {
        let pty = Pty::open().unwrap();
        let mut link = link(&pty, 9600);
        pty.write(b"one\ntw").unwrap();
        assert_eq!(link.receive(WAIT, scan), Ok(b"one".to_vec()));
        pty.write(b"o\nthree\n").unwrap();
        std::thread::sleep(Duration::from_millis(20));
        link.drain().unwrap();
        pty.write(b"four\n").unwrap();
        assert_eq!(link.receive(WAIT, scan), Ok(b"four".to_vec()));
    }

    #[test]
    fn an_unplugged_device_is_an_io_error_both_ways() {
        let pty = Pty::open().unwrap();
        let mut link = link(&pty, 9600);
        drop(pty);
        let gone = AdapterError::Io(format!(
            "the connection to {} broke: the serial device is gone (unplugged?)",
            link.peer()
        ));
        assert_eq!(link.receive(WAIT, scan), Err(gone.clone()));
        assert_eq!(link.send(b"x"), Err(gone));
    }

    #[test]
    fn a_peer_that_reads_nothing_does_not_block_forever() {
        let pty = Pty::open().unwrap();
        let mut link = SerialLink::connect("test", pty.path(), 9600, Duration::from_millis(20)).unwrap();
        let result = (0..1000).try_for_each(|_| link.send(&[0; 4096]));
        assert!(matches!(result, Err(AdapterError::Timeout(_))), "{result:?}");
    }

    #[test]
    fn an_endless_frame_is_an_error_not_a_hang() {
        let pty = Pty::open().unwrap();
        let mut link = link(&pty, 9600);
        let mut feed = || {
            pty.write(&[b'x'; 512]).unwrap();
            link.receive::<()>(Duration::from_millis(1), |_| Scan::More)
        };
        let ended = |result: &AdapterResult<()>| !matches!(result, Err(AdapterError::Timeout(_)));
        let result = (0..100).map(|_| feed()).find(ended).unwrap();
        assert!(matches!(result, Err(AdapterError::Protocol(_))), "{result:?}");
    }

    #[test]
    fn failures_say_what_to_do() {
        let error = |path| SerialLink::connect("test", path, 9600, WAIT).unwrap_err().to_string();
        let missing = error("/dev/ttyUSB77");
        assert!(
            missing.starts_with("cannot open serial device /dev/ttyUSB77 for test: there is no such device\nhint: ")
        );
        assert_eq!(error("/dev/null"), "cannot open serial device /dev/null for test: it is not a serial device");
        let denied = open_error("/dev/ttyUSB0", Errno::ACCESS);
        assert!(denied.contains("\nhint: ") && denied.contains("dialout"));
    }
}
