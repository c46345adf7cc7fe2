//! Latest-value slot between two threads: neither the writer nor the reader ever blocks, and the reader always sees a
//! complete value, the newest one. A triple buffer.

use std::cell::UnsafeCell;
use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};

/// Bit of the shared byte: the middle buffer holds a value that the reader has not taken.
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

/// Creates a slot with the value `initial`.
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
    /// Returns the newest value; repeats it if there is no newer one.
    pub fn read(&mut self) -> T {
        if self.shared.middle.load(Ordering::Relaxed) & FRESH != 0 {
            let before = self.shared.middle.swap(self.own, Ordering::AcqRel);
            self.own = before & INDEX;
        }
        #[allow(clippy::indexing_slicing, reason = "the remainder of a division by three")]
        let cell = &self.shared.buffers[(self.own & INDEX) as usize % 3];
        // SAFETY: the buffer with our own index belongs to the reader alone until the next swap.
        unsafe { *cell.get() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashSet;

    /// A value that reveals tearing: all words follow from the first.
    fn value(n: u64) -> [u64; 32] {
        std::array::from_fn(|k| {
            n.wrapping_mul(0x9e37_79b9_7f4a_7c15).rotate_left(k as u32) ^ if k == 0 { 0 } else { n }
        })
    }

    #[test]
    fn two_threads_see_whole_values_in_order_and_the_last_one() {
        const WRITES: u64 = 200_000;
        let numbered = |n| (n, value(n));
        let (mut writer, mut reader) = slot(numbered(0));
        let writing = std::thread::spawn(move || {
            (1..=WRITES).fold(0u64, |replaced, n| replaced + u64::from(writer.write(&numbered(n))))
        });
        let (mut last, mut taken) = (0, 0u64);
        while last < WRITES {
            let over = writing.is_finished();
            let (n, words) = reader.read();
            assert_eq!(words, value(n), "torn");
            assert!(n >= last, "{n} after {last}");
            taken += u64::from(n > last);
            assert!(!over || n == WRITES, "the last value is lost: {n}");
            last = n;
        }
        assert_eq!(writing.join().unwrap() + taken, WRITES, "each write is read or replaced");
    }

    #[test]
    fn a_value_is_repeated_until_the_next_write() {
        let (mut writer, mut reader) = slot(7);
        assert_eq!((reader.read(), reader.read()), (7, 7));
        assert!(!writer.write(&8));
        assert!(writer.write(&9), "8 was never read");
        assert_eq!((reader.read(), reader.read()), (9, 9));
    }

    /// The protocol as a state machine of single steps. A buffer is two words, written and read one at a time.
    #[derive(Clone, PartialEq, Eq, Hash)]
    struct Model {
        buffers: [[u8; 2]; 3],
        middle: u8,
        writer: (u8, u8),
        written: u8,
        reader: (u8, u8),
        half: u8,
        seen: u8,
        /// The newest value published when the current read began.
        due: u8,
    }

    const LAST: u8 = 5;

    impl Model {
        fn write_step(&self) -> Option<Self> {
            let mut m = self.clone();
            let (own, step) = m.writer;
            match step {
                _ if m.written == LAST => return None,
                0 | 1 => m.buffers[own as usize][step as usize] = m.written + 1,
                _ => {
                    let before = std::mem::replace(&mut m.middle, own | FRESH);
                    m.writer = (before & INDEX, 0);
                    m.written += 1;
                    return Some(m);
                }
            }
            m.writer.1 += 1;
            Some(m)
        }

        fn read_step(&self) -> Self {
            let mut m = self.clone();
            let (own, step) = m.reader;
            match step {
                0 => {
                    m.due = m.written;
                    m.reader.1 = if m.middle & FRESH != 0 { 1 } else { 2 };
                }
                1 => {
                    let before = std::mem::replace(&mut m.middle, own);
                    m.reader = (before & INDEX, 2);
                }
                2 => {
                    m.half = m.buffers[own as usize][0];
                    m.reader.1 = 3;
                }
                _ => {
                    let second = m.buffers[own as usize][1];
                    assert_eq!(m.half, second, "torn");
                    assert!(second >= m.seen, "an older value after a newer one");
                    assert!(second >= m.due, "not the newest one");
                    m.seen = second;
                    m.reader.1 = 0;
                }
            }
            m
        }
    }

    /// Every interleaving of five writes with reads, step by step.
    #[test]
    fn every_interleaving_keeps_the_buffers_apart() {
        let start = Model {
            buffers: [[0; 2]; 3],
            middle: 1,
            writer: (0, 0),
            written: 0,
            reader: (2, 0),
            half: 0,
            seen: 0,
            due: 0,
        };
        let (mut seen, mut open) = (HashSet::from([start.clone()]), vec![start]);
        while let Some(m) = open.pop() {
            let mut owners = [m.writer.0, m.reader.0, m.middle & INDEX];
            owners.sort_unstable();
            assert_eq!(owners, [0, 1, 2], "a buffer has two owners");
            for next in m.write_step().into_iter().chain([m.read_step()]) {
                if seen.insert(next.clone()) {
                    open.push(next);
                }
            }
        }
        assert!(seen.len() > 500, "{}", seen.len());
    }
}
