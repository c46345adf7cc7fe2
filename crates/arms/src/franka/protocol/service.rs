//! Commands over TCP: a header of 12 bytes (command, number, whole length: u32 each), then values; the answer repeats
//! command and number, then has one byte of status and, for some, more. A motion is answered twice: when it has
//! started, and when it has ended.

use super::{DOF, Interface};
use dimos_hardware::transport::Scan;

/// Length of a header [bytes].
const HEADER: usize = 12;
/// Longest answer that is taken [bytes]: a description of the robot has less than this.
const LONGEST: usize = 1 << 20;

/// A command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Service {
    /// Begins the connection.
    Connect,
    /// Starts a motion.
    Move,
    /// Ends it.
    StopMove,
    /// Thresholds of contacts and collisions.
    SetCollisionBehavior,
    /// Stiffness of the joints.
    SetJointImpedance,
    /// Load at the flange.
    SetLoad,
    /// Clears errors.
    AutomaticErrorRecovery,
    /// The robot's description (interface 10).
    GetRobotModel,
}

impl Service {
    fn code(self, interface: Interface) -> u32 {
        let (five, ten) = match self {
            Self::Connect => (0, 0),
            Self::Move => (1, 1),
            Self::StopMove => (2, 2),
            Self::SetCollisionBehavior => (4, 3),
            Self::SetJointImpedance => (5, 4),
            Self::SetLoad => (10, 9),
            Self::AutomaticErrorRecovery => (12, 10),
            Self::GetRobotModel => (u32::MAX, 11),
        };
        match interface {
            Interface::Five => five,
            Interface::Ten => ten,
        }
    }
}

/// An answer.
#[derive(Debug, Clone, PartialEq)]
pub struct Answer {
    /// Number of the command that it belongs to.
    pub id: u32,
    /// Status, 0 for success.
    pub status: u8,
    /// What follows.
    pub rest: Vec<u8>,
}

/// Encodes a command.
pub fn request(interface: Interface, service: Service, id: u32, values: &[u8]) -> Vec<u8> {
    let length = (HEADER + values.len()) as u32;
    let header = [service.code(interface), id, length].map(u32::to_le_bytes);
    [header.as_flattened(), values].concat()
}

/// Puts answers together: a description of the robot is longer than what is received at once.
#[derive(Debug, Default)]
pub struct Reader {
    /// Number of the answer that is not complete, its bytes after the header, and how many are missing.
    partial: Option<(u32, Vec<u8>, usize)>,
}

impl Reader {
    /// Takes what is at the front of the received bytes: `Some` with the end of an answer, `None` with a part of it.
    pub fn scan(&mut self, bytes: &[u8]) -> Scan<Option<Answer>> {
        let Some((id, mut body, missing)) = self.partial.take() else { return self.begin(bytes) };
        let taken = bytes.get(..missing.min(bytes.len())).unwrap_or_default();
        body.extend(taken);
        let missing = missing - taken.len();
        let answer = self.end(id, body, missing);
        Scan::Take(taken.len(), answer)
    }

    fn begin(&mut self, bytes: &[u8]) -> Scan<Option<Answer>> {
        let Some(header) = bytes.first_chunk::<HEADER>() else { return Scan::More };
        let [_, _, _, _, a, b, c, d, e, f, g, h] = *header;
        let length = u32::from_le_bytes([e, f, g, h]) as usize;
        if !(HEADER + 1..LONGEST).contains(&length) {
            return Scan::Skip(1);
        }
        self.partial = Some((u32::from_le_bytes([a, b, c, d]), Vec::new(), length - HEADER));
        Scan::Take(HEADER, None)
    }

    fn end(&mut self, id: u32, body: Vec<u8>, missing: usize) -> Option<Answer> {
        match body.split_first() {
            Some((status, rest)) if missing == 0 => Some(Answer { id, status: *status, rest: rest.to_vec() }),
            _ => {
                self.partial = Some((id, body, missing));
                None
            }
        }
    }
}

/// Returns the values of Connect: version, and the UDP port of the client.
pub fn connect(interface: Interface, port: u16) -> Vec<u8> {
    [interface.version().to_le_bytes(), port.to_le_bytes()].concat()
}

/// Largest deviations of a motion from its path and its goal that are allowed, as the vendor's client sets them:
/// translation [m], rotation [rad], elbow [rad].
const DEVIATION: [f64; 3] = [10.0, 3.12, 2.0 * std::f64::consts::PI];

/// Returns the values of Move: joint impedance control, and joint positions or velocities.
pub fn motion(interface: Interface, velocity: bool) -> Vec<u8> {
    let mut values = [0_u32, u32::from(velocity)].map(u32::to_le_bytes).concat();
    values.extend(floats(&[DEVIATION, DEVIATION].concat()));
    if interface == Interface::Ten {
        values.push(0); // not asynchronous
        values.extend(floats(&[0.0; DOF]));
    }
    values
}

/// Returns numbers as bytes.
pub fn floats(values: &[f64]) -> Vec<u8> {
    values.iter().flat_map(|value| value.to_le_bytes()).collect()
}

/// Status of Move.
pub mod moved {
    /// It has started, and has not ended.
    pub const STARTED: u8 = 1;
}

/// Returns what a status other than success means.
pub fn refusal(interface: Interface, service: Service, status: u8) -> &'static str {
    use Service::{AutomaticErrorRecovery, Connect, Move, StopMove};
    // Interface 10 has two more statuses of safety functions in Move, and one in the others.
    let ten = interface == Interface::Ten;
    let reason = match (service, status, ten) {
        (Connect, ..) => 0,
        (Move, 2, _) => 1,
        (Move, 3 | 4, true) | (StopMove | AutomaticErrorRecovery, 2, true) => 2,
        (Move, 3, false) | (Move, 5, true) | (_, 1, _) => 3,
        (Move, 4, false) | (Move, 6, true) => 4,
        (Move, 5, false) | (Move, 7, true) => 5,
        (Move, 6, false) | (Move, 8, true) => 6,
        (Move, 7, false) | (Move, 9, true) => 7,
        (Move, 8, false) | (Move, 10, true) => 8,
        (Move, 9, false) | (Move, 11, true) => 9,
        (StopMove, 2, false) | (StopMove, 3, true) => 7,
        (StopMove, 3, false) | (StopMove, 4, true) => 6,
        (StopMove, 4, false) | (StopMove, 5, true) => 9,
        (AutomaticErrorRecovery, 2, false) | (AutomaticErrorRecovery, 3, true) => 10,
        (AutomaticErrorRecovery, 3, false) | (AutomaticErrorRecovery, 4, true) => 6,
        (AutomaticErrorRecovery, 4, false) | (AutomaticErrorRecovery, 5, true) => 7,
        (AutomaticErrorRecovery, 5, false) | (AutomaticErrorRecovery, 6, true) => 9,
        (_, 2, _) => 5,
        (_, 3, true) => 2,
        _ => 11,
    };
    const REASONS: [&str; 12] = [
        "the versions of the interface differ",
        "preempted by another command",
        "a safety function of the arm is active",
        "not possible in the present mode",
        "the arm is at a singular pose",
        "invalid argument",
        "the arm stopped with a reflex",
        "the user stop is pressed",
        "an input of the motion was invalid",
        "aborted",
        "the error must be cleared in the vendor's Desk",
        "refused with an unknown status",
    ];
    REASONS.get(reason).copied().unwrap_or_default()
}
