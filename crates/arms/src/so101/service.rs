//! The servos outside a run: numbers, settings, and a calibration that LeRobot and dimos share.
//!
//! As in LeRobot, the homing offset of each servo makes the middle pose read 2047, and the ranges are recorded by hand.
//! Unlike there, nothing is written before all of it is known and saved: an interrupted calibration changes no servo,
//! and one that failed halfway is written again from its file.

use std::path::Path;
use std::time::Duration;

use super::bus::Bus;
use super::calibration::{Calibration, NAMES, Servo, file};
use super::protocol::{self, BROADCAST, Instruction, MAX_INSTRUCTION, SERVOS, register, signed, with_sign};
use super::settings;
use dimos_hardware::adapter::{AdapterError, AdapterResult};
use dimos_hardware::registry::AdapterConfig;
use dimos_hardware::service::{Motor, Service, Setting, Single};
use dimos_hardware::transport::request_reply::Retry;

/// Counts of a turn, and what the middle pose reads.
const TURN: i32 = 4096;
const MIDDLE: i32 = 2047;
/// Largest homing offset that a servo takes, in either direction.
const MAX_OFFSET: i32 = 2047;
/// A position that differs by less from the expected one has the expected offset: a limp arm moves a little.
const MOVED: i32 = 200;
/// Rates of the line [bit/s], each at the value that selects it in the servos; the first one is the factory's.
const RATES: [u32; 8] = [1_000_000, 500_000, 250_000, 128_000, 115_200, 76_800, 57_600, 38_400];
/// How long all servos may take to answer a ping.
const PING: Retry = Retry::once(Duration::from_millis(150));
/// A servo writes its EEPROM, and changes its rate, in this time.
const SETTLE: Duration = Duration::from_millis(50);

/// The joint that may turn without end stops.
const WRIST: &str = "wrist_roll";

/// Returns the offset that puts the middle of a range at [`MIDDLE`], and the range then: the seam of the encoder is
/// opposite, outside the travel where there is room.
fn centred(offset: i32, (low, high): (i32, i32)) -> (i32, i32, i32) {
    let by = if (low, high) == (0, TURN - 1) { 0 } else { (low + high) / 2 - MIDDLE };
    // Half a turn is no offset: one count beside it is as good.
    let centred = (offset + by + MAX_OFFSET).rem_euclid(TURN) - MAX_OFFSET;
    let by = by - i32::from(centred > MAX_OFFSET);
    (centred.min(MAX_OFFSET), low - by, high - by)
}

/// The servos' line.
struct Servos {
    bus: Bus,
    motors: &'static [Motor],
    /// Homing offsets that make the middle pose read [`MIDDLE`].
    offsets: Option<[i32; SERVOS]>,
}

/// Opens the line.
pub fn open(config: &AdapterConfig) -> AdapterResult<Box<dyn Service>> {
    let mut bus = Bus::new(config)?.patient();
    bus.open()?;
    let motor = |(id, name)| Motor { name, id, range: (name == WRIST).then_some((0, TURN - 1)) };
    // A program has one service, and keeps it to its end.
    let motors = bus.ids().zip(NAMES).map(motor).collect::<Vec<_>>().leak();
    Ok(Box::new(Servos { bus, motors, offsets: None }))
}

impl Servos {
    /// Reads what an encoder shows without the offset [counts].
    fn encoder(&mut self, id: u8) -> AdapterResult<i32> {
        let offset = self.offset(id)?;
        let position = signed(u16::from_le_bytes(self.bus.read(id, register::POSITION)?), 15);
        Ok((position + offset).rem_euclid(TURN))
    }

    fn offset(&mut self, id: u8) -> AdapterResult<i32> {
        Ok(signed(u16::from_le_bytes(self.bus.read(id, register::OFFSET)?), 11))
    }

    /// Returns the arm's rate: that of the address [bit/s], and the value that selects it in the servos.
    fn own_rate(&self) -> AdapterResult<(u8, u32)> {
        let wanted = self.bus.address().baud;
        let found = (0..).zip(RATES).find(|(_, rate)| *rate == wanted);
        found.ok_or_else(|| {
            let rates = RATES.map(|rate| rate.to_string()).join(", ");
            AdapterError::Rejected(format!("the servos have no rate of {wanted} bit/s\nhint: their rates: {rates}"))
        })
    }

    fn refuse_while_on(&mut self) -> AdapterResult<()> {
        match self.powered()?.as_slice() {
            [] => Ok(()),
            on => Err(AdapterError::Rejected(format!("motors are on: {}", on.join(", ")))),
        }
    }

    /// Writes offset and range of a servo; returns whether it had others.
    fn write_servo(&mut self, id: u8, to: &Servo) -> AdapterResult<bool> {
        let before = self.encoder(id)?;
        let words = [with_sign(to.homing_offset, 11), to.range_min as u16, to.range_max as u16].map(u16::to_le_bytes);
        let [offset, low, high] = words;
        let changed = self.bus.unlocked(id, |bus| {
            let new_offset = bus.set(id, register::OFFSET, offset)?;
            let new_low = bus.set(id, register::RANGE, low)?;
            Ok(bus.set(id, register::RANGE + 2, high)? || new_low || new_offset)
        })?;
        // What the register keeps must also be what the position follows.
        let turned = (self.encoder(id)? - before + TURN / 2).rem_euclid(TURN) - TURN / 2;
        if turned.abs() > MOVED {
            let what = format!("{} reads {turned} counts more than its new offset makes", self.bus.servo(id));
            return Err(AdapterError::Protocol(what));
        }
        Ok(changed)
    }

    /// Returns the numbers of all servos that answer at the line's present rate.
    fn ping(&mut self) -> AdapterResult<Vec<u8>> {
        let mut frame = [0; MAX_INSTRUCTION];
        let frame = protocol::encode(Instruction::Ping(BROADCAST), &mut frame);
        let mut found = Vec::new();
        let scan = |bytes: &[u8]| protocol::scan(bytes, 0..=252, 0).map(|status| status.id);
        // More than can answer: all of the time is waited for.
        let all = self.bus.line.gather(frame, PING, 253, scan, |id| {
            found.push(id);
            true
        });
        match all {
            Ok(()) | Err(AdapterError::Timeout(_)) => Ok(found),
            Err(error) => Err(error),
        }
    }
}

impl Service for Servos {
    fn motors(&self) -> &'static [Motor] {
        self.motors
    }

    fn identify(&mut self) -> AdapterResult<String> {
        let mut firmware = (0, 0);
        for motor in self.motors {
            firmware = self.bus.identify(motor.id)?;
        }
        Ok(format!("SO-101: {SERVOS} servos STS3215, firmware {}.{}", firmware.0, firmware.1))
    }

    fn powered(&mut self) -> AdapterResult<Vec<&'static str>> {
        let mut on = Vec::new();
        for motor in self.motors {
            if self.bus.read::<1>(motor.id, register::TORQUE)? != [0] {
                on.push(motor.name);
            }
        }
        Ok(on)
    }

    fn release(&mut self) -> AdapterResult<()> {
        self.motors.iter().try_for_each(|motor| self.bus.set(motor.id, register::TORQUE, [0]).map(drop))
    }

    fn take_middle(&mut self) -> AdapterResult<()> {
        let mut offsets = [0; SERVOS];
        for (offset, motor) in offsets.iter_mut().zip(self.motors) {
            *offset = self.encoder(motor.id)? - MIDDLE;
            if *offset > MAX_OFFSET {
                let what =
                    format!("{} is exactly half a turn from what its offset can reach", self.bus.servo(motor.id));
                return Err(AdapterError::Rejected(format!("{what}\nhint: move that joint by a degree")));
            }
        }
        self.offsets = Some(offsets);
        Ok(())
    }

    fn positions(&mut self) -> AdapterResult<Vec<i32>> {
        let (motors, offsets) = (self.motors, self.offsets.unwrap_or_default());
        let position = |(motor, offset): (&Motor, i32)| Ok((self.encoder(motor.id)? - offset).rem_euclid(TURN));
        motors.iter().zip(offsets).map(position).collect()
    }

    fn calibration(&self, ranges: &[(i32, i32)]) -> AdapterResult<String> {
        let offsets = self.offsets.ok_or_else(|| AdapterError::Rejected("no middle pose was taken".into()))?;
        let mut servos = [Servo::default(); SERVOS];
        for (((servo, motor), offset), range) in servos.iter_mut().zip(self.motors).zip(offsets).zip(ranges) {
            let (homing_offset, range_min, range_max) = centred(offset, *range);
            *servo = Servo { id: motor.id, drive_mode: 0, homing_offset, range_min, range_max };
        }
        let text = file(&servos);
        // What the adapter would not read is not saved.
        Calibration::parse(&text, self.bus.first()).map_err(AdapterError::Rejected)?;
        Ok(text)
    }

    fn write_calibration(&mut self, path: &Path) -> AdapterResult<Vec<&'static str>> {
        let servos = Calibration::read(path, self.bus.first()).map_err(AdapterError::Rejected)?;
        self.refuse_while_on()?;
        let mut changed = Vec::new();
        for (motor, to) in self.motors.iter().zip(&servos) {
            if self.write_servo(motor.id, to)? {
                changed.push(motor.name);
            }
        }
        Ok(changed)
    }

    fn settings(&mut self) -> AdapterResult<Vec<Setting>> {
        settings::check(&mut self.bus)
    }

    fn write_settings(&mut self) -> AdapterResult<()> {
        self.refuse_while_on()?;
        settings::write(&mut self.bus)
    }

    fn find_single(&mut self) -> AdapterResult<Single> {
        let (_, own) = self.own_rate()?;
        // The arm's rate comes first: a port that cannot be opened at that one is an error.
        self.bus.open_at(own)?;
        for baud in std::iter::once(own).chain(RATES.into_iter().filter(|baud| *baud != own)) {
            // A rate that the port cannot have is one that no servo on it has.
            if baud != own && self.bus.open_at(baud).is_err() {
                continue;
            }
            match self.ping()?.as_slice() {
                [] => {}
                [id] => {
                    self.bus.identify(*id)?;
                    return Ok(Single { id: *id, baud });
                }
                several => {
                    let what = format!("{} servos answer: {several:?}", several.len());
                    return Err(AdapterError::Rejected(format!("{what}\nhint: leave one connected to the board")));
                }
            }
        }
        let what = format!("no servo answers at {}", self.bus.address().path);
        Err(AdapterError::Timeout(format!("{what}\nhint: is it powered, and connected with its three-wire cable?")))
    }

    fn assign(&mut self, single: &Single, motor: &Motor) -> AdapterResult<()> {
        let (old, new) = (single.id, motor.id);
        let (code, rate) = self.own_rate()?;
        self.bus.set(old, register::TORQUE, [0])?;
        self.bus.set(old, register::LOCK, [0])?;
        if old != new {
            // Its status may be lost, and has the old number: what counts is that the new one answers.
            let _ = self.bus.write(old, register::ID, &[new]);
            std::thread::sleep(SETTLE);
            self.bus.read::<1>(new, register::ID)?;
        }
        if single.baud != rate {
            let _ = self.bus.write(new, register::RATE, &[code]);
            std::thread::sleep(SETTLE);
            self.bus.open_at(rate)?;
        }
        self.bus.set(new, register::RATE, [code])?;
        self.bus.set(new, register::LOCK, [1])?;
        match self.ping()?.as_slice() {
            [id] if *id == new => Ok(()),
            found => Err(AdapterError::Protocol(format!("servo {new} was set up, but {found:?} answer"))),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_middle_of_the_travel_is_the_middle_of_the_turn() {
        assert_eq!(centred(0, (600, 3200)), (-147, 747, 3347));
        assert_eq!(centred(10, (0, 4095)), (10, 0, 4095), "no end stops");
        for offset in -2047..=2047 {
            for (low, high) in [(0, 1000), (3000, 4095), (40, 4000), (2046, 2050)] {
                let (to, least, most) = centred(offset, (low, high));
                assert!((-2047..=2047).contains(&to) && ((least + most) / 2 - MIDDLE).abs() <= 1, "{offset} {low}");
                // The same places of the encoder.
                assert_eq!((least + to - low - offset).rem_euclid(TURN), 0);
                assert_eq!(most - least, high - low);
            }
        }
    }
}
