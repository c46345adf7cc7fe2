//! The emulator of a YourArm controller on a loopback address, for `address: sim` and for tests.
//!
//! The joints are advanced at every request. Like the real controller it serves one client at a time and rejects a
//! second one.

mod controller;
mod kinematics;
mod masses;
pub mod wire;

pub use super::Sim;
use super::protocol::PORT;
use controller::Controller;
pub use controller::Received;
use dimos_core::clock::{Clock, MonotonicClock};
use dimos_core::joint::Joints;
use dimos_hardware::adapter::AdapterResult;
use dimos_hardware::registry::{AdapterConfig, Emulator, EmulatorAddress, Truth};
use dimos_hardware::sim::arm::HasArm;
pub use dimos_hardware::sim::arm::SimOptions;
use dimos_hardware::sim::faults::Fault;
use dimos_hardware::sim::tcp_server::TcpServer;

/// A running emulator. Ends when it is dropped.
pub struct YourArmEmulator {
    server: TcpServer<Controller>,
}

impl YourArmEmulator {
    /// Starts an emulator at `place`, with the `sim` part of an adapter's options.
    pub fn start(config: &AdapterConfig, place: &EmulatorAddress) -> AdapterResult<Self> {
        Self::listen(&config.options::<super::Options>()?.sim, place)
    }

    /// Starts an emulator on a free loopback port.
    pub fn with(options: &SimOptions) -> AdapterResult<Self> {
        Self::of(&Sim::from(options.clone()))
    }

    /// Starts an emulator with all its settings on a free loopback port.
    pub fn of(options: &Sim) -> AdapterResult<Self> {
        Self::listen(options, &EmulatorAddress::InProcess)
    }

    fn listen(options: &Sim, place: &EmulatorAddress) -> AdapterResult<Self> {
        let address = place.tcp(PORT)?;
        let mut controller = Controller::new(options, MonotonicClock.now())?;
        if let Some(number) = place.number() {
            controller.serial = format!("YA6-{number:08}");
        }
        Ok(Self { server: TcpServer::start("yourarm", controller, address)? })
    }

    /// Presses the E-stop button: error 1, motors off, until it is released, cleared and enabled.
    pub fn press_estop(&self) {
        self.server.with(|controller, now| {
            controller.advance(now);
            controller.arm.press_estop();
        });
    }

    /// Releases the E-stop button. Nothing else changes.
    pub fn release_estop(&self) {
        self.server.with(|controller, _| controller.arm.release_estop());
    }

    /// Sets the level of a digital input, as the device wired to it does. All are high at power-up.
    pub fn set_input(&self, input: u8, high: bool) {
        self.server.with(|controller, _| controller.io.set_input(input, high));
    }

    /// Load at the flange that was set: mass [kg], centre x, y, z [mm], inertia xx, xy, xz, yy, yz, zz [kg·m²].
    pub fn load(&self) -> [f32; 10] {
        self.server.with(|controller, _| controller.load)
    }

    /// Puts an object of this width [m] between the fingers of the gripper; 0 takes it away.
    pub fn put_object(&self, width: f64) {
        self.server.with(|controller, _| controller.gripper.put_object(width));
    }

    /// Forgets the load, as at power-up.
    pub fn forget_load(&self) {
        self.server.with(|controller, _| controller.load = [0.0; 10]);
    }

    /// Levels of the digital outputs: bit i is output i.
    pub fn digital_outputs(&self) -> u32 {
        self.server.with(|controller, _| controller.io.state().digital_outputs)
    }

    /// True joint positions [rad] and velocities [rad/s] now.
    pub fn joints(&self) -> (Joints, Joints) {
        self.server.with(Controller::joints_at)
    }

    /// Whether the motors are on.
    pub fn enabled(&self) -> bool {
        self.server.with(|controller, _| controller.arm.enabled())
    }

    /// Starts to record what comes over the wire, up to 200 000 requests; forgets what was recorded before.
    pub fn record(&self) {
        self.server.with(|controller, _| controller.trace.start());
    }

    /// What came over the wire since [`YourArmEmulator::record`].
    pub fn trace(&self) -> Vec<Received> {
        self.server.with(|controller, _| controller.trace.entries())
    }

    /// Returns how many clients were rejected because another one was connected.
    pub fn refused_clients(&self) -> u64 {
        self.server.refused()
    }
}

impl Emulator for YourArmEmulator {
    fn address(&self) -> String {
        self.server.address().to_string()
    }

    fn inject(&self, fault: Fault) -> Result<(), String> {
        self.server.inject(fault)
    }

    fn truth(&self) -> Truth {
        self.server.truth()
    }
}
