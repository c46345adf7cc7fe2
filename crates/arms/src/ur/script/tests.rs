//! The reader of URScript, on the vendor's own programs and on those of dimos.

use std::path::Path;

use super::read;
use crate::ur::model::Model;
use crate::ur::{Options, program};

/// Why a text is refused, if it is.
fn refused(text: &str) -> Option<String> {
    read(text).err().map(|refused| refused.to_string())
}

#[test]
fn the_vendors_programs_are_read() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/protocols/ur_script");
    for name in ["external_control_5.20.0.script", "external_control_10.12.1.script"] {
        let Ok(text) = std::fs::read_to_string(folder.join(name)) else {
            println!("SKIPPED: ../shared (make test-tools)");
            assert_ne!(std::env::var("DIMOS_NO_SKIP").as_deref(), Ok("1"), "{name} is missing");
            return;
        };
        assert_eq!(refused(&text), None, "{name}");
        // A name that the manual does not have, somewhere in it.
        let wrong = text.replace("get_target_joint_speeds()", "get_wanted_joint_speeds()");
        assert!(refused(&wrong).unwrap().contains("there is no function get_wanted_joint_speeds"));
    }
}

#[test]
fn the_programs_of_dimos_are_read() {
    for model in Model::ALL {
        for stop_deceleration in [1.0, 8.0, 7.5] {
            let options = Options { stop_deceleration, ..Options::default() };
            let mut limits = model.limits();
            assert_eq!(refused(&program::control(7, &options, &limits)), None, "{model:?}");
            limits.position_upper = vec![3.0; 6];
            limits.velocity_max = vec![1.0; 6];
            assert_eq!(refused(&program::control(i32::MAX, &options, &limits)), None, "whole numbers");
        }
    }
    for text in [
        program::payload(1.5, [0.0, 0.01, 0.05], None),
        program::payload(1.0, [0.0; 3], Some([0.1, 0.2, 0.3, 0.0, 0.0, 0.0])),
        program::mounting([0.0, 0.6, -0.8]),
        program::tool_voltage(24),
    ] {
        assert_eq!(refused(&text), None, "{text}");
    }
}

/// Puts lines into a program.
fn program_of(lines: &[&str]) -> String {
    format!("def dimos():\n  {}\nend\n", lines.join("\n  "))
}

#[test]
fn what_the_language_has_is_taken() {
    for lines in [
        &["left = 1", "left = left + 2 * left - 7 % 2"][..],
        &["left = 1.0", "left = left - 0.5", "left = 1 / 2"],
        &["q = get_target_joint_positions()", "i = floor(2.5)", "q[i] = q[i] + 0.1"],
        &["q = [0, 0.5, 0, 0, 0, 0]", "q[1] = 0.25"],
        &["on = True", "on = on and not (1 < 2.5) or False", "if on:", "  sync()", "end"],
        &["servoj([0, 0, 0, 0, 0, 0], t=0.002, gain=300)"],
        &["def f(a, b=2):", "  return a + b", "end", "x = f(1)", "x = f(1, b=3)"],
        &[
            "while True:",
            "  if 1 > 2:",
            "    break",
            "  elif 2 > 1:",
            "    sync()",
            "  else:",
            "    halt",
            "  end",
            "end",
        ],
        &["textmsg(\"a # b\", 1) # a comment", "x = -1 - -2"],
        &["global total = 0", "local here = 1.5e-3 + .5"],
    ] {
        assert_eq!(refused(&program_of(lines)), None, "{lines:?}");
    }
}

#[test]
fn what_the_language_does_not_have_is_refused() {
    for (lines, why) in [
        // Types.
        (&["left = 1", "left = left - 0.5"][..], "left is Int, and cannot become Float"),
        (&["left = 0.5", "left = 1"], "left is Float, and cannot become Int"),
        (&["left = 4", "left = left / 2"], "left is Int, and cannot become Float"),
        (&["if 1 > 2:", "  a = 1", "else:", "  a = 1.5", "end"], "a is Int, and cannot become Float"),
        (&["a = 1", "a = True"], "a is Int, and cannot become Bool"),
        (&["a = True + 1"], "Add does not take Bool and Int"),
        (&["a = True == 1"], "Equal does not take Bool and Int"),
        (&["a = 1 and True"], "And does not take Int and Bool"),
        (&["a = not 1"], "not takes Bool, not Int"),
        (&["a = True < False"], "Less does not take Bool and Bool"),
        (&["a = \"x\" + 1"], "Add does not take Text and Int"),
        (&["if \"x\":", "  sync()", "end"], "a condition is Bool, not Text"),
        (&["q = [0, 0]", "a = q[1.0]"], "an index is Int, not Float"),
        (&["q = [0.5, 0]", "q[4 / 2] = 0.5"], "an index is Int, not Float"),
        (&["q = [0, 0]", "q[1] = 0.5"], "an item of q is Int, and cannot become Float"),
        (&["q = [0, True]"], "the items of a list have one type"),
        (&["q = [0.5, 0]", "q = 1.0"], "q is Floats, and cannot become Float"),
        (&["q = [1.0] + 1"], "Add does not take Floats and Int"),
        (&["a = 1", "b = a[0]"], "Int has no items"),
        (&["a = p[0, 0, 0]"], "a pose has six numbers"),
        (&["a = sync()"], "this function returns nothing"),
        (&["def f():", "  return 1", "end", "x = 0.5", "x = f()"], "x is Float, and cannot become Int"),
        (
            &["def f(a):", "  if a:", "    return 1", "  end", "  return 0.5", "end", "x = f(True)"],
            "the function returns Int, and cannot return Float",
        ),
        (&["def f(a):", "  a = a - 0.5", "  return a", "end", "x = f(1)"], "a is Int, and cannot become Float"),
        // Names and numbers of arguments.
        (&["a = abs(1.0)"], "there is no function abs"),
        (&["a = sqrt(2, 3)"], "sqrt takes 1 arguments"),
        (&["a = pow(2)"], "pow needs exponent"),
        (&["a = get_steptime(1)"], "get_steptime takes 0 arguments"),
        (&["servoj([0.0], speed=1)"], "servoj takes 6 arguments"),
        (&["servoj([0.0], q=[0.0])"], "servoj gets q twice"),
        (&["servoj(1)"], "q of servoj cannot be Int"),
        (&["a = read_input_integer_register(24.0)"], "address of read_input_integer_register cannot be Float"),
        (&["write_output_integer_register(24, 0.5)"], "value of write_output_integer_register cannot be Float"),
        (&["set_digital_out(1, 1)"], "b of set_digital_out cannot be Int"),
        (&["a = b"], "b has no value yet"),
        (&["a[0] = 1"], "a has no value yet"),
        (&["a = true"], "true has no value yet"),
        (&["def f(a):", "  return a", "end", "x = f()"], "f needs a"),
        (&["def sync():", "  halt", "end"], "there is a function sync already"),
        (&["run sync()"], "this is no thread"),
        // Structure.
        (&["a = 1 +"], "is no value"),
        (&["a = (1"], "is missing"),
        (&["a = 1 b = 2"], "after the end of a statement"),
        (&["a += 1"], "this statement does nothing"),
        (&["a"], "this statement does nothing"),
        (&["for i in q:", "end"], "this statement does nothing"),
        (&["if 1 > 2", "end"], "\":\" is missing"),
        (&["pass"], "this statement does nothing"),
        (&["end = 1"], "after the end of a statement"),
        (&["a = 1x"], "is no number"),
        (&["a = 'x'"], "is no sign of the language"),
        (&["a = \"x"], "a text without end"),
        (&["f(1) = 2"], "only a variable is assigned"),
    ] {
        let found = refused(&program_of(lines));
        assert!(found.as_ref().is_some_and(|found| found.contains(why)), "{lines:?}: {found:?}");
    }
    assert_eq!(refused("def f():\n  a = 1\n"), Some("line 2: \"end\" is missing, found None".into()));
    assert_eq!(refused("def f():\n  a = 1\nend\nend\n").unwrap(), "line 4: \"end\" begins no statement");
    assert!(refused(&format!("a = {}1{}\n", "(".repeat(5000), ")".repeat(5000))).unwrap().contains("too many"));
}
