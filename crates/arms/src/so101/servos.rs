//! The state of all servos and writes to all of them: one request reads the state; what is written has no answer, so it
//! is read back where it matters.

use std::time::Duration;

use super::SPEC;
use super::adapter::So101Adapter;
use super::protocol::{self, Instruction, MAX_DATA, MAX_INSTRUCTION, SERVOS, STATE, Servo, TURN, register};
use dimos_core::arm::JointSet;
use dimos_core::clock::{Clock, MonotonicClock};
use dimos_hardware::adapter::{AdapterError, AdapterResult};
use dimos_hardware::transport::request_reply::Retry;

/// Longest wait for the state of all servos. All attempts together stay below `stale_after`: a servo that answers none
/// of them, while others answer, is lost before the state of all is old.
const CYCLE: Retry = Retry { each: Duration::from_millis(25), times: 3 };
/// The same while one is lost: it is waited for no longer than that.
const WITHOUT: Retry = Retry::once(Duration::from_millis(25));
/// A state answers further questions for this time.
const STATE_AGE: Duration = Duration::from_millis(5);
/// How often torque and goals are written until the servos show them: nothing acknowledges a write to all.
const WRITES: u32 = 4;
/// Furthest that a goal is taken back to end an overload [counts].
const RELIEF: i32 = (SPEC.relief * TURN / std::f64::consts::TAU) as i32;

impl So101Adapter {
    /// Writes the same registers of all servos.
    pub(super) fn write<const N: usize>(&mut self, address: u8, values: [[u8; N]; SERVOS]) -> AdapterResult<()> {
        let mut frame = [0; MAX_INSTRUCTION];
        let write = Instruction::WriteAll(self.bus.first(), address, N as u8, values.as_flattened());
        self.state = None;
        self.bus.line.tell(protocol::encode(write, &mut frame))
    }

    /// Asks for the state of all servos. One that is lost has the state that it had last: `missing` names it.
    pub(super) fn fetch(&mut self) -> AdapterResult<[Servo; SERVOS]> {
        self.state = None;
        let asked = MonotonicClock.now();
        let mut frame = [0; MAX_INSTRUCTION];
        let frame = protocol::encode(Instruction::ReadAll(self.bus.first(), STATE.0, STATE.1), &mut frame);
        let (ids, first) = (self.bus.ids(), self.bus.first());
        let mut servos: [Option<Servo>; SERVOS] = [None; SERVOS];
        let scan = |bytes: &[u8]| {
            protocol::scan(bytes, ids.clone(), usize::from(STATE.1)).map(|status| {
                let mut data = [0; MAX_DATA];
                data.iter_mut().zip(status.data).for_each(|(to, byte)| *to = *byte);
                (status.id, data)
            })
        };
        let timeout = if self.missing.is_empty() { CYCLE } else { WITHOUT };
        let result = self.bus.line.gather_some(frame, timeout, SERVOS, scan, |(id, data)| {
            let slot = id.checked_sub(first).map(usize::from).and_then(|servo| servos.get_mut(servo));
            slot.is_some_and(|slot| slot.replace(Servo::decode(&data).unwrap_or_default()).is_none())
        });
        if let Err(AdapterError::Timeout(text)) = &result {
            let first = self.bus.servo(first);
            return Err(AdapterError::Timeout(format!("{text}; {first} did not")));
        }
        result?;
        let missing = (0..SERVOS).filter(|servo| servos.get(*servo).is_some_and(Option::is_none));
        self.missing = JointSet::of(missing);
        for (servo, heard) in servos.iter_mut().zip(&self.heard) {
            *servo = servo.or(*heard);
        }
        if let Some(unknown) = servos.iter().position(Option::is_none) {
            let unknown = self.bus.servo(first + unknown as u8);
            return Err(AdapterError::Timeout(format!("{unknown} did not answer, and the others did")));
        }
        self.heard = servos;
        let servos = servos.map(Option::unwrap_or_default);
        self.seams.take(&servos, asked);
        self.state = Some((servos, asked));
        Ok(servos)
    }

    /// Returns the last state, or a new one when that is too old.
    pub(super) fn recent(&mut self) -> AdapterResult<[Servo; SERVOS]> {
        self.not_older(STATE_AGE)
    }

    pub(super) fn not_older(&mut self, age: Duration) -> AdapterResult<[Servo; SERVOS]> {
        match self.state {
            Some((servos, at)) if self.bus.line.is_open() && MonotonicClock.now().since(at) <= age => Ok(servos),
            _ => self.fetch(),
        }
    }

    /// Writes the same registers of all servos until they show it. Returns whether they do.
    fn confirmed<const N: usize>(
        &mut self,
        address: u8,
        values: [[u8; N]; SERVOS],
        shown: impl Fn(usize, &Servo) -> bool,
    ) -> AdapterResult<bool> {
        for _ in 0..WRITES {
            self.write(address, values)?;
            let servos = self.fetch()?;
            // What a lost one has taken is not known, and keeps nothing from the others.
            if servos.iter().enumerate().all(|(j, servo)| self.missing.contains(j) || shown(j, servo)) {
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// Writes registers with the goals in them until the servos show these.
    pub(super) fn write_motion<const N: usize>(
        &mut self,
        address: u8,
        values: [[u8; N]; SERVOS],
        goals: &[i32; SERVOS],
    ) -> AdapterResult<()> {
        match self.confirmed(address, values, |j, servo| goals.get(j) == Some(&servo.goal))? {
            true => Ok(()),
            false => Err(AdapterError::Protocol("so101: the servos do not take their goals".into())),
        }
    }

    /// Writes goals until the servos show them.
    pub(super) fn write_goals(&mut self, goals: [i32; SERVOS]) -> AdapterResult<()> {
        self.write_motion(register::GOAL, goals.map(|goal| (goal.max(0) as u16).to_le_bytes()), &goals)
    }

    /// Switches all motors on or off until the servos show it.
    pub(super) fn write_torque(&mut self, on: bool) -> AdapterResult<()> {
        let shown = self.confirmed(register::TORQUE, [[u8::from(on)]; SERVOS], |_, servo| servo.on == on)?;
        let what = if on { "on" } else { "off" };
        if let Some(lost) = self.missing.first() {
            let lost = self.bus.servo(self.bus.first() + lost as u8);
            return Err(AdapterError::Protocol(format!(
                "so101: {lost} does not answer: whether its motor is {what} is not known\nhint: check its cable, or \
                 switch the power of the arm off"
            )));
        }
        if shown {
            return Ok(());
        }
        Err(AdapterError::Protocol(format!("so101: not all motors can be switched {what}")))
    }

    /// Writes goals of the servos whose motors are on; the others might come on.
    pub(super) fn write_goals_of_enabled(
        &mut self,
        servos: &[Servo; SERVOS],
        goals: [i32; SERVOS],
    ) -> AdapterResult<()> {
        if servos.iter().all(|servo| servo.on) {
            return self.write_goals(goals);
        }
        self.state = None;
        let each = self.bus.ids().zip(servos.iter().zip(goals)).filter(|(_, (servo, _))| servo.on);
        { each }.try_for_each(|(id, (_, goal))| self.bus.write(id, register::GOAL, &(goal.max(0) as u16).to_le_bytes()))
    }

    /// Returns the goals with those of overloaded servos taken back towards the joint: by at most [`RELIEF`] from what
    /// was commanded, however often this is asked for. A wrong reading moves a joint no further than that.
    pub(super) fn relieved_goals(&mut self, servos: &[Servo; SERVOS]) -> [i32; SERVOS] {
        let mut goals = servos.map(|servo| servo.goal);
        for ((goal, servo), commanded) in goals.iter_mut().zip(servos).zip(&mut self.relieved) {
            if servo.on && servo.error != 0 {
                let from = *commanded.get_or_insert(servo.goal);
                *goal = servo.position.max(from - RELIEF).min(from + RELIEF).max(0);
            }
        }
        goals
    }

    /// Returns code and text of the first servo in error; the text names it.
    pub(super) fn error_of(&self, servos: &[Servo; SERVOS]) -> Option<(i32, String)> {
        let (id, servo) = self.bus.ids().zip(servos).find(|(_, servo)| servo.error != 0)?;
        Some((servo.error.into(), format!("{}: {}", self.bus.servo(id), protocol::error_text(servo.error))))
    }
}
