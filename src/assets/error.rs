//! Why an asset is not there.

use std::fmt;
use std::io;
use std::path::Path;

use super::Asset;

/// Why an asset is not there: what happened, where, and what to do about it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AssetError {
    /// What happened, in a sentence without full stop.
    pub what: String,
    /// What to do about it.
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

    /// The file system refused.
    pub(super) fn io(path: &Path, error: &io::Error) -> Self {
        let error = Self::new(format!("{}: {error}", path.display()));
        error.hint("assets are kept in $XDG_CACHE_HOME/dimos/assets, which needs room and must be writable")
    }

    /// The address gave another file.
    #[cfg(feature = "fetch")]
    pub(super) fn other_file(url: &str, wanted: &str, found: &str) -> Self {
        let error = Self::new(format!("{url} is another file: its SHA-256 is {found}, and should be {wanted}"));
        error.hint("if this is the file that you mean, put its check sum into the blueprint; nothing of it was kept")
    }

    /// An archive holds what is not unpacked.
    #[cfg(feature = "fetch")]
    pub(super) fn entry(name: &str, what: &str) -> Self {
        Self::new(format!("its archive is refused: {name:?} {what}")).hint("nothing of it was kept")
    }

    /// The same, of this asset.
    pub(super) fn of(mut self, asset: &Asset) -> Self {
        let place = if asset.place.is_empty() { String::new() } else { format!("{}: ", asset.place) };
        self.what = format!("{place}the asset `{}`: {}", asset.name, self.what);
        self
    }
}
