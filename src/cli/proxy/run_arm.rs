//! The run's arm, as the controller of the box commands it.

use std::sync::MutexGuard;
use std::time::{Duration, Instant};

use nalgebra::Isometry3;

use super::refusals::Refusals;
use super::replies::{Commands, Target, refusal};
use super::run_link::{RunLink, View, code};
use super::tool_line;
use dimos_arms::xarm::emulator::{ControlledArm, Line, Links, MoveRequest, Refusal};
use dimos_core::clock::Mono;
use dimos_core::joint::{Joints, STANDSTILL};
use dimos_core::sync::lock;
use dimos_rpc::Code;
use dimos_rpc::api::{
    ArmDisable, ArmEnable, ArmPayloadSet, ArmReset, Cancel, Gripper, JointPath, Lease, Method, Move, PATH_TOLERANCE,
    Release, Servo, Velocity,
};

/// Positions this close to a limit count as inside: values on the wire are rounded [rad].
const ROUNDING: f64 = 2e-5;
/// Period in which a velocity is repeated, within the timeout of the task.
const REPEAT_PERIOD: Duration = Duration::from_millis(50);
/// Age of the joints from which the arm counts as not ready.
const MAX_AGE: Duration = Duration::from_millis(500);
/// Smallest fraction of a gripper's top speed.
const SLOWEST_GRIPPER: f64 = 0.01;
/// Time after which the status shows that a stream has begun.
const BEGIN_TIME: Duration = Duration::from_millis(200);

/// A task that follows a stream.
#[derive(Debug, Clone)]
pub struct StreamTask {
    /// Its name.
    pub name: String,
    /// Indices of its joints in the arm.
    pub joints: Vec<usize>,
}

/// What the proxy knows of the arm from the start.
#[derive(Debug, Clone)]
pub struct ArmInfo {
    /// Its `hardware_id`.
    pub arm: String,
    /// Its kinematics, if it is an xArm.
    pub links: Option<Links>,
    /// Limits of its joints [rad].
    pub limits: Vec<[f64; 2]>,
    /// Closed and open position of its gripper [m].
    pub gripper_range: Option<[f64; 2]>,
    /// The task for moves.
    pub trajectory: Option<String>,
    /// The task that follows positions.
    pub servo: Option<StreamTask>,
    /// The task that follows velocities.
    pub velocity: Option<StreamTask>,
}

/// A velocity that is kept by repeating it.
#[derive(Debug, Clone, Copy)]
struct Repeat {
    values: [f64; 7],
    until: Option<Mono>,
    next: Mono,
}

/// A stream to a task of the run, since a time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Stream {
    /// Whether of velocities.
    velocities: bool,
    since: Instant,
}

/// The arm of a run.
pub struct RunArm {
    link: RunLink,
    info: ArmInfo,
    view: View,
    began: Instant,
    now: Mono,
    /// Error code of the proxy's own refusals; 0 = none.
    error: u8,
    was_ready: bool,
    last_fault: u8,
    motion: Option<u64>,
    stream: Option<Stream>,
    repeat: Option<Repeat>,
    leased: bool,
    /// No client is connected that could stop what moves.
    orphaned: bool,
    gripper_ordered: Option<Instant>,
    refusals: Refusals,
    /// When a change of the arm was accepted whose effect the status does not show yet.
    changed: Option<Instant>,
}

impl RunArm {
    /// Creates the arm of a run.
    pub fn new(link: RunLink, info: ArmInfo) -> Self {
        let view = *link.shared.view();
        Self {
            link,
            info,
            view,
            began: Instant::now(),
            now: Mono::ZERO,
            error: 0,
            was_ready: view.ready,
            last_fault: 0,
            motion: None,
            stream: None,
            repeat: None,
            leased: false,
            orphaned: false,
            gripper_ordered: None,
            refusals: Refusals::default(),
            changed: None,
        }
    }

    fn commands(&self) -> MutexGuard<'_, Commands> {
        lock(&self.link.commands)
    }

    fn send<M: Method>(&self, params: &M) {
        self.commands().send(params, &self.link.shared);
    }

    fn ask<M: Method>(&self, params: &M) -> Result<M::Reply, Refusal> {
        self.commands().ask(params, &self.link.shared)
    }

    /// Makes a request that changes the arm's phase, and waits until the status shows it.
    fn change<M: Method>(&mut self, params: &M) -> Result<(), Refusal> {
        if self.view.stopping.is_some() {
            return Err(Refusal::Pending);
        }
        if let Some(since) = self.changed {
            if self.view.status_at <= since {
                return Err(Refusal::Pending);
            }
            self.changed = None;
            return Ok(());
        }
        self.ask(params)?;
        let now = Instant::now();
        self.changed = Some(now);
        self.link.shared.view().not_before = now;
        Err(Refusal::Pending)
    }

    fn send_target(&mut self, values: &[f64; 7], velocities: bool) -> Result<(), Refusal> {
        let task = if velocities { &self.info.velocity } else { &self.info.servo };
        let task = task.as_ref().ok_or(Refusal::NotNow)?;
        let mapped = task.joints.iter().map(|joint| values.get(*joint).copied().unwrap_or_default()).collect();
        let name = task.name.clone();
        let target = match velocities {
            true => Target::Velocities(Velocity { task: name, velocities: mapped }),
            false => Target::Positions(Servo::new(name, mapped)),
        };
        self.commands().stream(target, &self.link.shared);
        if self.stream.is_none_or(|stream| stream.velocities != velocities) {
            self.stream = Some(Stream { velocities, since: Instant::now() });
        }
        self.leased = true;
        Ok(())
    }

    /// Repeats a velocity that is due, or ends it.
    fn repeat_velocity(&mut self) {
        let Some(repeat) = self.repeat else { return };
        if repeat.until.is_some_and(|until| self.now >= until) {
            self.repeat = None;
            let _ = self.send_target(&[0.0; 7], true);
        } else if self.now >= repeat.next {
            self.repeat = Some(Repeat { next: self.now.after(REPEAT_PERIOD), ..repeat });
            let _ = self.send_target(&repeat.values, true);
        }
    }

    fn cancel(&self, task: String) {
        self.link.cancel(Cancel { task: Some(task), ..Cancel::default() });
    }

    /// Takes why the run has refused a target.
    fn target_refused(&mut self) -> bool {
        let Some(error) = self.commands().take_refused() else { return false };
        // The stream is another client's.
        if error.code == Code::LeaseHeld {
            self.stream = None;
        }
        let velocities = self.stream.is_some_and(|stream| stream.velocities);
        self.error = match refusal(&error) {
            Refusal::Error(_) if error.code == Code::OutOfLimits && velocities => code::SPEED,
            Refusal::Error(code) => code,
            // The arm's phase says why.
            _ => self.error,
        };
        self.link.shared.note(format!("target refused: {error}"));
        true
    }

    /// Takes the end of the motion. Returns whether it missed its target.
    fn motion_missed(&mut self) -> bool {
        let Some((_, completed)) = self.view.ended.filter(|(motion, _)| Some(*motion) == self.motion) else {
            // The run continues it under another number, around an obstacle.
            self.motion = self.motion.and(self.view.motion.or(self.motion));
            return false;
        };
        self.motion = None;
        !completed
    }

    /// Returns whether the run has ended the stream: a target jumped, or another task took the joints.
    fn stream_aborted(&mut self) -> bool {
        let Some(stream) = self.stream else { return false };
        let shown = self.view.status_at > stream.since + BEGIN_TIME;
        let [servo, velocity] = self.view.aborted;
        if !shown || !(if stream.velocities { velocity } else { servo }) {
            return false;
        }
        self.stream = None;
        self.error = code::SPEED;
        self.link.shared.note("the run has ended the stream: `dimos task list` shows why");
        true
    }
}

impl ControlledArm for RunArm {
    fn now(&self) -> Mono {
        self.now
    }

    fn integrate(&mut self, now: Mono) {
        self.now = now;
        self.view = *self.link.shared.view();
        // A run that hangs takes no commands.
        self.view.ready &= self.view.read_at.elapsed() < MAX_AGE;
        self.repeat_velocity();
        if self.orphaned && self.leased && !self.moving() {
            self.end();
        }
    }

    fn has_stopped(&mut self) -> bool {
        let refused = self.target_refused();
        let missed = self.motion_missed();
        let aborted = self.stream_aborted();
        let unready = self.was_ready && !self.view.ready;
        let failed = self.view.fault != 0 && self.view.fault != self.last_fault;
        (self.was_ready, self.last_fault) = (self.view.ready, self.view.fault);
        refused || missed || aborted || unready || failed
    }

    fn uptime(&self) -> Duration {
        self.began.elapsed()
    }

    fn joints(&self) -> (Joints, Joints) {
        (self.view.position, self.view.velocity)
    }

    fn efforts(&self) -> Joints {
        self.view.effort
    }

    fn motor(&self, _joint: usize) -> bool {
        self.view.enabled
    }

    fn enabled(&self) -> bool {
        self.view.enabled
    }

    fn moving(&self) -> bool {
        let fast = || self.view.velocity.iter().any(|velocity| velocity.abs() > STANDSTILL);
        // A move whose reply no client has taken is not known yet, even if it has begun.
        self.motion.is_some() || (fast() && !self.commands().is_asking_for_move())
    }

    fn error(&self) -> u16 {
        if self.error == 0 { self.view.fault.into() } else { self.error.into() }
    }

    fn is_ready(&self) -> bool {
        self.view.ready && self.error() == 0
    }

    fn is_within(&self, positions: &[f64]) -> bool {
        let mut joints = self.info.limits.iter().zip(positions);
        joints.all(|([lower, upper], value)| (lower - ROUNDING..=upper + ROUNDING).contains(value))
    }

    fn switch(&mut self, joint: Option<usize>, on: bool) -> Result<(), Refusal> {
        let arm = self.info.arm.clone();
        match (joint, on) {
            // A run switches all motors at once.
            (Some(_), _) => Err(Refusal::NotNow),
            (None, true) if self.view.ready && self.changed.is_none() => Ok(()),
            (None, true) => self.change(&ArmEnable::new(arm)),
            (None, false) if !self.view.enabled && self.changed.is_none() => Ok(()),
            (None, false) => self.change(&ArmDisable { arm, now: false }),
        }
    }

    fn clear(&mut self) -> Result<(), Refusal> {
        if self.view.held || self.changed.is_some() {
            self.change(&ArmReset { arm: self.info.arm.clone() })?;
        }
        self.error = 0;
        Ok(())
    }

    fn fail(&mut self, code: u16) {
        self.error = code.min(255) as u8;
    }

    fn begin(&mut self) -> Result<(), Refusal> {
        self.ask(&Lease { arm: Some(self.info.arm.clone()) })?;
        self.leased = true;
        Ok(())
    }

    fn stop(&mut self) {
        self.repeat = None;
        let pending = {
            let mut commands = self.commands();
            commands.end_stream();
            commands.forget_move()
        };
        if let Some(stream) = self.stream.take() {
            let task = if stream.velocities { &self.info.velocity } else { &self.info.servo };
            task.iter().for_each(|task| self.cancel(task.name.clone()));
        }
        let moving = self.motion.take().is_some();
        self.link.shared.view().motion = None;
        if let Some(task) = self.info.trajectory.clone() {
            if moving {
                self.cancel(task.clone());
            }
            if pending {
                // Behind the move, which the run may not have read yet.
                self.send(&Cancel { task: Some(task), ..Cancel::default() });
            }
        }
    }

    fn operational_stop(&mut self) {
        self.link.stop();
        self.view = *self.link.shared.view();
        self.was_ready = false;
    }

    fn end(&mut self) {
        if std::mem::take(&mut self.leased) {
            self.send(&Release { arm: Some(self.info.arm.clone()) });
        }
    }

    fn go(&mut self, way: &[[f64; 7]], speed: f64, acceleration: f64) -> Result<(), Refusal> {
        let joints = |point: &[f64; 7]| point.iter().take(self.info.limits.len()).copied().collect::<Vec<f64>>();
        let (target, path) = match way {
            [target] => (joints(target), None),
            _ => (Vec::new(), Some(JointPath { points: way.iter().map(joints).collect(), tolerance: PATH_TOLERANCE })),
        };
        let caps = (Some(speed).filter(|v| *v > 0.0), Some(acceleration).filter(|a| *a > 0.0));
        let (max_velocity, max_acceleration) = caps;
        let arm = self.info.arm.clone();
        let reply = self.ask(&Move { path, max_velocity, max_acceleration, ..Move::direct(arm, target, 1.0) })?;
        self.leased = true;
        self.motion = Some(reply.motion);
        self.link.shared.view().motion = Some(reply.motion);
        Ok(())
    }

    fn follow(&mut self, target: &[f64; 7]) -> Result<(), Refusal> {
        self.send_target(target, false)
    }

    fn keep_velocity(&mut self, velocities: &[f64; 7], duration: Option<Duration>) -> Result<(), Refusal> {
        self.send_target(velocities, true)?;
        let kept = velocities.iter().any(|velocity| *velocity != 0.0);
        let until = duration.map(|duration| self.now.after(duration));
        let next = self.now.after(REPEAT_PERIOD);
        self.repeat = kept.then_some(Repeat { values: *velocities, until, next });
        Ok(())
    }

    fn has_mode(&self, mode: u8) -> bool {
        match mode {
            0 => true,
            1 => self.info.servo.is_some(),
            4 => self.info.velocity.is_some(),
            _ => false,
        }
    }

    fn line(&self, from: &[f64; 7], request: &MoveRequest) -> Option<Line> {
        tool_line::of(self.info.links?, &self.view, from, request)
    }

    fn note_refused(&mut self, register: u8, data: &[u8], mode: u8, state: u8) {
        if let Some(line) = self.refusals.line(register, data, mode, state) {
            self.link.shared.note(line);
        }
    }

    fn pose(&self) -> Option<Isometry3<f64>> {
        self.view.pose
    }

    fn wrench(&self) -> Option<[f32; 6]> {
        self.view.wrench
    }

    fn gripper(&self) -> Option<(f64, bool)> {
        self.view.gripper_motion(self.gripper_ordered)
    }

    fn move_gripper(&mut self, opening: f64, speed: Option<f64>) {
        let Some([closed, open]) = self.info.gripper_range else { return };
        let position = opening.max(closed.min(open)).min(closed.max(open));
        self.gripper_ordered = Some(Instant::now());
        let speed = speed.map(|speed| speed.clamp(SLOWEST_GRIPPER, 1.0));
        self.send(&Gripper { arm: self.info.arm.clone(), position, speed, ..Gripper::default() });
    }

    fn set_load(&mut self, [mass, x, y, z]: [f32; 4]) -> Result<(), Refusal> {
        let center = [x, y, z].map(|value| f64::from(value) / 1000.0);
        let load = ArmPayloadSet { arm: self.info.arm.clone(), mass: mass.into(), center, inertia: [0.0; 6] };
        match self.ask(&load) {
            // The arm takes no load, or not this one: no reason to stop.
            Err(Refusal::Error(_)) => Err(Refusal::NotNow),
            result => result.map(drop),
        }
    }

    fn takes_settings(&self) -> bool {
        false
    }

    fn client_came(&mut self) {
        self.orphaned = false;
    }

    fn client_gone(&mut self) {
        self.repeat = None;
        self.orphaned = true;
    }
}
