//! Which files a log has: one, the further ones of a split log, or those of a folder.

use std::collections::BTreeMap;
use std::path::{Component, Path, PathBuf};

use mcap::parse_record;
use mcap::records::{Record, op};
use serde_yaml::Value;

use super::records::{RecordReader, ReplayError};
use super::{PART, files};
use crate::bounded;

/// The files of a log, in order.
pub struct Files {
    /// Files that exist.
    pub files: Vec<PathBuf>,
    /// Files that a folder's `metadata.yaml` names, and that are missing.
    pub missing: Vec<PathBuf>,
}

/// Returns the files of a log: of one in several files all of them, if it is named by the first or by its folder.
pub fn of(path: &Path) -> Result<Files, ReplayError> {
    let is_dir = path.is_dir();
    if let Some(named) = is_dir.then(|| named(path)).flatten() {
        let (files, missing) = named.into_iter().partition(|path| path.exists());
        return Ok(Files { files, missing });
    }
    let all = if is_dir { files::logs_in(path) } else { Vec::new() };
    let first = all.first().map_or(path, PathBuf::as_path);
    let mut files = vec![first.to_owned()];
    let own = metadata(&mut RecordReader::open(first)?)?;
    if !own.contains_key(PART) {
        for (part, number) in files::further_parts(first).zip(1u32..) {
            let next = metadata(&mut RecordReader::open(&part)?)?;
            if next.get(PART) != Some(&number.to_string()) || !is_same_run(&own, &next) {
                break;
            }
            files.push(part);
        }
    }
    for other in &all {
        if files.contains(other) {
            continue;
        }
        let next = metadata(&mut RecordReader::open(other)?)?;
        if !is_same_run(&own, &next) || !own.is_empty() {
            let what = format!("several logs: {} and {}", name(first), name(other));
            return Err(ReplayError::NotOneLog { path: path.to_owned(), what });
        }
        files.push(other.clone());
    }
    Ok(Files { files, missing: Vec::new() })
}

fn name(path: &Path) -> std::path::Display<'_> {
    Path::new(path.file_name().unwrap_or_default()).display()
}

fn is_same_run(log: &BTreeMap<String, String>, next: &BTreeMap<String, String>) -> bool {
    ["wall_offset_ns", "run"].iter().all(|key| log.get(*key) == next.get(*key))
}

/// Returns the files that the `metadata.yaml` of a rosbag2 folder names.
fn named(folder: &Path) -> Option<Vec<PathBuf>> {
    let text = bounded::read_text(&folder.join("metadata.yaml"), bounded::LARGE).ok()?;
    let value: Value = serde_yaml::from_str(&text).ok()?;
    let list = value.get("rosbag2_bagfile_information")?.get("relative_file_paths")?.as_sequence()?;
    let inside = |name: &Path| name.components().all(|part| matches!(part, Component::Normal(_) | Component::CurDir));
    let paths = list.iter().filter_map(Value::as_str).map(Path::new).filter(|name| inside(name));
    let paths: Vec<PathBuf> = paths.map(|name| folder.join(name)).collect();
    (!paths.is_empty()).then_some(paths)
}

/// Reads the run's metadata, stored before the first message.
fn metadata(records: &mut RecordReader) -> Result<BTreeMap<String, String>, ReplayError> {
    records.rewind()?;
    loop {
        let record = match records.next_record() {
            Ok(Some(record)) => record,
            Ok(None) | Err(ReplayError::Cut { .. }) => return Ok(BTreeMap::new()),
            Err(e) => return Err(e),
        };
        if matches!(record.opcode, op::CHUNK | op::MESSAGE) {
            return Ok(BTreeMap::new());
        }
        if let Ok(Record::Metadata(found)) = parse_record(record.opcode, &record.body)
            && found.name == "dimos"
        {
            return Ok(found.metadata);
        }
    }
}
