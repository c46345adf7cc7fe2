//! The connection to the primary interface: programs out; identity and errors in.

use std::time::Duration;

use super::address::{Address, Service};
use super::protocol::primary::{Configuration, Kinematics, Packet, WARNING, scan};
use dimos_core::clock::{Clock, Mono, MonotonicClock};
use dimos_hardware::adapter::{AdapterError, AdapterResult};
use dimos_hardware::transport::tcp::TcpLink;

/// Error code of a connection that was opened in local control: it takes no programs.
const READ_ONLY: i32 = 210;

/// Time for the kinematics to follow the configuration: three states.
pub const KINEMATICS: Duration = Duration::from_millis(350);

/// A connection, and what was reported on it.
pub struct Primary {
    link: TcpLink,
    /// The last error that stops the arm: C code and A argument, and when it came.
    pub error: Option<(i32, i32, Mono)>,
    /// Why the last program failed.
    exception: Option<String>,
    /// Whether the controller takes no programs on this connection.
    read_only: bool,
}

impl Primary {
    /// Connects, and waits for the version, the configuration, and for this time for the kinematics, which not all
    /// controllers send.
    pub fn connect(
        address: &Address,
        limit: Mono,
        patience: Duration,
    ) -> AdapterResult<(Self, u8, Configuration, Option<Kinematics>)> {
        let left = |most: Duration| limit.since(MonotonicClock.now()).min(most);
        let most = Duration::from_millis(1500);
        let link = TcpLink::connect("the primary interface of ur", &address.port(Service::Primary), left(most))?;
        let mut primary = Self { link, error: None, exception: None, read_only: false };
        let (mut major, mut configuration, mut kinematics) = (None, None, None);
        // A controller that sends its kinematics does so within its first states.
        let mut until = limit;
        loop {
            let known = major.zip(configuration);
            let packet = match (primary.link.receive(until.since(MonotonicClock.now()).min(most), scan), known) {
                (Err(AdapterError::Timeout(_)), Some((major, configuration))) => {
                    return Ok((primary, major, configuration, kinematics));
                }
                (packet, _) => packet?,
            };
            match packet {
                Packet::Version(version, ..) => major = Some(version),
                Packet::About(about) => {
                    configuration = about.configuration.or(configuration);
                    kinematics = about.kinematics.or(kinematics);
                }
                _ => {}
            }
            if let Some((major, configuration)) = major.zip(configuration) {
                if kinematics.is_some() || patience.is_zero() || MonotonicClock.now() >= until {
                    return Ok((primary, major, configuration, kinematics));
                }
                until = until.min(MonotonicClock.now().after(patience));
            }
        }
    }

    /// Processes what has arrived, without waiting.
    pub fn update(&mut self) -> AdapterResult<()> {
        while let Some(packet) = self.link.poll(scan)? {
            match packet {
                Packet::Error { code: READ_ONLY, .. } => self.read_only = true,
                Packet::Error { code, argument, level } if level >= WARNING => {
                    self.error = Some((code, argument, MonotonicClock.now()));
                }
                Packet::Exception { line, text } => self.exception = Some(format!("line {line}: {text}")),
                _ => {}
            }
        }
        Ok(())
    }

    /// Sends a program, which replaces the running one; one that begins with `sec` runs beside it.
    pub fn run(&mut self, program: &str) -> AdapterResult<()> {
        self.exception = None;
        self.link.send(program.as_bytes())
    }

    /// Processes what has arrived. Returns an error if the controller has refused the program that was sent.
    pub fn check(&mut self) -> AdapterResult<()> {
        self.update()?;
        if let Some(why) = self.exception.take() {
            return Err(AdapterError::Rejected(format!("the controller refuses the program of dimos: {why}")));
        }
        Ok(())
    }

    /// Returns whether the connection takes no programs: it was opened in local control. A new one does once the
    /// pendant is in remote control.
    pub fn read_only(&self) -> bool {
        self.read_only
    }
}
