//! The run directory: sockets and locks of the live runs.
//!
//! A run holds a lock on `<run>.lock`, which contains its pid, beside its socket `<run>.sock`; `<run>.view` has the URL
//! of its live view, with the token. The kernel releases the lock when the process ends, so files without a lock are
//! stale; any process that finds them removes them.

use std::fs::{self, DirBuilder, File, OpenOptions, Permissions, TryLockError};
use std::io::{self, Read, Write};
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Maximum length of a run name [bytes].
const MAX_NAME: usize = 64;
/// Maximum length of a socket's path in Linux [bytes].
const MAX_SOCKET_PATH: usize = 107;
/// Attempts to claim a name whose lock is held: a process that lists the runs holds each lock briefly.
const ATTEMPTS: u32 = 20;
/// Attempts while the lock file has no pid: its holder is about to write it, or is listing the runs.
const ATTEMPTS_UNNAMED: u32 = 400;
/// For a run to release its name after its connections: 10 s.
const ATTEMPTS_RELEASED: u32 = 2000;
/// Pause between attempts.
const PAUSE: Duration = Duration::from_millis(5);

/// Why a run name or the run directory cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum RunDirError {
    /// The name is not valid.
    #[error("{0:?} cannot be the name of a run")]
    BadName(String),
    /// A live run has this name.
    #[error("a run named {run:?} is live already (pid {pid})")]
    Taken {
        /// The name.
        run: String,
        /// Process id of its holder; 0 while unknown.
        pid: u32,
    },
    /// The directory belongs to another user, or is not a directory.
    #[error("{} is not a directory of this user", .0.display())]
    NotOurs(PathBuf),
    /// The path of the socket is too long for Linux.
    #[error("the path of the socket is too long: {}", .0.display())]
    PathTooLong(PathBuf),
    /// A file system operation failed.
    #[error("{}: {error}", path.display())]
    Io {
        /// The file or directory.
        path: PathBuf,
        /// The system's error.
        error: io::Error,
    },
}

impl RunDirError {
    /// Returns what the user can do about it.
    pub fn hint(&self) -> &'static str {
        match self {
            Self::BadName(_) => "use 1 to 64 letters, digits, '-', '_' and '.', without a leading '.'",
            Self::Taken { .. } => "choose another name with `--name`, or end that run with `dimos down`",
            Self::NotOurs(_) => "remove it, or set XDG_RUNTIME_DIR to a directory of this user",
            Self::PathTooLong(_) => "set XDG_RUNTIME_DIR to a directory with a shorter path, or use a shorter name",
            Self::Io { .. } => "make the directory writable, or set XDG_RUNTIME_DIR to another one",
        }
    }
}

/// The directory of sockets and locks.
#[derive(Debug, Clone)]
pub struct RunDir(PathBuf);

/// A live run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LiveRun {
    /// Its name.
    pub name: String,
    /// Process id; 0 while unknown.
    pub pid: u32,
    /// Its socket; missing while the run starts. Empty if it is on another computer.
    pub socket: PathBuf,
    /// Where it is, if it is on another computer.
    pub at: Option<String>,
}

/// A claimed run name. Dropping it removes the socket and releases the name.
#[derive(Debug)]
pub struct Claim {
    run: String,
    socket: PathBuf,
    lock_path: PathBuf,
    _lock: File,
}

impl RunDir {
    /// Returns the default directory: `$XDG_RUNTIME_DIR/dimos`, or `<tmp>/dimos-<uid>` if that variable is unset or
    /// names no directory.
    pub fn standard() -> Self {
        let runtime = std::env::var_os("XDG_RUNTIME_DIR").map(PathBuf::from).filter(|dir| dir.is_dir());
        Self(match runtime {
            Some(dir) => dir.join("dimos"),
            None => std::env::temp_dir().join(format!("dimos-{}", rustix::process::geteuid().as_raw())),
        })
    }

    /// Returns a run directory at this path, for tests and programs that contain a run.
    pub fn at(path: impl Into<PathBuf>) -> Self {
        Self(path.into())
    }

    /// Returns the directory for attached planners: they have a lock, but no socket.
    pub fn planners(&self) -> Self {
        Self(self.0.join("planners"))
    }

    /// Returns the directory for sockets that lead to runs on other computers.
    pub fn relays(&self) -> Self {
        Self(self.0.join("relays"))
    }

    /// Returns its path.
    pub fn path(&self) -> &Path {
        &self.0
    }

    /// Claims a run name, removing stale files of that name. Fails if a live run has it. May block for 2 s.
    pub fn claim(&self, run: &str) -> Result<Claim, RunDirError> {
        check_name(run)?;
        let socket = self.0.join(format!("{run}.sock"));
        if socket.as_os_str().len() > MAX_SOCKET_PATH {
            return Err(RunDirError::PathTooLong(socket));
        }
        self.prepare()?;
        let lock_path = self.0.join(format!("{run}.lock"));
        let in_lock = |error| RunDirError::Io { path: lock_path.clone(), error };
        let mut pid = 0;
        let mut attempts = 0;
        while attempts < if pid == 0 { ATTEMPTS_UNNAMED } else { ATTEMPTS } {
            attempts += 1;
            let mut file = OpenOptions::new()
                .read(true)
                .write(true)
                .create(true)
                .truncate(false)
                .mode(0o600)
                .open(&lock_path)
                .map_err(in_lock)?;
            match file.try_lock() {
                Ok(()) if is_same_file(&file, &lock_path) => {
                    file.set_len(0).map_err(in_lock)?;
                    write!(file, "{}", std::process::id()).map_err(in_lock)?;
                    remove_files(&socket)?;
                    return Ok(Claim { run: run.to_owned(), socket, lock_path, _lock: file });
                }
                Ok(()) => {} // Its previous holder removed the file after we opened it.
                Err(TryLockError::WouldBlock) => {
                    pid = read_pid(&mut file);
                    std::thread::sleep(PAUSE);
                }
                Err(TryLockError::Error(error)) => return Err(in_lock(error)),
            }
        }
        Err(RunDirError::Taken { run: run.to_owned(), pid })
    }

    /// Returns the live runs, sorted by name. Removes stale files.
    pub fn runs(&self) -> Result<Vec<LiveRun>, RunDirError> {
        let in_folder = |error| RunDirError::Io { path: self.0.clone(), error };
        let entries = match fs::read_dir(&self.0) {
            Ok(entries) => entries,
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
            Err(e) => return Err(in_folder(e)),
        };
        let mut runs = Vec::new();
        for entry in entries {
            let path = entry.map_err(in_folder)?.path();
            let name = path.file_stem().and_then(|n| n.to_str()).unwrap_or_default().to_owned();
            match path.extension().and_then(|e| e.to_str()) {
                Some("lock") => {}
                Some("sock" | "view") if !path.with_extension("lock").exists() => {
                    remove(&path)?;
                    continue;
                }
                _ => continue,
            }
            let socket = path.with_extension("sock");
            let Ok(mut file) = File::open(&path) else { continue };
            match file.try_lock() {
                Ok(()) if is_same_file(&file, &path) => {
                    remove_files(&socket)?;
                    remove(&path)?;
                }
                Err(TryLockError::WouldBlock) => {
                    runs.push(LiveRun { name, pid: read_pid(&mut file), socket, at: None })
                }
                _ => {}
            }
        }
        runs.sort_by(|a, b| a.name.cmp(&b.name));
        Ok(runs)
    }

    /// Creates the directory, accessible to this user only.
    fn prepare(&self) -> Result<(), RunDirError> {
        let failed = |error| RunDirError::Io { path: self.0.clone(), error };
        DirBuilder::new().recursive(true).mode(0o700).create(&self.0).map_err(failed)?;
        // Any user can create directories in <tmp>. The owner of this one could replace our socket.
        let found = fs::symlink_metadata(&self.0).map_err(failed)?;
        if !found.is_dir() || found.uid() != rustix::process::geteuid().as_raw() {
            return Err(RunDirError::NotOurs(self.0.clone()));
        }
        if found.mode() & 0o777 != 0o700 {
            fs::set_permissions(&self.0, Permissions::from_mode(0o700)).map_err(failed)?;
        }
        Ok(())
    }
}

/// Waits until a run whose connections have closed has released its name. Returns whether it ended in order: then it
/// removes its socket, and a run that was killed leaves it.
pub fn has_ended_in_order(socket: &Path) -> bool {
    let lock = socket.with_extension("lock");
    for _ in 0..ATTEMPTS_RELEASED {
        // Asked first: the socket is removed before the name is released.
        let is_held = File::open(&lock).is_ok_and(|file| matches!(file.try_lock(), Err(TryLockError::WouldBlock)));
        if !socket.exists() {
            return true;
        }
        if !is_held {
            return false;
        }
        std::thread::sleep(PAUSE);
    }
    true
}

impl Claim {
    /// Returns the run's name.
    pub fn run(&self) -> &str {
        &self.run
    }

    /// Returns the path for its socket.
    pub fn socket(&self) -> &Path {
        &self.socket
    }
}

impl Drop for Claim {
    fn drop(&mut self) {
        // Still locked, so these are not another run's files. After a failure the next run removes them.
        let _ = remove_files(&self.socket);
        let _ = remove(&self.lock_path);
    }
}

/// Checks that a run name is valid as part of a file name.
pub fn check_name(run: &str) -> Result<(), RunDirError> {
    let good = |b: u8| b.is_ascii_alphanumeric() || matches!(b, b'-' | b'_' | b'.');
    if run.is_empty() || run.len() > MAX_NAME || run.starts_with('.') || !run.bytes().all(good) {
        return Err(RunDirError::BadName(run.to_owned()));
    }
    Ok(())
}

/// Returns the file with the URL of a run's live view, beside its socket.
pub fn view_file(socket: &Path) -> PathBuf {
    socket.with_extension("view")
}

/// Removes what a run has beside its lock.
fn remove_files(socket: &Path) -> Result<(), RunDirError> {
    remove(socket)?;
    remove(&view_file(socket))
}

fn remove(path: &Path) -> Result<(), RunDirError> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(RunDirError::Io { path: path.to_owned(), error }),
        _ => Ok(()),
    }
}

fn is_same_file(file: &File, path: &Path) -> bool {
    match (file.metadata(), fs::metadata(path)) {
        (Ok(a), Ok(b)) => a.ino() == b.ino() && a.dev() == b.dev(),
        _ => false,
    }
}

fn read_pid(file: &mut File) -> u32 {
    let mut text = String::new();
    let _ = file.take(32).read_to_string(&mut text);
    text.trim().parse().unwrap_or(0)
}
