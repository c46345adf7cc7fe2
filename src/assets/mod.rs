//! Assets: files that a blueprint refers to by address and checksum, downloaded on first use and cached for the user.
//!
//! ```text
//!  url ─▶ download ─▶ <sha256>.part ─▶ checksum ─▶ unpack ─▶ <sha256>.new/ ─rename─▶ <sha256>/
//! ```
//!
//! The folder of an asset is complete or absent, and its contents match the checksum: its origin does not matter, and
//! two blueprints share it. Interrupted downloads resume; only one process at a time downloads an asset. Nothing can be
//! unpacked outside the asset's folder.

mod download;
mod error;
mod unpack;

#[cfg(test)]
mod tests;

use std::ffi::OsStr;
use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use percent_encoding::percent_decode_str;
use sha2::{Digest, Sha256};

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
        let (folder, sum) = (self.folder(&asset.sha256), asset.sha256.to_ascii_lowercase());
        if sum.len() != 64 || !sum.bytes().all(|b| b.is_ascii_hexdigit()) {
            return Err(AssetError::new("the SHA-256 does not have 64 hexadecimal digits"));
        }
        if folder.is_dir() {
            return Ok(folder);
        }
        fs::create_dir_all(&self.0).map_err(|e| AssetError::io(&self.0, &e))?;
        let _lock = self.lock(&asset.sha256, progress)?;
        if folder.is_dir() {
            return Ok(folder);
        }
        let part = self.file(&asset.sha256, ".part");
        let resumed = part.exists();
        download::download(&asset.url, &part, progress)?;
        let found = sum_of(&part)?;
        if found != sum {
            fs::remove_file(&part).map_err(|e| AssetError::io(&part, &e))?;
            if resumed {
                // The address may now return another file than when the download began.
                progress.note("an earlier partial download does not match: downloading from scratch");
                download::download(&asset.url, &part, progress)?;
            }
            if !resumed || sum_of(&part)? != sum {
                let _ = fs::remove_file(&part);
                return Err(AssetError::other_file(&asset.url, &sum, &found));
            }
        }
        let fresh = self.file(&asset.sha256, ".new");
        let _ = fs::remove_dir_all(&fresh);
        let unpacked = unpack::unpack(&part, &file_name(&asset.url), &fresh);
        if let Err(error) = unpacked {
            let _ = fs::remove_dir_all(&fresh);
            let _ = fs::remove_file(&part);
            return Err(error);
        }
        fs::rename(&fresh, &folder).map_err(|e| AssetError::io(&folder, &e))?;
        let _ = fs::remove_file(&part);
        Ok(folder)
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

fn sum_of(path: &Path) -> Result<String, AssetError> {
    let sum = || -> io::Result<String> {
        let (mut file, mut sum, mut room) = (File::open(path)?, Sha256::new(), vec![0; 1 << 16]);
        loop {
            match file.read(&mut room)? {
                0 => break,
                n => sum.update(room.get(..n).unwrap_or_default()),
            }
        }
        Ok(sum.finalize().iter().map(|byte| format!("{byte:02x}")).collect())
    };
    sum().map_err(|e| AssetError::io(path, &e))
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

/// Returns the name of a plain file: the last part of its address.
fn file_name(url: &str) -> String {
    let path = url.split(['?', '#']).next().unwrap_or_default();
    let last = path.rsplit('/').next().unwrap_or_default();
    let name = percent_decoded(last);
    match Path::new(&name).file_name() {
        Some(plain) if plain == OsStr::new(&name) && !name.contains('\0') => name,
        _ => "file".to_owned(),
    }
}

/// Decodes `%20` in an address's path.
fn percent_decoded(text: &str) -> String {
    percent_decode_str(text).decode_utf8().map_or_else(|_| text.to_owned(), Into::into)
}
