//! The servos' line with requests to one servo: what the adapter and the service verbs share.

use std::ops::RangeInclusive;
use std::time::Duration;

use super::calibration::NAMES;
use super::protocol::{self, Instruction, MAX_INSTRUCTION, MODEL, SERVOS, register};
use super::{BAUD, Options};
use dimos_hardware::adapter::{AdapterError, AdapterResult};
use dimos_hardware::registry::AdapterConfig;
use dimos_hardware::transport::request_reply::{RequestReply, Retry};
use dimos_hardware::transport::serial::SerialAddress;
use dimos_hardware::transport::shared_serial::SharedLink;

/// Servos may just be starting. With six of them: below 3 s.
const INTRODUCTION: Retry = Retry { each: Duration::from_millis(40), times: 5 };
/// The same where nothing waits but a person.
const PATIENT: Retry = Retry { each: Duration::from_millis(150), times: 5 };
/// Longest wait until the line takes a command.
const SEND_TIMEOUT: Duration = Duration::from_millis(100);

/// The line of the servos.
pub struct Bus {
    address: SerialAddress,
    /// Number of the first servo.
    first: u8,
    /// Timeout of requests to one servo.
    timeout: Retry,
    /// Requests to several servos at once.
    pub line: RequestReply<SharedLink>,
}

impl Bus {
    /// Creates the line at `config.address`. Does not open it.
    pub fn new(config: &AdapterConfig) -> AdapterResult<Self> {
        let address = config.parse_address(|address| SerialAddress::parse(address, BAUD))?;
        let options = config.options::<Options>()?;
        let line = RequestReply::half_duplex(options.echo);
        Ok(Self { address, first: options.first_id, timeout: INTRODUCTION, line })
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
        self.line.open(SharedLink::connect("so101", &self.address.path, baud, SEND_TIMEOUT)?);
        Ok(())
    }

    /// The device and its rate, for messages.
    pub fn address(&self) -> &SerialAddress {
        &self.address
    }

    /// The number of the first servo.
    pub fn first(&self) -> u8 {
        self.first
    }

    /// The numbers of the servos, from the base.
    pub fn ids(&self) -> RangeInclusive<u8> {
        self.first..=self.first + (SERVOS as u8 - 1)
    }

    /// Returns which servo has a number, from the base.
    pub fn index(&self, id: u8) -> Option<usize> {
        id.checked_sub(self.first).map(usize::from).filter(|servo| *servo < SERVOS)
    }

    /// Returns a servo's number and joint: `servo 3 (elbow_flex)`.
    pub fn servo(&self, id: u8) -> String {
        match self.index(id).and_then(|servo| NAMES.get(servo)) {
            Some(name) => format!("servo {id} ({name})"),
            None => format!("servo {id}"),
        }
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
            self.servo(id)
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
                self.servo(id),
                self.address
            )),
            error => error,
        })
    }
}
