//! The Acme adapter: the adapter protocol on one side, the servos' line on the other.
//!
//! Wire: counts, counts/s. Here: rad, rad/s, m. One request reads the state of all servos;
//! [`ManipulatorAdapter::read_joints`] makes it, and what is read right after is answered from it, so that a cycle
//! costs one round trip. Requests to all servos have no reply: where it matters, their effect is read back.

use std::f64::consts::TAU;
use std::time::Duration;

use dimos_hardware::adapter::{
    AdapterError, AdapterResult, Gripper, JointReading, ManipulatorAdapter, ManipulatorInfo, RobotState, Stop,
};
use dimos_hardware::adapter_util::{fault, fill, finite};
use dimos_hardware::arm::StopPoint;
use dimos_hardware::clock::{Clock, Mono, MonotonicClock};
use dimos_hardware::joint::{ControlMode, JointLimits, Joints, joints_of};
use dimos_hardware::registry::AdapterConfig;
use dimos_hardware::transport::request_reply::{RequestReply, Retry};

use super::calibration::{Calibration, TURN};
use super::protocol::{self, MAX_REQUEST, MODEL, Request, Servo};
use super::wire::{self, Address, Link};
use super::{DOF, HOLDS_WHEN_DISABLED, MODES, NATIVE_RATE, OPEN, Options, SERVOS, TOP_SPEED, check, limits};

/// HELLO is retried, as the servos may just be starting. With all of them: below 3 s.
const HELLO: Retry = Retry { each: Duration::from_millis(30), times: 5 };
/// Longest wait for the state of all servos. YOUR ARM: all tries together stay below `stale_after`, so that a lost, a
/// damaged or a late reply does not hold the arm.
const CYCLE: Retry = Retry { each: Duration::from_millis(30), times: 3 };
/// A state answers further questions for this time.
const STATE_AGE: Duration = Duration::from_millis(5);
/// A setpoint is written if the motors were on and without error this long ago at most.
const WRITABLE: Duration = Duration::from_millis(50);
/// How often a request without a reply is sent until the servos show its effect.
const WRITES: u32 = 4;
/// Before the motors come on, positions agree for this long, and may take this long to do so.
const AGREED: Duration = Duration::from_millis(50);
const AGREED_TIMEOUT: Duration = Duration::from_millis(300);
/// A joint at rest moves by less than this [counts], and is slower than this [counts/s]. YOUR ARM.
const STILL: i32 = 12;
const SLOW: i32 = 60;
/// A joint this far outside its range is inside [counts]: encoders flicker. YOUR ARM.
const SAME: i32 = 3;

/// The state of all servos.
type Servos = [Servo; SERVOS];

/// An arm of servos on a line.
pub struct AcmeAdapter {
    address: Address,
    calibration: Calibration,
    line: RequestReply<Link>,
    firmware: Option<(u8, u8)>,
    mode: ControlMode,
    /// The last state, and when it was asked for.
    state: Option<(Servos, Mono)>,
}

impl AcmeAdapter {
    /// An adapter for the servos at `config.address`. Does not connect.
    pub fn new(config: &AdapterConfig) -> AdapterResult<Self> {
        config.check(check)?;
        let options: Options = config.options()?;
        Ok(Self {
            address: config.parse_address(wire::address)?,
            calibration: Calibration::of(&options.calibration).map_err(AdapterError::Rejected)?,
            line: RequestReply::half_duplex(options.echo),
            firmware: None,
            mode: ControlMode::default(),
            state: None,
        })
    }

    /// Asks a servo for its model and firmware.
    fn hello(&mut self, servo: u8) -> AdapterResult<()> {
        let mut frame = [0; MAX_REQUEST];
        let frame = protocol::encode(Request::Hello(servo), &mut frame);
        let reply = self.line.request(frame, HELLO, |bytes| {
            protocol::scan(bytes, protocol::HELLO).map(|reply| reply.data.first_chunk().copied().unwrap_or([0; 4]))
        });
        let silent = |_| AdapterError::Timeout(format!("servo {servo} at {} does not answer", self.address));
        let [m0, m1, major, minor] = match reply {
            Err(AdapterError::Timeout(text)) => return Err(silent(text)),
            other => other?,
        };
        self.firmware = Some((major, minor));
        match u16::from_be_bytes([m0, m1]) {
            MODEL => Ok(()),
            model => {
                let what = format!("acme at {}: servo {servo} is model {model}, expected {MODEL}", self.address);
                Err(AdapterError::Rejected(what))
            }
        }
    }

    /// Asks for the state of all servos.
    fn fetch(&mut self) -> AdapterResult<Servos> {
        self.state = None;
        let asked = MonotonicClock.now();
        let mut frame = [0; MAX_REQUEST];
        let frame = protocol::encode(Request::State, &mut frame);
        let mut found: [Option<Servo>; SERVOS] = [None; SERVOS];
        let scan = |bytes: &[u8]| {
            protocol::scan(bytes, protocol::STATE).map(|reply| (reply.servo, Servo::decode(&reply).unwrap_or_default()))
        };
        self.line.gather(frame, CYCLE, SERVOS, scan, |(servo, state)| {
            // One that answers twice, because it was asked again, counts once.
            let slot = usize::from(servo).checked_sub(1).and_then(|servo| found.get_mut(servo));
            slot.is_some_and(|slot| slot.replace(state).is_none())
        })?;
        let servos = found.map(Option::unwrap_or_default);
        self.state = Some((servos, asked));
        Ok(servos)
    }

    /// The last state, or a new one when that is older.
    fn not_older(&mut self, age: Duration) -> AdapterResult<Servos> {
        match self.state {
            Some((servos, at)) if self.line.is_open() && MonotonicClock.now().since(at) <= age => Ok(servos),
            _ => self.fetch(),
        }
    }

    /// Sends a request that no servo answers. That it arrived is not known.
    fn tell(&mut self, request: Request<'_>) -> AdapterResult<()> {
        let mut frame = [0; MAX_REQUEST];
        self.line.tell(protocol::encode(request, &mut frame))
    }

    /// Sends a request that no servo answers until all of them show its effect.
    fn confirmed(&mut self, request: Request<'_>, shown: impl Fn(usize, &Servo) -> bool) -> AdapterResult<()> {
        for _ in 0..WRITES {
            self.tell(request)?;
            if self.fetch()?.iter().enumerate().all(|(i, servo)| shown(i, servo)) {
                return Ok(());
            }
        }
        Err(AdapterError::Protocol(format!("acme: the servos do not execute {request:?}")))
    }

    /// Reads until all positions agree for a while: a wrong one would be where a joint goes when its motor comes on.
    fn agreed(&mut self) -> AdapterResult<Servos> {
        let (first, end) = (self.fetch()?, MonotonicClock.now().after(AGREED_TIMEOUT));
        let (mut from, mut since) = (first, MonotonicClock.now());
        loop {
            std::thread::sleep(STATE_AGE);
            let (servos, now) = (self.fetch()?, MonotonicClock.now());
            let moved = servos.iter().zip(&from).any(|(a, b)| (a.position - b.position).abs() > STILL);
            match moved || servos.iter().any(|servo| servo.velocity.abs() > SLOW) {
                true => (from, since) = (servos, now),
                false if now.since(since) >= AGREED => return Ok(servos),
                false => {}
            }
            if now > end {
                let what = "the joints move, or their positions contradict each other: not enabled";
                return Err(AdapterError::Rejected(format!("{what}\nhint: keep the arm still, look at the cables")));
            }
        }
    }

    /// Where each servo is, inside its range. A joint outside its range is an error: its servo would move there at once.
    fn hold_goals(&self, servos: &Servos) -> AdapterResult<[i32; SERVOS]> {
        let positions = servos.map(|servo| servo.position);
        let goals = self.calibration.inside(positions);
        for (j, (goal, position)) in goals.iter().zip(positions).take(DOF).enumerate() {
            let outside = (goal - position).abs();
            if outside > SAME {
                return Err(AdapterError::Rejected(format!(
                    "joint {} is {:.1}° outside its range\nhint: move it inside by hand, or correct the calibration",
                    j + 1,
                    f64::from(outside) * 360.0 / TURN
                )));
            }
        }
        Ok(goals)
    }

    fn write_goals(&mut self, goals: [i32; SERVOS]) -> AdapterResult<()> {
        self.confirmed(Request::Goals(&goals, 0), |i, servo| goals.get(i) == Some(&servo.goal))
    }

    /// One value per joint.
    fn of_joints(&self, servos: &Servos, value: impl Fn(&Servo, &super::Range) -> f64) -> Joints {
        let mut values = [0.0; DOF];
        let each = values.iter_mut().zip(servos).zip(self.calibration.joints());
        each.for_each(|((to, servo), range)| *to = value(servo, range));
        joints_of(&values)
    }
}

/// Velocity of a joint [rad/s].
fn velocity(servo: &Servo, range: &super::Range) -> f64 {
    range.sign() * f64::from(servo.velocity) * TAU / TURN
}

/// Code and text of the first servo in error.
fn error_of(servos: &Servos) -> Option<u8> {
    servos.iter().map(|servo| servo.error).find(|error| *error != 0)
}

impl ManipulatorAdapter for AcmeAdapter {
    // --- Lifecycle ---

    fn connect(&mut self) -> AdapterResult<()> {
        self.disconnect();
        self.line.open(wire::connect(&self.address)?);
        let introduced = (1..=SERVOS as u8).try_for_each(|servo| self.hello(servo)).and_then(|()| self.fetch());
        if introduced.is_err() {
            self.disconnect();
        }
        introduced.map(drop)
    }

    fn disconnect(&mut self) {
        self.line.close();
        self.state = None;
    }

    fn is_connected(&self) -> bool {
        self.line.is_open()
    }

    // --- Identity ---

    fn get_info(&self) -> ManipulatorInfo {
        ManipulatorInfo {
            vendor: "Acme".into(), // YOUR ARM
            model: "Acme".into(),  // YOUR ARM
            dof: DOF,
            firmware_version: self.firmware.map(|(major, minor)| format!("{major}.{minor}")),
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

    fn get_limits(&mut self) -> AdapterResult<JointLimits> {
        Ok(limits(&self.calibration))
    }

    // --- Mode: goals with a top speed, or without ---

    fn set_control_mode(&mut self, mode: ControlMode) -> AdapterResult<()> {
        match mode {
            _ if !self.is_connected() => Err(AdapterError::NotConnected),
            mode if MODES.contains(&mode) => {
                self.mode = mode;
                Ok(())
            }
            _ => Err(AdapterError::Unsupported),
        }
    }

    fn get_control_mode(&self) -> ControlMode {
        self.mode
    }

    // --- State ---

    fn read_joint_positions(&mut self, positions: &mut [f64]) -> AdapterResult<()> {
        let servos = self.fetch()?;
        fill(positions, &self.of_joints(&servos, |servo, range| range.angle(servo.position)));
        Ok(())
    }

    fn read_joint_velocities(&mut self, velocities: &mut [f64]) -> AdapterResult<bool> {
        let servos = self.not_older(STATE_AGE)?;
        fill(velocities, &self.of_joints(&servos, velocity));
        Ok(true) // YOUR ARM: leave the method out if they do not measure them; never fill in zeros
    }

    fn read_joints(&mut self, reading: &mut JointReading) -> AdapterResult<()> {
        let servos = self.fetch()?;
        *reading = JointReading {
            stamp: None,
            device_ns: None,
            position: self.of_joints(&servos, |servo, range| range.angle(servo.position)),
            velocity: Some(self.of_joints(&servos, velocity)),
            effort: None,
            valid: Some(true),
            commanded: None,      // YOUR ARM: what the controller itself commands, if it reports that
            speed_fraction: None, // YOUR ARM: at which part of its speed the controller runs motions, if it reports that
            ..JointReading::default()  // YOUR ARM: what efforts are (`effort_kind`), motors that are lost (`missing`)
        };
        Ok(())
    }

    fn read_state(&mut self) -> AdapterResult<RobotState> {
        let servos = self.not_older(STATE_AGE)?;
        let (on, moving) = (servos.iter().all(|servo| servo.on), servos.iter().any(|servo| servo.moving));
        Ok(RobotState { state: i32::from(on) + 2 * i32::from(moving), mode: 0 })
    }

    fn read_error(&mut self) -> AdapterResult<(i32, String)> {
        let error = error_of(&self.not_older(STATE_AGE)?).unwrap_or_default();
        Ok((error.into(), protocol::error_text(error).into())) // an empty text allocates nothing
    }

    fn read_enabled(&mut self) -> AdapterResult<bool> {
        Ok(self.not_older(STATE_AGE)?.iter().take(DOF).all(|servo| servo.on))
    }

    // --- Motion ---

    fn write_joint_positions(&mut self, positions: &[f64], velocity: f64) -> AdapterResult<()> {
        let angles = finite::<DOF>(positions)?;
        let servos = self.not_older(WRITABLE)?;
        // First: servos that switch their motor off in an error are in error, not off.
        if let Some(error) = error_of(&servos) {
            return Err(fault(error.into(), protocol::error_text(error)));
        }
        if let Some(joint) = servos.iter().take(DOF).position(|servo| !servo.on) {
            return Err(AdapterError::Rejected(format!("the motor of joint {} is off", joint + 1)));
        }
        let mut goals = servos.map(|servo| servo.goal); // the gripper keeps its own
        let joints = goals.iter_mut().zip(self.calibration.joints()).zip(angles);
        joints.for_each(|((goal, range), angle)| *goal = range.counts(angle));
        match self.mode {
            ControlMode::Position => {
                let speed = (velocity * TOP_SPEED * TURN / TAU).max(1.0) as u16;
                self.confirmed(Request::Goals(&goals, speed), |i, servo| goals.get(i) == Some(&servo.goal))
            }
            _ => self.tell(Request::Goals(&goals, 0)), // the next setpoint follows at once
        }
    }

    /// Makes the point of rest the goal of the joints. The caller knows it; a measured position may be wrong. The gripper
    /// keeps its goal, and so its grip. YOUR ARM: an arm with a stop of its own ignores the point.
    fn write_stop(&mut self, rest: &StopPoint) -> AdapterResult<Stop> {
        let servos = self.fetch()?;
        let mut goals = servos.map(|servo| servo.goal);
        let joints =
            goals.iter_mut().zip(&servos).zip(self.calibration.joints()).zip(rest.position.into_iter().flatten());
        joints
            .filter(|(((_, servo), _), angle)| servo.on && angle.is_finite())
            .for_each(|(((goal, _), range), angle)| *goal = range.counts(angle));
        if goals != servos.map(|servo| servo.goal) {
            self.write_goals(goals)?;
        }
        Ok(Stop::Confirmed)
    }

    /// A servo goes to its goal when its motor comes on: so the goal is first set to where it is, and read back.
    fn write_enable(&mut self, enable: bool) -> AdapterResult<()> {
        let servos = self.fetch()?;
        if enable && !servos.iter().all(|servo| servo.on) {
            let servos = self.agreed()?;
            let here = self.hold_goals(&servos)?;
            let mut goals = servos.map(|servo| servo.goal);
            let off = goals.iter_mut().zip(here).zip(&servos).filter(|(_, servo)| !servo.on);
            off.for_each(|((goal, here), _)| *goal = here);
            self.write_goals(goals)?;
        }
        self.confirmed(Request::Motors(enable), |_, servo| servo.on == enable)
    }

    fn write_clear_errors(&mut self) -> AdapterResult<()> {
        match error_of(&self.fetch()?) {
            None => Ok(()),
            Some(_) => self.confirmed(Request::Clear, |_, servo| servo.error == 0),
        }
    }

    fn discard_pending(&mut self) {
        self.line.abort(); // what the servos did not get must not reach them later
        self.disconnect();
    }

    // --- Optional parts. YOUR ARM: remove `gripper` if it has none ---

    fn gripper(&mut self) -> Option<&mut dyn Gripper> {
        Some(self)
    }
}

impl Gripper for AcmeAdapter {
    fn read_gripper_position(&mut self) -> AdapterResult<Option<f64>> {
        let servos = self.not_older(STATE_AGE)?;
        Ok(Some(self.calibration.opening(servos[DOF].position)))
    }

    fn write_gripper_position(&mut self, position: f64) -> AdapterResult<()> {
        if !(0.0..=OPEN).contains(&position) {
            return Err(AdapterError::Rejected(format!("the gripper opens 0 to {OPEN} m, not {position} m")));
        }
        let servos = self.not_older(STATE_AGE)?;
        if !servos[DOF].on {
            return Err(AdapterError::Rejected("the motor of the gripper is off".into()));
        }
        // To its servo alone: the goals of the others, sent again, would end a slow motion of the joints with a fast one.
        let goal = self.calibration.of_opening(position);
        self.confirmed(Request::Goal(SERVOS as u8, goal), |i, servo| i != DOF || servo.goal == goal)
    }

    fn get_gripper_range(&mut self) -> Option<(f64, f64)> {
        Some((0.0, OPEN))
    }
}

#[cfg(test)]
mod tests {
    use super::super::calibration::Range;
    use super::*;
    use dimos_hardware::registry::{Emulator, EmulatorAddress};
    use dimos_hardware::sim::faults::{Fault, FaultKind};

    /// A connected adapter and its servos.
    fn arm() -> (AcmeAdapter, Box<dyn Emulator>) {
        let (hardware_id, options) = ("arm".into(), Default::default());
        let mut config = AdapterConfig { hardware_id, address: String::new(), dof: DOF, options };
        let servos = super::super::emulator::start(&config, &EmulatorAddress::InProcess).unwrap();
        config.address = servos.address();
        let mut adapter = AcmeAdapter::new(&config).unwrap();
        adapter.connect().unwrap();
        (adapter, servos)
    }

    #[test]
    fn a_lost_a_damaged_and_a_late_reply_cost_no_reading() {
        let (mut adapter, servos) = arm();
        let mut read = || {
            let mut positions = [0.0; DOF];
            adapter.read_joint_positions(&mut positions).map(|()| positions)
        };
        let start = read();
        assert!(start.is_ok());
        for kind in [FaultKind::Silent, FaultKind::Corrupt, FaultKind::Truncated, FaultKind::Garbage] {
            servos.inject(Fault::new(kind)).unwrap();
            assert_eq!(read(), start, "{kind:?}");
        }
        servos.inject(Fault::new(FaultKind::Stall).lasting(0.04)).unwrap();
        assert_eq!(read(), start, "late");
    }

    #[test]
    fn a_joint_outside_its_range_is_not_enabled() {
        let (mut adapter, _servos) = arm();
        let before = adapter.fetch().unwrap();
        // Its calibration says that the first joint ends 100 counts below the position that it has.
        let high = before[0].position - 100;
        let mut ranges = [Range { zero: 2048, low: 0, high: 4095, reversed: false }; SERVOS];
        ranges[0] = Range { zero: 0, low: 0, high, reversed: false };
        adapter.calibration = Calibration::of(&ranges).unwrap();
        let refused = adapter.activate().unwrap_err().to_string();
        assert!(refused.starts_with("joint 1 is 8.8° outside its range\nhint: "), "{refused}");
        let after = adapter.fetch().unwrap();
        assert!(after.iter().all(|servo| !servo.on) && after.map(|s| s.goal) == before.map(|s| s.goal), "{after:?}");
    }

    #[test]
    fn a_stop_goes_where_its_caller_says_and_the_gripper_keeps_its_goal() {
        let (mut adapter, _servos) = arm();
        adapter.activate().unwrap();
        let held = adapter.fetch().unwrap().map(|servo| servo.goal);
        adapter.write_stop(&StopPoint::default()).unwrap();
        assert_eq!(adapter.fetch().unwrap().map(|servo| servo.goal), held, "nothing was commanded");
        let mut rest = [0.0; DOF];
        adapter.read_joint_positions(&mut rest).unwrap();
        rest[0] += 0.2;
        adapter.write_stop(&StopPoint { position: Some(joints_of(&rest)) }).unwrap();
        let goals = adapter.fetch().unwrap().map(|servo| servo.goal);
        let moved = (goals[0] - held[0]).abs();
        assert!((100..=160).contains(&moved) && goals[DOF] == held[DOF], "{goals:?} {held:?}");
    }
}
