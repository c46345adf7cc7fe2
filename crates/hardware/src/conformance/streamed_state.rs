//! Devices that stream their state, and the descriptor that wakes the device thread.

use std::os::fd::AsFd;
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::Check;
use super::Needs::Nothing;
use super::context::{Context, require};
use crate::adapter::JointReading;
use dimos_core::clock::{Clock, Mono, MonotonicClock};

/// The checks of this file.
pub const CHECKS: &[Check] = &[
    Check::new(Nothing, "state_wakes_its_reader", "a new state wakes the reader", wakes),
    Check::new(
        Nothing,
        "reads_take_all_that_came",
        "after a read the descriptor is not readable: no busy loop",
        drains,
    ),
    Check::new(
        Nothing,
        "reads_never_wait",
        "without a new state a read returns at once, with the old stamp",
        never_waits,
    ),
];

const ASKED: &str = "its state is polled";
/// Attempts per check. The limits below tolerate states that arrive between two calls, and a busy machine: a faulty
/// adapter fails nearly every attempt.
const TRIES: usize = 60;
/// Longest wait for the next state.
const STATE_TIMEOUT: Duration = Duration::from_secs(2);

/// Returns whether the adapter's descriptor becomes readable within `limit`.
fn readable(context: &Context, limit: Duration) -> Result<bool, String> {
    let state = context.adapter.state_fd().ok_or("state_fd has become None")?;
    let timeout = Timespec { tv_sec: limit.as_secs() as i64, tv_nsec: i64::from(limit.subsec_nanos()) };
    let borrowed = state.as_fd();
    let mut fds = [PollFd::new(&borrowed, PollFlags::IN)];
    poll(&mut fds, Some(&timeout)).map(|n| n > 0).map_err(|e| format!("poll of state_fd: {e}"))
}

/// Waits for the next state as the device thread does, which also reads after a period without a new state.
pub(super) fn await_state(context: &mut Context) -> Result<(), String> {
    let period = Duration::from_secs_f64(1.0 / context.adapter.get_info().native_rate);
    let end = MonotonicClock.now().after(STATE_TIMEOUT);
    while !readable(context, period)? {
        require(MonotonicClock.now() < end, || format!("no new state within {STATE_TIMEOUT:?}"))?;
        stamp(context)?;
    }
    Ok(())
}

/// Returns the stamp of a reading; a device that streams its state must have one.
fn stamp(context: &mut Context) -> Result<Mono, String> {
    let mut reading = JointReading::default();
    context.adapter.read_joints(&mut reading).map_err(|e| format!("read_joints: {e}"))?;
    reading.stamp.ok_or_else(|| "it streams its state, but its readings have no stamp".to_owned())
}

fn wakes(context: &mut Context) -> Result<(), String> {
    context.connect()?;
    if context.adapter.state_fd().is_none() {
        return context.skip(ASKED);
    }
    let first = stamp(context)?;
    let (mut last, mut newer) = (first, 0);
    for _ in 0..TRIES {
        await_state(context)?;
        let now = stamp(context)?;
        newer += usize::from(now > last);
        last = now;
    }
    // On a bus, one state may arrive in several frames, each of which wakes the reader.
    require(newer >= TRIES / 20, || format!("of {TRIES} wake-ups {newer} brought a new stamp"))?;
    context.found(format!("{:.0} states a second", newer as f64 / last.seconds_since(first)))
}

fn drains(context: &mut Context) -> Result<(), String> {
    context.connect()?;
    if context.adapter.state_fd().is_none() {
        return context.skip(ASKED);
    }
    // Long enough for several packets to arrive.
    let period = Duration::from_secs_f64(8.0 / context.adapter.get_info().native_rate);
    let mut quiet = 0;
    for _ in 0..TRIES / 3 {
        std::thread::sleep(period.clamp(Duration::from_millis(5), Duration::from_millis(100)));
        await_state(context)?;
        // The second read takes what arrived during the first one, or the reply to its request.
        for _ in 0..2 {
            stamp(context)?;
        }
        quiet += usize::from(!readable(context, Duration::ZERO)?);
    }
    let loud = TRIES / 3 - quiet;
    require(quiet >= TRIES / 12, || format!("after {loud} of {} reads the descriptor was still readable", TRIES / 3))
}

fn never_waits(context: &mut Context) -> Result<(), String> {
    context.connect()?;
    if context.adapter.state_fd().is_none() {
        return context.skip(ASKED);
    }
    let (mut same, mut times) = (0, Vec::with_capacity(TRIES));
    for _ in 0..TRIES {
        await_state(context)?;
        let before = stamp(context)?;
        let began = MonotonicClock.now();
        let after = stamp(context)?;
        times.push(MonotonicClock.now().since(began));
        same += usize::from(after == before);
    }
    require(same >= TRIES / 6, || format!("{} of {TRIES} second reads had a new stamp", TRIES - same))?;
    times.sort();
    let median = times.get(TRIES / 2).copied().unwrap_or_default();
    let period = Duration::from_secs_f64(1.0 / context.adapter.get_info().native_rate);
    require(median < period / 3, || format!("a read without a new state takes {median:?} of a period of {period:?}"))
}
