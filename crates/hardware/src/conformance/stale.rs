//! Stale state: an arm that falls silent, and one that repeats a measurement.
//!
//! An adapter never reports an old measurement as new. Without a new one it returns an error or, for a device that
//! streams its state, the stamp of the old one, so that the age of the state is correct.

use std::time::Duration;

use super::Check;
use super::Needs::Faults;
use super::context::{Context, between, require};
use crate::adapter::JointReading;
use crate::sim::faults::{Fault, FaultKind};
use dimos_core::clock::{Clock, Mono, MonotonicClock};

/// The checks of this file.
pub const CHECKS: &[Check] = &[
    Check::new(Faults, "silence_is_noticed", "readings of a silent arm are not new, and soon errors", silence),
    Check::new(Faults, "late_answers_are_not_new", "a late answer does not count as the next one", late),
    Check::new(Faults, "frozen_state_is_noticed", "a measurement that is repeated keeps its stamp", frozen),
];

/// How late answers are [s]: later than any adapter waits, at least once.
const STALLS: [f64; 5] = [0.02, 0.04, 0.06, 0.12, 0.25];
/// Readings after each of them.
const LATE_READINGS: u32 = 25;
/// The reading whose answer is late.
const LATE_FROM: u32 = 3;
/// Tolerance of a position that was measured during the call [rad].
const LATE_TOLERANCE: f64 = 0.002;
/// How long an arm stays silent or frozen [s]: longer than any check.
const FAULT_TIME: f64 = 60.0;
/// Delayed states arrive within this time. Generous, because the emulator may have to wait for a processor.
const MAX_DELAY: Duration = Duration::from_secs(3);
/// Without a new state for this long, none is delayed.
const QUIET_TIME: Duration = Duration::from_millis(300);
/// How long stale readings are checked.
const OBSERVATION_TIME: Duration = Duration::from_secs(1);
/// Maximum duration of a call.
const CALL_TIMEOUT: Duration = Duration::from_secs(2);
/// Tolerance for equal stamps: two clocks are compared [s].
const STAMP_TOLERANCE: f64 = 0.005;

/// Returns the stamp of one reading (`Ok(None)`: without a stamp), or its error.
fn look(context: &mut Context) -> Result<Result<Option<Mono>, ()>, String> {
    let mut reading = JointReading::default();
    let began = MonotonicClock.now();
    let result = context.adapter.read_joints(&mut reading);
    let took = MonotonicClock.now().since(began);
    require(took < CALL_TIMEOUT, || format!("read_joints took {took:?}"))?;
    std::thread::sleep(Duration::from_millis(5));
    Ok(result.map(|()| reading.stamp).map_err(drop))
}

/// Waits until delayed states have arrived. Returns the final stamp, or `None` when readings fail.
fn settle(context: &mut Context) -> Result<Option<Mono>, String> {
    let began = MonotonicClock.now();
    let mut last = (Mono::ZERO, began);
    while MonotonicClock.now().since(began) < MAX_DELAY {
        let now = MonotonicClock.now();
        match look(context)? {
            Err(()) => return Ok(None),
            Ok(Some(stamp)) if stamp.seconds_since(last.0) > STAMP_TOLERANCE => last = (stamp, now),
            Ok(Some(stamp)) if now.since(last.1) > QUIET_TIME => return Ok(Some(stamp)),
            Ok(_) => {}
        }
    }
    Err(format!("{} s after the last measurement its readings are still new", MAX_DELAY.as_secs()))
}

fn silence(context: &mut Context) -> Result<(), String> {
    if !context.prepare(Fault::new(FaultKind::Silent).lasting(FAULT_TIME)) {
        return context.skip("its emulator cannot be silent");
    }
    context.connect()?;
    context.positions()?;
    context.trigger_faults()?;
    let old = settle(context)?;
    context.until("an error", |context| {
        let now = look(context)?;
        let news = matches!((now, old), (Ok(Some(stamp)), Some(old)) if stamp.seconds_since(old) > STAMP_TOLERANCE);
        require(!news, || "a reading of a silent arm claims to be new".into())?;
        Ok(now.is_err())
    })?;
    let end = MonotonicClock.now().after(OBSERVATION_TIME);
    while MonotonicClock.now() < end {
        let now = look(context)?;
        require(now.is_err(), || "after the error, reading a silent arm succeeds".into())?;
    }
    Ok(())
}

/// While the arm moves, each reading must be of a time within its call. Where replies carry no number, one late reply
/// may count once, and on a busy computer the next one too; an adapter that discards nothing lags one reading behind
/// from then on.
fn late(context: &mut Context) -> Result<(), String> {
    context.leave_out_calibration()?;
    if !STALLS.iter().all(|seconds| context.prepare(Fault::new(FaultKind::Stall).lasting(*seconds))) {
        return context.skip("its emulator cannot answer late");
    }
    let Some(mode) = context.position_mode() else { return context.skip("it has no position mode") };
    context.ready(mode)?;
    if context.adapter.state_fd().is_some() || context.true_positions().is_none() {
        return context.skip("it has no requests for its state");
    }
    let start = context.positions()?;
    let away = context.nearby(&start)?;
    let mut judged = 0;
    for _ in STALLS {
        let (mut answered, mut late) = (true, 0);
        for i in 0..LATE_READINGS {
            // Back and forth, so that it moves at every reading.
            let part = 0.5 - 0.5 * (f64::from(i) * std::f64::consts::TAU / f64::from(LATE_READINGS)).cos();
            if answered {
                // That it is refused, or late, is no matter of this check.
                let _ = context.adapter.write_joint_positions(&between(&start, &away, part), 1.0);
            }
            std::thread::sleep(Duration::from_millis(20));
            if i == LATE_FROM {
                context.trigger_faults()?;
            }
            let before = context.true_positions().unwrap_or_default();
            let mut reading = JointReading::default();
            let result = context.adapter.read_joints(&mut reading);
            let after = context.true_positions().unwrap_or_default();
            answered = result.is_ok();
            judged += u32::from(answered && i > LATE_FROM);
            let beyond = |(q, (a, b)): &(&f64, (&f64, &f64))| (a.min(**b) - **q).max(**q - a.max(**b)) > LATE_TOLERANCE;
            let off = reading.position.iter().zip(before.iter().zip(&after)).find(beyond).filter(|_| answered);
            late = if off.is_some() { late + 1 } else { 0 };
            if let Some((q, (_, b))) = off {
                require(late < 3, || format!("after a late answer it reads {q:.4} rad, a joint is at {b:.4} rad"))?;
            }
        }
    }
    require(judged >= LATE_READINGS, || format!("after late answers only {judged} requests were answered"))
}

fn frozen(context: &mut Context) -> Result<(), String> {
    if !context.prepare(Fault::new(FaultKind::Frozen).lasting(FAULT_TIME)) {
        return context.skip("its emulator cannot freeze its state");
    }
    context.connect()?;
    if context.joints()?.stamp.is_none() {
        return context.skip("its states have no time stamp");
    }
    context.trigger_faults()?;
    let Some(old) = settle(context)? else {
        return Ok(()); // this adapter returns an error instead
    };
    let end = MonotonicClock.now().after(OBSERVATION_TIME);
    while MonotonicClock.now() < end {
        if let Ok(Some(stamp)) = look(context)? {
            let younger = stamp.seconds_since(old);
            require(younger < STAMP_TOLERANCE, || format!("the same measurement is now {younger:.3} s younger"))?;
        }
    }
    Ok(())
}
