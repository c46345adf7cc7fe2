//! Everything that dimos reads, and what a run is asked, as targets for coverage-guided fuzzing.
//!
//! A target is a function of bytes that panics if something is wrong. `make fuzz` runs each under libFuzzer for a
//! minute; `make test` replays its seeds, its corpus, and small changes of both, without an engine.

pub mod bytes;
pub mod targets;

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU8, Ordering};

pub use targets::TARGETS;

/// A target.
#[derive(Clone, Copy)]
pub struct Target {
    /// Its name, which is also that of its folder in `fuzz/corpus`.
    pub name: &'static str,
    /// What must hold, in one line.
    pub about: &'static str,
    /// Tries one input; panics if something is wrong.
    pub run: fn(&[u8]),
    /// Returns inputs to begin with.
    pub seeds: fn() -> Vec<Vec<u8>>,
}

impl Target {
    /// Returns the target of a name.
    pub fn named(name: &str) -> Option<&'static Self> {
        TARGETS.iter().find(|target| target.name == name)
    }

    /// Returns the inputs that are kept in the repository: those that once found something, and a corpus.
    pub fn kept(&self) -> Vec<Vec<u8>> {
        let folder = root().join("fuzz/corpus").join(self.name);
        let mut files: Vec<PathBuf> = match std::fs::read_dir(folder) {
            Ok(files) => files.flatten().map(|file| file.path()).collect(),
            Err(_) => Vec::new(),
        };
        files.sort();
        files.iter().filter_map(|file| std::fs::read(file).ok()).collect()
    }

    /// Returns the words of its seeds, for an engine that cannot guess them.
    pub fn words(&self) -> Vec<String> {
        let mut words: Vec<String> = Vec::new();
        for seed in (self.seeds)() {
            let text = String::from_utf8_lossy(&seed).into_owned();
            let parts = text.split(|c: char| !(c.is_ascii_alphanumeric() || "_-:./<>".contains(c)));
            words.extend(parts.filter(|word| (2..=32).contains(&word.len()) && word.is_ascii()).map(str::to_owned));
        }
        words.sort();
        words.dedup();
        words
    }
}

/// The checkout.
pub fn root() -> &'static Path {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/.."))
}

/// Reads a file of the checkout; empty if it is not there.
pub(crate) fn file(path: &str) -> Vec<u8> {
    std::fs::read(root().join(path)).unwrap_or_default()
}

/// The planted bug of this process, from 1; 0: none.
static PLANTED: AtomicU8 = AtomicU8::new(0);

/// Plants a bug in all targets, to see that the engine finds it.
pub fn plant(bug: u8) {
    PLANTED.store(bug, Ordering::Relaxed);
}

/// A planted bug: panics where `there` holds, if it is the one that is planted.
pub(crate) fn bug(number: u8, there: bool) {
    assert!(!there || PLANTED.load(Ordering::Relaxed) != number, "planted bug {number}");
}
