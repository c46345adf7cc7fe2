//! Properties of a true arm, drawn from a seed within what the row of its type says.

use dimos::robot::random::Random;

use super::arm_rows::Row;

/// What an arm reports as its joints' velocities.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Velocities {
    Measured,
    /// None, and it says so.
    Absent,
    /// Zeros, as if measured.
    Zeros,
}

/// Properties of one arm: within what its row says.
#[derive(Debug, Clone)]
pub struct Traits {
    /// From a setpoint until the drive sees it [s].
    pub dead: f64,
    /// Time constant of the drive [s].
    pub tau: f64,
    /// The drives' own limits [rad/s, rad/s²].
    pub v_max: Vec<f64>,
    pub a_max: Vec<f64>,
    /// How far each joint rests below its setpoint under load [rad].
    pub droop: Vec<f64>,
    /// Amplitudes of the noise of positions [rad] and velocities [rad/s].
    pub noise: f64,
    pub v_noise: f64,
    /// Of the encoders [rad].
    pub resolution: f64,
    pub velocities: Velocities,
    /// Whether it reports what its controller commands.
    pub reports_commanded: bool,
    /// Its reading of a joint is renewed only every this many readings, and not at the same time for all joints.
    pub stairs: u64,
    /// A state is this old when the tick reads it [s].
    pub age: f64,
}

impl Traits {
    /// Draws an arm of a row.
    pub fn draw(row: &Row, random: &mut Random) -> Self {
        let s = &row.arm.supervision;
        let limits = &row.arm.limits;
        let dof = row.arm.dof;
        let faster = random.between(1.3, 2.5);
        let lag = s.lag * random.between(0.3, 0.85);
        let dead = lag * random.between(0.1, 0.4);
        let droop =
            |random: &mut Random| random.between(-1.0, 1.0) * s.droop * 0.9 + random.between(-0.5, 0.5) * s.accuracy;
        let resolution = match row.name {
            "so101" => std::f64::consts::TAU / 4096.0,
            "piper" => 1e-3f64.to_radians(),
            _ => 1e-6,
        };
        let velocities = match (row.name, random.below(4)) {
            ("remote", 0) | ("mock", 0) => Velocities::Absent,
            _ => Velocities::Measured,
        };
        Self {
            dead,
            tau: lag - dead,
            v_max: limits.velocity_max.iter().map(|v| v * faster.min(1.5)).collect(),
            a_max: limits.acceleration_max.iter().map(|a| a * faster * 2.0).collect(),
            droop: (0..dof).map(|_| droop(random)).collect(),
            noise: s.accuracy * random.between(0.0, 0.08),
            v_noise: random.between(0.0, 0.015),
            resolution,
            velocities,
            reports_commanded: matches!(row.name, "franka" | "ur" | "so101")
                || (row.name == "remote" && random.below(2) == 0),
            stairs: if row.name == "piper" { 1 + random.below(3) as u64 } else { 1 },
            age: random.between(0.0005, 0.003),
        }
    }
}
