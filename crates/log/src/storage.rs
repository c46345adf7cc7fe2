//! How logs are stored: compression, syncs, one file or several, and what is kept of a run without a log.

use std::path::PathBuf;
use std::time::Duration;

/// How the logs of a run are stored.
#[derive(Debug, Clone, PartialEq)]
pub struct Storage {
    /// Minimum free space on the disk; below it the log ends [bytes].
    pub min_free: u64,
    /// Whether chunks are compressed (zstd).
    pub compress: bool,
    /// Period of syncing the file to disk, against a loss of power; `None` leaves it to the kernel.
    pub sync_every: Option<Duration>,
    /// Size at which the log continues in another file [bytes].
    pub split_size: Option<u64>,
    /// Length at which the log continues in another file.
    pub split_after: Option<Duration>,
    /// The logs of faults, for a run that is not recorded.
    pub fault_log: Option<FaultLog>,
}

impl Default for Storage {
    fn default() -> Self {
        let sync_every = Some(Duration::from_secs(1));
        Self { min_free: 0, compress: true, sync_every, split_size: None, split_after: None, fault_log: None }
    }
}

/// Logs of faults.
#[derive(Debug, Clone, PartialEq)]
pub struct FaultLog {
    /// Their folder.
    pub folder: PathBuf,
    /// Number of logs to keep there; 0 = all.
    pub keep: usize,
}
