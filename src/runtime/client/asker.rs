//! Who asked for what is being done: known wherever a request is answered, as a span of a trace is.

use std::future::Future;
use std::sync::Arc;

use dimos_core::telemetry::Who;

tokio::task_local! {
    static ASKER: Arc<Who>;
}

/// Answers a client's request.
pub fn asked_by<T>(who: Arc<Who>, answer: impl Future<Output = T>) -> impl Future<Output = T> {
    ASKER.scope(who, answer)
}

/// Returns who asked for what is being done; `None`: this program.
pub fn asker() -> Option<Arc<Who>> {
    ASKER.try_with(Arc::clone).ok()
}
