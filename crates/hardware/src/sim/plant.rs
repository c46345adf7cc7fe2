//! The joints of a simulated arm: position, velocity, limits, and how they follow commands.
//!
//! Time is passed in ([`Plant::advance`]) and integrated in fixed steps, so the same inputs give the same motion
//! regardless of how often the state is read. Nothing allocates after construction.

use crate::sim::delay::DelayLine;
use crate::sim::plant_joint::{CREDIT, Joint, braking_speed};
use crate::sim::weight::{self, Masses};
use dimos_core::joint::{JointLimits, Joints, MAX_DOF};

/// The step of integration [s].
const STEP: f64 = 0.0005;
/// Speed at which a sagging joint sinks [rad/s].
const SAG_SPEED: f64 = 0.25;
/// Viscous friction [Nm·s/rad].
const FRICTION: f64 = 0.5;
/// Acceleration of the drives when they follow setpoints, as a factor of the acceleration limit: with exactly the limit
/// they would never catch up after a late start.
const HEADROOM: f64 = 2.0;
/// Largest first-order part of a lag [s]; the rest is dead time.
const FIRST_ORDER: f64 = 0.02;
/// Inertia of a joint in impedance mode of an arm without masses [kg·m²].
const MASSLESS: f64 = 0.05;
/// Weight of the newest setpoint in the pace at which a reference continues without setpoints.
const PACE_GAIN: f64 = 0.1;

/// How joints follow servo setpoints and velocities.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Tracking {
    /// Immediately, within the velocity limit.
    Ideal,
    /// First-order with this time constant [s]; setpoints within the acceleration limit, with some headroom.
    Lag(f64),
}

/// What drives the joints.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Drive {
    /// Motors off: brakes hold, or the arm falls.
    Disabled,
    /// Motors on: decelerates to rest and holds.
    Stop,
    /// On a trapezoid to the target.
    Position,
    /// Follows setpoints.
    Servo,
    /// Keeps a velocity.
    Velocity,
    /// Motors on, gravity compensated: gives way to a hand.
    Guided,
    /// Moves by stiffness, damping and efforts.
    Compliant,
}

/// Up to [`MAX_DOF`] joints with their motors.
#[derive(Debug, Clone)]
pub struct Plant {
    joints: [Joint; MAX_DOF],
    dof: usize,
    drive: Drive,
    tracking: Tracking,
    /// Setpoints in dead time.
    delayed: DelayLine,
    /// How far below its target a joint rests under load [rad].
    droop: f64,
    /// How many joints carry a load, from the base: the others do not droop.
    loaded: usize,
    /// Fraction of the top speed in drive `Position` (0–1].
    speed: f64,
    /// Speed at which joints without power fall to their rest positions [rad/s]; 0 = brakes hold.
    fall: f64,
    /// How far the second joint still has to sink [rad].
    sag: f64,
    /// Time since the last servo setpoint, and between the two before it [s].
    since_setpoint: f64,
    interval: f64,
    /// Average of that time [s].
    average: f64,
    /// How far the integration is ahead of the present [s]: less than a step.
    ahead: f64,
    /// Deceleration [rad/s²]; 0: each joint's acceleration.
    braking: f64,
    /// How long the reference continues without setpoints [s]; 0: not at all.
    bridges: f64,
    /// The joint that a hand pushes against its motor, and how far it yields [rad].
    nudged: Option<(usize, f64)>,
    /// Its masses, if it has any.
    masses: Option<Masses>,
}

impl Plant {
    /// Creates joints within `limits` (with defaults for missing accelerations), at rest at `initial` [rad], disabled.
    /// `fall` [rad/s] is the speed at which they sink when disabled, 0 for an arm with brakes.
    pub fn new(limits: &JointLimits, initial: &[f64], tracking: Tracking, fall: f64) -> Self {
        let limits = limits.clone().with_defaults();
        let mut joints = [Joint::default(); MAX_DOF];
        let dof = limits.position_lower.len().min(MAX_DOF);
        for (i, joint) in joints.iter_mut().take(dof).enumerate() {
            let of = |values: &[f64]| values.get(i).copied().unwrap_or_default();
            joint.lower = of(&limits.position_lower);
            joint.upper = of(&limits.position_upper).max(joint.lower);
            joint.velocity_max = of(&limits.velocity_max);
            joint.acceleration = of(&limits.acceleration_max);
            joint.position = of(initial).clamp(joint.lower, joint.upper);
            joint.rest = Some(joint.lower);
        }
        Self {
            joints,
            dof,
            drive: Drive::Disabled,
            tracking,
            delayed: DelayLine::new(0.0),
            droop: 0.0,
            loaded: MAX_DOF,
            speed: 1.0,
            fall,
            sag: 0.0,
            since_setpoint: 0.0,
            interval: 0.0,
            average: 0.0,
            ahead: 0.0,
            braking: 0.0,
            bridges: 0.0,
            nudged: None,
            masses: None,
        }
    }

    /// Gives it masses: it sags under them, and its efforts are those that hold them.
    pub fn with_masses(self, masses: Masses) -> Self {
        Self { masses: Some(masses), ..self }
    }

    /// Moves by stiffness, damping and efforts from now on; no effect while disabled.
    pub fn comply(&mut self, drives: &[weight::Drive]) {
        self.delayed.clear();
        if self.drive == Drive::Disabled {
            return;
        }
        self.drive = Drive::Compliant;
        self.active_mut().iter_mut().zip(drives).for_each(|(joint, drive)| joint.force = *drive);
    }

    /// Adds efforts [Nm] to those of the position control; missing ones are 0.
    pub fn assist(&mut self, efforts: &[f64]) {
        for (i, joint) in self.active_mut().iter_mut().enumerate() {
            joint.force = weight::Drive { effort: efforts.get(i).copied().unwrap_or(0.0), ..weight::Drive::default() };
        }
    }

    /// Creates joints with brakes that lag `lag` [s] behind their servo setpoints: 20 ms of it first-order, the rest
    /// dead time. A first-order lag alone would be shorter than its time constant while setpoints accelerate, and would
    /// not reach the ends of short motions.
    pub fn lagging(limits: &JointLimits, initial: &[f64], lag: f64) -> Self {
        let first_order = lag.min(FIRST_ORDER);
        let plant = Self::new(limits, initial, Tracking::Lag(first_order), 0.0);
        // A setpoint takes effect at the end of the present step: half a step later on average.
        Self { delayed: DelayLine::new(lag - first_order - 0.5 * STEP), ..plant }
    }

    /// Gives the joints position controllers without an integral part: under load each rests `droop` [rad] below its
    /// target. An arm that is repeatedly commanded to its measured position sinks.
    pub fn drooping(self, droop: f64) -> Self {
        Self { droop, ..self }
    }

    /// Gives all joints this deceleration [rad/s²], and lets their reference continue for `bridges` [s] at the velocity
    /// of the last setpoints when none follows; then it decelerates. 0 for neither.
    pub fn as_controlled(mut self, deceleration: f64, bridges: f64) -> Self {
        (self.braking, self.bridges) = (deceleration, bridges);
        for joint in self.active_mut().iter_mut().filter(|_| deceleration > 0.0) {
            // What a joint cannot brake it must not gather.
            joint.acceleration = joint.acceleration.min(deceleration / HEADROOM);
        }
        self
    }

    /// Returns whether it follows setpoints, and continues without them.
    pub fn bridges_gaps(&self) -> bool {
        self.drive == Drive::Servo && self.bridges > 0.0
    }

    /// A hand pushes a joint (index from 0) against its motor: it is `amount` [rad] beside its place. `None`: no hand.
    pub fn nudge(&mut self, nudged: Option<(usize, f64)>) {
        self.nudged = nudged;
    }

    /// Returns where the controller commands the joints to be [rad]: without lag, droop and pushes.
    pub fn commanded(&self) -> Joints {
        let following = self.drive == Drive::Servo;
        let undrooped = |i: usize| if i < self.loaded { self.droop } else { 0.0 };
        std::array::from_fn(|i| match self.joints.get(i) {
            Some(joint) if following && joint.on => joint.target + undrooped(i),
            Some(joint) => joint.position,
            None => 0.0,
        })
    }

    /// Lets only the first joints droop: those after them carry no load.
    pub fn load(&mut self, joints: usize) {
        self.loaded = joints;
    }

    /// Returns the joint positions [rad].
    pub fn positions(&self) -> Joints {
        // Interpolates back from the end of the last step to the present; an ideal servo is at its setpoint.
        let exact = self.drive == Drive::Servo && self.tracking == Tracking::Ideal;
        let back = if exact { 0.0 } else { self.ahead };
        let mut positions = self.joints.map(|joint| joint.position - joint.velocity * back);
        if let Some((at, amount)) = self.nudged.and_then(|(joint, amount)| Some((positions.get_mut(joint)?, amount))) {
            *at += amount;
        }
        positions
    }

    /// Returns the joint velocities [rad/s].
    pub fn velocities(&self) -> Joints {
        self.joints.map(|joint| joint.velocity)
    }

    /// Returns the joint torques [Nm]: friction, and with masses what holds them.
    pub fn efforts(&self) -> Joints {
        let mut efforts = self.joints.map(|joint| joint.velocity * FRICTION);
        let Some(masses) = self.masses else { return efforts };
        let gravity = (masses.gravity)(&self.positions());
        for (i, (effort, joint)) in efforts.iter_mut().zip(&self.joints).enumerate() {
            let held = gravity.get(i).copied().unwrap_or_default();
            *effort = match self.drive {
                // Brakes hold it.
                Drive::Disabled => 0.0,
                Drive::Compliant => joint.force.total(joint.position, joint.velocity),
                _ => *effort + held,
            };
        }
        efforts
    }

    /// Returns what drives the joints.
    pub fn drive(&self) -> Drive {
        self.drive
    }

    /// Returns whether all motors are on.
    pub fn enabled(&self) -> bool {
        self.active().iter().all(|joint| joint.on)
    }

    /// Returns whether the motor of a joint (index from 0) is on.
    pub fn motor(&self, joint: usize) -> bool {
        self.active().get(joint).is_some_and(|joint| joint.on)
    }

    /// Returns whether any joint is faster than 1 mrad/s, or has not reached its target.
    pub fn moving(&self) -> bool {
        self.active().iter().any(|joint| {
            joint.velocity.abs() > 1e-3
                || (self.drive == Drive::Position && joint.on && joint.position != joint.target && !joint.blocked)
        })
    }

    /// Switches all motors on, holding the current position, or off.
    pub fn enable(&mut self, on: bool) {
        (0..self.dof).for_each(|joint| self.enable_joint(joint, on));
    }

    /// Switches the motor of one joint (index from 0). The other joints stop and hold.
    pub fn enable_joint(&mut self, joint: usize, on: bool) {
        match self.active_mut().get_mut(joint) {
            Some(joint) if joint.on != on => joint.on = on,
            _ => return,
        }
        self.delayed.clear();
        self.drive = if self.active().iter().any(|joint| joint.on) { Drive::Stop } else { Drive::Disabled };
    }

    /// Sets the top speed of a joint [rad/s].
    pub fn limit_speed(&mut self, joint: usize, speed: f64) {
        self.active_mut().iter_mut().skip(joint).take(1).for_each(|joint| joint.velocity_max = speed);
    }

    /// Decelerates to rest and holds; no effect while disabled.
    pub fn stop(&mut self) {
        self.delayed.clear();
        if self.drive != Drive::Disabled {
            self.drive = Drive::Stop;
        }
    }

    /// Moves to `target` [rad] at a fraction of the top speed (0–1].
    pub fn move_to(&mut self, target: &[f64], speed: f64) {
        self.speed = if speed.is_finite() { speed.clamp(0.01, 1.0) } else { 0.01 };
        self.delayed.clear();
        self.drive_to(Drive::Position, target);
    }

    /// Follows a setpoint [rad], after the dead time.
    pub fn servo(&mut self, target: &[f64]) {
        if self.drive == Drive::Disabled {
            return;
        }
        if let Some(target) = self.delayed.push(target) {
            self.follow_setpoint(&target);
        }
    }

    fn follow_setpoint(&mut self, target: &[f64]) {
        let following = self.drive == Drive::Servo;
        let bridges = self.bridges > 0.0;
        let before = self.joints.map(|joint| if bridges { joint.setpoint } else { joint.target });
        if !self.drive_to(Drive::Servo, target) {
            return;
        }
        let passed = (self.since_setpoint - self.ahead).clamp(0.0, CREDIT);
        self.average = (self.average + PACE_GAIN * (passed - self.average)).max(1e-4);
        self.interval = passed.max(1e-3);
        self.since_setpoint = self.ahead;
        let (interval, ahead, average) = (self.interval, self.ahead, self.average);
        for (joint, before) in self.active_mut().iter_mut().zip(before) {
            joint.setpoint = joint.target;
            let step = if following { joint.target - before } else { 0.0 };
            joint.pace = step / interval;
            if bridges {
                // Setpoints do not arrive evenly: what continues without them continues at their average pace.
                joint.step = if following { joint.step + PACE_GAIN * (step - joint.step) } else { 0.0 };
                joint.pace = joint.step / average;
                // A setpoint holds for a period, and is in the middle of it on average.
                joint.target -= 0.5 * joint.step;
            }
        }
        if self.tracking == Tracking::Ideal {
            for joint in self.active_mut().iter_mut().filter(|joint| joint.on && !joint.blocked) {
                let reach = joint.velocity_max * (joint.credit - ahead).max(0.0);
                let step = (joint.target - joint.position).clamp(-reach, reach);
                joint.position += step;
                joint.velocity = (step / interval).clamp(-joint.velocity_max, joint.velocity_max);
                joint.credit = ahead;
            }
        }
    }

    /// Keeps a velocity [rad/s].
    pub fn velocity(&mut self, target: &[f64]) {
        self.delayed.clear();
        self.drive_to(Drive::Velocity, target);
    }

    /// Lets the joints fall at `speed` [rad/s] when disabled, each to its position in `rest` [rad]; a joint without one
    /// stays where it is.
    pub fn falls(&mut self, speed: f64, rest: &[Option<f64>]) {
        self.fall = speed;
        for (i, joint) in self.active_mut().iter_mut().enumerate() {
            joint.rest = rest.get(i).copied().flatten().map(|rest| rest.clamp(joint.lower, joint.upper));
        }
    }

    /// Lets the second joint sink by `amount` [rad].
    pub fn sag(&mut self, amount: f64) {
        self.sag = amount.max(0.0);
    }

    /// Puts a joint (index from 0) where it is [rad], moving at `velocity` [rad/s]: something else moves it.
    pub fn place(&mut self, joint: usize, position: f64, velocity: f64) {
        let driven = self.drive == Drive::Compliant;
        if let Some(joint) = self.active_mut().get_mut(joint) {
            joint.position = position;
            joint.velocity = if driven { velocity } else { 0.0 };
            joint.target = position;
        }
    }

    /// Puts all joints at rest where they are placed: the controller gives up what it was doing.
    pub fn come_to_rest(&mut self) {
        self.stop();
        self.active_mut().iter_mut().for_each(|joint| joint.velocity = 0.0);
    }

    /// Returns what drives a joint (index from 0) beside its position control, or in impedance mode.
    pub fn force(&self, joint: usize) -> weight::Drive {
        self.active().get(joint).map_or_else(weight::Drive::default, |joint| joint.force)
    }

    /// Takes its weight and its falling away: it is then only where the controller commands the arm to be.
    pub fn as_reference(&mut self) {
        (self.droop, self.fall, self.sag, self.masses) = (0.0, 0.0, 0.0, None);
    }

    /// Blocks a joint (index from 0), or frees it.
    pub fn block(&mut self, joint: usize, blocked: bool) {
        if let Some(joint) = self.active_mut().get_mut(joint) {
            joint.blocked = blocked;
        }
    }

    /// Moves a joint (index from 0) by `amount` [rad] at once, as by hand: a joint that is driven does not give way.
    pub fn push(&mut self, joint: usize, amount: f64) {
        let guided = self.drive == Drive::Guided;
        if let Some(joint) = self.active_mut().get_mut(joint).filter(|joint| guided || !joint.on) {
            joint.position = (joint.position + amount).max(joint.lower).min(joint.upper);
        }
    }

    /// A hand moves a joint (index from 0) at `velocity` [rad/s] from now on; `None`: no hand moves any.
    pub fn hand(&mut self, moved: Option<(usize, f64)>) {
        for (i, joint) in self.active_mut().iter_mut().enumerate() {
            joint.hand = moved.filter(|(moved, _)| *moved == i).map_or(0.0, |(_, velocity)| velocity);
        }
    }

    /// Gives way to a hand from now on; no effect while disabled.
    pub fn guide(&mut self) {
        self.stop();
        if self.drive != Drive::Disabled {
            self.drive = Drive::Guided;
        }
    }

    /// Advances by `dt` [s].
    pub fn advance(&mut self, dt: f64) {
        let mut left = if dt.is_finite() { dt.max(0.0) } else { 0.0 };
        while let Some((wait, target)) = self.delayed.pass(left) {
            self.integrate(wait);
            self.follow_setpoint(&target);
            left -= wait;
        }
        self.integrate(left);
    }

    fn integrate(&mut self, dt: f64) {
        self.ahead -= dt;
        // The margin prevents a sum of rounded times from causing one step too many.
        while self.ahead < -1e-6 * STEP {
            if self.at_rest() {
                let passed = -self.ahead;
                self.since_setpoint += passed;
                self.active_mut().iter_mut().for_each(|joint| joint.credit = (joint.credit + passed).min(CREDIT));
                self.ahead = 0.0;
                return;
            }
            self.step(STEP);
            self.ahead += STEP;
        }
    }

    fn active(&self) -> &[Joint] {
        self.joints.get(..self.dof).unwrap_or_default()
    }

    fn active_mut(&mut self) -> &mut [Joint] {
        self.joints.get_mut(..self.dof).unwrap_or_default()
    }

    /// Sets new targets; a joint whose value is missing or not finite keeps its position. Returns `false` while
    /// disabled.
    fn drive_to(&mut self, drive: Drive, target: &[f64]) -> bool {
        if self.drive == Drive::Disabled {
            return false;
        }
        self.drive = drive;
        let (droop, loaded) = (self.droop, self.loaded);
        for (i, joint) in self.active_mut().iter_mut().enumerate() {
            let value = target.get(i).copied().unwrap_or(f64::NAN);
            let (low, high, below, stay) = match drive {
                Drive::Velocity => (-joint.velocity_max, joint.velocity_max, 0.0, 0.0),
                _ => (joint.lower, joint.upper, if i < loaded { droop } else { 0.0 }, joint.position),
            };
            let sag = if drive == Drive::Velocity { 0.0 } else { joint.sag };
            joint.target = if value.is_finite() { (value - below + sag).clamp(low, high) } else { stay };
        }
        true
    }

    fn at_rest(&self) -> bool {
        let fallen = |joint: &Joint| self.fall == 0.0 || joint.fallen();
        let arrived = |joint: &Joint| match self.drive {
            _ if !joint.on => fallen(joint),
            Drive::Servo if self.bridges > 0.0 && joint.pace != 0.0 => false,
            Drive::Disabled | Drive::Stop | Drive::Guided => true,
            // The weight may change where it rests.
            Drive::Position | Drive::Servo => {
                joint.position == joint.target && !self.masses.is_some_and(|masses| masses.sags())
            }
            Drive::Velocity => joint.target == 0.0,
            Drive::Compliant => false,
        };
        self.sag <= 0.0
            && self.active().iter().all(|joint| joint.velocity == 0.0 && joint.hand == 0.0 && arrived(joint))
    }

    fn step(&mut self, h: f64) {
        self.since_setpoint += h;
        let pause = self.since_setpoint > 1.5 * self.interval;
        let (braking, bridges, since) = (self.braking, self.bridges, self.since_setpoint - 0.5 * self.average);
        let (drive, tracking, speed, fall) = (self.drive, self.tracking, self.speed, self.fall);
        let masses = self.masses;
        let inertia = masses.map_or([MASSLESS; MAX_DOF], |masses| masses.inertia);
        // Where the arm is held by its own control, its weight moves it only if that control gives way.
        let weighs = masses.filter(|masses| drive == Drive::Compliant || masses.sags());
        let gravity =
            weighs.map_or([0.0; MAX_DOF], |masses| (masses.gravity)(&self.joints.map(|joint| joint.position)));
        for ((joint, gravity), inertia) in self.active_mut().iter_mut().zip(gravity).zip(inertia) {
            if let Some(masses) =
                masses.filter(|masses| masses.sags() && matches!(drive, Drive::Position | Drive::Servo))
            {
                joint.settle(gravity, joint.force.effort, masses.stiffness);
            }
            if joint.blocked {
                joint.velocity = 0.0;
                continue;
            }
            match (if joint.on { drive } else { Drive::Disabled }, tracking) {
                (Drive::Disabled | Drive::Guided, _) if joint.hand != 0.0 => {
                    joint.velocity = joint.hand;
                    joint.travel(h);
                }
                (Drive::Disabled, _) => joint.fall(fall, h),
                (Drive::Compliant, _) => {
                    let force = joint.force;
                    joint.swing(&force, gravity, inertia, h);
                }
                (Drive::Stop | Drive::Guided, _) => {
                    let deceleration = if braking > 0.0 { braking } else { joint.acceleration };
                    joint.accelerate(0.0, deceleration, h);
                }
                (Drive::Position, _) => joint.approach(joint.velocity_max * speed, 0.0, 0.0, joint.acceleration, h),
                (Drive::Servo, Tracking::Lag(lag)) if bridges > 0.0 => {
                    if since > bridges {
                        let dv = (if braking > 0.0 { braking } else { joint.acceleration }) * h;
                        joint.pace -= joint.pace.clamp(-dv, dv);
                    }
                    joint.target = (joint.target + joint.pace * h).clamp(joint.lower, joint.upper);
                    joint.approach(joint.velocity_max, lag, joint.pace, HEADROOM * joint.acceleration, h);
                }
                (Drive::Servo, Tracking::Lag(lag)) => {
                    let pace = if pause { 0.0 } else { joint.pace };
                    joint.approach(joint.velocity_max, lag, pace, HEADROOM * joint.acceleration, h);
                }
                (Drive::Servo, Tracking::Ideal) => joint.follow(pause, h),
                (Drive::Velocity, Tracking::Lag(_)) => {
                    let room = if joint.target > 0.0 { joint.upper } else { joint.lower } - joint.position;
                    let brake = braking_speed(room.abs(), joint.acceleration, h);
                    joint.accelerate(joint.target.clamp(-brake, brake), joint.acceleration, h);
                }
                (Drive::Velocity, Tracking::Ideal) => {
                    joint.velocity = joint.target;
                    joint.travel(h);
                }
            }
        }
        if self.sag > 0.0 {
            let sink = self.sag.min(SAG_SPEED * h);
            self.sag = if self.sag > sink { self.sag - sink } else { 0.0 };
            if let Some(joint) = self.active_mut().get_mut(1) {
                joint.position = (joint.position - sink).max(joint.lower);
            }
        }
    }
}

#[cfg(test)]
#[path = "plant_tests.rs"]
mod tests;
