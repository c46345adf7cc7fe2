//! What each register of the control port does. Where the vendor's pages do not say what happens, a comment says that
//! the choice is ours.

use super::super::model::VELOCITY;
use super::controlled_arm::{ControlledArm, JOINT_LIMIT, Refusal};
use super::controller::{Controller, Move, QUEUE, state};
use super::kinematics::{from_wire, to_wire};
use super::wire::{self, Request, number, numbers, put_numbers};
use crate::hardware::sim::faults::FaultKind;
use crate::hardware::sim::reach::Chain;
use std::time::Duration;

/// The mode of guiding by hand.
const GUIDED: u8 = 2;
/// Warnings.
const QUEUE_FULL: u8 = 11;
const BAD_PARAMETER: u8 = 12;
const UNKNOWN: u8 = 13;
const NO_SOLUTION: u8 = 14;
/// Acceleration of a move that has none [rad/s²].
const ACCELERATION: f64 = 20.0;
/// Errors.
const TOOL_SILENT: u8 = 19;

/// The state byte's bit "no valid result": a command that the mode does not know (our choice).
const INVALID: u8 = 0x08;
/// Length of a response without a payload.
const HEADER: usize = 8;
/// The bus number of the tool flange.
const TOOL: u8 = 9;

use Refusal::{Error, NotNow, Pending, Warning};

/// How many numbers the result of a query has: a pose, or joints.
fn numbers_of(register: u8) -> Option<usize> {
    match register {
        41 | 44 | 91 => Some(6),
        43 => Some(7),
        _ => None,
    }
}

impl<A: ControlledArm> Controller<A> {
    /// Does what a request asks; answers the state byte of the response in `out`. `None`: the outcome is not known yet.
    pub(super) fn respond(&mut self, request: &Request<'_>, out: &mut Vec<u8>) -> Option<u8> {
        wire::begin(out, request);
        let mut extra = 0;
        match self.execute(request.register, request.payload, out) {
            Ok(()) => {}
            Err(Warning(code)) => self.warning = code,
            Err(Error(code)) => self.fail(code),
            Err(NotNow) => extra = INVALID,
            Err(Pending) => return None,
        }
        if let Some(missing) = numbers_of(request.register).filter(|_| out.len() == HEADER) {
            // Clients expect all numbers of a result, also of one that there is not.
            put_numbers(out, std::iter::repeat_n(f32::NAN, missing));
        }
        let status = self.status() | extra;
        wire::end(out, status);
        Some(status)
    }

    fn execute(&mut self, register: u8, data: &[u8], out: &mut Vec<u8>) -> Result<(), Refusal> {
        match (register, data) {
            (1, _) => self.version(out),
            (2, _) => {
                let serial = &self.identity.serial;
                out.extend(format!("{serial}C07L01\0AC1305C07L01\n\0").bytes().chain([0; 40]).take(40));
            }
            (5, _) => out.push(u8::from(self.settings.currents)),
            (70, [kind]) => self.settings.currents = *kind == 1,
            (11, [joint, on]) => self.switch(*joint, *on == 1)?,
            (12, [wanted]) => self.set_state(*wanted)?,
            (13, _) => out.push(self.reported_state()),
            (14, _) => self.put_queue(out),
            (15, _) => out.extend([self.error(), self.warning]),
            (16, _) => self.clear_error()?,
            (17, _) => self.warning = 0,
            (19, [mode, ..]) if !self.arm.has_mode(*mode) => return Err(NotNow),
            (19, [mode, ..]) if *mode <= 11 => self.set_mode(*mode),
            (31..=34, _) => self.put_queue(out),
            // Settings that the arm does not have are refused, except those that change nothing.
            (35, _) if !self.arm.takes_settings() && data.iter().all(|byte| *byte == 0) => self.put_queue(out),
            (35 | 37 | 38 | 206, _) if !self.arm.takes_settings() => return Err(NotNow),
            (201, _) if !self.arm.takes_settings() && self.arm.wrench().is_none() => return Err(NotNow),
            (35, _) => self.setting(|s| s.offset = numbers(data).unwrap_or(s.offset), out),
            (36, _) => {
                let load = numbers(data).ok_or(Warning(BAD_PARAMETER))?;
                self.arm.set_load(load)?;
                self.setting(|s| s.load = load, out);
            }
            (37, [level @ 0..=5]) => self.setting(|s| s.sensitivity = [*level, s.sensitivity[1]], out),
            (38, [level @ 1..=5]) => self.setting(|s| s.sensitivity = [s.sensitivity[0], *level], out),
            (18 | 39 | 40 | 254, _) => {}
            (253, _) => out.push(0),
            (41, _) => put_numbers(out, to_wire(&self.pose().ok_or(NotNow)?)),
            (42, _) => {
                let (wanted, (positions, velocities)) = (data.first().copied().unwrap_or_default(), self.reported());
                put_numbers(out, positions.map(|v| v as f32));
                matches!(wanted, 2 | 3).then(|| put_numbers(out, velocities.map(|v| v as f32)));
                (wanted == 3).then(|| put_numbers(out, self.torques()));
            }
            (43, _) => {
                let goal = from_wire(numbers(data).ok_or(Warning(BAD_PARAMETER))?);
                let joints = self.chain.ok_or(NotNow)?.inverse(&goal, &self.seven()).ok_or(Warning(NO_SOLUTION))?;
                put_numbers(out, joints.map(|v| v as f32));
            }
            (44, _) => {
                let joints = numbers::<7>(data).ok_or(Warning(BAD_PARAMETER))?.map(f64::from);
                put_numbers(out, to_wire(&self.chain.ok_or(NotNow)?.forward(&joints)));
            }
            (45, _) => {
                let joints = numbers::<7>(data).ok_or(Warning(BAD_PARAMETER))?.map(f64::from);
                out.push(u8::from(!self.arm.is_within(&joints)));
            }
            (55, _) => put_numbers(out, self.torques()),
            (91, _) => {
                let pose = self.pose().ok_or(NotNow)?;
                let (place, turn) = (pose.translation.vector * 1000.0, pose.rotation.scaled_axis());
                put_numbers(out, place.iter().chain(turn.iter()).map(|v| *v as f32));
            }
            (106, _) => {
                let failed = self.error().checked_sub(11).filter(|joint| *joint < 7);
                out.extend((0..8).flat_map(|joint| [0, if failed == Some(joint) { 23 } else { 0 }]));
            }
            (124, [TOOL, telegram @ ..]) => {
                let answer = self.tool.telegram(telegram).ok_or(Error(TOOL_SILENT))?;
                if let Some(opening) = self.tool.take_order() {
                    self.arm.move_gripper(opening);
                }
                out.extend([TOOL].into_iter().chain(answer));
            }
            (125, _) => out.extend([0, self.tool.error as u8]),
            (127, [TOOL, a0, a1, ..]) => {
                let value = number(data, 3, 0).ok_or(Warning(BAD_PARAMETER))?;
                self.tool.write(u16::from(*a0) << 8 | u16::from(*a1), value);
            }
            (128, [TOOL, a0, a1]) => {
                out.extend(self.tool.read(u16::from(*a0) << 8 | u16::from(*a1)).to_be_bytes());
            }
            (150 | 200, _) => put_numbers(out, if data == [1] { self.wrench().1 } else { self.wrench().0 }),
            (201, [on]) => self.settings.wrench_on = *on == 1,
            (202, _) => {}
            (206, _) => self.settings.wrench_zero = self.wrench().1,
            (21..=30 | 81, _) => self.motion(register, data, out)?,
            (1..=254, _) if (11..=45).contains(&register) => return Err(Warning(BAD_PARAMETER)),
            _ => return Err(Warning(UNKNOWN)),
        }
        Ok(())
    }

    fn version(&mut self, out: &mut Vec<u8>) {
        let axes = self.identity.axes + usize::from(self.arm.due_fault(FaultKind::WrongDof).is_some());
        let another = self.arm.due_fault(FaultKind::WrongModel).is_some();
        let kind = match self.identity.kind {
            6 if another => 9, // a Lite 6
            _ if another => 6,
            kind => kind,
        };
        let ([major, minor, revision], serial) = (self.firmware, &self.identity.serial);
        let text = format!("{axes},{kind},{serial},AC1305,v{major}.{minor}.{revision}");
        out.extend(text.bytes().chain([0; 40]).take(40));
    }

    /// The number of commands in the queue, which real controllers put behind the state byte.
    fn put_queue(&self, out: &mut Vec<u8>) {
        out.extend((self.queue.len() as u16).to_be_bytes());
    }

    /// A setting that resets the system and drops to mode 0.
    fn setting(&mut self, set: impl FnOnce(&mut super::controller::Settings), out: &mut Vec<u8>) {
        set(&mut self.settings);
        self.mode = 0;
        self.halt(state::CHANGED);
        self.put_queue(out);
    }

    fn switch(&mut self, joint: u8, on: bool) -> Result<(), Refusal> {
        if on && self.error() != 0 {
            return Ok(());
        }
        match joint {
            8 => self.arm.switch(None, on)?,
            1..=7 => self.arm.switch(Some(usize::from(joint - 1)), on)?,
            _ => {}
        }
        self.halt(if self.arm.enabled() { state::CHANGED } else { state::STOPPED });
        Ok(())
    }

    fn set_state(&mut self, wanted: u8) -> Result<(), Refusal> {
        match wanted {
            0 if self.arm.is_ready() => {
                self.arm.begin()?;
                if self.mode == GUIDED {
                    self.arm.guide()?;
                }
                if self.state == state::PAUSED
                    && let Some(halted) = self.current.take()
                {
                    self.queue.push_front(halted);
                }
                self.state = state::STANDING;
            }
            3 if self.state == state::STANDING => {
                self.state = state::PAUSED;
                self.arm.stop();
            }
            4 => {
                self.arm.operational_stop();
                self.halt(state::STOPPED);
            }
            6 => self.halt(state::STOPPING),
            _ => {}
        }
        Ok(())
    }

    fn set_mode(&mut self, mode: u8) {
        // From one streaming mode to another while it is ready, it silently lands in mode 0.
        let silently_0 = self.state == state::STANDING && self.mode != 0 && mode != 0 && mode != self.mode;
        self.mode = match mode {
            _ if self.keeps_mode => self.mode,
            _ if silently_0 => 0,
            mode => mode,
        };
        self.halt(if self.arm.enabled() { state::CHANGED } else { state::STOPPED });
    }

    // --- Motion ---

    fn motion(&mut self, register: u8, data: &[u8], out: &mut Vec<u8>) -> Result<(), Refusal> {
        let mode = match register {
            29 | 30 => 1,
            81 => 4,
            _ => 0,
        };
        if !self.arm.is_ready() || self.state != state::STANDING || self.mode != mode {
            return Err(NotNow);
        }
        match register {
            21 | 22 => {
                let [pose @ .., speed] = numbers::<7>(data).ok_or(Warning(BAD_PARAMETER))?;
                let target = self.inverse(pose)?;
                // The tool's way is not straight here: the joints go together (our choice).
                self.plan(target, (f64::from(speed) / 1000.0).clamp(0.01, 1.0) * VELOCITY, None, out)
            }
            23 | 24 => {
                let [joints @ .., speed] = numbers::<8>(data).ok_or(Warning(BAD_PARAMETER))?;
                let mut target = joints.map(f64::from);
                for (value, now) in target.iter_mut().zip(self.seven()) {
                    *value = if *value == f64::INFINITY { now } else { *value };
                }
                self.plan(target, speed.into(), number(data, 0, 8), out)
            }
            25 => {
                let speed = number(data, 0, 0).ok_or(Warning(BAD_PARAMETER))?;
                self.plan([0.0; 7], speed.into(), number(data, 0, 1), out)
            }
            29 => {
                let target = self.checked(numbers::<7>(data).ok_or(Warning(BAD_PARAMETER))?.map(f64::from))?;
                self.arm.follow(&target)
            }
            30 => {
                let target = self.inverse(numbers(data).ok_or(Warning(BAD_PARAMETER))?)?;
                let target = self.checked(target)?;
                self.arm.follow(&target)
            }
            81 => {
                let speeds = numbers::<7>(data).ok_or(Warning(BAD_PARAMETER))?;
                if !speeds.iter().all(|speed| speed.is_finite()) {
                    return Err(Warning(BAD_PARAMETER));
                }
                let duration = number(data, 29, 0).filter(|duration| *duration > 0.0);
                let duration = duration.map(|duration| Duration::from_secs_f32(duration.min(3600.0)));
                self.arm.keep_velocity(&speeds.map(f64::from), duration)
            }
            _ => Err(Warning(UNKNOWN)),
        }
    }

    fn plan(
        &mut self,
        target: [f64; 7],
        speed: f64,
        acceleration: Option<f32>,
        out: &mut Vec<u8>,
    ) -> Result<(), Refusal> {
        let target = self.checked(target)?;
        if self.queue.len() >= QUEUE {
            return Err(Warning(QUEUE_FULL));
        }
        let acceleration = acceleration.filter(|value| *value > 0.0).map_or(ACCELERATION, f64::from);
        let speed = if speed.is_nan() { 0.0 } else { speed };
        if self.queue.is_empty() && !self.arm.moving() {
            // Begins at once, so that the response says whether the arm takes it.
            self.arm.go(&target, speed, acceleration)?;
            self.current = Some(Move { target, speed, acceleration });
        } else {
            self.queue.push_back(Move { target, speed, acceleration });
        }
        let count = self.queue.len() + usize::from(self.current.is_some());
        out.extend((count as u16).to_be_bytes());
        Ok(())
    }

    fn inverse(&self, pose: [f32; 6]) -> Result<[f64; 7], Refusal> {
        if !pose.iter().all(|value| value.is_finite()) {
            return Err(Warning(BAD_PARAMETER));
        }
        self.chain.ok_or(NotNow)?.inverse(&from_wire(pose), &self.seven()).ok_or(Warning(NO_SOLUTION))
    }

    fn checked(&self, target: [f64; 7]) -> Result<[f64; 7], Refusal> {
        if !target.iter().all(|value| value.is_finite()) {
            return Err(Warning(BAD_PARAMETER));
        }
        if self.arm.is_within(&target) { Ok(target) } else { Err(Error(JOINT_LIMIT)) }
    }
}
