//! What an arm's condition makes of its phase. A fault latches a hold; only an operator's `reset` clears the
//! latch, and only `enable` makes the arm ready again: two separate acts, neither moves anything.
//!
//! ```text
//!             ready (request)          ramp over
//! Disabled ─────────────────▶ Activating ───────▶ Ready ──stop, fault──▶ Held ──reset──▶ Standby ──ready──▶ Activating
//! ```

use super::config::ACTIVATION_RAMP;
use crate::arm::{ArmState, Interference, Link};
use crate::clock::Mono;
use crate::telemetry::{Age, Cause, Outcome, Phase};

/// Phase of one arm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Failsafe {
    phase: Phase,
    cause: Cause,
    since: Mono,
}

impl Default for Failsafe {
    fn default() -> Self {
        Self { phase: Phase::Unknown, cause: Cause::None, since: Mono::ZERO }
    }
}

/// Whether the latest state is recent enough to act on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Freshness {
    /// It is.
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
        Link::Up if state.interference == Interference::Mode => Some(Cause::ModeChanged),
        Link::Up if state.interference == Interference::Power => Some(Cause::PowerChanged),
        Link::Up if state.interference == Interference::Stop => Some(Cause::StoppedElsewhere),
        Link::Up if state.self_held => Some(Cause::HeartbeatLost),
        Link::Up => None,
    }
}

impl Failsafe {
    /// What the arm is ready for.
    pub fn phase(&self) -> Phase {
        self.phase
    }

    /// Why.
    pub fn cause(&self) -> Cause {
        self.cause
    }

    fn enter(&mut self, phase: Phase, cause: Cause, now: Mono) {
        *self = Self { phase, cause, since: now };
    }

    /// Follows the arm's condition. `true`: the phase changed.
    pub fn update(&mut self, state: &ArmState, fresh: Freshness, now: Mono) -> bool {
        let before = (self.phase, self.cause);
        match self.phase {
            Phase::Unknown if state.seq == 0 => {}
            Phase::Unknown if state.enabled => self.enter(Phase::Standby, Cause::None, now),
            Phase::Unknown => self.enter(Phase::Disabled, Cause::None, now),
            Phase::Disabled if state.interference == Interference::Power => {
                self.enter(Phase::Held, Cause::PowerChanged, now);
            }
            Phase::Disabled | Phase::Held => {}
            Phase::Standby if !state.enabled && fresh.fresh => self.enter(Phase::Disabled, Cause::None, now),
            Phase::Standby => {
                // A self-held arm is at rest already; `enable` takes it over again. One that is being enabled or
                // disabled keeps its device thread busy, and its states wait: no command moves it meanwhile, `ready`
                // asks for a fresh one, and a connection that breaks is reported as such.
                let passes = |cause: &Cause| matches!(cause, Cause::HeartbeatLost | Cause::Stale(_));
                if let Some(cause) = trouble(state, fresh).filter(|cause| !passes(cause)) {
                    self.enter(Phase::Held, cause, now);
                }
            }
            Phase::Activating | Phase::Ready => match trouble(state, fresh) {
                Some(cause) => self.enter(Phase::Held, cause, now),
                None if !state.enabled => self.enter(Phase::Held, Cause::PowerLost, now),
                None if self.phase == Phase::Activating && now.since(self.since) >= ACTIVATION_RAMP => {
                    self.enter(Phase::Ready, Cause::None, now);
                }
                None => {}
            },
        }
        before != (self.phase, self.cause)
    }

    /// A latched hold. The first cause stays. An operator's stop holds a disabled arm too: it may be just about to be
    /// enabled.
    pub fn hold(&mut self, cause: Cause, now: Mono) {
        let heeded = match self.phase {
            Phase::Held | Phase::Unknown => false,
            Phase::Disabled => cause == Cause::Operator,
            Phase::Standby | Phase::Activating | Phase::Ready => true,
        };
        if heeded {
            self.enter(Phase::Held, cause, now);
        }
    }

    /// The arm will be disabled: no motion from here on, but nothing to reset either.
    pub fn park(&mut self, now: Mono) {
        if matches!(self.phase, Phase::Activating | Phase::Ready) {
            self.enter(Phase::Standby, Cause::None, now);
        }
    }

    /// Clears a latch, unless its cause is still present.
    pub fn reset(&mut self, arm: u16, state: &ArmState, fresh: Freshness, now: Mono) -> Outcome {
        if self.phase != Phase::Held {
            return Outcome::Accepted;
        }
        match trouble(state, fresh).filter(|c| *c != Cause::HeartbeatLost) {
            Some(cause) => Outcome::StillFaulted(arm, cause),
            None => {
                let phase = if state.enabled { Phase::Standby } else { Phase::Disabled };
                self.enter(phase, Cause::None, now);
                Outcome::Accepted
            }
        }
    }

    /// The arm was enabled: hold first, then be ready.
    pub fn ready(&mut self, arm: u16, state: &ArmState, fresh: Freshness, now: Mono) -> Outcome {
        match self.phase {
            Phase::Activating | Phase::Ready => Outcome::Accepted,
            Phase::Held => Outcome::ArmLatched(arm, self.cause),
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

    /// Whether a task may move the arm.
    pub fn admits(&self, arm: u16) -> Result<(), Outcome> {
        match self.phase {
            Phase::Ready => Ok(()),
            Phase::Held => Err(Outcome::ArmLatched(arm, self.cause)),
            phase => Err(Outcome::ArmNotReady(arm, phase, self.cause)),
        }
    }
}
