//! What reduced mode leaves of the arm's limits. It is read when connecting, and with every report that has it.

use super::protocol::commands::Command;
use super::protocol::reduced::Reduced;
use super::session::Session;
use dimos_core::joint::JointLimits;
use dimos_hardware::adapter::Reduction;

/// Share of the tool's highest speed that is used, as without reduced mode.
const TOOL_SHARE: f64 = 0.95;

impl Session {
    /// Returns the joint limits that hold now.
    pub fn limits(&mut self) -> JointLimits {
        self.limited_by = self.condition().reduced;
        narrowed(self.device.limits.clone(), self.active())
    }

    /// Returns whether the settings have changed since the limits were read.
    pub fn reduction_changed(&self) -> bool {
        self.condition().reduced != self.limited_by
    }

    /// Returns the highest speeds of a joint [rad/s] and of the tool [mm/s], where reduced mode limits them.
    pub fn reduced_speeds(&self) -> (Option<f64>, Option<f64>) {
        let above_0 = |speed: f64| Some(speed).filter(|speed| *speed > 0.0);
        let active = self.active();
        (active.and_then(|r| above_0(r.joint_speed)), active.and_then(|r| above_0(r.line_speed)))
    }

    /// Returns what is known of reduced mode and of the safety boundary.
    pub fn reduction(&self) -> Option<Reduction> {
        let reduced = self.condition().reduced?;
        let (joint, line) = self.reduced_speeds();
        let most = self.device.model.line_speed();
        let tool_velocity = line.map(|line| TOOL_SHARE * line.min(most) / 1000.0);
        let mut text = match reduced.on {
            false => "reduced mode is off".to_owned(),
            true => {
                let of =
                    |value: Option<f64>, unit: &str| value.map_or("not known".into(), |v| format!("{v:.2} {unit}"));
                let (joint, tool) = (of(joint, "rad/s"), of(tool_velocity, "m/s"));
                let ranges = if reduced.ranges.is_some() { "with its joint ranges" } else { "joint ranges not known" };
                format!("reduced mode is on: joints {joint}, tool {tool}, {ranges}")
            }
        };
        text += match reduced.fence {
            Some(true) => "; the safety boundary is on (error 35 outside; motions are not planned inside it)",
            Some(false) => "",
            None => "; safety boundary not known",
        };
        Some(Reduction { tool_velocity, text })
    }

    /// Returns a planned move within the speeds of reduced mode.
    pub(super) fn within_reduced(&self, mut command: Command) -> Command {
        let (joint, line) = self.reduced_speeds();
        match &mut command {
            Command::MoveJoints { speed, .. } => *speed = joint.map_or(*speed, |top| speed.min(top)),
            Command::MoveLine { speed, .. } => *speed = line.map_or(*speed, |top| speed.min(top)),
            _ => {}
        }
        command
    }

    fn active(&self) -> Option<Reduced> {
        self.condition().reduced.filter(|reduced| reduced.on)
    }
}

/// Returns limits narrowed by reduced mode where its figures make sense: zeros are no limits.
fn narrowed(mut limits: JointLimits, reduced: Option<Reduced>) -> JointLimits {
    let Some(Reduced { joint_speed, ranges, .. }) = reduced else { return limits };
    if joint_speed > 0.0 {
        limits.velocity_max.iter_mut().for_each(|top| *top = top.min(joint_speed));
    }
    let own = limits.position_lower.iter_mut().zip(&mut limits.position_upper);
    for ((lower, upper), [low, high]) in own.zip(ranges.into_iter().flatten()) {
        if low < *upper && high > *lower && low < high {
            (*lower, *upper) = (lower.max(low), upper.min(high));
        }
    }
    limits
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::xarm::model::Model;

    #[test]
    fn figures_that_make_no_sense_narrow_nothing() {
        let own = Model::Xarm6.limits();
        let zeros = Reduced { on: true, line_speed: 0.0, joint_speed: 0.0, ranges: Some([[0.0; 2]; 7]), fence: None };
        assert_eq!(narrowed(own.clone(), Some(zeros)), own);
        let mut ranges = [[-9.0, 9.0]; 7];
        ranges[1] = [-1.0, 9.0];
        let limits = narrowed(own.clone(), Some(Reduced { joint_speed: 0.5, ranges: Some(ranges), ..zeros }));
        assert_eq!((limits.position_lower[1], limits.position_upper[1]), (-1.0, own.position_upper[1]));
        assert_eq!((limits.position_lower[0], limits.velocity_max), (own.position_lower[0], vec![0.5; 6]));
    }
}
