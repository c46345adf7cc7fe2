//! A wire between a run and its arm that a test can cut, hold and slow down, and that remembers what went over it:
//! every byte, and every setpoint in radians, when the run sent it and when it was delivered to the arm.
//!
//! ```text
//! run ──▶ [sent] ── gate: pass, hold, drop, trickle ── [delivered] ──▶ emulator
//!     ◀──────────── gate ─────────────────────────────────────────────
//! ```

pub mod arms;
pub mod can;
pub mod decode;
pub mod judge;
pub mod lying;
mod lying_script;
pub mod paused;
pub mod paused_peer;
pub mod paused_run;
pub mod stream;
pub mod watch;

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use dimos::clock::{Clock, Mono, MonotonicClock};

/// What a stall does to the traffic. What was held goes out at once when it is over.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stall {
    /// Nothing passes either way; it is kept.
    Both,
    /// What the run sends is kept; what the arm says passes.
    ToArm,
    /// What the arm says is kept; what the run sends passes.
    FromArm,
    /// What is sent meanwhile is lost, both ways.
    Drop,
    /// A byte (a frame on a CAN bus) every 2 ms, both ways.
    Trickle,
}

/// Which way bytes go.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Way {
    ToArm,
    FromArm,
}

/// What becomes of traffic now.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Passage {
    Pass,
    Keep,
    Lose,
    Trickle,
}

/// Time between two bytes of a trickle.
pub const TRICKLE: Duration = Duration::from_millis(2);

/// A command of the run, as the arm's protocol sheet has it.
#[derive(Debug, Clone, PartialEq)]
pub enum What {
    /// A setpoint of a stream [rad].
    Position(Vec<f64>),
    /// Velocities [rad/s].
    Velocity(Vec<f64>),
    /// A target that the arm's controller plans its motion to [rad].
    Planned(Vec<f64>),
    Enable(bool),
    /// The arm's own number or name of the mode.
    Mode(String),
    Stop,
}

/// A command and when it went by.
#[derive(Debug, Clone)]
pub struct WireCommand {
    pub at: Mono,
    /// Counts the connections of the run to the arm.
    pub connection: usize,
    pub what: What,
    /// Where the joints truly were at that moment [rad].
    pub truth: Option<Vec<f64>>,
}

/// Bytes and when they went by.
#[derive(Debug, Clone)]
pub struct Passed {
    pub at: Mono,
    pub connection: usize,
    pub way: Way,
    pub bytes: Vec<u8>,
}

/// Finds commands in the bytes of one connection.
pub type Decoder = Box<dyn FnMut(&[u8], &mut Vec<What>) + Send>;
/// A decoder for a new connection.
pub type NewDecoder = Arc<dyn Fn() -> Decoder + Send + Sync>;
/// Where the joints truly are [rad].
pub type Truth = Arc<dyn Fn() -> Vec<f64> + Send + Sync>;

#[derive(Default)]
struct Log {
    sent: Vec<WireCommand>,
    delivered: Vec<WireCommand>,
    bytes: Vec<Passed>,
    connections: usize,
}

/// The gate in a wire and its memory. Clones are the same gate.
#[derive(Clone)]
pub struct Gate {
    stall: Arc<Mutex<Option<(Stall, Instant)>>>,
    log: Arc<Mutex<Log>>,
    truth: Truth,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

pub fn now() -> Mono {
    MonotonicClock.now()
}

impl Gate {
    pub fn new(truth: Truth) -> Self {
        Self { stall: Arc::default(), log: Arc::default(), truth }
    }

    /// Begins a stall. Answers when.
    pub fn stall(&self, stall: Stall, time: Duration) -> Mono {
        *lock(&self.stall) = Some((stall, Instant::now() + time));
        now()
    }

    /// What becomes of what comes now, and for how long that is known.
    fn passage(&self, way: Way) -> (Passage, Option<Duration>) {
        let mut stall = lock(&self.stall);
        let Some((kind, until)) = *stall else { return (Passage::Pass, None) };
        let left = until.saturating_duration_since(Instant::now());
        if left.is_zero() {
            *stall = None;
            return (Passage::Pass, None);
        }
        let passage = match (kind, way) {
            (Stall::Both, _) | (Stall::ToArm, Way::ToArm) | (Stall::FromArm, Way::FromArm) => Passage::Keep,
            (Stall::Drop, _) => Passage::Lose,
            (Stall::Trickle, _) => Passage::Trickle,
            _ => Passage::Pass,
        };
        (passage, Some(left))
    }

    /// The stall that is on.
    pub fn kind(&self) -> Option<Stall> {
        self.passage(Way::ToArm);
        lock(&self.stall).map(|(kind, _)| kind)
    }

    fn new_connection(&self) -> usize {
        let mut log = lock(&self.log);
        log.connections += 1;
        log.connections
    }

    fn note_sent(&self, connection: usize, what: impl Iterator<Item = What>) {
        for what in what {
            let truth = Some((self.truth)());
            lock(&self.log).sent.push(WireCommand { at: now(), connection, what, truth });
        }
    }

    fn note_delivered(&self, connection: usize, what: impl Iterator<Item = What>) {
        for what in what {
            let truth = Some((self.truth)());
            lock(&self.log).delivered.push(WireCommand { at: now(), connection, what, truth });
        }
    }

    fn note_bytes(&self, connection: usize, way: Way, bytes: &[u8]) {
        lock(&self.log).bytes.push(Passed { at: now(), connection, way, bytes: bytes.to_vec() });
    }

    /// Forgets what went by.
    pub fn forget(&self) {
        let mut log = lock(&self.log);
        let connections = log.connections;
        *log = Log { connections, ..Log::default() };
    }

    /// What the run sent, in order.
    pub fn sent(&self) -> Vec<WireCommand> {
        lock(&self.log).sent.clone()
    }

    /// What reached the arm, in order.
    pub fn delivered(&self) -> Vec<WireCommand> {
        lock(&self.log).delivered.clone()
    }

    /// Every byte that was delivered, either way.
    pub fn bytes(&self) -> Vec<Passed> {
        lock(&self.log).bytes.clone()
    }

    /// How fast the last two delivered setpoints move each joint [rad/s], at a setpoint every `period` [s]; in velocity
    /// mode the last velocities.
    pub fn speed(&self, period: f64) -> Vec<f64> {
        let log = lock(&self.log);
        let points = |t: &WireCommand| matches!(t.what, What::Position(_) | What::Velocity(_)).then(|| t.what.clone());
        let mut last = log.delivered.iter().rev().filter_map(points);
        match (last.next(), last.next()) {
            (Some(What::Position(b)), Some(What::Position(a))) => {
                b.iter().zip(a).map(|(b, a)| (b - a) / period).collect()
            }
            (Some(What::Velocity(v)), _) => v,
            _ => Vec::new(),
        }
    }
}
