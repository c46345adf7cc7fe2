//! How a held arm stops: it decelerates by commands, along the path of its motion where it has one, settles at the last
//! of them, and gets a stop from its own controller; at once if it was at rest.

use super::{ArmControl, JointRequest, Routed};
use crate::limit::Limiter;
use crate::rest::start_pose::AGREEMENT;
use crate::rest::{Relief, SETTLED, SETTLING_TIME, braking};
use crate::task_body::Demand;
use dimos_core::clock::Mono;
use dimos_core::joint::{ControlMode, TICK_STANDSTILL};
use dimos_core::telemetry::{Cause, Phase};

impl ArmControl {
    /// Decelerates by commands; once at rest, orders a stop and commands nothing more. `ask`: the requests of a motion
    /// that decelerates along its path.
    pub(super) fn come_to_rest(
        &mut self,
        demand: Demand,
        ask: impl Fn(usize) -> Option<JointRequest>,
        now: Mono,
        dt: f64,
    ) -> Routed {
        if let Relief::Moving(relief) = self.rest.relief {
            return self.relieve(relief, dt, now);
        }
        if let Some(mode) = self.command.mode {
            let silent = now.since(self.rest.written.last().at) > self.config.supervision.stale_after;
            // Without a connection, an arm in velocity mode keeps its last velocity until it is stopped.
            let stuck = self.rest.gap.is_some() && (silent || mode.is_position());
            if !stuck {
                let moving = self.limiters.iter().any(|limiter| !limiter.at_rest());
                let in_time = self.rest.along_path > 0.0;
                self.rest.along_path -= dt;
                if demand != Demand::Nothing && moving && (in_time || !self.rest.moved) {
                    let routed = self.follow(demand, ask, dt, now, |_, _, _| {});
                    if routed == Routed::Sent {
                        return routed;
                    }
                }
                // A slowed one decelerates for longer: its controller continues that, along its motion.
                let slowed = !in_time && self.speed_fraction() < 1.0;
                let moves = self.limiters.iter().any(|limiter| !limiter.at_rest());
                if !slowed && (moves || (self.rest.moved && !self.settled(dt))) {
                    self.hold(mode, dt);
                    return Routed::NotReady;
                }
            }
            self.command.mode = None;
            self.rest.stop_pending = true;
            if stuck {
                self.rest_where_written();
            }
        }
        if self.rest.stop_pending {
            self.stop();
        } else if self.rest.relief == Relief::Due {
            self.begin_relief(now);
        }
        Routed::NotReady
    }

    /// Orders a stop from the arm's controller.
    pub(super) fn stop(&mut self) {
        self.rest.stop_pending = false;
        self.command.stop_seq = self.command.stop_seq.wrapping_add(1);
    }

    /// Takes the setpoints back towards blocked joints, if the readings are trusted.
    fn begin_relief(&mut self, now: Mono) {
        let supervision = &self.config.supervision;
        let Some(mode) = self.config.position_mode().filter(|_| supervision.relief > 0.0) else {
            self.rest.relief = Relief::None;
            return;
        };
        if self.failsafe.phase() != Phase::Held || !self.rest.holds_written || self.feedback.state().mode != mode {
            self.rest.relief = Relief::None;
            return;
        }
        if !self.feedback.is_usable() || self.feedback.rest_time() < AGREEMENT {
            return;
        }
        let read = self.feedback.state().position;
        self.rest.relief = Relief::None;
        if let Some(relief) = crate::rest::Move::towards(&read, &self.limiters, supervision) {
            (self.rest.relief, self.rest.still) = (Relief::Moving(relief), 0.0);
            self.command.mode = Some(mode);
            self.relieve(relief, 0.0, now);
        }
    }

    /// Moves the setpoints of a relief; then judges the readings, and stops the arm again.
    fn relieve(&mut self, relief: crate::rest::Move, dt: f64, now: Mono) -> Routed {
        let usable = self.feedback.is_usable() && self.rest.gap.is_none();
        let arrived = dt > 0.0 && usable && relief.advance(&mut self.limiters, dt);
        for (limiter, out) in self.limiters.iter().zip(self.command.values.iter_mut()) {
            *out = limiter.position();
        }
        self.rest.still = if arrived { self.rest.still + dt } else { 0.0 };
        let judged = arrived && self.rest.still > self.config.supervision.lag + SETTLED.as_secs_f64();
        if usable && !judged {
            return Routed::NotReady;
        }
        if let Some((joint, by)) =
            relief.followed_by(&self.feedback.state().position, self.config.dof).filter(|_| judged)
        {
            self.failsafe.replace_cause(Cause::ReadingFollows(joint as u16, by), now);
        }
        if !usable {
            // The setpoints stay where they are.
            self.limiters.iter_mut().for_each(|limiter| limiter.relieve(limiter.position(), 0.0, dt));
        }
        self.rest.relief = Relief::None;
        (self.command.mode, self.rest.stop_pending) = (None, true);
        Routed::NotReady
    }

    /// Returns whether the arm has reached its last command. If it were stopped before, it would hold short of that
    /// command, and move by the difference at its next start.
    fn settled(&mut self, dt: f64) -> bool {
        self.rest.still += dt;
        let lagged = self.rest.still > self.config.supervision.lag;
        let rests = self.feedback.rest_time() >= SETTLED && lagged;
        rests || (lagged && !self.feedback.is_usable()) || self.rest.still > SETTLING_TIME
    }

    /// Returns whether the measured velocities and the commands are at rest.
    pub(super) fn at_standstill(&self) -> bool {
        let velocities = self.feedback.state().velocity.iter().take(self.config.dof);
        let still = velocities.into_iter().all(|v| v.abs() <= TICK_STANDSTILL);
        still && self.limiters.iter().all(Limiter::at_rest)
    }

    /// Commands the next step of the deceleration to rest, then the same values again.
    pub(super) fn hold(&mut self, mode: ControlMode, dt: f64) {
        let own = self.own_time(dt);
        if own == 0.0 {
            if mode.is_position() {
                self.limiters.iter_mut().for_each(|limiter| limiter.rewind(limiter.position(), 0.0));
            }
            return self.stays(mode, dt);
        }
        let decreases = braking::decreases(&self.limiters, own);
        let joints = self.limiters.iter_mut().zip(decreases).zip(self.command.values.iter_mut());
        for ((limiter, decrease), out) in joints {
            limiter.decelerate(decrease, own);
            *out = if mode == ControlMode::Velocity { limiter.velocity() } else { limiter.position() };
        }
        if !self.limiters.iter().all(Limiter::at_rest) {
            self.rest.still = 0.0;
        }
    }
}
