//! Writing all files or none, and never over anything.

use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

/// Files to create.
#[derive(Debug, Default)]
pub struct Plan {
    /// Paths and texts of new files.
    pub new: Vec<(PathBuf, String)>,
    /// Folders that must not be there yet.
    pub folders: Vec<PathBuf>,
}

impl Plan {
    /// What is in the way.
    pub fn obstacle(&self) -> Option<&Path> {
        let new = self.new.iter().map(|(path, _)| path);
        self.folders.iter().chain(new).find(|path| path.symlink_metadata().is_ok()).map(PathBuf::as_path)
    }

    /// Writes everything. After an error nothing is left of it.
    pub fn write(&self) -> io::Result<()> {
        let mut made = Made::default();
        let result = self.attempt(&mut made);
        if result.is_err() {
            made.undo();
        }
        result
    }

    fn attempt(&self, made: &mut Made) -> io::Result<()> {
        for (path, text) in &self.new {
            made.folders_of(path)?;
            // Files that appeared since are not touched.
            let mut file = fs::File::create_new(path).map_err(|e| at(path, &e))?;
            made.0.push(path.clone());
            file.write_all(text.as_bytes()).map_err(|e| at(path, &e))?;
        }
        Ok(())
    }
}

/// What has been made, in order.
#[derive(Default)]
struct Made(Vec<PathBuf>);

impl Made {
    /// Makes the folders that a file needs.
    fn folders_of(&mut self, file: &Path) -> io::Result<()> {
        let missing = file.ancestors().skip(1).take_while(|path| !path.as_os_str().is_empty() && !path.exists());
        let missing: Vec<&Path> = missing.collect();
        for folder in missing.into_iter().rev() {
            fs::create_dir(folder).map_err(|e| at(folder, &e))?;
            self.0.push(folder.to_owned());
        }
        Ok(())
    }

    fn undo(&self) {
        for path in self.0.iter().rev() {
            let _ = if path.is_dir() { fs::remove_dir(path) } else { fs::remove_file(path) };
        }
    }
}

fn at(path: &Path, error: &io::Error) -> io::Error {
    io::Error::new(error.kind(), format!("cannot write {}: {error}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failure_leaves_nothing_behind() {
        let dir = tempfile::tempdir().unwrap();
        let at = |path: &str| dir.path().join(path);
        fs::write(at("file"), "old").unwrap();
        let plan = |last: &str| Plan {
            new: [("a/b/c", "1"), ("a/d", "2"), (last, "3")].map(|(path, text)| (at(path), text.to_owned())).to_vec(),
            folders: vec![at("a")],
        };
        assert!(plan("file/x").write().is_err(), "a file is no folder");
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1, "only the file from before is left");

        assert!(plan("file").write().is_err(), "the file exists");
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
        assert_eq!(fs::read_to_string(at("file")).unwrap(), "old");

        assert_eq!(plan("a/e").obstacle(), None);
        plan("a/e").write().unwrap();
        assert_eq!(fs::read_to_string(at("a/b/c")).unwrap(), "1");
        assert_eq!(plan("a/f").obstacle(), Some(at("a").as_path()));
    }
}
