//! The joints of a simulated arm: position, velocity, limits, and how they follow what they are told.
//!
//! Time is passed in ([`Plant::advance`]) and integrated in steps of one length, so the same inputs give the same
//! motion however often somebody looks. Nothing here allocates after construction.

use crate::hardware::sim::delay::DelayLine;
use crate::joint::{JointLimits, Joints, MAX_DOF};

/// The step of integration [s].
const STEP: f64 = 0.0005;
/// The most waiting time that an ideal joint may make up for in one jump [s].
const CREDIT: f64 = 0.1;
/// Speed at which a sagging joint sinks [rad/s].
const SAG_SPEED: f64 = 0.25;
/// Part of its acceleration that a joint plans to brake with: the rest is for landing in a whole number of steps.
const BRAKING: f64 = 0.85;
/// Viscous friction [Nm·s/rad].
const FRICTION: f64 = 0.5;
/// How much more than the acceleration limit the drives can do when they follow set points: one that could do no more
/// than it is asked would never make up for starting late.
const HEADROOM: f64 = 2.0;
/// The part of a lag that is first-order at most [s]; the rest is dead time.
const FIRST_ORDER: f64 = 0.02;
/// Below these a joint that follows a target has arrived [rad, rad/s].
const ARRIVED: (f64, f64) = (1e-7, 1e-4);

/// How joints follow servo set points and velocities.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Tracking {
    /// At once, as far as the velocity limit allows.
    Ideal,
    /// First-order with this time constant [s]; set points within the acceleration limit, with some headroom.
    Lag(f64),
}

/// What drives the joints.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Drive {
    /// Motors off: brakes hold, or the arm falls.
    Disabled,
    /// Motors on: decelerates to standstill and holds.
    Stop,
    /// On its own trapezoid to the target.
    Position,
    /// Follows set points.
    Servo,
    /// Keeps a velocity.
    Velocity,
}

#[derive(Debug, Clone, Copy, Default)]
struct Joint {
    position: f64,
    velocity: f64,
    /// Target position [rad] or velocity [rad/s].
    target: f64,
    /// How fast the set points move, by the last two of them [rad/s].
    pace: f64,
    lower: f64,
    upper: f64,
    velocity_max: f64,
    acceleration: f64,
    /// Time in which an ideal joint has not moved although it might have [s].
    credit: f64,
    blocked: bool,
    /// Where it comes to rest when it falls [rad]; `None`: friction holds it.
    rest: Option<f64>,
}

/// Up to [`MAX_DOF`] joints with their motors.
#[derive(Debug, Clone)]
pub struct Plant {
    joints: [Joint; MAX_DOF],
    dof: usize,
    drive: Drive,
    tracking: Tracking,
    /// Servo set points that have not taken effect.
    delayed: DelayLine,
    /// Fraction of the top speed in drive `Position` (0–1].
    speed: f64,
    /// Speed at which joints fall to their lower limits when disabled [rad/s]; 0 = brakes hold.
    fall: f64,
    /// How far the second joint still has to sink [rad].
    sag: f64,
    /// Time since the last servo set point, and between the two before [s].
    since_set_point: f64,
    interval: f64,
    /// How far the joints have been integrated beyond the present [s]: less than a step.
    ahead: f64,
}

impl Plant {
    /// Joints within `limits` (defaults where they state no acceleration), at rest at `initial` [rad], disabled.
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
            speed: 1.0,
            fall,
            sag: 0.0,
            since_set_point: 0.0,
            interval: 0.0,
            ahead: 0.0,
        }
    }

    /// Joints as those of [`Plant::new`] with brakes, which move `lag` [s] after their servo set points: 20 ms of it
    /// first-order, the rest dead time. First-order alone would be less than its time constant behind where the set
    /// points accelerate, and would not reach the ends of short motions.
    pub fn lagging(limits: &JointLimits, initial: &[f64], lag: f64) -> Self {
        let first_order = lag.min(FIRST_ORDER);
        let plant = Self::new(limits, initial, Tracking::Lag(first_order), 0.0);
        // A set point is followed from the end of the present step on: half a step later, on average.
        Self { delayed: DelayLine::new(lag - first_order - 0.5 * STEP), ..plant }
    }

    /// Joint positions [rad].
    pub fn positions(&self) -> Joints {
        // Back from the end of the last step to the present; but an ideal servo is where it was sent.
        let exact = self.drive == Drive::Servo && self.tracking == Tracking::Ideal;
        let back = if exact { 0.0 } else { self.ahead };
        self.joints.map(|joint| joint.position - joint.velocity * back)
    }

    /// Joint velocities [rad/s].
    pub fn velocities(&self) -> Joints {
        self.joints.map(|joint| joint.velocity)
    }

    /// Joint torques [Nm]: friction only.
    pub fn efforts(&self) -> Joints {
        self.joints.map(|joint| joint.velocity * FRICTION)
    }

    /// What drives the joints now.
    pub fn drive(&self) -> Drive {
        self.drive
    }

    /// Whether the motors are on.
    pub fn enabled(&self) -> bool {
        self.drive != Drive::Disabled
    }

    /// Whether any joint is faster than 1 mrad/s, or has still to move to a target of its own.
    pub fn moving(&self) -> bool {
        self.active().iter().any(|joint| {
            joint.velocity.abs() > 1e-3
                || (self.drive == Drive::Position && joint.position != joint.target && !joint.blocked)
        })
    }

    /// Switches the motors on, holding where the arm is, or off.
    pub fn enable(&mut self, on: bool) {
        if on != self.enabled() {
            self.delayed.clear();
            self.drive = if on { Drive::Stop } else { Drive::Disabled };
        }
    }

    /// Decelerates to standstill and holds. Nothing when disabled.
    pub fn stop(&mut self) {
        self.delayed.clear();
        if self.enabled() {
            self.drive = Drive::Stop;
        }
    }

    /// Moves to `target` [rad] at a fraction of the top speed (0–1].
    pub fn move_to(&mut self, target: &[f64], speed: f64) {
        self.speed = if speed.is_finite() { speed.clamp(0.01, 1.0) } else { 0.01 };
        self.delayed.clear();
        self.drive_to(Drive::Position, target);
    }

    /// Follows a set point [rad], after the dead time.
    pub fn servo(&mut self, target: &[f64]) {
        if !self.enabled() {
            return;
        }
        if let Some(target) = self.delayed.push(target) {
            self.follow_set_point(&target);
        }
    }

    fn follow_set_point(&mut self, target: &[f64]) {
        let following = self.drive == Drive::Servo;
        let before = self.joints.map(|joint| joint.target);
        if !self.drive_to(Drive::Servo, target) {
            return;
        }
        self.interval = (self.since_set_point - self.ahead).clamp(1e-3, CREDIT);
        self.since_set_point = self.ahead;
        let (interval, ahead) = (self.interval, self.ahead);
        for (joint, before) in self.active_mut().iter_mut().zip(before) {
            joint.pace = if following { (joint.target - before) / interval } else { 0.0 };
        }
        if self.tracking == Tracking::Ideal {
            for joint in self.active_mut().iter_mut().filter(|joint| !joint.blocked) {
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

    /// From now on the joints fall at `speed` [rad/s] when disabled, each to its place in `rest` [rad]; one without
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

    /// Blocks a joint (index from 0) where it is, or frees it.
    pub fn block(&mut self, joint: usize, blocked: bool) {
        if let Some(joint) = self.active_mut().get_mut(joint) {
            joint.blocked = blocked;
        }
    }

    /// Lets `dt` [s] pass.
    pub fn advance(&mut self, dt: f64) {
        let mut left = if dt.is_finite() { dt.max(0.0) } else { 0.0 };
        while let Some((wait, target)) = self.delayed.pass(left) {
            self.integrate(wait);
            self.follow_set_point(&target);
            left -= wait;
        }
        self.integrate(left);
    }

    fn integrate(&mut self, dt: f64) {
        self.ahead -= dt;
        // The margin keeps a sum of rounded times from being a step too many.
        while self.ahead < -1e-6 * STEP {
            if self.at_rest() {
                let passed = -self.ahead;
                self.since_set_point += passed;
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

    /// Takes over new targets; a joint whose value is missing or not finite stays where it is. `false` when disabled.
    fn drive_to(&mut self, drive: Drive, target: &[f64]) -> bool {
        if !self.enabled() {
            return false;
        }
        self.drive = drive;
        for (i, joint) in self.active_mut().iter_mut().enumerate() {
            let value = target.get(i).copied().unwrap_or(f64::NAN);
            let (low, high, stay) = match drive {
                Drive::Velocity => (-joint.velocity_max, joint.velocity_max, 0.0),
                _ => (joint.lower, joint.upper, joint.position),
            };
            joint.target = if value.is_finite() { value.clamp(low, high) } else { stay };
        }
        true
    }

    fn at_rest(&self) -> bool {
        let still = |joint: &Joint| joint.velocity == 0.0;
        self.sag <= 0.0
            && match self.drive {
                Drive::Disabled => self.active().iter().all(|j| still(j) && (self.fall == 0.0 || j.fallen())),
                Drive::Stop => self.active().iter().all(still),
                Drive::Position | Drive::Servo => self.active().iter().all(|j| still(j) && j.position == j.target),
                Drive::Velocity => self.active().iter().all(|j| still(j) && j.target == 0.0),
            }
    }

    fn step(&mut self, h: f64) {
        self.since_set_point += h;
        let pause = self.since_set_point > 1.5 * self.interval;
        let (drive, tracking, speed, fall) = (self.drive, self.tracking, self.speed, self.fall);
        for joint in self.active_mut() {
            if joint.blocked {
                joint.velocity = 0.0;
                continue;
            }
            match (drive, tracking) {
                (Drive::Disabled, _) => joint.fall(fall, h),
                (Drive::Stop, _) => joint.accelerate(0.0, joint.acceleration, h),
                (Drive::Position, _) => joint.approach(joint.velocity_max * speed, 0.0, 0.0, joint.acceleration, h),
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

/// The speed from which a joint can still stop within `distance` [rad], braking at `acceleration` [rad/s²] in
/// steps of `h` [s].
fn braking_speed(distance: f64, acceleration: f64, h: f64) -> f64 {
    let acceleration = acceleration * BRAKING;
    let dv = acceleration * h;
    let speed = 0.5 * ((dv * dv + 8.0 * acceleration * distance).sqrt() - dv);
    speed.min(distance / h)
}

impl Joint {
    fn travel(&mut self, h: f64) {
        self.position += self.velocity * h;
        if self.position < self.lower || self.position > self.upper {
            self.position = self.position.clamp(self.lower, self.upper);
            self.velocity = 0.0;
        }
    }

    fn accelerate(&mut self, velocity: f64, acceleration: f64, h: f64) {
        let dv = acceleration * h;
        self.velocity += (velocity - self.velocity).clamp(-dv, dv);
        self.travel(h);
    }

    /// Towards the target, no faster than `top`, with first-order lag (0 = none), able to stop in time: not before a
    /// target that moves on at `pace` [rad/s], only relative to it.
    fn approach(&mut self, top: f64, lag: f64, pace: f64, acceleration: f64, h: f64) {
        let error = self.target - self.position;
        let arrived = error.abs() < ARRIVED.0 && self.velocity.abs() < ARRIVED.1.max(acceleration * h);
        if arrived && pace == 0.0 {
            (self.position, self.velocity) = (self.target, 0.0);
            return;
        }
        let wanted = error.abs() / lag.max(h);
        let brake = braking_speed(error.abs(), acceleration, h) + (pace * error.signum()).max(0.0);
        self.accelerate(wanted.min(brake).min(top).copysign(error), acceleration, h);
    }

    /// An ideal joint between set points: makes the rest of its way at top speed, then stands.
    fn follow(&mut self, pause: bool, h: f64) {
        let error = self.target - self.position;
        if error != 0.0 {
            let step = error.clamp(-self.velocity_max * h, self.velocity_max * h);
            self.position = if step == error { self.target } else { self.position + step };
            self.velocity = step / h;
            self.credit = 0.0;
        } else {
            self.credit = (self.credit + h).min(CREDIT);
            if pause {
                self.velocity = 0.0;
            }
        }
    }

    fn fallen(&self) -> bool {
        self.rest.is_none_or(|rest| self.position == rest)
    }

    fn fall(&mut self, speed: f64, h: f64) {
        let way = self.rest.map_or(0.0, |rest| rest - self.position);
        if way.abs() <= speed * h {
            (self.position, self.velocity) = (self.position + way, 0.0);
        } else {
            self.velocity = speed.copysign(way);
            self.travel(h);
        }
    }
}

#[cfg(test)]
#[path = "plant_tests.rs"]
mod tests;
