//! Location of the sockets of runs, which runs are live, and that a run name is taken once.
//!
//! A run holds a locked file `<run>.lock` with its pid in it, next to its socket `<run>.sock`. The lock dies with the
//! process, however that ends, so what is not locked is stale and removed by the process that finds it.

use std::fs::{self, DirBuilder, File, OpenOptions, Permissions, TryLockError};
use std::io::{self, Read, Write};
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Longest name of a run [bytes].
const MAX_NAME: usize = 64;
/// Longest path of a socket that Linux takes [bytes].
const MAX_SOCKET_PATH: usize = 107;
/// How often a name that looks taken is tried again: someone listing the runs holds each lock for a moment.
const ATTEMPTS: u32 = 20;
/// The same while the lock's file does not say who has it: its holder will write it in a moment, or only lists.
const ATTEMPTS_UNNAMED: u32 = 400;
/// Pause between attempts.
const PAUSE: Duration = Duration::from_millis(5);

/// Why a run's name or place cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum PlaceError {
    /// The name is no good for a file.
    #[error("{0:?} cannot be the name of a run")]
    BadName(String),
    /// A live run has that name.
    #[error("a run named {run:?} is live already (pid {pid})")]
    Taken {
        /// The name.
        run: String,
        /// The process that holds it; 0 when it has not said yet.
        pid: u32,
    },
    /// The folder belongs to someone else, or is none.
    #[error("{} is not a folder of this user", .0.display())]
    NotOurs(PathBuf),
    /// The path of the socket is too long for the system.
    #[error("the path of the socket is too long: {}", .0.display())]
    PathTooLong(PathBuf),
    /// The file system refused.
    #[error("{}: {error}", path.display())]
    Io {
        /// Which file or folder.
        path: PathBuf,
        /// What it said.
        error: io::Error,
    },
}

impl PlaceError {
    /// What to do about it.
    pub fn hint(&self) -> &'static str {
        match self {
            Self::BadName(_) => "up to 64 letters, digits, '-', '_' and '.', and no '.' at the start",
            Self::Taken { .. } => "give this one another name with `--name`, or end that one with `dimos down`",
            Self::NotOurs(_) => "remove it, or set XDG_RUNTIME_DIR to a folder of yours",
            Self::PathTooLong(_) => "set XDG_RUNTIME_DIR to a folder with a shorter path, or take a shorter name",
            Self::Io { .. } => "the folder must be writable; XDG_RUNTIME_DIR may name another",
        }
    }
}

/// The folder with the sockets.
#[derive(Debug, Clone)]
pub struct RunFolder(PathBuf);

/// A live run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LiveRun {
    /// Its name.
    pub name: String,
    /// Its process; 0 when it has not said yet.
    pub pid: u32,
    /// Its socket; it may not exist yet while the run starts.
    pub socket: PathBuf,
}

/// A run's name, taken for as long as this value exists. Dropping it removes the socket and the lock.
#[derive(Debug)]
pub struct Claim {
    run: String,
    socket: PathBuf,
    lock_path: PathBuf,
    _lock: File,
}

impl RunFolder {
    /// `$XDG_RUNTIME_DIR/dimos`, or `<tmp>/dimos-<uid>` where there is no such variable or folder.
    pub fn standard() -> Self {
        let runtime = std::env::var_os("XDG_RUNTIME_DIR").map(PathBuf::from).filter(|dir| dir.is_dir());
        Self(match runtime {
            Some(dir) => dir.join("dimos"),
            None => std::env::temp_dir().join(format!("dimos-{}", rustix::process::geteuid().as_raw())),
        })
    }

    /// A folder of one's own, for tests and embedders.
    pub fn at(path: impl Into<PathBuf>) -> Self {
        Self(path.into())
    }

    /// The same for planners in processes of their own: they have names and live, but no socket.
    pub fn planners(&self) -> Self {
        Self(self.0.join("planners"))
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.0
    }

    /// Takes a run's name, or says who has it. Removes what a dead run of that name left.
    pub fn claim(&self, run: &str) -> Result<Claim, PlaceError> {
        check_name(run)?;
        let socket = self.0.join(format!("{run}.sock"));
        if socket.as_os_str().len() > MAX_SOCKET_PATH {
            return Err(PlaceError::PathTooLong(socket));
        }
        self.prepare()?;
        let lock_path = self.0.join(format!("{run}.lock"));
        let in_lock = |error| PlaceError::Io { path: lock_path.clone(), error };
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
                    remove(&socket)?;
                    return Ok(Claim { run: run.to_owned(), socket, lock_path, _lock: file });
                }
                Ok(()) => {} // Removed by its last holder between our opening and locking it.
                Err(TryLockError::WouldBlock) => {
                    pid = read_pid(&mut file);
                    std::thread::sleep(PAUSE);
                }
                Err(TryLockError::Error(error)) => return Err(in_lock(error)),
            }
        }
        Err(PlaceError::Taken { run: run.to_owned(), pid })
    }

    /// The runs that live, by name. Removes what dead ones left.
    pub fn runs(&self) -> Result<Vec<LiveRun>, PlaceError> {
        let in_folder = |error| PlaceError::Io { path: self.0.clone(), error };
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
                Some("sock") if !path.with_extension("lock").exists() => {
                    remove(&path)?;
                    continue;
                }
                _ => continue,
            }
            let socket = path.with_extension("sock");
            let Ok(mut file) = File::open(&path) else { continue };
            match file.try_lock() {
                Ok(()) if is_same_file(&file, &path) => {
                    remove(&socket)?;
                    remove(&path)?;
                }
                Err(TryLockError::WouldBlock) => runs.push(LiveRun { name, pid: read_pid(&mut file), socket }),
                _ => {}
            }
        }
        runs.sort_by(|a, b| a.name.cmp(&b.name));
        Ok(runs)
    }

    /// Makes the folder, for this user only.
    fn prepare(&self) -> Result<(), PlaceError> {
        let failed = |error| PlaceError::Io { path: self.0.clone(), error };
        DirBuilder::new().recursive(true).mode(0o700).create(&self.0).map_err(failed)?;
        // Anyone may make folders in the temporary folder: one that is not ours would let its owner take our socket.
        let found = fs::symlink_metadata(&self.0).map_err(failed)?;
        if !found.is_dir() || found.uid() != rustix::process::geteuid().as_raw() {
            return Err(PlaceError::NotOurs(self.0.clone()));
        }
        if found.mode() & 0o777 != 0o700 {
            fs::set_permissions(&self.0, Permissions::from_mode(0o700)).map_err(failed)?;
        }
        Ok(())
    }
}

impl Claim {
    /// The run's name.
    pub fn run(&self) -> &str {
        &self.run
    }

    /// Where its socket belongs.
    pub fn socket(&self) -> &Path {
        &self.socket
    }
}

impl Drop for Claim {
    fn drop(&mut self) {
        // Removed while still locked, so that no other run's files are hit. A failure leaves stale files, which the
        // next run removes.
        let _ = remove(&self.socket);
        let _ = remove(&self.lock_path);
    }
}

/// Whether a name may be that of a run: it is part of names of files.
pub fn check_name(run: &str) -> Result<(), PlaceError> {
    let good = |b: u8| b.is_ascii_alphanumeric() || matches!(b, b'-' | b'_' | b'.');
    if run.is_empty() || run.len() > MAX_NAME || run.starts_with('.') || !run.bytes().all(good) {
        return Err(PlaceError::BadName(run.to_owned()));
    }
    Ok(())
}

fn remove(path: &Path) -> Result<(), PlaceError> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(PlaceError::Io { path: path.to_owned(), error }),
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
