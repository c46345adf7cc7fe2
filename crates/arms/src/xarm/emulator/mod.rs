//! The emulator of the control box of an xArm, Lite 6 or 850 on a loopback address, for `address: sim`, for tests,
//! and for the vendor's own client. It serves any number of clients at once, as the real one does.
//!
//! The sockets, the arm and its faults are those of the simulation kit ([`dimos_hardware::sim`]); here is what the
//! controller makes of a request (`wire`, `registers`), what it reports (`report`), and its modes, states and errors
//! (`controller`). The arm behind the controller is simulated, or one of a run ([`ControlBox`], for `dimos proxy`).

mod controlled_arm;
mod controller;
mod judge;
mod kinematics;
mod line;
mod modbus;
mod motion;
mod move_request;
mod ports;
mod queue;
mod reduced_mode;
mod registers;
mod report;
mod settings;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod tests_moves;
mod tool;
mod wire;

use std::io;
use std::net::{IpAddr, SocketAddr, TcpListener};
use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::address::{CONTROL_PORT, REPORT_PORT};
use super::model::Model;
use super::protocol::gripper::GripperKind;
use super::protocol::identity::Firmware;
use super::{Options, model_of};
pub use controlled_arm::{ControlledArm, JOINT_LIMIT, Refusal};
pub use controller::Received;
use controller::{Controller, introduce};
use dimos_core::clock::{Clock, MonotonicClock};
use dimos_core::joint::{JointLimits, Joints};
use dimos_hardware::adapter::{AdapterError, AdapterResult};
use dimos_hardware::check::ConfigError;
use dimos_hardware::registry::{AdapterConfig, Emulator, EmulatorAddress, Truth};
use dimos_hardware::sim::arm::{self, HasArm, SimArm};
use dimos_hardware::sim::faults::{Fault, FaultKind};
use dimos_hardware::sim::peer;
use dimos_hardware::sim::physics::PhysicsOptions;
use dimos_hardware::sim::tcp_server::{ATTEMPTS, Port, TcpServer, cannot_listen, ports_in_a_row};
use dimos_hardware::sim::tool_device::ToolDevice;
pub use kinematics::Links;
pub use line::Line;
pub use move_request::{Frame, MoveRequest, Target};
use report::Kind;

/// The faults that it can play.
const PLAYABLE: &[FaultKind] = &arm::playable_and::<{ arm::PLAYABLE.len() + 2 }>(&dimos_hardware::sim::gripper::FAULTS);
/// Prefix of messages.
const WHO: &str = "xarm emulator";
/// The report ports follow one another; they come first among the emulator's ports.
const REPORT_PORTS: u16 = Kind::ALL.len() as u16;
/// The second control port comes last.
const SECOND: usize = Kind::ALL.len() + 1;
/// Most control connections at once.
const CLIENTS: usize = 16;

/// What the emulator does.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SimOptions {
    /// Joint positions at power-up [rad], one per joint; a pose amid the range when empty.
    pub initial_positions: Vec<f64>,
    /// Firmware version of the controller. Before 2.1.0 there is no report with velocities.
    pub firmware: String,
    /// Whether it serves the second control port (503), which newer boxes have for the gripper's bus.
    pub port_503: bool,
    /// Registers whose replies take time, as those of a real box do.
    pub slow_replies: Vec<SlowReply>,
    /// Limit of the tool's speed in servo mode, as a multiple of its top speed: what `set_linear_spd_limit_factor` sets
    /// and the controller saves. Above it, it stops with error 60.
    #[schemars(range(min = 0.1, max = 100))]
    pub tool_speed_factor: f32,
    /// Tool offset that is set at the controller: x, y, z [m], roll, pitch, yaw [rad].
    pub tcp_offset: [f64; 6],
    /// Offset of the base that is set at the controller, alike.
    pub world_offset: [f64; 6],
    /// How far joints are behind their servo setpoints, 0 to 0.5 [s].
    #[schemars(range(min = 0, max = 0.5))]
    pub lag: f64,
    /// How far below their targets joints rest under load, 0 to 0.2 [rad].
    #[schemars(range(min = 0, max = 0.2))]
    pub droop: f64,
    /// What goes wrong, and when (seconds after the first connection).
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
            firmware: "2.5.1".into(),
            port_503: true,
            slow_replies: Vec::new(),
            tool_speed_factor: judge::LIMIT_FACTOR,
            tcp_offset: [0.0; 6],
            world_offset: [0.0; 6],
            lag: 0.01,
            droop: 0.0,
            faults: Vec::new(),
            controller: arm::ControllerOptions::default(),
            physics: None,
        }
    }
}

/// A register whose replies take time. What was asked happens at once; requests that come later over the same
/// connection wait, as the controller replies in order.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SlowReply {
    /// The register: 11 enable, 12 state, 16 clear the error, 19 mode, 124 RS485 of the gripper.
    #[schemars(range(min = 1, max = 254))]
    pub register: u8,
    /// How long its replies take [s].
    #[schemars(range(min = 0, max = 3600))]
    pub delay: f64,
}

impl SimOptions {
    /// Refuses a pose outside `limits`, firmware that has no version, and faults that the emulator cannot play.
    pub(super) fn check(&self, limits: &JointLimits) -> Result<(), ConfigError> {
        self.common().check("xarm", limits, PLAYABLE)?;
        if let Some(i) = self.slow_replies.iter().position(|slow| !(0.0..=3600.0).contains(&slow.delay)) {
            return Err(ConfigError::new(format!("sim.slow_replies.{i}.delay"), "a delay is between 0 and 3600 s"));
        }
        if !(0.1..=100.0).contains(&self.tool_speed_factor) {
            return Err(ConfigError::new("sim.tool_speed_factor", "it is between 0.1 and 100"));
        }
        self.firmware().map(drop)
    }

    /// What all emulated arms have.
    fn common(&self) -> arm::SimOptions {
        let Self { initial_positions, lag, droop, faults, controller, physics, .. } = self.clone();
        arm::SimOptions { initial_positions, lag, droop, faults, controller, physics }
    }

    fn firmware(&self) -> Result<[u16; 3], ConfigError> {
        let what = || format!("firmware {:?} is not a version like 2.5.1", self.firmware);
        let Firmware(version) =
            Firmware::parse(&self.firmware).ok_or_else(|| ConfigError::new("sim.firmware", what()))?;
        Ok(version)
    }
}

/// A running emulator. Ends when it is dropped.
pub struct XArmEmulator {
    server: TcpServer<Controller<SimArm>>,
    address: String,
}

impl XArmEmulator {
    /// Starts an emulator at `place` of the arm that a configuration describes.
    pub fn start(config: &AdapterConfig, place: &EmulatorAddress) -> AdapterResult<Self> {
        let options: Options = config.options()?;
        let model = model_of(&options, config.dof)?;
        let control = place.tcp(CONTROL_PORT)?;
        let in_process = *place == EmulatorAddress::InProcess;
        Self::listen(model, options.gripper, &options.sim, control.ip(), in_process)
    }

    fn listen(
        model: Model,
        gripper: GripperKind,
        options: &SimOptions,
        ip: IpAddr,
        in_process: bool,
    ) -> AdapterResult<Self> {
        options.check(&model.limits())?;
        let firmware = options.firmware()?;
        let (ports, address) = listen(WHO, ip, in_process, options.port_503)?;
        let mut controller = Controller::new(model, firmware, gripper, options, MonotonicClock.now())?;
        if let Some(number) = EmulatorAddress::Bind(ip).number() {
            controller.unit = format!("C{number:07}");
        }
        let server = TcpServer::with_ports("xarm", controller, ports, CLIENTS, |_| true).map_err(cannot_serve)?;
        Ok(Self { server, address })
    }

    /// Presses the E-stop button: error 1, motors off, until it is released, cleared and enabled.
    pub fn press_estop(&self) {
        self.server.with(|controller, now| {
            controller.advance(now);
            controller.press_estop();
        });
    }

    /// Releases the E-stop button. Nothing else changes.
    pub fn release_estop(&self) {
        self.server.with(|controller, _| controller.arm().release_estop());
    }

    /// Makes the controller ignore changes of the mode, or accept them again.
    pub fn keep_mode(&self, keep: bool) {
        self.server.with(|controller, _| controller.keeps_mode = keep);
    }

    /// Mutes ports 30001 and 30002 while their connections stay open and all other ports continue, or unmutes it.
    pub fn mute_condition(&self, mute: bool) {
        self.server.with(|controller, _| controller.condition_muted = mute);
    }

    /// Delays the responses to a register by this time [s].
    pub fn slow_down(&self, register: u8, delay: f64) {
        self.server.with(|controller, _| controller.slow_down(SlowReply { register, delay }));
    }

    /// Lets port 30000 close its connections, or keep them open without reports.
    pub fn withhold_full_reports(&self, withhold: Withhold) {
        self.server.with(|controller, _| controller.withhold = withhold);
    }

    /// True joint positions [rad] and velocities [rad/s] now.
    pub fn joints(&self) -> (Joints, Joints) {
        self.server.with(HasArm::joints_at)
    }

    /// Whether all motors are on.
    pub fn enabled(&self) -> bool {
        self.server.with(|controller, _| controller.arm().enabled())
    }

    /// The gripper's true opening now [m].
    pub fn gripper(&self) -> f64 {
        self.server.with(|controller, now| {
            controller.advance(now);
            controller.tool.opening()
        })
    }

    /// Connects a device to the RS-485 line at the tool, which runs at `baud` [bit/s].
    pub fn fit_tool(&self, device: impl ToolDevice, baud: u32) {
        self.server.with(|controller, _| controller.tool.socket.fit(device, baud));
    }

    /// Starts to record what comes over the wire, up to 200 000 requests; forgets what was recorded before.
    pub fn record(&self) {
        self.server.with(|controller, _| controller.trace.start());
    }

    /// What came over the wire since [`XArmEmulator::record`].
    pub fn trace(&self) -> Vec<Received> {
        self.server.with(|controller, _| controller.trace.entries())
    }
}

impl Emulator for XArmEmulator {
    fn address(&self) -> String {
        self.address.clone()
    }

    fn inject(&self, fault: Fault) -> Result<(), String> {
        self.server.inject(fault)
    }

    fn truth(&self) -> Truth {
        self.server.truth()
    }
}

/// The control box with another arm behind it than the simulated one. Ends when it is dropped.
pub struct ControlBox<A: ControlledArm> {
    server: TcpServer<Controller<A>>,
    address: String,
}

impl<A: ControlledArm> ControlBox<A> {
    /// Serves `arm` as a `model` with the default firmware, at the arm's own ports of a loopback
    /// address, to programs of this user and of root.
    pub fn start(model: Model, gripper: GripperKind, arm: A, ip: IpAddr) -> AdapterResult<Self> {
        let ip = EmulatorAddress::Bind(ip).tcp(CONTROL_PORT)?.ip();
        let (ports, address) = listen("xArm control box", ip, false, true)?;
        let firmware = SimOptions::default().firmware()?;
        let controller = Controller::around(introduce(model), firmware, gripper, arm);
        let server =
            TcpServer::with_ports("xarm", controller, ports, CLIENTS, peer::is_ours_or_root).map_err(cannot_serve)?;
        Ok(Self { server, address })
    }

    /// Returns its address: host, control port and first report port.
    pub fn address(&self) -> &str {
        &self.address
    }

    /// Begins queued moves that are due, and calls `f` with the arm.
    pub fn with<T>(&self, f: impl FnOnce(&mut A) -> T) -> T {
        self.server.with(|controller, now| {
            controller.advance(now);
            f(&mut controller.arm)
        })
    }
}

fn cannot_serve(error: io::Error) -> AdapterError {
    AdapterError::Io(format!("{WHO}: cannot serve: {error}"))
}

/// Listens at the arm's own ports, or at free ones. Returns the ports and their address.
fn listen(who: &str, ip: IpAddr, free: bool, second: bool) -> AdapterResult<(Vec<(TcpListener, Port)>, String)> {
    let (control, reports) = if free {
        let free = |_| {
            let control = ports_in_a_row(ip, 0, 1 + u16::from(second)).ok()?;
            Some((control, ports_in_a_row(ip, 0, REPORT_PORTS).ok()?))
        };
        let found = (0..ATTEMPTS).find_map(free);
        found.ok_or_else(|| AdapterError::Io(format!("{who}: no free ports at {ip}")))?
    } else {
        let at = |first, count| {
            let failed = |e: io::Error| cannot_listen(who, SocketAddr::new(ip, first), &e);
            ports_in_a_row(ip, first, count).map_err(failed)
        };
        (at(CONTROL_PORT, 1 + u16::from(second))?, at(REPORT_PORT, REPORT_PORTS)?)
    };
    let port = |listeners: &[TcpListener]| {
        listeners.first().map_or(Ok(0), |first| first.local_addr().map(|at| at.port())).map_err(cannot_serve)
    };
    let address = format!("{}:{}", SocketAddr::new(ip, port(&control)?), port(&reports)?);
    let periods = Kind::ALL.map(|kind| Port::Reports(Duration::from_micros(kind.period_us())));
    let ports = reports.into_iter().zip(periods).chain(control.into_iter().map(|port| (port, Port::Requests)));
    Ok((ports.collect(), address))
}

/// Fault of the reports of port 30000.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Withhold {
    /// They are sent.
    #[default]
    No,
    /// Connections end at once.
    Close,
    /// Connections stay, and nothing is sent.
    Silence,
}
