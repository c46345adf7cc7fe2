//! The two-finger gripper as a peripheral.

use std::time::Duration;

use super::protocol::{ACTION, BEGIN, Fingers, RESET, STATUS, Status, go};
use super::{BAUD, FORCES, Options, SPEEDS};
use dimos_hardware::adapter::{AdapterError, AdapterResult, Gripper};
use dimos_hardware::adapter_util::within;
use dimos_hardware::peripheral::{Condition, Peripheral, PeripheralInfo};
use dimos_hardware::registry::AdapterConfig;
use dimos_hardware::transport::line::LineAddress;
use dimos_hardware::transport::modbus::{Framing, ModbusClient, Table};
use dimos_hardware::transport::request_reply::Retry;

/// Timeout of the connection, and of a telegram; the line and the gripper take 16 ms for one. Telegrams may be
/// repeated: they state what is wanted.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(2);
const RETRY: Retry = Retry { each: Duration::from_millis(100), times: 2 };
/// Positions this far outside the range are within it: they are rounded in files [m].
const SAME: f64 = 1e-6;

/// A gripper.
pub struct Robotiq2F {
    options: Options,
    arm: String,
    address: LineAddress,
    client: ModbusClient,
    /// As read last; `None` before, and while it is not connected.
    status: Option<Status>,
    /// The last commanded position, by this connection.
    target: Option<u8>,
    /// Fraction of the top speed of the next command.
    speed: Option<f64>,
    /// Activation was begun; the next status may be from before.
    homing: bool,
}

impl Robotiq2F {
    /// Creates the adapter of a gripper. Does not connect.
    pub fn new(config: &AdapterConfig) -> AdapterResult<Self> {
        super::check(config)?;
        let options: Options = config.options()?;
        let address = LineAddress::parse(&config.address, BAUD).map_err(AdapterError::Rejected)?;
        let framing = Framing::at(&address, options.framing);
        let client = ModbusClient::new("the gripper", options.unit, framing, RETRY);
        let arm = config.hardware_id.clone();
        Ok(Self { options, arm, address, client, status: None, target: None, speed: None, homing: false })
    }

    /// Returns the opening at one of the gripper's own positions [m].
    fn opening(&self, count: u8) -> f64 {
        let Options { stroke, open_count, closed_count, .. } = self.options;
        let range = f64::from(closed_count) - f64::from(open_count);
        ((f64::from(closed_count) - f64::from(count)) / range).clamp(0.0, 1.0) * stroke
    }

    fn count(&self, opening: f64) -> u8 {
        let Options { stroke, open_count, closed_count, .. } = self.options;
        let closed = 1.0 - (opening / stroke).clamp(0.0, 1.0);
        (f64::from(open_count) + closed * (f64::from(closed_count) - f64::from(open_count))).round() as u8
    }

    fn go(&mut self, opening: f64, force: f64) -> AdapterResult<()> {
        within("gripper position", opening, (-SAME, self.options.stroke + SAME), "m")?;
        self.condition().ready(&self.arm)?;
        let share = |value: f64, (least, most): (f64, f64)| {
            (255.0 * ((value - least) / (most - least)).clamp(0.0, 1.0)).round() as u8
        };
        let speed = share(self.speed.unwrap_or(self.options.speed) * SPEEDS.1, SPEEDS);
        let count = self.count(opening);
        self.client.write(ACTION, &go(count, speed, share(force, FORCES)))?;
        self.target = Some(count);
        Ok(())
    }
}

impl Peripheral for Robotiq2F {
    fn connect(&mut self) -> AdapterResult<PeripheralInfo> {
        self.client.connect(&self.address, CONNECT_TIMEOUT)?;
        self.read().inspect_err(|_| self.disconnect())?;
        let info = PeripheralInfo { vendor: "Robotiq".into(), model: "2F".into(), ..PeripheralInfo::default() };
        Ok(info)
    }

    fn disconnect(&mut self) {
        self.client.close();
        (self.status, self.target, self.homing) = (None, None, false);
    }

    fn is_connected(&self) -> bool {
        self.client.is_open()
    }

    fn read(&mut self) -> AdapterResult<()> {
        let mut registers = [0; 3];
        let read = self.client.read(Table::Input, STATUS, &mut registers);
        self.status = read.is_ok().then(|| Status::of(registers));
        // Activation has begun, or was ended.
        if self.status.is_some_and(|status| status.activation != 0 || !status.active) {
            self.homing = false;
        }
        read
    }

    fn condition(&self) -> Condition {
        match self.status {
            _ if self.homing => Condition::Homing,
            Some(status) => status.condition(),
            None => Condition::NotHomed,
        }
    }

    /// Activates it: the fingers open and close once. Also clears its faults.
    fn home(&mut self) -> AdapterResult<()> {
        self.client.write(ACTION, &RESET)?;
        self.client.write(ACTION, &BEGIN)?;
        (self.target, self.homing) = (None, true);
        Ok(())
    }

    fn halt(&mut self) -> AdapterResult<()> {
        if self.condition() == Condition::Homing {
            self.homing = false;
            self.client.write(ACTION, &RESET)?;
        }
        Ok(())
    }

    fn waits_for_arm(&self) -> bool {
        matches!(self.address, LineAddress::UrTool(_))
    }

    fn gripper(&mut self) -> Option<&mut dyn Gripper> {
        Some(self)
    }
}

impl Gripper for Robotiq2F {
    /// Before activation the gripper does not know its position.
    fn read_gripper_position(&mut self) -> AdapterResult<Option<f64>> {
        let known = self.status.filter(|status| status.active && status.activation == 3);
        Ok(known.map(|status| self.opening(status.position)))
    }

    fn write_gripper_position(&mut self, position: f64) -> AdapterResult<()> {
        self.go(position, self.options.force)
    }

    fn get_gripper_range(&mut self) -> Option<(f64, f64)> {
        Some((0.0, self.options.stroke))
    }

    fn get_gripper_force_range(&mut self) -> Option<(f64, f64)> {
        Some(FORCES)
    }

    fn write_gripper_position_with_force(&mut self, position: f64, force: f64) -> AdapterResult<()> {
        self.go(position, within("gripper force", force, FORCES, "N")?)
    }

    /// A status from before the last command says nothing of that.
    fn read_gripper_holds(&mut self) -> AdapterResult<Option<bool>> {
        let known = self.status.filter(|status| status.condition() == Condition::Ready);
        let known = known.filter(|status| self.target.is_none_or(|target| target == status.requested));
        Ok(known
            .map(|status| status.goes && matches!(status.fingers, Fingers::StoppedOpening | Fingers::StoppedClosing)))
    }

    fn has_gripper_speed(&self) -> bool {
        true
    }

    fn set_gripper_speed(&mut self, fraction: Option<f64>) {
        self.speed = fraction;
    }
}
