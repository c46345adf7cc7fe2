//! The hand on the next port: commands with a header of 10 bytes, and its state over UDP.

use std::net::{IpAddr, SocketAddr};

use super::control::Who;
use dimos_hardware::sim::arm::Delivery;
use dimos_hardware::sim::faults::{Fault, FaultKind};
use dimos_hardware::sim::gripper::Gripper;
use dimos_hardware::transport::Scan;

/// Widest opening [m], and the speed of the fingers [m/s].
const WIDEST: f64 = 0.08;
const SPEED: f64 = 0.1;
/// Statuses.
const SUCCESS: u16 = 0;
const FAILED: u16 = 1;
const UNSUCCESSFUL: u16 = 2;
const ABORTED: u16 = 3;

/// A motion of the fingers, to be answered at its end.
struct Motion {
    who: Who,
    code: u16,
    id: u32,
    /// Smallest and largest width that is a success [m].
    success: (f64, f64),
    /// A motion without a grasp ends unsuccessfully at an object.
    grasps: bool,
}

/// The hand.
pub(super) struct Hand {
    fingers: Gripper,
    pub homed: bool,
    grasped: bool,
    motion: Option<Motion>,
    client: Option<(Who, SocketAddr)>,
    messages: u32,
}

impl Hand {
    pub fn new() -> Self {
        let fingers = Gripper::new(WIDEST, SPEED);
        Self { fingers, homed: true, grasped: false, motion: None, client: None, messages: 0 }
    }

    /// Returns the distance of the fingers [m].
    pub fn width(&self) -> f64 {
        self.fingers.position
    }

    /// Processes the command at the front of a connection's bytes. Returns the answers that are due.
    pub fn request(&mut self, who: Who, at: IpAddr, bytes: &[u8], answers: &mut Vec<(Who, Vec<u8>)>) -> Scan<Delivery> {
        let Some([a, b, c, d, e, f, g, h, i, j]) = bytes.first_chunk::<10>().copied() else { return Scan::More };
        let (code, id) = (u16::from_le_bytes([a, b]), u32::from_le_bytes([c, d, e, f]));
        let length = u32::from_le_bytes([g, h, i, j]) as usize;
        let expected = match code {
            0 => 14,
            1 | 4 => 10,
            2 => 50,
            3 => 26,
            _ => 0,
        };
        if length != expected {
            return Scan::Take(bytes.len(), Delivery::HangUp);
        }
        let Some(values) = bytes.get(10..length) else { return Scan::More };
        let numbers = super::wire::floats(values);
        let number = |at: usize| numbers.get(at).copied().unwrap_or_default();
        match code {
            0 => {
                let word =
                    |at: usize| values.get(at..at + 2).and_then(|b| b.try_into().ok()).map_or(0, u16::from_le_bytes);
                let same = word(0) == 3;
                if same {
                    self.client = Some((who, SocketAddr::new(at, word(2))));
                }
                let mut reply = answer(code, id, u16::from(!same), 2);
                reply.extend(3_u16.to_le_bytes());
                answers.push((who, reply));
            }
            1 => {
                (self.homed, self.grasped) = (true, false);
                self.begin(Motion { who, code, id, success: (0.0, 1.0), grasps: false }, WIDEST, answers);
            }
            2 => {
                let (width, inner, outer) = (number(0), number(1), number(2));
                self.fingers.set_speed(number(3) / SPEED);
                let success = (width - inner, width + outer);
                self.begin(Motion { who, code, id, success, grasps: true }, width, answers);
            }
            3 => {
                let width = number(0);
                self.fingers.set_speed(number(1) / SPEED);
                let success = (width - 1e-6, width + 1e-6);
                self.begin(Motion { who, code, id, success, grasps: false }, width, answers);
            }
            _ => {
                self.abort(answers);
                self.fingers.stop();
                answers.push((who, answer(code, id, SUCCESS, 0)));
            }
        }
        Scan::Take(length, Delivery::Send)
    }

    fn abort(&mut self, answers: &mut Vec<(Who, Vec<u8>)>) {
        let aborted = self.motion.take();
        answers.extend(aborted.map(|motion| (motion.who, answer(motion.code, motion.id, ABORTED, 0))));
    }

    fn begin(&mut self, motion: Motion, width: f64, answers: &mut Vec<(Who, Vec<u8>)>) {
        self.abort(answers);
        if !self.homed || !(0.0..=WIDEST + 1e-3).contains(&width) {
            answers.push((motion.who, answer(motion.code, motion.id, FAILED, 0)));
            return;
        }
        self.grasped = false;
        self.fingers.move_to(width);
        self.motion = Some(motion);
    }

    /// Puts an object of this width [m] between the fingers; `None` takes it away.
    pub fn put_object(&mut self, width: Option<f64>) {
        self.fingers.put_object(width.unwrap_or_default());
    }

    /// Plays the faults of the fingers that are due.
    pub fn play(&mut self, take: impl FnMut(FaultKind) -> Option<Fault>) {
        self.fingers.play(take);
    }

    /// Moves the fingers. Returns the answer to a motion that ends.
    pub fn advance(&mut self, dt: f64) -> Option<(Who, Vec<u8>)> {
        self.fingers.advance(dt);
        if self.fingers.moving() {
            return None;
        }
        let motion = self.motion.take()?;
        let touches = self.fingers.gripping();
        self.grasped = touches && motion.grasps;
        if touches && !motion.grasps {
            self.fingers.rest(); // it does not press
        }
        let (least, most) = motion.success;
        let inside = (least..=most).contains(&self.fingers.position);
        let status = if inside && (motion.grasps || !touches) { SUCCESS } else { UNSUCCESSFUL };
        Some((motion.who, answer(motion.code, motion.id, status, 0)))
    }

    /// Returns the state, and where it goes.
    pub fn state(&mut self) -> Option<(SocketAddr, Vec<u8>)> {
        let (_, address) = self.client?;
        self.messages += 1;
        let most = if self.homed { WIDEST } else { 0.0 };
        let mut bytes = self.messages.to_le_bytes().to_vec();
        bytes.extend(self.fingers.position.to_le_bytes());
        bytes.extend(most.to_le_bytes());
        bytes.push(u8::from(self.grasped));
        bytes.extend(35_u16.to_le_bytes());
        Some((address, bytes))
    }

    pub fn leave(&mut self, who: Who) {
        self.client = self.client.filter(|(client, _)| *client != who);
        if self.motion.as_ref().is_some_and(|motion| motion.who == who) {
            self.motion = None;
            self.fingers.stop();
        }
    }
}

fn answer(code: u16, id: u32, status: u16, more: u32) -> Vec<u8> {
    let length = 12 + more;
    [&code.to_le_bytes()[..], &id.to_le_bytes(), &length.to_le_bytes(), &status.to_le_bytes()].concat()
}
