//! Robotiq's force/torque sensors FT 300 and FT 300-S on Modbus RTU: forces and torques are read, nothing is written
//! but the end of a stream that another program has begun.

use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use dimos_core::clock::Mono;
use dimos_hardware::adapter::{AdapterError, AdapterResult, ForceTorque};
use dimos_hardware::check::ConfigError;
use dimos_hardware::peripheral::{Part, Peripheral, PeripheralInfo, PeripheralSpec};
use dimos_hardware::registry::{AdapterConfig, AddressForm, EmulatorAddress, Level, OptionsSpec, Truth};
use dimos_hardware::sim::arm::Delivery;
use dimos_hardware::sim::faults::{Fault, FaultKind, check_script};
use dimos_hardware::sim::modbus::{self, NO_REGISTER, NO_VALUE, Registers};
use dimos_hardware::sim::peripheral_server::{Emulated, PeripheralServer, WIRE_FAULTS, WireFaults};
use dimos_hardware::sim::stream::Controller;
use dimos_hardware::transport::Scan;
use dimos_hardware::transport::line::{self, LineAddress};
use dimos_hardware::transport::modbus::{Framing, ModbusClient, Table};
use dimos_hardware::transport::request_reply::Retry;

/// Rate of the line from the factory [bit/s]; a reading takes 14 ms at that rate.
const BAUD: u32 = 19_200;
const RATE: f64 = 50.0;
/// First register of the six values, and of the serial number's four.
const VALUES: u16 = 180;
const SERIAL: u16 = 510;
/// Units of the values: forces [N], torques [Nm].
const FORCE: f64 = 0.01;
const TORQUE: f64 = 0.001;
/// What ends a stream: nothing is answered while one is sent.
const END_OF_STREAM: [u8; 50] = [0xFF; 50];
const CONNECT_TIMEOUT: Duration = Duration::from_secs(2);
const RETRY: Retry = Retry { each: Duration::from_millis(100), times: 2 };

/// Options of the sensor.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Options {
    /// The sensor's number on its line.
    pub unit: u8,
    /// Settings of the emulator.
    pub sim: SimOptions,
}

impl Default for Options {
    fn default() -> Self {
        Self { unit: 9, sim: SimOptions::default() }
    }
}

/// Settings of the emulator.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema, Default)]
#[serde(deny_unknown_fields, default)]
pub struct SimOptions {
    /// What it measures: force [N] and torque [Nm] about x, y, z.
    pub wrench: [f64; 6],
    /// Faults, and when they begin (seconds after the first request).
    pub faults: Vec<Fault>,
}

fn check(config: &AdapterConfig) -> Result<(), ConfigError> {
    let options: Options = config.options()?;
    let within = options.sim.wrench.iter().zip([FORCE, FORCE, FORCE, TORQUE, TORQUE, TORQUE]);
    if { within }.any(|(value, unit)| value.abs() > 32_767.0 * unit || !value.is_finite()) {
        return Err(ConfigError::new("sim.wrench", "at most 327 N and 32.7 Nm"));
    }
    check_script("robotiq_ft300", &options.sim.faults, PLAYABLE).map_err(|error| error.within("sim"))
}

/// The sensor's row.
pub const SPEC: PeripheralSpec = PeripheralSpec {
    name: "robotiq_ft300",
    about: "Robotiq FT 300 and FT 300-S on Modbus RTU",
    part: Part::ForceTorque,
    level: Level::Emulated,
    native_rate: RATE,
    address: AddressForm {
        form: line::FORM,
        required: true,
        check: |text| LineAddress::parse(text, BAUD).map(|address| address.to_string()),
    },
    options: OptionsSpec::of::<Options>(),
    check,
    create: |config| Ok(Box::new(Ft300::new(config)?)),
    emulate: Some(|config, place| Ok(Box::new(start(config, place)?))),
};

/// A sensor.
pub struct Ft300 {
    address: LineAddress,
    client: ModbusClient,
    wrench: Option<[f64; 6]>,
}

impl Ft300 {
    /// Creates the adapter of a sensor. Does not connect.
    pub fn new(config: &AdapterConfig) -> AdapterResult<Self> {
        check(config)?;
        let options: Options = config.options()?;
        let address = LineAddress::parse(&config.address, BAUD).map_err(AdapterError::Rejected)?;
        let client = ModbusClient::new("the force/torque sensor", options.unit, Framing::Rtu, RETRY);
        Ok(Self { address, client, wrench: None })
    }
}

impl Peripheral for Ft300 {
    fn connect(&mut self) -> AdapterResult<PeripheralInfo> {
        self.client.connect(&self.address, CONNECT_TIMEOUT)?;
        let mut serial = [0; 4];
        let read = self.client.send(&END_OF_STREAM).and_then(|()| {
            self.read()?;
            self.client.read(Table::Holding, SERIAL, &mut serial)
        });
        read.inspect_err(|_| self.disconnect())?;
        let text: String = serial.iter().flat_map(|word| word.to_be_bytes()).map(char::from).collect();
        let text = text.trim_matches(|c: char| !c.is_ascii_graphic()).to_owned();
        Ok(PeripheralInfo {
            vendor: "Robotiq".into(),
            model: "FT 300".into(),
            serial_number: Some(text).filter(|text| !text.is_empty()),
            ..PeripheralInfo::default()
        })
    }

    fn disconnect(&mut self) {
        self.client.close();
        self.wrench = None;
    }

    fn is_connected(&self) -> bool {
        self.client.is_open()
    }

    fn read(&mut self) -> AdapterResult<()> {
        let mut values = [0; 6];
        let read = self.client.read(Table::Holding, VALUES, &mut values);
        self.wrench = read.is_ok().then(|| {
            let [x, y, z, a, b, c] = values.map(|value| f64::from(value.cast_signed()));
            [x * FORCE, y * FORCE, z * FORCE, a * TORQUE, b * TORQUE, c * TORQUE]
        });
        read
    }

    fn waits_for_arm(&self) -> bool {
        matches!(self.address, LineAddress::UrTool(_))
    }

    fn force_torque(&mut self) -> Option<&mut dyn ForceTorque> {
        Some(self)
    }
}

impl ForceTorque for Ft300 {
    fn read_force_torque(&mut self) -> AdapterResult<Option<[f64; 6]>> {
        Ok(self.wrench)
    }
}

/// The faults that the emulator can play.
const PLAYABLE: &[FaultKind] = &WIRE_FAULTS;

/// An emulated sensor.
pub struct Sensor {
    unit: u8,
    /// What it measures [N, N, N, Nm, Nm, Nm].
    pub wrench: [f64; 6],
    faults: WireFaults,
}

impl Registers for Sensor {
    fn read(&mut self, input: bool, first: u16, count: u16, _now: Mono) -> Result<Vec<u16>, u8> {
        let value = |register: u16| {
            let measured = self.wrench.get(usize::from(register.wrapping_sub(180))).filter(|_| !input);
            match (register, measured) {
                (180..=182, Some(force)) => Ok(((100.0 * force).round() as i16).cast_unsigned()),
                (183..=185, Some(torque)) => Ok(((1000.0 * torque).round() as i16).cast_unsigned()),
                (510..=513, _) if !input => Ok(0x4631 + register - 510),
                _ => Err(NO_REGISTER),
            }
        };
        (first..first.saturating_add(count)).map(value).collect()
    }

    fn write(&mut self, _first: u16, _values: &[u16], _now: Mono) -> Result<(), u8> {
        Err(NO_VALUE)
    }
}

impl Controller for Sensor {
    fn serve(&mut self, bytes: &[u8], now: Mono, answer: &mut Vec<u8>) -> Scan<Delivery> {
        self.faults.requested(now);
        let unit = self.unit;
        modbus::serve(Framing::Rtu, unit, bytes, now, self, answer).map(|()| self.faults.delivery(now))
    }

    fn client_gone(&mut self, _now: Mono) {}
}

impl Emulated for Sensor {
    fn faults(&mut self) -> &mut WireFaults {
        &mut self.faults
    }

    fn truth(&mut self, _now: Mono) -> Truth {
        Truth::default()
    }
}

/// Starts an emulator.
pub fn start(config: &AdapterConfig, place: &EmulatorAddress) -> AdapterResult<PeripheralServer<Sensor>> {
    check(config)?;
    let options: Options = config.options()?;
    let faults = WireFaults::new("robotiq_ft300", PLAYABLE, &options.sim.faults);
    let sensor = Sensor { unit: options.unit, wrench: options.sim.wrench, faults };
    PeripheralServer::start("robotiq_ft300", sensor, place, 502, false)
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_hardware::registry::Emulator;
    use serde_json::json;

    #[test]
    fn forces_and_torques_are_those_of_the_sensor() {
        let options = json!({"sim": {"wrench": [1.5, -20.25, 300.0, 0.5, -0.125, 4.0]}});
        let config = |address: &str| AdapterConfig {
            hardware_id: "arm".into(),
            address: address.into(),
            dof: 0,
            options: options.clone(),
        };
        let server = start(&config(""), &EmulatorAddress::InProcess).unwrap();
        let mut sensor = Ft300::new(&config(&server.address())).unwrap();
        assert_eq!(sensor.connect().unwrap().serial_number.as_deref(), Some("F1F2F3F4"));
        assert_eq!(sensor.read_force_torque(), Ok(Some([1.5, -20.25, 300.0, 0.5, -0.125, 4.0])));
        server.with(|sensor, _| sensor.wrench = [0.0; 6]);
        sensor.read().unwrap();
        assert_eq!(sensor.read_force_torque(), Ok(Some([0.0; 6])));
        server.inject(Fault::new(FaultKind::PowerLoss).lasting(3.0)).unwrap();
        assert!((0..20).any(|_| sensor.read().is_err() && !sensor.is_connected()));
        assert_eq!(sensor.read_force_torque(), Ok(None), "unknown, never zero");
    }
}
