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

use dimos::hardware::conformance::{Outcome, checks, run};
use dimos::hardware::registry::AdapterSpec;
use dimos::rt::counting;

/// The suite over a row, its checks side by side.
fn conforms(row: &AdapterSpec) {
    let failures: Vec<String> = std::thread::scope(|scope| {
        let threads: Vec<_> =
            checks().map(|check| (check, scope.spawn(|| run(row, check, Some(counting::allocations))))).collect();
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
    conforms(&can::SPEC);
}

#[test]
fn the_serial_template_conforms() {
    conforms(&serial::SPEC);
}

#[test]
fn the_tcp_template_conforms() {
    conforms(&tcp::SPEC);
}
