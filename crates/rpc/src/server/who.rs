//! Who is at the other end of a connection, from what the kernel knows of it.

use std::collections::BTreeMap;
use std::sync::OnceLock;

use tokio::net::UnixStream;

use dimos_core::telemetry::Who;

/// Name of the program where a page of the live view commands the arm.
const LIVE_VIEW: &str = "a page of the live view";

/// The process at the other end of a connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Peer {
    /// Its id, if the system reports it.
    pub pid: Option<i32>,
    /// Its user, if the system reports it.
    pub uid: Option<u32>,
}

impl Peer {
    /// Asks the kernel.
    pub fn of(stream: &UnixStream) -> Self {
        stream.peer_cred().map_or_else(|_| Self::default(), |peer| Self { pid: peer.pid(), uid: Some(peer.uid()) })
    }

    /// Returns who that is.
    pub fn who(&self) -> Who {
        Who { program: program(self.pid), pid: self.pid, user: self.uid.map(user_name) }
    }

    /// The same without the command line, which the kernel may keep waiting for: a stop never waits.
    pub fn at_once(&self, verb: &str) -> Who {
        let name = self.pid.and_then(|pid| std::fs::read_to_string(format!("/proc/{pid}/comm")).ok());
        let name = name.map(|name| printable(name.trim())).filter(|name| !name.is_empty());
        let program = match name {
            Some(name) if name == "dimos" => format!("dimos {verb}"),
            name => name.unwrap_or_else(|| "another program".to_owned()),
        };
        Who { program, pid: self.pid, user: self.uid.map(user_name) }
    }
}

/// Returns the name of a process from its command line: `dimos move`, `python3 policy.py`.
fn program(pid: Option<i32>) -> String {
    let read = |pid: i32| std::fs::read(format!("/proc/{pid}/cmdline")).ok();
    let line = pid.and_then(read).unwrap_or_default();
    let words = line.split(|byte| *byte == 0).map(String::from_utf8_lossy).filter(|word| !word.is_empty());
    let mut name = String::new();
    for word in words.take(2).take_while(|word| !word.starts_with('-')) {
        let word: String = word.rsplit('/').next().unwrap_or_default().chars().take(40).collect();
        name = if name.is_empty() { word } else { format!("{name} {word}") };
    }
    // Of `dimos run`, whether it is this run or a planner that is attached to it, only the live view commands arms.
    if name == "dimos run" {
        return LIVE_VIEW.to_owned();
    }
    let name = printable(&name);
    if name.is_empty() { "another program".to_owned() } else { name }
}

/// Other users' terminals show the name.
fn printable(name: &str) -> String {
    name.chars().filter(|c| !c.is_control()).collect()
}

/// Returns the name of a user, or its number. The names are read once: see [`read_users`].
pub fn user_name(uid: u32) -> String {
    users().get(&uid).cloned().unwrap_or_else(|| uid.to_string())
}

/// Reads the names of users: before the first stop, which never waits for a disk.
pub(crate) fn read_users() {
    users();
}

fn users() -> &'static BTreeMap<u32, String> {
    static USERS: OnceLock<BTreeMap<u32, String>> = OnceLock::new();
    USERS.get_or_init(|| {
        let text = std::fs::read_to_string("/etc/passwd").unwrap_or_default();
        let user = |line: &str| {
            let mut fields = line.split(':');
            let (name, number) = (fields.next()?, fields.nth(1)?);
            Some((number.parse().ok()?, name.to_owned()))
        };
        text.lines().rev().filter_map(user).collect()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_program_is_named_by_its_command_line() {
        let own = Peer { pid: Some(std::process::id() as i32), uid: Some(0) };
        let (mine, at_once) = (own.who(), own.at_once("stop"));
        assert!(mine.program.starts_with("dimos") && at_once.program.starts_with("dimos"), "{mine} {at_once}");
        assert_eq!(mine.to_string(), format!("{} (pid {}, user root)", mine.program, std::process::id()));
        for pid in [None, Some(-5)] {
            let nobody = Peer { pid, uid: None };
            assert_eq!(
                (nobody.who().program, nobody.at_once("stop").program),
                ("another program".into(), "another program".into())
            );
        }
        assert_eq!(user_name(4_000_000_000), "4000000000");
    }
}
