//! Files in a run directory. Anyone may have put something else there: nothing is opened that could block, nothing is
//! followed, and only what a run of this user left is believed or removed.

use std::fs::{self, DirBuilder, File, Metadata, OpenOptions, Permissions};
use std::io::{self, Read};
use std::os::unix::fs::{DirBuilderExt, FileTypeExt, MetadataExt, OpenOptionsExt, PermissionsExt};
use std::path::Path;

use rustix::fs::OFlags;

use crate::run_dir::RunDirError;

/// Maximum size of a run's lock, which has a pid, and of its file with a URL [bytes].
const MAX_SIZE: u64 = 512;
/// Maximum size of a lock [bytes].
const MAX_LOCK: u64 = 20;
/// Folders in a run directory.
pub(crate) const FOLDERS: [&str; 2] = ["planners", "relays"];

/// Returns whether a directory of this user is there; fails if something else is.
pub(crate) fn is_ours(folder: &Path) -> Result<bool, RunDirError> {
    match fs::symlink_metadata(folder) {
        Ok(found) if found.is_dir() && is_own(&found) => Ok(true),
        Ok(_) => Err(RunDirError::NotOurs(folder.to_owned())),
        Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(false),
        Err(error) => Err(RunDirError::Io { path: folder.to_owned(), error }),
    }
}

/// Creates a directory, accessible to this user only.
pub(crate) fn prepare(folder: &Path) -> Result<(), RunDirError> {
    let failed = |error| RunDirError::Io { path: folder.to_owned(), error };
    // Any user can create directories in <tmp>. The owner of this one could replace our socket.
    if !is_ours(folder)? {
        DirBuilder::new().recursive(true).mode(0o700).create(folder).map_err(failed)?;
        is_ours(folder)?;
    }
    let mode = fs::symlink_metadata(folder).map_err(failed)?.mode() & 0o777;
    if mode == 0o700 {
        return Ok(());
    }
    // Others have access. A folder with files of someone's project stays open to them.
    if mode & 0o077 != 0 {
        for entry in fs::read_dir(folder).map_err(failed)? {
            let path = entry.map_err(failed)?.path();
            let is_run_folder = FOLDERS.iter().any(|name| path.file_name().is_some_and(|found| found == *name));
            let is_of_run = match path.extension().and_then(|ending| ending.to_str()) {
                _ if is_run_folder => true,
                Some("lock") => open_lock(&path, false).is_ok(),
                Some("view" | "sock") => {
                    has_form(&path) && fs::symlink_metadata(&path).is_ok_and(|found| found.mode() & 0o077 == 0)
                }
                _ => false,
            };
            if !is_of_run {
                return Err(RunDirError::OtherFiles(path));
            }
        }
    }
    fs::set_permissions(folder, Permissions::from_mode(0o700)).map_err(failed)
}

/// Opens a run's lock: a file of this user with nothing but a pid.
pub(crate) fn open_lock(path: &Path, create: bool) -> io::Result<File> {
    let file = OpenOptions::new()
        .read(true)
        .write(create)
        .create(create)
        .mode(0o600)
        .custom_flags((OFlags::NOFOLLOW | OFlags::NONBLOCK).bits() as i32)
        .open(path)?;
    let found = file.metadata()?;
    let is_number = || {
        let mut text = String::new();
        (&file).take(MAX_LOCK).read_to_string(&mut text).is_ok() && text.trim().bytes().all(|b| b.is_ascii_digit())
    };
    // Without a link: its holder has just removed it, and the caller looks again.
    if found.is_file() && is_own(&found) && found.nlink() <= 1 && found.len() <= MAX_LOCK && is_number() {
        return Ok(file);
    }
    Err(io::Error::new(io::ErrorKind::AlreadyExists, "this is not the lock of a run of this user"))
}

/// Returns the pid in a lock; 0 while it has none.
pub(crate) fn pid_in(lock: &File) -> u32 {
    let mut bytes = [0; MAX_LOCK as usize];
    let read = std::os::unix::fs::FileExt::read_at(lock, &mut bytes, 0).unwrap_or(0);
    let text = bytes.get(..read).and_then(|bytes| std::str::from_utf8(bytes).ok());
    text.and_then(|text| text.trim().parse().ok()).unwrap_or(0)
}

/// Returns whether an open file still is the one at a path.
pub(crate) fn is_at(file: &File, path: &Path) -> bool {
    match (file.metadata(), fs::symlink_metadata(path)) {
        (Ok(a), Ok(b)) => id_of(&a) == id_of(&b),
        _ => false,
    }
}

/// Returns device and inode.
pub(crate) fn id_of(found: &Metadata) -> (u64, u64) {
    (found.dev(), found.ino())
}

/// Reads a small file of this user in a directory of this user; `None` if it is anything else.
pub(crate) fn read_text(path: &Path) -> Option<String> {
    is_ours(path.parent()?).ok().filter(|is_there| *is_there)?;
    let flags = OFlags::NOFOLLOW | OFlags::NONBLOCK;
    let file = OpenOptions::new().read(true).custom_flags(flags.bits() as i32).open(path).ok()?;
    let found = file.metadata().ok()?;
    let mut text = String::new();
    (found.is_file() && is_own(&found)).then(|| file.take(MAX_SIZE).read_to_string(&mut text).ok())??;
    Some(text)
}

/// Removes what a dead run left at the place of a socket, or of a file with a URL. Anything else there is an error.
pub(crate) fn remove_left(path: &Path) -> Result<(), RunDirError> {
    let failed = |error| RunDirError::Io { path: path.to_owned(), error };
    match fs::symlink_metadata(path) {
        Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(()),
        Err(error) => Err(failed(error)),
        Ok(_) if has_form(path) => fs::remove_file(path).map_err(failed),
        Ok(_) => Err(RunDirError::OtherFiles(path.to_owned())),
    }
}

/// Returns whether a file of this user has the form that its ending says: a socket, or a small file with nothing but
/// the URL of a page.
fn has_form(path: &Path) -> bool {
    let Ok(found) = fs::symlink_metadata(path) else { return false };
    match path.extension().is_some_and(|ending| ending == "sock") {
        true => is_own(&found) && found.file_type().is_socket(),
        // With the rights and the size of such a file: others may end in `.view`, too.
        false => {
            found.mode() & 0o077 == 0 && found.len() <= MAX_SIZE && read_text(path).is_some_and(|text| is_url(&text))
        }
    }
}

/// Returns whether a text is a URL as a run writes it, or what a full disk left of it: nothing.
fn is_url(text: &str) -> bool {
    text.is_empty()
        || text.starts_with("http://") && text.contains("/#") && text.trim().bytes().all(|b| b.is_ascii_graphic())
}

fn is_own(found: &Metadata) -> bool {
    found.uid() == rustix::process::geteuid().as_raw()
}
