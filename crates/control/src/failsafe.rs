//! The phase of an arm. A fault latches a hold. Only `reset` by an operator clears the latch, and only `enable` makes
//! the arm ready again: two separate acts, neither moves anything.
//!
//! ```text
//!             ready (request)          ramp over
//! Disabled ─────────────────▶ Activating ───────▶ Ready ──stop, fault──▶ Held ──reset──▶ Standby ──ready──▶ Activating
//!                                                   │ lead                                  ▲
//!                                                   └────▶ Led ──prepare to disable─────────┘
//! ```

use super::config::ACTIVATION_RAMP;
use dimos_core::arm::{ArmState, Interference, Link};
use dimos_core::clock::Mono;
use dimos_core::telemetry::{Age, Cause, LedBy, Outcome, Phase};

/// Phase of one arm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Failsafe {
    phase: Phase,
    cause: Cause,
    since: Mono,
    /// What moves the arm while it is led.
    led_by: LedBy,
}

impl Default for Failsafe {
    fn default() -> Self {
        Self { phase: Phase::Unknown, cause: Cause::None, since: Mono::ZERO, led_by: LedBy::Hand }
    }
}

/// Whether the latest state is recent enough to act on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Freshness {
    /// Whether it is.
    pub fresh: bool,
    /// Its age.
    pub age: Age,
}

/// Returns what prevents an arm's motion.
pub fn trouble(state: &ArmState, freshness: Freshness) -> Option<Cause> {
    match state.link {
        _ if state.error != 0 => Some(Cause::Fault(state.error)),
        Link::Down | Link::Faulted => Some(Cause::LinkLost),
        Link::Stale => Some(Cause::Stale(freshness.age)),
        Link::Up if !freshness.fresh => Some(Cause::Stale(freshness.age)),
        Link::Up if state.stop_input_open => Some(Cause::StopInput),
        Link::Up if !state.missing.is_empty() => state.missing.first().map(|joint| Cause::JointLost(joint as u16)),
        Link::Up if state.interference == Interference::Identity => Some(Cause::IdentityChanged),
        Link::Up if state.interference == Interference::Mode => Some(Cause::ModeChanged),
        Link::Up if state.interference == Interference::Power => Some(Cause::PowerChanged),
        Link::Up if state.interference == Interference::Stop => Some(Cause::StoppedElsewhere),
        Link::Up if state.interference == Interference::Limits => Some(Cause::LimitsChanged),
        Link::Up if state.interference == Interference::Tool => Some(Cause::ToolLost),
        Link::Up if state.self_held => Some(Cause::HeartbeatLost),
        Link::Up => None,
    }
}

impl Failsafe {
    /// Returns the phase.
    pub fn phase(&self) -> Phase {
        self.phase
    }

    /// Returns the cause of the phase.
    pub fn cause(&self) -> Cause {
        self.cause
    }

    /// Returns what moves the arm; `None` while nothing but this program does.
    pub fn led_by(&self) -> Option<LedBy> {
        (self.phase == Phase::Led).then_some(self.led_by)
    }

    fn enter(&mut self, phase: Phase, cause: Cause, now: Mono) {
        *self = Self { phase, cause, since: now, led_by: self.led_by };
    }

    /// Takes the arm's state. Returns whether the phase or its cause changed.
    pub fn update(&mut self, state: &ArmState, fresh: Freshness, now: Mono) -> bool {
        let before = (self.phase, self.cause);
        match self.phase {
            Phase::Unknown if state.seq == 0 => {}
            Phase::Unknown if state.enabled => self.enter(Phase::Standby, Cause::None, now),
            Phase::Unknown => self.enter(Phase::Disabled, Cause::None, now),
            Phase::Disabled if state.interference == Interference::Power => {
                self.enter(Phase::Held, Cause::PowerChanged, now);
            }
            Phase::Disabled if state.interference == Interference::Identity => {
                self.enter(Phase::Held, Cause::IdentityChanged, now);
            }
            // The connection is back: whatever it was held for before was about another arm.
            Phase::Held
                if state.interference == Interference::Identity
                    && state.link == Link::Up
                    && self.cause != Cause::IdentityChanged =>
            {
                self.enter(Phase::Held, Cause::IdentityChanged, now);
            }
            // It may be about to be enabled.
            Phase::Disabled if state.link == Link::Up && state.stop_input_open => {
                self.enter(Phase::Held, Cause::StopInput, now);
            }
            Phase::Disabled | Phase::Held => {}
            Phase::Standby if !state.enabled && fresh.fresh => self.enter(Phase::Disabled, Cause::None, now),
            Phase::Standby => {
                // A self-held arm is at rest already, until `enable`. While an arm is being enabled or disabled, its
                // device thread reads no states; no command moves it meanwhile, `ready` requires a fresh state, and a
                // lost connection is reported as such.
                let passes = |cause: &Cause| matches!(cause, Cause::HeartbeatLost | Cause::Stale(_));
                if let Some(cause) = trouble(state, fresh).filter(|cause| !passes(cause)) {
                    self.enter(Phase::Held, cause, now);
                }
            }
            Phase::Activating | Phase::Ready | Phase::Led => match trouble(state, fresh) {
                Some(cause) => self.enter(Phase::Held, cause, now),
                None if self.led_by() == Some(LedBy::HandMotorsOff) => {}
                None if !state.enabled => self.enter(Phase::Held, Cause::PowerLost, now),
                None if self.phase == Phase::Activating && now.since(self.since) >= ACTIVATION_RAMP => {
                    self.enter(Phase::Ready, Cause::None, now);
                }
                None => {}
            },
        }
        before != (self.phase, self.cause)
    }

    /// Latches a hold. The first cause stays. An operator's stop also holds a disabled arm, which may be about to be
    /// enabled.
    pub fn hold(&mut self, cause: Cause, now: Mono) {
        let holds = match self.phase {
            Phase::Held | Phase::Unknown => false,
            // It may be about to be enabled.
            Phase::Disabled => {
                matches!(cause, Cause::Operator | Cause::PositionJump(..) | Cause::TurnLost(..) | Cause::SeamCrossed(_))
            }
            Phase::Standby | Phase::Activating | Phase::Ready | Phase::Led => true,
        };
        if holds {
            self.enter(Phase::Held, cause, now);
        }
    }

    /// Replaces the cause of a hold by one that is found while the arm is held.
    pub fn replace_cause(&mut self, cause: Cause, now: Mono) {
        if self.phase == Phase::Held {
            self.enter(Phase::Held, cause, now);
        }
    }

    /// The ramp after enabling begins now: the arm holds no setpoint yet.
    pub fn prolong_ramp(&mut self, now: Mono) {
        if self.phase == Phase::Activating {
            self.since = now;
        }
    }

    /// The arm will be disabled: refuses motion from now on, without a latch.
    pub fn prepare_disable(&mut self, now: Mono) {
        if matches!(self.phase, Phase::Activating | Phase::Ready | Phase::Led) {
            self.enter(Phase::Standby, Cause::None, now);
        }
    }

    /// The arm will be led: from `Ready`, or for a hand that leads it with the motors off also from `Disabled`.
    pub fn lead(&mut self, by: LedBy, arm: u16, state: &ArmState, fresh: Freshness, now: Mono) -> Outcome {
        let fits = self.phase == Phase::Ready || (by == LedBy::HandMotorsOff && self.phase == Phase::Disabled);
        if self.phase == Phase::Held {
            return Outcome::ArmLatched(arm, self.cause);
        }
        if !fits {
            return Outcome::ArmNotReady(arm, self.phase, self.cause);
        }
        match trouble(state, fresh) {
            Some(Cause::Stale(_) | Cause::LinkLost) => Outcome::StartStateUnavailable(arm),
            Some(cause) => Outcome::StillFaulted(arm, cause),
            None => {
                self.led_by = by;
                self.enter(Phase::Led, Cause::None, now);
                Outcome::Accepted
            }
        }
    }

    /// Clears the latch, unless its cause persists. An arm that is connected needs no accepted state for that: a reset
    /// moves nothing, and `ready` requires one.
    pub fn reset(&mut self, arm: u16, state: &ArmState, fresh: Freshness, now: Mono) -> Outcome {
        if self.phase != Phase::Held {
            return Outcome::Accepted;
        }
        // Readings that are late or not believed are a matter of enabling.
        match trouble(state, fresh).filter(|c| !matches!(c, Cause::HeartbeatLost | Cause::Stale(_))) {
            Some(cause) => Outcome::StillFaulted(arm, cause),
            None => {
                let phase = if state.enabled { Phase::Standby } else { Phase::Disabled };
                self.enter(phase, Cause::None, now);
                Outcome::Accepted
            }
        }
    }

    /// The arm was enabled: holds it for a short time, then it is ready.
    pub fn on_enabled(&mut self, arm: u16, state: &ArmState, fresh: Freshness, now: Mono) -> Outcome {
        match self.phase {
            Phase::Activating | Phase::Ready => Outcome::Accepted,
            Phase::Held => Outcome::ArmLatched(arm, self.cause),
            // It is stopped first, so that it holds where it is.
            Phase::Led => Outcome::ArmNotReady(arm, self.phase, self.cause),
            Phase::Unknown | Phase::Disabled | Phase::Standby => match trouble(state, fresh) {
                Some(Cause::Stale(_) | Cause::LinkLost) => Outcome::StartStateUnavailable(arm),
                Some(cause) => Outcome::StillFaulted(arm, cause),
                None if !state.enabled => Outcome::ArmNotReady(arm, self.phase, Cause::PowerLost),
                None => {
                    self.enter(Phase::Activating, Cause::None, now);
                    Outcome::Accepted
                }
            },
        }
    }

    /// Returns whether a task may move the arm; otherwise the outcome for its client.
    pub fn admits(&self, arm: u16) -> Result<(), Outcome> {
        match self.phase {
            Phase::Ready => Ok(()),
            Phase::Held => Err(Outcome::ArmLatched(arm, self.cause)),
            phase => Err(Outcome::ArmNotReady(arm, phase, self.cause)),
        }
    }
}

#[cfg(test)]
#[path = "failsafe_tests.rs"]
mod tests;
