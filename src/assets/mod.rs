//! Files that a blueprint names by an address and a check sum: fetched on first use, kept in the user's cache.
//!
//! ```text
//!  url ─▶ download ─▶ <sha256>.part ─▶ check sum ─▶ unpack ─▶ <sha256>.new/ ─rename─▶ <sha256>/
//! ```
//!
//! The folder of an asset is there whole or not at all, and what is in it is what the check sum says: where it came
//! from does not matter, and two blueprints share it. A download that breaks goes on where it was; only one process at
//! a time fetches an asset. Nothing that is fetched may lie outside its folder or lead out of it.

#[cfg(feature = "fetch")]
mod download;
mod error;
#[cfg(feature = "fetch")]
mod fetch;
#[cfg(feature = "fetch")]
mod unpack;

#[cfg(test)]
mod tests;
#[cfg(test)]
mod without_fetch;

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

pub use error::AssetError;

/// What a path into an asset begins with: `asset:NAME/path/inside`.
pub const PREFIX: &str = "asset:";
/// Another process may take so long to fetch the same asset.
const LONGEST_FETCH: Duration = Duration::from_secs(3600);
/// How often is looked whether it is done.
const LOOK: Duration = Duration::from_millis(100);

/// A file to fetch.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Asset {
    /// Its name in the blueprint.
    pub name: String,
    /// Where it is: `https://`, `http://` or `file:///`.
    pub url: String,
    /// SHA-256 of the file, 64 hexadecimal digits.
    pub sha256: String,
    /// Where the blueprint says so: `cell.yaml:12:3`.
    pub place: String,
}

/// Who is told how a download goes.
pub trait Progress {
    /// So many bytes are there, of so many where that is known.
    fn at(&mut self, bytes: u64, of: Option<u64>);
    /// Something to know, in words.
    fn note(&mut self, text: &str);
}

/// Tells nobody.
#[derive(Debug, Clone, Copy, Default)]
pub struct Quiet;

impl Progress for Quiet {
    fn at(&mut self, _: u64, _: Option<u64>) {}
    fn note(&mut self, _: &str) {}
}

/// The name and the path inside, where a path is one into an asset. `asset:NAME` alone is its folder.
pub fn split(path: &str) -> Option<(&str, &str)> {
    let rest = path.strip_prefix(PREFIX)?;
    Some(rest.split_once('/').unwrap_or((rest, "")))
}

/// The folder where assets are kept.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Cache(PathBuf);

impl Cache {
    /// `$XDG_CACHE_HOME/dimos/assets`, or `~/.cache/dimos/assets`.
    pub fn standard() -> Self {
        let absolute = |name: &str| std::env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
        let caches = absolute("XDG_CACHE_HOME").or_else(|| absolute("HOME").map(|home| home.join(".cache")));
        Self(caches.unwrap_or_else(std::env::temp_dir).join("dimos/assets"))
    }

    /// A folder of one's own.
    pub fn at(path: impl Into<PathBuf>) -> Self {
        Self(path.into())
    }

    /// Where an asset is, once it is fetched.
    pub fn folder(&self, sha256: &str) -> PathBuf {
        self.file(sha256, "")
    }

    /// Whether an asset is there.
    pub fn has(&self, sha256: &str) -> bool {
        self.folder(sha256).is_dir()
    }

    /// Whether a path leads into the folder of an asset that is not there.
    pub fn awaits(&self, path: &Path) -> bool {
        let inside = path.strip_prefix(&self.0).ok().and_then(|rest| rest.components().next());
        inside.is_some_and(|folder| !self.0.join(folder).is_dir())
    }

    /// How much of an asset has come in a download that is not done [bytes].
    pub fn part(&self, sha256: &str) -> Option<u64> {
        fs::metadata(self.file(sha256, ".part")).ok().map(|part| part.len())
    }

    /// How much room an asset takes [bytes].
    pub fn size(&self, sha256: &str) -> u64 {
        size_of(&self.folder(sha256))
    }

    fn file(&self, sha256: &str, ending: &str) -> PathBuf {
        self.0.join(format!("{}{ending}", sha256.to_ascii_lowercase()))
    }

    /// The folder of an asset, fetched if it is not there. Fails when it cannot be reached, is not what its check sum
    /// says, or cannot be unpacked; what has come is kept, and the next try goes on from there.
    pub fn fetch(&self, asset: &Asset, progress: &mut dyn Progress) -> Result<PathBuf, AssetError> {
        let failed = |error: AssetError| error.of(asset);
        self.fetch_now(asset, progress).map_err(failed)
    }

    fn fetch_now(&self, asset: &Asset, progress: &mut dyn Progress) -> Result<PathBuf, AssetError> {
        if asset.sha256.len() != 64 || !asset.sha256.bytes().all(|b| b.is_ascii_hexdigit()) {
            return Err(AssetError::new("its SHA-256 has not 64 hexadecimal digits"));
        }
        let folder = self.folder(&asset.sha256);
        if folder.is_dir() { Ok(folder) } else { self.fetch_missing(asset, progress) }
    }

    #[cfg(not(feature = "fetch"))]
    fn fetch_missing(&self, asset: &Asset, _: &mut dyn Progress) -> Result<PathBuf, AssetError> {
        let folder = self.folder(&asset.sha256);
        let error = AssetError::new("it is not in the cache, and this program was built without asset download");
        let build = "build it with the feature `fetch` (on by default)";
        Err(error.hint(format!("{build}, or unpack the file into {}", folder.display())))
    }

    /// Removes an asset, and what there is of a download; whether there was anything. A process that fetches it just
    /// now is waited for.
    pub fn remove(&self, asset: &Asset) -> Result<bool, AssetError> {
        let failed = |error: AssetError| error.of(asset);
        let (folder, part) = (self.folder(&asset.sha256), self.file(&asset.sha256, ".part"));
        if !folder.exists() && !part.exists() {
            return Ok(false);
        }
        let _lock = self.lock(&asset.sha256, &mut Quiet).map_err(failed)?;
        let gone = |path: &Path, result: io::Result<()>| match result {
            Err(e) if e.kind() != io::ErrorKind::NotFound => Err(AssetError::io(path, &e)),
            _ => Ok(()),
        };
        // Never seen half removed: first out of its place.
        let old = self.file(&asset.sha256, ".new");
        let _ = fs::remove_dir_all(&old);
        gone(&folder, fs::rename(&folder, &old)).map_err(failed)?;
        gone(&old, fs::remove_dir_all(&old)).map_err(failed)?;
        gone(&part, fs::remove_file(&part)).map_err(failed)?;
        Ok(true)
    }

    /// Keeps other processes from the same asset for as long as the file is open.
    fn lock(&self, sha256: &str, progress: &mut dyn Progress) -> Result<File, AssetError> {
        let path = self.file(sha256, ".lock");
        let failed = |e: io::Error| AssetError::io(&path, &e);
        // Never removed, so that all lock the same file.
        let open = OpenOptions::new().read(true).write(true).create(true).truncate(false).open(&path);
        let (file, began, mut told) = (open.map_err(failed)?, Instant::now(), false);
        loop {
            match file.try_lock() {
                Ok(()) => return Ok(file),
                Err(TryLockError::WouldBlock) if began.elapsed() < LONGEST_FETCH => {
                    if !std::mem::replace(&mut told, true) {
                        progress.note("another process fetches it: waiting");
                    }
                    std::thread::sleep(LOOK);
                }
                Err(TryLockError::WouldBlock) => {
                    return Err(AssetError::new("another process has been fetching it for an hour"));
                }
                Err(TryLockError::Error(e)) => return Err(failed(e)),
            }
        }
    }
}

fn size_of(folder: &Path) -> u64 {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    entries
        .map(|entry| match entry.metadata() {
            Ok(found) if found.is_dir() => size_of(&entry.path()),
            Ok(found) => found.len(),
            Err(_) => 0,
        })
        .sum()
}
