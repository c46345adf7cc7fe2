//! A queue that outlives the thread that takes from it: what waits when that thread hangs is taken by its replacement.

use std::collections::VecDeque;
use std::sync::Mutex;

use tokio::sync::Notify;

use dimos_core::sync::lock;

/// Items that wait to be taken.
#[derive(Debug)]
pub(crate) struct Handover<T> {
    waiting: Mutex<VecDeque<T>>,
    put: Notify,
}

impl<T> Default for Handover<T> {
    fn default() -> Self {
        Self { waiting: Mutex::default(), put: Notify::new() }
    }
}

impl<T> Handover<T> {
    /// Adds an item. Never blocks.
    pub fn put(&self, item: T) {
        lock(&self.waiting).push_back(item);
        // All are woken: the one that has waited for the longest time may hang.
        self.put.notify_waiters();
    }

    /// Returns how many wait.
    pub fn len(&self) -> usize {
        lock(&self.waiting).len()
    }

    /// Waits for the oldest item.
    pub async fn take(&self) -> T {
        loop {
            // Before the look, so that nothing is put unseen between both.
            let put = self.put.notified();
            if let Some(item) = lock(&self.waiting).pop_front() {
                return item;
            }
            put.await;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::pin::pin;
    use std::task::{Context, Poll, Waker};

    use super::*;

    #[test]
    fn what_a_hung_thread_does_not_take_another_one_does() {
        let queue = Handover::default();
        let (mut hung, mut next) = (pin!(queue.take()), pin!(queue.take()));
        let mut context = Context::from_waker(Waker::noop());
        assert!(hung.as_mut().poll(&mut context).is_pending());
        assert!(next.as_mut().poll(&mut context).is_pending());
        queue.put(1);
        assert_eq!(next.as_mut().poll(&mut context), Poll::Ready(1));
        assert!(hung.as_mut().poll(&mut context).is_pending());
    }
}
