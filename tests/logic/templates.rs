//! The templates of `dimos adapter new`, as they stand: their unit tests, and the conformance suite over each.

#[allow(dead_code, reason = "a library's public parts")]
#[path = "../../assets/templates/can/mod.rs"]
mod can;
#[allow(dead_code, reason = "a library's public parts")]
#[path = "../../assets/templates/serial/mod.rs"]
mod serial;
#[allow(dead_code, reason = "a library's public parts")]
#[path = "../../assets/templates/tcp/mod.rs"]
mod tcp;

use dimos::hardware::conformance::{Outcome, Subject, checks, run_on};
use dimos::hardware::registry::AdapterSpec;
use dimos::rt::counting;
use serde_json::{Value, json};

/// The suite over a row with options, its checks side by side.
fn conforms(row: &AdapterSpec, options: Value) {
    let mut subject = Subject { allocations: Some(counting::allocations), ..Subject::emulated(row) };
    subject.config.options = options;
    let failures: Vec<String> = std::thread::scope(|scope| {
        let threads: Vec<_> = checks().map(|check| (check, scope.spawn(|| run_on(&subject, check).0))).collect();
        let outcomes = threads.into_iter().map(|(check, thread)| (check, thread.join().unwrap()));
        outcomes
            .filter_map(|(check, outcome)| match outcome {
                Outcome::Passed => None,
                Outcome::Skipped(why) => {
                    println!("{} does not apply: {why}", check.name);
                    None
                }
                Outcome::Failed(why) => Some(format!("{}: {why}", check.name)),
            })
            .collect()
    });
    assert!(failures.is_empty(), "\n{}", failures.join("\n"));
}

#[test]
fn the_can_template_conforms() {
    conforms(&can::SPEC, json!({}));
}

#[test]
fn the_serial_template_conforms() {
    conforms(&serial::SPEC, json!({}));
}

#[test]
fn the_tcp_template_conforms() {
    conforms(&tcp::SPEC, json!({}));
}

/// The emulated arm has the calibration of the data sheet, whatever that of the real one is.
#[test]
fn the_serial_template_conforms_with_a_calibration() {
    let joint = |zero: i32, reversed: bool| json!({"zero": zero, "low": 200, "high": 3900, "reversed": reversed});
    let mut servos: Vec<Value> = (0..serial::SERVOS as i32).map(|k| joint(1900 + 40 * k, k == 1)).collect();
    servos[serial::DOF] = json!({"zero": 1000, "low": 1000, "high": 3000});
    conforms(&serial::SPEC, json!({ "calibration": servos }));
}
