//! The emulator of a controller with its arm, for `address: sim`, for tests, and for other clients such as the
//! vendor's.
//!
//! Written from the protocol, and shares no code with the adapter besides the models' dimensions and limits. It keeps
//! the controller's rules: a command counts only if it answers the state that was sent last, before the next one is
//! sent; what it commands is judged, and never made smoother.

mod clock;
mod control;
mod hand;
mod judge;
mod ports;
mod services;
#[cfg(test)]
mod tests;
mod urdf;
mod wire;

use std::net::{SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use nalgebra::Isometry3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::model::Model;
use super::protocol::{DOF, PORT};
use clock::{Network, Pace};
use control::Control;
pub use control::{Datagram, Figures};
use dimos_core::clock::{Clock, MonotonicClock};
use dimos_core::joint::JointLimits;
use dimos_core::pose::from_xyz_rpy;
use dimos_hardware::adapter::{AdapterError, AdapterResult};
use dimos_hardware::check::ConfigError;
use dimos_hardware::registry::{AdapterConfig, Emulator, EmulatorAddress, Truth};
use dimos_hardware::sim::arm;
use dimos_hardware::sim::faults::{Fault, FaultKind};
use dimos_hardware::sim::physics::PhysicsOptions;
use dimos_hardware::sim::tcp_server::{Port, TcpServer, emulator_ports};
use dimos_rt::histogram::{self, Histogram};

/// The faults that the controller can play.
const PLAYABLE: &[FaultKind] = &[
    FaultKind::Stall,
    FaultKind::Silent,
    FaultKind::Disconnect,
    FaultKind::ErrorCode,
    FaultKind::Estop,
    FaultKind::PowerLoss,
    FaultKind::Nan,
    FaultKind::ZeroState,
    FaultKind::Garbage,
    FaultKind::Corrupt,
    FaultKind::Truncated,
    FaultKind::WrongModel,
    FaultKind::Misread,
    FaultKind::Frozen,
    FaultKind::Blocked,
    FaultKind::Pushed,
    FaultKind::Nudged,
    FaultKind::Object,
    FaultKind::GripperBlocked,
];
/// Most connections at once, to arm and hand.
const CLIENTS: usize = 8;
/// Time between two looks for answers that are due.
const ANSWERS: Duration = Duration::from_millis(1);

/// Settings of the emulator.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SimOptions {
    /// Joint positions at power-up [rad], one per joint; a pose of its own when empty.
    pub initial_positions: Vec<f64>,
    /// Lag of the joints behind the commands, 0 to 0.5 [s].
    #[schemars(range(min = 0, max = 0.5))]
    pub lag: f64,
    /// How far below its target a joint rests under load, 0 to 0.2 [rad].
    #[schemars(range(min = 0, max = 0.2))]
    pub droop: f64,
    /// Nominal end effector in the flange's frame, as it is set in the controller's web interface: x, y, z [m], roll,
    /// pitch, yaw [rad].
    pub end_effector: [f64; 6],
    /// Share of the states, and of the commands, that the network loses, 0 to 1.
    #[schemars(range(min = 0, max = 1))]
    pub lose: f64,
    /// Share of them that come twice, 0 to 1.
    #[schemars(range(min = 0, max = 1))]
    pub repeat: f64,
    /// Share of them that the next one overtakes, 0 to 1.
    #[schemars(range(min = 0, max = 1))]
    pub reorder: f64,
    /// How much slower than this computer's the controller's clock is, -1000 to 1000 [ppm].
    #[schemars(range(min = -1000, max = 1000))]
    pub drift: f64,
    /// How long the controller's clock waits for a command that is late, 0 to 0.1 [s]; a real one does not wait. For a
    /// computer that is too busy for 1 kHz.
    #[schemars(range(min = 0, max = 0.1))]
    pub command_wait: f64,
    /// Whether the vendor's hand is set up in Desk as the end effector: the controller counts its mass beside the load.
    pub hand_in_desk: bool,
    /// Faults, and when they begin (seconds after the first connection).
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
            lag: 0.004,
            droop: 0.0,
            end_effector: [0.0; 6],
            lose: 0.0,
            repeat: 0.0,
            reorder: 0.0,
            drift: 0.0,
            command_wait: 0.0,
            hand_in_desk: false,
            faults: Vec::new(),
            controller: arm::ControllerOptions::default(),
            physics: None,
        }
    }
}

impl SimOptions {
    /// Returns an error for values that the emulator cannot have.
    pub(super) fn check(&self, limits: &JointLimits) -> Result<(), ConfigError> {
        for (name, value) in [("lose", self.lose), ("repeat", self.repeat), ("reorder", self.reorder)] {
            arm::check_range(name, value, 0.0..=1.0, "")?;
        }
        arm::check_range("drift", self.drift, -1000.0..=1000.0, "ppm")?;
        arm::check_range("command_wait", self.command_wait, 0.0..=0.1, "s")?;
        self.common().check("franka", limits, PLAYABLE)
    }

    fn end_effector(&self) -> Isometry3<f64> {
        let [x, y, z, roll, pitch, yaw] = self.end_effector;
        from_xyz_rpy([x, y, z], [roll, pitch, yaw])
    }

    fn common(&self) -> arm::SimOptions {
        let Self { initial_positions, lag, droop, faults, controller, physics, .. } = self.clone();
        arm::SimOptions { initial_positions, lag, droop, faults, controller, physics }
    }
}

/// A running emulator. Ends when it is dropped.
pub struct FrankaEmulator {
    server: Arc<TcpServer<Control>>,
    address: SocketAddr,
    ends: Arc<AtomicBool>,
    answers: Arc<Histogram>,
    clock: Option<JoinHandle<()>>,
}

impl FrankaEmulator {
    /// Starts an emulator at `place` of the arm that a configuration describes.
    pub fn start(config: &AdapterConfig, place: &EmulatorAddress) -> AdapterResult<Self> {
        config.check(super::check)?;
        let options: super::Options = config.options()?;
        let (address, listeners) = emulator_ports("franka", place, PORT, 2)?;
        let ip = address.ip();
        let serve = |e: std::io::Error| AdapterError::Io(format!("franka emulator: cannot serve: {e}"));
        let control = Control::new(options.model, &options.sim, MonotonicClock.now())?;
        let socket = UdpSocket::bind((ip, 0)).map_err(serve)?;
        socket.set_nonblocking(true).map_err(serve)?;
        let ports = listeners.into_iter().map(|listener| (listener, Port::Sessions(ANSWERS))).collect();
        let server = Arc::new(TcpServer::with_ports("franka", control, ports, CLIENTS, |_| true).map_err(serve)?);
        let ends = Arc::new(AtomicBool::new(false));
        let sim = options.sim;
        let network = Network { lose: sim.lose, repeat: sim.repeat, reorder: sim.reorder };
        let pace = Pace { drift: sim.drift * 1e-6, command_wait: Duration::from_secs_f64(sim.command_wait) };
        let answers = Arc::new(Histogram::default());
        let (shared, end, times) = (server.clone(), ends.clone(), answers.clone());
        let clock = std::thread::Builder::new()
            .name("franka-sim-clock".to_owned())
            .spawn(move || clock::run(&shared, &socket, &end, (network, pace), &times))
            .map_err(serve)?;
        Ok(Self { server, address, ends, answers, clock: Some(clock) })
    }

    fn with<T>(&self, act: impl FnOnce(&mut Control) -> T) -> T {
        self.server.with(|control, _| act(control))
    }

    /// Returns what happened so far.
    pub fn figures(&self) -> Figures {
        self.with(|control| control.figures)
    }

    /// Returns the time from each state to the command that answered it.
    pub fn answer_times(&self) -> histogram::Figures {
        self.answers.figures()
    }

    /// Applies external torques to the joints [Nm].
    pub fn push(&self, torques: [f64; DOF]) {
        self.with(|control| control.external = torques);
    }

    /// Presses or releases the user stop.
    pub fn user_stop(&self, pressed: bool) {
        self.with(|control| control.user_stop(pressed));
    }

    /// Presses or releases the guiding button.
    pub fn guide(&self, pressed: bool) {
        self.with(|control| control.guide(pressed));
    }

    /// Returns the stiffness of the joints [Nm/rad], and the upper thresholds of external torques [Nm].
    pub fn settings(&self) -> ([f64; DOF], [f64; DOF]) {
        self.with(|control| (control.impedance, control.thresholds.1))
    }

    /// Puts an object between the fingers [m], or takes it away.
    pub fn place_object(&self, width: Option<f64>) {
        self.with(|control| control.hand.put_object(width));
    }

    /// Sets whether the hand has been homed.
    pub fn set_homed(&self, homed: bool) {
        self.with(|control| control.hand.homed = homed);
    }

    /// Begins to record datagrams.
    pub fn record(&self) {
        self.with(|control| control.traffic.start());
    }

    /// Returns the datagrams since then.
    pub fn traffic(&self) -> Vec<Datagram> {
        self.with(|control| control.traffic.entries())
    }
}

impl Drop for FrankaEmulator {
    fn drop(&mut self) {
        self.ends.store(true, Ordering::Release);
        if let Some(clock) = self.clock.take() {
            let _ = clock.join();
        }
    }
}

impl Emulator for FrankaEmulator {
    fn address(&self) -> String {
        self.address.to_string()
    }

    fn inject(&self, fault: Fault) -> Result<(), String> {
        self.server.inject(fault)
    }

    fn truth(&self) -> Truth {
        self.server.truth()
    }
}

/// Returns the limits within which the emulated joints move: the controller's, with a drive that is stronger.
fn limits(model: Model) -> JointLimits {
    let limits = model.limits(true);
    JointLimits { acceleration_max: vec![40.0; DOF], ..limits }
}
