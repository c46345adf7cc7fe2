//! Every row of the adapter table against the conformance suite. A new row needs no further line here.

use dimos::hardware::conformance::{Outcome, Subject, checks, run_all};

use dimos::rt::counting::allocations;

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
