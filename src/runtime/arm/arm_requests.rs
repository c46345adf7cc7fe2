//! Requests to an arm as a whole: stop, reset, enable, disable.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use crate::runtime::client::dispatch::log_of;
use crate::runtime::{Service, internal};
use dimos_control::request::Request;
use dimos_core::arm::{Interference, Link};
use dimos_core::joint::STANDSTILL;
use dimos_core::message::Message;
use dimos_core::telemetry::texts::cause_text;
use dimos_core::telemetry::{ArmSample, Outcome, Phase};
use dimos_hardware::adapter::{AdapterError, AdapterResult};
use dimos_hardware::device::{Answer, Device};
use dimos_rpc::api::{self, Reply};
use dimos_rpc::{Code, RpcError};

/// Timeout for a stopped arm to decelerate to rest and confirm.
const STOP_LIMIT: Duration = Duration::from_secs(3);
/// Additional time for a braking arm besides what its limits need: a few ticks, and its lag.
const REACTION: Duration = Duration::from_millis(250);
/// Timeout for an arm at rest until no command is sent to it.
const SETTLING_LIMIT: Duration = Duration::from_secs(1);
/// Maximum wait of a request to disable: clients wait 10 s for a reply, of which the device needs a part.
const BRAKING_LIMIT: Duration = Duration::from_secs(7);
/// Timeout for an order to a device.
pub(in crate::runtime) const ORDER_LIMIT: Duration = Duration::from_secs(8);
/// Maximum number of reports until an arm reports the effect of an order.
const REPORTS: u32 = 3;
/// Period of the requests to an enabled arm that is not ready yet.
const RETRY_PERIOD: Duration = Duration::from_millis(100);
/// Timeout for an enabled arm to be ready.
const READY_LIMIT: Duration = Duration::from_secs(2);

impl Service {
    pub(in crate::runtime) async fn stop(&self, call: api::Stop) -> Result<Reply, RpcError> {
        let arm = call.arm.as_deref().map(|a| self.facts.arm_index(a)).transpose()?;
        let stopped = self.arms.stops.iter().enumerate().filter(|(i, _)| arm.is_none_or(|a| usize::from(a) == *i));
        for (_, count) in stopped {
            count.fetch_add(1, Ordering::Relaxed);
        }
        // The tick refuses it in any case: no client waits for a plan that cannot begin.
        let concerns = |joint| self.facts.locate(joint).is_some_and(|(i, _)| arm.is_none_or(|a| usize::from(a) == i));
        self.motions
            .end_replanning("stopped by an operator", |motion| motion.joints.iter().any(|joint| concerns(*joint)));
        self.ask(Request::Stop { arm }).await?;
        let limit = Instant::now() + STOP_LIMIT;
        let mut arms = BTreeMap::new();
        for (i, config) in self.facts.config.arms.iter().enumerate() {
            if arm.is_some_and(|a| a as usize != i) {
                continue;
            }
            let confirmation = self.tick.until(limit, || self.confirmation(i)).await;
            let confirmation = confirmation.unwrap_or(api::Confirmation::SentNotConfirmed);
            if confirmation == api::Confirmation::NotSent {
                self.stop_not_sent(i);
            }
            arms.insert(config.name.clone(), confirmation);
        }
        Ok(Reply::Stop(api::StopReply { arms }))
    }

    /// Returns whether the stop of each held arm was sent, or cannot be.
    pub(in crate::runtime) fn stops_are_sent(&self) -> bool {
        (0..self.facts.config.arms.len())
            .all(|arm| self.tick.phase(arm) != Phase::Held || self.confirmation(arm).is_some())
    }

    /// Returns the progress of an arm's stop; `None`: not known yet.
    pub(in crate::runtime) fn confirmation(&self, arm: usize) -> Option<api::Confirmation> {
        let (view, device) = (self.tick.arm_view(arm)?, self.arms.devices.get(arm)?);
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
        // In this order: the confirmation of a sent stop is set before.
        if health.stop_sent.load(Ordering::Acquire) != asked {
            return None;
        }
        let confirmed = health.stop_confirmed.load(Ordering::Relaxed) == asked;
        Some(if confirmed { api::Confirmation::Confirmed } else { api::Confirmation::SentNotConfirmed })
    }

    pub(in crate::runtime) async fn reset(&self, id: String) -> Result<Reply, RpcError> {
        let arm = self.facts.arm_index(&id)?;
        let device = self.arms.device(arm)?;
        self.accept_identity(&id, arm)?;
        let count = || self.arms.stops.get(usize::from(arm)).map_or(0, |count| count.load(Ordering::Relaxed));
        let stops = count();
        let view = self.tick.arm_view(arm as usize);
        let cause = view.filter(|v| v.phase == Phase::Held).map(|v| cause_text(v.cause));
        if cause.is_some() {
            let cleared = order(device.clear_errors()).await;
            match cleared {
                Ok(()) | Err(AdapterError::NotConnected) => {}
                Err(e) => return Err(refused(&id, "did not clear its error", &e)),
            }
            // The tick must read the state after the reset; an arm that streams its state sends it with the next
            // report.
            self.tick.next_tick().await;
            self.tick.until(self.next_report(arm), || self.tick.seen(arm, |view| view.state.error == 0)).await;
        }
        let peripherals = self.reset_peripherals(arm).await?;
        if peripherals.is_some() {
            // The tick must read that the loss is acknowledged.
            self.tick
                .until(self.next_report(arm), || {
                    self.tick.seen(arm, |view| view.state.interference != Interference::Tool)
                })
                .await;
        }
        if count() == stops {
            self.ask(Request::Reset { arm }).await?;
        }
        // Clearing an error may take seconds. A stop that comes meanwhile holds the arm, also one in the reset's tick.
        if count() != stops {
            self.ask(Request::Stop { arm: Some(arm) }).await?;
            let what = format!("{id} was stopped while its hold was being cleared: it stays held");
            return Err(RpcError::new(Code::ArmLatched, what)
                .hint(format!("when it may move again: `dimos arm reset {id}`, then `dimos arm enable {id}`")));
        }
        let mut reply = self.phase_of(id, arm);
        // The state is read once more before the arm is enabled.
        let notes: Vec<String> =
            cause.map(|cause| format!("was held: {cause}")).into_iter().chain(peripherals).collect();
        reply.note = Some(notes.join("; ")).filter(|text| !text.is_empty());
        Ok(Reply::ArmReset(reply))
    }

    /// Accepts another arm at the second reset; the first one shows both. Arms of the run that changed places are never
    /// accepted.
    fn accept_identity(&self, id: &str, arm: u16) -> Result<(), RpcError> {
        let health = |device: &Arc<Device>| device.health().identity();
        let Some(device) = self.arms.devices.get(usize::from(arm)) else { return Ok(()) };
        let own = health(device);
        let Some(found) = own.other.clone() else { return Ok(()) };
        let others = self.arms.devices.iter().enumerate().filter(|(index, _)| *index != usize::from(arm));
        if let Some((_, other)) = { others }.find(|(_, other)| own.is_exchanged_with(&health(other))) {
            let what =
                format!("{found} answers at the address of {id}, and is the arm {} of this run", other.hardware_id());
            return Err(RpcError::new(Code::ArmLatched, what).hint(
                "their cables or addresses are interchanged: change them back, or end the run and start it again",
            ));
        }
        let known = self.facts.blueprint.arms.get(usize::from(arm)).zip(self.facts.connected.get(usize::from(arm)));
        if let Some(((config, about), serial)) = known.zip(found.strip_prefix("serial ")) {
            let taken = self.arms.serials.take(usize::from(arm), config, &about.info, serial);
            taken.map_err(|holder| {
                let (what, hint) = holder.describe(id, &self.facts.blueprint.arms, serial);
                RpcError::new(Code::ArmLatched, what).hint(hint)
            })?;
        }
        device.health().with_identity(|identity| identity.accept()).map_err(|(accepted, found)| {
            let what = format!("another arm answers as {id}: the run began with {accepted}, this is {found}");
            RpcError::new(Code::ArmLatched, what).hint(format!(
                "if it is meant: `dimos arm reset {id}` again; its limits and its model stay those of the arm before until \
                 a new run"
            ))
        })
    }

    pub(in crate::runtime) async fn enable(&self, id: String, outside: bool) -> Result<Reply, RpcError> {
        let arm = self.facts.arm_index(&id)?;
        let view = self.tick.arm_view(arm as usize).ok_or_else(internal)?;
        match view.phase {
            Phase::Held => {
                let outcome = Outcome::ArmLatched(arm, view.cause);
                return self.refusal(&outcome).map_or_else(|| Err(internal()), Err);
            }
            Phase::Ready | Phase::Activating => {}
            phase => {
                if phase == Phase::Led {
                    self.led_arm_rests(&id, arm)?;
                    self.end_lead(&id, arm).await?;
                }
                // Its joints would move while it is being enabled.
                if phase == Phase::Standby {
                    self.wait_for_rest(&id, arm, Instant::now()).await?;
                }
                order(self.arms.device(arm)?.activate()).await.map_err(|e| refused(&id, "was not enabled", &e))?;
                self.ask(Request::Enabled { arm, outside }).await?;
            }
        }
        self.until_ready(id, arm).await
    }

    /// Waits for an enabled arm to be ready.
    pub(in crate::runtime) async fn until_ready(&self, id: String, arm: u16) -> Result<Reply, RpcError> {
        let settled = |phase| matches!(phase, Phase::Ready | Phase::Held);
        self.tick.until(Instant::now() + READY_LIMIT, || self.tick.seen(arm, |view| settled(view.phase))).await;
        let view = self.tick.arm_view(arm as usize).ok_or_else(internal)?;
        let outcome = match view.phase {
            Phase::Ready => return Ok(Reply::ArmEnable(self.phase_of(id, arm))),
            // A stop or a fault came first.
            Phase::Held => Outcome::ArmLatched(arm, view.cause),
            phase => Outcome::ArmNotReady(arm, phase, view.cause),
        };
        self.refusal(&outcome).map_or_else(|| Err(internal()), Err)
    }

    /// Makes the arms ready that the start has enabled, and waits for them and for the first state of the others, up to
    /// a timeout. The banner and `status` show the result.
    pub async fn first_ready(&self) {
        let arms = || self.facts.blueprint.arms.iter().map(|arm| arm.auto_enable).enumerate();
        let settled = |(arm, enabled): (usize, bool)| match self.tick.phase(arm) {
            Phase::Ready => true,
            phase => !enabled && phase != Phase::Unknown,
        };
        let limit = Instant::now() + READY_LIMIT;
        while Instant::now() < limit {
            for (arm, _) in arms().filter(|(_, enabled)| *enabled) {
                if !matches!(self.tick.phase(arm), Phase::Activating | Phase::Ready | Phase::Held) {
                    // The arm's phase shows whether it was accepted. On a busy host its state may be stale for a
                    // moment.
                    let ready = Request::Enabled { arm: arm as u16, outside: false };
                    let log = log_of(&ready);
                    let _ = self.tick.dispatcher().send(ready, log);
                }
            }
            let round = limit.min(Instant::now() + RETRY_PERIOD);
            if self.tick.until(round, || arms().all(settled).then_some(())).await.is_some() {
                return;
            }
        }
    }

    /// Disables an arm's motors: once it is at rest, or `now`.
    pub(in crate::runtime) async fn disable(&self, id: String, now: bool) -> Result<Reply, RpcError> {
        let arm = self.facts.arm_index(&id)?;
        let began = Instant::now();
        self.ask(Request::PrepareDisable { arm }).await?;
        if !now {
            self.wait_for_rest(&id, arm, began).await?;
        }
        let speed = self.tick.speed(arm);
        order(self.arms.device(arm)?.disable()).await.map_err(|e| refused(&id, "was not disabled", &e))?;
        self.tick.next_tick().await;
        let off = |view: &ArmSample| !view.state.enabled && view.phase != Phase::Standby;
        self.tick.until(self.next_report(arm), || self.tick.seen(arm, off)).await;
        let mut reply = self.phase_of(id, arm);
        if now {
            let was =
                if speed > STANDSTILL { format!("while it moved at {speed:.2} rad/s") } else { "at rest".to_owned() };
            reply.note = Some(format!("the motors were switched off at once, {was}"));
        }
        Ok(Reply::ArmDisable(reply))
    }

    /// Waits until an arm that brakes since `began` is at rest; an error if it still moves when it has had time enough.
    pub(in crate::runtime) async fn wait_for_rest(&self, id: &str, arm: u16, began: Instant) -> Result<(), RpcError> {
        let device = self.arms.device(arm)?;
        // Without a command the arm is being stopped, or this run did not move it. The motors stay on until that stop.
        let stopped = |seq| device.health().stop_sent.load(Ordering::Acquire) == seq;
        let rests = |late| {
            self.tick
                .arm_view(arm as usize)
                .is_none_or(|view| view.command.mode.is_none() && (stopped(view.command.stop_seq) || late))
        };
        let mut braking = Duration::ZERO;
        let look = || {
            // A velocity may be measured far too low between two setpoints: the longest time counts.
            braking = braking.max(self.braking_limit(arm));
            let late = Instant::now() >= began + braking;
            match self.tick.speed(arm) {
                speed if speed > STANDSTILL => late.then_some(Err(speed)),
                _ => rests(late).then_some(Ok(())),
            }
        };
        let rested = self.tick.until(began + BRAKING_LIMIT + SETTLING_LIMIT, look).await;
        rested.unwrap_or_else(|| Err(self.tick.speed(arm))).map_err(|speed| still_moves(id, speed))
    }

    /// Returns the time by which an arm must have reported again.
    pub(in crate::runtime) fn next_report(&self, arm: u16) -> Instant {
        let own = self.facts.config.arms.get(arm as usize).map(|arm| arm.read_period);
        Instant::now() + REPORTS * own.unwrap_or_default().max(self.facts.period())
    }

    /// Returns the time for an arm to brake: twice what its fastest joint needs at its acceleration limit.
    pub(in crate::runtime) fn braking_limit(&self, arm: u16) -> Duration {
        let config = self.facts.config.arms.get(arm as usize);
        let view = self.tick.arm_view(arm as usize);
        let joints = view.iter().zip(config).flat_map(|(view, config)| {
            view.state.velocity.into_iter().zip(config.limits.acceleration_max.clone()).take(config.dof)
        });
        let fastest = joints.max_by(|a, b| a.0.abs().total_cmp(&b.0.abs()));
        let braking = fastest.map_or(0.0, |(velocity, acceleration)| 2.0 * velocity.abs() / acceleration);
        // Plus ticks and lag, but less than the client waits for its reply.
        let braking = Duration::try_from_secs_f64(braking).unwrap_or(BRAKING_LIMIT);
        (braking + REACTION).min(BRAKING_LIMIT)
    }

    /// Returns an arm's phase after the latest tick.
    fn phase_of(&self, arm: String, index: u16) -> api::ArmReply {
        api::ArmReply { arm, phase: self.tick.phase(index as usize).name().to_owned(), note: None }
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

/// Waits for a device without blocking other clients of the run.
pub(in crate::runtime) async fn order<T: Send + 'static>(answer: Answer<T>) -> AdapterResult<T> {
    let waited = tokio::task::spawn_blocking(move || answer.wait(ORDER_LIMIT)).await;
    waited.unwrap_or_else(|e| Err(AdapterError::Io(e.to_string())))
}

pub(in crate::runtime) fn refused(arm: &str, what: &str, error: &AdapterError) -> RpcError {
    let general = "see the arm's own panel or manual; `dimos status` shows its link and error";
    let (what, hint) = Message::of(format!("{arm} {what}: {error}")).or_hint(general);
    RpcError::new(Code::DeviceRefused, what).hint(hint)
}
