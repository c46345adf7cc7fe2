//! The servos' line with requests to one servo: what the adapter and the service verbs share.

use std::time::Duration;

use super::calibration::NAMES;
use super::protocol::{self, Instruction, MAX_INSTRUCTION, MODEL, register};
use super::{BAUD, Options};
use dimos_hardware::adapter::{AdapterError, AdapterResult};
use dimos_hardware::registry::AdapterConfig;
use dimos_hardware::transport::request_reply::{RequestReply, Retry};
use dimos_hardware::transport::serial::{SerialAddress, SerialLink};

/// Servos may just be starting. With six of them: below 3 s.
const INTRODUCTION: Retry = Retry { each: Duration::from_millis(40), times: 5 };
/// The same where nothing waits but a person.
const PATIENT: Retry = Retry { each: Duration::from_millis(150), times: 5 };
/// Longest wait until the line takes a command.
const SEND_TIMEOUT: Duration = Duration::from_millis(100);

/// The line of the servos.
pub struct Bus {
    address: SerialAddress,
    /// Timeout of requests to one servo.
    timeout: Retry,
    /// Requests to several servos at once.
    pub line: RequestReply<SerialLink>,
}

impl Bus {
    /// Creates the line at `config.address`. Does not open it.
    pub fn new(config: &AdapterConfig) -> AdapterResult<Self> {
        let address = config.parse_address(|address| SerialAddress::parse(address, BAUD))?;
        Ok(Self { address, timeout: INTRODUCTION, line: RequestReply::half_duplex(config.options::<Options>()?.echo) })
    }

    /// Waits longer for answers, for work outside a run.
    pub fn patient(self) -> Self {
        Self { timeout: PATIENT, ..self }
    }

    /// Opens the line at its rate.
    pub fn open(&mut self) -> AdapterResult<()> {
        self.open_at(self.address.baud)
    }

    /// Opens the line at another rate [bit/s].
    pub fn open_at(&mut self, baud: u32) -> AdapterResult<()> {
        self.line.close();
        self.line.open(SerialLink::connect("so101", &self.address.path, baud, SEND_TIMEOUT)?);
        Ok(())
    }

    /// The device and its rate, for messages.
    pub fn address(&self) -> &SerialAddress {
        &self.address
    }

    /// Reads the model of a servo and returns its firmware version; `Rejected` for another model.
    pub fn identify(&mut self, id: u8) -> AdapterResult<(u8, u8)> {
        let [major, minor, _, m0, m1] = self.read::<5>(id, 0)?;
        match u16::from_le_bytes([m0, m1]) {
            MODEL => Ok((major, minor)),
            model => Err(AdapterError::Rejected(format!(
                "so101 at {}: servo {id} is model {model}, expected {MODEL} (STS3215)",
                self.address
            ))),
        }
    }

    /// Reads registers of one servo.
    pub fn read<const N: usize>(&mut self, id: u8, address: u8) -> AdapterResult<[u8; N]> {
        self.request(id, Instruction::Read(id, address, N as u8))
    }

    /// Writes registers of one servo, if they have other values, and reads them back. Returns whether it wrote.
    pub fn set<const N: usize>(&mut self, id: u8, address: u8, values: [u8; N]) -> AdapterResult<bool> {
        if self.read::<N>(id, address)? == values {
            return Ok(false);
        }
        self.write(id, address, &values)?;
        let found = self.read::<N>(id, address)?;
        if found == values {
            return Ok(true);
        }
        Err(AdapterError::Protocol(format!(
            "{} keeps {found:?} in register {address} instead of {values:?}",
            servo(id)
        )))
    }

    /// Writes registers of one servo; its status confirms that they arrived.
    pub fn write(&mut self, id: u8, address: u8, values: &[u8]) -> AdapterResult<()> {
        self.request::<0>(id, Instruction::Write(id, address, values)).map(drop)
    }

    /// Makes changes that a servo keeps without power.
    pub fn unlocked<T>(&mut self, id: u8, change: impl FnOnce(&mut Self) -> AdapterResult<T>) -> AdapterResult<T> {
        self.set(id, register::LOCK, [0])?;
        let changed = change(self);
        let locked = self.set(id, register::LOCK, [1]);
        changed.and_then(|value| locked.map(|_| value))
    }

    /// Sends an instruction to one servo and waits for its status with `N` bytes of data.
    fn request<const N: usize>(&mut self, id: u8, instruction: Instruction<'_>) -> AdapterResult<[u8; N]> {
        let mut frame = [0; MAX_INSTRUCTION];
        let frame = protocol::encode(instruction, &mut frame);
        let reply = self.line.request(frame, self.timeout, |bytes| {
            protocol::scan(bytes, id..=id, N).map(|status| status.data.first_chunk::<N>().copied().unwrap_or([0; N]))
        });
        reply.map_err(|error| match error {
            AdapterError::Timeout(_) => AdapterError::Timeout(format!(
                "{} at {} does not answer\nhint: is the arm powered, and is each cable plugged in?",
                servo(id),
                self.address
            )),
            error => error,
        })
    }
}

/// `servo 3 (elbow_flex)`.
pub fn servo(id: u8) -> String {
    match usize::from(id).checked_sub(1).and_then(|servo| NAMES.get(servo)) {
        Some(name) => format!("servo {id} ({name})"),
        None => format!("servo {id}"),
    }
}
