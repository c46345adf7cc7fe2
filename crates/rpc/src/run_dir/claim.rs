//! A claimed run name: its mark in the kernel, its lock, its socket and the file with the URL of its page.

use std::fs::{self, File, Permissions, TryLockError};
use std::io::{self, Write};
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::UnixListener;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, TryLockError as TryLockMutex};
use std::time::Duration;

use crate::error::{Code, RpcError};
use crate::run_dir::mark::{Mark, Way};
use crate::run_dir::run_files::{id_of, is_at, open_lock, pid_in, prepare, remove_left};
use crate::run_dir::{RunDirError, view_file};
use crate::wire;
use dimos_core::sync::lock;

/// Attempts to lock a name that is not taken: a process that lists the runs holds each lock briefly.
const ATTEMPTS: u32 = 400;
/// Attempts to lock the files of a run that ends: 0.5 s.
const ATTEMPTS_LOCK: u32 = 100;
/// Pause between attempts.
const PAUSE: Duration = Duration::from_millis(5);

/// A claimed run name. Dropping it removes its files and releases the name.
#[derive(Debug)]
pub struct Claim {
    files: RunFiles,
    // Released last.
    mark: Option<Mark>,
}

/// The files of a claimed name. Clones are the same files.
#[derive(Debug, Clone)]
pub struct RunFiles(Arc<Mutex<Files>>);

#[derive(Debug)]
struct Files {
    run: String,
    /// Where the files are, and where they go if that is impossible.
    folders: Vec<PathBuf>,
    socket: PathBuf,
    /// Device and inode of the socket, once it is open.
    bound: Option<(u64, u64)>,
    lock: File,
    url: Option<String>,
    /// Whether a lost socket was reported.
    is_reported: bool,
    /// Whether the claim has ended: then nothing is made again.
    is_released: bool,
}

impl Claim {
    /// Locks a name in a folder that is prepared; `mark` is held.
    pub(crate) fn new(folder: &Path, run: &str, mark: Option<Mark>) -> Result<Self, RunDirError> {
        let socket = folder.join(format!("{run}.sock"));
        let lock = take_lock(&socket.with_extension("lock"), run)?;
        remove_left(&socket)?;
        remove_left(&view_file(&socket))?;
        let (run, folders) = (run.to_owned(), vec![folder.to_owned()]);
        let (bound, url, is_reported, is_released) = (None, None, false, false);
        let files = Files { run, folders, socket, bound, lock, url, is_reported, is_released };
        Ok(Self { files: RunFiles(Arc::new(Mutex::new(files))), mark })
    }

    /// Uses another folder when that of the claim is lost and cannot be made again.
    pub fn or_in(self, folder: Option<PathBuf>) -> Self {
        lock(&self.files.0).folders.extend(folder);
        self
    }

    /// Returns the run's name.
    pub fn run(&self) -> String {
        lock(&self.files.0).run.clone()
    }

    /// Returns the path for its socket.
    pub fn socket(&self) -> PathBuf {
        self.files.socket()
    }

    /// Returns its files.
    pub fn files(&self) -> RunFiles {
        self.files.clone()
    }

    /// Returns where a program on this computer reaches it, whatever happens to its directory.
    pub fn far_socket(&self) -> PathBuf {
        self.mark.as_ref().map_or_else(|| self.socket(), |mark| PathBuf::from(format!("@{}", mark.name())))
    }

    /// Sets where connections to its mark go.
    pub(crate) fn lead(&self, way: Way) {
        if let Some(mark) = &self.mark {
            mark.lead(way);
        }
    }

    /// Refuses all connections to its mark: the run serves no clients.
    pub fn refuse_clients(&self) {
        let text = format!("run {} serves no clients: its blueprint has rpc.enabled: false", self.run());
        let error = RpcError::new(Code::Unsupported, text)
            .hint(format!("end it with a signal: kill -INT {}", std::process::id()));
        self.lead(Way::Refused(wire::reply::<()>(&serde_json::Value::Null, Err(error))));
    }
}

impl Drop for Claim {
    fn drop(&mut self) {
        // Still locked, so these are not another run's files. After a failure the next run removes them.
        if let Some(mut files) = self.files.within_reach() {
            files.remove();
        }
    }
}

impl RunFiles {
    /// Returns the path of the socket.
    pub fn socket(&self) -> PathBuf {
        lock(&self.0).socket.clone()
    }

    /// Locks them. `None`: a file system hangs under the thread that looks after them.
    fn within_reach(&self) -> Option<MutexGuard<'_, Files>> {
        for _ in 0..ATTEMPTS_LOCK {
            match self.0.try_lock() {
                Ok(files) => return Some(files),
                Err(TryLockMutex::Poisoned(files)) => return Some(files.into_inner()),
                Err(TryLockMutex::WouldBlock) => std::thread::sleep(PAUSE),
            }
        }
        None
    }

    /// Opens the socket.
    pub(crate) fn bind(&self) -> io::Result<UnixListener> {
        lock(&self.0).bind()
    }

    /// Opens the socket again, with its lock and the file with the URL, if the socket is no longer at its path: in its
    /// folder, else in the other one. `None`: it is there, or cannot be opened now.
    pub(crate) fn restore(&self) -> Option<UnixListener> {
        lock(&self.0).restore()
    }

    /// Writes the file with the URL of its page, for its user only.
    pub fn write_url(&self, url: &str) -> io::Result<UrlFile> {
        let mut files = lock(&self.0);
        files.url = Some(url.to_owned());
        files.write_url()?;
        Ok(UrlFile(self.clone()))
    }
}

/// The file with the URL of a run's page. Removed when dropped.
#[derive(Debug)]
pub struct UrlFile(RunFiles);

impl Drop for UrlFile {
    fn drop(&mut self) {
        let Some(mut files) = self.0.within_reach() else { return };
        files.url = None;
        // If that fails, the next run of this name removes it.
        let _ = remove_left(&view_file(&files.socket));
    }
}

impl Files {
    fn bind(&mut self) -> io::Result<UnixListener> {
        let listener = UnixListener::bind(&self.socket)?;
        // The directory is closed to other users, so none of them could connect before this.
        fs::set_permissions(&self.socket, Permissions::from_mode(0o600))?;
        listener.set_nonblocking(true)?;
        self.bound = Some(id_of(&fs::symlink_metadata(&self.socket)?));
        Ok(listener)
    }

    fn restore(&mut self) -> Option<UnixListener> {
        if self.is_released {
            return None;
        }
        let there = fs::symlink_metadata(&self.socket).ok().map(|found| id_of(&found));
        if there.is_some() && there == self.bound {
            return None;
        }
        for folder in self.folders.clone() {
            match self.restore_in(&folder) {
                Ok(listener) => {
                    tracing::warn!("rpc: the socket was gone; it is open again: {}", self.socket.display());
                    self.is_reported = false;
                    return Some(listener);
                }
                Err(error) if !self.is_reported => tracing::warn!("rpc: the socket is gone: {error}"),
                Err(_) => {}
            }
        }
        self.is_reported = true;
        None
    }

    fn restore_in(&mut self, folder: &Path) -> Result<UnixListener, RunDirError> {
        prepare(folder)?;
        let socket = folder.join(format!("{}.sock", self.run));
        let lock_path = socket.with_extension("lock");
        if !is_at(&self.lock, &lock_path) {
            self.lock = try_lock(&lock_path, &self.run)?.map_err(|pid| taken(&self.run, pid))?;
        }
        remove_left(&socket)?;
        remove_left(&view_file(&socket))?;
        self.socket = socket;
        let listener = self.bind().map_err(|error| RunDirError::Io { path: self.socket.clone(), error })?;
        if let Err(error) = self.write_url() {
            tracing::warn!("rpc: the file with the URL of the page: {error}");
        }
        Ok(listener)
    }

    fn write_url(&self) -> io::Result<()> {
        use std::os::unix::fs::OpenOptionsExt;
        let Some(url) = &self.url else { return Ok(()) };
        let path = view_file(&self.socket);
        let mut file = fs::OpenOptions::new().write(true).create_new(true).mode(0o600).open(path)?;
        writeln!(file, "{url}")
    }

    fn remove(&mut self) {
        self.is_released = true;
        let lock_path = self.socket.with_extension("lock");
        if is_at(&self.lock, &lock_path) {
            let _ = remove_left(&self.socket);
            let _ = remove_left(&view_file(&self.socket));
            let _ = fs::remove_file(lock_path);
        }
    }
}

/// Locks a name; blocks for 2 s at most.
fn take_lock(path: &Path, run: &str) -> Result<File, RunDirError> {
    let mut pid = 0;
    for _ in 0..ATTEMPTS {
        match try_lock(path, run)? {
            Ok(file) => return Ok(file),
            Err(holder) => pid = holder,
        }
        std::thread::sleep(PAUSE);
    }
    Err(taken(run, pid))
}

/// Locks a name, or returns the pid of its holder.
fn try_lock(path: &Path, run: &str) -> Result<Result<File, u32>, RunDirError> {
    let failed = |error| RunDirError::Io { path: path.to_owned(), error };
    let mut file = match open_lock(path, true) {
        Ok(file) => file,
        Err(e) if fs::symlink_metadata(path).is_ok_and(|found| !found.is_file() || e.raw_os_error().is_none()) => {
            return Err(RunDirError::OtherFiles(path.to_owned()));
        }
        Err(error) => return Err(failed(error)),
    };
    match file.try_lock() {
        // Else its previous holder removed the file after we opened it.
        Ok(()) if is_at(&file, path) => {
            file.set_len(0).map_err(failed)?;
            use std::io::Seek;
            file.rewind().and_then(|()| write!(file, "{}", std::process::id())).map_err(failed)?;
            Ok(Ok(file))
        }
        Ok(()) => Ok(Err(0)),
        Err(TryLockError::WouldBlock) => Ok(Err(pid_in(&file))),
        Err(TryLockError::Error(error)) => {
            tracing::debug!("lock of {run}: {error}");
            Err(failed(error))
        }
    }
}

fn taken(run: &str, pid: u32) -> RunDirError {
    RunDirError::Taken { run: run.to_owned(), pid }
}

#[cfg(test)]
mod tests {
    use crate::run_dir::RunDir;

    #[test]
    fn nothing_is_made_again_once_the_name_is_released() {
        let folder = tempfile::tempdir().unwrap();
        let claim = RunDir::closed(folder.path().join("runs")).claim("cell").unwrap();
        let (files, socket) = (claim.files(), claim.socket());
        drop(files.bind().unwrap());
        assert!(files.restore().is_none(), "it is there");
        std::fs::remove_file(&socket).unwrap();
        drop(files.restore().unwrap());
        assert!(socket.exists());
        drop(claim);
        assert!(files.restore().is_none() && !socket.exists());
        assert_eq!(std::fs::read_dir(folder.path().join("runs")).unwrap().count(), 0);
    }
}
