//! Compares where the model of an arm has its flange with where the arm's controller has it: at the start, and whenever
//! the arm is enabled. A small difference adds to the distance that plans keep; with a large one nothing is planned.

use std::collections::BTreeMap;

use nalgebra::Isometry3;

use crate::runtime::Service;
use crate::runtime::tool::tcp::TcpModel;
use dimos_core::arm::{ArmState, Link, Pose, VelocitySource};
use dimos_core::joint::STANDSTILL;
use dimos_core::sync::lock;
use dimos_rpc::api::Plan;
use dimos_rpc::{Code, RpcError};

/// Difference that is reported, and added to the padding [m, rad].
const NOTED: (f64, f64) = (0.005, 1.0 / 180.0 * std::f64::consts::PI);
/// Difference with which planned motions are refused [m, rad].
const REFUSED: (f64, f64) = (0.030, 5.0 / 180.0 * std::f64::consts::PI);

/// A tool, and what it holds, may reach this far from the flange [m]: a wrong angle moves its end.
const REACH: f64 = 0.2;

/// What is known of the model of an arm.
#[derive(Debug, Clone, Default, PartialEq)]
pub(in crate::runtime) enum Check {
    /// Not compared yet.
    #[default]
    Pending,
    /// The arm's controller reports no pose.
    NoPose,
    /// The controller does not report this offset, so that its flange is not known.
    NoOffset(&'static str),
    /// The model does not say which link is the flange.
    NoFlange,
    /// The robot has joints of several arms: its base is not that of the controller.
    Spans,
    /// Both were compared.
    Compared(Compared),
}

/// A flange by the model and by the controller.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::runtime) struct Compared {
    /// In the frame of the controller's base.
    model: Pose,
    controller: Pose,
    /// Their difference [m, rad].
    distance: f64,
    angle: f64,
}

impl Compared {
    fn new(model: &Isometry3<f64>, controller: Pose) -> Self {
        let off = model.inverse() * controller.isometry();
        let (distance, angle) = (off.translation.vector.norm(), off.rotation.angle());
        Self { model: Pose::from(model), controller, distance, angle }
    }

    fn exceeds(&self, (distance, angle): (f64, f64)) -> bool {
        self.distance > distance || self.angle > angle
    }

    fn difference(&self) -> String {
        format!("{:.1} mm and {:.2}°", self.distance * 1e3, self.angle.to_degrees())
    }
}

/// The check of an arm, and whether its motors were on when it was made.
#[derive(Debug, Clone, Default)]
pub(in crate::runtime) struct Checked {
    pub check: Check,
    done: bool,
    enabled: bool,
}

impl Service {
    /// Compares the flanges of arms that are at rest, of those that were not compared yet or have just been enabled.
    pub(in crate::runtime) fn check_models(&self) {
        let states: Vec<Option<ArmState>> =
            (0..self.facts.names.arms.len()).map(|arm| self.tick.arm_view(arm).map(|view| view.state)).collect();
        let due = |checked: &Checked, state: &ArmState| !checked.done || (state.enabled && !checked.enabled);
        let is_due = |(checked, state): (&Checked, &Option<ArmState>)| state.is_some_and(|state| due(checked, &state));
        if !lock(&self.arms.checks).iter().zip(&states).any(is_due) {
            return;
        }
        // Only planned motions need a model that fits.
        let models: Vec<_> =
            self.tcp_models().into_iter().map(|model| model.filter(|model| model.robot.is_some())).collect();
        let mut noted = Vec::new();
        let mut checks = lock(&self.arms.checks);
        for (arm, ((checked, state), model)) in checks.iter_mut().zip(&states).zip(&models).enumerate() {
            let Some(state) = state.filter(is_at_rest) else { continue };
            if due(checked, &state) {
                let before = std::mem::take(&mut checked.check);
                checked.check = model.as_ref().map_or(Check::Pending, |model| check(model, &state));
                checked.done = !matches!(checked.check, Check::Pending | Check::NoPose);
                if let (Check::Compared(found), true) = (&checked.check, checked.check != before)
                    && found.exceeds(NOTED)
                {
                    noted.push((arm, *found));
                }
            }
            checked.enabled = state.enabled;
        }
        drop(checks);
        for (arm, found) in noted {
            let name = self.facts.names.arm(arm as u16);
            tracing::warn!("{name}: the flange by its model is {} from that by its controller", found.difference());
        }
    }

    /// Returns of which arms model and controller were compared.
    #[cfg(test)]
    pub(in crate::runtime) fn compared(&self) -> Vec<bool> {
        lock(&self.arms.checks).iter().map(|checked| matches!(checked.check, Check::Compared(_))).collect()
    }

    /// Returns what is to be said of the flange of an arm.
    pub(in crate::runtime) fn model_note(&self, arm: usize) -> Option<String> {
        let checks = lock(&self.arms.checks);
        let name = self.facts.names.arm(arm as u16);
        match &checks.get(arm)?.check {
            Check::Pending => None,
            Check::NoPose => Some("not compared with the arm: it reports no pose of its own".to_owned()),
            Check::NoOffset(what) => {
                Some(format!("not compared with the arm: its controller does not report its {what}"))
            }
            Check::NoFlange => Some("not compared with the arm: the robot has no `flange_link`".to_owned()),
            Check::Spans => Some("not compared with the arm: the robot has joints of several arms".to_owned()),
            Check::Compared(found) if found.exceeds(REFUSED) => {
                let end = match self.allows_mismatch(&name) {
                    true => "allowed by `model_mismatch`, and added to the padding",
                    false => "planned motions are refused",
                };
                Some(format!("its flange is {} from that by the controller: {end}", found.difference()))
            }
            Check::Compared(found) if found.exceeds(NOTED) => {
                Some(format!("its flange is {} from that by the controller: added to the padding", found.difference()))
            }
            Check::Compared(_) => None,
        }
    }

    /// Returns the distance that plans keep beyond the padding, listed for each joint of its arm [m].
    pub(in crate::runtime) fn paddings(&self) -> BTreeMap<String, f64> {
        let checks = lock(&self.arms.checks);
        let arms = self.facts.names.arms.iter().zip(checks.iter());
        let padded = arms.filter_map(|(arm, checked)| match &checked.check {
            Check::Compared(found) if found.exceeds(NOTED) => Some((arm, found.distance + found.angle * REACH)),
            _ => None,
        });
        padded.flat_map(|(arm, distance)| arm.joints.iter().map(move |joint| (joint.clone(), distance))).collect()
    }

    /// Refuses a planned motion of these joints if the model of one of their arms is wrong.
    pub(in crate::runtime) fn refuse_mismatch(&self, joints: &[String]) -> Result<(), RpcError> {
        let checks = lock(&self.arms.checks);
        for (arm, checked) in self.facts.names.arms.iter().zip(checks.iter()) {
            let Check::Compared(found) = &checked.check else { continue };
            let name = &arm.hardware_id;
            let moves = arm.joints.iter().any(|joint| joints.contains(joint));
            if !moves || !found.exceeds(REFUSED) || self.allows_mismatch(name) {
                continue;
            }
            let text = |pose: &Pose| {
                let three = |values: [f64; 3]| values.map(|value| format!("{value:.4}")).join(" ");
                format!("xyz {} m rpy {} rad", three(pose.xyz), three(pose.rpy))
            };
            let what = format!(
                "the model of {name} does not fit the arm: its flange is at {} by the model and at {} by the controller, {} \
                 apart",
                text(&found.model),
                text(&found.controller),
                found.difference()
            );
            return Err(RpcError::new(Code::ModelMismatch, what).hint(format!(
                "check `model_path`, `base_link` and `flange_link` of {name}; to plan with it anyway: \
                 --set planner.robots.{name}.model_mismatch=allow"
            )));
        }
        Ok(())
    }

    /// Returns the joints of the arms that a request plans motions of.
    pub(in crate::runtime) fn joints_of_plan(&self, plan: &Plan) -> Vec<String> {
        let models = self.tcp_models();
        let meant = |model: &&TcpModel| plan.goals.iter().any(|goal| Some(&goal.robot) == model.robot.as_ref());
        let moved = |joints: &[String]| models.iter().flatten().filter(meant).any(|model| model.moves(joints));
        self.facts.names.arms.iter().filter(|arm| moved(&arm.joints)).flat_map(|arm| arm.joints.clone()).collect()
    }

    fn allows_mismatch(&self, arm: &str) -> bool {
        let joints = self.facts.blueprint.arms.iter().find(|own| own.hardware_id == arm).map(|own| &own.joints);
        let models = self.tcp_models();
        let model = joints.and_then(|joints| models.iter().flatten().find(|model| model.moves(joints)));
        model.is_some_and(|model| model.allows_mismatch)
    }
}

fn check(model: &TcpModel, state: &ArmState) -> Check {
    let Some(stated) = state.pose else { return Check::NoPose };
    let Some(controller) = stated.flange() else { return Check::NoOffset(stated.missing().unwrap_or("pose")) };
    if model.dof() != state.dof {
        return Check::Spans;
    }
    match model.flange_in_controller(state.position.get(..state.dof).unwrap_or_default()) {
        Some(flange) => Check::Compared(Compared::new(&flange, controller)),
        None => Check::NoFlange,
    }
}

/// Returns whether joints and pose are of the same place: a pose may be read after the joints.
fn is_at_rest(state: &ArmState) -> bool {
    let still = |v: &f64| v.abs() <= STANDSTILL;
    state.seq > 0
        && state.link == Link::Up
        && (state.velocity_source == VelocitySource::Absent || state.velocity.iter().take(state.dof).all(still))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thresholds() {
        let model = Isometry3::translation(0.4, 0.0, 0.3);
        let at = |x: f64, yaw: f64| Compared::new(&model, Pose { xyz: [0.4 + x, 0.0, 0.3], rpy: [0.0, 0.0, yaw] });
        let degrees = f64::to_radians;
        for (x, yaw, noted, refused) in [
            (0.0049, degrees(0.9), false, false),
            (0.0051, 0.0, true, false),
            (0.0, degrees(1.1), true, false),
            (0.029, degrees(4.9), true, false),
            (0.031, 0.0, true, true),
            (0.0, degrees(5.1), true, true),
        ] {
            assert_eq!((at(x, yaw).exceeds(NOTED), at(x, yaw).exceeds(REFUSED)), (noted, refused), "{x} {yaw}");
        }
        assert_eq!(at(0.0312, degrees(1.0)).difference(), "31.2 mm and 1.00°");
    }
}
