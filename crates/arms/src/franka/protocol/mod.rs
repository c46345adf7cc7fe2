//! The bytes of the Franka Control Interface. TCP port 1337 takes commands; the controller sends its state over UDP
//! every millisecond, and takes a command in answer to each. All values are little-endian and packed.
//!
//! | interface | arm, client of the vendor | state | command |
//! |---|---|---|---|
//! | 5 | FER (Panda), libfranka 0.9 | 2373 bytes, f64 | 370 bytes |
//! | 10 | FR3, libfranka 0.18 to 0.21 | 1377 bytes, f32 | 371 bytes |

pub mod command;
pub mod errors;
pub mod gripper;
pub mod service;
pub mod state;

/// Number of joints.
pub const DOF: usize = 7;
/// TCP port of commands.
pub const PORT: u16 = 1337;
/// TCP port of the gripper.
pub const GRIPPER_PORT: u16 = 1338;

/// A version of the interface. Client and controller must have the same.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Interface {
    /// Version 5, of the FER.
    Five,
    /// Version 10, of the FR3.
    Ten,
}

impl Interface {
    /// Returns its number.
    pub fn version(self) -> u16 {
        match self {
            Self::Five => 5,
            Self::Ten => 10,
        }
    }

    /// Returns the length of a state [bytes].
    pub fn state_length(self) -> usize {
        match self {
            Self::Five => 2373,
            Self::Ten => 1377,
        }
    }

    /// Returns the length of a command [bytes].
    pub fn command_length(self) -> usize {
        match self {
            Self::Five => 370,
            Self::Ten => 371,
        }
    }
}
