//! What an arm is commanded beside its positions: efforts ahead of those that its own control would find from the
//! error, and in impedance mode stiffness, damping and the efforts of tasks. All within the limits of efforts, and of
//! their rate; nothing here changes a position.

use super::{ArmControl, OVERSPEED, TOO_FAST_FOR};
use crate::config::{EffortConfig, FeedForward};
use crate::task_body::Compliance;
use dimos_core::arm::{EffortLimits, Impedance};
use dimos_core::clock::Mono;
use dimos_core::joint::{ControlMode, Joints, MAX_DOF};
use dimos_robot::dynamics::Dynamics;

/// Time in which the stiffness may rise from none to the highest [s]: a joint off its setpoint is not thrown back.
const RISE: f64 = 0.5;
/// Slack for rounding [Nm or N]: an effort at its limit is not "limited".
const ROUNDING: f64 = 1e-9;

/// What was commanded last.
#[derive(Debug, Clone, Copy)]
struct Sent {
    start_seq: u32,
    mode: ControlMode,
    at: Mono,
    effort: Joints,
    stiffness: Joints,
}

/// The efforts and gains of one arm.
#[derive(Debug)]
pub struct Efforts {
    limits: EffortLimits,
    feed_forward: FeedForward,
    dynamics: Option<Dynamics>,
    impedance: Option<Impedance>,
    /// What tasks ask of the joints in this tick.
    asked: [Option<Compliance>; MAX_DOF],
    sent: Option<Sent>,
    /// Whether the joint's effort was limited in the last tick.
    limited: [bool; MAX_DOF],
}

fn at(list: &Joints, joint: usize) -> f64 {
    list.get(joint).copied().unwrap_or_default()
}

/// Returns a value between `-most` and `most`.
fn within(value: f64, most: f64) -> f64 {
    value.min(most).max(-most)
}

impl Efforts {
    /// Creates those of an arm; `None`: it is commanded none.
    pub fn new(config: Option<&EffortConfig>) -> Option<Box<Self>> {
        let config = config.filter(|config| config.feed_forward != FeedForward::None || config.impedance.is_some())?;
        Some(Box::new(Self {
            limits: config.limits,
            feed_forward: config.feed_forward,
            dynamics: config.dynamics.clone().filter(|_| config.feed_forward != FeedForward::None),
            impedance: config.impedance,
            asked: [None; MAX_DOF],
            sent: None,
            limited: [false; MAX_DOF],
        }))
    }

    /// Returns whether it can be commanded in impedance mode.
    pub fn comply(&self) -> bool {
        self.impedance.is_some()
    }

    /// Takes what a task asks of a joint; by default, joints are held.
    pub fn ask(&mut self, joint: usize, compliance: Option<Compliance>) {
        if let Some(asked) = self.asked.get_mut(joint) {
            *asked = compliance;
        }
    }

    /// Tasks ask nothing.
    pub fn ask_nothing(&mut self) {
        self.asked = [None; MAX_DOF];
    }

    /// Goes back to the efforts that were written last.
    pub fn rewind(&mut self, effort: Option<&Joints>) {
        if let (Some(sent), Some(effort)) = (&mut self.sent, effort) {
            sent.effort = *effort;
        }
    }

    /// Returns the efforts of the motion at these positions, velocities and accelerations, without limits.
    fn ahead(&mut self, dof: usize, q: &Joints, qd: &Joints, qdd: &Joints) -> Joints {
        let mut efforts = [0.0; MAX_DOF];
        let Some(dynamics) = &mut self.dynamics else { return efforts };
        let (of, out) = (|list| joints(list, dof), efforts.get_mut(..dof).unwrap_or_default());
        match self.feed_forward {
            FeedForward::None => {}
            FeedForward::Gravity => dynamics.gravity(of(q), out),
            FeedForward::Dynamics => dynamics.inverse(of(q), of(qd), of(qdd), out),
        }
        efforts
    }
}

fn joints(list: &Joints, dof: usize) -> &[f64] {
    list.get(..dof).unwrap_or_default()
}

impl ArmControl {
    /// Adds efforts and gains to the command that leaves the tick. `report` gets the joint and the effort whenever a
    /// limit begins to change one.
    pub(super) fn add_efforts(&mut self, mode: ControlMode, now: Mono, dt: f64, mut report: impl FnMut(usize, f64)) {
        let (dof, complies) = (self.config.dof, mode == ControlMode::Impedance);
        let usable = self.feedback.is_usable();
        let Some(efforts) = &mut self.efforts else { return };
        (self.command.effort, self.command.gains) = (None, None);
        if !mode.is_position() || (efforts.dynamics.is_none() && !complies) {
            efforts.sent = None;
            return;
        }
        let commanded: Joints = std::array::from_fn(|j| self.limiters.get(j).map_or(0.0, |l| l.position()));
        // A compliant joint is not where it is commanded: its weight is that of where it is.
        let here = if complies && usable { self.feedback.state().position } else { commanded };
        let ahead = efforts.ahead(dof, &here, &self.command.velocity, &self.command.acceleration);
        let last = efforts.sent.filter(|last| last.start_seq == self.command.start_seq && last.mode == mode);
        let time = last.map_or(0.0, |last| now.seconds_since(last.at).min(dt));
        let impedance = efforts.impedance.filter(|_| complies);
        let (mut effort, mut gains) = ([0.0; MAX_DOF], [[0.0; MAX_DOF]; 2]);
        let [stiffness, damping] = &mut gains;
        let joints = effort.iter_mut().zip(stiffness.iter_mut().zip(damping)).zip(&mut efforts.limited).enumerate();
        for (j, ((effort, (stiffness, damping)), limited)) in joints.take(dof) {
            let asked = efforts.asked.get(j).copied().flatten().filter(|_| complies).unwrap_or_default();
            let wanted = at(&ahead, j) + asked.effort;
            let before = last.map(|last| at(&last.effort, j));
            let most = at(&efforts.limits.max, j);
            *effort = within(if wanted.is_finite() { wanted } else { before.unwrap_or_default() }, most);
            if let Some(before) = before {
                // A start may begin with any: the weight of the arm is there at once.
                *effort = before + within(*effort - before, at(&efforts.limits.rate, j) * time);
            }
            let was = std::mem::replace(limited, (*effort - wanted).abs() > ROUNDING);
            if *limited && !was {
                report(j, wanted);
            }
            if let Some(arm) = &impedance {
                let (held, highest) = (at(&arm.stiffness, j), at(&arm.stiffness_max, j));
                let from = last.map_or(held, |last| at(&last.stiffness, j));
                let risen = from + highest * time / RISE;
                *stiffness = asked.stiffness.unwrap_or(held).min(highest).min(risen).max(0.0);
                *damping = asked.damping.unwrap_or(at(&arm.damping, j)).min(at(&arm.damping_max, j)).max(0.0);
            }
        }
        efforts.sent = Some(Sent { start_seq: self.command.start_seq, mode, at: now, effort, stiffness: gains[0] });
        self.command.effort = Some(effort);
        self.command.gains = impedance.map(|_| gains);
    }

    /// Returns the joint that moves faster than its limit allows for longer than noise does, and its velocity [rad/s].
    pub(super) fn too_fast(&mut self) -> Option<(u16, f64)> {
        let velocities = self.feedback.state().velocity.iter().zip(&self.limiters).enumerate();
        let too_fast = { velocities }.find(|(_, (v, limiter))| v.abs() > OVERSPEED * limiter.bounds().velocity);
        let Some((joint, (velocity, _))) = too_fast else {
            self.too_fast_since = None;
            return None;
        };
        let stamp = self.feedback.state().stamp;
        let since = *self.too_fast_since.get_or_insert(stamp);
        (stamp.seconds_since(since) >= TOO_FAST_FOR).then_some((joint as u16, *velocity))
    }
}
