//! The emulator of a controller with its arm, for `address: sim`, for tests, and for other clients such as `ur_rtde`.
//!
//! Written from the protocol, and shares no code with the adapter besides the models' dimensions: two sides that share
//! an encoder share its mistakes. The text of the adapter's program is carried out (`super::script`), that of `ur_rtde`
//! is recognized by its name, and any other one starts and ends.

mod controller;
mod dashboard;
mod fields;
mod ours;
mod pace;
mod points;
mod ports;
mod primary;
mod programs;
mod robot_api;
mod rtde;
mod scripts;
#[cfg(test)]
mod tests;

use std::net::{SocketAddr, TcpListener};
use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::address::{API_PORT, FIRST_PORT, PORTS, Service};
use super::model::Model;
use controller::Controller;
use dimos_core::arm::Dh;
use dimos_core::clock::{Clock, Mono, MonotonicClock};
use dimos_core::joint::JointLimits;
use dimos_hardware::adapter::{AdapterError, AdapterResult};
use dimos_hardware::check::ConfigError;
use dimos_hardware::registry::{AdapterConfig, Emulator, EmulatorAddress, Truth};
use dimos_hardware::sim::arm;
use dimos_hardware::sim::faults::{Fault, FaultKind};
use dimos_hardware::sim::physics::PhysicsOptions;
use dimos_hardware::sim::tcp_server::{Port, TcpServer, cannot_listen, emulator_ports};
use dimos_hardware::sim::tool_device::ToolDevice;
use dimos_hardware::transport::line::UR_TOOL_PORT;

/// The faults that the controller can play. Its joints have one supply, so no single motor goes off.
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
    FaultKind::Sag,
    FaultKind::Blocked,
    FaultKind::Pushed,
    FaultKind::Nudged,
    FaultKind::InputLow,
];
/// The ports, in the order of their numbers here.
const SERVICES: [Service; 6] =
    [Service::Dashboard, Service::Primary, Service::Secondary, Service::RealTime, Service::Rtde, Service::Tool];
/// Whether programs may come at a port, by its number here.
fn takes_scripts(port: usize) -> bool {
    matches!(SERVICES.get(port), Some(Service::Primary | Service::Secondary | Service::RealTime))
}

/// Most connections at once.
const CLIENTS: usize = 32;
/// Time between two looks for messages at the script's ports.
const MESSAGES: Duration = Duration::from_millis(10);
/// The dashboard sends nothing that is not asked for.
const NEVER: Duration = Duration::from_secs(3600);

/// Settings of the emulator.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SimOptions {
    /// Joint positions at power-up [rad], one per joint; an upright pose when empty.
    pub initial_positions: Vec<f64>,
    /// Lag of the joints behind the servo setpoints of a program, 0 to 0.5 [s].
    #[schemars(range(min = 0, max = 0.5))]
    pub lag: f64,
    /// How far below its target a joint rests under load, 0 to 0.2 [rad].
    #[schemars(range(min = 0, max = 0.2))]
    pub droop: f64,
    /// Software of the controller, such as 5.4.0; empty: one that has all values.
    pub software: String,
    /// Serial number of the arm, digits only.
    pub serial: String,
    /// Pose of the tool's centre point in the flange's frame: x, y, z [m], rotation vector [rad].
    pub tcp_offset: [f64; 6],
    /// The arm's own Denavit-Hartenberg parameters, one entry per joint; those of the data sheet when empty.
    pub kinematics: Vec<Dh>,
    /// How long power-on and the release of the brakes take, each, 0 to 60 [s].
    #[schemars(range(min = 0, max = 60))]
    pub power_time: f64,
    /// Whether the pendant is in remote control, which an e-Series controller needs for programs.
    pub remote_control: bool,
    /// Position of the pendant's speed slider, 0 to 1.
    #[schemars(range(min = 0, max = 1))]
    pub speed_slider: f64,
    /// How much of that speed the limits of the controller leave, as in reduced mode, 0 to 1.
    #[schemars(range(min = 0, max = 1))]
    pub speed_scaling: f64,
    /// A surface below the tool; `null` for none.
    pub surface: Option<Surface>,
    /// Faults, and when they begin (seconds after the first connection).
    pub faults: Vec<Fault>,
    /// What the controller does otherwise than its documents say.
    pub controller: arm::ControllerOptions,
    /// A body with mass, by MuJoCo: `{}`, or with a seed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub physics: Option<PhysicsOptions>,
}

/// A horizontal surface that yields like a spring where the tool's centre point presses on it. It does not hold the arm
/// up.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Surface {
    /// Its height in the arm's base frame [m].
    pub height: f64,
    /// Its stiffness, 1 to 1000000 [N/m].
    #[schemars(range(min = 1, max = 1_000_000))]
    pub stiffness: f64,
}

impl Surface {
    /// Returns the force on the tool that is at this height [N].
    pub(super) fn force(&self, height: f64) -> f64 {
        self.stiffness * (self.height - height).max(0.0)
    }
}

impl Default for SimOptions {
    fn default() -> Self {
        Self {
            initial_positions: Vec::new(),
            lag: 0.05,
            droop: 0.0,
            software: String::new(),
            serial: "20195500123".into(),
            tcp_offset: [0.0; 6],
            kinematics: Vec::new(),
            power_time: 0.05,
            remote_control: true,
            speed_slider: 1.0,
            speed_scaling: 1.0,
            surface: None,
            faults: Vec::new(),
            controller: arm::ControllerOptions::default(),
            physics: None,
        }
    }
}

impl SimOptions {
    /// Returns an error for values that the emulator cannot have.
    pub(super) fn check(&self, limits: &JointLimits) -> Result<(), ConfigError> {
        arm::check_range("power_time", self.power_time, 0.0..=60.0, "s")?;
        arm::check_range("speed_slider", self.speed_slider, 0.0..=1.0, "")?;
        let wrong = |option: &str, what: &str| Err(ConfigError::new(format!("sim.{option}"), what));
        if !self.software.is_empty() && parse_software(&self.software).is_none() {
            return wrong("software", "a version is like 5.11.6");
        }
        if !self.serial.bytes().all(|byte| byte.is_ascii_digit()) {
            return wrong("serial", "a serial number has digits only");
        }
        if !self.kinematics.is_empty() && self.kinematics.len() != super::DOF {
            return wrong("kinematics", "one entry per joint");
        }
        arm::check_range("speed_scaling", self.speed_scaling, 0.0..=1.0, "")?;
        if let Some(surface) = self.surface {
            arm::check_range("surface.height", surface.height, -10.0..=10.0, "m")?;
            arm::check_range("surface.stiffness", surface.stiffness, 1.0..=1e6, "N/m")?;
        }
        self.common().check("ur", limits, PLAYABLE)
    }

    fn software(&self, model: Model) -> [u8; 3] {
        let own = if model.is_cb3() { [3, 15, 8] } else { [5, 11, 6] };
        parse_software(&self.software).unwrap_or(own)
    }

    /// Returns the arm's parameters.
    fn kinematics(&self, model: Model) -> [Dh; super::DOF] {
        let nominal = model.dh();
        self.kinematics.clone().try_into().unwrap_or(nominal)
    }

    fn common(&self) -> arm::SimOptions {
        let Self { initial_positions, lag, droop, faults, controller, physics, .. } = self.clone();
        arm::SimOptions { initial_positions, lag, droop, faults, controller, physics }
    }
}

fn parse_software(text: &str) -> Option<[u8; 3]> {
    let numbers: Vec<u8> = text.split('.').map(|number| number.parse().ok()).collect::<Option<_>>()?;
    numbers.try_into().ok()
}

/// A running emulator. Ends when it is dropped.
pub struct UrEmulator {
    server: TcpServer<Controller>,
    address: SocketAddr,
    /// The port of the tool's line.
    tool: Option<SocketAddr>,
}

impl UrEmulator {
    /// Starts an emulator at `place` of the arm that a configuration describes.
    pub fn start(config: &AdapterConfig, place: &EmulatorAddress) -> AdapterResult<Self> {
        config.check(super::check)?;
        let options: super::Options = config.options()?;
        let (address, listeners) = emulator_ports("ur", place, FIRST_PORT, PORTS)?;
        let used = SERVICES.map(|service| service as usize);
        let mut controller = Controller::new(options.model, &options.sim, MonotonicClock.now())?;
        if let Some(number) = place.number().filter(|_| options.sim.serial == SimOptions::default().serial) {
            controller.serial = format!("201{number:08}");
        }
        let mut listeners: Vec<_> = listeners.into_iter().map(Some).collect();
        if controller.is_polyscope_x() {
            let api = Service::RobotApi as usize;
            let place = SocketAddr::new(address.ip(), API_PORT);
            let at_default = address.port() == FIRST_PORT;
            let own = at_default.then(|| TcpListener::bind(place).map_err(|e| cannot_listen("ur emulator", place, &e)));
            // It has no dashboard: nothing answers there.
            listeners.swap(Service::Dashboard as usize, api);
            if let (Some(own), Some(first)) = (own.transpose()?, listeners.first_mut()) {
                *first = Some(own);
            }
        }
        let listeners = listeners.into_iter().enumerate().filter(|(i, _)| used.contains(i));
        let listeners = listeners.filter_map(|(_, listener)| listener);
        let tool = match options.model.is_cb3() {
            true => None,
            false => {
                let port = if address.port() == FIRST_PORT { UR_TOOL_PORT } else { 0 };
                let place = SocketAddr::new(address.ip(), port);
                Some(TcpListener::bind(place).map_err(|e| cannot_listen("ur emulator", place, &e))?)
            }
        };
        let tool_at = tool.as_ref().and_then(|listener| listener.local_addr().ok());
        let listeners = listeners.chain(tool);
        let period = Duration::from_secs_f64(1.0 / options.model.rate());
        let ports = listeners.zip(SERVICES).map(|(listener, service)| {
            let period = match service {
                Service::Dashboard | Service::Tool => NEVER,
                Service::Rtde => period,
                _ => MESSAGES,
            };
            (listener, Port::Sessions(period))
        });
        let server = TcpServer::with_ports("ur", controller, ports.collect(), CLIENTS, |_| true);
        let server = server.map_err(|e| AdapterError::Io(format!("ur emulator: cannot serve: {e}")))?;
        Ok(Self { server, address, tool: tool_at })
    }

    /// Returns the address of the tool's RS-485 line, as the vendor's URCap has it; `None` for a CB3 arm.
    pub fn tool_line(&self) -> Option<SocketAddr> {
        self.tool
    }

    /// Connects a device to that line, which runs at `baud` [bit/s].
    pub fn fit_tool(&self, device: impl ToolDevice, baud: u32) {
        self.with(|controller| controller.tool.fit(device, baud));
    }

    /// Calls `act` with the controller, advanced to the present.
    fn with<T>(&self, act: impl FnOnce(&mut Controller) -> T) -> T {
        self.server.with(|controller, now| {
            controller.advance_to(now);
            act(controller)
        })
    }

    /// Sets the safety mode, as safety inputs and faults do; `None`: normal.
    pub fn set_safety(&self, mode: Option<i32>) {
        self.with(|controller| controller.set_safety(mode));
    }

    /// Moves the pendant's speed slider, 0 to 1.
    pub fn set_slider(&self, fraction: f64) {
        self.with(|controller| controller.slider = fraction);
    }

    /// Sets how much of the slider's speed the limits of the controller leave, 0 to 1.
    pub fn set_scaling(&self, fraction: f64) {
        self.with(|controller| controller.scaling = fraction);
    }

    /// Changes between remote control and the pendant.
    pub fn set_remote_control(&self, remote: bool) {
        self.with(|controller| controller.set_remote_control(remote));
    }

    /// Stops the running program, as the pendant's button does.
    pub fn press_stop(&self) {
        self.with(Controller::stop_program);
    }

    /// Lets programs fail in their first line, or run again.
    pub fn refuse_programs(&self, refuse: bool) {
        self.with(|controller| controller.refuses_programs = refuse);
    }

    /// Ends the program's answers: it runs, and ignores every order.
    pub fn hang_program(&self, hang: bool) {
        self.with(|controller| controller.hangs = hang);
    }

    /// Lets the dashboard close connections instead of answering.
    pub fn break_dashboard(&self, broken: bool) {
        self.with(|controller| controller.breaks_dashboard = broken);
    }

    /// Withholds the answer to this request of the dashboard once, until the next one.
    pub fn answer_late(&self, request: &'static str) {
        self.with(|controller| controller.late_answer = Some(request));
    }

    /// Lets paused programs count as running in the status bits, or not: controllers may differ.
    pub fn hide_paused_programs(&self, hide: bool) {
        self.with(|controller| controller.hides_paused = hide);
    }

    /// Pauses the running program, as the pendant's button does.
    pub fn press_pause(&self) {
        self.with(Controller::pause_program);
    }

    /// Sets the robot mode, for one that only the pendant leads to.
    pub fn set_robot_mode(&self, mode: i32) {
        self.with(|controller| controller.mode = mode);
    }

    /// Changes the arm's serial number, as when another arm is connected in its place.
    pub fn set_serial(&self, serial: &str) {
        self.with(|controller| serial.clone_into(&mut controller.serial));
    }

    /// Sets the level of a digital input, bits as in RTDE.
    pub fn set_input(&self, number: u8, high: bool) {
        self.with(|controller| controller.set_input(number, high));
    }

    /// Returns the payload [kg] and its centre of gravity [m].
    pub fn payload(&self) -> (f64, [f64; 3]) {
        self.with(|controller| (controller.payload.0, controller.payload.1))
    }

    /// Returns the acceleration of the base that balances gravity, as programs set it [m/s²].
    pub fn gravity(&self) -> [f64; 3] {
        self.with(|controller| controller.gravity)
    }

    /// Returns the positions [rad] that the program gave to servoj, one a step, and when.
    pub fn servoj(&self) -> Vec<(Mono, [f64; super::DOF])> {
        self.with(|controller| controller.servoj.iter().copied().collect())
    }

    /// Returns the address of the primary interface, which takes programs.
    pub fn primary(&self) -> SocketAddr {
        SocketAddr::new(self.address.ip(), self.address.port() + Service::Primary as u16)
    }

    /// Returns the name of the running program.
    pub fn program(&self) -> Option<String> {
        self.with(|controller| controller.program_name().map(str::to_owned))
    }

    /// Returns how many connections there are.
    pub fn clients(&self) -> usize {
        self.with(|controller| controller.sessions.len())
    }

    /// Returns the digital outputs, bits as in RTDE, and the analog ones [V or A].
    pub fn outputs(&self) -> (u64, [f64; 2]) {
        self.with(|controller| (controller.outputs.digital, controller.outputs.analog))
    }
}

impl Emulator for UrEmulator {
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

/// Returns the limits within which the emulated joints move.
fn limits(model: Model) -> JointLimits {
    JointLimits { acceleration_max: vec![20.0; super::DOF], ..model.limits() }
}
