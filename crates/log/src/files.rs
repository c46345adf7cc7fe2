//! Log files: folder, names, and retention.

use std::fs::{File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};

use jiff::Timestamp;
use jiff::fmt::strtime;

/// Format of the time in a log's file name: `20261121T141630Z`.
const STAMP: &str = "%Y%m%dT%H%M%SZ";
/// Extension of a log.
const LOG: &str = "mcap";
/// Extension of a text log, stored beside it.
const TEXT_LOG: &str = "log";
/// Number of logs kept by default.
pub const KEPT_LOGS: usize = 20;

/// Returns the folder of logs: `$XDG_STATE_HOME/dimos`, otherwise `~/.local/state/dimos`; `None` if neither is known.
pub fn log_folder() -> Option<PathBuf> {
    let absolute = |name| std::env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
    let state = absolute("XDG_STATE_HOME").or_else(|| Some(absolute("HOME")?.join(".local/state")))?;
    Some(state.join("dimos"))
}

/// Returns the file name of a log that begins at a Unix time [ns]: `<run>-20261121T141630Z.mcap`.
pub fn log_file_name(run: &str, wall_ns: u64) -> String {
    file_name(run, wall_ns, LOG)
}

fn file_name(run: &str, wall_ns: u64, ending: &str) -> String {
    let time = Timestamp::from_nanosecond(i128::from(wall_ns)).unwrap_or(Timestamp::UNIX_EPOCH);
    format!("{run}-{}.{ending}", time.strftime(STAMP))
}

/// Returns an unused path in `folder` for a log that begins at a Unix time [ns]. A second log of the same run within a
/// second gets `-2` after its time, and so on.
pub fn new_log_path(folder: &Path, run: &str, wall_ns: u64) -> PathBuf {
    new_path(folder, run, wall_ns, LOG)
}

/// Same for a text log: `<run>-20261121T141630Z.log`.
pub fn new_text_log_path(folder: &Path, run: &str, wall_ns: u64) -> PathBuf {
    new_path(folder, run, wall_ns, TEXT_LOG)
}

fn new_path(folder: &Path, run: &str, wall_ns: u64, ending: &str) -> PathBuf {
    let name = file_name(run, wall_ns, ending);
    let first = folder.join(&name);
    let others = (2..).map(|n| folder.join(name.replace(&format!(".{ending}"), &format!("-{n}.{ending}"))));
    std::iter::once(first.clone()).chain(others).find(|path| !path.exists()).unwrap_or(first)
}

/// Returns the path of a further file of a log, from 1: `<run>-20261121T141630Z_1.mcap`. Such files are no logs of
/// their own in [`all`] and [`newest`], and are removed with the first one.
pub fn part(first: &Path, number: u32) -> PathBuf {
    first.with_file_name(format!("{}_{number}.{LOG}", first.file_stem().unwrap_or_default().display()))
}

/// Returns the further files of a log that exist, in order. Files between them may be missing.
pub fn further_parts(first: &Path) -> impl Iterator<Item = PathBuf> {
    numbered_parts(first).into_iter().map(|(_, path)| path)
}

/// Same, with their numbers.
pub fn numbered_parts(first: &Path) -> Vec<(u32, PathBuf)> {
    let folder = first.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let names = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.file_name());
    let numbers = names.filter_map(|name| number_of(Path::new(&name)));
    let mut parts: Vec<(u32, PathBuf)> =
        numbers.map(|number| (number, part(first, number))).filter(|(_, path)| path.exists()).collect();
    parts.sort();
    parts.dedup();
    parts
}

/// Returns the number in the name of a further file of a log.
pub fn number_of(path: &Path) -> Option<u32> {
    let number: u32 = path.file_stem()?.to_str()?.rsplit_once('_')?.1.parse().ok()?;
    (number > 0).then_some(number)
}

/// Returns the size of all files of a log, or in its folder [bytes].
pub fn size(first: &Path) -> u64 {
    let size = |path: &Path| std::fs::metadata(path).map_or(0, |about| about.len());
    if first.is_dir() {
        return logs_in(first).iter().map(|path| size(path)).sum();
    }
    size(first) + further_parts(first).map(|path| size(&path)).sum::<u64>()
}

/// Returns the MCAP files in a folder, the first file of a log before its further ones.
pub fn logs_in(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
    let mut logs: Vec<PathBuf> = entries.filter(|path| path.extension().is_some_and(|e| e == LOG)).collect();
    // `_` sorts after `.`, but a log of one file may have any name.
    logs.sort_by_key(|path| path.file_stem().map(std::ffi::OsStr::to_owned));
    logs
}

/// Returns the newest log in `folder`, by the time in its name.
pub fn newest(folder: &Path) -> io::Result<Option<PathBuf>> {
    Ok(logs(folder, LOG)?.pop())
}

/// Returns all logs in `folder`, the oldest first.
pub fn all(folder: &Path) -> io::Result<Vec<PathBuf>> {
    logs(folder, LOG)
}

/// Removes all but the newest `keep` logs from `folder`, and no other files. Keeps logs that a live run writes, and
/// those that cannot be removed. Returns the removed paths.
pub fn retain(folder: &Path, keep: usize) -> io::Result<Vec<PathBuf>> {
    retain_newest(folder, LOG, keep)
}

/// Same for text logs.
pub fn retain_text_logs(folder: &Path, keep: usize) -> io::Result<Vec<PathBuf>> {
    retain_newest(folder, TEXT_LOG, keep)
}

fn retain_newest(folder: &Path, ending: &str, keep: usize) -> io::Result<Vec<PathBuf>> {
    let mut old = logs(folder, ending)?;
    old.truncate(old.len().saturating_sub(keep));
    let live = |path: &PathBuf| File::open(path).is_ok_and(|file| is_being_written(&file));
    old.retain(|path| {
        let parts: Vec<PathBuf> = further_parts(path).collect();
        // What cannot be removed remains.
        !std::iter::once(path).chain(&parts).any(live)
            && parts.iter().rev().chain([path]).all(|path| std::fs::remove_file(path).is_ok())
    });
    Ok(old)
}

/// Marks a log as being written, until `file` and all its clones are closed: [`retain`] keeps it. Has no effect on file
/// systems without locks.
pub fn mark_as_being_written(file: &File) {
    let _ = file.try_lock();
}

/// Returns whether a live run writes this log: its lock is held, which the kernel releases with the writer's process.
pub(super) fn is_being_written(file: &File) -> bool {
    // Shared, so that readers do not take each other for the writer.
    let locked = file.try_lock_shared();
    let _ = file.unlock();
    matches!(locked, Err(TryLockError::WouldBlock))
}

/// Returns all logs in `folder` with that extension, oldest first.
fn logs(folder: &Path, ending: &str) -> io::Result<Vec<PathBuf>> {
    let entries = match std::fs::read_dir(folder) {
        Ok(entries) => entries,
        Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
        Err(e) => return Err(e),
    };
    let mut found = Vec::new();
    for entry in entries {
        let entry = entry?;
        let key = entry.file_name().to_str().and_then(|name| log_time(name, ending));
        if let Some(key) = key.filter(|_| entry.file_type().is_ok_and(|kind| kind.is_file())) {
            found.push((key, entry.path()));
        }
    }
    found.sort();
    Ok(found.into_iter().map(|(_, path)| path).collect())
}

/// Returns the time in a log's name, and its number within that second; `None` for other names.
fn log_time(name: &str, ending: &str) -> Option<(jiff::civil::DateTime, u32)> {
    let stem = name.strip_suffix(ending)?.strip_suffix('.')?;
    let (run_and_time, last) = stem.rsplit_once('-')?;
    let (run, time, number) = match last.parse() {
        Ok(number) if last.len() < 8 => {
            let (run, time) = run_and_time.rsplit_once('-')?;
            (run, time, number)
        }
        _ => (run_and_time, last, 1),
    };
    let time = strtime::parse(STAMP, time).ok()?.to_datetime().ok()?;
    (!run.is_empty()).then_some((time, number))
}

#[cfg(test)]
mod tests {
    use super::*;

    const NOON: u64 = 1_795_270_590 * 1_000_000_000;

    fn touch(folder: &Path, name: &str) -> PathBuf {
        let path = folder.join(name);
        std::fs::write(&path, b"").unwrap();
        path
    }

    #[test]
    fn a_log_is_named_after_its_run_and_utc_time() {
        assert_eq!(log_file_name("coordinator-yourarm", NOON), "coordinator-yourarm-20261121T141630Z.mcap");
        assert!(log_time("coordinator-yourarm-20261121T141630Z.mcap", LOG).is_some());
    }

    #[test]
    fn a_second_log_in_the_same_second_is_newer() {
        let folder = tempfile::tempdir().unwrap();
        for number in ["", "-2", "-3"] {
            let path = new_log_path(folder.path(), "run", NOON);
            assert_eq!(path.file_name().unwrap().to_str().unwrap(), format!("run-20261121T141630Z{number}.mcap"));
            std::fs::write(&path, b"").unwrap();
            assert_eq!(newest(folder.path()).unwrap(), Some(path));
        }
    }

    #[test]
    fn only_old_logs_are_removed() {
        let folder = tempfile::tempdir().unwrap();
        let foreign = ["notes.mcap", "run-1.mcap", "-20261121T141630Z.mcap", "run-20261121T141630Z.txt", "x.yaml"];
        let foreign = foreign.map(|name| touch(folder.path(), name));
        let old = touch(folder.path(), "z-20251121T141630Z.mcap");
        let kept = [touch(folder.path(), "b-20261121T141629Z.mcap"), touch(folder.path(), "a-20261121T141630Z.mcap")];
        assert_eq!(retain(folder.path(), 2).unwrap(), std::slice::from_ref(&old));
        assert!(!old.exists());
        assert!(foreign.iter().chain(&kept).all(|path| path.exists()));
        assert_eq!(newest(folder.path()).unwrap().as_ref(), Some(&kept[1]));
    }

    #[test]
    fn the_log_of_a_live_run_is_not_removed() {
        let folder = tempfile::tempdir().unwrap();
        let live = touch(folder.path(), "live-20251121T141630Z.mcap");
        let ended = touch(folder.path(), "ended-20251121T141631Z.mcap");
        let writing = File::options().append(true).open(&live).unwrap();
        mark_as_being_written(&writing);
        assert_eq!(retain(folder.path(), 0).unwrap(), [ended]);
        drop(writing);
        assert_eq!(retain(folder.path(), 0).unwrap(), [live]);
    }

    #[test]
    fn the_files_of_a_log_are_one_log() {
        let folder = tempfile::tempdir().unwrap();
        let first = touch(folder.path(), "run-20251121T141630Z.mcap");
        let parts = [1, 2].map(|number| part(&first, number));
        parts.iter().for_each(|path| std::fs::write(path, b"").unwrap());
        assert_eq!(all(folder.path()).unwrap(), std::slice::from_ref(&first));
        // A gap ends nothing.
        let later = touch(folder.path(), "run-20251121T141630Z_12.mcap");
        touch(folder.path(), "z-20251121T141630Z_3.mcap");
        let all: Vec<PathBuf> = parts.iter().cloned().chain([later]).collect();
        assert_eq!(further_parts(&first).collect::<Vec<_>>(), all);
        assert_eq!(logs_in(folder.path()).first(), Some(&first));
        let writing = File::open(&parts[1]).unwrap();
        mark_as_being_written(&writing);
        assert_eq!(retain(folder.path(), 0).unwrap(), <[PathBuf; 0]>::default());
        drop(writing);
        assert_eq!(retain(folder.path(), 0).unwrap(), [first]);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "that of another log");
    }

    #[test]
    fn no_folder_is_no_logs() {
        assert_eq!(newest(Path::new("/nonexistent/dimos")).unwrap(), None);
    }
}
