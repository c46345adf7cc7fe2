//! Runs that the kernel lists by their marks in `/proc/net/unix`: here, and in the network namespaces of other
//! processes of this user. What the list says is checked by the credentials of the process that listens.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use rustix::io::Errno;
use rustix::net::SocketAddrUnix;

use crate::run_dir::{LiveRun, Seen, check_name};
use dimos_rt::abstract_name::{self, Peer, holder};
use dimos_rt::socket_list::{self, listening};

/// Inode of the first pid namespace of a computer.
const FIRST_PIDS: u64 = 0xEFFF_FFFC;
/// Returns the runs with marks in this network namespace.
pub(crate) fn here(prefix: &str) -> io::Result<Vec<LiveRun>> {
    let us = rustix::process::geteuid().as_raw();
    let table = socket_list::of("self")?;
    let of_mark = |(_, name): (&str, String)| {
        let socket = format!("@{prefix}{name}");
        match holder(&format!("{prefix}{name}")) {
            Ok(peer) if peer.uid == us => {
                let socket = path_in(&table, &name, peer).unwrap_or_else(|| socket.into());
                Some(LiveRun { name, pid: peer.pid, socket, at: None })
            }
            // Another user holds it: no run of this one.
            Ok(_) => None,
            // It is there, and does not answer.
            Err(Errno::AGAIN) => Some(LiveRun { name, pid: 0, socket: socket.into(), at: None }),
            Err(_) => None,
        }
    };
    let mut runs: Vec<LiveRun> = marks(&table, prefix).filter_map(of_mark).collect();
    runs.dedup_by(|a, b| a.name == b.name);
    Ok(runs)
}

/// Returns the path at which the process with this mark listens.
pub(crate) fn path_of(mark: &str) -> Option<PathBuf> {
    let (table, name) = (socket_list::of("self").ok()?, mark.rsplit('/').next()?);
    path_in(&table, name, holder(mark).ok()?)
}

fn path_in(table: &str, run: &str, process: Peer) -> Option<PathBuf> {
    paths(table, run).map(PathBuf::from).find(|path| peer_at(path).is_some_and(|found| found == process))
}

/// Returns whether the process of a run has a mark of its name in another world.
pub(crate) fn is_of_other_world(prefix: &str, run: &LiveRun) -> bool {
    // `dimos/run/1000/` and `dimos/run/1000@0123456789abcdef/`.
    let user = prefix.split(['@']).next().unwrap_or(prefix).trim_end_matches('/');
    let table = socket_list::of("self").unwrap_or_default();
    let other = listening(&table).filter_map(|row| {
        let mark = row.path.strip_prefix('@')?;
        let (world, name) = mark.strip_prefix(user)?.split_once('/')?;
        let is_world = world.is_empty() || world.starts_with('@');
        (is_world && name == run.name && mark != format!("{prefix}{name}")).then_some(mark)
    });
    { other }.any(|mark| holder(mark).is_ok_and(|peer| peer.pid == run.pid))
}

/// Returns the runs with marks in the network namespaces of other processes of this user.
pub(crate) fn elsewhere(prefix: &str) -> Seen {
    let us = rustix::process::geteuid().as_raw();
    let namespace = |pid: &str| fs::metadata(format!("/proc/{pid}/ns/net")).ok().map(|found| found.ino());
    let (own, own_table) = (namespace("self"), socket_list::of("self").unwrap_or_default());
    let mut known: BTreeSet<String> = listening(&own_table).map(|row| row.inode.to_owned()).collect();
    let mut seen = Seen { is_whole: is_first_pid_namespace(), ..Seen::default() };
    let mut by_namespace: BTreeMap<Option<u64>, Vec<u32>> = BTreeMap::new();
    for pid in processes().filter(|pid| user_of(*pid) == Some(us)) {
        match namespace(&pid.to_string()) {
            found if found.is_some() && found == own => {}
            found => by_namespace.entry(found).or_default().push(pid),
        }
    }
    for (namespace, pids) in by_namespace {
        let mut refused = Vec::new();
        for pid in &pids {
            let Ok(table) = socket_list::of(&pid.to_string()) else {
                // A process that has ended since hides nothing.
                refused.extend(user_of(*pid).map(|_| *pid));
                continue;
            };
            for (inode, name) in marks(&table, prefix) {
                if known.insert(inode.to_owned()) {
                    seen.runs.push(far_run(&table, name, &pids, us));
                }
            }
            // One list shows the whole namespace. Without a number each process may be in another one.
            if namespace.is_some() {
                refused.clear();
                break;
            }
        }
        seen.unseen.extend(refused);
    }
    seen
}

/// Returns a run in another network namespace, with a path to its socket if there is one from here.
fn far_run(table: &str, name: String, pids: &[u32], us: u32) -> LiveRun {
    let through = |path: &str| {
        let of_process = pids.iter().map(move |pid| PathBuf::from(format!("/proc/{pid}/root{path}")));
        of_process.chain([PathBuf::from(path)]).collect::<Vec<_>>()
    };
    let reached = paths(table, &name).flat_map(through).find_map(|path| {
        let peer = peer_at(&path).filter(|peer| peer.uid == us)?;
        // A run of this namespace may have the same path.
        let is_there = peer.pid == 0 || pids.contains(&peer.pid);
        is_there.then_some((path, peer.pid))
    });
    let (socket, pid) = reached.unwrap_or_else(|| {
        let is_dimos = |pid: &&u32| fs::read_to_string(format!("/proc/{pid}/comm")).is_ok_and(|name| name == "dimos\n");
        let mut of_dimos = pids.iter().filter(is_dimos);
        let only = of_dimos.next().filter(|_| of_dimos.next().is_none());
        let pid = only.or(pids.first()).copied().unwrap_or(0);
        let path = paths(table, &name).next().unwrap_or_default();
        (format!("/proc/{pid}/root{path}").into(), if only.is_some() { pid } else { 0 })
    });
    LiveRun { name, pid, socket, at: None }
}

/// Returns inode and run name of each mark in a list.
fn marks<'t>(table: &'t str, prefix: &str) -> impl Iterator<Item = (&'t str, String)> {
    listening(table).filter_map(move |row| {
        let name = row.path.strip_prefix('@')?.strip_prefix(prefix)?;
        check_name(name).ok()?;
        Some((row.inode, name.to_owned()))
    })
}

/// Returns the paths of sockets in a list that a run of this name may have.
fn paths<'t>(table: &'t str, run: &str) -> impl Iterator<Item = &'t str> {
    let ending = format!("/{run}.sock");
    listening(table).map(|row| row.path).filter(move |path| path.starts_with('/') && path.ends_with(&ending))
}

/// Returns the process that listens at a path.
fn peer_at(path: &Path) -> Option<Peer> {
    let stream = abstract_name::open(&SocketAddrUnix::new(path).ok()?).ok()?;
    abstract_name::peer(stream).ok()
}

/// Returns the processes that this one sees.
fn processes() -> impl Iterator<Item = u32> {
    let entries = fs::read_dir("/proc").into_iter().flatten().flatten();
    entries.filter_map(|entry| entry.file_name().to_str()?.parse().ok())
}

/// Returns the effective user of a process, also of one that may not be traced; `None` if it has ended or is a zombie,
/// which has no namespaces.
fn user_of(pid: u32) -> Option<u32> {
    let status = fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
    let state = status.lines().find_map(|line| line.strip_prefix("State:"))?.trim_start();
    if state.starts_with(['Z', 'X']) {
        return None;
    }
    let users = status.lines().find_map(|line| line.strip_prefix("Uid:"))?;
    users.split_ascii_whitespace().nth(1)?.parse().ok()
}

/// Returns whether this process sees all processes of this computer. In a container it does not.
fn is_first_pid_namespace() -> bool {
    fs::metadata("/proc/self/ns/pid").is_ok_and(|found| found.ino() == FIRST_PIDS)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn marks_and_paths_are_read_from_the_list() {
        let line = |flags: &str, inode: u32, path: &str| {
            format!("0000000000000000: 00000002 00000000 {flags} 0001 01 {inode} {path}\n")
        };
        let table = "Num       RefCount Protocol Flags    Type St Inode Path\n".to_owned()
            + &line("00010000", 11, "@dimos/run/1000/cell")
            + &line("00010000", 12, "@dimos/run/1000@00000000000000ab/cell")
            + &line("00010000", 13, "@dimos/run/1000/../evil")
            + &line("00000000", 14, "@dimos/run/1000/cell")
            + &line("00010000", 15, "/run/user/1000/my dimos/cell.sock")
            + &line("00010000", 16, "@/x/cell.sock");
        let marked: Vec<_> = marks(&table, "dimos/run/1000/").collect();
        assert_eq!(marked, [("11", "cell".to_owned())]);
        assert_eq!(paths(&table, "cell").collect::<Vec<_>>(), ["/run/user/1000/my dimos/cell.sock"]);
    }

    #[test]
    fn a_process_is_found_with_its_user() {
        let us = std::process::id();
        assert!(processes().any(|pid| pid == us));
        assert_eq!(user_of(us), Some(rustix::process::geteuid().as_raw()));
        assert_eq!(user_of(u32::MAX), None);
    }
}
