//! What a client reads on stderr when a request of its program was not executed: the SDK's call, and why.

use std::time::{Duration, Instant};

/// Minimum time between two lines about the same request.
const REPEATED_AFTER: Duration = Duration::from_secs(1);

/// The refusal that was last reported.
#[derive(Debug, Default)]
pub struct Refusals {
    last: Option<(u8, Instant)>,
}

impl Refusals {
    /// Returns the line for a request to `register` that was refused in this mode and state; `None` for queries, and
    /// for the same request shortly after.
    pub fn line(&mut self, register: u8, data: &[u8], mode: u8, state: u8) -> Option<String> {
        let (call, why) = reason(register, data)?;
        let recent = self.last.is_some_and(|(last, at)| last == register && at.elapsed() < REPEATED_AFTER);
        self.last = Some((register, Instant::now()));
        if recent {
            return None;
        }
        let why = why
            .map_or_else(|| format!("not in mode {mode} and state {state}, or not with these values"), str::to_owned);
        Some(format!("{call} refused (code 10): {why}"))
    }
}

/// Returns the SDK's call and why it is refused; without a reason the arm was not ready. `None` for queries.
fn reason(register: u8, data: &[u8]) -> Option<(String, Option<&'static str>)> {
    const NO_LINE: &str = "a run has no absolute Cartesian moves here; relative ones need an xArm and a known pose";
    const NO_SETTING: &str = "a run does not change settings of the box";
    let (call, why) = match (register, data) {
        (21 | 22 | 28 | 92, _) => ("set_position, set_tool_position or set_position_aa", Some(NO_LINE)),
        (83, _) if is_cartesian_change(data) => ("set_position(relative=True)", Some(NO_LINE)),
        (23 | 24 | 83, _) => ("set_servo_angle", None),
        (25, _) => ("move_gohome", None),
        (26, _) => ("set_pause_time", None),
        (27, _) => ("move_circle", Some("a run has no circles")),
        (29, _) => ("set_servo_angle_j", None),
        (30 | 93, _) => ("set_servo_cartesian", Some("a run has no stream of poses of the box")),
        (81, _) => ("vc_set_joint_velocity", None),
        (82, _) => ("vc_set_cartesian_velocity", Some("a run has no Cartesian velocities of the box")),
        (11, [1..=7, _]) => ("motion_enable", Some("a run switches all motors at once")),
        (11, _) => ("motion_enable", Some("the arm is in error; clean_error first")),
        (12, [0]) => ("set_state(0)", Some("the arm is not ready; clean_error and motion_enable first")),
        (12, _) => ("set_state", None),
        (18, _) => ("set_servo_detach", Some("a run releases no brakes")),
        (127 | 129 | 143 | 145, _) => ("an output or setting of the tool", Some("a run has none of the box")),
        (134..=138 | 142 | 144 | 146 | 147, _) => {
            ("an output or setting of the box", Some("a run has none of the box"))
        }
        (16, _) => ("clean_error", Some("the cause is still there")),
        (19, _) => ("set_mode", Some("the run has no task for this mode, or the mode is not 0, 1 or 4")),
        (36, _) => ("set_tcp_load", Some("the arm does not take this load")),
        (79, _) => ("set_simulation_robot", Some("the run decides what is simulated")),
        (124 | 241, _) => ("a telegram to the tool", Some("the run has no such device, or it does not do this")),
        (31..=40 | 47 | 48 | 50..=52 | 56 | 58..=60 | 66 | 70 | 73 | 77 | 78 | 80 | 123 | 201..=202, _) => {
            ("a setting", Some(NO_SETTING))
        }
        // Queries, the SDK's request for feedback, and checks.
        (1..=10 | 13..=15 | 17 | 41..=46 | 49 | 53 | 55 | 57 | 65 | 67 | 69 | 76 | 91 | 106 | 107, _) => return None,
        (102 | 104 | 125 | 128 | 130..=133 | 139..=141 | 150 | 200 | 203 | 204 | 212 | 230 | 231 | 233, _) => {
            return None;
        }
        (234 | 253 | 254, _) => return None,
        _ => ("a request", Some("a run has nothing for it")),
    };
    Some((format!("{call} (register {register})"), why))
}

/// Returns whether a relative move (register 83) is one of the tool.
fn is_cartesian_change(data: &[u8]) -> bool {
    data.get(44) == Some(&0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_would_move_or_set_is_reported_once_and_queries_are_not() {
        let mut refusals = Refusals::default();
        let line = refusals.line(21, &[], 0, 2).unwrap();
        assert!(line.starts_with("set_position, set_tool_position or set_position_aa (register 21) refused (code 10)"));
        assert_eq!(refusals.line(21, &[], 0, 2), None, "a moment later");
        assert!(refusals.line(29, &[], 1, 4).unwrap().contains("not in mode 1 and state 4"));
        assert_eq!(refusals.line(41, &[], 0, 2), None);
        let mut change = [0; 46];
        assert!(refusals.line(83, &change, 0, 2).unwrap().starts_with("set_position(relative=True)"));
        change[44] = 1;
        let mut refusals = Refusals::default();
        assert!(refusals.line(83, &change, 0, 2).unwrap().starts_with("set_servo_angle "));
    }
}
