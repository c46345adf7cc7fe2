//! The control connection. Requests are sent without waiting for earlier responses, so that a setpoint never waits for
//! the previous one. Each response is matched to its request by number.

use std::os::fd::{AsFd, BorrowedFd};
use std::time::Duration;

use super::protocol::commands::{Command, QUICK, STOP};
use super::protocol::frame::{self, Arrived, MAX_REQUEST, PRIVATE, Response, Status};
use dimos_core::clock::{Clock, Mono, MonotonicClock};
use dimos_hardware::adapter::{AdapterError, AdapterResult};
use dimos_hardware::transport::tcp::TcpLink;

/// Maximum number of requests without a response.
const WINDOW: usize = 64;
/// Maximum number of setpoints without a response: a stalled connection still delivers them later.
const IN_FLIGHT: usize = 2;
/// Without a response to a quick request for this time the controller is lost.
const LOST_AFTER: Duration = Duration::from_millis(1000);

/// Purpose of a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Purpose {
    /// A caller waits for it.
    Answer,
    /// A motion command: only a refusal matters.
    Motion,
    /// Requests the controller's condition.
    Health,
    /// A telegram of the gripper.
    Gripper,
}

/// Counts of requests.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Counts {
    /// Requests sent.
    pub sent: u64,
    /// Late responses.
    pub late: u64,
    /// Requests without a response in time.
    pub overdue: u64,
    /// Complete frames that match no request.
    pub stray: u64,
}

#[derive(Debug, Clone, Copy)]
struct Pending {
    transaction: u16,
    register: u8,
    purpose: Purpose,
    sent: Mono,
    timeout: Duration,
    overdue: bool,
}

impl Pending {
    /// Whether the controller may be slow to answer. It answers in order, so later requests wait too.
    fn is_slow(&self) -> bool {
        self.timeout > QUICK && !self.overdue
    }
}

/// Connection to the control port.
pub struct Control {
    link: TcpLink,
    protocol: u16,
    transaction: u16,
    pending: [Option<Pending>; WINDOW],
    last_sent: Mono,
    last_response: Mono,
    /// When the newest answered request was sent.
    answered_up_to: Mono,
    /// When the last slow request was answered or timed out.
    unblocked: Mono,
    /// When the newest request was sent whose response says that the arm is not ready.
    not_ready: Option<Mono>,
    /// A refused motion command, and when it was sent, until the session takes it.
    refusal: Option<(Status, Mono)>,
    counts: Counts,
}

impl Control {
    /// Uses this connection with the plain private protocol.
    pub fn new(link: TcpLink) -> Self {
        let now = MonotonicClock.now();
        Self {
            link,
            protocol: PRIVATE,
            transaction: 0,
            pending: [None; WINDOW],
            last_sent: now,
            last_response: now,
            answered_up_to: Mono::ZERO,
            unblocked: Mono::ZERO,
            not_ready: None,
            refusal: None,
            counts: Counts::default(),
        }
    }

    /// Switches to another protocol.
    pub fn speak(&mut self, protocol: u16) {
        self.protocol = protocol;
    }

    /// Returns when the last request was sent.
    pub fn last_sent(&self) -> Mono {
        self.last_sent
    }

    /// Returns the counts of requests.
    pub fn counts(&self) -> Counts {
        self.counts
    }

    /// Returns the descriptor that becomes readable when a response has arrived.
    pub fn fd(&self) -> BorrowedFd<'_> {
        self.link.as_fd()
    }

    /// Returns the device and its address, for messages.
    pub fn peer(&self) -> &str {
        self.link.peer()
    }

    /// Closes the connection and discards unsent bytes. Setpoints that have left this computer may still arrive, and
    /// velocities would move the arm again, so a stop is sent after them.
    pub fn abort(mut self) {
        if self.in_flight() > 0 {
            let mut frame = [0; MAX_REQUEST];
            let number = self.transaction % u16::MAX + 1;
            self.link.send_now(Command::SetState(STOP).encode(number, self.protocol, &mut frame));
        }
        self.link.abort();
    }

    /// Returns the refusal of an earlier motion command, and when that was sent; once.
    pub fn take_refusal(&mut self) -> Option<(Status, Mono)> {
        self.refusal.take()
    }

    /// Returns whether the response to a request sent after `since` says that the arm is not ready.
    pub fn not_ready_after(&self, since: Mono) -> bool {
        self.not_ready.is_some_and(|sent| sent > since)
    }

    /// Returns whether a slow request is outstanding.
    pub fn waits(&self) -> bool {
        self.pending.iter().flatten().any(Pending::is_slow)
    }

    /// Returns the number of setpoints in flight: without a response, and nothing sent later has one. While the
    /// connection stalls, the number does not change.
    fn in_flight(&self) -> usize {
        let on_their_way = |p: &&Pending| p.purpose == Purpose::Motion && p.sent > self.answered_up_to;
        self.pending.iter().flatten().filter(on_their_way).count()
    }

    /// Sends a request and returns its number at once. [`Control::next`] returns the response. `Busy` for a setpoint
    /// while two are in flight.
    pub fn post(&mut self, command: &Command, purpose: Purpose) -> AdapterResult<u16> {
        let now = MonotonicClock.now();
        if purpose == Purpose::Motion && self.in_flight() >= IN_FLIGHT {
            return Err(AdapterError::Busy);
        }
        if purpose == Purpose::Answer {
            self.make_room();
        }
        let Some(slot) = self.pending.iter_mut().find(|slot| slot.is_none()) else {
            return Err(AdapterError::Timeout(format!(
                "{} does not keep up: {WINDOW} requests without response",
                self.link.peer()
            )));
        };
        self.transaction = self.transaction % u16::MAX + 1;
        let (transaction, register) = (self.transaction, command.register());
        let timeout = command.timeout();
        *slot = Some(Pending { transaction, register, purpose, sent: now, timeout, overdue: false });
        self.last_sent = now;
        self.counts.sent += 1;
        let mut frame = [0; MAX_REQUEST];
        self.link.send(command.encode(transaction, self.protocol, &mut frame))?;
        Ok(transaction)
    }

    /// Makes room for a request that a caller waits for, even if the controller is far behind: it may be a stop. The
    /// response to the oldest request is then ignored.
    fn make_room(&mut self) {
        if self.pending.iter().all(Option::is_some)
            && let Some(oldest) = self.pending.iter_mut().min_by_key(|slot| slot.map(|pending| pending.sent))
        {
            *oldest = None;
        }
    }

    /// Returns the next response that has arrived, and its purpose, without waiting.
    pub fn next(&mut self) -> AdapterResult<Option<(Purpose, Response)>> {
        loop {
            let (protocol, pending) = (self.protocol, &self.pending);
            let asked = |transaction, register| find(pending, transaction, register).is_some();
            match self.link.poll(|bytes| frame::scan(bytes, protocol, asked))? {
                Some(Arrived::Response(response)) => {
                    if let Some(purpose) = self.settle(&response) {
                        return Ok(Some((purpose, response)));
                    }
                }
                Some(Arrived::Stray) => self.counts.stray += 1,
                None => {
                    self.expire()?;
                    return Ok(None);
                }
            }
        }
    }

    /// Sends a request and waits for its response. Passes other responses to `other`.
    pub fn ask(
        &mut self,
        command: &Command,
        timeout: Duration,
        mut other: impl FnMut(Purpose, &Response),
    ) -> AdapterResult<Response> {
        let transaction = self.post(command, Purpose::Answer)?;
        let deadline = MonotonicClock.now().after(timeout);
        loop {
            let (protocol, pending) = (self.protocol, &self.pending);
            let asked = |transaction, register| find(pending, transaction, register).is_some();
            let left = deadline.since(MonotonicClock.now());
            let received = self.link.receive(left, |bytes| frame::scan(bytes, protocol, asked));
            match received {
                Ok(Arrived::Stray) => self.counts.stray += 1,
                Ok(Arrived::Response(response)) => match self.settle(&response) {
                    Some(Purpose::Answer) if response.transaction == transaction => return Ok(response),
                    Some(purpose) => other(purpose, &response),
                    None => {}
                },
                Err(AdapterError::Timeout(_)) => {
                    self.expire()?;
                    let (peer, register) = (self.link.peer(), command.register());
                    return Err(AdapterError::Timeout(format!(
                        "{peer} did not answer register {register} within {timeout:?}"
                    )));
                }
                Err(error) => return Err(error),
            }
        }
    }

    /// Removes the request of a response; returns its purpose unless the response is too late.
    fn settle(&mut self, response: &Response) -> Option<Purpose> {
        let at = find(&self.pending, response.transaction, response.register)?;
        let pending = self.pending.get_mut(at)?.take()?;
        self.last_response = MonotonicClock.now();
        self.answered_up_to = self.answered_up_to.max(pending.sent);
        if pending.is_slow() {
            self.unblocked = self.last_response;
        }
        if response.status.not_ready() {
            self.not_ready = self.not_ready.max(Some(pending.sent));
        }
        if pending.purpose == Purpose::Motion {
            let refused = response.status.error() || response.status.not_ready() || response.status.invalid();
            self.refusal = refused.then_some((response.status, pending.sent)).or(self.refusal);
        }
        if pending.overdue {
            self.counts.late += 1;
            return None;
        }
        Some(pending.purpose)
    }

    /// Drops overdue requests; an error if the controller has not answered for too long. Time spent on a slow request
    /// does not count for later ones.
    fn expire(&mut self) -> AdapterResult<()> {
        let (now, last_response) = (MonotonicClock.now(), self.last_response);
        let slow = self.pending.iter().flatten().filter(|p| p.is_slow()).map(|p| p.sent).min();
        let mut over = false;
        for slot in &mut self.pending {
            let Some(pending) = slot.as_mut().filter(|p| slow.is_none_or(|slow| p.sent <= slow)) else { continue };
            let age = now.since(pending.sent.max(self.unblocked));
            if age > pending.timeout && !pending.overdue {
                over |= pending.is_slow();
                pending.overdue = true;
                self.counts.overdue += 1;
            }
            let gone = age > LOST_AFTER.max(pending.timeout);
            if gone && last_response < pending.sent {
                return Err(AdapterError::Io(format!("{} does not answer", self.link.peer())));
            }
            if gone {
                *slot = None; // lost, while others were answered
            }
        }
        if over {
            self.unblocked = now;
        }
        Ok(())
    }
}

fn find(pending: &[Option<Pending>], transaction: u16, register: u8) -> Option<usize> {
    let is_it = |slot: &Option<Pending>| slot.is_some_and(|p| p.transaction == transaction && p.register == register);
    pending.iter().position(is_it)
}

#[cfg(test)]
mod tests {
    use std::io::{Read, Write};
    use std::net::TcpListener;
    use std::sync::mpsc::channel;

    use super::*;
    use dimos_hardware::transport::tcp::Endpoint;

    #[test]
    fn responses_are_matched_by_number_and_late_and_stray_ones_are_counted() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        let (go, told) = channel();
        std::thread::spawn(move || {
            let (mut stream, _) = listener.accept().unwrap();
            // Register 13, transactions 1 to 3: seven bytes each.
            stream.read_exact(&mut [0; 21]).unwrap();
            let answer = |transaction| [0, transaction, 0, 2, 0, 3, 13, 0, 10 + transaction];
            for transactions in [&[9, 3][..], &[1], &[1, 2]] {
                told.recv().unwrap();
                transactions.iter().for_each(|t| stream.write_all(&answer(*t)).unwrap());
            }
            let _ = stream.read(&mut [0; 1]);
        });
        let endpoint = Endpoint { host: "127.0.0.1".into(), port };
        let mut control = Control::new(TcpLink::connect("test", &endpoint, Duration::from_secs(5)).unwrap());
        let numbers = [(); 3].map(|()| control.post(&Command::GetState, Purpose::Health).unwrap());
        assert_eq!(numbers, [1, 2, 3]);
        let next = |control: &mut Control| {
            let end = std::time::Instant::now() + Duration::from_secs(10);
            while std::time::Instant::now() < end {
                if let Some((purpose, response)) = control.next().unwrap() {
                    assert_eq!(purpose, Purpose::Health);
                    return response;
                }
            }
            panic!("no response")
        };
        go.send(()).unwrap();
        assert_eq!(next(&mut control).data(), [13], "the third came first, after one without a request");
        go.send(()).unwrap();
        assert_eq!(next(&mut control).data(), [11]);
        let second = |control: &Control| control.pending.iter().flatten().map(|p| p.transaction).collect::<Vec<_>>();
        assert_eq!(second(&control), [2]);
        std::thread::sleep(QUICK + Duration::from_millis(10));
        assert_eq!(control.next().unwrap().map(|_| ()), None);
        assert_eq!(control.counts(), Counts { sent: 3, late: 0, overdue: 1, stray: 1 });
        go.send(()).unwrap();
        let end = std::time::Instant::now() + Duration::from_secs(10);
        while control.counts().late == 0 {
            assert!(std::time::Instant::now() < end, "the late one is not counted");
            assert_eq!(control.next().unwrap().map(|_| ()), None, "its request was dropped");
        }
        assert_eq!(control.counts(), Counts { sent: 3, late: 1, overdue: 1, stray: 2 });
    }

    #[test]
    fn a_stop_goes_out_to_a_controller_that_is_far_behind() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        let server = std::thread::spawn(move || {
            let (mut stream, _) = listener.accept().unwrap();
            stream.read_exact(&mut [0; 7 * WINDOW]).unwrap();
            let mut stop = [0; 8];
            stream.read_exact(&mut stop).unwrap();
            let [t0, t1, .., register, _] = stop;
            stream.write_all(&[t0, t1, 0, 2, 0, 2, register, 0]).unwrap();
            stop
        });
        let endpoint = Endpoint { host: "127.0.0.1".into(), port };
        let mut control = Control::new(TcpLink::connect("test", &endpoint, Duration::from_secs(5)).unwrap());
        assert!((0..WINDOW).all(|_| control.post(&Command::GetState, Purpose::Health).is_ok()));
        let full = control.post(&Command::GetState, Purpose::Health).unwrap_err();
        assert!(full.to_string().contains("does not keep up"), "{full}");
        let answer = control.ask(&Command::SetState(STOP), Duration::from_secs(5), |_, _| ());
        assert_eq!(answer.map(|response| response.register), Ok(12));
        assert_eq!(server.join().unwrap()[6..], [12, 4]);
    }

    #[test]
    fn setpoints_that_may_arrive_late_are_followed_by_a_stop() {
        let orders = |set_points: usize| {
            let listener = TcpListener::bind("127.0.0.1:0").unwrap();
            let port = listener.local_addr().unwrap().port();
            let endpoint = Endpoint { host: "127.0.0.1".into(), port };
            let mut control = Control::new(TcpLink::connect("test", &endpoint, Duration::from_secs(5)).unwrap());
            let (mut stream, _) = listener.accept().unwrap();
            let velocity = Command::Velocity { joints: [0.0; 7], duration: Some(0.2) };
            assert!((0..set_points).all(|_| control.post(&velocity, Purpose::Motion).is_ok()));
            assert_eq!(control.post(&velocity, Purpose::Motion).is_err(), set_points == IN_FLIGHT);
            control.abort();
            let mut bytes = Vec::new();
            let end = stream.read_to_end(&mut bytes);
            assert_eq!(end.unwrap_err().kind(), std::io::ErrorKind::ConnectionReset);
            let mut rest = &bytes[..];
            let mut registers = Vec::new();
            while let [_, _, _, _, _, length, register, ..] = *rest {
                registers.push(register);
                rest = &rest[6 + usize::from(length)..];
            }
            registers
        };
        assert_eq!(orders(IN_FLIGHT), [81, 81, 12]);
    }
}
