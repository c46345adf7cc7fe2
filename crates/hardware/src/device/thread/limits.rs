//! The limits of the run beside those of the arm's controller: a run keeps those that it began with, so an arm whose
//! controller allows less than these is held.

use super::Worker;
use dimos_core::arm::Interference;
use dimos_core::joint::JointLimits;

/// Differences below this are rounding [rad, rad/s, m/s].
const ROUNDING: f64 = 1e-4;

/// Limits of commands.
#[derive(Debug, Default)]
pub(super) struct RunLimits {
    joints: JointLimits,
    /// Highest speed of the tool [m/s].
    tool: Option<f64>,
    /// What the controller allows less.
    narrower: Option<String>,
}

impl RunLimits {
    pub(super) fn set(&mut self, joints: &JointLimits) {
        self.joints = joints.clone();
    }

    /// Sets the smaller of the configured speed of the tool and the controller's [m/s].
    pub(super) fn set_tool(&mut self, configured: Option<f64>, own: Option<f64>) {
        self.tool = configured.into_iter().chain(own).reduce(f64::min);
    }

    /// Returns what the controller allows less than the run commands.
    pub(super) fn narrower(&self) -> Option<&str> {
        self.narrower.as_deref()
    }

    fn compare(&self, own: &JointLimits, tool: Option<f64>) -> Option<String> {
        let run = &self.joints;
        let below = |run: f64, own: f64| own < run - ROUNDING;
        let pairs = |run: &[f64], own: &[f64]| run.iter().copied().zip(own.iter().copied()).collect::<Vec<_>>();
        let speeds = pairs(&run.velocity_max, &own.velocity_max).into_iter().enumerate();
        let mut slower = speeds.filter(|(_, (run, own))| below(*run, *own)).map(|(j, (run, own))| {
            format!("its controller limits joint {} to {own:.2} rad/s, the run to {run:.2} rad/s", j + 1)
        });
        let lower = pairs(&run.position_lower, &own.position_lower).into_iter();
        let ranges = lower.zip(pairs(&run.position_upper, &own.position_upper)).enumerate();
        let mut shorter = ranges.filter(|(_, (lower, upper))| below(lower.1, lower.0) || below(upper.0, upper.1)).map(
            |(j, ((lower, own_lower), (upper, own_upper)))| {
                format!(
                    "its controller limits joint {} to {own_lower:.2} to {own_upper:.2} rad, the run to {lower:.2} to \
                     {upper:.2} rad",
                    j + 1
                )
            },
        );
        let tool = self.tool.zip(tool).filter(|(run, own)| below(*run, *own)).map(|(run, own)| {
            format!("its controller's settings limit the tool to {own:.2} m/s, the run to {run:.2} m/s")
        });
        slower.next().or_else(|| shorter.next()).or(tool)
    }
}

impl Worker {
    /// Takes the controller's present limits. Narrower ones hold the arm until they are wide enough again, or the run
    /// is restarted.
    pub(super) fn compare_limits(&mut self, own: &JointLimits, tool: Option<f64>) {
        let narrower = self.limits.compare(own, tool);
        if let Some(what) = narrower.as_ref().filter(|_| self.limits.narrower != narrower) {
            self.trouble(what);
        }
        self.limits.narrower = narrower;
        self.hold_for_limits();
    }

    pub(super) fn hold_for_limits(&mut self) {
        match (self.limits.narrower.is_some(), self.state.interference) {
            (true, Interference::None) => self.state.interference = Interference::Limits,
            (false, Interference::Limits) => self.state.interference = Interference::None,
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_limits_below_those_of_the_run_are_named() {
        let limits = JointLimits::uniform(2, 2.0, 1.0);
        let mut run = RunLimits::default();
        run.set(&limits);
        run.set_tool(Some(0.95), None);
        assert_eq!(run.compare(&limits, None), None);
        assert_eq!(run.compare(&JointLimits::uniform(2, 3.0, 2.0), Some(1.2)), None, "wider ones");
        let named = |own: &JointLimits, tool| run.compare(own, tool).unwrap();
        let slower = JointLimits { velocity_max: vec![1.0, 0.5], ..limits.clone() };
        assert_eq!(named(&slower, None), "its controller limits joint 2 to 0.50 rad/s, the run to 1.00 rad/s");
        let shorter = JointLimits { position_lower: vec![-1.0, -2.0], ..limits.clone() };
        let text = "its controller limits joint 1 to -1.00 to 2.00 rad, the run to -2.00 to 2.00 rad";
        assert_eq!(named(&shorter, None), text);
        let text = "its controller's settings limit the tool to 0.24 m/s, the run to 0.95 m/s";
        assert_eq!(named(&limits, Some(0.24)), text);
        run.set_tool(Some(0.2), Some(0.24));
        assert_eq!(run.compare(&limits, Some(0.24)), None, "the blueprint's limit is lower");
    }
}
