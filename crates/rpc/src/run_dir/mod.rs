//! The run directory: sockets and locks of the live runs.
//!
//! A run holds a lock on `<run>.lock`, which contains its pid, beside its socket `<run>.sock`; `<run>.view` has the URL
//! of its live view, with the token. The kernel releases the lock when the process ends, so files without a lock are
//! stale: the next run of that name removes them, readers remove nothing. A run also has a mark in the kernel, so that
//! its name is unique and it is found wherever its directory is, or was.

pub(crate) mod claim;
pub(crate) mod live_runs;
pub(crate) mod look;
pub(crate) mod mark;
pub(crate) mod run_files;

use std::fs::{self, TryLockError};
use std::io;
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};

pub use crate::run_dir::claim::{Claim, RunFiles, UrlFile};
use crate::run_dir::mark::Mark;
use crate::run_dir::run_files::{FOLDERS, is_ours, open_lock, pid_in, prepare};
use dimos_rt::abstract_name::{Taken, holder};

/// Environment variable of the directory of a closed world of runs.
pub const WORLD: &str = "DIMOS_WORLD";
/// Maximum length of a run name [bytes].
const MAX_NAME: usize = 64;
/// Maximum length of a socket's path in Linux [bytes].
const MAX_SOCKET_PATH: usize = 107;

/// Why a run name or the run directory cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum RunDirError {
    /// The name is not valid.
    #[error("{0:?} cannot be the name of a run")]
    BadName(String),
    /// A live run has this name.
    #[error("a run named {run:?} is live already (pid {})", pid_text(*.pid))]
    Taken {
        /// The name.
        run: String,
        /// Process id of its holder; 0 while unknown.
        pid: u32,
    },
    /// Another user has taken this name.
    #[error("another user has the name {run:?} (uid {uid}, pid {})", pid_text(*.pid))]
    TakenByOther {
        /// The name.
        run: String,
        /// The user.
        uid: u32,
        /// Process id of its holder; 0 while unknown.
        pid: u32,
    },
    /// The directory belongs to another user, or is not a directory.
    #[error("{} is not a directory of this user", .0.display())]
    NotOurs(PathBuf),
    /// Something else is where a run's file would be, or in a directory that others may enter.
    #[error("{} was not made by a run", .0.display())]
    OtherFiles(PathBuf),
    /// `DIMOS_WORLD` names no directory of this user.
    #[error("DIMOS_WORLD={} is not a directory of this user", .0.display())]
    World(PathBuf),
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
            Self::TakenByOther { .. } => "choose another name with `--name`, and ask that user to end the program",
            Self::NotOurs(_) => "remove it, or set XDG_RUNTIME_DIR to a directory of this user",
            Self::OtherFiles(_) => "move it away, or set XDG_RUNTIME_DIR to another directory",
            Self::World(_) => "make the directory, or unset DIMOS_WORLD",
            Self::PathTooLong(_) => "set XDG_RUNTIME_DIR to a directory with a shorter path, or use a shorter name",
            Self::Io { .. } => "make the directory writable, or set XDG_RUNTIME_DIR to another one",
        }
    }
}

fn pid_text(pid: u32) -> String {
    if pid == 0 { "unknown".into() } else { pid.to_string() }
}

/// Which runs see each other.
#[derive(Debug, Clone, PartialEq, Eq)]
enum World {
    /// All runs of this user that the kernel lists.
    Open,
    /// Those with the same directory, identified by this number.
    Closed(u64),
    /// `DIMOS_WORLD` names no directory of this user: no runs.
    Wrong,
}

/// What is claimed in a directory.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Run,
    Planner,
    Relay,
}

/// The directory of sockets and locks.
#[derive(Debug, Clone)]
pub struct RunDir {
    path: PathBuf,
    world: World,
    kind: Kind,
}

/// A live run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LiveRun {
    /// Its name.
    pub name: String,
    /// Process id; 0 while unknown.
    pub pid: u32,
    /// Its socket; missing while the run starts. `@NAME`: an abstract one. Empty if it is on another computer.
    pub socket: PathBuf,
    /// Where it is, if it is on another computer.
    pub at: Option<String>,
}

/// The live runs, and where others may be.
#[derive(Debug, Default)]
pub struct Seen {
    /// The runs, sorted by name.
    pub runs: Vec<LiveRun>,
    /// Processes of this user whose namespace cannot be searched.
    pub unseen: Vec<u32>,
    /// Whether this process sees all processes of this computer.
    pub is_whole: bool,
}

impl RunDir {
    /// Returns the default directory: `$DIMOS_WORLD/dimos`, a closed world, if that variable is set; else
    /// `$XDG_RUNTIME_DIR/dimos`, or `<tmp>/dimos-<uid>` if that variable is unset or names no directory.
    pub fn standard() -> Self {
        if let Some(folder) = std::env::var_os(WORLD).map(PathBuf::from) {
            return match fs::canonicalize(&folder).ok().filter(|real| matches!(is_ours(real), Ok(true))) {
                Some(real) => Self::closed(real.join("dimos")),
                None => Self { path: folder, world: World::Wrong, kind: Kind::Run },
            };
        }
        let runtime = std::env::var_os("XDG_RUNTIME_DIR").map(PathBuf::from).filter(|dir| dir.is_dir());
        Self::at(match runtime {
            Some(dir) => dir.join("dimos"),
            None => std::env::temp_dir().join(format!("dimos-{}", rustix::process::geteuid().as_raw())),
        })
    }

    /// Returns a run directory at this path, for programs that contain a run.
    pub fn at(path: impl Into<PathBuf>) -> Self {
        Self { path: path.into(), world: World::Open, kind: Kind::Run }
    }

    /// Returns a run directory at this path that is a world for itself, for tests: its runs are found by nothing else,
    /// find nothing else, and may have names that other runs have. That of `DIMOS_WORLD=DIR` is `DIR/dimos`.
    pub fn closed(path: impl Into<PathBuf>) -> Self {
        let path = path.into();
        let real = path.parent().and_then(|parent| Some(fs::canonicalize(parent).ok()?.join(path.file_name()?)));
        // FNV-1a: other programs compute it, too.
        let number = real.as_ref().unwrap_or(&path).as_os_str().as_bytes().iter();
        let number = number
            .fold(0xcbf2_9ce4_8422_2325_u64, |n, byte| (n ^ u64::from(*byte)).wrapping_mul(0x0000_0100_0000_01b3));
        Self { path, world: World::Closed(number), kind: Kind::Run }
    }

    /// Returns the directory for attached planners: they have a lock, but no socket.
    pub fn planners(&self) -> Self {
        self.within(FOLDERS[0], Kind::Planner)
    }

    /// Returns the directory for sockets that lead to runs on other computers.
    pub fn relays(&self) -> Self {
        self.within(FOLDERS[1], Kind::Relay)
    }

    fn within(&self, folder: &str, kind: Kind) -> Self {
        Self { path: self.path.join(folder), world: self.world.clone(), kind }
    }

    /// Returns its path.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns whether its world is closed: only arms of this computer belong to it.
    pub fn is_closed(&self) -> bool {
        self.world != World::Open
    }

    /// Claims a run name, removing stale files of that name. Fails if a live run of this user has it, whatever its
    /// directory. May block for 2 s.
    pub fn claim(&self, run: &str) -> Result<Claim, RunDirError> {
        self.check_world()?;
        check_name(run)?;
        let socket = self.path.join(format!("{run}.sock"));
        if socket.as_os_str().len() > MAX_SOCKET_PATH {
            return Err(RunDirError::PathTooLong(socket));
        }
        let taken = |pid| RunDirError::Taken { run: run.to_owned(), pid };
        let mark = match self.marks() {
            Some(prefix) => Some(Mark::take(format!("{prefix}{run}")).map_err(|refused| match refused {
                Taken::By(Some(peer)) if peer.uid != rustix::process::geteuid().as_raw() => {
                    RunDirError::TakenByOther { run: run.to_owned(), uid: peer.uid, pid: peer.pid }
                }
                Taken::By(peer) => taken(peer.map_or(0, |peer| peer.pid)),
                Taken::Io(error) => RunDirError::Io { path: socket.clone(), error },
            })?),
            None => None,
        };
        // A name in another network namespace does not show as taken.
        if let Some(prefix) = self.marks().filter(|_| self.world == World::Open)
            && let Some(other) = live_runs::elsewhere(&prefix).runs.into_iter().find(|other| other.name == run)
        {
            return Err(taken(other.pid));
        }
        prepare(&self.path)?;
        Claim::new(&self.path, run, mark)
    }

    /// Returns the live runs, sorted by name.
    pub fn runs(&self) -> Result<Vec<LiveRun>, RunDirError> {
        Ok(self.seen()?.runs)
    }

    /// Returns the live runs: with a lock in this directory, or with a mark in the kernel. Removes nothing.
    pub fn seen(&self) -> Result<Seen, RunDirError> {
        self.check_world()?;
        let here = self.locked();
        let Some(prefix) = self.marks() else { return Ok(Seen { runs: here?, ..Seen::default() }) };
        let mut seen = Seen::default();
        let locked = match live_runs::here(&prefix) {
            Ok(marked) => {
                seen.runs = marked;
                // A folder that cannot be read hides none: the kernel lists them.
                here.unwrap_or_default()
            }
            // Then the folder alone must do.
            Err(error) => {
                tracing::debug!("/proc/net/unix: {error}");
                here?
            }
        };
        // A lock knows the socket, the mark the process.
        for run in locked {
            match seen.runs.iter_mut().find(|marked| marked.name == run.name) {
                Some(marked) if marked.socket.as_os_str().as_bytes().starts_with(b"@") && run.socket.exists() => {
                    marked.socket = run.socket;
                }
                Some(_) => {}
                None if live_runs::is_of_other_world(&prefix, &run) => {}
                None => seen.runs.push(run),
            }
        }
        if self.world == World::Open {
            let elsewhere = live_runs::elsewhere(&prefix);
            let is_new = |run: &LiveRun| !seen.runs.iter().any(|known| known.name == run.name && known.pid == run.pid);
            let new: Vec<LiveRun> = elsewhere.runs.into_iter().filter(is_new).collect();
            seen.runs.extend(new);
            (seen.unseen, seen.is_whole) = (elsewhere.unseen, elsewhere.is_whole);
        } else {
            seen.is_whole = true;
        }
        seen.runs.sort_by(|a, b| a.name.cmp(&b.name));
        Ok(seen)
    }

    /// Returns where a live run is reached whatever becomes of its directory: at its mark. One in another network
    /// namespace, whose mark cannot be reached, at its socket.
    pub fn lasting(&self, run: &LiveRun) -> PathBuf {
        let mark = self.marks().map(|prefix| format!("{prefix}{}", run.name));
        let is_its = |mark: &String| holder(mark).is_ok_and(|peer| peer.pid == run.pid);
        mark.filter(is_its).map_or_else(|| run.socket.clone(), |mark| format!("@{mark}").into())
    }

    fn check_world(&self) -> Result<(), RunDirError> {
        match self.world {
            World::Wrong => {
                let given = std::env::var_os(WORLD).map_or_else(|| self.path.clone(), PathBuf::from);
                Err(RunDirError::World(given))
            }
            _ => Ok(()),
        }
    }

    /// Returns the beginning of the marks; what is claimed here may have none.
    fn marks(&self) -> Option<String> {
        let kind = match self.kind {
            Kind::Run => "run",
            Kind::Planner => "planner",
            Kind::Relay => return None,
        };
        let user = rustix::process::geteuid().as_raw();
        Some(match self.world {
            World::Closed(number) => format!("dimos/{kind}/{user}@{number:016x}/"),
            _ => format!("dimos/{kind}/{user}/"),
        })
    }

    /// Removes what dead holders of names left here.
    pub fn tidy(&self) -> Result<(), RunDirError> {
        if !is_ours(&self.path)? {
            return Ok(());
        }
        let failed = |error| RunDirError::Io { path: self.path.clone(), error };
        for entry in fs::read_dir(&self.path).map_err(failed)? {
            let path = entry.map_err(failed)?.path();
            let Some(lock) = path.extension().filter(|e| *e == "lock").and_then(|_| open_lock(&path, false).ok())
            else {
                continue;
            };
            if lock.try_lock().is_ok() && run_files::is_at(&lock, &path) {
                run_files::remove_left(&path.with_extension("sock"))?;
                fs::remove_file(&path).map_err(failed)?;
            }
        }
        Ok(())
    }

    /// Returns the runs with a lock in this directory; none if it belongs to another user.
    fn locked(&self) -> Result<Vec<LiveRun>, RunDirError> {
        if !matches!(is_ours(&self.path), Ok(true)) {
            return Ok(Vec::new());
        }
        let in_folder = |error| RunDirError::Io { path: self.path.clone(), error };
        let mut runs = Vec::new();
        for entry in fs::read_dir(&self.path).map_err(in_folder)? {
            let path = entry.map_err(in_folder)?.path();
            let name = path.file_stem().and_then(|n| n.to_str()).unwrap_or_default();
            if path.extension().is_none_or(|ending| ending != "lock") || check_name(name).is_err() {
                continue;
            }
            let Ok(file) = open_lock(&path, false) else { continue };
            if matches!(file.try_lock_shared(), Err(TryLockError::WouldBlock)) {
                let (name, socket) = (name.to_owned(), path.with_extension("sock"));
                runs.push(LiveRun { name, pid: pid_in(&file), socket, at: None });
            }
        }
        Ok(runs)
    }
}

/// Returns the path of a run's socket: of an abstract one, that at which the same process listens now.
pub fn path_of(socket: &Path) -> Option<PathBuf> {
    match socket.to_str().and_then(|text| text.strip_prefix('@')) {
        Some(mark) => live_runs::path_of(mark),
        None => Some(socket.to_owned()),
    }
}

/// Returns the URL in the file of a run's live view; `None` if there is none, or it is not of this user.
pub fn url_in(view_file: &Path) -> Option<String> {
    run_files::read_text(view_file).map(|text| text.trim().to_owned())
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
