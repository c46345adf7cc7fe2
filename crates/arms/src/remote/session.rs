//! One connection to a peer, from its hello on: outstanding requests, replies, and the newest state.
//!
//! An error of a method here that is not about one act or one reading ends the session; the adapter drops it then.

use std::os::fd::BorrowedFd;
use std::time::{Duration, Instant};

use super::MODES;
use super::address::Address;
use super::link::Link;

use super::protocol::{self, Act, Command, Description, Measured, Reply};
use dimos_core::clock::{Clock, Mono, MonotonicClock};
use dimos_hardware::adapter::{AdapterError, AdapterResult};
use dimos_hardware::transport::device_time::DeviceTime;

/// Longest waits for the connection and for the description: together below 3 s.
const CONNECT_TIMEOUT: Duration = Duration::from_millis(500);
const HELLO_TIMEOUT: Duration = Duration::from_millis(1500);
/// Reply timeout: this many device periods, but at least this long. Reads fail after it.
const REPLY_TIMEOUT: (u32, Duration) = (3, Duration::from_millis(100));
/// The peer is lost when a reply is missing for this many device periods, but at least this long.
const LOST_AFTER: (u32, Duration) = (10, Duration::from_secs(1));
/// Capacity for a cycle request [bytes].
const LINE: usize = 1024;
/// An act repeated within this time is a retry that waits for the same answer.
const AGAIN: Duration = Duration::from_millis(500);
/// While commands are at most this far apart, their replies bring the states, and no other cycle is sent.
const COMMANDED: Duration = Duration::from_millis(15);

/// A connection to a peer that has described its arm.
pub struct Session {
    link: Link,
    /// Description of the arm from the peer.
    pub description: Description,
    heard: Heard,
    /// The last request, as it was sent.
    line: Vec<u8>,
    /// Number of the last request.
    sequence: u32,
    /// Since when a reply is outstanding.
    owed_since: Option<Mono>,
    /// When the last command was given.
    commanded: Mono,
    /// When the last cycle was sent.
    asked: Mono,
    /// Number of the last cycle; only one is outstanding at a time.
    cycling: u32,
    /// The last requested act, until its answer is returned, and when a caller last waited for it.
    act: Option<(Act, Mono)>,
    /// Number of the last act: states from earlier cycles were measured before it.
    last_act: u32,
}

/// Replies of the peer.
struct Heard {
    peer: String,
    dof: usize,
    /// The newest state, the number of the cycle that brought it, and when it was measured.
    measured: Option<(Measured, u32, Mono)>,
    /// When it arrived.
    at: Mono,
    device_time: DeviceTime,
    /// Number of the last answered request; replies arrive in order.
    answered: u32,
    /// Why there is no newer state.
    trouble: Option<AdapterError>,
    /// Why the last command was not taken.
    refused: Option<AdapterError>,
    /// Number of the act whose answer is awaited, and the answer.
    awaited: u32,
    acted: Option<AdapterResult<()>>,
}

/// Whether number `a` comes after `b`; they wrap around.
fn after(a: u32, b: u32) -> bool {
    a != b && a.wrapping_sub(b) < u32::MAX / 2
}

impl Heard {
    /// Takes a reply; `cycling` is the number of the last cycle. An error ends the session.
    fn take(&mut self, reply: &Reply, cycling: u32) -> AdapterResult<()> {
        let trouble = reply.trouble(&self.peer);
        if reply.lost() {
            return Err(AdapterError::Io(format!("{} has lost its arm: {}", self.peer, reply.text())));
        } else if reply.id == self.awaited {
            self.acted = Some(trouble.map_or(Ok(()), Err));
        } else if trouble.is_some() {
            // A late error reply to an act that a newer one has replaced says nothing about the states.
            if reply.id == cycling {
                self.trouble = trouble;
            }
        } else if let Some(measured) = &reply.state {
            match measured.check(self.dof) {
                Ok(()) => self.take_measured(*measured, reply.id),
                Err(what) => self.trouble = Some(AdapterError::Protocol(format!("{}: {what}", self.peer))),
            }
            if let Some(text) = reply.refused {
                self.refused = Some(AdapterError::Rejected(format!("{}: {text}", self.peer)));
            }
        }
        if after(reply.id, self.answered) {
            self.answered = reply.id;
        }
        Ok(())
    }

    fn take_measured(&mut self, measured: Measured, of: u32) {
        self.at = MonotonicClock.now();
        let stamp = match &self.measured {
            // Read again before the device measured: the same state, with the same stamp.
            Some((before, _, stamp)) if before.time == measured.time => *stamp,
            _ => self.device_time.translate(measured.time, self.at),
        };
        self.trouble = None;
        self.measured = Some((measured, of, stamp));
    }
}

impl Session {
    /// Connects and reads the description of the arm. `dof`: number of joints in the blueprint.
    pub fn open(address: &Address, dof: usize) -> AdapterResult<Self> {
        let mut link = Link::connect(address, CONNECT_TIMEOUT)?;
        let mut line = Vec::with_capacity(LINE);
        protocol::hello(1, dof, &mut line);
        // A rejected client may find the connection closed already; the reason can still be read.
        let _ = link.send(&line);
        let description = introduction(&mut link)?;
        let (peer, found) = (link.peer().to_owned(), description.dof);
        if found != dof {
            return Err(AdapterError::Rejected(format!(
                "{peer}: expected {dof} joints, the arm says {found}\n\
                 hint: give the blueprint's arm {found} joints, or start the process that serves it with --dof {dof}"
            )));
        }
        let heard = Heard {
            peer,
            dof,
            measured: None,
            at: Mono::ZERO,
            device_time: DeviceTime::default(),
            answered: 1,
            trouble: None,
            refused: None,
            awaited: 0,
            acted: None,
        };
        let (owed_since, commanded, cycling, act) = (None, Mono::ZERO, 1, None);
        let mut session = Self {
            link,
            description,
            heard,
            line,
            sequence: 1,
            owed_since,
            commanded,
            asked: Mono::ZERO,
            cycling,
            act,
            last_act: 1,
        };
        session.fresh()??; // fails unless the peer measures
        Ok(session)
    }

    /// What becomes readable when a reply has arrived.
    pub fn fd(&self) -> BorrowedFd<'_> {
        self.link.fd()
    }

    /// Returns the reply timeout.
    pub fn late(&self) -> Duration {
        self.periods(REPLY_TIMEOUT)
    }

    fn periods(&self, (count, least): (u32, Duration)) -> Duration {
        least.max(Duration::from_secs_f64(f64::from(count) / self.description.native_rate))
    }

    /// Returns the period of the arm's states.
    fn period(&self) -> Duration {
        Duration::from_secs_f64(1.0 / self.description.native_rate)
    }

    fn next_number(&mut self) -> u32 {
        self.sequence = self.sequence.wrapping_add(1);
        self.owed_since.get_or_insert(MonotonicClock.now());
        self.sequence
    }

    /// Sends a cycle; allocates nothing.
    fn cycle(&mut self, command: Option<Command<'_>>) -> AdapterResult<()> {
        self.asked = MonotonicClock.now();
        self.cycling = self.next_number();
        protocol::cycle(self.cycling, command, &mut self.line);
        self.link.send(&self.line)
    }

    fn is_cycling(&self) -> bool {
        after(self.cycling, self.heard.answered)
    }

    /// Processes all that has arrived, without waiting.
    pub fn take_up(&mut self) -> AdapterResult<()> {
        self.link.begin();
        let mut any = false;
        while let Some(line) = self.link.next()? {
            match Reply::decode(line) {
                Ok(reply) => self.heard.take(&reply, self.cycling)?,
                Err(what) => return Err(self.link.nonsense(&what)),
            }
            any = true;
        }
        if any {
            self.owed_since = (self.heard.answered != self.sequence).then(|| MonotonicClock.now());
        }
        Ok(())
    }

    /// Sends a command; `Busy` while the peer has not answered the last cycle. Also returns the refusal of an earlier
    /// command.
    pub fn command(&mut self, command: Command<'_>) -> AdapterResult<()> {
        self.commanded = MonotonicClock.now();
        self.take_up()?;
        if self.is_cycling() {
            return Err(AdapterError::Busy);
        }
        self.cycle(Some(command))?;
        self.heard.refused.take().map_or(Ok(()), Err)
    }

    /// Closes the connection and discards what has not left this computer.
    pub fn abort(self) {
        self.link.abort();
    }

    /// The newest state and when it was measured, without waiting; asks for a newer one. The outer error ends the
    /// session, the inner one says why there is no state now.
    pub fn newest(&mut self) -> AdapterResult<AdapterResult<(&Measured, Mono)>> {
        self.take_up()?;
        let now = MonotonicClock.now();
        match self.owed_since {
            Some(since) if now.since(since) > self.periods(LOST_AFTER) => {
                return Err(AdapterError::Timeout(format!("{} has stopped answering", self.heard.peer)));
            }
            Some(since) if now.since(since) > self.late() => {
                return Ok(Err(self.unanswered()));
            }
            // Each reply wakes the device thread; this limits the rate of requests to that of the arm.
            None if now.since(self.commanded) > COMMANDED && now.since(self.asked) > self.period().mul_f64(0.9) => {
                self.cycle(None)?;
            }
            _ => {}
        }
        Ok(self.known())
    }

    fn known(&self) -> AdapterResult<(&Measured, Mono)> {
        match (&self.heard.trouble, &self.heard.measured) {
            (None, Some((measured, _, stamp))) => Ok((measured, *stamp)),
            (Some(trouble), _) => Err(trouble.clone()),
            (None, None) => Err(AdapterError::Timeout(format!("{} has sent no state yet", self.heard.peer))),
        }
    }

    /// Returns a state measured after the last act; requests one and waits if the newest is older or stale.
    pub fn recent(&mut self) -> AdapterResult<AdapterResult<&Measured>> {
        let old = MonotonicClock.now().since(self.heard.at) > self.late();
        if old || !self.after_last_act() {
            if self.is_cycling() && !after(self.cycling, self.last_act) {
                self.await_answer(self.cycling)?;
            }
            if !self.is_cycling() {
                self.cycle(None)?;
            }
            self.await_answer(self.cycling)?;
            if !self.after_last_act() && self.heard.trouble.is_none() {
                return Ok(Err(self.unanswered()));
            }
        }
        Ok(self.known().map(|(measured, _)| measured))
    }

    /// Whether the newest state is of the time after the last act.
    pub fn after_last_act(&self) -> bool {
        self.heard.measured.as_ref().is_some_and(|(_, of, _)| after(*of, self.last_act))
    }

    fn unanswered(&self) -> AdapterError {
        AdapterError::Timeout(format!("{} did not answer within {:?}", self.heard.peer, self.late()))
    }

    /// Requests a new state and waits for it.
    pub fn fresh(&mut self) -> AdapterResult<AdapterResult<(&Measured, Mono)>> {
        if self.is_cycling() {
            self.await_answer(self.cycling)?;
        }
        self.cycle(None)?;
        self.await_answer(self.sequence)?;
        if after(self.sequence, self.heard.answered) {
            return Ok(Err(self.unanswered()));
        }
        Ok(self.known())
    }

    /// Waits until request `number` is answered, at most for the reply timeout.
    fn await_answer(&mut self, number: u32) -> AdapterResult<()> {
        let end = Instant::now() + self.late();
        loop {
            self.take_up()?;
            let left = end.saturating_duration_since(Instant::now());
            if !after(number, self.heard.answered) || left.is_zero() {
                return Ok(());
            }
            self.link.wait(left);
        }
    }

    /// Requests an act and waits for its answer: `None` after `timeout`. A retry of a stop or a change of mode
    /// continues to wait for the same answer. The outer error ends the session.
    pub fn act(&mut self, act: &Act, timeout: Duration) -> AdapterResult<Option<AdapterResult<()>>> {
        let now = MonotonicClock.now();
        let same = |(asked, waited): &(Act, Mono)| asked == act && now.since(*waited) < AGAIN;
        if !(matches!(act, Act::Stop(_) | Act::Mode(_)) && self.act.as_ref().is_some_and(same)) {
            let number = self.next_number();
            (self.heard.awaited, self.heard.acted, self.last_act) = (number, None, number);
            protocol::act(number, act, &mut self.line);
            self.link.send(&self.line)?;
        }
        self.act = Some((act.clone(), now.after(timeout)));
        let end = Instant::now() + timeout;
        loop {
            self.take_up()?;
            if let Some(answer) = self.heard.acted.take() {
                self.act = None;
                self.heard.refused = None; // of a command before the act
                return Ok(Some(answer));
            }
            let left = end.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(None);
            }
            self.link.wait(left);
        }
    }

    /// Returns the name and address of the peer, for messages.
    pub fn peer(&self) -> &str {
        &self.heard.peer
    }
}

/// Waits for the reply to the hello.
fn introduction(link: &mut Link) -> AdapterResult<Description> {
    let end = Instant::now() + HELLO_TIMEOUT;
    let peer = link.peer().to_owned();
    loop {
        link.begin();
        let Some(line) = link.next()? else {
            let left = end.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Err(AdapterError::Timeout(format!(
                    "{peer} accepts the connection, but does not say what it is\n\
                     hint: does it hang, or serve something else? Restart the process that serves the arm"
                )));
            }
            link.wait(left);
            continue;
        };
        let (reply, description) = (Reply::decode(line), Description::decode(line, MODES));
        let version = serde_json::from_slice::<Version>(line).map(|said| said.version);
        return match (reply, description) {
            (Err(what), _) => Err(link.nonsense(&what)),
            (Ok(reply), _) if reply.lost() => Err(AdapterError::Io(format!("{peer}: {}", reply.text()))),
            (Ok(reply), _) if reply.trouble(&peer).is_some() => {
                Err(reply.trouble(&peer).unwrap_or(AdapterError::Unsupported))
            }
            _ if version.as_ref().is_ok_and(|version| !(protocol::OLDEST..=protocol::VERSION).contains(version)) => {
                Err(AdapterError::Rejected(format!(
                    "{peer} speaks version {} of the protocol, this program versions {} to {}\n\
                     hint: use the dimos_shim.py that came with this program",
                    version.unwrap_or_default(),
                    protocol::OLDEST,
                    protocol::VERSION
                )))
            }
            (_, Err(what)) => Err(AdapterError::Protocol(format!("{peer}: {what}"))),
            (_, Ok(description)) => Ok(description),
        };
    }
}

/// What the reply to a hello has in every version.
#[derive(serde::Deserialize)]
struct Version {
    version: u32,
}
