//! Runs of other users: visible, because the kernel lists every socket, but not accessible.

use std::fmt;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use super::arguments::place;
use super::output;
use dimos_rpc::run_dir::{RunDir, check_name};
use dimos_rt::socket_list;

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

/// Prints where runs of this user may be that this process cannot see.
pub fn note_unseen(found_none: bool) {
    let Ok(seen) = RunDir::standard().seen() else { return };
    if place().is_some() {
        return;
    }
    if !seen.unseen.is_empty() {
        let pids: Vec<String> = seen.unseen.iter().map(ToString::to_string).collect();
        let pids = pids.join(", ");
        output::note(format_args!("note: runs in namespaces of other processes (pid {pids}) cannot be seen"));
    }
    // In a container that has the runs, this would be noise.
    if !seen.is_whole && found_none {
        output::note("note: runs outside of this container are not seen");
    }
}

/// Returns the live runs of all other users; empty if the system does not show them, and in a closed world.
pub fn runs() -> Vec<OtherRun> {
    if RunDir::standard().is_closed() || place().is_some() {
        return Vec::new();
    }
    let us = rustix::process::geteuid().as_raw();
    let sockets = socket_list::of("self").unwrap_or_default();
    let others = socket_list::listening(&sockets).filter_map(|socket| {
        let path = Path::new(socket.path);
        if let Some((user, name)) = marked(path) {
            return (user != us).then(|| OtherRun { name, user: dimos_rpc::server::who::user_name(user) });
        }
        let name = run_of(path)?;
        let user = owner(path).filter(|user| *user != us)?;
        Some(OtherRun { name, user: dimos_rpc::server::who::user_name(user) })
    });
    let mut others: Vec<OtherRun> = others.collect();
    others.sort();
    others.dedup();
    others
}

/// Returns user and name of a run, if a socket is its mark. The user is the one that the mark claims.
fn marked(path: &Path) -> Option<(u32, String)> {
    let (user, name) = path.to_str()?.strip_prefix("@dimos/run/")?.split_once('/')?;
    check_name(name).ok()?;
    Some((user.parse().ok()?, name.to_owned()))
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sockets_of_runs_are_recognized() {
        let run = |path: &str| run_of(Path::new(path));
        assert_eq!(run("/run/user/1001/dimos/cell-2.sock").as_deref(), Some("cell-2"));
        assert_eq!(run("/tmp/dimos-1001/cell.sock").as_deref(), Some("cell"));
        assert_eq!(run("/tmp/dimos-x/cell.sock"), None);
        assert_eq!(run("/run/user/1001/bus"), None);
        assert_eq!(run("@dimos/device/10.0.0.1:9760"), None);
        let mark = |path: &str| marked(Path::new(path));
        assert_eq!(mark("@dimos/run/1001/cell"), Some((1001, "cell".to_owned())));
        assert_eq!(mark("@dimos/run/1001@00000000000000ab/cell"), None, "a closed world");
        assert_eq!(dimos_rpc::server::who::user_name(0), "root");
    }
}
