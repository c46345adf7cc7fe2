//! One program per device: a lock file by the device's canonical address, taken before a byte is sent, which dies
//! with the process.

use std::fs::{DirBuilder, File, OpenOptions, TryLockError};
use std::io::Write;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt};
use std::path::Path;

/// A device that is ours for as long as this lives.
#[derive(Debug)]
pub struct DeviceLock(#[expect(dead_code, reason = "the lock lasts as long as the file is open")] File);

/// Why a device is not ours.
#[derive(Debug, thiserror::Error)]
pub enum DeviceTaken {
    /// Another process has it.
    #[error("{adapter} at {address} is in use by process {pid}")]
    By {
        /// The adapter.
        adapter: String,
        /// The device's address.
        address: String,
        /// The process.
        pid: String,
    },
    /// The lock file cannot be made.
    #[error("cannot lock {adapter} at {address}: {error}")]
    Io {
        /// The adapter.
        adapter: String,
        /// The device's address.
        address: String,
        /// Why.
        error: std::io::Error,
    },
}

/// Takes a device, or says who has it. `folder` is the folder of the runs' sockets.
pub fn take(folder: &Path, adapter: &str, address: &str) -> Result<DeviceLock, DeviceTaken> {
    let io = |error| DeviceTaken::Io { adapter: adapter.into(), address: address.into(), error };
    DirBuilder::new().recursive(true).mode(0o700).create(folder).map_err(io)?;
    let plain = |c: char| if c.is_ascii_alphanumeric() || matches!(c, '.' | '-') { c } else { '_' };
    let name: String = canonical(address).chars().map(plain).collect();
    let path = folder.join(format!("device-{adapter}-{name}.held"));
    let mut file =
        OpenOptions::new().read(true).write(true).create(true).truncate(false).mode(0o600).open(path).map_err(io)?;
    match file.try_lock() {
        Ok(()) => {
            // The file stays when the lock is gone: removing it would let two processes lock two files.
            file.set_len(0).map_err(io)?;
            write!(file, "{}", std::process::id()).map_err(io)?;
            Ok(DeviceLock(file))
        }
        Err(TryLockError::WouldBlock) => {
            let pid = holder(&file).map_or_else(|| "unknown".to_owned(), |pid| pid.to_string());
            Err(DeviceTaken::By { adapter: adapter.into(), address: address.into(), pid })
        }
        Err(TryLockError::Error(error)) => Err(io(error)),
    }
}

/// Who holds a lock, by the kernel's own list: what stands in the file may not be written yet, or be of the last one.
fn holder(file: &File) -> Option<u32> {
    let inode = file.metadata().ok()?.ino().to_string();
    let locks = std::fs::read_to_string("/proc/locks").ok()?;
    // 1: FLOCK  ADVISORY  WRITE 4242 00:2e:1234 0 EOF
    let of_file = |line: &&str| line.split_whitespace().nth(5).and_then(|f| f.rsplit(':').next()) == Some(&inode);
    let line = locks.lines().filter(|line| line.contains(" FLOCK ")).find(of_file)?;
    line.split_whitespace().nth(4)?.parse().ok()
}

/// The same device under another spelling: case, a name for the loopback, a leading zero in the port.
fn canonical(address: &str) -> String {
    let address = address.trim().to_ascii_lowercase().replace("localhost", "127.0.0.1");
    match address.rsplit_once(':') {
        Some((host, port)) => match port.parse::<u16>() {
            Ok(port) => format!("{host}:{port}"),
            Err(_) => address,
        },
        None => address,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn f29_a_device_is_taken_once_and_names_the_holder() {
        let folder = tempfile::tempdir().unwrap();
        let held = take(folder.path(), "yourarm", "LOCALHOST:9760").unwrap();
        let refused = take(folder.path(), "yourarm", "127.0.0.1:9760").unwrap_err().to_string();
        assert!(refused.contains(&std::process::id().to_string()), "{refused}");
        assert!(take(folder.path(), "yourarm", "127.0.0.2:9760").is_ok());
        drop(held);
        assert!(take(folder.path(), "yourarm", "127.0.0.1:9760").is_ok());
    }
}
