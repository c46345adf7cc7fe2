//! Which files a log has: one, the further ones of a split log, or those of a folder. A file that should be there and
//! is not, or cannot be read, is one of them: what it had is missing.

use std::collections::BTreeMap;
use std::path::{Component, Path, PathBuf};

use mcap::parse_record;
use mcap::records::{Record, op};
use serde_yaml::Value;

use super::records::{RecordReader, ReplayError};
use super::{CONTINUES, PART, attachment, files};
use dimos_core::bounded;

/// A file of a log.
pub struct LogFile {
    /// Where it is, or should be.
    pub path: PathBuf,
    /// Why it cannot be read.
    pub wrong: Option<String>,
}

/// Metadata of a run.
type Metadata = BTreeMap<String, String>;

/// Returns the files of a log in order: of one in several files all of them, if it is named by the first or by its
/// folder.
///
/// # Errors
/// No file can be read, or the files of a folder are not one log.
pub fn of(path: &Path) -> Result<Vec<LogFile>, ReplayError> {
    if !path.is_dir() {
        return of_first(path);
    }
    let files = match named(path) {
        Some(named) => named.into_iter().map(of_bag).collect(),
        None => of_folder(path)?,
    };
    match files.iter().any(|file| file.wrong.is_none()) {
        true => Ok(files),
        // The error of its first file says why.
        false => {
            let first = files.first().map_or(path, |file| &file.path);
            RecordReader::open(first).map(|_| files)
        }
    }
}

/// Returns a file with those that continue it.
fn of_first(first: &Path) -> Result<Vec<LogFile>, ReplayError> {
    let own = metadata(&mut RecordReader::open(first)?)?;
    let mut found = vec![(0, readable(first))];
    if own.is_empty() || own.contains_key(PART) {
        return Ok(found.into_iter().map(|(_, file)| file).collect());
    }
    for (number, path) in files::numbered_parts(first) {
        match about(&path) {
            // It broke off before its metadata.
            Ok(next) if next.is_empty() && !is_closed(&path) => found.push((number, readable(&path))),
            Ok(next) if number_in(&next) == number && is_same_run(&own, &next) => found.push((number, readable(&path))),
            // Another log of such a name.
            Ok(_) => {}
            Err(wrong) => found.push((number, LogFile { path, wrong: Some(wrong) })),
        }
    }
    Ok(without_gaps(found))
}

/// Returns the files of a folder that no `metadata.yaml` describes: of one run, or of no run that is known.
fn of_folder(folder: &Path) -> Result<Vec<LogFile>, ReplayError> {
    let all = files::logs_in(folder).into_iter().map(|path| (about(&path), path));
    let all: Vec<(Result<Metadata, String>, PathBuf)> = all.collect();
    let Some((own, first)) = all.iter().find_map(|(about, path)| Some((about.as_ref().ok()?.clone(), path.clone())))
    else {
        return Ok(all.into_iter().map(|(about, path)| LogFile { path, wrong: about.err() }).collect());
    };
    let mut found: Vec<(u32, LogFile)> = Vec::new();
    for (about, path) in all {
        let number = match &about {
            Ok(next) => number_in(next),
            Err(_) => files::number_of(&path).unwrap_or(0),
        };
        let is_twice = !own.is_empty() && found.iter().any(|(known, _)| *known == number);
        if about.as_ref().is_ok_and(|next| is_twice || !is_same_run(&own, next)) {
            let what = format!("several logs: {} and {}", name(&first), name(&path));
            return Err(ReplayError::NotOneLog { path: folder.to_owned(), what });
        }
        found.push((number, LogFile { path, wrong: about.err() }));
    }
    if own.is_empty() {
        return Ok(found.into_iter().map(|(_, file)| file).collect());
    }
    found.sort_by_key(|(number, _)| *number);
    Ok(without_gaps(found))
}

/// Returns the files of a split log with an entry for those that are missing before, between and after them.
fn without_gaps(found: Vec<(u32, LogFile)>) -> Vec<LogFile> {
    let mut all: Vec<LogFile> = Vec::new();
    let mut next = 0;
    for (number, file) in found {
        if number > next {
            let first = match (all.first(), next) {
                (Some(first), _) => first.path.clone(),
                (None, _) => first_of(&file.path),
            };
            let of = |number| if number == 0 { first.clone() } else { files::part(&first, number) };
            let to = if number - next > 1 { format!(" to {}", name(&of(number - 1))) } else { String::new() };
            let path = of(next);
            let wrong = format!("{}{to} is missing: the log continues in {}", name(&path), name(&file.path));
            all.push(LogFile { path, wrong: Some(wrong) });
        }
        next = number.saturating_add(1);
        all.push(file);
    }
    if let Some(last) = all.last().filter(|last| last.wrong.is_none())
        && let Some(path) = next_of(&last.path, next)
    {
        let wrong = format!("{} is missing: {} ends there", name(&path), name(&last.path));
        all.push(LogFile { path, wrong: Some(wrong) });
    }
    all
}

/// Returns the first file of a log by the name of a further one.
fn first_of(part: &Path) -> PathBuf {
    let stem = part.file_stem().unwrap_or_default().to_string_lossy();
    part.with_file_name(format!("{}.mcap", stem.rsplit_once('_').map_or(&*stem, |(stem, _)| stem)))
}

/// Returns the path of the file in which a log continues after `last`, if that says so; `number` is its number. A file
/// under another name is a copy that a user made of one file.
pub fn next_of(last: &Path, number: u32) -> Option<PathBuf> {
    let next = match number {
        0 => return None,
        1 => files::part(last, 1),
        _ => files::part(&first_of(last), number),
    };
    let said = attachment::metadata(&mut RecordReader::open(last).ok()?, CONTINUES)?;
    (next.file_name()?.to_str()? == said.get(CONTINUES)?).then_some(next)
}

fn readable(path: &Path) -> LogFile {
    LogFile { path: path.to_owned(), wrong: None }
}

/// Returns a file that a `metadata.yaml` names.
fn of_bag(path: PathBuf) -> LogFile {
    let wrong = match path.exists() {
        true => RecordReader::open(&path).err().map(|e| reason(&path, &e)),
        false => Some(format!("{}, which metadata.yaml names, is missing", path.display())),
    };
    LogFile { path, wrong }
}

/// Returns the metadata of the run in a file, or why it cannot be read.
fn about(path: &Path) -> Result<Metadata, String> {
    RecordReader::open(path).and_then(|mut records| metadata(&mut records)).map_err(|e| reason(path, &e))
}

fn reason(path: &Path, error: &ReplayError) -> String {
    let why = match error {
        ReplayError::Io { source, .. } => format!("cannot be read: {source}"),
        _ if path.metadata().is_ok_and(|about| about.len() == 0) => "is empty".to_owned(),
        _ => "is not an MCAP file".to_owned(),
    };
    format!("{} {why}", name(path))
}

fn is_closed(path: &Path) -> bool {
    RecordReader::open(path).and_then(|mut records| records.summary_start()).is_ok_and(|start| start.is_some())
}

fn name(path: &Path) -> std::path::Display<'_> {
    Path::new(path.file_name().unwrap_or_default()).display()
}

fn number_in(metadata: &Metadata) -> u32 {
    metadata.get(PART).and_then(|number| number.parse().ok()).unwrap_or(0)
}

fn is_same_run(log: &Metadata, next: &Metadata) -> bool {
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
fn metadata(records: &mut RecordReader) -> Result<Metadata, ReplayError> {
    records.rewind()?;
    loop {
        let record = match records.next_record() {
            Ok(Some(record)) => record,
            Ok(None) | Err(ReplayError::Cut { .. }) => return Ok(Metadata::new()),
            Err(e) => return Err(e),
        };
        if matches!(record.opcode, op::CHUNK | op::MESSAGE) {
            return Ok(Metadata::new());
        }
        if let Ok(Record::Metadata(found)) = parse_record(record.opcode, &record.body)
            && found.name == "dimos"
        {
            return Ok(found.metadata);
        }
    }
}
