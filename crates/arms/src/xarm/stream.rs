//! One of the controller's report connections: takes up all that has arrived and keeps the newest.

use std::os::fd::{AsFd, BorrowedFd};
use std::time::Duration;

use super::address::Address;
use super::protocol::report::{Kind, scan};
use dimos_core::clock::{Clock, Mono, MonotonicClock};
use dimos_hardware::adapter::AdapterResult;
use dimos_hardware::transport::tcp::TcpLink;

/// A connection on which the controller streams reports.
pub struct Stream<T> {
    link: TcpLink,
    kind: Kind,
    decode: fn(&[u8]) -> Option<T>,
    /// Length of its reports, once one has come.
    length: Option<usize>,
    /// When the newest report was taken up.
    pub arrived: Mono,
}

impl<T> Stream<T> {
    /// Connects to the port of this kind of report.
    pub fn connect(
        address: &Address,
        kind: Kind,
        decode: fn(&[u8]) -> Option<T>,
        timeout: Duration,
    ) -> AdapterResult<Self> {
        let link = TcpLink::connect("the reports of xarm", &address.report(kind.offset()), timeout)?;
        Ok(Self { link, kind, decode, length: None, arrived: MonotonicClock.now() })
    }

    /// The newest of the reports that have arrived since the last call, without waiting.
    pub fn newest(&mut self) -> AdapterResult<Option<T>> {
        let (kind, decode) = (self.kind, self.decode);
        let mut newest = None;
        loop {
            let length = self.length;
            let Some((length, report)) = self.link.poll(|bytes| scan(bytes, kind, length, decode))? else {
                return Ok(newest);
            };
            self.length = Some(length);
            self.arrived = MonotonicClock.now();
            newest = Some(report);
        }
    }

    /// Waits for the next report, or until the time is over.
    pub fn wait(&mut self, timeout: Duration) -> AdapterResult<T> {
        let (kind, decode, length) = (self.kind, self.decode, self.length);
        let (length, report) = self.link.receive(timeout, |bytes| scan(bytes, kind, length, decode))?;
        self.length = Some(length);
        self.arrived = MonotonicClock.now();
        Ok(report)
    }

    /// Which reports these are.
    pub fn kind(&self) -> Kind {
        self.kind
    }

    /// The device and its address, for messages.
    pub fn peer(&self) -> &str {
        self.link.peer()
    }
}

impl<T> AsFd for Stream<T> {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.link.as_fd()
    }
}
