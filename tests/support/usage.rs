//! What a process uses, as its kernel counts it.

/// Memory [bytes], file descriptors, threads.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Usage {
    pub memory: u64,
    pub files: usize,
    pub threads: usize,
}

impl Usage {
    pub fn of_this_process() -> Self {
        Self::of("self")
    }

    /// Of a process by its number.
    pub fn of(process: &str) -> Self {
        let folder = std::path::Path::new("/proc").join(process);
        let status = std::fs::read_to_string(folder.join("status")).unwrap_or_default();
        let memory = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
        let kib = memory.and_then(|text| text.trim().trim_end_matches(" kB").parse::<u64>().ok()).unwrap_or(0);
        let count = |name: &str| std::fs::read_dir(folder.join(name)).map_or(0, Iterator::count);
        Self { memory: kib << 10, files: count("fd"), threads: count("task") }
    }
}
