//! Received bytes of an emulator, for tests.

/// Maximum number of entries; later ones are dropped.
const CAPACITY: usize = 200_000;

/// A record of what arrives after [`Trace::start`].
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
    /// Starts to record, up to 200 000 entries; discards earlier records.
    pub fn start(&mut self) {
        self.entries = Some(Vec::new());
    }

    /// Records what arrived, if recording was started.
    pub fn push(&mut self, entry: impl FnOnce() -> T) {
        if let Some(entries) = self.entries.as_mut().filter(|entries| entries.len() < CAPACITY) {
            entries.push(entry());
        }
    }

    /// Returns the records since [`Trace::start`].
    pub fn entries(&self) -> Vec<T> {
        self.entries.clone().unwrap_or_default()
    }
}
