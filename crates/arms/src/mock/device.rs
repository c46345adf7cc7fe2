//! The mock arm's controller: a [`SimArm`] that is advanced to the present at every call.

use std::sync::Arc;
use std::time::Duration;

use super::limits;
use super::options::{Options, PLAYABLE};
use dimos_core::arm::{Load, UPRIGHT};
use dimos_core::clock::{Clock, Mono};
use dimos_core::joint::Joints;
use dimos_hardware::adapter::{AdapterError, AdapterResult};
use dimos_hardware::sim::arm::{Delivery, SimArm};
use dimos_hardware::sim::faults::{Fault, FaultKind};
use dimos_hardware::sim::gripper::Gripper;
use dimos_hardware::sim::io::SimIo;
use dimos_hardware::sim::plant::{Plant, Tracking};

/// Maximum opening of the gripper [m].
pub const GRIPPER_MAX: f64 = 0.08;
/// Smallest and largest force of the gripper, and the one for a command without a force [N].
pub const GRIPPER_FORCE: (f64, f64) = (1.0, 40.0);
pub const GRIPPER_DEFAULT_FORCE: f64 = 20.0;
/// Speed of the gripper [m/s].
const GRIPPER_SPEED: f64 = 0.1;
/// How fast an arm without brakes sinks while disabled [rad/s].
const FALL_SPEED: f64 = 0.2;

/// The simulated arm behind the adapter.
pub struct Device {
    pub arm: SimArm,
    pub gripper: Gripper,
    pub io: SimIo,
    pub load: Load,
    pub gravity: [f64; 3],
    pub connected: bool,
    clock: Arc<dyn Clock>,
    latency: Duration,
    /// When the power returns after a scripted loss of power.
    power_off_until: Mono,
}

impl Device {
    /// An arm of `dof` joints that was just switched on.
    pub fn new(dof: usize, options: &Options, clock: Arc<dyn Clock>) -> AdapterResult<Self> {
        let tracking = if options.lag > 0.0 { Tracking::Lag(options.lag) } else { Tracking::Ideal };
        let fall = if options.brakes { 0.0 } else { FALL_SPEED };
        let arm = SimArm::new("mock", &limits(dof), &options.sim(), PLAYABLE, clock.now())?;
        let plant = Plant::new(&limits(dof), &options.initial_positions, tracking, fall);
        Ok(Self {
            // Targets outside the limits are accepted; the joints stop at the limits.
            arm: arm.with_plant(plant).with_tolerance(f64::INFINITY),
            gripper: Gripper::new(GRIPPER_MAX, GRIPPER_SPEED).with_force(GRIPPER_DEFAULT_FORCE),
            io: SimIo::default(),
            load: Load::default(),
            gravity: UPRIGHT,
            connected: false,
            clock,
            latency: Duration::from_secs_f64(options.latency_ms * 1e-3),
            power_off_until: Mono::ZERO,
        })
    }

    pub fn inject(&mut self, fault: Fault) -> Result<(), String> {
        self.arm.inject(fault, self.clock.now())
    }

    pub fn connect(&mut self) -> AdapterResult<()> {
        let now = self.clock.now();
        if now < self.power_off_until {
            return Err(AdapterError::Io("cannot connect to the mock arm: it has no power (scripted fault)".into()));
        }
        self.advance();
        self.arm.client_came();
        let (expected, found) = (self.arm.dof(), self.arm.claimed_dof());
        if expected != found {
            return Err(AdapterError::Rejected(format!("expected {expected} joints, the arm says {found}")));
        }
        self.connected = true;
        Ok(())
    }

    /// Disconnects and stops the arm, as a controller does.
    pub fn disconnect(&mut self) {
        if self.connected {
            self.advance();
            self.arm.stop();
            self.connected = false;
        }
    }

    /// Begins a read that needs no exchange with the arm, as if its value had arrived with the last joint positions.
    pub fn answer(&mut self) -> AdapterResult<()> {
        if !self.connected {
            return Err(AdapterError::NotConnected);
        }
        self.advance();
        Ok(())
    }

    /// Begins a read of the joints.
    pub fn read(&mut self) -> AdapterResult<()> {
        self.exchange()?;
        match self.arm.take_fault(FaultKind::ReadError) {
            None => Ok(()),
            Some(_) => Err(AdapterError::Io("read failed (scripted fault)".into())),
        }
    }

    /// Begins a write.
    pub fn write(&mut self) -> AdapterResult<()> {
        self.exchange()?;
        match self.arm.take_fault(FaultKind::WriteError) {
            None => Ok(()),
            Some(_) => Err(AdapterError::Io("write failed (scripted fault)".into())),
        }
    }

    /// Begins a motion command, which requires motors on and no error.
    pub fn write_motion(&mut self) -> AdapterResult<()> {
        self.write()?;
        self.arm.ready().map_err(|refusal| self.arm.rejected(refusal))
    }

    /// Returns the joint positions [rad] as reported; faults make them NaN or zero.
    pub fn reported_positions(&mut self) -> Joints {
        self.arm.measured().positions
    }

    /// Advances joints and gripper to the present.
    fn advance(&mut self) {
        let before = self.arm.now();
        self.arm.integrate(self.clock.now());
        self.gripper.play(|kind| self.arm.take_fault(kind));
        self.gripper.advance(self.arm.now().seconds_since(before));
    }

    /// Exchanges data with the arm: waits for the latency and plays due faults.
    fn exchange(&mut self) -> AdapterResult<()> {
        self.answer()?;
        if !self.latency.is_zero() {
            std::thread::sleep(self.latency);
        }
        match self.arm.delivery() {
            Delivery::Stall(time) => std::thread::sleep(time),
            Delivery::Disconnect(_) => {
                self.disconnect();
                return Err(AdapterError::Io("connection closed (scripted fault)".into()));
            }
            Delivery::PowerLoss(time) => {
                self.power_off_until = self.clock.now().after(time);
                self.connected = false;
                return Err(AdapterError::Io("connection closed (scripted loss of power)".into()));
            }
            _ => {}
        }
        self.advance();
        #[allow(clippy::panic, reason = "a test's script of faults says so")]
        if self.arm.take_fault(FaultKind::Panic).is_some() {
            panic!("scripted fault: the adapter panics");
        }
        self.arm.apply_faults();
        self.io.play(&mut self.arm);
        Ok(())
    }
}
