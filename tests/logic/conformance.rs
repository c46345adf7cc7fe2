//! Every row of the adapter table against the conformance suite. A new row needs no further line here.

use dimos::hardware::conformance::{Outcome, Subject, checks, run_all};

use dimos::rt::counting::allocations;

/// An arm whose joints droop and lag as recorded ones do, and one that sags within its accuracy.
#[test]
fn arms_that_obey_physics_conform() {
    let registry = dimos::arms::registry();
    for (name, options) in [
        ("so101", serde_json::json!({"sim": {"droop": 0.11, "lag": 0.13}})),
        ("yourarm", serde_json::json!({"sim": {"servo_stiffness": 20_000.0}})),
    ] {
        let mut subject = Subject::emulated(registry.get(name).unwrap());
        subject.config.options = options;
        for (check, outcome, _) in run_all(&subject, &checks().collect::<Vec<_>>(), &|_, _| (), &|| false) {
            assert!(!matches!(outcome, Outcome::Failed(_)), "{name} {}: {outcome:?}", check.name);
        }
    }
}

#[test]
fn every_adapter_conforms() {
    let registry = dimos::arms::registry();
    assert!(!registry.rows().is_empty());
    let mut failures = Vec::new();
    for row in registry.rows() {
        let subject = Subject { allocations: Some(allocations), ..Subject::emulated(row) };
        for (check, outcome, _) in run_all(&subject, &checks().collect::<Vec<_>>(), &|_, _| (), &|| false) {
            match outcome {
                Outcome::Passed => println!("{:10} {:32} passed", row.name, check.name),
                Outcome::Skipped(why) => println!("{:10} {:32} does not apply: {why}", row.name, check.name),
                Outcome::Failed(why) => failures.push(format!("{} {}: {why}", row.name, check.name)),
            }
        }
    }
    assert!(failures.is_empty(), "\n{}", failures.join("\n"));
}
