//! Reports that the controller streams, each on its own port. Every report begins with its length (u32, big-endian),
//! which is constant on a connection; floats are little-endian.

use super::reduced::{self, Reduced};
use super::take;
use dimos_hardware::transport::tcp::Scan;

/// No joint is ever this far from zero [rad]: such a packet is not to be believed.
const FARTHEST: f64 = 4.0 * std::f64::consts::PI;

/// The kinds of report that the adapter reads.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// Port 30000, firmware 2.1.0 and newer, 250 Hz: measured positions, velocities and torques, with a time.
    Full,
    /// Port 30003, every firmware, 100 Hz: positions and torques.
    Real,
    /// Port 30002, 5 Hz: which motors are on, error and warning, the load; on newer firmware the joints' temperatures,
    /// voltages and currents.
    Rich,
}

impl Kind {
    /// Its port, counted from the first report port.
    pub fn offset(self) -> u16 {
        match self {
            Self::Full => 0,
            Self::Rich => 2,
            Self::Real => 3,
        }
    }

    /// How often it comes [Hz].
    pub fn rate(self) -> f64 {
        match self {
            Self::Full => 250.0,
            Self::Real => 100.0,
            Self::Rich => 5.0,
        }
    }

    /// Which lengths it can have, from the end of what is read of it: a newer firmware may add to it, an old one sends
    /// less. Of the full report both 784 and 804 bytes are documented.
    fn fits(self, length: usize) -> bool {
        match self {
            Self::Full => (736..=2048).contains(&length),
            Self::Real => (87..=512).contains(&length),
            Self::Rich => (133..=1024).contains(&length),
        }
    }
}

/// Where the joints are.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Motion {
    /// Time of the measurement on the controller's clock [µs], if reported.
    pub time_us: Option<u64>,
    /// 1 moving, 2 standing, 3 paused, 4 stopped, 5 to be made ready, 6 stopping.
    pub state: u8,
    /// The mode.
    pub mode: u8,
    /// Joint positions [rad].
    pub position: [f64; 7],
    /// Joint velocities [rad/s], if reported.
    pub velocity: Option<[f64; 7]>,
    /// Joint torques [Nm], or motor currents [A] if the controller is configured so.
    pub torque: [f64; 7],
    /// Tool x, y, z [mm], roll, pitch, yaw [rad].
    pub pose: [f64; 6],
    /// Filtered force and torque at the sensor [N, Nm], if reported.
    pub wrench: Option<[f64; 6]>,
}

impl Motion {
    /// Decodes a report of port 30000.
    pub fn decode_full(packet: &[u8]) -> Option<Self> {
        let [state_mode] = take::bytes(packet, 12)?;
        let motion = Self {
            time_us: Some(u64::from_be_bytes(take::bytes(packet, 4)?)),
            state: state_mode & 0x0F,
            mode: state_mode >> 4,
            position: take::floats(packet, 116)?,
            velocity: Some(take::floats(packet, 144)?),
            torque: take::floats(packet, 228)?,
            pose: take::floats(packet, 472)?,
            wrench: Some(take::floats(packet, 712)?),
        };
        motion.believable()
    }

    /// Decodes a report of port 30003.
    pub fn decode_real(packet: &[u8]) -> Option<Self> {
        let [state_mode] = take::bytes(packet, 4)?;
        let motion = Self {
            time_us: None,
            state: state_mode & 0x0F,
            mode: state_mode >> 4,
            position: take::floats(packet, 7)?,
            velocity: None,
            torque: take::floats(packet, 59)?,
            pose: take::floats(packet, 35)?,
            wrench: if packet.len() > 87 { Some(take::floats(packet, 87)?) } else { None },
        };
        motion.believable()
    }

    fn believable(self) -> Option<Self> {
        (self.state <= 9 && self.position.iter().all(|q| q.abs() <= FARTHEST)).then_some(self)
    }
}

/// How the controller is.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Health {
    /// Motors that are on, one bit per joint.
    pub enabled: u8,
    /// The error; 0 = none.
    pub error: u8,
    /// The warning; 0 = none.
    pub warning: u8,
    /// Offset of the tool from the flange: x, y, z [mm], roll, pitch, yaw [rad].
    pub tool: [f64; 6],
    /// Pose of the base in the reference frame of poses, alike, if reported.
    pub base: Option<[f64; 6]>,
    /// Load at the flange: mass [kg], centre x, y, z [mm].
    pub load: [f64; 4],
    /// Direction of gravity in the base frame, if reported.
    pub gravity: Option<[f64; 3]>,
    /// The joints' motors, if reported.
    pub motors: Option<Motors>,
    /// The settings of reduced mode, if reported.
    pub reduced: Option<Reduced>,
}

/// Condition of the joints' motors.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Motors {
    /// Temperatures [°C].
    pub temperature: [i8; 7],
    /// Supply voltages [V], if reported.
    pub voltage: Option<[f64; 7]>,
    /// Currents [A], if reported.
    pub current: Option<[f64; 7]>,
}

impl Motors {
    fn decode(packet: &[u8]) -> Option<Self> {
        let temperature = take::bytes::<7>(packet, 245)?.map(|byte| byte as i8);
        let mut voltage = Some([0.0; 7]);
        for i in 0..7 {
            let value = take::bytes(packet, 341 + 2 * i).map(|bytes| f64::from(u16::from_be_bytes(bytes)) / 100.0);
            voltage = voltage.zip(value).map(|(mut all, value)| {
                all.iter_mut().skip(i).take(1).for_each(|to| *to = value);
                all
            });
        }
        Some(Self { temperature, voltage, current: take::floats(packet, 355) })
    }
}

impl Health {
    /// Decodes a report of port 30002, or of port 30001, which has its first part.
    pub fn decode(packet: &[u8]) -> Option<Self> {
        let [enabled, error, warning] = take::bytes(packet, 88)?;
        // What the vendor's own client asks of a report before it believes it.
        let [collision, teach] = take::bytes(packet, 131)?;
        let [state_mode] = take::bytes(packet, 4)?;
        let (tool, load) = (take::floats(packet, 91)?, take::floats(packet, 115)?);
        let (gravity, motors, base) = (take::floats(packet, 133), Motors::decode(packet), take::floats(packet, 288));
        let reduced = packet.get(495..495 + reduced::LENGTH).and_then(Reduced::decode);
        let valid = collision <= 5 && teach <= 5 && state_mode & 0x0F <= 9;
        valid.then_some(Self { enabled, error, warning, tool, base, load, gravity, motors, reduced })
    }
}

/// Finds the report at the front of `bytes`. `length` is that of the reports before it, where one has come. What is
/// no report, or one that cannot be believed, is skipped up to the next that may be one.
pub fn scan<T>(
    bytes: &[u8],
    kind: Kind,
    length: Option<usize>,
    decode: impl Fn(&[u8]) -> Option<T>,
) -> Scan<(usize, T)> {
    let Some(head) = bytes.first_chunk() else { return Scan::More };
    let found = u32::from_be_bytes(*head) as usize;
    if !length.map_or(kind.fits(found), |length| length == found) {
        return Scan::Skip(1);
    }
    let Some(packet) = bytes.get(..found) else { return Scan::More };
    match decode(packet) {
        Some(report) => Scan::Take(found, (found, report)),
        None => Scan::Skip(1),
    }
}
