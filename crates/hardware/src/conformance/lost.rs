//! A command or an answer that is lost on the wire.

use std::time::{Duration, Instant};

use super::Check;
use super::Needs::Faults;
use super::context::{Context, farthest, pause, require, rest_point};
use super::stops::{SLOW, set_off};
use crate::adapter::{JointReading, Stop};
use crate::sim::faults::{Fault, FaultKind};
use dimos_core::joint::ControlMode;

/// The checks of this file.
pub const CHECKS: &[Check] = &[
    Check::new(
        Faults,
        "lost_commands_are_noticed",
        "what returns Ok is done, also when one command without an answer is lost",
        commands,
    ),
    Check::new(Faults, "a_lost_answer_holds_no_arm", "one lost answer costs less than stale_after", answers),
];

/// How long a stopped arm is observed: without the stop it moves on for longer than it coasts.
const OBSERVATION_TIME: Duration = Duration::from_millis(600);
/// How often an answer is lost.
const TRIES: usize = 5;

/// Setpoints of a stream are exempt: the next one follows at once.
fn commands(context: &mut Context) -> Result<(), String> {
    let lost = Fault::new(FaultKind::LostCommand);
    if context.emulator.is_none() || !(0..4).all(|_| context.prepare(lost)) {
        return context.skip("its emulator answers every command");
    }
    context.connect()?;
    context.trigger_faults()?;
    if context.adapter.activate().is_ok() {
        context.until("the motors to come on after activate", Context::enabled)?;
    }
    context.activate()?;
    if context.has_mode(ControlMode::Position) {
        context.set_mode(ControlMode::Position).map_err(|e| format!("set_control_mode: {e}"))?;
        let start = context.positions()?;
        let near = context.nearby(&start)?;
        context.trigger_faults()?;
        if context.command(&near, 0.5).is_ok() {
            context.arrive("a planned move", &near)?;
        }
        set_off(context)?;
        context.trigger_faults()?;
        let rest = rest_point(&mut *context.adapter);
        if context.adapter.write_stop(&rest) == Ok(Stop::Confirmed) {
            let here = context.positions()?;
            pause(&mut *context.adapter, OBSERVATION_TIME);
            let moved = farthest(&context.positions()?, &here);
            let fastest = context.limits()?.velocity_max.iter().copied().fold(0.0, f64::max);
            let most = context.coasting(SLOW * fastest)? + context.droop();
            require(moved < most, || format!("a stop is confirmed, but the arm moves on by {moved:.3} rad"))?;
        }
        context.stop()?;
        context.standstill()?;
    }
    context.trigger_faults()?;
    if context.adapter.write_enable(false).is_ok() {
        context.until("the motors to go off", |context| Ok(!context.enabled()?))?;
    }
    Ok(())
}

/// The shortest of several times counts: a busy machine only makes them longer.
fn answers(context: &mut Context) -> Result<(), String> {
    let lost = Fault::new(FaultKind::Silent);
    if context.emulator.is_none() || !(0..TRIES).all(|_| context.prepare(lost)) {
        return context.skip("its emulator loses no answer");
    }
    context.connect()?;
    if context.adapter.state_fd().is_some() {
        return context.skip("it has no requests for its state");
    }
    let mut shortest = Duration::MAX;
    for _ in 0..TRIES {
        context.positions()?;
        let last = Instant::now();
        context.trigger_faults()?;
        context.until("a state", |context| Ok(context.adapter.read_joints(&mut JointReading::default()).is_ok()))?;
        shortest = shortest.min(last.elapsed());
    }
    let (ms, limit) = (1e3 * shortest.as_secs_f64(), context.row.stale_after);
    require(shortest < limit, || {
        format!("one lost answer costs {ms:.0} ms without a state; stale_after is {limit:?}: the arm would be held")
    })?;
    context.found(format!("{ms:.0} ms, held after {limit:?}"))
}
