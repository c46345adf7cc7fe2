//! The gate in a CAN bus: the run is on a bus in memory of its own, and its frames are brought over to the arm's.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use dimos::hardware::transport::can::bus::SEND_QUEUE;
use dimos::hardware::transport::can::{self, Bus, CanAddress, CanEvent, CanFrame, CanPort};
use dimos::rt::host;
use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::decode::piper;
use super::{Gate, Passage, Stall, TRICKLE, Way};

/// How often the thread checks the gate, so that a stall ends in time.
const LOOK: Duration = Duration::from_millis(1);

/// A bus in front of an emulator's. Ends when it is dropped.
pub struct CanProxy {
    pub address: String,
    closing: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl CanProxy {
    /// In front of the arm on the bus at `upstream`.
    ///
    /// In a stall towards the arm no node acknowledges what the run sends, as where the arm's plug is out: it
    /// waits in the queue of the computer's own controller, and nothing comes back. In the other stalls frames wait
    /// behind the bus, as in a gateway.
    pub fn start(upstream: &str, gate: &Gate) -> Self {
        let address = CanAddress::parse(upstream).unwrap();
        // A run locks its arm by the bus's number, and buses of other tests have numbers, too.
        let own = |bus: &Bus| matches!(bus.address(), CanAddress::Memory(n) if n > std::process::id() % 10_000);
        let bus = std::iter::repeat_with(Bus::new).find(own).unwrap();
        let closing = Arc::new(AtomicBool::new(false));
        let near = bus.attach().unwrap();
        let far = can::open("the wire of a test", &address, &[]).unwrap();
        let own = bus.address().to_string();
        let (gate, until) = (gate.clone(), closing.clone());
        let thread = std::thread::spawn(move || {
            host::enter_realtime(host::EMULATOR_PRIORITY);
            carry(&bus, Box::new(near), far, &gate, &until);
        });
        Self { address: own, closing, thread: Some(thread) }
    }
}

impl Drop for CanProxy {
    fn drop(&mut self) {
        self.closing.store(true, Ordering::Relaxed);
        drop(self.thread.take().map(JoinHandle::join));
    }
}

fn carry(bus: &Bus, mut near: Box<dyn CanPort>, mut far: Box<dyn CanPort>, gate: &Gate, closing: &AtomicBool) {
    let connection = gate.new_connection();
    let (mut sent, mut delivered) = (piper(), piper());
    let mut held: [VecDeque<CanFrame>; 2] = Default::default();
    let (mut withheld, mut next_frame) = (false, Instant::now());
    while !closing.load(Ordering::Relaxed) {
        let cut = matches!(gate.kind(), Some(Stall::Both | Stall::ToArm));
        match (cut, withheld) {
            (true, false) => bus.withhold(SEND_QUEUE),
            (false, true) => drop(bus.acknowledge()),
            _ => {}
        }
        withheld = cut;
        while let Ok(Some(CanEvent::Frame(frame))) = near.receive() {
            gate.note_sent(connection, sent(&frame).into_iter());
            held[0].push_back(frame);
        }
        while let Ok(Some(event)) = far.receive() {
            if let CanEvent::Frame(frame) = event {
                held[1].push_back(frame);
            }
        }
        let trickles = Instant::now() >= next_frame;
        for (way, held) in [Way::ToArm, Way::FromArm].into_iter().zip(&mut held) {
            let most = match gate.passage(way).0 {
                Passage::Pass if !cut => usize::MAX,
                Passage::Keep if !cut => 0,
                // What an arm says while its plug is out is lost.
                Passage::Pass | Passage::Keep | Passage::Lose => {
                    held.clear();
                    0
                }
                Passage::Trickle if trickles => 1,
                Passage::Trickle => 0,
            };
            for frame in held.drain(..most.min(held.len())) {
                let bytes = [&frame.id.to_be_bytes()[..], frame.bytes()].concat();
                gate.note_bytes(connection, way, &bytes);
                if way == Way::ToArm {
                    gate.note_delivered(connection, delivered(&frame).into_iter());
                    let _ = far.send(&[frame]);
                } else {
                    let _ = near.send(&[frame]);
                }
            }
        }
        if trickles {
            next_frame = Instant::now() + TRICKLE;
        }
        let timeout = Timespec { tv_sec: 0, tv_nsec: LOOK.subsec_nanos().into() };
        let (a, b) = (near.fd(), far.fd());
        let ends = &mut [PollFd::from_borrowed_fd(a, PollFlags::IN), PollFd::from_borrowed_fd(b, PollFlags::IN)];
        let _ = poll(ends, Some(&timeout));
    }
}
