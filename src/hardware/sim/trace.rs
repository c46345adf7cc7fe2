//! What came over an emulator's wire, for tests that judge a client by it.

/// Most entries that are kept; later ones are lost.
const CAPACITY: usize = 200_000;

/// A record of what arrived, which is kept from [`Trace::start`] on.
#[derive(Debug, Clone)]
pub struct Trace<T> {
    entries: Option<Vec<T>>,
}

impl<T> Default for Trace<T> {
    fn default() -> Self {
        Self { entries: None }
    }
}

impl<T: Clone> Trace<T> {
    /// Starts to record, up to 200 000 entries; forgets what was recorded before.
    pub fn start(&mut self) {
        self.entries = Some(Vec::new());
    }

    /// Records what arrived, where that was asked for.
    pub fn push(&mut self, entry: impl FnOnce() -> T) {
        if let Some(entries) = self.entries.as_mut().filter(|entries| entries.len() < CAPACITY) {
            entries.push(entry());
        }
    }

    /// What was recorded since [`Trace::start`].
    pub fn entries(&self) -> Vec<T> {
        self.entries.clone().unwrap_or_default()
    }
}
