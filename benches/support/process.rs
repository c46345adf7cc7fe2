//! The kernel's figures of another process: memory, and processor time per thread.

use std::collections::BTreeMap;
use std::fs;

/// Resident memory [MiB].
#[derive(Debug, Clone, Copy, Default)]
pub struct Memory {
    /// Current.
    pub now: f64,
    /// Peak.
    pub most: f64,
}

/// Returns the resident memory of a process.
pub fn memory(pid: u32) -> Memory {
    let status = fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
    let field = |name: &str| {
        let kib = status.lines().find_map(|l| l.strip_prefix(name))?.split_whitespace().next()?.parse::<f64>().ok()?;
        Some(kib / 1024.0)
    };
    Memory { now: field("VmRSS:").unwrap_or(f64::NAN), most: field("VmHWM:").unwrap_or(f64::NAN) }
}

/// Returns the processor time of each thread of a process [ns], by thread name.
pub fn threads(pid: u32) -> BTreeMap<String, u64> {
    let mut times = BTreeMap::new();
    for task in fs::read_dir(format!("/proc/{pid}/task")).into_iter().flatten().flatten() {
        let read = |file: &str| fs::read_to_string(task.path().join(file)).unwrap_or_default();
        let used = read("schedstat").split_whitespace().next().and_then(|ns| ns.parse::<u64>().ok());
        if let Some(ns) = used {
            *times.entry(read("comm").trim().to_owned()).or_default() += ns;
        }
    }
    times
}
