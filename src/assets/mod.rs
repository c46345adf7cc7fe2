//! Assets: files that a blueprint refers to by address and checksum, downloaded on first use and cached for the user.
//!
//! ```text
//!  url ─▶ download ─▶ <sha256>.part ─▶ checksum ─▶ unpack ─▶ <sha256>.new/ ─rename─▶ <sha256>/
//! ```
//!
//! The folder of an asset is complete or absent, and its contents match the checksum: its origin does not matter, and
//! two blueprints share it. Interrupted downloads resume; only one process at a time downloads an asset. Nothing can be
//! unpacked outside the asset's folder.

#[cfg(feature = "fetch")]
mod download;
mod error;
#[cfg(feature = "fetch")]
mod fetch;
#[cfg(feature = "fetch")]
mod links;
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

/// Prefix of a path into an asset: `asset:NAME/path/inside`.
pub const PREFIX: &str = "asset:";
/// Maximum wait for another process that downloads the same asset.
const LOCK_TIMEOUT: Duration = Duration::from_secs(3600);
/// Poll period of that wait.
const POLL_PERIOD: Duration = Duration::from_millis(100);

/// A file to download.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Asset {
    /// Name in the blueprint.
    pub name: String,
    /// Address: `https://`, `http://` or `file:///`.
    pub url: String,
    /// SHA-256 of the file, 64 hexadecimal digits.
    pub sha256: String,
    /// Position in the blueprint: `cell.yaml:12:3`.
    pub place: String,
}

/// Returns a URL for messages: without the password that it may contain.
pub fn without_password(url: &str) -> String {
    let shown = || {
        let (scheme, rest) = url.split_once("://")?;
        let host = rest.split(['/', '?', '#']).next().unwrap_or_default();
        let (login, _) = host.rsplit_once('@')?;
        let (user, _) = login.split_once(':')?;
        Some(format!("{scheme}://{user}:***{}", rest.get(login.len()..)?))
    };
    shown().unwrap_or_else(|| url.to_owned())
}

/// Receives the progress of a download.
pub trait Progress {
    /// Bytes received, and the total if the server sent one.
    fn at(&mut self, bytes: u64, of: Option<u64>);
    /// A message for the user.
    fn note(&mut self, text: &str);
}

/// Ignores progress.
#[derive(Debug, Clone, Copy, Default)]
pub struct NoProgress;

impl Progress for NoProgress {
    fn at(&mut self, _: u64, _: Option<u64>) {}
    fn note(&mut self, _: &str) {}
}

/// Splits a path into an asset into name and inner path. `asset:NAME` alone is its folder.
pub fn split(path: &str) -> Option<(&str, &str)> {
    let rest = path.strip_prefix(PREFIX)?;
    Some(rest.split_once('/').unwrap_or((rest, "")))
}

/// The folder of cached assets.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Cache(PathBuf);

impl Cache {
    /// Returns the default cache: `$XDG_CACHE_HOME/dimos/assets` or `~/.cache/dimos/assets`.
    pub fn standard() -> Self {
        let absolute = |name: &str| std::env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
        let caches = absolute("XDG_CACHE_HOME").or_else(|| absolute("HOME").map(|home| home.join(".cache")));
        Self(caches.unwrap_or_else(std::env::temp_dir).join("dimos/assets"))
    }

    /// Returns a cache in another folder.
    pub fn at(path: impl Into<PathBuf>) -> Self {
        Self(path.into())
    }

    /// Returns the folder of an asset once it is cached.
    pub fn folder(&self, sha256: &str) -> PathBuf {
        self.file(sha256, "")
    }

    /// Returns whether an asset is cached.
    pub fn has(&self, sha256: &str) -> bool {
        self.folder(sha256).is_dir()
    }

    /// Returns whether a path is inside the folder of an asset that is not cached.
    pub fn awaits(&self, path: &Path) -> bool {
        let inside = path.strip_prefix(&self.0).ok().and_then(|rest| rest.components().next());
        inside.is_some_and(|folder| !self.0.join(folder).is_dir())
    }

    /// Returns the size of an unfinished download [bytes].
    pub fn part(&self, sha256: &str) -> Option<u64> {
        fs::metadata(self.file(sha256, ".part")).ok().map(|part| part.len())
    }

    /// Returns the size of a cached asset [bytes].
    pub fn size(&self, sha256: &str) -> u64 {
        size_of(&self.folder(sha256))
    }

    fn file(&self, sha256: &str, ending: &str) -> PathBuf {
        self.0.join(format!("{}{ending}", sha256.to_ascii_lowercase()))
    }

    /// Returns the folder of an asset, downloading it if necessary. Fails if it is unreachable, its checksum differs,
    /// or it cannot be unpacked; a partial download is kept, and the next attempt resumes it.
    pub fn fetch(&self, asset: &Asset, progress: &mut dyn Progress) -> Result<PathBuf, AssetError> {
        let failed = |error: AssetError| error.of(asset);
        self.fetch_now(asset, progress).map_err(failed)
    }

    fn fetch_now(&self, asset: &Asset, progress: &mut dyn Progress) -> Result<PathBuf, AssetError> {
        if asset.sha256.len() != 64 || !asset.sha256.bytes().all(|b| b.is_ascii_hexdigit()) {
            return Err(AssetError::new("the SHA-256 does not have 64 hexadecimal digits"));
        }
        let folder = self.folder(&asset.sha256);
        if folder.is_dir() { Ok(folder) } else { self.fetch_missing(asset, progress) }
    }

    #[cfg(not(feature = "fetch"))]
    fn fetch_missing(&self, asset: &Asset, _: &mut dyn Progress) -> Result<PathBuf, AssetError> {
        let folder = self.folder(&asset.sha256);
        let error = AssetError::new("not in the cache, and this program was built without asset download");
        let build = "build it with the feature `fetch` (on by default)";
        Err(error.hint(format!("{build}, or unpack the file into {}", folder.display())))
    }

    /// Removes an asset and its partial download; returns whether there was anything. Waits for a process that is
    /// downloading it.
    pub fn remove(&self, asset: &Asset) -> Result<bool, AssetError> {
        let failed = |error: AssetError| error.of(asset);
        let (folder, part) = (self.folder(&asset.sha256), self.file(&asset.sha256, ".part"));
        if !folder.exists() && !part.exists() {
            return Ok(false);
        }
        let _lock = self.lock(&asset.sha256, &mut NoProgress).map_err(failed)?;
        let gone = |path: &Path, result: io::Result<()>| match result {
            Err(e) if e.kind() != io::ErrorKind::NotFound => Err(AssetError::io(path, &e)),
            _ => Ok(()),
        };
        // Rename first, so that it is never visible half removed.
        let old = self.file(&asset.sha256, ".new");
        let _ = fs::remove_dir_all(&old);
        gone(&folder, fs::rename(&folder, &old)).map_err(failed)?;
        gone(&old, fs::remove_dir_all(&old)).map_err(failed)?;
        gone(&part, fs::remove_file(&part)).map_err(failed)?;
        Ok(true)
    }

    /// Locks an asset against other processes while the file is open.
    fn lock(&self, sha256: &str, progress: &mut dyn Progress) -> Result<File, AssetError> {
        let path = self.file(sha256, ".lock");
        let failed = |e: io::Error| AssetError::io(&path, &e);
        // Never removed, so that all processes lock the same file.
        let open = OpenOptions::new().read(true).write(true).create(true).truncate(false).open(&path);
        let (file, began, mut noted) = (open.map_err(failed)?, Instant::now(), false);
        loop {
            match file.try_lock() {
                Ok(()) => return Ok(file),
                Err(TryLockError::WouldBlock) if began.elapsed() < LOCK_TIMEOUT => {
                    if !std::mem::replace(&mut noted, true) {
                        progress.note("another process is downloading it: waiting");
                    }
                    std::thread::sleep(POLL_PERIOD);
                }
                Err(TryLockError::WouldBlock) => {
                    return Err(AssetError::new("another process has been downloading it for an hour"));
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
