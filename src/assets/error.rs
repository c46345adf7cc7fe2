//! Errors of assets.

use std::fmt;
use std::io;
use std::path::Path;

use super::Asset;

/// Why an asset is unavailable: what happened, where, and what to do.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AssetError {
    /// What happened: a sentence without full stop.
    pub what: String,
    /// What the user can do about it.
    pub hint: Option<String>,
}

impl fmt::Display for AssetError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.what)
    }
}

impl std::error::Error for AssetError {}

impl AssetError {
    pub(super) fn new(what: impl Into<String>) -> Self {
        Self { what: what.into(), hint: None }
    }

    pub(super) fn hint(mut self, hint: impl Into<String>) -> Self {
        self.hint = Some(hint.into());
        self
    }

    /// Creates the error of a file system operation.
    pub(super) fn io(path: &Path, error: &io::Error) -> Self {
        let error = Self::new(format!("{}: {error}", path.display()));
        error.hint("assets are kept in $XDG_CACHE_HOME/dimos/assets, which needs free space and must be writable")
    }

    /// Creates the error of a file with another checksum.
    #[cfg(feature = "fetch")]
    pub(super) fn other_file(url: &str, wanted: &str, found: &str) -> Self {
        let url = super::without_password(url);
        let error = Self::new(format!("{url}: the SHA-256 of the file is {found}, expected {wanted}"));
        error.hint("if this is the intended file, update the checksum in the blueprint; the download was discarded")
    }

    /// Creates the error of an unsafe archive entry.
    #[cfg(feature = "fetch")]
    pub(super) fn entry(name: &str, what: &str) -> Self {
        Self::new(format!("the archive is rejected: {name:?} {what}")).hint("the download was discarded")
    }

    /// Adds the asset's name and position.
    pub(super) fn of(mut self, asset: &Asset) -> Self {
        let place = if asset.place.is_empty() { String::new() } else { format!("{}: ", asset.place) };
        self.what = format!("{place}the asset `{}`: {}", asset.name, self.what);
        self
    }
}
