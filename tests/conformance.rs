//! Every row of the adapter table against the conformance suite. A new row needs no further line here.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

use dimos::hardware::conformance::{Outcome, Subject, checks, run_all};
use dimos::hardware::registry::Registry;

/// Counts the allocations of each thread.
struct Counting;

thread_local! {
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

// SAFETY: everything is handed on to the system's allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let _ = ALLOCATIONS.try_with(|count| count.set(count.get() + 1));
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

fn allocations() -> u64 {
    ALLOCATIONS.with(Cell::get)
}

#[test]
fn every_adapter_conforms() {
    let registry = Registry::builtin();
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
