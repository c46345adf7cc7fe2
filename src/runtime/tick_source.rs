//! What starts the ticks of a run: this computer's clock, or an arm (`coordinator.clock`).

use std::time::Duration;

use super::StartError;
use super::arm::arms::Arms;
use crate::blueprint::{Blueprint, TickClock};
use dimos_control::pace::Source;
use dimos_hardware::device::Connected;

/// Maximum ratio between the arm's rate and the tick's.
const MAX_RATIO: f64 = 100.0;

/// Returns the source of the ticks. An arm that cannot clock them is an error: it must stream its state,
/// at the tick's rate or a multiple of it.
pub(in crate::runtime) fn source<'a>(
    blueprint: &Blueprint,
    arms: &mut Arms,
    connected: impl IntoIterator<Item = &'a Connected>,
) -> Result<Source, StartError> {
    let TickClock::Device(id) = &blueprint.coordinator.clock else { return Ok(Source::Host) };
    let found = blueprint.arms.iter().zip(connected).enumerate().find(|(_, (arm, _))| arm.hardware_id == *id);
    // The blueprint was checked.
    let (Some((arm, (_, connected))), Some(wake)) = (found, arms.pace.take()) else { return Ok(Source::Host) };
    let wrong = |what: String, hint: String| Err(StartError::Hardware { arm: id.clone(), what, hint });
    if !connected.streams {
        let what = "it cannot clock the ticks: its state is asked for, not streamed".to_owned();
        return wrong(what, "remove `coordinator.clock`, or write `clock: host`".to_owned());
    }
    let (own, rate) = (connected.info.native_rate, blueprint.coordinator.tick_rate);
    let ratio = own / rate;
    if (ratio - ratio.round()).abs() > 1e-6 || !(0.5..MAX_RATIO).contains(&ratio) {
        let what = format!("it cannot clock the ticks at {rate} Hz: it sends its state at {own} Hz");
        return wrong(what, format!("set `coordinator.tick_rate: {own}`, or a whole fraction of it"));
    }
    Ok(Source::Device { arm, wake, cycle: Duration::from_secs_f64(1.0 / own) })
}
