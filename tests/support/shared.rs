//! Test data that lies beside the checkout and is not part of it.

use std::path::{Path, PathBuf};

use super::skip::skip;

/// A folder of `../shared`; `None` after saying that it is not there.
pub fn shared(name: &str) -> Option<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().join("shared").join(name);
    if folder.is_dir() {
        return Some(folder);
    }
    skip(&format!("the folder ../shared/{name}"));
    None
}
