//! Processes that only use up the computer.

use std::process::{Child, Command, Stdio};

/// Busy processes. They end when this is dropped.
pub struct Busy(Vec<Child>);

impl Busy {
    /// Starts this number of processes.
    pub fn start(count: usize) -> Self {
        let one = |_| {
            let mut shell = Command::new("sh");
            shell.args(["-c", "while :; do :; done"]).stdin(Stdio::null()).stdout(Stdio::null());
            shell.spawn().unwrap()
        };
        Self((0..count).map(one).collect())
    }
}

impl Drop for Busy {
    fn drop(&mut self) {
        for child in &mut self.0 {
            let _ = (child.kill(), child.wait());
        }
    }
}
