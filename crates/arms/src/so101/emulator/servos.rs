//! Six servos with their registers, on the joints of a simulated arm.

use std::f64::consts::TAU;

use super::wire::{ALL, Packet, packet, status};
use super::{PLAYABLE, RANGES, SPEED, SimOptions, limits};
use dimos_core::clock::Mono;
use dimos_core::joint::Joints;
use dimos_hardware::adapter::AdapterResult;
use dimos_hardware::registry::Truth;
use dimos_hardware::sim::arm::{Delivery, HasArm, SimArm};
use dimos_hardware::sim::faults::FaultKind;
use dimos_hardware::sim::stream::Controller;
use dimos_hardware::transport::Scan;

/// Number of registers, and of servos.
const REGISTERS: usize = 87;
const SERVOS: usize = 6;
/// Registers: EEPROM keeps its values without power; those from `READ_ONLY` on cannot be written.
const MODEL: usize = 3;
const ID: usize = 5;
const LOWEST: usize = 9;
const PHASE: usize = 18;
const PROPORTIONAL: usize = 21;
const OFFSET: usize = 31;
const RAM: usize = 40;
const TORQUE: usize = 40;
const GOAL: usize = 42;
const GOAL_SPEED: usize = 46;
const TORQUE_LIMIT: usize = 48;
const LOCK: usize = 55;
const READ_ONLY: std::ops::Range<usize> = 56..80;
/// Phase bit: positions count turns instead of beginning again after one.
const ALL_TURNS: u8 = 0x10;
/// Torque value that makes the present position the middle of the turn.
const MAKE_MIDDLE: u8 = 128;
/// Duty cycle for a count of distance, with a proportional part of 16 [0.1 %]: a load of a third of the stall torque
/// leaves 50 counts.
const DUTY_PER_COUNT: i32 = 7;
/// Counts of a turn, and the largest homing offset.
const TURN: i32 = 4096;
const MAX_OFFSET: i32 = 2047;
/// Speed at which joints without power fall [rad/s].
const FALLING: f64 = 0.4;

/// The servos of an arm.
pub struct Servos {
    arm: SimArm,
    registers: [[u8; REGISTERS]; SERVOS],
    /// What the registers come back with after a power loss: writes while the lock is set are not stored.
    stored: [[u8; REGISTERS]; SERVOS],
    /// Which servos are on the line.
    plugged: [bool; SERVOS],
    /// Writes that wait for the instruction `action`: servo, address, bytes.
    held: Vec<(usize, usize, Vec<u8>)>,
    /// Whether the line returns what is sent.
    echo: bool,
    /// Supply voltage [0.1 V].
    voltage: u8,
    /// The fault of a wrong model.
    wrong_model: bool,
    /// Which servos have a worn-out EEPROM, which keeps its values.
    worn: [bool; SERVOS],
    /// How far the encoder of a servo is off [counts], for how many readings.
    misread: [(i32, u32); SERVOS],
    /// Turns of the servos at the last check of their goals: behind the end of a turn a goal is somewhere else.
    turns: [i32; SERVOS],
    /// Instructions since the start.
    instructions: u64,
    /// A second arm on the same line.
    beside: Option<Box<Servos>>,
}

impl Servos {
    /// Creates servos that were just switched on.
    pub fn new(options: &SimOptions, now: Mono) -> AdapterResult<Self> {
        let limits = limits();
        let mut arm = SimArm::new("so101", &limits, &options.common(), PLAYABLE, now)?.without_modes();
        arm.load(SERVOS - 1);
        let mut registers = [[0; REGISTERS]; SERVOS];
        for ((servo, id), (low, high)) in
            registers.iter_mut().zip(1u8..).zip(limits.position_lower.iter().zip(&limits.position_upper))
        {
            let mut set = |address: usize, bytes: &[u8]| {
                servo.iter_mut().skip(address).zip(bytes).for_each(|(register, byte)| *register = *byte);
            };
            set(0, &[3, 10, 0, 0x09, 0x03, id, 0, 0, 1]);
            set(LOWEST, &(counts(*low).ceil() as u16).to_le_bytes());
            set(LOWEST + 2, &(counts(*high).floor() as u16).to_le_bytes());
            set(13, &[70, 140, 40, 0xE8, 0x03, 0x0C]);
            set(21, &[32, 32, 0]);
            set(34, &[20, 200, 80]);
            set(84, &[254, 254, 0]);
            if !options.factory {
                set(21, &[16]);
            }
            if !options.factory && id == SERVOS as u8 {
                set(16, &500u16.to_le_bytes());
                set(28, &250u16.to_le_bytes());
                set(36, &[25]);
            }
        }
        let mut servos = Self {
            arm,
            registers,
            stored: registers,
            plugged: [true; SERVOS],
            held: Vec::new(),
            echo: options.echo,
            voltage: (options.voltage * 10.0).round() as u8,
            wrong_model: false,
            worn: [false; SERVOS],
            misread: [(0, 0); SERVOS],
            turns: [0; SERVOS],
            instructions: 0,
            beside: None,
        };
        if let Some(rest) = options.ids.get(SERVOS..).filter(|rest| !rest.is_empty()) {
            let options = SimOptions { ids: rest.to_vec(), ..options.clone() };
            servos.beside = Some(Box::new(Self::new(&options, now)?));
        }
        for (servo, id) in options.ids.iter().take(SERVOS).enumerate() {
            servos.plug(servo, *id);
        }
        servos.power_up();
        Ok(servos)
    }

    /// The encoder of a servo (index from 0) is off by this many counts, for this number of readings of its position.
    pub fn misread(&mut self, servo: usize, by: i32, readings: u32) {
        self.misread.get_mut(servo).into_iter().for_each(|to| *to = (by, readings));
    }

    /// Puts a servo (index from 0) with this number on the line; 0 takes it off.
    pub fn plug(&mut self, servo: usize, id: u8) {
        self.plugged.iter_mut().skip(servo).take(1).for_each(|plugged| *plugged = id != 0);
        for bank in [&mut self.registers, &mut self.stored] {
            bank.iter_mut().skip(servo).take(1).for_each(|registers| registers[ID] = id.max(1));
        }
    }

    /// Wears out the EEPROM of a servo (index from 0), which then keeps its values, or replaces it.
    pub fn wear_out(&mut self, servo: usize, worn: bool) {
        self.worn.iter_mut().skip(servo).take(1).for_each(|state| *state = worn);
    }

    /// Returns the second arm of the line.
    pub fn beside(&mut self) -> Option<&mut Self> {
        self.beside.as_deref_mut()
    }

    /// Returns the angles of the servos [rad].
    pub fn angles(&self) -> Joints {
        self.arm.joints().0
    }

    /// Returns how many instructions have arrived.
    pub fn instructions(&self) -> u64 {
        self.instructions
    }

    /// Returns a register of a servo (index from 0) as it is after the next power loss.
    pub fn stored(&self, servo: usize, address: usize) -> u8 {
        self.stored.get(servo).and_then(|servo| servo.get(address)).copied().unwrap_or_default()
    }

    /// What is in RAM has its default.
    fn power_up(&mut self) {
        self.held.clear();
        self.registers = self.stored;
        for servo in &mut self.registers {
            servo.iter_mut().skip(RAM).take(16).for_each(|register| *register = 0);
            // The torque limit.
            let limit = [servo.get(16).copied(), servo.get(17).copied()].map(Option::unwrap_or_default);
            servo.iter_mut().skip(48).zip(limit).for_each(|(register, byte)| *register = byte);
            servo.iter_mut().skip(LOCK).take(1).for_each(|register| *register = 1);
        }
    }

    /// From now on upper arm and forearm fall without power, to the end of their range. At power-up they are supported.
    fn fall(&mut self) {
        let limits = limits();
        let (low, high) = (limits.position_lower.get(1).copied(), limits.position_upper.get(2).copied());
        self.arm.falls(FALLING, &[None, low, high, None, None, None]);
    }

    /// Returns a register of a servo (index from 0).
    pub fn byte(&self, servo: usize, address: usize) -> u8 {
        self.registers.get(servo).and_then(|servo| servo.get(address)).copied().unwrap_or_default()
    }

    fn word(&self, servo: usize, address: usize) -> u16 {
        u16::from_le_bytes([self.byte(servo, address), self.byte(servo, address + 1)])
    }

    /// The homing offset of a servo [counts].
    fn offset(&self, servo: usize) -> i32 {
        let word = i32::from(self.word(servo, OFFSET));
        if word & 0x800 == 0 { word & 0x7FF } else { -(word & 0x7FF) }
    }

    /// Position of a servo by its own offset [counts], and the turns that are not in it.
    fn position(&self, servo: usize) -> (i32, i32) {
        self.counted(servo, self.arm.joints().0.get(servo).copied().unwrap_or_default())
    }

    /// As above, for a servo at another angle [rad].
    fn counted(&self, servo: usize, angle: f64) -> (i32, i32) {
        let counted = counts(angle).round() as i32 - self.offset(servo);
        match self.byte(servo, PHASE) & ALL_TURNS {
            0 => (counted.rem_euclid(TURN), counted.div_euclid(TURN)),
            _ => (counted, 0),
        }
    }

    /// Duty cycle of a servo's motor [0.1 %], with its sign in bit 10: what its proportional part makes of the distance
    /// to its goal, which does not know the way over the end of the turn.
    fn load(&self, servo: usize) -> u16 {
        if !self.arm.motor(servo) {
            return 0;
        }
        let away = i32::from(self.word(servo, GOAL)) - self.position(servo).0;
        let duty = away * i32::from(self.byte(servo, PROPORTIONAL)) * DUTY_PER_COUNT / 16;
        let size = (duty.abs()).min(i32::from(self.word(servo, TORQUE_LIMIT))).min(1000) as u16;
        if duty < 0 { size | 0x400 } else { size }
    }

    /// The error bits of a servo.
    fn error(&self, servo: usize) -> u8 {
        self.arm.error_of(servo) as u8
    }

    /// What is read from registers of a servo.
    fn read(&mut self, servo: usize, address: usize, length: usize) -> Vec<u8> {
        let (mut angles, mut velocities) = self.arm.joints();
        self.arm.misread(&mut angles, &mut velocities);
        let of = |values: &Joints| values.get(servo).copied().unwrap_or_default();
        let (position, velocity) = (self.counted(servo, of(&angles)).0, of(&velocities));
        let mut all = self.registers.get(servo).copied().unwrap_or([0; REGISTERS]);
        let mut set = |address: usize, bytes: &[u8]| {
            all.iter_mut().skip(address).zip(bytes).for_each(|(register, byte)| *register = *byte);
        };
        if self.wrong_model {
            set(MODEL, &2825u16.to_le_bytes());
        }
        set(TORQUE, &[u8::from(self.arm.motor(servo))]);
        let (by, readings) = self.misread.get(servo).copied().unwrap_or_default();
        let shown = if readings > 0 { (position + by).rem_euclid(TURN) } else { position };
        set(56, &with_sign(shown).to_le_bytes());
        let speed = velocity * f64::from(TURN) / TAU;
        set(58, &with_sign(speed.round() as i32).to_le_bytes());
        let [low, high] = self.load(servo).to_le_bytes();
        set(
            60,
            &[
                low,
                high,
                self.voltage,
                SimArm::temperature(servo) as u8,
                u8::from(self.held.iter().any(|(held, ..)| *held == servo)),
                self.error(servo),
            ],
        );
        set(66, &[u8::from(speed.abs() > 3.0)]);
        (address..address + length).map(|i| all.get(i).copied().unwrap_or_default()).collect()
    }

    /// What a servo answers to a request for registers.
    fn answer(&mut self, servo: usize, address: usize, length: usize) -> Vec<u8> {
        let data = self.read(servo, address, length);
        if (address..address + length).contains(&56) {
            self.misread.get_mut(servo).into_iter().for_each(|(_, readings)| *readings = readings.saturating_sub(1));
        }
        data
    }

    /// Writes registers of a servo, as far as they can be written.
    fn write(&mut self, servo: usize, address: usize, values: &[u8]) {
        let (Some(registers), Some(stored)) = (self.registers.get_mut(servo), self.stored.get_mut(servo)) else {
            return;
        };
        let makes_middle = address == TORQUE && values.first() == Some(&MAKE_MIDDLE);
        let lowest = if self.worn.get(servo) == Some(&true) { RAM } else { 0 };
        for (i, value) in (address..).zip(values).filter(|(i, _)| *i >= lowest && !READ_ONLY.contains(i)) {
            if let Some(register) = registers.get_mut(i).filter(|_| !(makes_middle && i == TORQUE)) {
                *register = *value;
            }
        }
        if registers.get(LOCK) == Some(&0) {
            stored
                .iter_mut()
                .zip(registers.iter())
                .enumerate()
                .filter(|(i, _)| !(RAM..READ_ONLY.end).contains(i))
                .for_each(|(_, (stored, register))| *stored = *register);
        }
        if makes_middle {
            let (position, turns) = self.position(servo);
            let offset = (position + turns * TURN + self.offset(servo) - TURN / 2).clamp(-MAX_OFFSET, MAX_OFFSET);
            let word = offset.unsigned_abs() as u16 | if offset < 0 { 0x800 } else { 0 };
            return self.write(servo, OFFSET, &word.to_le_bytes());
        }
        let touches = |register: usize| (address..address + values.len()).contains(&register);
        if touches(TORQUE) {
            let on = self.byte(servo, TORQUE) == 1;
            if !on && self.error(servo) != 0 {
                let _ = self.arm.clear_error();
            }
            if on != self.arm.motor(servo) {
                self.arm.enable_joint(servo, on);
                if !on {
                    self.fall();
                }
            }
        }
    }

    /// Sends the joints to the goals in the registers. A servo whose goal is where it is has no overload, nor has one
    /// that is switched off.
    fn go(&mut self) {
        let mut goals = [0.0; SERVOS];
        let (positions, velocities) = self.arm.joints();
        for (servo, ((goal, position), velocity)) in goals.iter_mut().zip(&positions).zip(&velocities).enumerate() {
            let (low, high) = (self.word(servo, LOWEST), self.word(servo, LOWEST + 2));
            let wanted = self.word(servo, GOAL).max(low).min(high.max(low));
            // The way there never leads over the end of the turn.
            let turns = self.position(servo).1 * TURN;
            *goal = radians(f64::from(i32::from(wanted) + self.offset(servo) + turns));
            let stop = RANGES.get(servo).copied().unwrap_or_default();
            *goal = goal.max(stop.0).min(stop.1);
            // A joint at rest less than a count away stays.
            if velocity.abs() < 1e-3 && (*goal - position).abs() < radians(2049.0) {
                *goal = *position;
            }
        }
        let near = |servo: usize| {
            let off = goals.get(servo).zip(positions.get(servo)).map_or(0.0, |(goal, position)| goal - position);
            off.abs() < 0.01
        };
        if (0..SERVOS).any(|servo| self.error(servo) != 0 && near(servo)) {
            let _ = self.arm.clear_error();
        }
        for servo in 0..SERVOS {
            let speed = f64::from(self.word(servo, GOAL_SPEED)) * TAU / f64::from(TURN);
            self.arm.limit_speed(servo, if speed > 0.0 { speed.min(SPEED) } else { SPEED });
        }
        if self.arm.error() == 0 {
            self.arm.take_goal(&goals, 1.0, self.word(0, GOAL_SPEED) == 0);
        }
    }

    /// Takes a packet of the line.
    fn hear(&mut self, Packet { id, instruction, parameters }: &Packet, now: Mono, answer: &mut Vec<u8>) {
        self.arm.client_came();
        self.arm.advance(now);
        let turns = std::array::from_fn(|servo| self.position(servo).1);
        if turns != std::mem::replace(&mut self.turns, turns) {
            self.go();
        }
        if self.arm.take_fault(FaultKind::WrongModel).is_some() {
            self.wrong_model = true;
        }
        // Writes to several servos have no status.
        let unanswered = matches!((*id, *instruction), (_, 0x83) | (ALL, 0x03..=0x05));
        if !(unanswered && self.arm.loses_command()) {
            self.execute(*id, *instruction, parameters, answer);
        }
    }

    /// Executes an instruction; puts statuses into `answer`.
    pub fn execute(&mut self, id: u8, instruction: u8, parameters: &[u8], answer: &mut Vec<u8>) {
        self.instructions += 1;
        let (ids, plugged) = (self.registers.map(|registers| registers[ID]), self.plugged);
        let on_line = (0..SERVOS).zip(ids).filter(|(servo, _)| plugged.get(*servo) == Some(&true));
        let listed = |id: u8| { on_line.clone() }.find(|(_, own)| *own == id).map(|(servo, _)| servo);
        match (instruction, parameters) {
            (0x01, []) => {
                let pinged = { on_line }.filter(|(_, own)| id == ALL || id == *own);
                pinged.for_each(|(servo, own)| status(answer, own, self.error(servo), &[]));
            }
            (0x02, [address, length]) => {
                if let Some(servo) = listed(id) {
                    let data = self.answer(servo, (*address).into(), (*length).into());
                    status(answer, id, self.error(servo), &data);
                }
            }
            (0x03 | 0x04, [address, values @ ..]) => {
                let answers = listed(id);
                let chosen: Vec<usize> =
                    { on_line }.filter(|(_, own)| [ALL, *own].contains(&id)).map(|(s, _)| s).collect();
                for servo in &chosen {
                    if instruction == 0x03 {
                        self.write(*servo, (*address).into(), values);
                    } else {
                        self.held.push((*servo, (*address).into(), values.to_vec()));
                    }
                }
                if instruction == 0x03 {
                    self.go();
                }
                // With the number that the request had, also if it was changed.
                if let Some(servo) = answers {
                    status(answer, id, self.error(servo), &[]);
                }
            }
            (0x05, []) => {
                for (servo, address, values) in std::mem::take(&mut self.held) {
                    self.write(servo, address, &values);
                }
                self.go();
            }
            (0x82, [address, length, ids @ ..]) => {
                for (id, servo) in ids.iter().filter_map(|id| Some((*id, listed(*id)?))) {
                    let data = self.answer(servo, (*address).into(), (*length).into());
                    status(answer, id, self.error(servo), &data);
                }
            }
            (0x83, [address, length, values @ ..]) => {
                for chunk in values.chunks_exact(usize::from(*length) + 1) {
                    if let [id, values @ ..] = chunk
                        && let Some(servo) = listed(*id)
                    {
                        self.write(servo, (*address).into(), values);
                    }
                }
                self.go();
            }
            _ => {}
        }
    }
}

/// Position of an angle [counts], zero in the middle of the turn.
fn counts(angle: f64) -> f64 {
    2048.0 + angle * 4096.0 / TAU
}

/// Angle of a position [rad].
fn radians(counts: f64) -> f64 {
    (counts - 2048.0) * TAU / 4096.0
}

/// A number with its sign in the highest bit.
fn with_sign(value: i32) -> u16 {
    let size = value.unsigned_abs().min(0x7FFF) as u16;
    if value < 0 { size | 0x8000 } else { size }
}

impl HasArm for Servos {
    fn arm(&mut self) -> &mut SimArm {
        &mut self.arm
    }

    /// The gripper's position counts from closed, the end of its range.
    fn complete(&self, truth: &mut Truth) {
        let closed = RANGES.last().map_or(0.0, |range| range.0);
        let angles = self.arm.joints().0;
        truth.gripper_position = angles.get(SERVOS - 1).map(|angle| angle - closed);
    }
}

impl Controller for Servos {
    fn serve(&mut self, bytes: &[u8], now: Mono, answer: &mut Vec<u8>) -> Scan<Delivery> {
        let (packet, length) = match packet(bytes) {
            Scan::More => return Scan::More,
            Scan::Skip(n) => return Scan::Skip(n),
            Scan::Take(n, packet) => (packet, n),
        };
        self.hear(&packet, now, answer);
        if let Some(beside) = &mut self.beside {
            beside.hear(&packet, now, answer);
        }
        // Only what is answered can be lost.
        let delivery = if answer.is_empty() { Delivery::Send } else { self.arm.delivery() };
        if matches!(delivery, Delivery::PowerLoss(_)) {
            self.power_up();
            self.beside.iter_mut().for_each(|beside| beside.power_up());
        }
        if self.echo {
            drop(answer.splice(0..0, bytes.iter().take(length).copied()));
        }
        Scan::Take(length, delivery)
    }

    /// Servos do not know their client.
    fn client_gone(&mut self, now: Mono) {
        self.arm.advance(now);
        self.beside.iter_mut().for_each(|beside| beside.arm.advance(now));
    }
}
