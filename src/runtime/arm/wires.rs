//! The rings and slots between the tick and the rest of a run.

use std::sync::Arc;

use super::arms::{Arms, Slots};
use crate::runtime::StartError;
use crate::runtime::client::dispatch::REQUEST_RING;
use crate::runtime::plan::guard_worlds::GuardEnds;
use dimos_control::config::CoordinatorConfig;
use dimos_control::pace::Source;
use dimos_control::request::{Envelope, Motion};
use dimos_control::tick_loop::{GuardPorts, Pulse, TickPorts};
use dimos_core::arm::{ArmCommand, ArmState};
use dimos_core::telemetry::{ArmSample, Cause, Outcome, Phase, Sample, TaskView, TickSample};
use dimos_rt::host;
use dimos_rt::slot::{SlotReader, slot};
use dimos_rt::wake::Wake;

/// Capacity of the recorder's ring [s].
const RING_SECONDS: f64 = 5.0;

/// The ends for the other threads.
pub(in crate::runtime) struct Ends {
    pub requests: rtrb::Producer<Envelope>,
    pub replies: rtrb::Consumer<(u64, Outcome)>,
    pub reply_wake: Wake,
    pub retired: rtrb::Consumer<Box<Motion>>,
    pub samples: rtrb::Consumer<Sample>,
    pub arm_views: Vec<SlotReader<ArmSample>>,
    pub task_views: Vec<SlotReader<TaskView>>,
    pub guard: Option<GuardEnds>,
}

/// Creates all of them. Answers of a device thread wake the same thread as replies of the tick.
pub(in crate::runtime) fn wires(
    config: &CoordinatorConfig,
    slots: Slots,
    arms: &Arms,
    source: Source,
    pulse: Arc<Pulse>,
    guarded: bool,
) -> Result<(TickPorts, Ends), StartError> {
    let reply_wake = Wake::new().map_err(|e| StartError::other(format!("no eventfd: {e}"), "see ulimit -n"))?;
    for device in &arms.devices {
        device.health().wake_on_answers(reply_wake.clone());
    }
    let (mut sample_producer, mut samples) = rtrb::RingBuffer::new(ring_size(config));
    touch(&mut sample_producer, &mut samples);
    let (requests, request_consumer) = rtrb::RingBuffer::new(REQUEST_RING);
    let (reply_producer, replies) = rtrb::RingBuffer::new(2 * REQUEST_RING);
    let (retired_producer, retired) = rtrb::RingBuffer::new(REQUEST_RING + 2 * config.tasks.len());
    let nothing = ArmSample {
        arm: 0,
        state: ArmState::default(),
        command: ArmCommand::default(),
        phase: Phase::Unknown,
        cause: Cause::None,
    };
    let (arm_writers, arm_views) = config.arms.iter().map(|_| slot(nothing)).unzip();
    let (task_writers, task_views) = config.tasks.iter().map(|_| slot(TaskView::default())).unzip();
    let (guard_ports, guard) = guarded.then(guard_wires).unzip();
    let ports = TickPorts {
        states: slots.states,
        commands: slots.commands,
        wakes: arms.devices.iter().map(|d| d.wake()).collect(),
        dues: arms.devices.iter().map(|d| d.due()).collect(),
        requests: request_consumer,
        replies: reply_producer,
        reply_wake: reply_wake.clone(),
        retired: retired_producer,
        samples: sample_producer,
        arm_views: arm_writers,
        task_views: task_writers,
        guard: guard_ports,
        source,
        pulse,
    };
    Ok((ports, Ends { requests, replies, reply_wake, retired, samples, arm_views, task_views, guard }))
}

/// Creates the rings of the collision guard. The tick takes a world each tick: a few are enough.
fn guard_wires() -> (GuardPorts, GuardEnds) {
    let (world_producer, worlds) = rtrb::RingBuffer::new(4);
    let (retired_producer, retired) = rtrb::RingBuffer::new(8);
    (GuardPorts { worlds, retired: retired_producer }, GuardEnds { worlds: world_producer, retired })
}

/// Touches every page of the ring, so that filling it for the first time causes no page fault.
fn touch(producer: &mut rtrb::Producer<Sample>, consumer: &mut rtrb::Consumer<Sample>) {
    while producer.push(Sample::Tick(TickSample::default())).is_ok() {}
    if let Ok(chunk) = consumer.read_chunk(consumer.slots()) {
        let (first, second) = chunk.as_slices();
        host::lock_pages(first);
        host::lock_pages(second);
        chunk.commit_all();
    }
}

fn ring_size(config: &CoordinatorConfig) -> usize {
    let per_tick = config.arms.len() + 1;
    512 + (per_tick as f64 * config.rate * RING_SECONDS) as usize
}
