//! A connection to a controller: takes its states, answers them while a motion runs, and asks for services.

use std::os::fd::{AsFd, BorrowedFd};
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::adapter::pose;
use super::catching_up::CatchingUp;
use super::desired::{Fate, Record};
use super::follower::Follower;
use super::model::{JointRange, Model};
use super::protocol::command::{self, Target};
use super::protocol::errors;
use super::protocol::service::{Answer, Reader, Service, refusal, request};
use super::protocol::state::{State, generator, mode};
use super::protocol::{DOF, Interface};
use super::shaping::{Pace, Shaping};
use dimos_core::clock::{Clock, Mono, MonotonicClock};
use dimos_hardware::adapter::{AdapterError, AdapterResult};
use dimos_hardware::transport::tcp::TcpLink;
use dimos_hardware::transport::udp::UdpLink;

/// Without a state for this time the connection is lost.
const STATE_TIMEOUT: Duration = Duration::from_millis(500);
/// Time between two checks of the TCP connection, and the age of a state from which it is checked every time.
const TCP_PERIOD: Duration = Duration::from_millis(20);
const LATE_STATE: Duration = Duration::from_millis(5);
/// Timeout of a service.
const ANSWER_TIMEOUT: Duration = Duration::from_millis(800);
/// Joint positions that jump by more than the arm can move plus this [rad] are accepted only when the next state
/// agrees.
const MAX_JUMP: f64 = 0.1;
/// Joints whose desired speed is lower are at rest [rad/s].
const REST: f64 = 1e-3;
/// A joint that rests at an end of its range may be measured this far outside [rad].
const OUTSIDE: f64 = 0.02;
/// States that are taken at once: more do not wait in a socket.
const MOST_STATES: usize = 512;

/// How states and answers fare.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct LinkCounts {
    /// States that were taken.
    pub states: u64,
    /// States that never came, or came too late to be the newest.
    pub missed_states: u64,
    /// Commands that were sent.
    pub answers: u64,
    /// States of a motion without an answer.
    pub unanswered: u64,
    /// Commands that the controller did not use: its desired positions are others.
    pub lost_answers: u64,
}

/// A motion of ours.
#[derive(Debug)]
pub(super) struct Motion {
    pub velocity: bool,
    /// Number of its Move command.
    pub id: u32,
    pub follower: Follower,
    /// Commands so far.
    sent: u64,
    /// The state that was answered last.
    answered: u64,
    /// The newest state: those before it were counted.
    counted: u64,
    /// The controller's desired values in full precision.
    record: Record,
    catching_up: CatchingUp,
    /// How fast the answers move before filter and limits.
    pace: Pace,
    /// It is to end: answers hold, and say so.
    pub finishing: bool,
}

/// A connected arm.
pub struct Session {
    pub(super) model: Model,
    pub(super) interface: Interface,
    pub(super) tcp: TcpLink,
    reader: Reader,
    answers: Vec<Answer>,
    last_id: u32,
    pub(super) udp: UdpLink,
    pub(super) ranges: [JointRange; DOF],
    pub(super) shaping: Shaping,
    pub(super) state: State,
    pub(super) fresh_at: Mono,
    suspect: bool,
    tcp_at: Mono,
    pub(super) motion: Option<Box<Motion>>,
    /// Whether the arm was enabled by this adapter, and nothing has disabled it.
    pub(super) on: bool,
    /// What others ended.
    pub(super) foreign: Option<&'static str>,
    pub(super) counts: LinkCounts,
}

impl Session {
    /// Starts with a first state.
    pub(super) fn new(model: Model, tcp: TcpLink, udp: UdpLink, first: State, shaping: Shaping) -> Self {
        let now = MonotonicClock.now();
        Self {
            model,
            interface: model.interface(),
            tcp,
            reader: Reader::default(),
            answers: Vec::new(),
            last_id: 100,
            udp,
            ranges: model.ranges(),
            shaping,
            state: first,
            fresh_at: now,
            suspect: false,
            tcp_at: now,
            motion: None,
            on: false,
            foreign: None,
            counts: LinkCounts::default(),
        }
    }

    /// Returns the descriptor that becomes readable when a state has arrived.
    pub fn fd(&self) -> BorrowedFd<'_> {
        self.udp.as_fd()
    }

    /// Returns whether the arm is enabled and could move.
    pub fn enabled(&self) -> bool {
        self.on && matches!(self.state.mode, mode::IDLE | mode::MOVE | mode::REFLEX)
    }

    /// Returns whether the joint positions are measured: the controller computes a proper pose of them, and they are
    /// inside the joints' hard limits.
    pub fn positions_are_proven(&self) -> bool {
        let within = |(q, range): (&f64, &JointRange)| (range.lower - OUTSIDE..=range.upper + OUTSIDE).contains(q);
        let inside = self.state.q.iter().zip(&self.ranges).all(within);
        inside && pose(&self.state.pose).is_some()
    }

    pub(super) fn at_rest(&self) -> bool {
        self.state.dq_d.iter().all(|v| v.abs() < REST)
    }

    /// Returns the error and its text; code 0 without one.
    pub fn error(&self) -> (i32, String) {
        match self.state.mode {
            mode::USER_STOPPED => (errors::USER_STOP, "the user stop is pressed".to_owned()),
            mode::REFLEX => {
                let all = if self.state.errors == 0 { self.state.reflex_reason } else { self.state.errors };
                let LinkCounts { unanswered, lost_answers, .. } = self.counts;
                let lost = match unanswered + lost_answers {
                    0 => String::new(),
                    _ => format!(" ({unanswered} states were not answered, {lost_answers} answers were lost)"),
                };
                (errors::reflex_code(all), format!("{}{lost}", errors::names(all)))
            }
            _ if self.state.errors != 0 => (errors::code(self.state.errors), errors::names(self.state.errors)),
            _ => (0, String::new()),
        }
    }

    /// Returns `Fault` while the arm is in error.
    pub(super) fn fault(&self) -> AdapterResult<()> {
        match self.state.errors != 0 || matches!(self.state.mode, mode::USER_STOPPED | mode::REFLEX) {
            true => {
                let (code, text) = self.error();
                Err(AdapterError::Fault { code, text })
            }
            false => Ok(()),
        }
    }

    // --- States ---

    /// Processes all that has arrived, without waiting. Answers the newest state if its answer is known.
    pub fn update(&mut self) -> AdapterResult<()> {
        let mut newest: Option<State> = None;
        let mut buffer = [0; 2400];
        for _ in 0..MOST_STATES {
            let Ok(length) = self.udp.recv(&mut buffer) else { break };
            let state = State::decode(self.interface, buffer.get(..length).unwrap_or_default());
            // Old and repeated ones do not count.
            let latest = newest.map_or(self.state.id, |state| state.id);
            newest = state.filter(|state| state.id > latest).or(newest);
        }
        let now = MonotonicClock.now();
        if let Some(state) = newest {
            self.take(state, now);
        }
        let age = now.since(self.fresh_at);
        if age > LATE_STATE || now.since(self.tcp_at) > TCP_PERIOD {
            self.tcp_at = now;
            self.take_answers()?;
        }
        if age > STATE_TIMEOUT {
            return Err(AdapterError::Io(format!("{} sent no state for {STATE_TIMEOUT:?}", self.tcp.peer())));
        }
        Ok(())
    }

    fn take_answers(&mut self) -> AdapterResult<()> {
        while let Some(answer) = self.tcp.poll(|bytes| self.reader.scan(bytes))? {
            self.answers.extend(answer);
        }
        Ok(())
    }

    fn take(&mut self, state: State, now: Mono) {
        let top = self.ranges.iter().fold(0.0, |top: f64, range| top.max(range.velocity));
        let reach = MAX_JUMP + 1.5 * top * now.since(self.fresh_at).as_secs_f64();
        let jumps = state.q.iter().zip(&self.state.q).any(|(new, old)| (new - old).abs() > reach);
        if jumps && !self.suspect {
            self.suspect = true;
            return;
        }
        self.suspect = false;
        self.counts.states += 1;
        self.counts.missed_states += state.id.saturating_sub(self.state.id + 1);
        self.fresh_at = now;
        self.state = state;
        match state.mode {
            mode::GUIDING => self.lose("the arm is guided by hand, or its guiding button is pressed"),
            mode::USER_STOPPED => self.on = false,
            _ => {}
        }
        self.see_motion();
    }

    /// Records that somebody else ended what this adapter ordered.
    fn lose(&mut self, why: &'static str) {
        if std::mem::take(&mut self.on) {
            self.foreign = Some(why);
        }
        self.motion = None;
    }

    /// Checks that the motion still runs, and answers the state.
    fn see_motion(&mut self) {
        let Some(motion) = self.motion.as_mut() else { return };
        let expected = if motion.velocity { generator::JOINT_VELOCITY } else { generator::JOINT_POSITION };
        if self.state.mode != mode::MOVE || self.state.generator != expected {
            let finishing = motion.finishing;
            self.motion = None;
            if !finishing && self.state.mode == mode::IDLE && self.state.errors == 0 {
                self.foreign = Some("the controller ended the motion: another client or the vendor's Desk did it");
            }
            return;
        }
        let (desired, fate) = motion.record.take(&self.state);
        (self.state.q_d, self.state.dq_d, self.state.ddq_d) = (desired.q, desired.v, desired.a);
        if motion.answered + 1 == self.state.id {
            self.counts.lost_answers += u64::from(fate != Fate::Used && motion.sent > 1);
        } else if motion.sent > 0 {
            self.counts.unanswered += self.state.id.saturating_sub(motion.counted.max(motion.answered + 1));
        }
        motion.counted = self.state.id;
        let answer = if motion.finishing {
            Some(if motion.velocity { [0.0; DOF] } else { self.state.q_d })
        } else {
            motion.follower.state(&self.state)
        };
        if let Some(answer) = answer {
            self.answer(&answer);
        }
    }

    /// Returns the time since the newest state came.
    pub(super) fn age(&self) -> Duration {
        MonotonicClock.now().since(self.fresh_at)
    }

    /// Sends the answer to the newest state.
    pub(super) fn answer(&mut self, values: &[f64; DOF]) {
        let Some(motion) = self.motion.as_mut() else { return };
        if !self.state.is_finite() {
            return;
        }
        let cycles = self.state.id.saturating_sub(motion.answered);
        let values = match motion.velocity || motion.finishing {
            true => *values,
            false => motion.catching_up.take(values, cycles, &self.shaping.user),
        };
        let target = if motion.velocity { Target::Velocities(values) } else { Target::Positions(values) };
        motion.pace.take(&values, cycles);
        let shaping = Shaping { rounded: motion.record.is_uncertain(), ..self.shaping };
        let shaped = shaping.shape(&target, &self.state, motion.sent == 0, Some(&motion.pace));
        let bytes = command::encode(self.state.id, &shaped, motion.finishing);
        // A datagram that is not sent is lost, as others are.
        let sent = self.udp.send(command::sent(self.interface, &bytes)).is_ok();
        self.counts.answers += u64::from(sent);
        motion.sent += 1;
        motion.answered = self.state.id;
        motion.record.answered(shaped);
    }

    pub(super) fn begin(&mut self, id: u32, velocity: bool) {
        let follower = Follower::new(&self.state, velocity, self.shaping.gain);
        let (now, record) = (self.state.id, Record::new(&self.state, velocity));
        let (sent, answered, counted, finishing) = (0, now, now, false);
        let (pace, catching_up) = (Pace::default(), CatchingUp::default());
        self.motion = Some(Box::new(Motion {
            velocity,
            id,
            follower,
            sent,
            answered,
            counted,
            record,
            catching_up,
            pace,
            finishing,
        }));
        self.see_motion();
    }

    // --- Services ---

    /// Sends a command. Returns its number.
    pub(super) fn order(&mut self, service: Service, values: &[u8]) -> AdapterResult<u32> {
        self.last_id = self.last_id.wrapping_add(1);
        self.tcp.send(&request(self.interface, service, self.last_id, values))?;
        Ok(self.last_id)
    }

    /// Returns the answer to a command, if it has come.
    pub(super) fn answered(&mut self, id: u32) -> AdapterResult<Option<Answer>> {
        self.take_answers()?;
        let found = self.answers.iter().position(|answer| answer.id == id);
        Ok(found.map(|index| self.answers.swap_remove(index)))
    }

    /// Sends a command and waits for its answer. States are answered meanwhile.
    pub(super) fn ask(&mut self, service: Service, values: &[u8]) -> AdapterResult<Answer> {
        self.answers.clear();
        let id = self.order(service, values)?;
        let late =
            || AdapterError::Timeout(format!("the controller did not answer {service:?} within {ANSWER_TIMEOUT:?}"));
        self.wait(ANSWER_TIMEOUT, |session| session.answered(id))?.ok_or_else(late)
    }

    /// Sends a command, and returns an error unless it succeeds.
    pub(super) fn set(&mut self, service: Service, values: &[u8]) -> AdapterResult<()> {
        match self.ask(service, values)?.status {
            0 => Ok(()),
            status => Err(refused(self.interface, service, status)),
        }
    }

    /// Processes what arrives until `done` returns a value; `None` after `limit`.
    pub(super) fn wait<T>(
        &mut self,
        limit: Duration,
        mut done: impl FnMut(&mut Self) -> AdapterResult<Option<T>>,
    ) -> AdapterResult<Option<T>> {
        let until = MonotonicClock.now().after(limit);
        loop {
            self.update()?;
            if let Some(found) = done(self)? {
                return Ok(Some(found));
            }
            if MonotonicClock.now() >= until {
                return Ok(None);
            }
            let timeout = Timespec { tv_sec: 0, tv_nsec: 2_000_000 };
            let (states, answers) = (PollFd::new(&self.udp, PollFlags::IN), PollFd::new(&self.tcp, PollFlags::IN));
            let _ = poll(&mut [states, answers], Some(&timeout));
        }
    }
}

/// Returns the error of a command that was refused.
pub(super) fn refused(interface: Interface, service: Service, status: u8) -> AdapterError {
    AdapterError::Rejected(format!("the controller refuses {service:?}: {}", refusal(interface, service, status)))
}
