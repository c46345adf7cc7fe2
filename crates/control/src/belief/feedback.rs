//! The state of one arm as the tick uses it: implausible readings are left out, missing velocities are estimated, and
//! the state's age excludes the time in which this computer could not read a newer one.

use std::time::Duration;

use super::agreement::Agreement;
use super::estimate::VelocityEstimator;
use super::plausibility::{CONFIRMED, Plausibility, Verdict};
use super::setpoints::Range;
use super::stalls::Stalls;
use super::stillness::Stillness;
use super::tracking::furthest;
use crate::config::ArmConfig;
use crate::failsafe::Freshness;
use dimos_core::arm::{ArmState, Link, VelocitySource};
use dimos_core::clock::Mono;
use dimos_core::joint::Joints;
use dimos_core::telemetry::Age;

/// A longer delay of this computer is not subtracted from a state's age.
const MAX_OWN_DELAY: Duration = Duration::from_millis(100);

/// The latest state of one arm.
#[derive(Debug)]
pub struct Feedback {
    dof: usize,
    read_period: Duration,
    /// Maximum age of a fresh state.
    max_age: Duration,
    /// The latest accepted state, with estimated velocities if the arm reports none.
    state: ArmState,
    /// The latest reading, while its positions are rejected.
    rejected: Option<ArmState>,
    plausibility: Plausibility,
    agreement: Agreement,
    /// Whether position and velocity contradicted each other since the last reset.
    contradicted: bool,
    /// Whether the arm has lately sent readings that were rejected.
    answers: bool,
    stillness: Stillness,
    estimator: VelocityEstimator,
    freshness: Freshness,
}

impl Feedback {
    /// Creates the feedback of an arm without a state so far.
    pub fn new(config: &ArmConfig) -> Self {
        let l = &config.limits;
        let own = if config.own_velocity.len() == config.dof { &config.own_velocity } else { &l.velocity_max };
        let read = config.read_period.max(Duration::from_micros(100)).as_secs_f64();
        let supervision = &config.supervision;
        Self {
            dof: config.dof,
            read_period: config.read_period,
            max_age: supervision.stale_after.max(3 * config.read_period),
            state: ArmState::default(),
            rejected: None,
            plausibility: Plausibility::new(own, &l.position_lower, &l.position_upper, supervision.topology, read),
            agreement: Agreement::new(own),
            contradicted: false,
            answers: false,
            stillness: Stillness::new(config.dof, supervision.accuracy),
            estimator: VelocityEstimator::default(),
            freshness: Freshness::default(),
        }
    }

    /// Returns the latest accepted state.
    pub fn state(&self) -> &ArmState {
        &self.state
    }

    /// Returns whether the state is recent enough to act on, with its age.
    pub fn freshness(&self) -> Freshness {
        self.freshness
    }

    /// Returns whether the latest reading was rejected as implausible.
    pub fn is_rejected(&self) -> bool {
        self.plausibility.rejected_for().is_some()
    }

    /// Returns the joint whose rejected position is furthest from the accepted one, and how far [rad], if readings that
    /// agree were rejected for this time [s].
    pub fn rejected_step(&self, time: f64) -> Option<(u16, f64)> {
        let rejected = self.rejected.as_ref().filter(|_| self.plausibility.rejected_for() >= Some(time))?;
        furthest(rejected.position.iter().zip(&self.state.position).map(|(now, before)| now - before))
    }

    /// Returns whether the arm is heard: what it says may be false, but its line works, and with it the commands.
    pub fn is_heard(&self) -> bool {
        self.freshness.fresh || self.answers
    }

    /// Returns whether the state is fresh and plausible.
    pub fn is_usable(&self) -> bool {
        self.freshness.fresh && !self.is_rejected() && !self.contradicted
    }

    /// Returns how long all joints have been read at rest, by positions and velocities.
    pub fn rest_time(&self) -> Duration {
        self.stillness.time()
    }

    /// Returns whether this difference from where a joint was commanded is that of a lost turn count [rad].
    pub fn is_turn(&self, joint: usize, difference: f64) -> bool {
        self.plausibility.is_turn(joint, difference)
    }

    /// An operator has seen what was rejected: the next reading counts.
    pub fn acknowledge(&mut self) {
        self.plausibility.acknowledge();
        self.agreement.reset();
        self.stillness.reset();
        self.contradicted = false;
    }

    /// Returns the state as it was read, with rejected positions and estimated velocities: for the log.
    pub fn measured(&self) -> ArmState {
        match &self.rejected {
            Some(read) if self.is_finite(&read.position) => {
                ArmState { velocity: self.state.velocity, velocity_source: self.state.velocity_source, ..*read }
            }
            _ => self.state,
        }
    }

    /// Takes the latest reading. `range`: the setpoints that the arm may be following. `driven`: they are all that
    /// moves it, so position and velocity must agree. `stalls`: when the tick could not run.
    pub fn read(
        &mut self,
        state: &ArmState,
        range: Option<&Range>,
        driven: bool,
        now: Mono,
        stalls: &Stalls,
    ) -> Verdict {
        let mut verdict = self.accept(state, range);
        self.estimator.fill(&mut self.state);
        match verdict {
            Verdict::Same => {}
            Verdict::Accepted => {
                self.stillness.take(&self.state);
                let contradiction = self.agreement.take(&self.state).filter(|_| driven);
                if let Some((joint, by)) = contradiction {
                    self.contradicted = true;
                    verdict = Verdict::Inconsistent(joint, by);
                }
            }
            _ => {
                self.stillness.reset();
                self.agreement.reset();
            }
        }
        self.freshness = self.age(now, stalls);
        self.answers = self.rejected.as_ref().is_some_and(|read| now.since(read.stamp) <= self.max_age);
        verdict
    }

    fn accept(&mut self, state: &ArmState, range: Option<&Range>) -> Verdict {
        if matches!(state.link, Link::Down | Link::Faulted) {
            // A new connection may find the arm anywhere.
            self.plausibility.acknowledge();
        }
        let verdict = self.plausibility.take(state, range);
        let refused = !matches!(verdict, Verdict::Accepted | Verdict::Same);
        if refused || (verdict == Verdict::Same && self.is_rejected()) {
            // The last accepted measurement stays, and ages.
            self.rejected = Some(*state);
            let before = std::mem::replace(&mut self.state, *state);
            (self.state.seq, self.state.stamp) = (before.seq, before.stamp);
            (self.state.position, self.state.velocity) = (before.position, before.velocity);
            (self.state.velocity_source, self.state.effort) = (before.velocity_source, before.effort);
            return verdict;
        }
        self.rejected = None;
        self.state = *state;
        if !self.is_finite(&state.velocity) {
            self.state.velocity_source = VelocitySource::Absent;
        }
        verdict
    }

    fn is_finite(&self, values: &Joints) -> bool {
        values.iter().take(self.dof).all(|v| v.is_finite())
    }

    /// Returns the age of the accepted state, without the time in which this computer could not read a newer one.
    fn age(&self, now: Mono, stalls: &Stalls) -> Freshness {
        // An arm whose readings are rejected still answers: its age counts from the latest of them until it had the
        // time to confirm a jump.
        let confirmation = Duration::from_secs_f64(CONFIRMED) + 2 * self.read_period.max(Duration::from_millis(1));
        let finite = self.rejected.as_ref().is_some_and(|read| self.is_finite(&read.position));
        let waits = finite && now.since(self.plausibility.stamp()) <= self.max_age + confirmation;
        let stamp = self.rejected.as_ref().filter(|_| waits).map_or(self.state.stamp, |read| read.stamp);
        let age = now.since(stamp);
        let device = Duration::from_nanos(self.state.own_delay_ns);
        let device = if device < MAX_OWN_DELAY { device } else { Duration::ZERO };
        let own = stalls.between(stamp, now).max(device).min(age);
        let seen = age - own;
        let us = |d: Duration| d.as_micros().min(u128::from(u32::MAX)) as u32;
        let fresh = self.state.seq != 0 && self.state.link == Link::Up && seen <= self.max_age;
        Freshness { fresh, age: Age { age_us: us(seen), limit_us: us(self.max_age), own_us: us(own) } }
    }
}

#[cfg(test)]
#[path = "feedback_tests.rs"]
mod tests;
