//! The state that the controller sends every millisecond.
//!
//! Message number (u64), then numbers in one width (f64 in interface 5, f32 in interface 10), then modes and error
//! flags (bytes), then the success rate. Interface 10 has 36 numbers of accelerometers more, at the end of the numbers.

use super::errors::ERRORS;
use super::{DOF, Interface};
use dimos_core::arm::Load;

/// Where values begin, as the count of numbers before them.
mod at {
    pub const POSE: usize = 0;
    pub const F_T_EE: usize = 32;
    pub const TOOL_MASS: usize = 96;
    pub const LOAD_MASS: usize = 109;
    pub const TAU: usize = 126;
    pub const Q: usize = 147;
    pub const Q_D: usize = 154;
    pub const DQ: usize = 161;
    pub const DQ_D: usize = 168;
    pub const DDQ_D: usize = 175;
    pub const FORCE: usize = 215;
    /// End of the numbers of interface 5, and of interface 10.
    pub const END: (usize, usize) = (284, 320);
}

/// What the robot does.
pub mod mode {
    /// Ready for a motion.
    pub const IDLE: u8 = 1;
    /// A motion runs.
    pub const MOVE: u8 = 2;
    /// Guided by hand.
    pub const GUIDING: u8 = 3;
    /// Stopped by an error.
    pub const REFLEX: u8 = 4;
    /// The user stop is pressed.
    pub const USER_STOPPED: u8 = 5;
}

/// Motion generators in a state.
pub mod generator {
    /// No motion.
    pub const IDLE: u8 = 0;
    /// Joint positions.
    pub const JOINT_POSITION: u8 = 1;
    /// Joint velocities.
    pub const JOINT_VELOCITY: u8 = 2;
}

/// A state, as far as the adapter uses it.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct State {
    /// Number of the message: time of the controller [ms].
    pub id: u64,
    /// Pose of the end effector in the base frame, column-major [m].
    pub pose: [f64; 16],
    /// Pose of the end effector in the flange's frame, column-major [m].
    pub end_effector: [f64; 16],
    /// End effector that is set up in Desk: the controller counts it beside the load.
    pub tool: Load,
    /// Load that was set.
    pub load: Load,
    /// Measured joint torques [Nm].
    pub tau: [f64; DOF],
    /// Measured positions [rad] and velocities [rad/s].
    pub q: [f64; DOF],
    /// Measured velocities [rad/s].
    pub dq: [f64; DOF],
    /// Desired positions [rad]: the last command, or what the controller made up for a lost one.
    pub q_d: [f64; DOF],
    /// Desired velocities [rad/s].
    pub dq_d: [f64; DOF],
    /// Desired accelerations [rad/s²].
    pub ddq_d: [f64; DOF],
    /// Estimated external force and torque in the base frame [N, Nm].
    pub force: [f64; 6],
    /// Motion generator.
    pub generator: u8,
    /// Controller.
    pub controller: u8,
    /// Present errors, one bit each.
    pub errors: u64,
    /// What ended the last motion, one bit each.
    pub reflex_reason: u64,
    /// What the robot does.
    pub mode: u8,
    /// Share of the last 100 commands that came in time, 0 to 1.
    pub success_rate: f64,
}

/// Reads numbers of one width.
struct Numbers<'a> {
    bytes: &'a [u8],
    wide: bool,
}

impl Numbers<'_> {
    fn get(&self, index: usize) -> f64 {
        if self.wide {
            let bytes = self.bytes.get(8 * index..).and_then(<[u8]>::first_chunk);
            bytes.map_or(f64::NAN, |bytes| f64::from_le_bytes(*bytes))
        } else {
            let bytes = self.bytes.get(4 * index..).and_then(<[u8]>::first_chunk);
            bytes.map_or(f64::NAN, |bytes| f32::from_le_bytes(*bytes).into())
        }
    }

    /// Mass, inertia (nine numbers), centre.
    fn body(&self, from: usize) -> Load {
        let [xx, xy, xz, _, yy, yz, _, _, zz] = self.array(from + 1);
        Load { mass: self.get(from), center: self.array(from + 10), inertia: [xx, xy, xz, yy, yz, zz] }
    }

    fn array<const N: usize>(&self, from: usize) -> [f64; N] {
        std::array::from_fn(|i| self.get(from + i))
    }
}

impl State {
    /// Decodes a datagram; `None` unless it has the length of a state.
    pub fn decode(interface: Interface, bytes: &[u8]) -> Option<Self> {
        if bytes.len() != interface.state_length() {
            return None;
        }
        let (wide, end) = match interface {
            Interface::Five => (true, at::END.0),
            Interface::Ten => (false, at::END.1),
        };
        let (id, rest) = bytes.split_first_chunk()?;
        let width = if wide { 8 } else { 4 };
        let (numbers, rest) = rest.split_at_checked(end * width)?;
        let [generator, controller, rest @ ..] = rest else { return None };
        let (errors, rest) = rest.split_at_checked(ERRORS)?;
        let (reasons, rest) = rest.split_at_checked(ERRORS)?;
        let [mode, rest @ ..] = rest else { return None };
        let numbers = Numbers { bytes: numbers, wide };
        Some(Self {
            id: u64::from_le_bytes(*id),
            pose: numbers.array(at::POSE),
            end_effector: numbers.array(at::F_T_EE),
            tool: numbers.body(at::TOOL_MASS),
            load: numbers.body(at::LOAD_MASS),
            tau: numbers.array(at::TAU),
            q: numbers.array(at::Q),
            dq: numbers.array(at::DQ),
            q_d: numbers.array(at::Q_D),
            dq_d: numbers.array(at::DQ_D),
            ddq_d: numbers.array(at::DDQ_D),
            force: numbers.array(at::FORCE),
            generator: *generator,
            controller: *controller,
            errors: bits(errors),
            reflex_reason: bits(reasons),
            mode: *mode,
            success_rate: Numbers { bytes: rest, wide }.get(0),
        })
    }

    /// Returns whether all joint values are finite.
    pub fn is_finite(&self) -> bool {
        [&self.q, &self.dq, &self.q_d, &self.dq_d, &self.ddq_d].into_iter().flatten().all(|value| value.is_finite())
    }
}

fn bits(flags: &[u8]) -> u64 {
    flags.iter().enumerate().fold(0, |all, (bit, flag)| all | u64::from(*flag != 0) << bit)
}
