//! A gripper command, until the gripper has settled.

use std::time::{Duration, Instant};

use crate::cli::exit::{Exit, Failure, Result};
use crate::cli::follow::Signals;
use crate::rpc::api::{Gripper, State};
use crate::rpc::client::Client;

/// Poll period.
const POLL_PERIOD: Duration = Duration::from_millis(20);
/// A gripper that has not moved for this long has settled.
const SETTLED: Duration = Duration::from_millis(400);
/// Part of its range within which a gripper is at a position.
const TOLERANCE: f64 = 0.02;

/// Where a gripper settled.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settled {
    /// Its position [m or rad]; absent if the device does not report it.
    pub position: Option<f64>,
    /// Whether that is the commanded one.
    pub reached: bool,
}

/// Commands a gripper and waits until it is at its target, or has stopped before. `range`: its width of motion [m or
/// rad]. A signal ends the wait, not the gripper's motion.
pub fn command(
    client: &mut Client,
    call: Gripper,
    range: f64,
    timeout: Duration,
    signals: &Signals,
) -> Result<Settled> {
    let (arm, target) = (call.arm.clone(), call.position);
    client.call(call)?;
    let (began, mut moved, mut before) = (Instant::now(), Instant::now(), f64::NAN);
    loop {
        let state = client.call(State {})?;
        let position = state.arms.iter().find(|a| a.hardware_id == arm).and_then(|a| a.gripper);
        let Some(at) = position else { return Ok(Settled { position, reached: true }) };
        let near = TOLERANCE * range;
        if (at - target).abs() <= near {
            return Ok(Settled { position, reached: true });
        }
        // The first change of any size ends the wait for the beginning of the motion.
        if (at - before).abs() > 0.02 * near || before.is_nan() {
            (moved, before) = (Instant::now(), at);
        }
        if moved.elapsed() >= SETTLED || signals.last().is_some() {
            return Ok(Settled { position, reached: false });
        }
        if began.elapsed() > timeout {
            let what = format!("the gripper of {arm} still moves after {} s", timeout.as_secs_f64());
            return Err(Failure::new(Exit::Failed, what).hint("give it more time: `timeout`"));
        }
        std::thread::sleep(POLL_PERIOD);
    }
}
