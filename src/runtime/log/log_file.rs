//! Path, attachments and metadata of a run's log.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Duration;

use crate::blueprint::{Blueprint, Compression};
use crate::runtime::{Options, Record, StartError};
use dimos_control::config::CoordinatorConfig;
use dimos_core::clock::{Clock, MonotonicClock, WallOffset};
use dimos_core::message::Message;
use dimos_core::telemetry::describe::{Names, Severity};
use dimos_hardware::device;
use dimos_log::log_writer::LogAttachment;
use dimos_log::notes::Notes;
use dimos_log::recorder::Note;
use dimos_log::storage::{FaultLog, Storage};
use dimos_log::{CONFIG_VERSION_KEY, COORDINATOR, disk_space, files};

/// Returns the path of the log, if there is one. An error if the disk lacks space for it.
pub(in crate::runtime) fn log_path(
    blueprint: &Blueprint,
    options: &Options,
    run: &str,
    wall: WallOffset,
) -> Result<Option<PathBuf>, StartError> {
    let log = match &options.record {
        Record::Off | Record::Faults => None,
        Record::To(path) => Some(path.clone()),
        Record::AsBlueprint if !blueprint.recording.enabled => None,
        Record::AsBlueprint => {
            let folder = log_folder(blueprint).ok_or_else(|| {
                StartError::other("no folder for the log: neither XDG_STATE_HOME nor HOME is set", "use --record FILE")
            })?;
            Some(files::new_log_path(&folder, run, wall.wall(MonotonicClock.now())))
        }
    };
    if let Some(log) = &log {
        disk_space::check(log, blueprint.recording.min_free.0).map_err(no_log)?;
    }
    Ok(log)
}

fn log_folder(blueprint: &Blueprint) -> Option<PathBuf> {
    blueprint.recording.directory.as_ref().map(PathBuf::from).or_else(files::log_folder)
}

/// Returns how the blueprint wants logs to be stored.
pub(in crate::runtime) fn storage(blueprint: &Blueprint, options: &Options) -> Storage {
    let recording = &blueprint.recording;
    let time = |seconds: f64| (seconds > 0.0).then(|| Duration::from_secs_f64(seconds.min(1e9)));
    let folder = log_folder(blueprint).filter(|_| recording.fault_log && options.record != Record::Off);
    Storage {
        min_free: recording.min_free.0,
        compress: recording.compression == Compression::Zstd,
        sync_every: time(recording.sync_every),
        split_size: Some(recording.split_size.0).filter(|size| *size > 0).map(|size| size.max(1_000_000)),
        split_after: time(recording.split_after).map(|after| after.max(Duration::from_secs(1))),
        fault_log: folder.map(|folder| FaultLog { folder, keep: recording.keep as usize }),
    }
}

/// Removes the oldest logs beyond what the blueprint keeps.
pub(in crate::runtime) fn retain(blueprint: &Blueprint, log: &Option<PathBuf>) {
    let folder = log_folder(blueprint).filter(|f| log.as_deref().and_then(|l| l.parent()) == Some(f));
    if let (Some(folder), 1..) = (folder, blueprint.recording.keep)
        && let Err(e) = files::retain(&folder, blueprint.recording.keep as usize)
    {
        tracing::warn!("old logs were not removed: {e}");
    }
}

/// Returns the blueprint with its sources, and the coordinator's configuration: with these and its messages a log can
/// be replayed.
pub(in crate::runtime) fn attachments(blueprint: &Blueprint, config: &CoordinatorConfig) -> Vec<LogAttachment> {
    let yaml = |name: String, text: &str| LogAttachment {
        name,
        media_type: "application/yaml".to_owned(),
        data: text.as_bytes().to_vec(),
    };
    let mut all = vec![yaml("blueprint.yaml".to_owned(), &blueprint.source_yaml)];
    all.extend(blueprint.sources.iter().map(|(name, text)| yaml(format!("source/{name}"), text)));
    all.push(LogAttachment {
        name: COORDINATOR.to_owned(),
        media_type: "application/json".to_owned(),
        // Plain structs with string keys always encode.
        data: serde_json::to_vec_pretty(config).unwrap_or_default(),
    });
    all
}

/// Returns further metadata for readers of the log.
pub(in crate::runtime) fn metadata(blueprint: &Blueprint, config: &CoordinatorConfig) -> BTreeMap<String, String> {
    BTreeMap::from([
        ("blueprint".to_owned(), blueprint.name.clone()),
        ("tick_rate".to_owned(), blueprint.coordinator.tick_rate.to_string()),
        ("dimos_version".to_owned(), crate::VERSION.to_owned()),
        (CONFIG_VERSION_KEY.to_owned(), config.version.to_string()),
        ("simulated".to_owned(), blueprint.arms.iter().any(|arm| !arm.is_real()).to_string()),
    ])
}

/// Logs and records an episode of a device.
pub(in crate::runtime) fn log_device_note(notes: &Notes, names: &Names, arm: usize, note: device::Note) {
    let id = names.arm(arm as u16);
    let (severity, text) = match note {
        device::Note::Began(text) => (Severity::Warn, format!("{id}: {text}")),
        device::Note::Over(text) => (Severity::Info, format!("{id}: over: {text}")),
    };
    // One line per episode, without DIMOS_LOG=info.
    match severity {
        Severity::Info => tracing::info!("{text}"),
        _ => tracing::warn!("{text}"),
    }
    let stamp = MonotonicClock.now();
    // Without a recorder the run is shutting down.
    let _ = notes.send(Note::ArmText { arm: arm as u16, text: text.clone() });
    let _ = notes.send(Note::Log { severity, stamp, text });
}

/// Why there is no log.
pub(in crate::runtime) fn no_log(error: impl std::fmt::Display) -> StartError {
    let (what, hint) = Message::of(error).or_hint("run with --no-record");
    StartError::other(what, hint)
}
