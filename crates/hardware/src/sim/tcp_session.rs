//! A connection of a [`super::tcp_server::TcpServer`] with a state of its own: requests, responses and periodic reports
//! on one stream.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::arm::Delivery;
use super::stream::{Controller, Ending, Shared};

/// A client that reads nothing for this time is dropped.
const WRITE_TIMEOUT: Duration = Duration::from_secs(1);

impl<C: Controller, Client> Shared<C, Client> {
    /// Serves a client of a port until the connection ends.
    pub fn converse(&self, who: (usize, u64), stream: &mut TcpStream, period: Duration) -> Ending {
        let (mut arrived, mut answer) = (Vec::with_capacity(4096), Vec::with_capacity(1024));
        let mut reports = Reports { due: Instant::now(), last: Vec::new(), packet: Vec::with_capacity(1024) };
        let mut buffer = [0; 4096];
        let _ = stream.set_write_timeout(Some(WRITE_TIMEOUT));
        self.with(|controller, now| controller.session_began(who.0, who.1, now, &mut answer));
        if stream.write_all(&answer).is_err() {
            return Ending::Closed;
        }
        loop {
            if let Err(ending) = self.report(who, &mut reports, period, stream) {
                return ending;
            }
            let left = reports.due.saturating_duration_since(Instant::now());
            let timeout = Timespec { tv_sec: left.as_secs() as i64, tv_nsec: left.subsec_nanos().into() };
            if poll(&mut [PollFd::new(stream, PollFlags::IN)], Some(&timeout)).is_ok_and(|n| n == 0) {
                continue;
            }
            let Ok(n @ 1..) = stream.read(&mut buffer) else { return Ending::Closed };
            arrived.extend_from_slice(buffer.get(..n).unwrap_or_default());
            if let Err(ending) = self.answer(who, &mut arrived, &mut answer, stream) {
                return ending;
            }
        }
    }

    /// Sends the report that is due.
    fn report(
        &self,
        (port, client): (usize, u64),
        reports: &mut Reports,
        period: Duration,
        stream: &mut TcpStream,
    ) -> Result<(), Ending> {
        let now = Instant::now();
        if reports.due > now {
            return Ok(());
        }
        let (next, packet) = (reports.due + period, &mut reports.packet);
        reports.due = if now > next { now + period } else { next };
        packet.clear();
        let report = self.with(|controller, now| controller.session_report(port, client, now, packet));
        let delivery = report.ok_or(Ending::Closed)?;
        if packet.is_empty() && delivery == Delivery::Send {
            return Ok(());
        }
        if delivery == Delivery::Frozen && !reports.last.is_empty() {
            packet.clone_from(&reports.last);
        }
        reports.last.clone_from(packet);
        if self.play(delivery, packet)? {
            stream.write_all(packet).map_err(|_| Ending::Closed)?;
        }
        Ok(())
    }
}

/// The reports of a connection.
struct Reports {
    due: Instant,
    /// The last one sent.
    last: Vec<u8>,
    packet: Vec<u8>,
}
