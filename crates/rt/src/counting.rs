//! Counting allocator, for tests: what must not allocate is called between two counts. A test binary installs it with
//! `#[global_allocator]`.

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

/// Counts the calls of each thread, and passes them on to the system's allocator.
#[derive(Debug)]
pub struct Counting;

thread_local! {
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
    static WATCHED: Cell<bool> = const { Cell::new(false) };
    static WATCHED_CALLS: Cell<u64> = const { Cell::new(0) };
}

fn count(allocates: bool) {
    // The cells of an ending thread are gone.
    let _ = ALLOCATIONS.try_with(|n| n.set(n.get() + u64::from(allocates)));
    let watched = WATCHED.try_with(Cell::get).unwrap_or(false);
    let _ = WATCHED_CALLS.try_with(|n| n.set(n.get() + u64::from(watched)));
}

// SAFETY: passes every call on to the system's allocator; counting neither allocates nor unwinds.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count(true);
        // SAFETY: the caller keeps the contract of `GlobalAlloc`, and so of `System`.
        unsafe { System.alloc(layout) }
    }

    // SAFETY: as above.
    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        count(true);
        // SAFETY: the caller keeps the contract of `GlobalAlloc`, and so of `System`.
        unsafe { System.alloc_zeroed(layout) }
    }

    // SAFETY: as above.
    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count(true);
        // SAFETY: the caller keeps the contract of `GlobalAlloc`, and so of `System`.
        unsafe { System.realloc(pointer, layout, size) }
    }

    // SAFETY: as above.
    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        count(false);
        // SAFETY: the caller keeps the contract of `GlobalAlloc`, and so of `System`.
        unsafe { System.dealloc(pointer, layout) }
    }
}

/// Returns the number of allocations of the calling thread so far; 0 if the allocator is not installed.
pub fn allocations() -> u64 {
    ALLOCATIONS.with(Cell::get)
}

/// Starts or ends a watch over the calling thread, which counts every call, also those that free memory.
pub fn watch(on: bool) {
    WATCHED.set(on);
}

/// Returns the number of calls of the calling thread while it was watched.
pub fn watched_calls() -> u64 {
    WATCHED_CALLS.get()
}
