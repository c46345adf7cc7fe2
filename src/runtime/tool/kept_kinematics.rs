//! Factory kinematics of arms that were connected once, in `$XDG_STATE_HOME/dimos/kinematics/ADAPTER-SERIAL.json`: for
//! planners that run without the arm.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use serde::{Deserialize, Serialize};

use dimos_core::arm::FactoryKinematics;
use dimos_core::bounded;
use dimos_log::files::log_folder;

/// Kinematics of one arm, as they are kept.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct KeptKinematics {
    /// The adapter's name.
    pub adapter: String,
    /// Address at which the arm was connected.
    pub address: String,
    /// The arm's serial number.
    pub serial: String,
    /// The kinematics.
    #[serde(flatten)]
    pub kinematics: FactoryKinematics,
}

impl KeptKinematics {
    /// Returns it as the text of a file.
    pub fn to_text(&self) -> String {
        serde_json::to_string_pretty(self).unwrap_or_default() + "\n"
    }
}

/// Returns the folder: beside the logs; `None` without a home.
pub fn folder() -> Option<PathBuf> {
    Some(log_folder()?.join("kinematics"))
}

/// Keeps kinematics in a folder, in place of older ones of the same arm. The time of the file says which arm of an
/// address was connected last.
pub(in crate::runtime) fn keep(folder: &Path, kept: &KeptKinematics) -> io::Result<()> {
    let name = format!("{}-{}.json", kept.adapter, kept.serial);
    // A serial number is text of the device: it names no other folder.
    if !name.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"-_.".contains(&byte)) {
        return Err(io::Error::new(io::ErrorKind::InvalidInput, format!("the serial number {:?}", kept.serial)));
    }
    let (path, text) = (folder.join(&name), kept.to_text());
    fs::create_dir_all(folder)?;
    let new = folder.join(format!("{name}.{}", std::process::id()));
    fs::write(&new, text)?;
    fs::rename(&new, &path)
}

/// Returns the kinematics of an arm that was connected before.
pub fn of_serial(adapter: &str, serial: &str) -> Option<KeptKinematics> {
    let text = bounded::read_text(&folder()?.join(format!("{adapter}-{serial}.json")), bounded::SMALL).ok()?;
    serde_json::from_str(&text).ok().filter(|kept: &KeptKinematics| kept.adapter == adapter && kept.serial == serial)
}

/// Finds the kinematics of the arm that was last connected at an address with an adapter.
pub(in crate::runtime) fn find(folder: &Path, adapter: &str, address: &str) -> Option<KeptKinematics> {
    let read = |entry: io::Result<fs::DirEntry>| -> Option<(SystemTime, KeptKinematics)> {
        let entry = entry.ok().filter(|entry| entry.path().extension().is_some_and(|ending| ending == "json"))?;
        let kept: KeptKinematics =
            serde_json::from_str(&bounded::read_text(&entry.path(), bounded::SMALL).ok()?).ok()?;
        (kept.adapter == adapter && kept.address == address).then_some(())?;
        Some((entry.metadata().and_then(|about| about.modified()).unwrap_or(SystemTime::UNIX_EPOCH), kept))
    };
    fs::read_dir(folder).ok()?.filter_map(read).max_by_key(|(at, _)| *at).map(|(_, kept)| kept)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kinematics_are_kept_by_serial_number_and_found_by_address() {
        let folder = tempfile::tempdir().unwrap();
        let folder = folder.path().join("kinematics");
        let kept = |serial: &str, address: &str, checksum: &str| KeptKinematics {
            adapter: "ur".into(),
            address: address.into(),
            serial: serial.into(),
            kinematics: FactoryKinematics { checksum: checksum.into(), ..Default::default() },
        };
        assert_eq!(find(&folder, "ur", "10.0.0.1"), None);
        keep(&folder, &kept("1", "10.0.0.1", "a")).unwrap();
        keep(&folder, &kept("2", "10.0.0.2", "b")).unwrap();
        keep(&folder, &kept("1", "10.0.0.1", "c")).unwrap();
        assert_eq!(find(&folder, "ur", "10.0.0.1"), Some(kept("1", "10.0.0.1", "c")), "calibrated again");
        assert_eq!(find(&folder, "ur", "10.0.0.2"), Some(kept("2", "10.0.0.2", "b")));
        assert_eq!(find(&folder, "xarm", "10.0.0.2"), None);
        for serial in ["3", "1"] {
            std::thread::sleep(std::time::Duration::from_millis(20));
            keep(&folder, &kept(serial, "10.0.0.1", "c")).unwrap();
            assert_eq!(find(&folder, "ur", "10.0.0.1").unwrap().serial, serial, "the last one there");
        }
        assert_eq!(fs::read_dir(&folder).unwrap().count(), 3, "one file an arm, and no others");
        assert!(keep(&folder, &kept("../1", "10.0.0.1", "a")).is_err());
    }
}
