//! Old news: an arm that falls silent, and one that repeats what it has said.
//!
//! An adapter never passes off an old measurement as a new one. Where nothing new has come it answers with an error,
//! or (a device that sends by itself) with the stamp of the old one, so that the age of the state is the truth.

use std::time::Duration;

use super::Check;
use super::Needs::Faults;
use super::context::{Context, require};
use crate::clock::{Clock, Mono, MonotonicClock};
use crate::hardware::adapter::JointReading;
use crate::hardware::sim::faults::{Fault, FaultKind};

/// The checks of this file.
pub const CHECKS: &[Check] = &[
    Check::new(Faults, "silence_is_noticed", "of a silent arm no reading is new, and soon an error", silence),
    Check::new(Faults, "frozen_state_is_noticed", "a measurement that is repeated keeps its stamp", frozen),
];

/// For how long an arm stays silent or frozen [s]: longer than any check lasts.
const LONG: f64 = 60.0;
/// What was on its way when the silence fell arrives within this time. Very generous: the emulator may have to wait
/// for a processor.
const LATE: Duration = Duration::from_secs(3);
/// Without news for this long, none is on its way any more.
const QUIET: Duration = Duration::from_millis(300);
/// For how long old news are watched.
const WATCH: Duration = Duration::from_secs(1);
/// A single call never takes longer.
const BOUND: Duration = Duration::from_secs(2);
/// What counts as the same stamp: two clocks are compared [s].
const SAME: f64 = 0.005;

/// One reading: its stamp (`Ok(None)`: it gives no time), or that there is none.
fn look(context: &mut Context) -> Result<Result<Option<Mono>, ()>, String> {
    let mut reading = JointReading::default();
    let began = MonotonicClock.now();
    let result = context.adapter.read_joints(&mut reading);
    let took = MonotonicClock.now().since(began);
    require(took < BOUND, || format!("read_joints took {took:?}"))?;
    std::thread::sleep(Duration::from_millis(5));
    Ok(result.map(|()| reading.stamp).map_err(drop))
}

/// Waits until what was under way has arrived: the stamp that stands, or `None` when readings fail.
fn settle(context: &mut Context) -> Result<Option<Mono>, String> {
    let struck = MonotonicClock.now();
    let mut last = (Mono::ZERO, struck);
    while MonotonicClock.now().since(struck) < LATE {
        let now = MonotonicClock.now();
        match look(context)? {
            Err(()) => return Ok(None),
            Ok(Some(stamp)) if stamp.seconds_since(last.0) > SAME => last = (stamp, now),
            Ok(Some(stamp)) if now.since(last.1) > QUIET => return Ok(Some(stamp)),
            Ok(_) => {}
        }
    }
    Err(format!("{} s after the last measurement its readings are still new", LATE.as_secs()))
}

fn silence(context: &mut Context) -> Result<(), String> {
    if !context.prepare(Fault::new(FaultKind::Silent).lasting(LONG)) {
        return context.skip("its double cannot be silent");
    }
    context.connect()?;
    context.positions()?;
    context.trigger_faults()?;
    let old = settle(context)?;
    context.until("an error", |context| {
        let now = look(context)?;
        let news = matches!((now, old), (Ok(Some(stamp)), Some(old)) if stamp.seconds_since(old) > SAME);
        require(!news, || "a reading of a silent arm claims to be new".into())?;
        Ok(now.is_err())
    })?;
    let end = MonotonicClock.now().after(WATCH);
    while MonotonicClock.now() < end {
        let now = look(context)?;
        require(now.is_err(), || "after the error, a silent arm is read again".into())?;
    }
    Ok(())
}

fn frozen(context: &mut Context) -> Result<(), String> {
    if !context.prepare(Fault::new(FaultKind::Frozen).lasting(LONG)) {
        return context.skip("its double cannot repeat itself");
    }
    context.connect()?;
    if context.joints()?.stamp.is_none() {
        return context.skip("it gives no time");
    }
    context.trigger_faults()?;
    let Some(old) = settle(context)? else {
        return Ok(()); // it is an error to this adapter, which is as good
    };
    let end = MonotonicClock.now().after(WATCH);
    while MonotonicClock.now() < end {
        if let Ok(Some(stamp)) = look(context)? {
            let younger = stamp.seconds_since(old);
            require(younger < SAME, || format!("the same measurement is now {younger:.3} s younger"))?;
        }
    }
    Ok(())
}
