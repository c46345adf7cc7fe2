//! A latest-value slot between two threads: the writer never waits, the reader never waits, and the reader always
//! sees a whole value, the newest one. A triple buffer.

use super::sync::{Arc, AtomicU8, Ordering, UnsafeCell};

/// Bit of the shared byte that says the middle buffer holds a value the reader has not taken.
const FRESH: u8 = 0b100;
const INDEX: u8 = 0b011;

struct Shared<T> {
    buffers: [UnsafeCell<T>; 3],
    /// Index of the middle buffer, and `FRESH`.
    middle: AtomicU8,
}

// SAFETY: each of the three buffers is owned by exactly one party at any time: the writer's own, the reader's own,
// and the middle one, which changes hands only by the atomic swap of `middle`.
unsafe impl<T: Send> Sync for Shared<T> {}
// SAFETY: as above; the values move between threads, so they must be `Send`.
unsafe impl<T: Send> Send for Shared<T> {}

/// The writing end.
pub struct SlotWriter<T> {
    shared: Arc<Shared<T>>,
    own: u8,
}

/// The reading end.
pub struct SlotReader<T> {
    shared: Arc<Shared<T>>,
    own: u8,
}

/// A slot that holds `initial` until the first write.
pub fn slot<T: Copy + Send>(initial: T) -> (SlotWriter<T>, SlotReader<T>) {
    let shared = Arc::new(Shared {
        buffers: [UnsafeCell::new(initial), UnsafeCell::new(initial), UnsafeCell::new(initial)],
        middle: AtomicU8::new(1),
    });
    (SlotWriter { shared: shared.clone(), own: 0 }, SlotReader { shared, own: 2 })
}

impl<T: Copy> SlotWriter<T> {
    /// Publishes a value. Returns whether it replaced one that was never read.
    pub fn write(&mut self, value: &T) -> bool {
        if let Some(cell) = self.shared.buffers.get(self.own as usize) {
            // SAFETY: the buffer with our own index belongs to the writer alone until the swap below.
            unsafe { *cell.get() = *value };
        }
        let before = self.shared.middle.swap(self.own | FRESH, Ordering::AcqRel);
        self.own = before & INDEX;
        before & FRESH != 0
    }
}

impl<T: Copy> SlotReader<T> {
    /// The newest value; the same one again where there is no newer.
    pub fn read(&mut self) -> T {
        if self.shared.middle.load(Ordering::Relaxed) & FRESH != 0 {
            let before = self.shared.middle.swap(self.own, Ordering::AcqRel);
            self.own = before & INDEX;
        }
        let cell = &self.shared.buffers[(self.own & INDEX) as usize % 3];
        // SAFETY: the buffer with our own index belongs to the reader alone until the next swap.
        unsafe { *cell.get() }
    }
}
