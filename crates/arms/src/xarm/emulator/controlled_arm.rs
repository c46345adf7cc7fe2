//! What the controller moves: the simulated arm of the emulator, or an arm of a run (`dimos proxy`).

use std::time::Duration;

use nalgebra::Isometry3;

use super::super::model::VELOCITY;
use super::line::Line;
use super::move_request::MoveRequest;
use dimos_core::arm::Load;
use dimos_core::clock::Mono;
use dimos_core::joint::Joints;
use dimos_hardware::registry::Truth;
use dimos_hardware::sim::arm::{self, Delivery, HasArm, SimArm};
use dimos_hardware::sim::faults::{Fault, FaultKind};

/// Error: a joint is beyond its limit.
pub const JOINT_LIMIT: u8 = 23;

/// Why a request is not done.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Refusal {
    /// It raises a warning.
    Warning(u8),
    /// It raises an error.
    Error(u8),
    /// The arm is not ready, in another mode, or lacks the feature.
    NotNow,
    /// The outcome is not known yet: the same request is made again until it is.
    Pending,
}

/// An arm behind the controller. Positions [rad] and velocities [rad/s], one per joint; the wire has seven.
pub trait ControlledArm: Send + 'static {
    /// Returns the time up to which it was advanced.
    fn now(&self) -> Mono;
    /// Advances to `now`, or takes the latest measurements.
    fn integrate(&mut self, now: Mono);
    /// Plays what is due. Returns whether the arm has stopped since the last call without a request.
    fn has_stopped(&mut self) -> bool;
    /// Returns the time since power-up.
    fn uptime(&self) -> Duration;
    /// Returns the measured positions [rad] and velocities [rad/s].
    fn joints(&self) -> (Joints, Joints);
    /// Returns the joint torques [Nm].
    fn efforts(&self) -> Joints;
    /// Returns whether the motor of a joint (index from 0) is on.
    fn motor(&self, joint: usize) -> bool;
    /// Returns whether all motors are on.
    fn enabled(&self) -> bool;
    /// Returns whether it moves, or executes a move.
    fn moving(&self) -> bool;
    /// Returns the error code; 0 = none.
    fn error(&self) -> u16;
    /// Returns whether it accepts motion.
    fn is_ready(&self) -> bool;
    /// Returns whether positions [rad] are within its limits.
    fn is_within(&self, positions: &[f64]) -> bool;

    /// Switches the motor of one joint, or of all.
    fn switch(&mut self, joint: Option<usize>, on: bool) -> Result<(), Refusal>;
    /// Clears the error.
    fn clear(&mut self) -> Result<(), Refusal>;
    /// Sets an error and stops.
    fn fail(&mut self, code: u16);
    /// Prepares for commands: the client has made the controller ready.
    fn begin(&mut self) -> Result<(), Refusal> {
        Ok(())
    }
    /// Decelerates to rest.
    fn stop(&mut self);
    /// Gives way to a hand until it is stopped.
    fn guide(&mut self) -> Result<(), Refusal> {
        Err(Refusal::NotNow)
    }
    /// Stops as the client's stop does.
    fn operational_stop(&mut self) {
        self.stop();
    }
    /// The controller is no longer ready, until the next [`ControlledArm::begin`].
    fn end(&mut self) {}
    /// Moves along joint positions [rad] to the last of them, with at most this speed [rad/s] and acceleration
    /// [rad/s²].
    fn go(&mut self, way: &[[f64; 7]], speed: f64, acceleration: f64) -> Result<(), Refusal>;
    /// Follows a setpoint [rad].
    fn follow(&mut self, target: &[f64; 7]) -> Result<(), Refusal>;
    /// Keeps velocities [rad/s] for a time, or until the next command.
    fn keep_velocity(&mut self, velocities: &[f64; 7], duration: Option<Duration>) -> Result<(), Refusal>;
    /// Returns the straight line of the tool that a request asks for, from joints [rad] on, if the arm itself can
    /// follow one.
    fn line(&self, _from: &[f64; 7], _request: &MoveRequest) -> Option<Line> {
        None
    }
    /// Returns whether commands of a mode can be executed.
    fn has_mode(&self, mode: u8) -> bool {
        matches!(mode, 0 | 1 | 2 | 4)
    }
    /// Takes note of a request that was not executed in this mode and state.
    fn note_refused(&mut self, _register: u8, _data: &[u8], _mode: u8, _state: u8) {}

    /// Returns the tool's measured pose, if the arm itself knows it.
    fn pose(&self) -> Option<Isometry3<f64>> {
        None
    }
    /// Returns the measured force and torque [N, Nm], if the arm itself has a sensor.
    fn wrench(&self) -> Option<[f32; 6]> {
        None
    }
    /// Returns the gripper's opening [m] and whether it moves, if the arm itself has one.
    fn gripper(&self) -> Option<(f64, bool)> {
        None
    }
    /// Moves the gripper of the arm itself [m], with a fraction of its top speed if the client has set one.
    fn move_gripper(&mut self, _opening: f64, _speed: Option<f64>) {}
    /// Sets the load: mass [kg], centre [mm].
    fn set_load(&mut self, _load: [f32; 4]) -> Result<(), Refusal> {
        Ok(())
    }
    /// Returns whether the controller is that of the arm: its settings (tool offset, sensitivities, sensor) apply, and
    /// it has the habits of a real one.
    fn takes_settings(&self) -> bool {
        true
    }

    /// A client has connected.
    fn client_came(&mut self) {}
    /// A client has disconnected.
    fn client_gone(&mut self) {}

    /// Takes a fault that is due.
    fn due_fault(&mut self, _kind: FaultKind) -> Option<Fault> {
        None
    }
    /// Changes true positions [rad] and velocities [rad/s] to what is reported instead of them now.
    fn misread(&mut self, _positions: &mut [f64; 7], _velocities: &mut [f64; 7]) {}
    /// Returns whether a fault lasts.
    fn lasts(&self, _kind: FaultKind) -> bool {
        false
    }
    /// Returns what becomes of the next response or report.
    fn next_delivery(&mut self) -> Delivery {
        Delivery::Send
    }
}

impl ControlledArm for SimArm {
    fn now(&self) -> Mono {
        self.now()
    }

    fn integrate(&mut self, now: Mono) {
        self.integrate(now);
    }

    fn has_stopped(&mut self) -> bool {
        let before = (self.error(), self.estop_open());
        self.apply_faults();
        self.error() != 0 && before != (self.error(), self.estop_open())
    }

    fn uptime(&self) -> Duration {
        self.uptime()
    }

    fn joints(&self) -> (Joints, Joints) {
        self.joints()
    }

    fn efforts(&self) -> Joints {
        self.efforts()
    }

    fn motor(&self, joint: usize) -> bool {
        self.motor(joint)
    }

    fn enabled(&self) -> bool {
        self.enabled()
    }

    fn moving(&self) -> bool {
        self.moving()
    }

    fn error(&self) -> u16 {
        self.error()
    }

    fn is_ready(&self) -> bool {
        self.ready().is_ok()
    }

    fn is_within(&self, positions: &[f64]) -> bool {
        self.within(positions).is_ok()
    }

    fn switch(&mut self, joint: Option<usize>, on: bool) -> Result<(), Refusal> {
        match joint {
            Some(joint) => self.enable_joint(joint, on),
            None => (0..self.dof()).for_each(|joint| self.enable_joint(joint, on)),
        }
        Ok(())
    }

    fn clear(&mut self) -> Result<(), Refusal> {
        self.clear_error().map_err(not_now)
    }

    fn fail(&mut self, code: u16) {
        self.fail(code);
    }

    fn stop(&mut self) {
        self.stop();
    }

    fn guide(&mut self) -> Result<(), Refusal> {
        self.guide().map_err(not_now)
    }

    fn go(&mut self, way: &[[f64; 7]], speed: f64, _acceleration: f64) -> Result<(), Refusal> {
        let target = way.last().ok_or(Refusal::NotNow)?;
        self.move_to(target, (speed / VELOCITY).clamp(0.0, 1.0)).map_err(not_now)
    }

    fn follow(&mut self, target: &[f64; 7]) -> Result<(), Refusal> {
        self.servo(target).map_err(not_now)
    }

    fn keep_velocity(&mut self, velocities: &[f64; 7], duration: Option<Duration>) -> Result<(), Refusal> {
        self.velocity_for(velocities, duration).map_err(not_now)
    }

    fn client_came(&mut self) {
        self.client_came();
    }

    fn due_fault(&mut self, kind: FaultKind) -> Option<Fault> {
        self.take_fault(kind)
    }

    fn misread(&mut self, positions: &mut [f64; 7], velocities: &mut [f64; 7]) {
        self.misread(positions, velocities);
    }

    fn lasts(&self, kind: FaultKind) -> bool {
        self.fault_lasts(kind)
    }

    fn next_delivery(&mut self) -> Delivery {
        self.delivery()
    }
}

fn not_now(_: arm::Refusal) -> Refusal {
    Refusal::NotNow
}

impl HasArm for super::controller::Controller<SimArm> {
    fn arm(&mut self) -> &mut SimArm {
        &mut self.arm
    }

    fn complete(&self, truth: &mut Truth) {
        truth.gripper_position = Some(self.tool.opening());
        truth.gripper_force = self.tool.force();
        let [mass, x, y, z] = self.settings.load.map(f64::from);
        truth.load = Some(Load { mass, center: [x, y, z].map(|mm| mm / 1000.0), inertia: [0.0; 6] });
    }

    fn advance(&mut self, now: Mono) {
        self.advance(now);
    }
}
