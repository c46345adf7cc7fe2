//! The kernel's list of unix sockets, `/proc/PID/net/unix`: all those in the network namespace of a process.

use std::fs;
use std::io;

/// Flag of a listening socket.
const LISTENING: &str = "00010000";

/// A listening socket.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Listening<'t> {
    /// Its inode.
    pub inode: &'t str,
    /// Its path, or `@` and the name of an abstract one.
    pub path: &'t str,
}

/// Returns the list of a process: its pid, or `self`. Other users' paths may be any bytes.
pub fn of(pid: &str) -> io::Result<String> {
    Ok(String::from_utf8_lossy(&fs::read(format!("/proc/{pid}/net/unix"))?).into_owned())
}

/// Returns the listening sockets of a list that have a path.
pub fn listening(list: &str) -> impl Iterator<Item = Listening<'_>> {
    list.lines().filter_map(|line| {
        // Num RefCount Protocol Flags Type St Inode Path
        let mut columns = line.split_ascii_whitespace();
        let (flags, inode) = (columns.nth(3)?, columns.nth(2)?);
        // The path may have spaces.
        let path = line.get(line.find(&format!(" {inode} "))? + inode.len() + 2..)?;
        (flags == LISTENING && path.starts_with(['/', '@'])).then_some(Listening { inode, path })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_listening_sockets_with_a_path_are_listed() {
        let line = |flags: &str, end: &str| format!("0000000000000000: 00000002 00000000 {flags} 0001 01 {end}\n");
        let list = "Num       RefCount Protocol Flags    Type St Inode Path\n".to_owned()
            + &line(LISTENING, "11 /run/my folder/a.sock")
            + &line(LISTENING, "12 @a")
            + &line("00000000", "13 /run/b.sock")
            + &line(LISTENING, "14");
        let found: Vec<_> = listening(&list).map(|socket| (socket.inode, socket.path)).collect();
        assert_eq!(found, [("11", "/run/my folder/a.sock"), ("12", "@a")]);
    }
}
