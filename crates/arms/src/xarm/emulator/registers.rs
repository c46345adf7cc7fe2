//! What each register of the control port does. Where the vendor's pages do not say what happens, a comment says that
//! the choice is ours.

use super::controlled_arm::{ControlledArm, Refusal};
use super::controller::{Controller, state};
use super::kinematics::{to_wire, to_wire_axis_angle};
use super::motion::is_motion;
use super::settings::is_setting;
use super::wire::{self, Request, number, numbers, put_numbers};
use dimos_hardware::sim::faults::FaultKind;

/// The mode of guiding by hand.
pub(super) const GUIDED: u8 = 2;
/// Warnings.
pub(super) const QUEUE_FULL: u8 = 11;
pub(super) const BAD_PARAMETER: u8 = 12;
const UNKNOWN: u8 = 13;
pub(super) const NO_SOLUTION: u8 = 14;
/// Errors: a bus of the tool or of the box without an answer.
const TOOL_SILENT: u8 = 19;
const BOX_SILENT: u8 = 111;

/// The state byte's bit "no valid result". What is not done always has it, so that the vendor's client returns 10: of a
/// warning alone it makes a success.
const INVALID: u8 = 0x08;
/// Length of a response without a payload.
const HEADER: usize = 8;
/// The bus number of the tool flange, and of the box.
const TOOL: u8 = 9;
const BOX: u8 = 11;

use Refusal::{Error, NotNow, Pending, Warning};

/// How many bytes the result of a query has at most. Clients expect all of them, also of a result that there is not.
fn length_of(register: u8) -> usize {
    match register {
        41 | 44 | 76 | 91 | 150 | 200 => 4 * 6,
        43 | 55 => 4 * 7,
        53 => 79,
        67 => 4 * 28,
        111..=114 => 4 * 3,
        212 => 280,
        3..=10 | 46 | 49 | 57 | 65 | 69 | 101..=107 | 115 | 125 | 128..=141 | 203 | 204 | 230..=234 => 40,
        _ => 0,
    }
}

/// Returns whether the result of a query is numbers.
fn is_of_numbers(register: u8) -> bool {
    matches!(register, 41 | 43 | 44 | 91)
}

impl<A: ControlledArm> Controller<A> {
    /// Does what a request asks; answers the state byte of the response in `out`. `None`: the outcome is not known yet.
    pub(super) fn respond(&mut self, request: &Request<'_>, out: &mut Vec<u8>) -> Option<u8> {
        wire::begin(out, request);
        let (register, data) = (request.register, request.payload);
        let outcome = self.execute(register, data, out);
        let mut extra = 0;
        match outcome {
            Ok(()) => {}
            Err(Warning(code)) => (self.warning, extra) = (code, INVALID),
            // The client returns 1 for a motion in error, and forgives it elsewhere.
            Err(Error(code)) => {
                self.fail(code);
                extra = if is_motion(register) { 0 } else { INVALID };
            }
            Err(NotNow) => extra = INVALID,
            Err(Pending) => return None,
        }
        if extra != 0 {
            self.arm.note_refused(register, data, self.mode, self.state);
            let missing = length_of(register).saturating_sub(out.len().saturating_sub(HEADER));
            let none = if is_of_numbers(register) { f32::NAN } else { 0.0 };
            put_numbers(out, std::iter::repeat_n(none, missing.div_ceil(4)));
        }
        let status = self.status() | extra;
        wire::end(out, status);
        Some(status)
    }

    fn execute(&mut self, register: u8, data: &[u8], out: &mut Vec<u8>) -> Result<(), Refusal> {
        match (register, data) {
            (1, _) => self.version(out),
            (2, _) => {
                let (serial, unit) = (&self.identity.serial, &self.unit);
                out.extend(format!("{serial}{unit}\0AC1305C07L01\n\0").bytes().chain([0; 40]).take(40));
            }
            (5, _) => out.push(u8::from(self.settings.currents)),
            (11, [joint, on]) => self.switch(*joint, *on == 1)?,
            (12, [wanted]) => self.set_state(*wanted)?,
            (13, _) => out.push(self.reported_state()),
            (14, _) => self.put_queue(out),
            (15, _) => out.extend([self.error(), self.warning]),
            (16, _) => self.clear_error()?,
            (17, _) => self.warning = 0,
            (19, [mode, ..]) if self.arm.has_mode(*mode) => self.set_mode(*mode),
            (19, [_, ..]) => return Err(NotNow),
            _ if is_setting(register) => self.setting(register, data, out)?,
            (253, _) => out.push(0),
            // No feedback is sent; clients ask for it with every move that they wait for, and do without.
            (254, _) => return Err(NotNow),
            (41, _) => put_numbers(out, to_wire(&self.pose().ok_or(NotNow)?)),
            (42, _) => {
                let wanted = data.first().copied().unwrap_or_default() & 0x0F;
                let (positions, velocities) = self.reported();
                put_numbers(out, positions.map(|v| v as f32));
                matches!(wanted, 2 | 3).then(|| put_numbers(out, velocities.map(|v| v as f32)));
                (wanted == 3).then(|| put_numbers(out, self.torques()));
            }
            (43, _) => {
                let joints = self.inverse(numbers(data).ok_or(Warning(BAD_PARAMETER))?)?;
                put_numbers(out, joints.map(|v| v as f32));
            }
            (44, _) => {
                let joints = numbers::<7>(data).ok_or(Warning(BAD_PARAMETER))?.map(f64::from);
                put_numbers(out, to_wire(&self.tcp_of(self.chain.ok_or(NotNow)?, &joints)));
            }
            (45, _) => {
                let joints = numbers::<7>(data).ok_or(Warning(BAD_PARAMETER))?.map(f64::from);
                out.push(u8::from(!self.arm.is_within(&joints)));
            }
            (55, _) => put_numbers(out, self.torques()),
            (91, _) => put_numbers(out, to_wire_axis_angle(&self.pose().ok_or(NotNow)?)),
            (106, _) => {
                let failed = self.error().checked_sub(11).filter(|joint| *joint < 7);
                out.extend((0..8).flat_map(|joint| [0, if failed == Some(joint) { 23 } else { 0 }]));
            }
            (124, [TOOL, telegram @ ..]) => {
                let answer = self.telegram(telegram)?;
                out.extend([TOOL].into_iter().chain(answer));
            }
            (241, [TOOL, bytes @ ..]) if self.arm.takes_settings() => {
                // A device that is silent is no error: the box passes bytes on and does not know what they are.
                out.push(TOOL);
                out.extend(self.tool.pass(bytes));
            }
            (241, _) => return Err(NotNow),
            // Nothing is at the box's own bus, such as a linear track.
            (124, [BOX, ..]) if self.arm.takes_settings() => return Err(Error(BOX_SILENT)),
            (124, _) => return Err(NotNow),
            (125, _) => out.extend([0, self.tool.error as u8]),
            (127, [TOOL, a0, a1, ..]) => {
                let value = number(data, 3, 0).ok_or(Warning(BAD_PARAMETER))?;
                let (register, own) = (u16::from_be_bytes([*a0, *a1]), self.arm.takes_settings());
                self.tool.write(register, value, own).ok_or(NotNow)?;
            }
            (128, [TOOL, a0, a1]) => {
                let value = self.tool.read(u16::from_be_bytes([*a0, *a1])).ok_or(NotNow)?;
                out.extend(value.to_be_bytes());
            }
            (127 | 128, [_, ..]) => return Err(NotNow),
            (150 | 200, _) => put_numbers(out, if data == [1] { self.wrench().1 } else { self.wrench().0 }),
            _ if is_motion(register) => self.motion(register, data, out)?,
            (11 | 12 | 19, _) => return Err(Warning(BAD_PARAMETER)),
            _ => return Err(Warning(UNKNOWN)),
        }
        Ok(())
    }

    /// Returns the answer of the device at the tool.
    fn telegram(&mut self, telegram: &[u8]) -> Result<Vec<u8>, Refusal> {
        if let Some(answer) = self.tool.pass_modbus(telegram).filter(|_| self.arm.takes_settings()) {
            return Ok(answer);
        }
        if !self.tool.hears(telegram) {
            // An arm of a run is not stopped because a client looks for a device.
            return Err(if self.arm.takes_settings() { Error(TOOL_SILENT) } else { NotNow });
        }
        let answer = self.tool.telegram(telegram).ok_or(NotNow)?;
        if let Some((opening, speed)) = self.tool.take_order() {
            self.arm.move_gripper(opening, speed);
        }
        Ok(answer)
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
    pub(super) fn put_queue(&self, out: &mut Vec<u8>) {
        out.extend((self.queue.len() as u16).to_be_bytes());
    }

    fn switch(&mut self, joint: u8, on: bool) -> Result<(), Refusal> {
        if on && self.error() != 0 {
            return Err(NotNow);
        }
        match joint {
            8 => self.arm.switch(None, on)?,
            1.. if usize::from(joint) <= self.identity.axes => self.arm.switch(Some(usize::from(joint - 1)), on)?,
            _ => return Err(Warning(BAD_PARAMETER)),
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
            3 if self.state == state::PAUSED => {}
            4 => {
                self.arm.operational_stop();
                self.halt(state::STOPPED);
            }
            6 => self.halt(state::STOPPING),
            _ => return Err(NotNow),
        }
        Ok(())
    }

    fn set_mode(&mut self, mode: u8) {
        // A real box that is ready silently lands in mode 0 on its way from one streaming mode to another, and reports
        // success. This is kept: programs for a real arm have to deal with it.
        let real = self.arm.takes_settings();
        let silently_0 = real && self.state == state::STANDING && self.mode != 0 && mode != 0 && mode != self.mode;
        self.mode = match mode {
            _ if self.keeps_mode => self.mode,
            _ if silently_0 => 0,
            mode => mode,
        };
        self.halt(if self.arm.enabled() { state::CHANGED } else { state::STOPPED });
    }
}
