//! The live view of a build without it.

use std::path::Path;

use super::Shown;
use crate::blueprint::planner::ViewConfig;
use dimos_rpc::run_dir::RunFiles;

/// No view.
#[derive(Debug)]
pub enum View {}

impl View {
    /// Fails: this build has none.
    pub fn start(_: &ViewConfig, _: Shown, _: &Path, _: &RunFiles) -> Result<Self, String> {
        Err("this build has none (cargo feature `view`)".to_owned())
    }

    /// Returns its address.
    pub fn address(&self) -> &str {
        match *self {}
    }

    /// Returns its address with the token.
    pub fn url(&self) -> &str {
        match *self {}
    }
}

/// Returns none: this build has no Foxglove either.
pub fn foxglove_url(_: &str) -> Option<String> {
    None
}
