//! Ends a sequence of requests that the run makes: nothing is sent to the tick for it after its end.

use std::future::Future;
use std::sync::{Arc, Mutex};

use dimos_core::sync::lock;

tokio::task_local! {
    static CURB: Arc<Curb>;
}

/// Ends a sequence of requests. A `cancel` first ends the curb, then asks the tick: what was sent before is cancelled,
/// and nothing is sent after.
#[derive(Debug, Default)]
pub struct Curb(Mutex<Option<String>>);

impl PartialEq for Curb {
    fn eq(&self, other: &Self) -> bool {
        std::ptr::eq(self, other)
    }
}

impl Curb {
    /// Ends the sequence for this reason; the first one counts.
    pub fn end(&self, why: &str) {
        lock(&self.0).get_or_insert_with(|| why.to_owned());
    }

    /// Returns why it has ended, if it has.
    pub fn ended(&self) -> Option<String> {
        lock(&self.0).clone()
    }
}

/// Does work whose requests to the tick end with this curb.
pub fn curbed<T>(curb: Arc<Curb>, work: impl Future<Output = T>) -> impl Future<Output = T> {
    CURB.scope(curb, work)
}

/// Returns the curb of what is being done, if it has one.
pub fn curb() -> Option<Arc<Curb>> {
    CURB.try_with(Arc::clone).ok()
}

/// Sends, unless the curb of what is being done has ended. An end waits for what is being sent.
pub fn unless_ended<T>(send: impl FnOnce() -> T) -> Option<T> {
    let Some(curb) = curb() else { return Some(send()) };
    let ended = lock(&curb.0);
    ended.is_none().then(send)
}
