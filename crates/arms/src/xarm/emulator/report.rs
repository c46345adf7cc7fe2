//! The reports, byte by byte as the vendor's page "Data Description of TCP port" has them.

use super::reduced_mode::ReducedMode;
use dimos_hardware::sim::arm::SimArm;

/// What a report shows, in units of the wire.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Snapshot {
    /// Since power-up [µs].
    pub time_us: u64,
    /// 1 to 6.
    pub state: u8,
    /// The mode.
    pub mode: u8,
    /// Commands in the queue.
    pub queued: u16,
    /// [rad]
    pub position: [f32; 7],
    /// [rad/s]
    pub velocity: [f32; 7],
    /// [Nm]
    pub torque: [f32; 7],
    /// [mm, rad]
    pub pose: [f32; 6],
    /// Motors on, one bit per joint.
    pub enabled: u8,
    /// Error code.
    pub error: u8,
    /// Warning code.
    pub warning: u8,
    /// Number of joints, and the vendor's number for the kind of arm.
    pub axes: u8,
    /// See `axes`.
    pub kind: u8,
    /// Firmware.
    pub firmware: [u16; 3],
    /// Pose of the base in the reference frame of poses [mm, rad].
    pub base: [f32; 6],
    /// Offset of the tool [mm, rad], its mass and centre [kg, mm].
    pub offset: [f32; 6],
    /// See `offset`.
    pub load: [f32; 4],
    /// Sensitivities for collisions and for guiding by hand.
    pub sensitivity: [u8; 2],
    /// Jerk and largest acceleration of the tool [mm/s³, mm/s²], then of the joints [rad/s³, rad/s²].
    pub motion: [f32; 4],
    /// Reduced mode.
    pub reduced: ReducedMode,
    /// Force and torque, without and with what the tool weighs [N, Nm].
    pub wrench: [f32; 6],
    /// See `wrench`.
    pub wrench_raw: [f32; 6],
    /// Counts the reports.
    pub counter: u32,
}

/// Places a report's parts.
struct Packet<'a>(&'a mut Vec<u8>);

impl Packet<'_> {
    fn new(out: &mut Vec<u8>, length: u32) -> Packet<'_> {
        out.clear();
        out.resize(length as usize, 0);
        let mut packet = Packet(out);
        packet.bytes(0, &length.to_be_bytes());
        packet
    }

    fn bytes(&mut self, at: usize, bytes: &[u8]) {
        if let Some(to) = self.0.get_mut(at..at + bytes.len()) {
            to.copy_from_slice(bytes);
        }
    }

    fn floats(&mut self, at: usize, values: &[f32]) {
        values.iter().enumerate().for_each(|(i, value)| self.bytes(at + 4 * i, &value.to_bits().to_le_bytes()));
    }
}

/// Which report.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// Port 30000.
    Full,
    /// Port 30001.
    Normal,
    /// Port 30002.
    Rich,
    /// Port 30003.
    Real,
}

impl Kind {
    /// In the order of their ports.
    pub const ALL: [Self; 4] = [Self::Full, Self::Normal, Self::Rich, Self::Real];

    /// Time from one to the next [µs].
    pub fn period_us(self) -> u64 {
        match self {
            Self::Full => 4_000,
            Self::Real => 10_000,
            Self::Normal | Self::Rich => 200_000,
        }
    }

    /// Writes the report into `out`, which keeps its room.
    pub fn write(self, s: &Snapshot, out: &mut Vec<u8>) {
        match self {
            Self::Full => full(s, out),
            Self::Normal => normal(s, 145, out),
            Self::Rich => rich(s, out),
            Self::Real => {
                let mut packet = common(s, 135, out);
                packet.floats(87, &s.wrench);
                packet.floats(111, &s.wrench_raw);
            }
        }
    }
}

fn state_and_mode(s: &Snapshot) -> u8 {
    s.state | s.mode << 4
}

fn full(s: &Snapshot, out: &mut Vec<u8>) {
    let mut packet = Packet::new(out, 804);
    packet.bytes(4, &s.time_us.to_be_bytes());
    packet.bytes(12, &[state_and_mode(s)]);
    packet.bytes(13, &s.queued.to_be_bytes());
    for (at, values) in [(32, &s.position), (60, &s.velocity), (116, &s.position), (144, &s.velocity)] {
        packet.floats(at, values);
    }
    packet.floats(200, &s.torque.map(|torque| torque / 10.0)); // motor currents
    packet.floats(228, &s.torque);
    packet.floats(424, &s.pose);
    packet.floats(472, &s.pose);
    packet.floats(688, &s.wrench_raw);
    packet.floats(712, &s.wrench);
}

/// The part that the three older reports share.
fn common<'a>(s: &Snapshot, length: u32, out: &'a mut Vec<u8>) -> Packet<'a> {
    let mut packet = Packet::new(out, length);
    packet.bytes(4, &[state_and_mode(s)]);
    packet.bytes(5, &s.queued.to_be_bytes());
    packet.floats(7, &s.position);
    packet.floats(35, &s.pose);
    packet.floats(59, &s.torque);
    packet
}

fn normal(s: &Snapshot, length: u32, out: &mut Vec<u8>) {
    let mut packet = common(s, length, out);
    packet.bytes(87, &[s.enabled, s.enabled, s.error, s.warning]);
    packet.floats(91, &s.offset);
    packet.floats(115, &s.load);
    packet.bytes(131, &s.sensitivity);
    packet.floats(133, &[0.0, 0.0, -1.0]);
}

fn rich(s: &Snapshot, out: &mut Vec<u8>) {
    normal(s, 587, out);
    let mut packet = Packet(out);
    packet.bytes(145, &[s.kind, s.axes, 0xAA, 0x55]);
    let [major, minor, revision] = s.firmware;
    packet.bytes(151, format!("v{major}.{minor}.{revision}").as_bytes());
    let [tool_jerk, tool_acceleration, jerk, acceleration] = s.motion;
    packet.floats(181, &[tool_jerk, 1.0, tool_acceleration, 0.1, 1000.0]);
    packet.floats(201, &[jerk, 0.01, acceleration, 1e-4, std::f32::consts::PI]);
    packet.floats(221, &[100.0, 40.0]);
    packet.bytes(245, &std::array::from_fn::<u8, 7, _>(|joint| SimArm::temperature(joint) as u8));
    (0..7).for_each(|joint| packet.bytes(341 + 2 * joint, &4800_u16.to_be_bytes()));
    packet.floats(355, &s.torque.map(|torque| torque / 10.0));
    packet.floats(256, &s.velocity);
    packet.bytes(284, &s.counter.to_be_bytes());
    packet.floats(288, &s.base);
    packet.floats(433, &s.wrench);
    packet.floats(457, &s.wrench_raw);
    let mut reduced = Vec::with_capacity(79);
    s.reduced.write(&mut reduced);
    packet.bytes(494, &[u8::from(s.reduced.active.is_some()) | u8::from(s.reduced.fence) << 1]);
    packet.bytes(495, &reduced);
}
