//! A CAN interface of the system, over a raw socket of Linux's SocketCAN.
//!
//! While no node acknowledges (the arm has lost power), the socket may have at most [`SEND_QUEUE`] frames in the
//! kernel's queues, and [`CanPort::waiting`] returns how many are not transmitted. Closing the socket does not take
//! them back: the kernel sends them when a node acknowledges again. Only taking the interface down (`ip link set can0
//! down`, a privilege) or a controller in one-shot mode discards them.
//!
//! The memory that the kernel charges the socket for a frame covers only the interface's queue: since Linux 5.10 it is
//! released when the driver takes the frame, and drivers have room for 10 and more. Therefore the socket also receives
//! its own frames (`CAN_RAW_RECV_OWN_MSGS`, marked `MSG_CONFIRM`): drivers of real controllers echo a frame after its
//! transmission. Interfaces without such a driver (vcan, vxcan, serial lines) echo it at once, but there the memory
//! shows the waiting frames.

use std::io::{Error, ErrorKind, IoSliceMut};
use std::os::fd::{AsFd, BorrowedFd};

use libc::{ENETDOWN, ENOBUFS, ENODEV};
use rustix::net::{RecvAncillaryBuffer, RecvFlags, recvmsg, sockopt};
use socketcan::{CanDataFrame, CanSocket, EmbeddedFrame, Socket, SocketOptions, StandardId};

use super::in_flight::InFlight;
use super::{CanEvent, CanFilter, CanFrame, CanPort, CanTrouble};
use crate::adapter::{AdapterError, AdapterResult};

/// Approximate maximum number of one socket's frames that wait in the kernel.
pub const SEND_QUEUE: usize = 16;
/// Memory that the kernel charges a socket for a classic frame [bytes].
const FRAME_MEMORY: usize = 768;
/// Requested size of the receive buffer [bytes]: a Piper fills it in about a second. The system may grant less.
const RECEIVE_BUFFER: usize = 1 << 20;
/// Directory of the kernel's network interfaces.
const INTERFACES_DIR: &str = "/sys/class/net";
/// A protocol error at this place is a missing acknowledgement (`linux/can/error.h`).
const LOCATION_ACK: u8 = 0x19;

/// A port on a CAN interface.
pub struct SocketPort {
    socket: CanSocket,
    /// The device and its interface, for messages.
    peer: String,
    /// Error of a broken port.
    broken: Option<AdapterError>,
    /// Frames that the socket had no room for, as counted by the kernel.
    lost: u32,
    /// Frames to receive, and own frames to track until they are transmitted. Without filters: all frames are received,
    /// none are tracked.
    filters: Vec<CanFilter>,
    in_flight: InFlight,
}

/// A frame of the kernel (`struct can_frame`), and whether this socket sent it.
struct Raw {
    id: u32,
    len: u8,
    data: [u8; 8],
    own: bool,
}

/// Opens a port on the CAN interface `name`.
pub fn open(device: &str, name: &str, filters: &[CanFilter]) -> AdapterResult<SocketPort> {
    let failed = |why: &str| AdapterError::Io(format!("cannot open CAN interface {name} for {device}: {why}"));
    let socket = CanSocket::open(name).map_err(|e| failed(&open_error(name, &e)))?;
    let prepare = || -> std::io::Result<()> {
        // The filter also covers these flags: no extended identifiers, no remote requests.
        let flags = libc::CAN_EFF_FLAG | libc::CAN_RTR_FLAG;
        let filter = |f: &CanFilter| (u32::from(f.id), u32::from(f.mask) | flags);
        let everything = CanFilter { id: 0, mask: 0 };
        let wanted = if filters.is_empty() { &[everything] } else { filters };
        socket.set_filters(&wanted.iter().map(filter).collect::<Vec<_>>())?;
        socket.set_error_filter_accept_all()?;
        // Programs on this computer receive each other's frames, so that an emulator can replace an arm.
        socket.set_loopback(true)?;
        socket.set_recv_own_msgs(!filters.is_empty())?;
        socket.set_nonblocking(true)?;
        // The kernel doubles both figures, to account for its own overhead.
        sockopt::set_socket_send_buffer_size(&socket, SEND_QUEUE * FRAME_MEMORY / 2)?;
        sockopt::set_socket_recv_buffer_size_force(&socket, RECEIVE_BUFFER)
            .or_else(|_| sockopt::set_socket_recv_buffer_size(&socket, RECEIVE_BUFFER))?;
        Ok(())
    };
    prepare().map_err(|e| failed(&e.to_string()))?;
    // Binding to an interface that is down succeeds; the socket then has a pending error.
    if let Ok(Err(errno)) = sockopt::socket_error(&socket) {
        return Err(failed(&open_error(name, &errno.into())));
    }
    // Without a carrier the kernel drops frames and reports them as sent.
    if std::fs::read_to_string(format!("{INTERFACES_DIR}/{name}/carrier")).is_ok_and(|carrier| carrier.trim() == "0") {
        return Err(failed(&format!(
            "it has no carrier: its controller is bus-off, or the other end of a virtual pair is down\nhint: check the \
             wiring, the terminators and the bit rate; then ip link set {name} down; ip link set {name} up (as root)"
        )));
    }
    let (peer, filters) = (format!("{device} at {name}"), filters.to_vec());
    Ok(SocketPort { socket, peer, broken: None, lost: 0, filters, in_flight: InFlight::new() })
}

/// Returns why an interface cannot be opened, with a hint.
fn open_error(name: &str, error: &Error) -> String {
    match error.raw_os_error() {
        Some(ENETDOWN) => format!(
            "the interface is down\nhint: ip link set {name} up type can bitrate 1000000 (as root; for a virtual \
             interface: ip link set {name} up)"
        ),
        Some(ENODEV) if std::path::Path::new(INTERFACES_DIR).join(name).exists() => {
            format!("it is no CAN interface\nhint: {}", list_interfaces())
        }
        Some(ENODEV) if name.starts_with("vcan") => {
            format!("there is no such interface\nhint: ip link add {name} type vcan && ip link set {name} up (as root)")
        }
        Some(ENODEV) => format!("there is no such interface\nhint: {}", list_interfaces()),
        Some(libc::EAFNOSUPPORT | libc::EPROTONOSUPPORT) => {
            "this kernel has no CAN\nhint: modprobe can-raw (as root), or a kernel with CAN".to_owned()
        }
        _ => error.to_string(),
    }
}

/// Lists the CAN interfaces of this computer.
fn list_interfaces() -> String {
    /// `ARPHRD_CAN` of the kernel.
    const CAN_TYPE: &str = "280";
    let is_can = |entry: &std::fs::DirEntry| {
        std::fs::read_to_string(entry.path().join("type")).is_ok_and(|kind| kind.trim() == CAN_TYPE)
    };
    let entries = std::fs::read_dir(INTERFACES_DIR).into_iter().flatten().flatten();
    let mut names: Vec<_> =
        entries.filter(is_can).map(|entry| entry.file_name().to_string_lossy().into_owned()).collect();
    names.sort();
    match names.as_slice() {
        [] => "no CAN interface is there (see: ip link); plug in the CAN adapter, or load its driver".to_owned(),
        names => format!("the CAN interfaces here are {}", names.join(", ")),
    }
}

impl SocketPort {
    fn usable(&self) -> AdapterResult<()> {
        self.broken.clone().map_or(Ok(()), Err)
    }

    fn break_down(&mut self, error: &Error) -> AdapterError {
        let why = match error.raw_os_error() {
            Some(ENETDOWN) => "the interface went down".to_owned(),
            Some(ENODEV | libc::ENXIO) => "the interface is gone".to_owned(),
            _ => error.to_string(),
        };
        let error = AdapterError::Io(format!("the connection to {} broke: {why}", self.peer));
        self.broken = Some(error.clone());
        error
    }

    /// Returns the next frame in the socket's buffer.
    fn read(&self) -> std::io::Result<Raw> {
        /// Identifier (4 bytes), length (1), padding (3), data (8).
        const SIZE: usize = 16;
        let mut room = [0; SIZE];
        let mut control = RecvAncillaryBuffer::default();
        let got = recvmsg(&self.socket, &mut [IoSliceMut::new(&mut room)], &mut control, RecvFlags::empty())?;
        let own = got.flags.bits() & libc::MSG_CONFIRM as u32 != 0;
        let [a, b, c, d, len, _, _, _, data @ ..] = room;
        Ok(Raw { id: u32::from_ne_bytes([a, b, c, d]), len: len.min(8), data, own })
    }

    /// Returns the kernel's figures of the socket: its send memory [bytes], and how many frames it had no room for.
    fn figures(&self) -> Option<(usize, u32)> {
        let mut bytes = [0; 9 * 4];
        let read = self.socket.get_socket_option_bytes(libc::SOL_SOCKET, libc::SO_MEMINFO, &mut bytes).ok()?;
        let figure = |index: libc::c_int| {
            let at = index as usize * 4;
            let word = bytes.get(..read)?.get(at..at + 4)?;
            Some(u32::from_ne_bytes(word.try_into().ok()?))
        };
        Some((figure(libc::SK_MEMINFO_WMEM_ALLOC)? as usize, figure(libc::SK_MEMINFO_DROPS)?))
    }
}

impl CanPort for SocketPort {
    fn send(&mut self, frames: &[CanFrame]) -> AdapterResult<usize> {
        self.usable()?;
        for (taken, frame) in frames.iter().enumerate() {
            let made = StandardId::new(frame.id).and_then(|id| CanDataFrame::new(id, frame.bytes()));
            let Some(data) = made else {
                return Err(AdapterError::Protocol(format!("{:#x} is no CAN identifier of 11 bits", frame.id)));
            };
            if self.in_flight.len() >= SEND_QUEUE {
                return Ok(taken);
            }
            match self.socket.write_frame(&data) {
                Ok(()) if !self.filters.is_empty() && CanFilter::any(&self.filters, frame.id) => {
                    self.in_flight.sent(CanFrame::new(frame.id, frame.bytes()));
                }
                Ok(()) => {}
                // The queue of the socket, or of the interface, is full.
                Err(e) if e.kind() == ErrorKind::WouldBlock || e.raw_os_error() == Some(ENOBUFS) => return Ok(taken),
                Err(e) => return Err(self.break_down(&e)),
            }
        }
        Ok(frames.len())
    }

    fn receive(&mut self) -> AdapterResult<Option<CanEvent>> {
        self.usable()?;
        // Its own frames are skipped: at most as many as can be in flight.
        for _ in 0..=SEND_QUEUE {
            match self.read() {
                Ok(frame) if frame.id & libc::CAN_ERR_FLAG != 0 => {
                    return Ok(Some(CanEvent::Trouble(trouble(frame.id, frame.data))));
                }
                Ok(frame) => {
                    let bytes = frame.data.get(..usize::from(frame.len)).unwrap_or(&frame.data);
                    let heard = CanFrame::new((frame.id & libc::CAN_SFF_MASK) as u16, bytes);
                    if !frame.own {
                        return Ok(Some(CanEvent::Frame(heard)));
                    }
                    self.in_flight.confirmed(&heard);
                }
                Err(e) if e.kind() == ErrorKind::WouldBlock => {
                    // All frames are read: check whether some were lost.
                    let lost = self.figures().map_or(self.lost, |(_, lost)| lost);
                    let fresh = lost != self.lost;
                    self.lost = lost;
                    if fresh {
                        // Echoes may be among the lost frames; a busy bus has transmitted what was sent before.
                        self.in_flight.clear();
                    }
                    return Ok(fresh.then_some(CanEvent::Trouble(CanTrouble::Overflow)));
                }
                Err(e) if e.kind() == ErrorKind::Interrupted => return Ok(None),
                Err(e) => return Err(self.break_down(&e)),
            }
        }
        Ok(None)
    }

    fn fd(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }

    fn waiting(&self) -> usize {
        let queued = self.figures().map_or(0, |(memory, _)| memory.div_ceil(FRAME_MEMORY));
        queued.max(self.in_flight.len())
    }
}

/// Returns the trouble that an error frame reports; the worst if it reports several.
fn trouble(id: u32, data: [u8; 8]) -> CanTrouble {
    let class = id & libc::CAN_ERR_MASK;
    let [_, controller, _, location, ..] = data;
    let controller = |bits: libc::c_int| class & libc::CAN_ERR_CRTL != 0 && libc::c_int::from(controller) & bits != 0;
    let no_ack = class & libc::CAN_ERR_PROT != 0 && location == LOCATION_ACK;
    match class {
        class if class & libc::CAN_ERR_BUSOFF != 0 => CanTrouble::BusOff,
        class if class & libc::CAN_ERR_ACK != 0 || no_ack => CanTrouble::NoAcknowledge,
        _ if controller(libc::CAN_ERR_CRTL_RX_PASSIVE | libc::CAN_ERR_CRTL_TX_PASSIVE) => CanTrouble::Passive,
        _ if controller(libc::CAN_ERR_CRTL_RX_OVERFLOW | libc::CAN_ERR_CRTL_TX_OVERFLOW) => CanTrouble::Overflow,
        class if class & libc::CAN_ERR_RESTARTED != 0 => CanTrouble::Restarted,
        _ if controller(libc::CAN_ERR_CRTL_ACTIVE) => CanTrouble::Restarted,
        class => CanTrouble::Other(class),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Error frames as drivers make them: class bits, then the data bytes (`linux/can/error.h`).
    #[test]
    fn error_frames_are_distinguished() {
        let reported = |class: u32, data: [u8; 8]| {
            let made = socketcan::CanErrorFrame::new_error(class, &data).unwrap();
            let frame: &libc::can_frame = made.as_ref();
            trouble(frame.can_id, frame.data)
        };
        assert_eq!(reported(0x40, [0; 8]), CanTrouble::BusOff);
        assert_eq!(reported(0x20, [0; 8]), CanTrouble::NoAcknowledge);
        assert_eq!(reported(0x08, [0, 0, 0, 0x19, 0, 0, 0, 0]), CanTrouble::NoAcknowledge);
        assert_eq!(reported(0x08, [0, 0, 4, 0x08, 0, 0, 0, 0]), CanTrouble::Other(0x08));
        assert_eq!(reported(0x204, [0, 0x20, 0, 0, 0, 0, 128, 0]), CanTrouble::Passive);
        assert_eq!(reported(0x204, [0, 0x10, 0, 0, 0, 0, 0, 128]), CanTrouble::Passive);
        assert_eq!(reported(0x204, [0, 0x08, 0, 0, 0, 0, 97, 0]), CanTrouble::Other(0x204), "a warning");
        assert_eq!(reported(0x04, [0, 0x01, 0, 0, 0, 0, 0, 0]), CanTrouble::Overflow);
        assert_eq!(reported(0x204, [0, 0x40, 0, 0, 0, 0, 0, 0]), CanTrouble::Restarted);
        assert_eq!(reported(0x100, [0; 8]), CanTrouble::Restarted);
        assert_eq!(reported(0x44 | 0x20, [0, 0x20, 0, 0, 0, 0, 0, 0]), CanTrouble::BusOff, "the worst of them");
    }

    #[test]
    fn an_interface_that_is_missing_is_named() {
        let error = open("piper", "nosuchcan7", &[]).err().unwrap().to_string();
        assert!(error.starts_with("cannot open CAN interface nosuchcan7 for piper: "), "{error}");
        assert!(error.contains("\nhint: "), "{error}");
    }

    #[test]
    fn an_interface_of_another_kind_is_named() {
        let error = open("piper", "lo", &[]).err().unwrap().to_string();
        assert!(error.contains("\nhint: "), "{error}");
        // A kernel with CAN reports that `lo` is no CAN interface; one without, that it has no CAN.
        assert!(error.contains("no CAN"), "{error}");
    }
}
