//! Two computers joined by a cable: network namespaces with a veth pair, which the test makes and removes.

use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};

use super::program::Home;
use super::skip::skip;

/// Address of the cell's computer.
pub const CELL: &str = "10.77.0.1";
/// Address of the other one.
const LAPTOP: &str = "10.77.0.2";

/// The cable; removed with both namespaces when dropped.
pub struct Cable {
    id: String,
}

/// An end of a cable.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum End {
    Cell,
    Laptop,
}

impl Cable {
    /// Lays a cable; nothing where this user may not, with a note.
    #[track_caller]
    pub fn lay() -> Option<Self> {
        static NUMBER: AtomicU32 = AtomicU32::new(0);
        let id = format!("{}{}", std::process::id(), NUMBER.fetch_add(1, Ordering::Relaxed));
        let cable = Self { id };
        let (cell, laptop) = (cable.name(End::Cell), cable.name(End::Laptop));
        let is_root = rustix::process::geteuid().is_root();
        if !is_root || !ip(&format!("netns add {cell}")) || !ip(&format!("netns add {laptop}")) {
            skip("ip netns, as root (make test-tools)");
            return None;
        }
        let (a, b) = (cable.link(End::Cell), cable.link(End::Laptop));
        if !ip(&format!("link add {a} netns {cell} type veth peer name {b} netns {laptop}")) {
            skip("a kernel with veth");
            return None;
        }
        for (end, address) in [(End::Cell, CELL), (End::Laptop, LAPTOP)] {
            let (name, link) = (cable.name(end), cable.link(end));
            assert!(ip(&format!("-n {name} addr add {address}/24 dev {link}")));
            assert!(ip(&format!("-n {name} link set lo up")));
            cable.plug(end);
        }
        Some(cable)
    }

    fn name(&self, end: End) -> String {
        format!("dimos-{}-{end:?}", self.id).to_lowercase()
    }

    /// At most 15 characters.
    fn link(&self, end: End) -> String {
        let side = if end == End::Cell { 'c' } else { 'l' };
        format!("dv{side}{}", self.id.chars().rev().take(10).collect::<String>())
    }

    pub fn pull(&self, end: End) {
        assert!(ip(&format!("-n {} link set {} down", self.name(end), self.link(end))));
    }

    pub fn plug(&self, end: End) {
        assert!(ip(&format!("-n {} link set {} up", self.name(end), self.link(end))));
    }

    /// A verb on one of the computers, with the folders of `home`.
    pub fn command(&self, home: &Home, end: End, arguments: &str) -> Command {
        let mut command = Command::new("ip");
        command.args(["netns", "exec", &self.name(end), env!("CARGO_BIN_EXE_dimos")]);
        home.settle(command.args(arguments.split_whitespace()).stdin(Stdio::null()));
        command
    }
}

impl Drop for Cable {
    fn drop(&mut self) {
        // The veth pair goes with its namespaces.
        for end in [End::Cell, End::Laptop] {
            ip(&format!("netns del {}", self.name(end)));
        }
    }
}

fn ip(arguments: &str) -> bool {
    let mut command = Command::new("ip");
    let done = command.args(arguments.split_whitespace()).stdout(Stdio::null()).stderr(Stdio::null()).status();
    done.is_ok_and(|status| status.success())
}
