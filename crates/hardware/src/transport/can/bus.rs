//! A CAN bus in memory, for `--sim` and for tests of conditions that a kernel cannot produce on request.
//!
//! A [`Bus`] contains both the wire and the computer's CAN controller with its send queue. Ports from [`open`] are
//! programs on that computer, those from [`Bus::attach`] other nodes on the wire. A test can withhold the
//! acknowledgement; frames of programs then stay in the queue, as with real controllers, even after the program has
//! closed its port.

use std::collections::{BTreeMap, VecDeque};
use std::os::fd::{AsFd, BorrowedFd};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, Weak};

use super::{CanAddress, CanEvent, CanFilter, CanFrame, CanPort, CanTrouble};
use crate::adapter::{AdapterError, AdapterResult};
use dimos_core::sync::lock;
use dimos_rt::wake::Wake;

/// Maximum number of unread events of a port. Further ones are lost, and the port is informed.
pub const RECEIVE_QUEUE: usize = 4096;
/// Default maximum number of frames that wait for an acknowledgement.
pub const SEND_QUEUE: usize = 16;

/// The buses of this process, by number.
static BUSES: Mutex<BTreeMap<u32, Weak<Hub>>> = Mutex::new(BTreeMap::new());
/// Number of the next bus. Numbers are not reused, so an address never leads to another bus than before.
static NEXT: AtomicU32 = AtomicU32::new(1);

type Hub = Mutex<State>;

#[derive(Default)]
struct State {
    members: Vec<Member>,
    next_member: u64,
    /// The owner has dropped the bus.
    gone: bool,
    down: bool,
    /// How often the interface went down: ports opened before stay broken.
    downs: u64,
    /// Number of further frames to refuse.
    refuse: usize,
    /// While no node acknowledges: maximum number of waiting frames.
    withheld: Option<usize>,
    /// Whether ports cannot take back waiting frames.
    kept: bool,
    /// Frames that wait for an acknowledgement.
    queue: VecDeque<(u64, CanFrame)>,
}

struct Member {
    number: u64,
    /// Whether this is another node on the wire, not a program on this computer.
    remote: bool,
    filters: Vec<CanFilter>,
    events: VecDeque<CanEvent>,
    wake: Wake,
}

impl Member {
    fn push(&mut self, event: CanEvent) {
        if self.events.is_empty() {
            self.wake.raise();
        }
        match self.events.len() + 1 {
            room if room < RECEIVE_QUEUE => self.events.push_back(event),
            // The last slot is reserved for the event that something was lost.
            RECEIVE_QUEUE => self.events.push_back(CanEvent::Trouble(CanTrouble::Overflow)),
            _ => {}
        }
    }
}

impl State {
    /// Delivers a frame to all ports but its sender's.
    fn deliver(&mut self, from: u64, frame: CanFrame) {
        let wants = |member: &&mut Member| member.number != from && CanFilter::any(&member.filters, frame.id);
        self.members.iter_mut().filter(wants).for_each(|member| member.push(CanEvent::Frame(frame)));
    }

    /// Takes a frame from a program on this computer; `false` if there is no room.
    fn take(&mut self, from: u64, frame: CanFrame) -> bool {
        if self.refuse > 0 {
            self.refuse -= 1;
            return false;
        }
        match self.withheld {
            None => self.deliver(from, frame),
            Some(limit) if self.queue.len() < limit => self.queue.push_back((from, frame)),
            Some(_) => return false,
        }
        true
    }

    fn wake_all(&self) {
        self.members.iter().for_each(|member| member.wake.raise());
    }
}

/// A bus. It exists, and has its address, until it is dropped.
pub struct Bus {
    hub: Arc<Hub>,
    number: u32,
}

impl Bus {
    /// Creates a bus with its own address.
    #[expect(clippy::new_without_default, reason = "every bus is another one")]
    pub fn new() -> Self {
        let hub = Arc::new(Hub::default());
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        lock(&BUSES).insert(number, Arc::downgrade(&hub));
        Self { hub, number }
    }

    /// Returns the address for [`open`](super::open): `memory:N`.
    pub fn address(&self) -> CanAddress {
        CanAddress::Memory(self.number)
    }

    /// Opens the port of another node on the wire, such as an arm: it receives every frame, and no trouble.
    pub fn attach(&self) -> AdapterResult<BusPort> {
        join(&self.hub, format!("memory:{}", self.number), true, &[])
    }

    /// Reports trouble of the computer's controller to the programs.
    pub fn trouble(&self, trouble: CanTrouble) {
        let programs = |member: &&mut Member| !member.remote;
        lock(&self.hub).members.iter_mut().filter(programs).for_each(|m| m.push(CanEvent::Trouble(trouble)));
    }

    /// Refuses the next `frames` of programs, as if the controller's queue were full.
    pub fn refuse(&self, frames: usize) {
        lock(&self.hub).refuse = frames;
    }

    /// Simulates a loss of power of the other nodes: none acknowledges, and at most `limit` frames of programs wait.
    /// Frames of the other nodes are lost.
    pub fn withhold(&self, limit: usize) {
        let mut state = lock(&self.hub);
        state.queue.reserve(limit);
        state.withheld = Some(limit);
    }

    /// Sets whether ports can take back frames that wait for an acknowledgement (the default). Those on an interface of
    /// the system cannot.
    pub fn keep_waiting(&self, keep: bool) {
        lock(&self.hub).kept = keep;
    }

    /// Ends [`Bus::withhold`]: the other nodes receive the waiting frames in order, then new ones. Returns how many
    /// frames had waited.
    pub fn acknowledge(&self) -> usize {
        let mut state = lock(&self.hub);
        state.withheld = None;
        let waited = state.queue.len();
        while let Some((from, frame)) = state.queue.pop_front() {
            state.deliver(from, frame);
        }
        waited
    }

    /// Takes the interface down, or up again. Going down breaks the programs' ports and discards waiting frames.
    pub fn set_up(&self, up: bool) {
        let mut state = lock(&self.hub);
        if !up && !state.down {
            state.downs += 1;
            state.queue.clear();
            state.wake_all();
        }
        state.down = !up;
    }
}

impl Drop for Bus {
    fn drop(&mut self) {
        lock(&BUSES).remove(&self.number);
        let mut state = lock(&self.hub);
        state.gone = true;
        state.wake_all();
    }
}

/// A port on a bus in memory.
pub struct BusPort {
    hub: Arc<Hub>,
    number: u64,
    remote: bool,
    downs: u64,
    wake: Wake,
    /// Device and address, for messages.
    peer: String,
}

/// Opens a program's port on the bus with this number.
pub fn open(device: &str, number: u32, filters: &[CanFilter]) -> AdapterResult<BusPort> {
    let hub = lock(&BUSES).get(&number).and_then(Weak::upgrade);
    let address = CanAddress::Memory(number);
    let hub = hub.ok_or_else(|| {
        AdapterError::Io(format!("cannot reach {device} at {address}: this process has no such bus in memory"))
    })?;
    if lock(&hub).down {
        return Err(AdapterError::Io(format!("cannot reach {device} at {address}: the interface is down")));
    }
    join(&hub, format!("{device} at {address}"), false, filters)
}

fn join(hub: &Arc<Hub>, peer: String, remote: bool, filters: &[CanFilter]) -> AdapterResult<BusPort> {
    let wake = Wake::new().map_err(|e| AdapterError::Io(format!("cannot reach {peer}: {e}")))?;
    let mut state = lock(hub);
    let (number, downs) = (state.next_member, state.downs);
    state.next_member += 1;
    let events = VecDeque::with_capacity(RECEIVE_QUEUE);
    state.members.push(Member { number, remote, filters: filters.to_vec(), events, wake: wake.clone() });
    drop(state);
    Ok(BusPort { hub: hub.clone(), number, remote, downs, wake, peer })
}

impl BusPort {
    /// Returns the bus, if this port still works.
    fn state(&self) -> AdapterResult<MutexGuard<'_, State>> {
        let state = lock(&self.hub);
        let why = match &*state {
            State { gone: true, .. } => "the bus is gone",
            state if !self.remote && state.downs != self.downs => "the interface went down",
            _ => return Ok(state),
        };
        Err(AdapterError::Io(format!("the connection to {} broke: {why}", self.peer)))
    }
}

impl CanPort for BusPort {
    fn send(&mut self, frames: &[CanFrame]) -> AdapterResult<usize> {
        let mut state = self.state()?;
        if self.remote {
            // Without an acknowledgement this node has no power; with the interface down, no program receives.
            if state.withheld.is_none() && !state.down {
                frames.iter().for_each(|frame| state.deliver(self.number, *frame));
            }
            return Ok(frames.len());
        }
        Ok(frames.iter().take_while(|frame| state.take(self.number, **frame)).count())
    }

    fn receive(&mut self) -> AdapterResult<Option<CanEvent>> {
        let mut state = self.state()?;
        let member = state.members.iter_mut().find(|member| member.number == self.number);
        let event = member.and_then(|member| member.events.pop_front());
        if event.is_none() {
            self.wake.lower();
        }
        Ok(event)
    }

    fn fd(&self) -> BorrowedFd<'_> {
        self.wake.as_fd()
    }

    fn waiting(&self) -> usize {
        lock(&self.hub).queue.iter().filter(|(from, _)| *from == self.number).count()
    }

    fn discard(&mut self) -> AdapterResult<usize> {
        let mut state = self.state()?;
        let (kept, number) = (state.kept, self.number);
        if !kept {
            state.queue.retain(|(from, _)| *from != number);
        }
        drop(state);
        Ok(self.waiting())
    }
}

impl Drop for BusPort {
    fn drop(&mut self) {
        lock(&self.hub).members.retain(|member| member.number != self.number);
    }
}
