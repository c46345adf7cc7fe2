//! Writing all files or none, and never over anything.

use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

/// Files that are to be made, and some that are to be changed.
#[derive(Debug, Default)]
pub struct Plan {
    /// Paths and texts of new files.
    pub new: Vec<(PathBuf, String)>,
    /// Folders that must not be there yet.
    pub folders: Vec<PathBuf>,
    /// Files that are to be changed.
    pub changes: Vec<Change>,
}

/// A change of a file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Change {
    /// Its path.
    pub path: PathBuf,
    /// What it was read as.
    pub before: String,
    /// What it becomes.
    pub after: String,
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
        // The changes come last, each at once: a reader sees a file from before or from after.
        let mut ready = Vec::new();
        for change in &self.changes {
            let beside = change.path.with_extension("rs.new");
            let mut file = fs::File::create_new(&beside).map_err(|e| at(&beside, &e))?;
            made.0.push(beside.clone());
            file.write_all(change.after.as_bytes()).map_err(|e| at(&beside, &e))?;
            change.still_as_read()?;
            ready.push((beside, change));
        }
        for (done, (beside, change)) in ready.iter().enumerate() {
            if let Err(error) = fs::rename(beside, &change.path) {
                let back = |(_, change): &(PathBuf, &Change)| drop(fs::write(&change.path, &change.before));
                ready.iter().take(done).for_each(back);
                return Err(at(&change.path, &error));
            }
        }
        Ok(())
    }
}

impl Change {
    /// What a function makes of a file; what is wrong with the file where it cannot.
    pub fn of(path: PathBuf, make: impl FnOnce(&str) -> Result<String, String>) -> Result<Self, String> {
        let before = fs::read_to_string(&path).map_err(|e| format!("cannot read {}: {e}", path.display()))?;
        let after = make(&before).map_err(|e| format!("{}: {e}: nothing was written", path.display()))?;
        Ok(Self { path, before, after })
    }

    fn still_as_read(&self) -> io::Result<()> {
        if fs::read_to_string(&self.path).map_err(|e| at(&self.path, &e))? == self.before {
            return Ok(());
        }
        Err(io::Error::other(format!("{} was changed meanwhile", self.path.display())))
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
        let change = |file: &str, before: &str| Change { path: at(file), before: before.into(), after: "new".into() };
        fs::write(at("table"), "old").unwrap();
        fs::write(at("robots"), "few").unwrap();
        let plan = |last: &str| Plan {
            new: [("a/b/c", "1"), ("a/d", "2"), (last, "3")].map(|(path, text)| (at(path), text.to_owned())).to_vec(),
            folders: vec![at("a")],
            changes: vec![change("table", "old"), change("robots", "few")],
        };
        assert!(plan("table/x").write().is_err(), "a file is no folder");
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 2, "only what was there is there");
        let changes = vec![change("table", "old"), change("robots", "other")];
        assert!(Plan { changes, ..plan("a/e") }.write().is_err());
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 2);
        assert_eq!(fs::read_to_string(at("table")).unwrap(), "old");
        assert_eq!(fs::read_to_string(at("robots")).unwrap(), "few");

        assert_eq!(plan("a/e").obstacle(), None);
        plan("a/e").write().unwrap();
        assert_eq!(fs::read_to_string(at("table")).unwrap(), "new");
        assert_eq!(fs::read_to_string(at("robots")).unwrap(), "new");
        assert_eq!(fs::read_to_string(at("a/b/c")).unwrap(), "1");
        assert_eq!(plan("a/f").obstacle(), Some(at("a").as_path()));
    }
}
