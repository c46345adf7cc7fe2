//! The adapter's end of the bus: which frames it wants, what happens to those that the bus does not take, and what
//! trouble means.

use std::os::fd::BorrowedFd;
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::feedback::Feedback;
use super::protocol::decode;
use dimos_core::clock::{Clock, MonotonicClock};
use dimos_hardware::adapter::{AdapterError, AdapterResult};
use dimos_hardware::transport::can::{self, CanAddress, CanEvent, CanFilter, CanFrame, CanPort, CanTrouble};

/// What the arm sends, and what it would send if it led other arms (0x15x, 0x3Ax).
const FILTERS: &[CanFilter] = &[
    CanFilter { id: 0x2A0, mask: 0x7F0 },
    CanFilter { id: 0x250, mask: 0x7F0 },
    CanFilter { id: 0x260, mask: 0x7F0 },
    CanFilter { id: 0x4AF, mask: 0x7FF },
    CanFilter { id: 0x150, mask: 0x7F0 },
    CanFilter { id: 0x3A0, mask: 0x7F0 },
    // Commands for the motors: those of other programs, and this one's until they are transmitted.
    CanFilter { id: 0x470, mask: 0x7FC },
    CanFilter { id: 0x474, mask: 0x7FE },
];
/// Frames that may wait for the bus: two setpoints of four frames. A healthy bus takes one in 1 ms, and what waits when
/// the arm loses its power reaches it when the power returns.
const MAY_WAIT: usize = 2 * SET_POINT;
/// Frames of a setpoint at most.
const SET_POINT: usize = 4;
/// Most events fetched in one go: a second's.
const BATCH: usize = 4096;

/// An open port.
pub struct Wire {
    port: Box<dyn CanPort>,
    /// The arm and its bus, for messages.
    peer: String,
    /// What waited when it was to be discarded must have gone before anything new is sent.
    discarding: bool,
    /// What was counted.
    pub counts: WireCounts,
}

/// What was counted since the port was opened.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct WireCounts {
    /// Frames that the bus did not take.
    pub not_taken: u64,
    /// Times that frames from the arm were lost because they were not fetched in time.
    pub overflows: u64,
    /// Reports of many errors on the bus, and of others that nothing follows from.
    pub complaints: u64,
}

impl Wire {
    /// Opens a port at `address`.
    pub fn open(address: &CanAddress) -> AdapterResult<Self> {
        let port = can::open("piper", address, FILTERS)?;
        Ok(Self { port, peer: format!("piper at {address}"), discarding: false, counts: WireCounts::default() })
    }

    /// Sends a command: an error unless the bus has taken all of it.
    pub fn send(&mut self, frames: &[CanFrame]) -> AdapterResult<()> {
        let waiting = self.port.waiting();
        self.discarding &= waiting > 0;
        let room = !self.discarding && waiting + frames.len() <= MAY_WAIT;
        let taken = if room { self.port.send(frames)? } else { 0 };
        self.counts.not_taken += (frames.len() - taken) as u64;
        if taken == frames.len() { Ok(()) } else { Err(self.no_room()) }
    }

    /// Whether no frame waits for the bus.
    pub fn is_clear(&self) -> bool {
        self.port.waiting() == 0
    }

    /// Whether another setpoint may wait for the bus.
    pub fn has_room(&self) -> bool {
        let waiting = self.port.waiting();
        if self.discarding { waiting == 0 } else { waiting + SET_POINT <= MAY_WAIT }
    }

    /// Takes back what has not left this computer. What cannot be taken back goes out before anything else: until then
    /// nothing is sent.
    pub fn discard(&mut self) -> AdapterResult<()> {
        self.discarding = self.port.discard()? > 0;
        Ok(())
    }

    fn no_room(&self) -> AdapterError {
        AdapterError::Io(format!(
            "{}: its bus takes no frames: the queue is full\nhint: no node acknowledges: is the arm powered, plugged \
             in, and the bus at 1 Mbit/s?",
            self.peer
        ))
    }

    /// Adds all that has arrived to the feedback, without waiting.
    pub fn drain(&mut self, feedback: &mut Feedback) -> AdapterResult<()> {
        for _ in 0..BATCH {
            match self.port.receive()? {
                None => break,
                Some(CanEvent::Frame(frame)) => feedback.take(decode(&frame), MonotonicClock.now()),
                Some(CanEvent::Trouble(trouble)) => self.apply_trouble(trouble)?,
            }
        }
        Ok(())
    }

    fn apply_trouble(&mut self, trouble: CanTrouble) -> AdapterResult<()> {
        let (what, hint) = match trouble {
            CanTrouble::BusOff => (
                "the CAN controller has left the bus after too many errors",
                "check cable, termination and bit rate (1 Mbit/s); then set the interface down and up",
            ),
            CanTrouble::NoAcknowledge => {
                ("no node acknowledges on its bus", "is the arm powered, plugged in, and the bus at 1 Mbit/s?")
            }
            CanTrouble::Overflow => {
                self.counts.overflows += 1;
                return Ok(());
            }
            CanTrouble::Passive | CanTrouble::Restarted | CanTrouble::Other(_) => {
                self.counts.complaints += 1;
                return Ok(());
            }
        };
        Err(AdapterError::Io(format!("the connection to {} broke: {what}\nhint: {hint}", self.peer)))
    }

    /// Waits until something has arrived, at most `timeout`.
    pub fn wait(&self, timeout: Duration) {
        let timeout = Timespec { tv_sec: timeout.as_secs() as i64, tv_nsec: timeout.subsec_nanos().into() };
        let _ = poll(&mut [PollFd::from_borrowed_fd(self.port.fd(), PollFlags::IN)], Some(&timeout));
    }

    /// Readable when something has arrived.
    pub fn fd(&self) -> BorrowedFd<'_> {
        self.port.fd()
    }
}

#[cfg(test)]
mod tests {
    use super::super::protocol::{Follow, joint_targets};
    use super::*;
    use dimos_hardware::transport::can::Bus;

    fn burst(n: i32) -> [CanFrame; 4] {
        joint_targets(100, Follow::Smooth, [n; 6])
    }

    /// The frames that another node has heard.
    fn heard(arm: &mut impl CanPort) -> Vec<CanFrame> {
        let frames = std::iter::from_fn(|| arm.receive().unwrap());
        frames.filter_map(|event| if let CanEvent::Frame(frame) = event { Some(frame) } else { None }).collect()
    }

    #[test]
    fn at_most_two_set_points_wait_and_they_can_be_taken_back() {
        let bus = Bus::new();
        let mut arm = bus.attach().unwrap();
        let mut wire = Wire::open(&bus.address()).unwrap();
        bus.withhold(100);
        let sent: Vec<bool> = (0..5).map(|n| wire.send(&burst(n)).is_ok()).collect();
        assert_eq!(sent, [true, true, false, false, false]);
        wire.discard().unwrap();
        assert_eq!(wire.send(&burst(7)), Ok(()), "there is room again");
        assert_eq!((bus.acknowledge(), heard(&mut arm)), (4, burst(7).to_vec()), "and nothing from before goes out");
    }

    #[test]
    fn what_cannot_be_taken_back_goes_out_before_anything_new() {
        let bus = Bus::new();
        let mut arm = bus.attach().unwrap();
        let mut wire = Wire::open(&bus.address()).unwrap();
        bus.keep_waiting(true);
        bus.withhold(100);
        wire.send(&burst(0)).unwrap();
        wire.discard().unwrap();
        let error = wire.send(&burst(1)).unwrap_err().to_string();
        assert!(error.contains("takes no frames"), "{error}");
        assert_eq!((bus.acknowledge(), heard(&mut arm)), (4, burst(0).to_vec()));
        assert_eq!((wire.send(&burst(2)), heard(&mut arm)), (Ok(()), burst(2).to_vec()));
    }
}
