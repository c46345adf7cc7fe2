//! Duration of a tick: `Coordinator::tick` alone, and everything the tick thread does.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::sync::mpsc::{Sender, channel};
use std::time::{Duration, Instant};

use dimos::arm::{ArmCommand, ArmState};
use dimos::arms::mock::MockArm;
use dimos::clock::{Clock, Mono, MonotonicClock, VirtualClock};
use dimos::control::coordinator::{Coordinator, TickTime};
use dimos::control::tick_loop::{self, Pulse, TickPorts};
use dimos::hardware::adapter::{JointReading, ManipulatorAdapter};
use dimos::hardware::registry::AdapterConfig;
use dimos::rt::host;
use dimos::rt::slot::{SlotReader, SlotWriter, slot};
use dimos::rt::wake::Wake;
use dimos::telemetry::{ArmSample, Cause, Phase, Sample, TaskView};

use crate::bed::{self, Bed, DOF, Load, SETTLED};
use crate::support::measure::quantile;

const PERIOD: Duration = Duration::from_millis(10);

/// Durations of single ticks [ns], and of all of them.
pub struct Ticks {
    /// One entry per tick.
    pub times: Vec<f64>,
    /// Ticks per second, everything included.
    pub rate: f64,
}

/// Whether ticks follow each other at once, or every 10 ms with cold caches.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Pace {
    /// At once.
    Free,
    /// 100 Hz.
    Paced,
}

/// Times `Coordinator::tick` alone, on a real-time thread.
pub fn coordinator(arms: usize, load: Load, pace: Pace, ticks: usize) -> Ticks {
    on_a_thread(move || {
        host::enter_realtime(host::TICK_PRIORITY);
        let mut bed = Bed::new(arms, load);
        let mut coordinator = Coordinator::new(bed.config(), bed.tasks());
        let mut states = vec![bed::fresh_arm(); arms];
        let mut queue = VecDeque::with_capacity(4 * arms);
        let mut views = vec![TaskView::default(); bed.config().tasks.len()];
        let mut times = Vec::with_capacity(ticks);
        let start = MonotonicClock.now();
        let began = Instant::now();
        for tick in 0.. {
            let now = start.after(PERIOD * tick as u32);
            bed.requests(tick, &views, &mut queue);
            let busy = tick > SETTLED && bed.is_busy(&views);
            if pace == Pace::Paced && tick > SETTLED {
                host::sleep_until(now);
            }
            let time = TickTime { now, next: now.after(PERIOD), skipped: 0, late_ns: 0, woke_late_ns: 0 };
            let before = Instant::now();
            let output = coordinator.tick(time, &states, || queue.pop_front());
            let took = before.elapsed();
            for (state, command) in states.iter_mut().zip(&output.commands) {
                bed::follow(state, command, now);
            }
            views.copy_from_slice(&output.tasks);
            output.retired.clear();
            if busy {
                times.push(took.as_nanos() as f64);
            }
            if times.len() == ticks {
                break;
            }
        }
        Ticks { rate: ticks as f64 / began.elapsed().as_secs_f64(), times }
    })
}

/// Times the whole tick as the tick thread runs it, with slots, wake-ups, rings and statistics. Free-running on a
/// virtual clock: wall time. Paced: the thread's processor time, including sleep and wake-up.
pub fn whole(arms: usize, load: Load, pace: Pace, plant: Plant, ticks: usize) -> Ticks {
    on_a_thread(move || {
        let clock = VirtualClock::starting_at(Mono(1_000_000_000));
        let (ports, mut world) = World::new(arms, load, plant, &clock);
        let coordinator = Coordinator::new(world.bed.config(), world.bed.tasks());
        let (sender, result) = channel();
        let mut meter = Meter { pace, times: Vec::with_capacity(ticks), ticks, began: None, left: None, sender };
        let (free, moved) = (pace == Pace::Free, clock.clone());
        let probe = move |tick: u64| {
            let busy = world.bed.is_busy(&world.views);
            meter.tick_over(tick, busy, &world.pulse);
            let now = if free { moved.now() } else { MonotonicClock.now() };
            world.turn(tick, now);
            if free {
                moved.advance(PERIOD);
            }
            meter.tick_begins();
        };
        let clock: &dyn Clock = if pace == Pace::Free { &clock } else { &MonotonicClock };
        tick_loop::run(coordinator, ports, PERIOD, clock, Some(Box::new(probe)));
        result.recv().expect("the probe sends before it stops the loop")
    })
}

/// Returns the median processor time that a real-time thread needs to sleep and wake up at 100 Hz [µs]: the cost of the
/// machine itself.
pub fn sleeper(ticks: usize) -> f64 {
    on_a_thread(move || {
        host::enter_realtime(host::TICK_PRIORITY);
        let start = MonotonicClock.now();
        let times = (1..=ticks as u32).map(|tick| {
            let before = host::thread_cpu_time();
            host::sleep_until(start.after(PERIOD * tick));
            (host::thread_cpu_time() - before).as_nanos() as f64 * 1e-3
        });
        quantile(&times.collect::<Vec<_>>(), 0.5)
    })
}

/// Measures from the end of one call of the probe to the beginning of the next.
struct Meter {
    pace: Pace,
    times: Vec<f64>,
    ticks: usize,
    began: Option<Instant>,
    left: Option<(Instant, Duration)>,
    sender: Sender<Ticks>,
}

impl Meter {
    fn tick_over(&mut self, tick: u64, busy: bool, pulse: &Pulse) {
        let Some((left, cpu)) = self.left.filter(|_| busy && tick > SETTLED && self.times.len() < self.ticks) else {
            return;
        };
        let began = *self.began.get_or_insert(left);
        let took = match self.pace {
            Pace::Free => left.elapsed(),
            Pace::Paced => host::thread_cpu_time() - cpu,
        };
        self.times.push(took.as_nanos() as f64);
        if self.times.len() == self.ticks {
            let rate = self.ticks as f64 / began.elapsed().as_secs_f64();
            let _ = self.sender.send(Ticks { times: std::mem::take(&mut self.times), rate });
            self.ticks = 0;
            pulse.stop.store(true, Ordering::Relaxed);
        }
    }

    fn tick_begins(&mut self) {
        let cpu = if self.pace == Pace::Paced { host::thread_cpu_time() } else { Duration::ZERO };
        self.left = Some((Instant::now(), cpu));
    }
}

/// Replacement of the arms.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Plant {
    /// Arms that reach their commands at once.
    Ideal,
    /// The adapter `mock`, called in every tick: one write, one read.
    Mock,
}

/// The environment of the tick thread, simulated by the probe.
struct World {
    bed: Bed,
    pulse: Arc<Pulse>,
    views: Vec<TaskView>,
    arms: Vec<Arm>,
    requests: rtrb::Producer<dimos::control::request::Envelope>,
    queue: VecDeque<dimos::control::request::Envelope>,
    replies: rtrb::Consumer<(u64, dimos::telemetry::Outcome)>,
    retired: rtrb::Consumer<Box<dimos::control::request::Motion>>,
    samples: rtrb::Consumer<Sample>,
    task_views: Vec<SlotReader<TaskView>>,
    _arm_views: Vec<SlotReader<ArmSample>>,
}

struct Arm {
    state: ArmState,
    states: SlotWriter<ArmState>,
    commands: SlotReader<ArmCommand>,
    mock: Option<(MockArm, JointReading)>,
}

impl World {
    fn new(arms: usize, load: Load, plant: Plant, clock: &VirtualClock) -> (TickPorts, Self) {
        let bed = Bed::new(arms, load);
        let tasks = bed.config().tasks.len();
        // Rings as long as those of a run at 100 Hz.
        let (sample_in, samples) = rtrb::RingBuffer::new(512 + (arms + 1) * 500);
        let (requests, request_out) = rtrb::RingBuffer::new(256);
        let (reply_in, replies) = rtrb::RingBuffer::new(512);
        let (retired_in, retired) = rtrb::RingBuffer::new(256 + 2 * tasks);
        let (state_in, state_out): (Vec<_>, Vec<_>) = (0..arms).map(|_| slot(bed::fresh_arm())).unzip();
        let (command_in, command_out): (Vec<_>, Vec<_>) = (0..arms).map(|_| slot(ArmCommand::default())).unzip();
        let sample = ArmSample {
            arm: 0,
            state: ArmState::default(),
            command: ArmCommand::default(),
            phase: Phase::Unknown,
            cause: Cause::None,
        };
        let (arm_views, arm_view_out) = (0..arms).map(|_| slot(sample)).unzip();
        let (task_view_in, task_views) = (0..tasks).map(|_| slot(TaskView::default())).unzip();
        let pulse = Arc::new(Pulse::default());
        let wake = || Wake::new().expect("an eventfd");
        let ports = TickPorts {
            states: state_out,
            commands: command_in,
            wakes: (0..arms).map(|_| wake()).collect(),
            dues: (0..arms).map(|_| Arc::default()).collect(),
            requests: request_out,
            replies: reply_in,
            reply_wake: wake(),
            retired: retired_in,
            samples: sample_in,
            arm_views,
            task_views: task_view_in,
            guard: None,
            source: dimos::control::pace::Source::Host,
            pulse: pulse.clone(),
        };
        let arms = state_in.into_iter().zip(command_out).map(|(states, commands)| {
            let mock = (plant == Plant::Mock).then(|| (mock_arm(clock), JointReading::default()));
            Arm { state: bed::fresh_arm(), states, commands, mock }
        });
        let world = Self {
            views: vec![TaskView::default(); tasks],
            arms: arms.collect(),
            bed,
            pulse,
            requests,
            queue: VecDeque::new(),
            replies,
            retired,
            samples,
            task_views,
            _arm_views: arm_view_out,
        };
        (ports, world)
    }

    /// Runs the other threads' work between two ticks.
    fn turn(&mut self, tick: u64, now: Mono) {
        for (view, slot) in self.views.iter_mut().zip(&mut self.task_views) {
            *view = slot.read();
        }
        self.bed.requests(tick, &self.views, &mut self.queue);
        while let Some(envelope) = self.queue.pop_front() {
            let _ = self.requests.push(envelope);
        }
        for arm in &mut self.arms {
            let command = arm.commands.read();
            match &mut arm.mock {
                None => bed::follow(&mut arm.state, &command, now),
                Some((mock, reading)) => exchange(mock, reading, &mut arm.state, &command),
            }
            arm.states.write(&arm.state);
        }
        while self.samples.pop().is_ok() {}
        while self.replies.pop().is_ok() {}
        while self.retired.pop().is_ok() {}
    }
}

fn mock_arm(clock: &VirtualClock) -> MockArm {
    let config =
        AdapterConfig { hardware_id: "arm".into(), address: String::new(), dof: DOF, options: serde_json::Value::Null };
    let mut mock = MockArm::with_clock(&config, Arc::new(clock.clone())).expect("a mock arm");
    mock.connect().and_then(|()| mock.activate()).expect("a mock arm that comes up");
    mock
}

/// Makes one write and one read, like a device thread.
fn exchange(mock: &mut MockArm, reading: &mut JointReading, state: &mut ArmState, command: &ArmCommand) {
    if let Some(mode) = command.mode {
        if mock.get_control_mode() != mode {
            mock.set_control_mode(mode).expect("a mode that it has");
        }
        mock.write_joint_positions(&command.values[..DOF], 1.0).expect("a command that it takes");
    }
    mock.read_joints(reading).expect("a state");
    (state.mode, state.written) = (mock.get_control_mode(), command.seq);
    state.seq += 1;
    state.stamp = reading.stamp.unwrap_or(state.stamp);
    state.position = reading.position;
    state.velocity = reading.velocity.unwrap_or_default();
}

fn on_a_thread<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> T {
    std::thread::spawn(work).join().expect("the measuring thread does not panic")
}
