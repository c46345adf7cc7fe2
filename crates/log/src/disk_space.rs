//! Checks a log's disk: enough free space, and the file still in place.

use std::fs::File;
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use super::recorder::RecordError;

/// Fails if less than `min_free` bytes are free. The folder need not exist yet. Passes if the file system reports no
/// figures.
pub fn check(log: &Path, min_free: u64) -> Result<(), RecordError> {
    match free(log) {
        Ok(free) if free < min_free => {
            let (path, free, min_free) = (log.to_owned(), Megabytes(free), Megabytes(min_free));
            Err(RecordError::Room { path, free, min_free })
        }
        _ => Ok(()),
    }
}

/// Returns why the current log must end: its disk is nearly full, or the file is gone.
pub(super) fn watch(log: &Path, file: &File, min_free: u64) -> Result<(), RecordError> {
    let gone = || RecordError::Removed { path: log.to_owned() };
    match (file.metadata(), std::fs::metadata(log)) {
        (Ok(ours), Ok(there)) if (ours.dev(), ours.ino()) != (there.dev(), there.ino()) => return Err(gone()),
        (_, Err(e)) if e.kind() == io::ErrorKind::NotFound => return Err(gone()),
        _ => {}
    }
    check(log, min_free)
}

/// Returns the free space on the disk of a path [bytes].
pub fn free(path: &Path) -> io::Result<u64> {
    let absolute = std::path::absolute(path)?;
    let existing = absolute.ancestors().find(|folder| folder.exists()).unwrap_or(Path::new("/"));
    let disk = rustix::fs::statvfs(existing)?;
    Ok(disk.f_bavail.saturating_mul(disk.f_frsize))
}

/// An amount of memory [bytes], shown in megabytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Megabytes(pub u64);

impl std::fmt::Display for Megabytes {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:.1} MB", self.0 as f64 * 1e-6)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn too_little_space_is_rejected_with_the_figures() {
        let folder = tempfile::tempdir().unwrap();
        let log = folder.path().join("not/yet/there/run.mcap");
        check(&log, 0).unwrap();
        let refused = check(&log, u64::MAX).unwrap_err().to_string();
        assert!(refused.contains("MB free") && refused.contains("hint: "), "{refused}");
    }

    #[test]
    fn a_log_that_was_removed_or_replaced_is_noticed() {
        let folder = tempfile::tempdir().unwrap();
        let log = folder.path().join("run.mcap");
        let file = File::create(&log).unwrap();
        watch(&log, &file, 0).unwrap();
        std::fs::rename(&log, folder.path().join("other.mcap")).unwrap();
        assert!(matches!(watch(&log, &file, 0), Err(RecordError::Removed { .. })));
        std::fs::write(&log, "").unwrap();
        assert!(matches!(watch(&log, &file, 0), Err(RecordError::Removed { .. })));
    }
}
