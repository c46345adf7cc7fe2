//! The programs that the adapter sends to the controller. The text is in `control.script`.

use super::{Options, SPEC};
use dimos_core::joint::JointLimits;

/// The control program, with its constants to be filled in. A counter, checked in each step, ends it when orders no
/// longer come: the controller's own watchdog would add nothing.
const CONTROL: &str = include_str!("control.script");
/// Acceleration of gravity, as the vendor's examples have it [m/s²].
const STANDARD_GRAVITY: f64 = 9.82;

/// Returns the control program. `number` distinguishes its state from that of an earlier one; no joint goes faster than
/// its top speed in `limits`, or beyond its range.
pub fn control(number: i32, options: &Options, limits: &JointLimits) -> String {
    // Of floats, also whole ones: the program changes items of the lists.
    let list = |values: &[f64]| values.iter().map(|value| format!("{value:?}")).collect::<Vec<_>>().join(", ");
    let tool = options.tool_line.map(|line| line.script()).unwrap_or_default();
    CONTROL
        .replace("  # @TOOL@\n", &tool)
        .replace("@SPEEDS@", &list(&limits.velocity_max))
        .replace("@LOWER@", &list(&limits.position_lower))
        .replace("@UPPER@", &list(&limits.position_upper))
        .replace("@GAP@", &format!("{:?}", SPEC.gap_tolerance.as_secs_f64()))
        .replace("@NUMBER@", &number.to_string())
        .replace("@LOOKAHEAD@", &options.lookahead_time.to_string())
        .replace("@GAIN@", &options.gain.to_string())
        .replace("@DECELERATION@", &options.stop_deceleration.to_string())
}

/// Returns a program that sets the payload: mass [kg] and centre of gravity [m], and its inertia (xx, yy, zz, xy, xz,
/// yz [kg·m²]) if it is given.
pub fn payload(mass: f64, cog: [f64; 3], inertia: Option<[f64; 6]>) -> String {
    let list = |values: &[f64]| values.iter().map(f64::to_string).collect::<Vec<_>>().join(", ");
    let call = match inertia {
        Some(inertia) => format!("set_target_payload({mass}, [{}], [{}])", list(&cog), list(&inertia)),
        None => format!("set_payload({mass}, [{}])", list(&cog)),
    };
    beside("dimos_payload", &call)
}

/// Returns a program that sets the mounting by the direction of gravity in the base frame, a unit vector. The
/// controller takes the acceleration that the base experiences: upright, that is along +z.
pub fn mounting(gravity: [f64; 3]) -> String {
    let [x, y, z] = gravity.map(|v| 0.0 - STANDARD_GRAVITY * v);
    beside("dimos_mounting", &format!("set_gravity([{x}, {y}, {z}])"))
}

/// Returns a program that sets the tool's supply voltage [V].
pub fn tool_voltage(volts: u8) -> String {
    beside("dimos_tool", &format!("set_tool_voltage({volts})"))
}

/// Returns a program of one call that runs beside the main one.
fn beside(name: &str, call: &str) -> String {
    format!("sec {name}():\n  {call}\nend\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_control_program_is_complete() {
        let text = control(7, &Options::default(), &crate::ur::model::Model::Ur3e.limits());
        assert!(text.starts_with("def dimos_control():\n") && text.ends_with("\nend\n"));
        assert!(text.contains("\n  number = 7\n") && !text.contains('@'), "{text}");
        assert!(text.contains("servoj(q, 0, 0, step, 0.05, 500)") && text.contains("stopj(8)"), "{text}");
        assert!(text.is_ascii() && text.lines().count() < 220);
        // Every block is closed, and its lines are indented by two.
        let mut depth = 0_usize;
        for line in text.lines() {
            let words = line.trim();
            depth -= usize::from(["end", "else:"].contains(&words) || words.starts_with("elif "));
            assert_eq!(line.len() - words.len(), 2 * depth, "{line:?}");
            depth += usize::from(words.ends_with(':') && !words.starts_with('#'));
        }
        assert_eq!(depth, 0);
    }

    #[test]
    fn programs_beside_it_are_single_calls() {
        assert_eq!(tool_voltage(24), "sec dimos_tool():\n  set_tool_voltage(24)\nend\n");
        let text = mounting([0.0, 0.0, -1.0]);
        assert_eq!(text, "sec dimos_mounting():\n  set_gravity([0, 0, 9.82])\nend\n");
        let text = payload(1.5, [0.0, 0.01, 0.05], None);
        assert_eq!(text, "sec dimos_payload():\n  set_payload(1.5, [0, 0.01, 0.05])\nend\n");
        let text = payload(1.5, [0.0; 3], Some([0.1, 0.2, 0.3, 0.0, 0.0, 0.0]));
        assert!(text.contains("set_target_payload(1.5, [0, 0, 0], [0.1, 0.2, 0.3, 0, 0, 0])"), "{text}");
    }
}
