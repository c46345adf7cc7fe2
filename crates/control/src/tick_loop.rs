//! The thread that runs the coordinator: waits for the start of each tick, reads the state slots, ticks, fills the
//! command slots, wakes the device threads, then reports. It neither allocates, locks nor logs, and waits for no other
//! thread.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
use std::time::Duration;

use super::coordinator::Coordinator;
use super::guard::GuardWorld;
use super::pace::{Pacer, Source, Start};
use super::request::{Envelope, Motion};
use dimos_core::arm::{ArmCommand, ArmState};
use dimos_core::clock::Clock;
use dimos_core::telemetry::{ArmSample, Event, Outcome, Sample, TaskView, TickSample};
use dimos_rt::due::Due;
use dimos_rt::heartbeat::Heartbeat;
use dimos_rt::histogram::Histogram;
use dimos_rt::host;
use dimos_rt::slot::{SlotReader, SlotWriter};
use dimos_rt::wake::Wake;

/// State of the tick thread for its observers.
#[derive(Debug, Default)]
pub struct Pulse {
    /// The thread's heartbeat.
    pub beat: Arc<Heartbeat>,
    /// Number of ticks begun.
    pub begun: AtomicU64,
    /// Number of ticks completed.
    pub ticks: AtomicU64,
    /// Number of ticks that began at least a period late.
    pub overruns: AtomicU64,
    /// Number of periods skipped.
    pub skipped: AtomicU64,
    /// Number of ticks that this computer's clock began because the arm that clocks them was silent.
    pub unprompted: AtomicU64,
    /// Fraction of the speed override, as bits.
    pub speed: AtomicU64,
    /// Whether all motions are paused.
    pub paused: AtomicBool,
    /// Number of interruptions of all arms so far.
    pub epoch: AtomicU64,
    /// Whether the thread runs with SCHED_FIFO.
    pub fifo: AtomicBool,
    /// Whether no command moves an arm.
    pub at_rest: AtomicBool,
    /// Set while the joint state has subscribers: every tick wakes its publisher.
    pub streaming: AtomicBool,
    /// Number of threads that wait for a tick: every tick wakes them.
    pub waiting: AtomicU32,
    /// Set to end the thread after the current tick.
    pub stop: AtomicBool,
    /// Samples lost because the ring was full.
    pub dropped: AtomicU64,
    /// Commands that replaced one which the device thread had not read.
    pub overwritten: AtomicU32,
    /// Wake-up after the deadline.
    pub lateness: Histogram,
    /// Time from wake-up to the last command written to its slot.
    pub compute: Histogram,
}

/// The tick's ends of its slots and rings.
pub struct TickPorts {
    /// Latest states, one per arm.
    pub states: Vec<SlotReader<ArmState>>,
    /// Latest commands, one per arm.
    pub commands: Vec<SlotWriter<ArmCommand>>,
    /// Wakes the device threads, one per arm.
    pub wakes: Vec<Wake>,
    /// Planned wake-ups of the device threads, one per arm.
    pub dues: Vec<Arc<Due>>,
    /// Requests to the coordinator.
    pub requests: rtrb::Consumer<Envelope>,
    /// Outcomes of requests, with their ids.
    pub replies: rtrb::Producer<(u64, Outcome)>,
    /// Wakes the thread that waits for replies.
    pub reply_wake: Wake,
    /// Motions that ended.
    pub retired: rtrb::Producer<Box<Motion>>,
    /// Samples for the log.
    pub samples: rtrb::Producer<Sample>,
    /// Latest samples for rpc, one per arm.
    pub arm_views: Vec<SlotWriter<ArmSample>>,
    /// Latest views for rpc, one per task.
    pub task_views: Vec<SlotWriter<TaskView>>,
    /// Worlds of the collision guard, if streams are guarded.
    pub guard: Option<GuardPorts>,
    /// What starts the ticks.
    pub source: Source,
    /// Shared with its observers.
    pub pulse: Arc<Pulse>,
}

/// The tick's ends of the rings of the collision guard.
pub struct GuardPorts {
    /// New robots and obstacles.
    pub worlds: rtrb::Consumer<Box<GuardWorld>>,
    /// Those that they replaced, to be freed on another thread.
    pub retired: rtrb::Producer<Box<GuardWorld>>,
}

impl GuardPorts {
    /// Takes the newest world.
    fn exchange(&mut self, coordinator: &mut Coordinator) {
        while !self.retired.is_full()
            && let Ok(world) = self.worlds.pop()
        {
            // There is room for it.
            coordinator.set_guard(Some(world)).map(|old| self.retired.push(old));
        }
    }
}

/// Called at the start of each tick. Tests and benchmarks use it to delay, hang or end the thread.
pub type Probe = Box<dyn FnMut(u64) + Send>;

/// Runs ticks until `pulse.stop`.
pub fn run(
    mut coordinator: Coordinator,
    mut ports: TickPorts,
    period: Duration,
    clock: &dyn Clock,
    mut probe: Option<Probe>,
) {
    let pulse = ports.pulse.clone();
    pulse.fifo.store(host::enter_realtime(host::TICK_PRIORITY), Ordering::Relaxed);
    let mut states = vec![ArmState::default(); ports.states.len()];
    let mut pacer = Pacer::new(ports.source, clock.now(), period);
    let (mut tick, mut dropped) = (0u64, 0u32);
    pulse.beat.adopt_thread();
    pulse.beat.beat(clock.now());
    while !pulse.stop.load(Ordering::Relaxed) {
        let Start { time, woke, unprompted } = pacer.wait(clock, &pulse.beat, &mut ports.states);
        if let Some(probe) = &mut probe {
            probe(tick);
        }
        pulse.begun.store(tick + 1, Ordering::SeqCst);
        for ((state, slot), due) in states.iter_mut().zip(&mut ports.states).zip(&ports.dues) {
            *state = slot.read();
            state.own_delay_ns = due.overdue(woke).as_nanos() as u64;
        }
        if let Some(guard) = &mut ports.guard {
            guard.exchange(&mut coordinator);
        }
        let requests = &mut ports.requests;
        let output = coordinator.tick(time, &states, || requests.pop().ok());
        let mut overwritten = 0;
        for (slot, command) in ports.commands.iter_mut().zip(&output.commands) {
            overwritten += u32::from(slot.write(command));
        }
        let done = clock.now();
        // All wake-ups after the computation: a woken thread must not preempt the tick.
        ports.wakes.iter().for_each(Wake::raise);
        let compute_ns = done.0.saturating_sub(woke.0);
        pulse.beat.beat(done);

        for motion in output.retired.drain(..) {
            // The ring has room for all motions that can exist. One that does not fit is leaked, not freed.
            if let Err(rtrb::PushError::Full(motion)) = ports.retired.push(motion) {
                #[expect(clippy::mem_forget, reason = "the tick frees nothing")]
                std::mem::forget(motion);
            }
        }
        let timing = TickSample {
            tick,
            deadline: time.now,
            next: time.next,
            late_ns: time.woke_late_ns,
            compute_ns,
            skipped: time.skipped,
            overrun_ns: time.late_ns,
            dropped,
        };
        let wanted = output.arms.len() + output.events.len() + 1;
        if let Ok(chunk) = ports.samples.write_chunk_uninit(wanted) {
            let arms = output.arms.iter().map(|a| Sample::Arm(*a));
            let events = output.events.iter().map(|e| Sample::Event(tick, *e));
            chunk.fill_from_iter(arms.chain(events).chain([Sample::Tick(timing)]));
            dropped = 0;
        } else {
            // A tick is logged completely or not at all; lost samples are counted.
            dropped = dropped.saturating_add(wanted as u32);
            pulse.dropped.fetch_add(wanted as u64, Ordering::Relaxed);
        }
        for (slot, sample) in ports.arm_views.iter_mut().zip(&output.arms) {
            slot.write(sample);
        }
        for (slot, view) in ports.task_views.iter_mut().zip(&output.tasks) {
            slot.write(view);
        }
        pulse.speed.store(output.speed.fraction.to_bits(), Ordering::Relaxed);
        pulse.paused.store(output.speed.paused, Ordering::Relaxed);
        pulse.epoch.store(output.epoch, Ordering::Release);
        // After the views: they show the effect of a request when its client gets the outcome.
        let mut replied = false;
        for event in &output.events {
            if let Event::Request(id, outcome) = event {
                replied |= ports.replies.push((*id, *outcome)).is_ok();
            }
        }
        pulse.at_rest.store(coordinator.at_rest(), Ordering::Release);
        pulse.lateness.record(time.woke_late_ns);
        pulse.compute.record(compute_ns);
        pulse.overwritten.fetch_add(overwritten, Ordering::Relaxed);
        pulse.overruns.fetch_add(u64::from(time.skipped > 0), Ordering::Relaxed);
        pulse.skipped.fetch_add(time.skipped as u64, Ordering::Relaxed);
        pulse.unprompted.fetch_add(u64::from(unprompted), Ordering::Relaxed);
        pulse.ticks.store(tick + 1, Ordering::Release);
        let watched = pulse.streaming.load(Ordering::Relaxed) || pulse.waiting.load(Ordering::Relaxed) > 0;
        if replied || watched {
            ports.reply_wake.raise();
        }
        tick += 1;
    }
}
