//! What is asked of an arm as a whole: stop, reset, enable, disable.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use super::service::{STANDSTILL, Service, internal};
use crate::arm::Link;
use crate::control::request::Request;
use crate::hardware::device::{Answer, Device};
use crate::hardware::spec::{AdapterError, AdapterResult};
use crate::rpc::api::{self, Reply};
use crate::rpc::{Code, RpcError};
use crate::telemetry::describe::cause_text;
use crate::telemetry::{Outcome, Phase};

/// How long a stopped arm gets to come to rest and confirm.
const STOP_LIMIT: Duration = Duration::from_secs(3);
/// What a braking arm gets beside the time that its limits need: a few ticks, and its lag.
const REACTION: Duration = Duration::from_millis(250);
/// How long an arm at rest gets until nothing is commanded any more.
const SETTLING_LIMIT: Duration = Duration::from_secs(1);
/// How long a request to disable waits at most: clients wait 10 s for an answer, and the device needs some of that.
const BRAKING_LIMIT: Duration = Duration::from_secs(7);
/// How long an order to a device may take.
const ORDER_LIMIT: Duration = Duration::from_secs(8);
/// How long an enabled arm gets to be ready.
const READY_LIMIT: Duration = Duration::from_secs(2);

impl Service {
    pub(super) async fn stop(&self, call: api::Stop) -> Result<Reply, RpcError> {
        let arm = call.arm.as_deref().map(|a| self.arm_index(a)).transpose()?;
        self.ask(Request::Stop { arm }).await?;
        let limit = Instant::now() + STOP_LIMIT;
        let mut arms = BTreeMap::new();
        for (i, config) in self.parts.config.arms.iter().enumerate() {
            if arm.is_some_and(|a| a as usize != i) {
                continue;
            }
            let confirmation = loop {
                match self.confirmation(i) {
                    Some(c) => break c,
                    None if Instant::now() >= limit => break api::Confirmation::SentNotConfirmed,
                    None => tokio::time::sleep(Duration::from_millis(5)).await,
                }
            };
            if confirmation == api::Confirmation::NotSent {
                self.stop_not_sent(i);
            }
            arms.insert(config.name.clone(), confirmation);
        }
        Ok(Reply::Stop(api::StopReply { arms }))
    }

    /// How far an arm's stop has come; `None`: not yet known.
    pub(super) fn confirmation(&self, arm: usize) -> Option<api::Confirmation> {
        let (view, device) = (self.arm_view(arm)?, self.parts.devices.get(arm)?);
        if view.state.link != Link::Up {
            return Some(api::Confirmation::NotSent);
        }
        if !view.state.enabled {
            return Some(api::Confirmation::Confirmed); // Its motors are off: the arm itself says so.
        }
        let (asked, health) = (view.command.stop_seq, device.health());
        let is_asked = view.phase == Phase::Held && view.command.mode.is_none() && asked > 0;
        if !is_asked {
            return None;
        }
        // In this order: a stop that is sent has been confirmed before, or never is.
        if health.stop_sent.load(Ordering::Acquire) != asked {
            return None;
        }
        let confirmed = health.stop_confirmed.load(Ordering::Relaxed) == asked;
        Some(if confirmed { api::Confirmation::Confirmed } else { api::Confirmation::SentNotConfirmed })
    }

    pub(super) async fn reset(&self, id: String) -> Result<Reply, RpcError> {
        let arm = self.arm_index(&id)?;
        let device = self.device(arm)?;
        let view = self.arm_view(arm as usize);
        let cause = view.filter(|v| v.phase == Phase::Held).map(|v| cause_text(v.cause));
        if cause.is_some() {
            let cleared = order(device.clear_errors()).await;
            match cleared {
                Ok(()) | Err(AdapterError::NotConnected) => {}
                Err(e) => return Err(refused(&id, "did not clear its error", &e)),
            }
            // The next tick must see the state after the clearing.
            tokio::time::sleep(self.period() * 2).await;
        }
        self.ask(Request::Reset { arm }).await?;
        let mut reply = self.phase_of(id, arm).await;
        // What was wrong is read once more before the arm is enabled.
        reply.note = cause.map(|cause| format!("was held: {cause}"));
        Ok(Reply::ArmReset(reply))
    }

    pub(super) async fn enable(&self, id: String) -> Result<Reply, RpcError> {
        let arm = self.arm_index(&id)?;
        let view = self.arm_view(arm as usize).ok_or_else(internal)?;
        match view.phase {
            Phase::Held => {
                let outcome = Outcome::ArmLatched(arm, view.cause);
                return self.refusal(&outcome).map_or_else(|| Err(internal()), Err);
            }
            Phase::Ready | Phase::Activating => {}
            _ => {
                order(self.device(arm)?.activate()).await.map_err(|e| refused(&id, "was not enabled", &e))?;
                self.ask(Request::Ready { arm }).await?;
            }
        }
        let limit = Instant::now() + READY_LIMIT;
        loop {
            let view = self.arm_view(arm as usize).ok_or_else(internal)?;
            let outcome = match view.phase {
                Phase::Ready => return self.phase_reply(id, arm).await,
                // A stop or a fault overtook it.
                Phase::Held => Outcome::ArmLatched(arm, view.cause),
                phase if Instant::now() >= limit => Outcome::ArmNotReady(arm, phase, view.cause),
                _ => {
                    tokio::time::sleep(Duration::from_millis(5)).await;
                    continue;
                }
            };
            return self.refusal(&outcome).map_or_else(|| Err(internal()), Err);
        }
    }

    /// Switches an arm's motors off: when it is at rest, or `now`.
    pub(super) async fn disable(&self, id: String, now: bool) -> Result<Reply, RpcError> {
        let arm = self.arm_index(&id)?;
        let limit = Instant::now() + self.braking_limit(arm);
        self.ask(Request::Park { arm }).await?;
        if !now {
            self.wait_for_rest(&id, arm, limit).await?;
        }
        let speed = self.speed(arm);
        order(self.device(arm)?.disable()).await.map_err(|e| refused(&id, "was not disabled", &e))?;
        tokio::time::sleep(self.period() * 2).await;
        let mut reply = self.phase_of(id, arm).await;
        if now {
            let was =
                if speed > STANDSTILL { format!("while it moved at {speed:.2} rad/s") } else { "at rest".to_owned() };
            reply.note = Some(format!("the motors were switched off at once, {was}"));
        }
        Ok(Reply::ArmDisable(reply))
    }

    /// Waits until an arm is at rest, or refuses when it still moves at the limit.
    async fn wait_for_rest(&self, id: &str, arm: u16, limit: Instant) -> Result<(), RpcError> {
        let settled = limit + SETTLING_LIMIT;
        // Where nothing is commanded any more the device has been asked to stop, or was not moved by us.
        while self.arm_view(arm as usize).is_some_and(|v| v.command.mode.is_some()) {
            let (now, speed) = (Instant::now(), self.speed(arm));
            if now >= if speed > STANDSTILL { limit } else { settled } {
                return Err(still_moves(id, speed));
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        let speed = self.speed(arm);
        while self.speed(arm) > STANDSTILL {
            if Instant::now() >= limit {
                return Err(still_moves(id, speed));
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        Ok(())
    }

    /// How long an arm gets to brake: twice as long as its fastest joint needs at its limit of acceleration.
    fn braking_limit(&self, arm: u16) -> Duration {
        let config = self.parts.config.arms.get(arm as usize);
        let view = self.arm_view(arm as usize);
        let joints = view.iter().zip(config).flat_map(|(view, config)| {
            view.state.velocity.into_iter().zip(config.limits.acceleration_max.clone()).take(config.dof)
        });
        let fastest = joints.max_by(|a, b| a.0.abs().total_cmp(&b.0.abs()));
        let braking = fastest.map_or(0.0, |(velocity, acceleration)| 2.0 * velocity.abs() / acceleration);
        // What the ticks and the arm's lag add; and the client is to hear of it while it waits.
        let braking = Duration::try_from_secs_f64(braking).unwrap_or(BRAKING_LIMIT);
        (braking + REACTION).min(BRAKING_LIMIT)
    }

    /// Velocity of an arm's fastest joint [rad/s]; zero where the arm cannot be seen.
    fn speed(&self, arm: u16) -> f64 {
        let view = self.arm_view(arm as usize).filter(|view| view.state.link == Link::Up);
        let joints = view.iter().flat_map(|view| view.state.velocity.iter().take(view.state.dof));
        joints.map(|v| v.abs()).fold(0.0, f64::max)
    }

    async fn phase_reply(&self, arm: String, index: u16) -> Result<Reply, RpcError> {
        Ok(Reply::ArmReset(self.phase_of(arm, index).await))
    }

    /// An arm's phase after the next tick.
    async fn phase_of(&self, arm: String, index: u16) -> api::ArmReply {
        tokio::time::sleep(self.period()).await;
        api::ArmReply { arm, phase: self.phase(index as usize).name().to_owned(), note: None }
    }

    pub(super) fn device(&self, arm: u16) -> Result<Arc<Device>, RpcError> {
        self.parts.devices.get(arm as usize).cloned().ok_or_else(internal)
    }
}

fn still_moves(arm: &str, speed: f64) -> RpcError {
    let text = format!("{arm} still moves at {speed:.2} rad/s: it is braking, and its motors stay on");
    RpcError::new(Code::ArmNotReady, text)
        .hint(format!(
            "again when it is at rest; `dimos arm disable --now {arm}` switches off at once: it may fall or swing"
        ))
        .data(serde_json::json!({"arm": arm, "speed": speed}))
}

/// Waits for a device without holding up the others who talk to the run.
async fn order<T: Send + 'static>(answer: Answer<T>) -> AdapterResult<T> {
    let waited = tokio::task::spawn_blocking(move || answer.wait(ORDER_LIMIT)).await;
    waited.unwrap_or_else(|e| Err(AdapterError::Io(e.to_string())))
}

fn refused(arm: &str, what: &str, error: &AdapterError) -> RpcError {
    let text = format!("{arm} {what}: {error}");
    // An adapter that knows what to do says so in a line of its own.
    let general = "see the arm's own panel or manual; `dimos status` shows its link and error";
    let (text, hint) = text.split_once("\nhint: ").unwrap_or((&text, general));
    RpcError::new(Code::DeviceRefused, text).hint(hint)
}
