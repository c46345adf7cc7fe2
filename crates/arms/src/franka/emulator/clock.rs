//! The controller's clock: a thread with absolute deadlines, one cycle and one state each. It waits for a client's
//! command only where the settings say so.

use std::net::{SocketAddr, UdpSocket};
use std::os::fd::AsFd;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::control::Control;
use dimos_core::clock::{Clock, Mono, MonotonicClock};
use dimos_hardware::sim::tcp_server::TcpServer;
use dimos_rt::histogram::Histogram;
use dimos_rt::{arrival, host};

/// A cycle that begins later than this leaves its client too little time: the clock continues from there.
const LATE: Duration = Duration::from_micros(300);
/// Cycles between two states of the hand.
const HAND: u64 = 10;
/// Longest command that is received [bytes], and the most of them in a cycle.
const BUFFER: usize = 512;
const MOST: usize = 64;

/// What the network does to datagrams, each way: shares from 0 to 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Network {
    pub lose: f64,
    pub repeat: f64,
    pub reorder: f64,
}

/// Datagrams on their way.
struct Way {
    network: Network,
    random: u64,
    /// One that the next one overtakes.
    held: Option<(SocketAddr, Vec<u8>)>,
}

impl Way {
    fn new(network: Network, seed: u64) -> Self {
        Self { network, random: seed, held: None }
    }

    /// Returns true in a share of all calls.
    fn chance(&mut self, share: f64) -> bool {
        if share <= 0.0 {
            return false;
        }
        self.random ^= self.random << 13;
        self.random ^= self.random >> 7;
        self.random ^= self.random << 17;
        ((self.random >> 11) as f64 / (1_u64 << 53) as f64) < share
    }

    /// Passes a datagram on: once, twice, after the next one, or not at all.
    fn pass(&mut self, at: SocketAddr, bytes: &[u8], mut to: impl FnMut(SocketAddr, &[u8])) {
        if self.chance(self.network.lose) {
            return;
        }
        if self.held.is_none() && self.chance(self.network.reorder) {
            self.held = Some((at, bytes.to_vec()));
            return;
        }
        to(at, bytes);
        if self.chance(self.network.repeat) {
            to(at, bytes);
        }
        if let Some((at, bytes)) = self.held.take() {
            to(at, &bytes);
        }
    }
}

/// How the clock runs.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pace {
    /// How much slower than this computer's clock it is, as a fraction.
    pub drift: f64,
    /// Longest wait for the command that answers a state, after the next cycle is due.
    pub command_wait: Duration,
}

/// Returns whether a command has arrived, once it has; `false` at `due`.
fn readable_before(socket: &UdpSocket, due: Mono) -> bool {
    let left = due.since(MonotonicClock.now());
    let timeout = Timespec { tv_sec: 0, tv_nsec: left.subsec_nanos().into() };
    !left.is_zero() && matches!(poll(&mut [PollFd::new(socket, PollFlags::IN)], Some(&timeout)), Ok(1..))
}

/// Runs until `ends`. `answers` gets the time from each state to the command that was used.
pub(super) fn run(
    server: &Arc<TcpServer<Control>>,
    socket: &UdpSocket,
    ends: &AtomicBool,
    (network, pace): (Network, Pace),
    answers: &Histogram,
) {
    host::enter_realtime(host::EMULATOR_PRIORITY);
    let period = Duration::from_secs_f64(super::control::CYCLE * (1.0 + pace.drift));
    let (mut states, mut commands) = (Way::new(network, 0x9E37_79B9), Way::new(network, 0x7F4A_7C15));
    let mut buffer = [0; BUFFER];
    let mut due = MonotonicClock.now().after(period);
    let (mut sent, mut sent_before) = (due, due);
    // Whether a state of a motion is on its way to a client, and nothing has come from there since.
    let mut awaited = false;
    while !ends.load(Ordering::Acquire) {
        // Commands are taken as they come: when they came is measured.
        while readable_before(socket, if awaited { due.after(pace.command_wait) } else { due }) {
            awaited = false;
            server.with(|control, _| {
                for _ in 0..MOST {
                    let Ok((length, from)) = socket.recv_from(&mut buffer) else { break };
                    let arrived = arrival::of_last_packet(socket.as_fd()).unwrap_or_else(|_| MonotonicClock.now());
                    let bytes = buffer.get(..length).unwrap_or_default();
                    commands.pass(from, bytes, |_, bytes| {
                        if control.take_command(bytes) {
                            // One that arrived before the newest state answers the one before it.
                            let state = if arrived < sent { sent_before } else { sent };
                            answers.record(arrived.since(state).as_nanos() as u64);
                        }
                    });
                }
            });
        }
        let now = MonotonicClock.now();
        let late = now.since(due) > LATE;
        if late {
            due = now;
        }
        let (state, hand, moves) = server.with(|control, _| {
            control.figures.late_wakes += u64::from(late);
            let state = control.cycle();
            let hand = if control.id.is_multiple_of(HAND) { control.hand.state() } else { None };
            (state, hand, control.motion.is_some())
        });
        (sent_before, sent) = (sent, MonotonicClock.now());
        awaited = false;
        if let Some((to, bytes)) = state {
            states.pass(to, &bytes, |to, bytes| awaited |= socket.send_to(bytes, to).is_ok() && moves);
        }
        if let Some((to, bytes)) = hand {
            let _ = socket.send_to(&bytes, to);
        }
        due = due.after(period);
    }
}
