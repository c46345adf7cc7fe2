//! The Piper adapter: the adapter protocol on one side, the arm's CAN frames on the other.
//!
//! Wire: 0.001°, 0.001 mm, 0.001 rad/s, mA. Here: rad, m, rad/s, Nm. Every conversion between the two is in this file.
//!
//! The arm sends its state by itself, 200 times a second; nothing is asked for after `connect`. It takes joint targets
//! without a word: what it does shows in its feedback, and so enabling, clearing and stopping are confirmed by that.
//!
//! Nothing here takes the power from the motors but `write_enable(false)`: the arm has no brakes. So a stop is a hold
//! where the arm is; the arm's own E-stop command can only be left by a reset that lets it fall, and is never sent.

use std::os::fd::BorrowedFd;
use std::time::Duration;

use super::picture::{Counts, Picture};
use super::protocol::{self, DOF, WireJoints};
use super::wire::{Wire, WireCounts};
use super::{Follow, HOLDS_WHEN_DISABLED, MODES, NATIVE_RATE, Options, limits};
use crate::arm::Pose;
use crate::clock::{Clock, Mono, MonotonicClock};
use crate::hardware::registry::AdapterConfig;
use crate::hardware::spec::{
    AdapterError, AdapterResult, JointReading, ManipulatorAdapter, ManipulatorInfo, RobotState, Stop,
};
use crate::hardware::transport::can::{CanAddress, CanFrame};
use crate::joint::{ControlMode, JointLimits, Joints, joints_of};

/// Longest waits for the first whole state, and then for what was asked.
const CONNECT_TIMEOUT: Duration = Duration::from_millis(1000);
const ANSWER_TIMEOUT: Duration = Duration::from_millis(300);
/// What has arrived within this time need not be looked for again: the arm's period.
const RECENT: Duration = Duration::from_millis(5);
/// A state older than this is no state: a living arm sends one every 5 ms; the rest is for a busy host.
const SILENCE: Duration = Duration::from_millis(150);
/// After this long without a state the connection is given up: the arm has lost its power.
const LOST: Duration = Duration::from_millis(400);
/// Enabling and disabling are asked for again and again, as the vendor does, and for so long.
const REPEAT: Duration = Duration::from_millis(10);
const ENABLE_TIMEOUT: Duration = Duration::from_millis(1000);
/// How long clearing may take; drivers report every 25 ms.
const CLEAR_TIMEOUT: Duration = Duration::from_millis(300);
/// How long a stop waits for the joints to get slower, and what counts as standing and as slower [0.001 rad/s].
const STOP_TIMEOUT: Duration = Duration::from_millis(20);
const STANDSTILL: i32 = 20;
const SLOWER: i32 = 20;
/// So far outside its limits a joint may be sent [rad]: the coordinator keeps to the limits, and an arm that lies
/// beyond one must find back.
const MARGIN: f64 = 0.1;
/// The E-stop among the arm's states.
const ESTOP: u8 = 1;
/// Motor torque per current [Nm/A]: joints 1 to 3, and 4 to 6.
const TORQUE: [f64; DOF] = [1.18125, 1.18125, 1.18125, 0.95844, 0.95844, 0.95844];
/// Up to this firmware the arm reports a quarter of the current of its first three joints.
const QUARTER_CURRENT: (u8, u8, u8) = (1, 8, 2);

const MICRO: f64 = 1e-6;
const MILLI: f64 = 1e-3;

/// A Piper on its bus.
pub struct PiperAdapter {
    hardware_id: String,
    address: CanAddress,
    options: Options,
    wire: Option<Wire>,
    picture: Picture,
    /// When what had arrived was last taken up.
    drained_at: Mono,
    mode: ControlMode,
}

impl PiperAdapter {
    /// An adapter for the arm on the bus at `config.address`. Does not connect.
    pub fn new(config: &AdapterConfig) -> AdapterResult<Self> {
        let rejected = |text: String| AdapterError::Rejected(format!("{}: {text}", config.hardware_id));
        if config.dof != DOF {
            return Err(rejected(format!("piper has {DOF} joints, not {}", config.dof)));
        }
        Ok(Self {
            hardware_id: config.hardware_id.clone(),
            address: CanAddress::parse(&config.address).map_err(|e| rejected(format!("address: {e}")))?,
            options: config.options()?,
            wire: None,
            picture: Picture::default(),
            drained_at: Mono::ZERO,
            mode: ControlMode::Position,
        })
    }

    /// What was counted since the connection was made: frames of the arm, and of the bus.
    pub fn counts(&self) -> (Counts, WireCounts) {
        (self.picture.counts, self.wire.as_ref().map(|wire| wire.counts).unwrap_or_default())
    }

    // --- The wire ---

    fn drain(&mut self) -> AdapterResult<()> {
        let wire = self.wire.as_mut().ok_or(AdapterError::NotConnected)?;
        self.drained_at = MonotonicClock.now();
        let result = wire.drain(&mut self.picture);
        if result.is_err() {
            self.wire = None;
        }
        result
    }

    fn send(&mut self, frames: &[CanFrame]) -> AdapterResult<()> {
        self.wire.as_mut().ok_or(AdapterError::NotConnected)?.send(frames)
    }

    /// Takes up feedback until `done` says so; `false` when the time is over.
    fn watch(&mut self, timeout: Duration, mut done: impl FnMut(&Picture) -> bool) -> AdapterResult<bool> {
        let end = MonotonicClock.now().after(timeout);
        loop {
            self.drain()?;
            let left = end.since(MonotonicClock.now());
            if done(&self.picture) || left.is_zero() {
                return Ok(done(&self.picture));
            }
            if let Some(wire) = &self.wire {
                wire.wait(left);
            }
        }
    }

    /// Takes up what has arrived; an error when the newest positions are too old to act on.
    fn refresh(&mut self) -> AdapterResult<()> {
        self.drain()?;
        let age = MonotonicClock.now().since(self.picture.joints_at);
        if age <= SILENCE {
            return Ok(());
        }
        // The same words each time, so that they are told once.
        if age > LOST {
            self.wire = None;
            let text =
                format!("the connection to piper at {} broke: no state for {} ms", self.address, LOST.as_millis());
            return Err(AdapterError::Io(text));
        }
        Err(AdapterError::Timeout(format!("piper at {}: no state for {} ms", self.address, SILENCE.as_millis())))
    }

    /// The picture, for reads that mostly follow one of the joints and then answer from memory.
    fn known(&mut self) -> AdapterResult<&Picture> {
        if self.wire.is_none() {
            return Err(AdapterError::NotConnected);
        }
        if MonotonicClock.now().since(self.drained_at) > RECENT {
            self.drain()?;
        }
        Ok(&self.picture)
    }

    /// Waits for a whole state, then for what was asked.
    fn introduce(&mut self) -> AdapterResult<()> {
        let mut questions = [protocol::ask_firmware(); DOF + 1];
        questions.iter_mut().zip(1..).take(DOF).for_each(|(frame, joint)| *frame = protocol::ask_limits(joint));
        self.send(&questions)?;
        if !self.watch(CONNECT_TIMEOUT, Picture::complete)? {
            return Err(self.why_not());
        }
        let answered = |p: &Picture| p.firmware().is_some() && p.limits.iter().all(Option::is_some);
        if !self.watch(ANSWER_TIMEOUT / 2, answered)? {
            self.send(&questions)?;
            self.watch(ANSWER_TIMEOUT / 2, answered)?; // what stays unanswered is known from the data sheet
        }
        Ok(())
    }

    /// Why there is no whole state.
    fn why_not(&self) -> AdapterError {
        let (address, counts) = (&self.address, self.picture.counts);
        if self.picture.joints_at != Mono::ZERO {
            return AdapterError::Timeout(format!("piper at {address}: some of its motors send no state"));
        }
        if counts.leader > 0 {
            return AdapterError::Rejected(format!(
                "piper at {address}: this arm leads others: it sends commands instead of its state\nhint: make it a \
                 follower with the vendor's SDK, MasterSlaveConfig(0xFC, 0, 0, 0), and switch it off and on"
            ));
        }
        let heard = match counts.other + counts.damaged + counts.decoded {
            0 => "nothing was heard".to_owned(),
            n => format!("only {n} other frames were heard"),
        };
        AdapterError::Timeout(format!(
            "no state from piper at {address} within {} ms: {heard}\nhint: is the arm powered, plugged in, and the bus \
             at 1 Mbit/s? An arm that was set to lead others sends none: MasterSlaveConfig(0xFC, 0, 0, 0) of the \
             vendor's SDK makes it a follower",
            CONNECT_TIMEOUT.as_millis()
        ))
    }

    // --- What may be done ---

    fn refuse(&self, why: String) -> AdapterError {
        AdapterError::Rejected(format!("{}: {why}", self.hardware_id))
    }

    /// An error unless the arm is in order and listens to CAN.
    fn in_order(&self) -> AdapterResult<()> {
        let code = self.picture.error_code();
        if code != 0 {
            let mut text = self.picture.error_text();
            if self.picture.status.arm == ESTOP {
                text.push_str(
                    "\nhint: the arm leaves its E-stop only by a reset that takes the power from its motors: hold it, \
                     then switch it off and on",
                );
            }
            return Err(AdapterError::Fault { code, text });
        }
        match self.picture.status.control {
            0 | 1 => Ok(()),
            other => Err(self.refuse(format!(
                "the arm is controlled by {}\nhint: end that at the arm; where it does not let go, hold it and switch \
                 it off and on",
                protocol::control_text(other)
            ))),
        }
    }

    /// An error unless the arm may be told to move.
    fn may_move(&mut self) -> AdapterResult<()> {
        self.refresh()?;
        self.in_order()?;
        if self.picture.enabled() { Ok(()) } else { Err(self.refuse("the motors are disabled".into())) }
    }

    /// An error when the measured pose cannot be true: holding there would be a jump.
    fn plausible(&self) -> AdapterResult<()> {
        if self.picture.joints == [0; DOF] {
            return Err(self.refuse(
                "every joint reads exactly 0, as from a controller that has not measured yet: not enabled\nhint: if \
                 the arm truly lies there, move a joint a little by hand"
                    .into(),
            ));
        }
        let limits = limits(DOF);
        let range = limits.position_lower.iter().zip(&limits.position_upper);
        for (i, (wire, (lower, upper))) in self.picture.joints.iter().zip(range).enumerate() {
            let value = radians(*wire);
            if !(lower - 2.0 * MARGIN..=upper + 2.0 * MARGIN).contains(&value) {
                let joint = i + 1;
                return Err(self.refuse(format!(
                    "joint {joint} reads {value:.3} rad, outside its range of {lower} to {upper}: not enabled\nhint: \
                     move it back by hand, or set its zero point anew with the vendor's tool"
                )));
            }
        }
        Ok(())
    }

    /// Speed of a planned move [%] from a fraction of the top speed.
    fn percent(&self, velocity: f64) -> u8 {
        (velocity * self.options.speed_scale * 100.0).round().clamp(1.0, 100.0) as u8
    }

    fn follow(&self) -> protocol::Follow {
        match (self.mode, self.options.follow) {
            (ControlMode::ServoPosition, Follow::Direct) => protocol::Follow::Direct,
            _ => protocol::Follow::Smooth,
        }
    }

    /// Makes the place where the arm is its target.
    fn hold(&mut self) -> AdapterResult<()> {
        self.send(&protocol::joint_targets(100, self.follow(), self.picture.joints))
    }

    /// Asks for the motors to be on or off until they say that they are.
    fn switch_motors(&mut self, on: bool) -> AdapterResult<()> {
        let switched = |p: &Picture| p.drivers_heard() && if on { p.enabled() } else { p.disabled() };
        let end = MonotonicClock.now().after(ENABLE_TIMEOUT);
        self.picture.expect_drivers();
        while MonotonicClock.now() < end {
            self.send(&[protocol::enable(on)])?;
            if self.watch(REPEAT, switched)? {
                return Ok(());
            }
        }
        let wrong = |(_, driver): &(usize, &protocol::Driver)| driver.enabled() != on;
        let joints: Vec<String> =
            (1..).zip(&self.picture.drivers).filter(wrong).map(|(joint, _)| joint.to_string()).collect();
        Err(AdapterError::Timeout(format!(
            "{}: the motors of joints {} do not go {} within {} ms",
            self.hardware_id,
            joints.join(", "),
            if on { "on" } else { "off" },
            ENABLE_TIMEOUT.as_millis()
        )))
    }

    fn velocities(&self) -> Joints {
        joints_of(&self.picture.motors.map(|motor| f64::from(motor.speed) * MILLI))
    }

    /// Torques [Nm]; `None` when the firmware, which says how to read the currents, is not known.
    fn efforts(&self) -> Option<Joints> {
        let quarter = self.picture.firmware()? <= QUARTER_CURRENT;
        let mut efforts = [0.0; DOF];
        let motors = self.picture.motors.iter().zip(TORQUE).enumerate();
        for (effort, (joint, (motor, torque))) in efforts.iter_mut().zip(motors) {
            let scale = if quarter && joint < 3 { 4.0 } else { 1.0 };
            *effort = f64::from(motor.current) * MILLI * torque * scale;
        }
        Some(joints_of(&efforts))
    }
}

// --- Units ---

/// [rad] from [0.001°].
fn radians(wire: i32) -> f64 {
    (f64::from(wire) * MILLI).to_radians()
}

/// [0.001°] from [rad].
fn millidegrees(value: f64) -> i32 {
    (value.to_degrees() / MILLI).round() as i32
}

/// Copies the first values; `out` has length dof.
fn fill(out: &mut [f64], values: &[f64]) {
    out.iter_mut().zip(values).for_each(|(to, value)| *to = *value);
}

impl ManipulatorAdapter for PiperAdapter {
    // --- Lifecycle ---

    fn connect(&mut self) -> AdapterResult<()> {
        self.disconnect();
        self.picture = Picture::default();
        self.wire = Some(Wire::open(&self.address)?);
        let introduced = self.introduce();
        if introduced.is_err() {
            self.disconnect();
        }
        introduced
    }

    fn disconnect(&mut self) {
        self.wire = None;
    }

    fn is_connected(&self) -> bool {
        self.wire.is_some()
    }

    // --- What it is ---

    fn get_info(&self) -> ManipulatorInfo {
        ManipulatorInfo {
            vendor: "AgileX".into(),
            model: "Piper".into(),
            dof: DOF,
            firmware_version: self.picture.firmware().map(|(a, b, c)| format!("S-V{a}.{b}-{c}")),
            serial_number: None,
            native_rate: NATIVE_RATE,
            modes: MODES,
            holds_when_disabled: HOLDS_WHEN_DISABLED,
            whole_state_at_once: true,
        }
    }

    fn get_dof(&self) -> usize {
        DOF
    }

    /// The data sheet's limits, narrowed by those that the controller has been given.
    fn get_limits(&mut self) -> AdapterResult<JointLimits> {
        let mut limits = limits(DOF);
        let positions = limits.position_lower.iter_mut().zip(&mut limits.position_upper);
        let all = positions.zip(&mut limits.velocity_max).zip(&self.picture.limits);
        for (((lower, upper), speed), own) in all {
            let Some(own) = own else { continue };
            let decidegrees = |value: i16| (f64::from(value) / 10.0).to_radians();
            let (low, high) = (lower.max(decidegrees(own.lower)), upper.min(decidegrees(own.upper)));
            if low < high {
                (*lower, *upper) = (low, high);
            }
            if own.speed > 0 {
                *speed = speed.min(f64::from(own.speed) * MILLI);
            }
        }
        Ok(limits)
    }

    // --- Mode ---

    /// Both modes are MOVE J and differ in what stands before each target, so that nothing is sent here.
    fn set_control_mode(&mut self, mode: ControlMode) -> AdapterResult<()> {
        if !MODES.contains(&mode) {
            return Err(AdapterError::Unsupported);
        }
        self.known()?;
        self.mode = mode;
        Ok(())
    }

    fn get_control_mode(&self) -> ControlMode {
        self.mode
    }

    // --- State ---

    fn state_fd(&self) -> Option<BorrowedFd<'_>> {
        self.wire.as_ref().map(Wire::fd)
    }

    fn read_joint_positions(&mut self, positions: &mut [f64]) -> AdapterResult<()> {
        self.refresh()?;
        fill(positions, &self.picture.joints.map(radians));
        Ok(())
    }

    fn read_joint_velocities(&mut self, velocities: &mut [f64]) -> AdapterResult<bool> {
        self.known()?;
        fill(velocities, &self.velocities());
        Ok(true)
    }

    fn read_joint_efforts(&mut self, efforts: &mut [f64]) -> AdapterResult<bool> {
        self.known()?;
        let known = self.efforts();
        known.iter().for_each(|known| fill(efforts, known));
        Ok(known.is_some())
    }

    fn read_joints(&mut self, reading: &mut JointReading) -> AdapterResult<()> {
        self.refresh()?;
        *reading = JointReading {
            stamp: Some(self.picture.joints_at),
            position: joints_of(&self.picture.joints.map(radians)),
            velocity: Some(self.velocities()),
            effort: self.efforts(),
        };
        Ok(())
    }

    /// State: the arm's own (0 = in order, 1 = E-stop …); mode: who controls it (0 nobody, 1 CAN, 2 teaching …).
    fn read_state(&mut self) -> AdapterResult<RobotState> {
        let status = self.known()?.status;
        Ok(RobotState { state: status.arm.into(), mode: status.control.into() })
    }

    fn read_error(&mut self) -> AdapterResult<(i32, String)> {
        let picture = self.known()?;
        Ok((picture.error_code(), picture.error_text())) // an empty text allocates nothing
    }

    fn read_enabled(&mut self) -> AdapterResult<bool> {
        Ok(self.known()?.enabled())
    }

    // --- Motion ---

    fn write_joint_positions(&mut self, positions: &[f64], velocity: f64) -> AdapterResult<()> {
        let Ok(positions) = <[f64; DOF]>::try_from(positions) else {
            return Err(self.refuse(format!("{DOF} values are needed, one per joint")));
        };
        for (i, (value, (lower, upper))) in positions.iter().zip(super::RANGES).enumerate() {
            // Not finite is not inside either.
            if !(lower - MARGIN..=upper + MARGIN).contains(value) {
                let joint = i + 1;
                return Err(self.refuse(format!("joint {joint}: {value} rad is not within {lower} to {upper}")));
            }
        }
        self.may_move()?;
        let speed = if self.mode == ControlMode::Position { self.percent(velocity) } else { 100 };
        let joints: WireJoints = positions.map(millidegrees);
        self.send(&protocol::joint_targets(speed, self.follow(), joints))
    }

    /// Holds the arm where it is. Confirmed when its feedback shows that every joint gets slower or stands.
    fn write_stop(&mut self) -> AdapterResult<Stop> {
        self.refresh()?; // an arm that was somewhere else before it fell silent is not sent back there
        let before = self.picture.motors.map(|motor| i32::from(motor.speed).abs());
        if self.picture.enabled() && self.picture.status.arm != ESTOP {
            self.hold()?;
        }
        let sent = self.picture.joints_at;
        let slower = |picture: &Picture| {
            let speeds = picture.motors.iter().map(|motor| i32::from(motor.speed).abs());
            picture.joints_at > sent && speeds.zip(before).all(|(now, then)| now <= STANDSTILL || now + SLOWER <= then)
        };
        Ok(if self.watch(STOP_TIMEOUT, slower)? { Stop::Confirmed } else { Stop::Sent })
    }

    /// Enabling holds the arm where it is: the target is set before the motors come on, and anew when they are on.
    fn write_enable(&mut self, enable: bool) -> AdapterResult<()> {
        if !enable {
            self.drain()?;
            return self.switch_motors(false);
        }
        self.refresh()?;
        self.in_order()?;
        self.plausible()?;
        self.hold()?;
        self.switch_motors(true)?;
        self.refresh()?;
        self.hold()
    }

    fn write_clear_errors(&mut self) -> AdapterResult<()> {
        self.refresh()?;
        if self.picture.status.arm == ESTOP {
            return self.in_order();
        }
        self.send(&[protocol::clear_errors()])?;
        self.picture.expect_drivers();
        let asked = MonotonicClock.now();
        let cleared = |p: &Picture| p.drivers_heard() && p.status_at > asked && p.error_code() == 0;
        if self.watch(CLEAR_TIMEOUT, cleared)? {
            return Ok(());
        }
        let (code, text) = (self.picture.error_code(), self.picture.error_text());
        Err(AdapterError::Fault { code, text })
    }

    // --- Optional parts ---

    fn read_cartesian_position(&mut self) -> AdapterResult<Option<Pose>> {
        Ok(self.known()?.pose.map(|[x, y, z, roll, pitch, yaw]| Pose {
            xyz: [x, y, z].map(|v| f64::from(v) * MICRO),
            rpy: [roll, pitch, yaw].map(radians),
        }))
    }

    fn write_cartesian_position(&mut self, pose: &Pose, velocity: f64) -> AdapterResult<()> {
        // Ten metres and ten turns are far beyond the arm, and far inside the wire's numbers.
        let sensible = pose.xyz.iter().all(|v| v.abs() < 10.0) && pose.rpy.iter().all(|v| v.abs() < 62.0);
        if !sensible {
            return Err(self.refuse("the pose is not finite, or absurd".into()));
        }
        self.may_move()?;
        let ([x, y, z], [roll, pitch, yaw]) =
            (pose.xyz.map(|v| (v / MICRO).round() as i32), pose.rpy.map(millidegrees));
        self.send(&protocol::pose_target(self.percent(velocity), [x, y, z, roll, pitch, yaw]))
    }

    fn read_gripper_position(&mut self) -> AdapterResult<Option<f64>> {
        let used = self.options.gripper.stroke().is_some();
        let gripper = self.known()?.gripper.filter(|_| used);
        Ok(gripper.map(|gripper| f64::from(gripper.stroke) * MICRO))
    }

    fn get_gripper_range(&self) -> Option<(f64, f64)> {
        self.options.gripper.stroke().map(|stroke| (0.0, stroke))
    }

    fn write_gripper_position(&mut self, position: f64) -> AdapterResult<()> {
        let stroke = self.options.gripper.stroke().ok_or(AdapterError::Unsupported)?;
        if !(0.0..=stroke).contains(&position) {
            return Err(self.refuse(format!("gripper opening {position} m is not within 0 to {stroke} m")));
        }
        self.may_move()?;
        let torque = (self.options.gripper_torque / MILLI).round() as u16;
        self.send(&[protocol::gripper_target((position / MICRO).round() as i32, torque)])
    }
}
