//! The command that answers a state, over UDP.
//!
//! Number of the state (u64), then f64: joint positions 7, joint velocities 7, pose 16, twist 6, elbow 2; then two
//! bytes (elbow valid, motion finished); torques 7; in interface 10 one byte (torques finished). What a motion does not
//! use is zero.

use super::{DOF, Interface};

/// Length of the longest command [bytes].
pub const LONGEST: usize = 371;
/// Where joint positions, joint velocities and the flag of a finished motion begin.
const POSITIONS: usize = 8;
const VELOCITIES: usize = 64;
const FINISHED: usize = 313;

/// What a command sets.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Target {
    /// Joint positions [rad].
    Positions([f64; DOF]),
    /// Joint velocities [rad/s].
    Velocities([f64; DOF]),
}

/// Encodes the answer to the state `id`; the first [`Interface::command_length`] bytes are sent.
pub fn encode(id: u64, target: &Target, finished: bool) -> [u8; LONGEST] {
    let mut bytes = [0; LONGEST];
    let (at, values) = match target {
        Target::Positions(values) => (POSITIONS, values),
        Target::Velocities(values) => (VELOCITIES, values),
    };
    put(&mut bytes, 0, &id.to_le_bytes());
    for (i, value) in values.iter().enumerate() {
        put(&mut bytes, at + 8 * i, &value.to_le_bytes());
    }
    put(&mut bytes, FINISHED, &[u8::from(finished)]);
    bytes
}

/// Returns the bytes that an interface takes.
pub fn sent(interface: Interface, bytes: &[u8; LONGEST]) -> &[u8] {
    bytes.get(..interface.command_length()).unwrap_or(bytes)
}

fn put(bytes: &mut [u8], at: usize, value: &[u8]) {
    bytes.iter_mut().skip(at).zip(value).for_each(|(to, from)| *to = *from);
}
