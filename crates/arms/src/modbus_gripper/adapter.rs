//! A gripper by its registers.

use std::time::Duration;

use super::{BAUD, Flag, Force, Needed, Options, Value};
use dimos_core::arm::{ForceUnit, GripperUnit};
use dimos_hardware::adapter::{AdapterError, AdapterResult, Gripper};
use dimos_hardware::adapter_util::within;
use dimos_hardware::peripheral::{Condition, Peripheral, PeripheralInfo};
use dimos_hardware::registry::AdapterConfig;
use dimos_hardware::transport::line::LineAddress;
use dimos_hardware::transport::modbus::{Framing, ModbusClient, Table};
use dimos_hardware::transport::request_reply::Retry;

const CONNECT_TIMEOUT: Duration = Duration::from_secs(2);
const RETRY: Retry = Retry { each: Duration::from_millis(150), times: 2 };
/// Positions this far outside the range are within it: they are rounded in files [m or rad].
const SAME: f64 = 1e-6;
/// What a fault code of its own means is in its manual.
const FAULT: &str = "see its manual";

/// A gripper.
pub struct ModbusGripper {
    options: Options,
    needed: Needed,
    arm: String,
    address: LineAddress,
    client: ModbusClient,
    position: Option<f64>,
    holds: Option<bool>,
    condition: Condition,
    speed: Option<f64>,
    /// Homing was begun and is not done.
    homing: bool,
}

impl ModbusGripper {
    /// Creates the adapter of a gripper. Does not connect.
    pub fn new(config: &AdapterConfig) -> AdapterResult<Self> {
        let (options, needed) = Options::read(config)?;
        let address = LineAddress::parse(&config.address, BAUD).map_err(AdapterError::Rejected)?;
        let client = ModbusClient::new("the gripper", options.unit, Framing::at(&address, options.framing), RETRY);
        Ok(Self {
            options,
            needed,
            arm: config.hardware_id.clone(),
            address,
            client,
            position: None,
            holds: None,
            condition: Condition::NotHomed,
            speed: None,
            homing: false,
        })
    }

    fn contents(&mut self, table: Table, register: u16) -> AdapterResult<u16> {
        let mut contents = [0];
        self.client.read(table, register, &mut contents)?;
        let [contents] = contents;
        Ok(contents)
    }

    fn flag(&mut self, flag: Option<Flag>) -> AdapterResult<Option<(bool, u16)>> {
        let Some(flag) = flag else { return Ok(None) };
        let contents = self.contents(flag.table, flag.register)?;
        Ok(Some((flag.holds(contents), contents)))
    }

    fn go(&mut self, position: f64, force: Option<f64>) -> AdapterResult<()> {
        let (Needed { range: [closed, open], target, .. }, options) = (self.needed, &self.options);
        let ends = (closed.min(open) - SAME, closed.max(open) + SAME);
        within("gripper position", position, ends, options.position_unit.name())?;
        self.condition.ready(&self.arm)?;
        let mut writes = Vec::new();
        if let Some(Force { register, range: [least, most], counts: [low, high], default, .. }) = options.force {
            let share = (force.unwrap_or(default) - least) / (most - least);
            writes.push((register, between(low, high, share)));
        }
        if let Some(speed) = options.speed {
            let [low, high] = speed.counts;
            writes.push((speed.register, between(low, high, self.speed.unwrap_or(speed.default))));
        }
        writes.push((target.register, between(target.closed, target.open, (position - closed) / (open - closed))));
        writes.extend(options.then.iter().map(|write| (write.register, write.value)));
        writes.into_iter().try_for_each(|(register, value)| self.client.write(register, &[value]))
    }
}

/// Returns the contents of a register at a share of the way from `low` to `high`.
fn between(low: u16, high: u16, share: f64) -> u16 {
    (f64::from(low) + share.clamp(0.0, 1.0) * (f64::from(high) - f64::from(low))).round() as u16
}

impl Peripheral for ModbusGripper {
    fn connect(&mut self) -> AdapterResult<PeripheralInfo> {
        self.client.connect(&self.address, CONNECT_TIMEOUT)?;
        self.read().inspect_err(|_| self.disconnect())?;
        Ok(PeripheralInfo { model: "Modbus gripper".into(), ..PeripheralInfo::default() })
    }

    fn disconnect(&mut self) {
        self.client.close();
        (self.position, self.holds, self.homing) = (None, None, false);
    }

    fn is_connected(&self) -> bool {
        self.client.is_open()
    }

    fn read(&mut self) -> AdapterResult<()> {
        (self.position, self.holds) = (None, None);
        let Needed { range: [closed, open], position: Value { register, table, closed: low, open: high }, .. } =
            self.needed;
        let contents = f64::from(self.contents(table, register)?);
        let share = (contents - f64::from(low)) / (f64::from(high) - f64::from(low));
        let fault = self.flag(self.options.fault.clone())?;
        let homed = self.flag(self.options.homed.clone())?;
        let holds = self.flag(self.options.holds.clone())?;
        let is_homed = homed.is_none_or(|(homed, _)| homed);
        self.homing &= !is_homed;
        self.condition = match fault {
            Some((true, code)) => Condition::Fault(code.into(), FAULT),
            _ if is_homed => Condition::Ready,
            _ if self.homing => Condition::Homing,
            _ => Condition::NotHomed,
        };
        self.position = is_homed.then_some(closed + share * (open - closed));
        self.holds = holds.map(|(holds, _)| holds);
        Ok(())
    }

    fn condition(&self) -> Condition {
        self.condition
    }

    fn home(&mut self) -> AdapterResult<()> {
        if self.options.home.is_empty() {
            return Err(AdapterError::Unsupported);
        }
        for write in self.options.home.clone() {
            self.client.write(write.register, &[write.value])?;
        }
        (self.homing, self.condition) = (true, Condition::Homing);
        Ok(())
    }

    fn waits_for_arm(&self) -> bool {
        matches!(self.address, LineAddress::UrTool(_))
    }

    fn gripper(&mut self) -> Option<&mut dyn Gripper> {
        Some(self)
    }
}

impl Gripper for ModbusGripper {
    fn get_gripper_unit(&self) -> GripperUnit {
        self.options.position_unit
    }

    fn read_gripper_position(&mut self) -> AdapterResult<Option<f64>> {
        Ok(self.position)
    }

    fn write_gripper_position(&mut self, position: f64) -> AdapterResult<()> {
        self.go(position, None)
    }

    fn get_gripper_range(&mut self) -> Option<(f64, f64)> {
        Some(self.needed.range.into())
    }

    fn get_gripper_force_unit(&self) -> ForceUnit {
        self.options.force.map_or(ForceUnit::Newtons, |force| force.unit)
    }

    fn get_gripper_force_range(&mut self) -> Option<(f64, f64)> {
        Some(self.options.force?.range.into())
    }

    fn write_gripper_position_with_force(&mut self, position: f64, force: f64) -> AdapterResult<()> {
        let Some(Force { range, unit, .. }) = self.options.force else { return Err(AdapterError::Unsupported) };
        self.go(position, Some(within("gripper force", force, range.into(), unit.name())?))
    }

    fn read_gripper_holds(&mut self) -> AdapterResult<Option<bool>> {
        Ok(self.holds)
    }

    fn has_gripper_speed(&self) -> bool {
        self.options.speed.is_some()
    }

    fn set_gripper_speed(&mut self, fraction: Option<f64>) {
        self.speed = fraction;
    }
}
