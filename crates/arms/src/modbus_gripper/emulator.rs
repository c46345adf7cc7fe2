//! A gripper with the registers of a blueprint, and simulated fingers. What a register map says is all that it knows: a
//! wrong map shows only at the gripper itself.

use std::collections::BTreeMap;

use super::{BAUD, Flag, Needed, Options};
use dimos_core::clock::Mono;
use dimos_hardware::adapter::AdapterResult;
use dimos_hardware::registry::{AdapterConfig, EmulatorAddress, Truth};
use dimos_hardware::sim::arm::Delivery;
use dimos_hardware::sim::faults::{FaultKind, joined};
use dimos_hardware::sim::gripper::Gripper;
use dimos_hardware::sim::modbus::{self, NO_REGISTER, Registers};
use dimos_hardware::sim::peripheral_server::{Emulated, PeripheralServer, WIRE_FAULTS, WireFaults};
use dimos_hardware::sim::stream::Controller;
use dimos_hardware::transport::Scan;
use dimos_hardware::transport::line::LineAddress;
use dimos_hardware::transport::modbus::{Framing, Table};

/// The faults that it can play.
pub const PLAYABLE: &[FaultKind] = &joined::<9>(&WIRE_FAULTS, &[FaultKind::Object, FaultKind::GripperBlocked]);
/// Time to open fully, and to be homed [s].
const OPENING_TIME: f64 = 0.5;
const HOMING_TIME: f64 = 1.0;

/// An emulated gripper.
pub struct Fingers {
    options: Options,
    needed: Needed,
    framing: Framing,
    /// From closed (0) to open: a distance from the closed position.
    gripper: Gripper,
    /// What was written.
    written: BTreeMap<u16, u16>,
    /// Since when it is being homed; it is homed after [`HOMING_TIME`].
    homing: Option<Mono>,
    homed: bool,
    faults: WireFaults,
    advanced_to: Option<Mono>,
}

impl Fingers {
    /// Puts an object of this width [m or rad] between the fingers; 0 takes it away.
    pub fn put_object(&mut self, width: f64) {
        self.gripper.put_object(width);
    }

    fn span(&self) -> f64 {
        let [closed, open] = self.needed.range;
        open - closed
    }

    fn advance(&mut self, now: Mono) {
        let dt = self.advanced_to.map_or(0.0, |before| now.seconds_since(before));
        self.advanced_to = Some(now);
        let faults = &mut self.faults;
        self.gripper.play(|kind| faults.take(kind, now));
        self.gripper.advance(dt);
        if self.homing.is_some_and(|since| now.seconds_since(since) > HOMING_TIME) {
            (self.homing, self.homed) = (None, true);
        }
    }

    /// Returns the contents of a register; `None` if the map has no such.
    fn contents(&self, table: Table, register: u16) -> Option<u16> {
        let has = |flag: &Option<Flag>| {
            flag.as_ref().filter(|flag| (flag.table, flag.register) == (table, register)).cloned()
        };
        let said = |flag: Flag, so: bool| {
            let other = (0..=u16::MAX).find(|contents| !flag.holds(*contents)).unwrap_or_default();
            if so { flag.is.first().copied().unwrap_or_default() } else { other }
        };
        let position = self.needed.position;
        if (position.table, position.register) == (table, register) {
            let share = self.gripper.position / self.span().abs();
            let (low, high) = (f64::from(position.closed), f64::from(position.open));
            return Some((low + share * (high - low)).round() as u16);
        }
        has(&self.options.homed)
            .map(|flag| said(flag, self.homed))
            .or_else(|| has(&self.options.holds).map(|flag| said(flag, self.gripper.gripping())))
            .or_else(|| has(&self.options.fault).map(|flag| said(flag, false)))
            .or_else(|| self.written.get(&register).copied().filter(|_| table == Table::Holding))
    }

    /// Returns whether the map has a holding register that is written.
    fn is_writable(&self, register: u16) -> bool {
        let options = &self.options;
        let writes = options.then.iter().chain(&options.home).map(|write| write.register);
        let values =
            options.force.map(|force| force.register).into_iter().chain(options.speed.map(|speed| speed.register));
        writes.chain(values).chain([self.needed.target.register]).any(|known| known == register)
    }
}

impl Registers for Fingers {
    fn read(&mut self, input: bool, first: u16, count: u16, _now: Mono) -> Result<Vec<u16>, u8> {
        let table = if input { Table::Input } else { Table::Holding };
        (first..first.saturating_add(count)).map(|r| self.contents(table, r).ok_or(NO_REGISTER)).collect()
    }

    fn write(&mut self, first: u16, values: &[u16], now: Mono) -> Result<(), u8> {
        for (register, value) in (first..).zip(values) {
            if !self.is_writable(register) {
                return Err(NO_REGISTER);
            }
            self.written.insert(register, *value);
            if self.options.home.last().is_some_and(|last| (last.register, last.value) == (register, *value)) {
                (self.homing, self.homed) = (Some(now), false);
            }
            let target = self.needed.target;
            if register == target.register && (self.homed || self.options.homed.is_none()) {
                let (low, high) = (f64::from(target.closed), f64::from(target.open));
                self.gripper.move_to((f64::from(*value) - low) / (high - low) * self.span().abs());
            }
        }
        Ok(())
    }
}

impl Controller for Fingers {
    fn serve(&mut self, bytes: &[u8], now: Mono, answer: &mut Vec<u8>) -> Scan<Delivery> {
        self.faults.requested(now);
        self.advance(now);
        let (framing, unit) = (self.framing, self.options.unit);
        modbus::serve(framing, unit, bytes, now, self, answer).map(|()| {
            let delivery = self.faults.delivery(now);
            if matches!(delivery, Delivery::PowerLoss(_)) {
                (self.homing, self.homed) = (None, false);
                self.gripper.rest();
            }
            delivery
        })
    }

    fn client_gone(&mut self, _now: Mono) {}
}

impl Emulated for Fingers {
    fn faults(&mut self) -> &mut WireFaults {
        &mut self.faults
    }

    fn truth(&mut self, now: Mono) -> Truth {
        self.advance(now);
        let [closed, _] = self.needed.range;
        Truth { gripper_position: Some(closed + self.gripper.position * self.span().signum()), ..Truth::default() }
    }
}

/// Starts an emulator.
pub fn start(config: &AdapterConfig, place: &EmulatorAddress) -> AdapterResult<PeripheralServer<Fingers>> {
    let (options, needed) = Options::read(config)?;
    let tcp = options.framing == Some(Framing::Tcp) || matches!(place, EmulatorAddress::Bind(_));
    let given = LineAddress::parse(&config.address, BAUD).ok();
    let framing = match (options.framing, given) {
        (None, Some(address)) => Framing::at(&address, None),
        (framing, _) => framing.unwrap_or(if tcp { Framing::Tcp } else { Framing::Rtu }),
    };
    let [closed, open] = needed.range;
    let span = (open - closed).abs();
    let fingers = Fingers {
        gripper: Gripper::new(span, span / OPENING_TIME),
        written: BTreeMap::new(),
        homing: None,
        homed: false,
        faults: WireFaults::new("modbus_gripper", PLAYABLE, &options.sim.faults),
        advanced_to: None,
        framing,
        options,
        needed,
    };
    PeripheralServer::start("modbus_gripper", fingers, place, 502, tcp)
}
