//! The conformance suite of dimos over the adapter: each check has an adapter and an emulator of its own.

use dimos_hardware::conformance::{Outcome, checks, run};
use dimos_hardware::counting::{self, Counting};

/// What runs in every cycle must not allocate: the suite counts.
#[global_allocator]
static ALLOCATOR: Counting = Counting;

#[test]
fn the_adapter_conforms() {
    // The checks mostly wait for motion, so they run side by side.
    let outcomes: Vec<_> = std::thread::scope(|scope| {
        let count = Some(counting::allocations as fn() -> u64);
        let threads: Vec<_> =
            checks().map(|check| (check, scope.spawn(move || run(&acme::SPEC, check, count)))).collect();
        threads.into_iter().map(|(check, thread)| (check, thread.join().unwrap())).collect()
    });
    let mut failures = 0;
    for (check, outcome) in outcomes {
        match outcome {
            Outcome::Passed => println!("{:32} passed", check.name),
            Outcome::Skipped(why) => println!("{:32} does not apply: {why}", check.name),
            Outcome::Failed(why) => {
                failures += 1;
                println!("{:32} FAILED: {why}\n{:32} {}", check.name, "", check.about);
            }
        }
    }
    assert!(failures == 0, "{failures} checks failed");
}
