//! What is asked of an arm as a whole: stop, reset, enable, disable; and of its gripper.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use super::dispatch::log_of;
use super::service::{Service, internal};
use crate::arm::Link;
use crate::control::request::Request;
use crate::hardware::adapter::{AdapterError, AdapterResult};
use crate::hardware::device::{Answer, Device};
use crate::joint::STANDSTILL;
use crate::message::Message;
use crate::rpc::api::{self, Done, Reply};
use crate::rpc::{Code, RpcError};
use crate::telemetry::describe::cause_text;
use crate::telemetry::{ArmSample, Outcome, Phase};

/// Timeout for a stopped arm to decelerate to rest and confirm.
const STOP_LIMIT: Duration = Duration::from_secs(3);
/// What a braking arm gets beside the time that its limits need: a few ticks, and its lag.
const REACTION: Duration = Duration::from_millis(250);
/// Timeout for an arm at rest until no command is sent to it.
const SETTLING_LIMIT: Duration = Duration::from_secs(1);
/// How long a request to disable waits at most: clients wait 10 s for an answer, and the device needs some of that.
const BRAKING_LIMIT: Duration = Duration::from_secs(7);
/// How long an order to a device may take.
const ORDER_LIMIT: Duration = Duration::from_secs(8);
/// Maximum number of reports until an arm reports the effect of an order.
const REPORTS: u32 = 3;
/// How often an enabled arm is asked for again that is not ready yet.
const ASK_AGAIN: Duration = Duration::from_millis(100);
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
            let confirmation = self.until(limit, || self.confirmation(i)).await;
            let confirmation = confirmation.unwrap_or(api::Confirmation::SentNotConfirmed);
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
            // The tick must see the state after the clearing, and an arm that streams its state reports it in its next
            // report.
            self.next_tick().await;
            self.until(self.next_report(arm), || self.seen(arm, |view| view.state.error == 0)).await;
        }
        self.ask(Request::Reset { arm }).await?;
        let mut reply = self.phase_of(id, arm);
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
        let settled = |phase| matches!(phase, Phase::Ready | Phase::Held);
        self.until(Instant::now() + READY_LIMIT, || self.seen(arm, |view| settled(view.phase))).await;
        let view = self.arm_view(arm as usize).ok_or_else(internal)?;
        let outcome = match view.phase {
            Phase::Ready => return Ok(Reply::ArmEnable(self.phase_of(id, arm))),
            // A stop or a fault overtook it.
            Phase::Held => Outcome::ArmLatched(arm, view.cause),
            phase => Outcome::ArmNotReady(arm, phase, view.cause),
        };
        self.refusal(&outcome).map_or_else(|| Err(internal()), Err)
    }

    /// Makes the arms ready that a start has enabled, and waits until they are and the others are seen; not for ever:
    /// the banner and `status` say how far each came.
    pub async fn first_ready(&self) {
        let arms = || self.parts.blueprint.arms.iter().map(|arm| arm.auto_enable).enumerate();
        let settled = |(arm, enabled): (usize, bool)| match self.phase(arm) {
            Phase::Ready => true,
            phase => !enabled && phase != Phase::Unknown,
        };
        let limit = Instant::now() + READY_LIMIT;
        while Instant::now() < limit {
            for (arm, _) in arms().filter(|(_, enabled)| *enabled) {
                if !matches!(self.phase(arm), Phase::Activating | Phase::Ready | Phase::Held) {
                    // Whether it is taken shows in the arm's phase. On a busy host its state may not be fresh just now.
                    let ready = Request::Ready { arm: arm as u16 };
                    let log = log_of(&ready);
                    let _ = self.parts.dispatcher.send(ready, log);
                }
            }
            let round = limit.min(Instant::now() + ASK_AGAIN);
            if self.until(round, || arms().all(settled).then_some(())).await.is_some() {
                return;
            }
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
        self.next_tick().await;
        let off = |view: &ArmSample| !view.state.enabled && view.phase != Phase::Standby;
        self.until(self.next_report(arm), || self.seen(arm, off)).await;
        let mut reply = self.phase_of(id, arm);
        if now {
            let was =
                if speed > STANDSTILL { format!("while it moved at {speed:.2} rad/s") } else { "at rest".to_owned() };
            reply.note = Some(format!("the motors were switched off at once, {was}"));
        }
        Ok(Reply::ArmDisable(reply))
    }

    /// Waits until an arm is at rest, or refuses when it still moves at the limit.
    async fn wait_for_rest(&self, id: &str, arm: u16, limit: Instant) -> Result<(), RpcError> {
        let device = self.device(arm)?;
        let late = || Instant::now() >= limit;
        // Without a command the arm is being stopped, or this run did not move it. The motors wait for that stop.
        let stopped = |seq| device.health().stop_sent.load(Ordering::Acquire) == seq;
        let rests = || {
            self.arm_view(arm as usize)
                .is_none_or(|view| view.command.mode.is_none() && (stopped(view.command.stop_seq) || late()))
        };
        let look = || match self.speed(arm) {
            speed if speed > STANDSTILL => late().then_some(Err(speed)),
            _ => rests().then_some(Ok(())),
        };
        let rested = self.until(limit + SETTLING_LIMIT, look).await;
        rested.unwrap_or_else(|| Err(self.speed(arm))).map_err(|speed| still_moves(id, speed))
    }

    /// Commands a gripper, and waits for what the arm answers to this order.
    pub(super) async fn gripper(&self, call: api::Gripper) -> Result<Reply, RpcError> {
        let arm = self.arm_index(&call.arm)?;
        if self.arm_view(arm as usize).is_some_and(|v| v.state.gripper.is_none()) {
            return self.refusal(&Outcome::NoGripper(arm)).map_or_else(|| Err(internal()), Err);
        }
        let device = self.device(arm)?;
        let _turn = self.grippers.get(arm as usize).ok_or_else(internal)?.lock().await;
        self.ask(Request::Gripper { arm, opening: call.position }).await?;
        let order = self.arm_view(arm as usize).ok_or_else(internal)?.command.gripper_seq;
        let gone = |view: &ArmSample| matches!(view.state.link, Link::Down | Link::Faulted);
        let gone = || self.seen(arm, gone).map(|()| Err(AdapterError::NotConnected));
        let look = || device.health().gripper_answer(order).or_else(gone);
        match self.until(Instant::now() + ORDER_LIMIT, look).await {
            Some(Ok(())) => Ok(Reply::Gripper(Done {})),
            Some(Err(error)) => {
                let message = Message::of(format!("{} refused the gripper order: {error}", call.arm));
                let (what, hint) = message.or_hint("`dimos state` shows the gripper's opening now, in metres");
                Err(RpcError::new(Code::DeviceRefused, what).hint(hint))
            }
            None => {
                let what = format!("{} did not answer the gripper order within {} s", call.arm, ORDER_LIMIT.as_secs());
                Err(RpcError::new(Code::NoAnswer, what).hint("`dimos status` shows the arm's connection"))
            }
        }
    }

    /// `Some`, once an arm is seen in a condition.
    fn seen(&self, arm: u16, is: impl Fn(&ArmSample) -> bool) -> Option<()> {
        self.arm_view(arm as usize).is_some_and(|view| is(&view)).then_some(())
    }

    /// When an arm has reported again, if it reports as often as it should.
    fn next_report(&self, arm: u16) -> Instant {
        let own = self.parts.config.arms.get(arm as usize).map(|arm| arm.read_period);
        Instant::now() + REPORTS * own.unwrap_or_default().max(self.period())
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

    /// An arm's phase after the tick that was seen last.
    fn phase_of(&self, arm: String, index: u16) -> api::ArmReply {
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
    let general = "see the arm's own panel or manual; `dimos status` shows its link and error";
    let (what, hint) = Message::of(format!("{arm} {what}: {error}")).or_hint(general);
    RpcError::new(Code::DeviceRefused, what).hint(hint)
}
