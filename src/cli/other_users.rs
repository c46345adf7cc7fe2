//! Runs of other users: visible, because the kernel lists every socket, but not accessible.

use std::fmt;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

/// The kernel's list of sockets.
const SOCKETS: &str = "/proc/net/unix";
/// Flag of a listening socket in that list.
const LISTENING: &str = "00010000";

/// A live run of another user.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct OtherRun {
    /// Name.
    pub name: String,
    /// The user's name, or number if there is no name.
    pub user: String,
}

impl fmt::Display for OtherRun {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} of user {}", self.name, self.user)
    }
}

/// Returns the live runs of all other users; empty if the system does not show them.
pub fn runs() -> Vec<OtherRun> {
    let us = rustix::process::geteuid().as_raw();
    let sockets = std::fs::read_to_string(SOCKETS).unwrap_or_default();
    let others = sockets.lines().filter_map(listening).filter_map(|path| {
        let name = run_of(&path)?;
        let user = owner(&path).filter(|user| *user != us)?;
        Some(OtherRun { name, user: user_name(user) })
    });
    let mut others: Vec<OtherRun> = others.collect();
    others.sort();
    others.dedup();
    others
}

/// Returns the path of a listening socket, from a line of the list.
fn listening(line: &str) -> Option<PathBuf> {
    // Num RefCount Protocol Flags Type St Inode Path
    let mut columns = line.split_ascii_whitespace();
    let flags = columns.nth(3)?;
    let path = columns.nth(3)?;
    (flags == LISTENING && path.starts_with('/')).then(|| PathBuf::from(path))
}

/// Returns the run's name, if a socket belongs to a run.
fn run_of(path: &Path) -> Option<String> {
    let folder = path.parent()?.file_name()?.to_str()?;
    let ours = folder == "dimos" || folder.strip_prefix("dimos-").is_some_and(|uid| uid.parse::<u32>().is_ok());
    let is_run = ours && path.extension().is_some_and(|extension| extension == "sock");
    is_run.then(|| path.file_stem()?.to_str().map(str::to_owned)).flatten()
}

/// Returns the owner of a path, as far as visible: others see a closed folder, but not its contents.
fn owner(path: &Path) -> Option<u32> {
    path.ancestors().find_map(|visible| std::fs::symlink_metadata(visible).ok()).map(|found| found.uid())
}

fn user_name(uid: u32) -> String {
    let users = std::fs::read_to_string("/etc/passwd").unwrap_or_default();
    let name = users.lines().find_map(|line| {
        let mut fields = line.split(':');
        let (name, number) = (fields.next()?, fields.nth(1)?);
        (number.parse() == Ok(uid)).then(|| name.to_owned())
    });
    name.unwrap_or_else(|| uid.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sockets_of_runs_are_recognized() {
        let line =
            |flags: &str, path: &str| format!("0000000000000000: 00000002 00000000 {flags} 0001 01 47110 {path}");
        let run = |path: &str| listening(&line(LISTENING, path)).and_then(|path| run_of(&path));
        assert_eq!(run("/run/user/1001/dimos/cell-2.sock").as_deref(), Some("cell-2"));
        assert_eq!(run("/tmp/dimos-1001/cell.sock").as_deref(), Some("cell"));
        assert_eq!(run("/tmp/dimos-x/cell.sock"), None);
        assert_eq!(run("/run/user/1001/bus"), None);
        assert_eq!(run("@dimos/device/yourarm/10.0.0.1:9760"), None);
        assert_eq!(listening(&line("00000000", "/run/user/1001/dimos/cell.sock")), None);
        assert_eq!(listening("Num RefCount Protocol Flags Type St Inode Path"), None);
        assert_eq!(user_name(0), "root");
    }
}
