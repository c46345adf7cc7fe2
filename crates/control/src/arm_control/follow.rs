//! How an arm follows the requests of tasks: in the mode that they need, each joint within its limits.

use super::{ArmControl, JointRequest, Routed};
use crate::limit::Refusal;
use crate::rest::braking;
use crate::task_body::Demand;
use dimos_core::arm::AfterGap;
use dimos_core::clock::Mono;
use dimos_core::joint::{ControlMode, MAX_DOF};
use dimos_core::telemetry::LimitKind;

impl ArmControl {
    /// Makes a command from requests. `report` gets the limits that begin to change a command.
    pub(super) fn follow(
        &mut self,
        demand: Demand,
        ask: impl Fn(usize) -> Option<JointRequest>,
        dt: f64,
        now: Mono,
        mut report: impl FnMut(usize, LimitKind, f64),
    ) -> Routed {
        let Some(mode) = self.mode_for(demand) else {
            // The arm lacks the mode: it stops in its present one.
            if let Some(present) = self.command.mode {
                self.hold(present, dt);
            }
            return Routed::NotReady;
        };
        if let Some(present) = self.command.mode.filter(|present| *present != mode) {
            if !self.at_standstill() {
                self.hold(present, dt);
                return Routed::Waiting;
            }
            // Each mode has its own start: positions from where the arm rests, velocities from zero.
            self.start(mode, now);
            self.take_start_pose(now);
            if self.command.mode != Some(mode) {
                self.hold(present, dt);
                return Routed::Waiting;
            }
        }
        if self.command.mode.is_none() && self.rest.gap.is_none() {
            self.start(mode, now);
            return Routed::Waiting;
        }
        if let Some(gap) = self.rest.gap {
            let waits = self.config.supervision.after_gap != AfterGap::RestsAtSetpoint && gap.mode.is_position();
            self.command.mode = if waits { None } else { Some(gap.mode) };
            return self.wait_in_gap(gap.mode, ask, dt);
        }
        if self.feedback.state().mode != mode || self.is_starting() {
            self.hold(mode, dt);
            return Routed::Waiting;
        }
        if let Some((j, refusal)) = self.refused(mode, &ask) {
            self.hold(mode, dt);
            return Routed::Refused(j, refusal);
        }
        if let Some(efforts) = &mut self.efforts {
            (0..self.config.dof).for_each(|j| efforts.ask(j, ask(j).and_then(|ask| ask.compliance)));
        }
        let own = self.own_time(dt);
        if own == 0.0 {
            self.stays(mode, dt);
            for (j, limiter) in self.limiters.iter_mut().enumerate().filter(|_| mode.is_position()) {
                match ask(j) {
                    // Jumps were refused above.
                    Some(ask) => {
                        if ask.new_task {
                            limiter.forget_request();
                        }
                        let _ = limiter.check_request(ask.value);
                    }
                    // What ends here does not continue later.
                    None => limiter.rewind(limiter.position(), 0.0),
                }
            }
            return Routed::Sent;
        }
        let ahead = if mode == ControlMode::Velocity { self.ahead(dt) } else { None };
        let decreases = braking::decreases(&self.limiters, own);
        for (j, limiter) in self.limiters.iter_mut().enumerate() {
            let value = match ask(j) {
                None => {
                    limiter.decelerate(decreases.get(j).copied().unwrap_or_default(), own);
                    if mode == ControlMode::Velocity { limiter.velocity() } else { limiter.position() }
                }
                Some(ask) => {
                    if ask.new_task {
                        limiter.forget_request();
                    }
                    let dt = if ask.shared { dt } else { own };
                    let limited = match mode {
                        ControlMode::Velocity => {
                            let at = limiter.position();
                            let within = ahead.as_ref().and_then(|a| a.get(j)).copied().unwrap_or((at, at));
                            limiter.follow_velocity(ask.value, within, dt, ask.speed)
                        }
                        _ => limiter.follow_position(ask.value, dt, ask.speed),
                    };
                    match limited {
                        Ok(limited) => {
                            if let Some(was) = self.limited.get_mut(j) {
                                if let (Some((kind, asked)), None) = (limited.by, *was) {
                                    report(j, kind, asked);
                                }
                                *was = limited.by.map(|(kind, _)| kind);
                            }
                            limited.value
                        }
                        // Checked above.
                        Err(refusal) => return Routed::Refused(j, refusal),
                    }
                }
            };
            if let Some(out) = self.command.values.get_mut(j) {
                *out = value;
            }
        }
        if let Some(asked) = self.limit_tool(mode) {
            report(asked.0, LimitKind::Tool, asked.1);
        }
        Routed::Sent
    }

    /// Slows the commands down where the tool would be too fast. Returns the fastest joint and the speed of the tool
    /// [m/s] where that begins.
    fn limit_tool(&mut self, mode: ControlMode) -> Option<(usize, f64)> {
        let asked = self.tool.as_mut()?.limit(&self.before, &mut self.limiters);
        self.tool_limited = asked.is_some();
        let began = self.tool_limited && !self.tool_was_limited;
        for (out, limiter) in self.command.values.iter_mut().zip(&self.limiters).filter(|_| asked.is_some()) {
            *out = if mode == ControlMode::Velocity { limiter.velocity() } else { limiter.position() };
        }
        let speed = |j: usize| self.limiters.get(j).map_or(0.0, |limiter| limiter.velocity().abs());
        let joint = (0..self.limiters.len()).max_by(|a, b| speed(*a).total_cmp(&speed(*b)))?;
        asked.filter(|_| began).map(|speed| (joint, speed))
    }

    /// Nothing reaches the arm, or it is on its way back: repeats the last written setpoint. Requests are still checked
    /// for jumps.
    fn wait_in_gap(&mut self, mode: ControlMode, ask: impl Fn(usize) -> Option<JointRequest>, dt: f64) -> Routed {
        let mut refused = None;
        for (j, limiter) in self.limiters.iter_mut().enumerate() {
            if let (Some(ask), true) = (ask(j), mode.is_position()) {
                refused = refused.or(limiter.check_request(ask.value).err().map(|refusal| (j, refusal)));
            }
            limiter.repeat(dt);
            if let Some(out) = self.command.values.get_mut(j) {
                *out = if mode == ControlMode::Velocity { limiter.velocity() } else { limiter.position() };
            }
        }
        match refused {
            Some((j, refusal)) => {
                self.hold(mode, dt);
                Routed::Refused(j, refusal)
            }
            None => Routed::Waiting,
        }
    }

    /// Returns the lowest and highest position that each joint may have when a velocity command takes effect [rad]: the
    /// measurement is old, the joint still follows earlier commands, and it may be where these have led it in truth.
    pub(super) fn ahead(&self, dt: f64) -> Option<[(f64, f64); MAX_DOF]> {
        let state = self.feedback.state();
        let range = self.tracking.velocity_range(state)?;
        let age = self.feedback.freshness().age;
        let age = f64::from(age.age_us + age.own_us) * 1e-6;
        let time = self.config.supervision.lag + age + dt;
        let mut out = [(0.0, 0.0); MAX_DOF];
        for (j, (out, (q, before))) in out.iter_mut().zip(state.position.iter().zip(&self.before)).enumerate() {
            let led = before.position();
            *out = ((q + range.low(j).min(0.0) * time).min(led), (q + range.high(j).max(0.0) * time).max(led));
        }
        Some(out)
    }

    /// Returns the first request that must be refused, and the reason.
    fn refused(&self, mode: ControlMode, ask: impl Fn(usize) -> Option<JointRequest>) -> Option<(usize, Refusal)> {
        self.limiters.iter().enumerate().find_map(|(j, limiter)| {
            let ask = ask(j)?;
            let refusal = match mode {
                ControlMode::Velocity => (!ask.value.is_finite()).then_some(Refusal::NonFinite),
                _ if ask.compliance.is_some_and(|compliance| !compliance.is_finite()) => Some(Refusal::NonFinite),
                _ => limiter.refuses(ask.value, ask.new_task),
            };
            Some((j, refusal?))
        })
    }

    /// Returns the mode for a demand; without one, the present mode. `None`: the arm lacks it.
    fn mode_for(&self, demand: Demand) -> Option<ControlMode> {
        let velocity = self.config.modes.contains(&ControlMode::Velocity).then_some(ControlMode::Velocity);
        match demand {
            Demand::Velocities => velocity,
            Demand::Positions => self.config.position_mode(),
            Demand::Impedance => {
                let complies = self.efforts.as_ref().is_some_and(|efforts| efforts.comply());
                Some(ControlMode::Impedance).filter(|mode| complies && self.config.modes.contains(mode))
            }
            Demand::Nothing => self.command.mode.or_else(|| self.config.position_mode()).or(velocity),
        }
    }
}
