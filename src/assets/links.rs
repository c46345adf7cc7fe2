//! Links in archives: kept as copies of what they point to, if that is in the archive. No link is ever created, so that
//! a path in an asset's folder is what it says, and nothing can be written or read through one.

use std::fs::{self, File};
use std::path::{Component, Path, PathBuf};

use super::AssetError;
use super::unpack::{Budget, folder, inside};

/// Maximum length of the chain from a link to its file.
const MAX_CHAIN: usize = 16;

/// The links of an archive, collected while it is unpacked.
#[derive(Debug, Default)]
pub(super) struct Links(Vec<Link>);

#[derive(Debug)]
struct Link {
    /// Name in the archive.
    name: String,
    /// Path of the link.
    at: PathBuf,
    /// Path of its target.
    target: PathBuf,
}

impl Links {
    /// Adds a symbolic link of the archive: its target is relative to the folder that contains it.
    pub fn symbolic(&mut self, to: &Path, path: &Path, target: &Path) -> Result<(), AssetError> {
        let from = path.parent().unwrap_or(Path::new(""));
        self.add(to, path, &from.join(target))
    }

    /// Adds a hard link of a tar archive: its target is relative to the root of the archive.
    pub fn hard(&mut self, to: &Path, path: &Path, target: &Path) -> Result<(), AssetError> {
        self.add(to, path, target)
    }

    fn add(&mut self, to: &Path, path: &Path, target: &Path) -> Result<(), AssetError> {
        let name = path.display().to_string();
        let outside = || AssetError::entry(&name, "is a link that leads out of the archive");
        // `..` is resolved as text: there are no links on disk that it could lead through.
        let mut plain = PathBuf::new();
        for part in target.components() {
            match part {
                Component::Normal(part) => plain.push(part),
                Component::CurDir => {}
                Component::ParentDir if plain.pop() => {}
                _ => return Err(outside()),
            }
        }
        let (at, target) = (inside(to, path)?, to.join(plain));
        self.0.push(Link { name, at, target });
        Ok(())
    }

    /// Copies the targets into place. A link to nothing is left out, as in a repository with links to files that are
    /// not part of it.
    pub fn copy(mut self, to: &Path, budget: &mut Budget) -> Result<(), AssetError> {
        // A link may point to another, or through one: each round resolves those whose target is there by then.
        for _ in 0..MAX_CHAIN {
            let (ready, waiting): (Vec<_>, Vec<_>) = self.0.into_iter().partition(|link| link.target.exists());
            if ready.is_empty() {
                break;
            }
            for link in &ready {
                if link.target == to || link.at.starts_with(&link.target) {
                    return Err(AssetError::entry(&link.name, "is a link to a folder that contains it"));
                }
                if !link.at.exists() {
                    copy(&link.name, &link.target, &link.at, budget)?;
                }
            }
            self.0 = waiting;
        }
        Ok(())
    }
}

/// Copies a file, or a folder with what it contains.
fn copy(name: &str, from: &Path, to: &Path, budget: &mut Budget) -> Result<(), AssetError> {
    budget.entry(name)?;
    if !from.is_dir() {
        let file = File::open(from).map_err(|e| AssetError::io(from, &e))?;
        return budget.copy_stream(name, file, to);
    }
    folder(to)?;
    for entry in fs::read_dir(from).map_err(|e| AssetError::io(from, &e))? {
        let entry = entry.map_err(|e| AssetError::io(from, &e))?;
        copy(name, &entry.path(), &to.join(entry.file_name()), budget)?;
    }
    Ok(())
}
