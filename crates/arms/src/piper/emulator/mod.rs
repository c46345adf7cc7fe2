//! Emulator of a Piper on a CAN bus, for `address: sim`, for tests, and for other programs on a CAN interface or a
//! serial line.
//!
//! Like the arm it streams its state at the arm's rates (3 040 frames/s in all), whether or not a program receives it,
//! and takes commands from every node on its bus. The bus and the joints are those of the simulation kit
//! ([`dimos_hardware::sim`]).

mod controller;
mod feedback;
mod kinematics;
mod power;
mod wire;

use std::ops::RangeInclusive;
use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Deserializer, Serialize};

use super::model::Model;
use super::{GripperKind, NATIVE_RATE, Options};
use controller::Controller;
use dimos_core::clock::{Clock, Mono, MonotonicClock};
use dimos_core::joint::{JointLimits, Joints};
use dimos_hardware::adapter::AdapterResult;
use dimos_hardware::check::ConfigError;
use dimos_hardware::registry::{AdapterConfig, Emulator, EmulatorAddress, Truth};
use dimos_hardware::sim::arm::{self, HasArm};
use dimos_hardware::sim::can_server::{CanController, CanServer};
use dimos_hardware::sim::faults::{Fault, FaultKind};
use dimos_hardware::sim::physics::PhysicsOptions;
use dimos_hardware::transport::can::CanFrame;

/// The faults that the emulator can play on any bus.
pub(super) const PLAYABLE: &[FaultKind] = &[
    FaultKind::Stall,
    FaultKind::Silent,
    FaultKind::LostCommand,
    FaultKind::ErrorCode,
    FaultKind::Estop,
    FaultKind::PowerLoss,
    FaultKind::ZeroState,
    FaultKind::Misread,
    FaultKind::Garbage,
    FaultKind::Truncated,
    FaultKind::Sag,
    FaultKind::Blocked,
    FaultKind::Pushed,
    FaultKind::Nudged,
    FaultKind::MotorOff,
    FaultKind::Leader,
    FaultKind::Object,
    FaultKind::GripperBlocked,
    // Only on a bus in memory; the last of the list, in that order.
    FaultKind::Disconnect,
    FaultKind::BusOff,
    FaultKind::NoBuffers,
];
/// How many of them every bus can play.
const ANYWHERE: usize = PLAYABLE.len() - 3;

/// What the emulator does.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SimOptions {
    /// Joint positions at power-up [rad], one per joint, up to 0.05 rad outside the joint limits, as an unsupported arm
    /// may rest; `[0.1, 0.6, -0.7, 0.05, 0.4, -0.1]` when empty.
    pub initial_positions: Vec<f64>,
    /// How often it sends its state, 20 to 200 [Hz]: an arm's 200, or less for a client that cannot keep up.
    #[serde(deserialize_with = "rate")]
    #[schemars(range(min = 20, max = 200))]
    pub feedback_hz: f64,
    /// Its firmware, as the arm says it.
    pub firmware: String,
    /// How far joints are behind their servo setpoints, 0 to 0.5 [s].
    #[schemars(range(min = 0, max = 0.5))]
    pub lag: f64,
    /// How far below their targets joints rest under load, 0 to 0.2 [rad].
    #[schemars(range(min = 0, max = 0.2))]
    pub droop: f64,
    /// What goes wrong, and when (seconds after the first frame to the arm).
    pub faults: Vec<Fault>,
    /// What the controller does otherwise than its documents say.
    pub controller: arm::ControllerOptions,
    /// A body with mass, by MuJoCo: `{}`, or with a seed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub physics: Option<PhysicsOptions>,
}

impl Default for SimOptions {
    fn default() -> Self {
        Self {
            initial_positions: Vec::new(),
            feedback_hz: NATIVE_RATE,
            firmware: "S-V1.8-5".to_owned(),
            lag: 0.02,
            droop: 0.0,
            faults: Vec::new(),
            controller: arm::ControllerOptions::default(),
            physics: None,
        }
    }
}

impl SimOptions {
    /// Refuses a pose outside the joint limits, an invalid firmware version, and faults that are not among `playable`.
    pub(super) fn check(&self, model: Model, playable: &[FaultKind]) -> Result<(), ConfigError> {
        self.common().check("piper", &stops(model), playable)?;
        match self.firmware.len() {
            8 => Ok(()),
            _ => Err(ConfigError::new("sim.firmware", "firmware must have 8 characters, as S-V1.8-5 has")),
        }
    }

    /// What all emulated arms have.
    fn common(&self) -> arm::SimOptions {
        let Self { initial_positions, lag, droop, faults, controller, physics, .. } = self.clone();
        arm::SimOptions { initial_positions, lag, droop, faults, controller, physics }
    }
}

/// Where the joints meet their mechanical stops: 0.05 rad outside the limits.
fn stops(model: Model) -> JointLimits {
    const BEYOND: f64 = 0.05;
    let mut stops = model.limits();
    stops.position_lower.iter_mut().for_each(|lower| *lower -= BEYOND);
    stops.position_upper.iter_mut().for_each(|upper| *upper += BEYOND);
    stops
}

fn rate<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    let value = f64::deserialize(deserializer)?;
    if (20.0..=NATIVE_RATE).contains(&value) {
        Ok(value)
    } else {
        Err(serde::de::Error::custom(format!("{value} is not between 20 and {NATIVE_RATE}")))
    }
}

/// A running emulator. Ends when it is dropped.
pub struct PiperEmulator {
    server: CanServer<Controller>,
}

impl PiperEmulator {
    /// Starts an emulator at `place`, with the adapter's options.
    pub fn start(config: &AdapterConfig, place: &EmulatorAddress) -> AdapterResult<Self> {
        let options = config.options::<Options>()?;
        Self::of(options.model, &options.sim, options.gripper, place)
    }

    /// Starts an emulator of a Piper at `place`.
    pub fn with(options: &SimOptions, gripper: GripperKind, place: &EmulatorAddress) -> AdapterResult<Self> {
        Self::of(Model::Piper, options, gripper, place)
    }

    fn of(model: Model, options: &SimOptions, gripper: GripperKind, place: &EmulatorAddress) -> AdapterResult<Self> {
        let playable =
            if *place == EmulatorAddress::InProcess { PLAYABLE } else { PLAYABLE.get(..ANYWHERE).unwrap_or_default() };
        options.check(model, playable)?;
        let controller = Controller::new(options, (model, gripper), playable, MonotonicClock.now())?;
        let period = Duration::from_secs_f64(1.0 / options.feedback_hz);
        Ok(Self { server: CanServer::start("piper", controller, place, period)? })
    }

    /// True joint positions [rad] and velocities [rad/s] now.
    pub fn joints(&self) -> (Joints, Joints) {
        self.server.with(Controller::joints_at)
    }

    /// Whether the motors are on.
    pub fn enabled(&self) -> bool {
        self.server.with(|controller, _| controller.arm().enabled())
    }

    /// Sets whether it refuses targets outside its limits (the default) or takes them.
    pub fn refuse_outside(&self, refuse: bool) {
        self.server.with(|controller, _| controller.lenient = !refuse);
    }

    /// Does as a frame says that a program sends which other programs on this computer do not hear, as the vendor's SDK
    /// does (it switches local loopback off).
    pub fn execute_unheard(&self, frame: &CanFrame) {
        self.server.with(|controller, now| controller.on_frame(frame, now, &mut Vec::new()));
    }

    /// How often a client has let the motors lose their power by a reset (0x150).
    pub fn power_drops(&self) -> u64 {
        self.server.with(|controller, _| controller.power_drops)
    }

    /// Suppresses the frames with these identifiers, or none; all others continue.
    pub fn mute(&self, identifiers: Option<RangeInclusive<u16>>) {
        self.server.with(|controller, _| controller.muted = identifiers);
    }

    /// Starts to record what comes over the bus, up to 200 000 frames; forgets what was recorded before.
    pub fn record(&self) {
        self.server.with(|controller, _| controller.trace.start());
    }

    /// What came over the bus since [`PiperEmulator::record`], and when.
    pub fn trace(&self) -> Vec<(Mono, CanFrame)> {
        self.server.with(|controller, _| controller.trace.entries())
    }

    /// How many frames it has sent.
    pub fn sent(&self) -> u64 {
        self.server.sent()
    }

    /// Puts an object of this width [m] between the fingers of the gripper; 0 takes it away.
    pub fn put_object(&self, width: f64) {
        self.server.with(|controller, _| controller.gripper.put_object(width));
    }

    /// How many frames its bus did not take.
    pub fn not_taken(&self) -> u64 {
        self.server.not_taken()
    }
}

impl Emulator for PiperEmulator {
    fn address(&self) -> String {
        Emulator::address(&self.server)
    }

    fn inject(&self, fault: Fault) -> Result<(), String> {
        self.server.inject(fault)
    }

    fn truth(&self) -> Truth {
        self.server.truth()
    }
}
