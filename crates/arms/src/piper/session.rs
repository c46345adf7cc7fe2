//! A session with the arm, in wire units: processes received frames, detects silence, and decides from the arm's
//! feedback what may be sent.

use std::time::Duration;

use super::controller_limits;
use super::feedback::Feedback;
use super::hold::{self, WireRanges};
use super::model::Model;
use super::protocol::{self, DOF, Driver, Follow, MoveMode, Status, WireJoints, radians};
use super::wire::Wire;
use dimos_core::clock::{Clock, Mono, MonotonicClock};
use dimos_core::joint::JointLimits;
use dimos_hardware::adapter::{AdapterError, AdapterResult};
use dimos_hardware::transport::can::{CanAddress, CanFrame};

/// Timeouts of the first complete state, and of responses.
const CONNECT_TIMEOUT: Duration = Duration::from_millis(1000);
const ANSWER_TIMEOUT: Duration = Duration::from_millis(300);
/// Received frames are not processed again within this time: the arm's period.
const RECENT: Duration = Duration::from_millis(5);
/// Maximum age of the state: a live arm sends one every 5 ms; the rest is for a busy host.
const STALE_AFTER: Duration = Duration::from_millis(150);
/// Maximum age of the drivers' reports, which arrive every 25 ms.
const DRIVERS_STALE_AFTER: Duration = Duration::from_millis(300);
/// Without a state for this long the connection is closed: the arm has lost power.
const LOST_AFTER: Duration = Duration::from_millis(400);
/// Period of the repeated commands for enabling and disabling, as in the vendor's SDK.
const REPEAT: Duration = Duration::from_millis(10);
const ENABLE_TIMEOUT: Duration = Duration::from_millis(1000);
/// State of the arm: E-stop.
pub const ESTOP: u8 = 1;
/// How far outside its limits a joint may be when it is enabled [rad].
const MAX_OUTSIDE: f64 = 0.2;

/// An arm on its bus, connected or not.
pub struct Session {
    /// The arm's `hardware_id`, for messages.
    hardware_id: String,
    address: CanAddress,
    /// Which arm it is.
    model: Model,
    /// The open port, while connected.
    pub wire: Option<Wire>,
    /// The arm's feedback.
    pub feedback: Feedback,
    /// The last joint targets [0.001°]; `None` if the arm does not follow them.
    pub written: Option<WireJoints>,
    /// Speed [%] and mode of following in the last control frame for joint targets, unless another one followed it.
    pub control: Option<(u8, Follow)>,
    /// Joint limits [0.001°].
    pub ranges: WireRanges,
    /// Whether the controller refuses targets outside its limits.
    pub strict: bool,
    /// When received frames were last processed.
    drained_at: Mono,
}

impl Session {
    /// Creates a session with the arm on the bus at `address`. Does not connect.
    pub fn new(hardware_id: String, address: CanAddress, model: Model, gripper_used: bool) -> Self {
        let feedback = Feedback::of_arm(gripper_used);
        let ranges = [(0, 0); DOF];
        Self {
            hardware_id,
            address,
            model,
            wire: None,
            feedback,
            written: None,
            control: None,
            ranges,
            strict: false,
            drained_at: Mono::ZERO,
        }
    }

    /// Opens the port and waits for a complete state. Sends only requests.
    pub fn connect(&mut self) -> AdapterResult<()> {
        self.feedback = Feedback::of_arm(self.feedback.gripper_used);
        (self.written, self.control, self.strict) = (None, None, false);
        self.wire = Some(Wire::open(&self.address)?);
        let introduced = self.introduce();
        if introduced.is_err() {
            self.wire = None;
        }
        introduced
    }

    // --- The wire ---

    /// Processes received frames. A broken connection ends the session.
    pub fn drain(&mut self) -> AdapterResult<()> {
        let wire = self.wire.as_mut().ok_or(AdapterError::NotConnected)?;
        self.drained_at = MonotonicClock.now();
        let result = wire.drain(&mut self.feedback);
        if result.is_err() {
            self.wire = None;
        }
        result
    }

    /// Sends a command; an error unless the bus has taken all of it.
    pub fn send(&mut self, frames: &[CanFrame]) -> AdapterResult<()> {
        self.wire.as_mut().ok_or(AdapterError::NotConnected)?.send(frames)
    }

    /// Sends a joint target with its control frame, and records it.
    pub fn write(&mut self, speed: u8, follow: Follow, target: WireJoints) -> AdapterResult<()> {
        let frames = protocol::joint_targets(speed, follow, target);
        self.feedback.guard.order(MoveMode::Joint as u8, MonotonicClock.now());
        self.send(&frames)?;
        (self.written, self.control) = (Some(target), Some((speed, follow)));
        Ok(())
    }

    /// Sends a setpoint. The control frame is omitted while the arm reports the mode: it would undo a change by another
    /// program before that shows.
    pub fn stream(&mut self, follow: Follow, target: WireJoints) -> AdapterResult<()> {
        const SPEED: u8 = 100;
        let Status { control, mode, .. } = self.feedback.status;
        if self.control != Some((SPEED, follow)) || (control, mode) != (1, MoveMode::Joint as u8) {
            return self.write(SPEED, follow, target);
        }
        let [_, targets @ ..] = protocol::joint_targets(SPEED, follow, target);
        self.send(&targets)?;
        self.written = Some(target);
        Ok(())
    }

    /// Returns whether another setpoint may wait for the bus.
    pub fn has_room(&self) -> bool {
        self.wire.as_ref().is_some_and(Wire::has_room)
    }

    /// Discards unsent frames; see [`Wire::discard`]. If that fails, closes the connection.
    pub fn discard(&mut self) {
        let discarded = self.wire.as_mut().map(Wire::discard);
        if let Some(Err(_)) = discarded {
            self.wire = None;
        }
    }

    /// Processes feedback until `done` returns true; `false` after the timeout.
    pub fn watch(&mut self, timeout: Duration, mut done: impl FnMut(&Feedback) -> bool) -> AdapterResult<bool> {
        let end = MonotonicClock.now().after(timeout);
        loop {
            self.drain()?;
            let left = end.since(MonotonicClock.now());
            if done(&self.feedback) || left.is_zero() {
                return Ok(done(&self.feedback));
            }
            if let Some(wire) = &self.wire {
                wire.wait(left);
            }
        }
    }

    /// Processes received frames; an error if the newest positions are stale.
    pub fn refresh(&mut self) -> AdapterResult<()> {
        self.drain()?;
        let age = MonotonicClock.now().since(self.feedback.joints_at);
        if age <= STALE_AFTER {
            return Ok(());
        }
        // The same text each time, so that it is logged once.
        if age > LOST_AFTER {
            self.wire = None;
            let text = format!(
                "the connection to piper at {} broke: no state for {} ms",
                self.address,
                LOST_AFTER.as_millis()
            );
            return Err(AdapterError::Io(text));
        }
        Err(AdapterError::Timeout(format!("piper at {}: no state for {} ms", self.address, STALE_AFTER.as_millis())))
    }

    /// Processes what has arrived; an error if the state is stale, or if the drivers no longer report whether the
    /// motors are on.
    pub fn whole(&mut self) -> AdapterResult<()> {
        self.refresh()?;
        let earliest = MonotonicClock.now().before(DRIVERS_STALE_AFTER);
        if self.feedback.drivers_heard(earliest) {
            return Ok(());
        }
        let (address, silent) = (&self.address, self.feedback.silent_drivers(earliest));
        Err(AdapterError::Timeout(format!(
            "piper at {address}: the {} said nothing for {} ms",
            drivers(&silent),
            DRIVERS_STALE_AFTER.as_millis()
        )))
    }

    /// Returns whether the motors' speeds and currents are recent.
    pub fn measures(&self) -> bool {
        self.feedback.motors_heard(MonotonicClock.now().before(STALE_AFTER))
    }

    /// The feedback, for reads that mostly follow one of the joints and then answer from memory.
    pub fn known(&mut self) -> AdapterResult<&Feedback> {
        if self.wire.is_none() {
            return Err(AdapterError::NotConnected);
        }
        if MonotonicClock.now().since(self.drained_at) > RECENT {
            self.drain()?;
        }
        Ok(&self.feedback)
    }

    /// Waits for a whole state, then for what was asked.
    fn introduce(&mut self) -> AdapterResult<()> {
        let mut questions = [protocol::ask_firmware(); DOF + 1];
        questions.iter_mut().zip(1..).take(DOF).for_each(|(frame, joint)| *frame = protocol::ask_limits(joint));
        self.send(&questions)?;
        if !self.watch(CONNECT_TIMEOUT, Feedback::complete)? {
            return Err(self.why_not());
        }
        let answered = |p: &Feedback| p.firmware().is_some() && p.limits.iter().all(Option::is_some);
        if !self.watch(ANSWER_TIMEOUT / 2, answered)? {
            // Questions that still wait for the bus are not lost, and would leave no room for the repetition.
            if self.wire.as_ref().is_some_and(Wire::is_clear) {
                self.send(&questions)?;
            }
            self.watch(ANSWER_TIMEOUT / 2, answered)?; // what stays unanswered is known from the data sheet
        }
        let (limits, _) = self.limits();
        self.ranges = hold::ranges(&limits.position_lower, &limits.position_upper);
        Ok(())
    }

    /// The data sheet's limits, narrowed by those that the controller has been given; and what of these is odd.
    pub fn limits(&self) -> (JointLimits, Vec<String>) {
        controller_limits::narrowed(self.model, &self.feedback.limits)
    }

    /// Why there is no whole state.
    fn why_not(&self) -> AdapterError {
        let (address, counts) = (&self.address, self.feedback.counts);
        if self.feedback.joints_at != Mono::ZERO {
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

    /// Whether the measured positions can be relied on: `Some(true)` where the motors' drivers answer the controller,
    /// and the positions are not all exactly zero, which it says before it has measured; `Some(false)` where a joint
    /// does not answer it, or none of the drivers has said anything about itself.
    pub fn valid(&self) -> Option<bool> {
        let silent =
            |driver: &Driver| (driver.voltage, driver.driver_temperature, driver.motor_temperature) == (0, 0, 0);
        if self.feedback.status.silent != 0 || self.feedback.drivers.iter().all(silent) {
            return Some(false);
        }
        (self.feedback.joints != [0; DOF]).then_some(true)
    }

    // --- What may be done ---

    /// A line about this arm.
    pub fn about(&self, what: &str) -> String {
        format!("{}: {what}", self.hardware_id)
    }

    /// A refusal of our own.
    pub fn refuse(&self, why: String) -> AdapterError {
        AdapterError::Rejected(format!("{}: {why}", self.hardware_id))
    }

    /// Checks that the arm has no error and that only this run controls it.
    pub fn in_order(&self) -> AdapterResult<()> {
        let code = self.feedback.error_code();
        if code != 0 {
            let mut text = self.feedback.error_text();
            if self.feedback.status.arm == ESTOP {
                text.push_str(
                    "\nhint: the arm leaves its E-stop only by a reset that takes the power from its motors: hold it, \
                     then switch it off and on",
                );
            }
            return Err(AdapterError::Fault { code, text });
        }
        if MonotonicClock.now().since(self.feedback.commanded_at) < STALE_AFTER {
            return Err(self.refuse(
                "another program commands this arm\nhint: end the other program, or unplug the leader arm from this bus"
                    .into(),
            ));
        }
        match self.feedback.status.control {
            0 | 1 => Ok(()),
            other => Err(self.refuse(format!(
                "the arm is controlled by {}\nhint: end that at the arm; where it does not let go, hold it and switch \
                 it off and on",
                protocol::control_text(other)
            ))),
        }
    }

    /// Returns an error if another client has changed the arm's mode or power. Does not undo the change.
    pub fn ours(&self) -> AdapterResult<()> {
        let what = match (self.feedback.guard.change, self.feedback.guard.lost_power()) {
            (Some(change), _) => change.text(),
            (None, true) => "its motors were switched off".to_owned(),
            (None, false) => return Ok(()),
        };
        Err(self.refuse(format!(
            "{what}, which this run did not order: the arm is not commanded\nhint: end that, then enable the arm again"
        )))
    }

    /// Ends the watch for changes that this run did not order, and forgets what was written before one.
    pub fn release(&mut self) {
        self.written = self.written();
        self.control = None;
        self.feedback.guard.release();
    }

    /// What was written, if the arm has followed it since.
    pub fn written(&self) -> Option<WireJoints> {
        self.written.filter(|_| self.ours().is_ok())
    }

    /// Checks that the arm may be moved.
    pub fn may_move(&mut self) -> AdapterResult<()> {
        self.whole()?;
        self.in_order()?;
        self.ours()?;
        if self.feedback.enabled() { Ok(()) } else { Err(self.refuse("the motors are disabled".into())) }
    }

    /// Returns the measured pose; an error when it cannot be true: holding there would be a jump.
    pub fn plausible(&mut self) -> AdapterResult<WireJoints> {
        let measured = self.agreed()?;
        if self.feedback.only_zeros(MonotonicClock.now()) {
            return Err(self.refuse(
                "every joint reads exactly 0, as from a controller that has not measured yet: not enabled\nhint: if \
                 the arm truly lies there, move a joint a little by hand"
                    .into(),
            ));
        }
        let limits = self.model.limits();
        let range = limits.position_lower.iter().zip(&limits.position_upper);
        for (i, (wire, (lower, upper))) in measured.iter().zip(range).enumerate() {
            let value = radians(*wire);
            if !(lower - MAX_OUTSIDE..=upper + MAX_OUTSIDE).contains(&value) {
                let joint = i + 1;
                return Err(self.refuse(format!(
                    "joint {joint} reads {value:.3} rad, outside its range of {lower} to {upper}: not enabled\nhint: \
                     move it back by hand, or set its zero point again with the vendor's tool"
                )));
            }
        }
        Ok(measured)
    }

    /// Asks for the motors to be on or off until they say that they are.
    pub fn switch_motors(&mut self, on: bool) -> AdapterResult<()> {
        let began = MonotonicClock.now();
        let end = began.after(ENABLE_TIMEOUT);
        let switched = |p: &Feedback| p.drivers_heard(began) && if on { p.enabled() } else { p.disabled() };
        let mut sent = Ok(());
        while MonotonicClock.now() < end {
            sent = self.send(&[protocol::enable(on)]);
            if self.watch(REPEAT, switched)? {
                return Ok(());
            }
        }
        sent?;
        let (name, within) = (&self.hardware_id, ENABLE_TIMEOUT.as_millis());
        let silent = self.feedback.silent_drivers(began);
        if !silent.is_empty() {
            let what = format!("{name}: the {} said nothing for {within} ms", drivers(&silent));
            return Err(AdapterError::Timeout(what));
        }
        let wrong = |(_, driver): &(usize, &Driver)| driver.enabled() != on;
        let joints: Vec<String> =
            (1..).zip(&self.feedback.drivers).filter(wrong).map(|(joint, _)| joint.to_string()).collect();
        let (joints, word) = (joints.join(", "), if on { "on" } else { "off" });
        Err(AdapterError::Timeout(format!("{name}: the motors of joints {joints} do not go {word} within {within} ms")))
    }
}

/// Returns drivers, such as those of `3, 4`, with their verb.
fn drivers(joints: &str) -> String {
    let many = joints.contains(',');
    if many { format!("drivers of joints {joints} have") } else { format!("driver of joint {joints} has") }
}
