//! `dimos log export`: joint values as CSV or Parquet, or the messages of a topic as CSV.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use serde_json::{Value, json};

use super::python_writer::PythonWriter;
use super::{Part, STATES, ended, no_states, progress, unreadable, written};
use crate::cli::escapes::safe;
use crate::cli::exit::{Exit, Failure, Result};
use crate::cli::output;
use dimos_log::joints::{Places, twice};
use dimos_log::messages::JointState;
use dimos_log::replay::{Entry, LogReader, Payload, ReplayError, Selection};
use dimos_log::scan::{Item, Scan};

/// Exports a log as text.
pub fn csv(path: &Path, part: &Part, topic: Option<&str>, to: Option<&Path>, json: bool) -> Result {
    let (from, until) = part.of(path)?;
    let began = from.saturating_sub(part.from.as_nanos() as u64);
    let mut out: Box<dyn Write> = match to {
        None => Box::new(BufWriter::new(io::stdout().lock())),
        Some(to) => Box::new(new_file(to)?),
    };
    let mut rows = Rows { out: &mut *out, began, count: 0, prints: to.is_none() };
    let loss = match topic {
        Some(topic) => rows.topic(path, topic, (from, until))?,
        None => rows.joints(path, (from, until))?,
    };
    let count = rows.count;
    if let Err(e) = out.flush()
        && e.kind() != io::ErrorKind::BrokenPipe
    {
        return Err(Failure::new(Exit::Failed, format!("cannot write: {e}")));
    }
    if let Some(to) = to {
        output::done(
            format_args!("{count} rows: {}", to.display()),
            json!({"file": to, "rows": count, "loss": loss}),
            json,
        );
    }
    Ok(ended(loss.as_deref()))
}

/// Exports joint states and commands as a Parquet file, with the columns of the text; unknown values are NaN.
pub fn parquet(path: &Path, part: &Part, to: &Path, json: bool) -> Result {
    let part_of_log = part.of(path)?;
    let began = part_of_log.0.saturating_sub(part.from.as_nanos() as u64);
    let names = joint_names(path, part_of_log, false)?;
    let mut columns = vec![("time".to_owned(), "<f8"), ("log_time".to_owned(), "<i8")];
    columns.extend(columns_of(&names).map(|name| (name, "<f8")));
    let mut file = PythonWriter::start("parquet", "pyarrow", to, &json!({"columns": columns}))?;
    let mut rows = 0;
    let loss = joint_rows(path, part_of_log, &names, false, |time, values| {
        rows += 1;
        let seconds = time.saturating_sub(began) as f64 * 1e-9;
        let values = values.iter().map(|value| value.to_le_bytes());
        file.row([seconds.to_le_bytes(), time.to_le_bytes()].into_iter().chain(values)).map(|()| true)
    })?;
    file.finish()?;
    output::done(format_args!("{rows} rows: {}", to.display()), json!({"file": to, "rows": rows, "loss": loss}), json);
    Ok(ended(loss.as_deref()))
}

/// Creates a file that must not exist yet.
pub fn new_file(to: &Path) -> Result<BufWriter<File>> {
    File::create_new(to).map(BufWriter::new).map_err(|e| cannot_write(to, e))
}

/// Returns the failure of a file that cannot be written.
pub fn cannot_write(to: &Path, e: io::Error) -> Failure {
    Failure::new(Exit::Failed, format!("cannot write {}: {e}", to.display())).hint("choose another file")
}

const COMMANDS: &str = "/joint_commands";
const OUTPUTS: &str = "/dimos/outputs/";

/// Returns all names in joint states, in the order in which they appear: a gripper gets its name when it is first
/// measured.
fn joint_names(path: &Path, (from, to): (u64, u64), prints: bool) -> Result<Vec<String>> {
    let mut names: Vec<String> = Vec::new();
    let mut log = LogReader::open(path).map_err(unreadable)?;
    let states = Selection { topics: vec![STATES.to_owned()], from, to };
    let loss = each(&mut log, states, progress::bar(prints), |entry| {
        let Payload::JointState(state) = entry.data else { return Ok(true) };
        if names != state.name {
            let new: Vec<String> = state.name.into_iter().filter(|name| !names.contains(name)).collect();
            names.extend(new);
        }
        Ok(true)
    })?;
    // What is damaged may have had them.
    if names.is_empty() && loss.is_none() {
        return Err(no_states(path, log.info()));
    }
    Ok(names)
}

/// Returns the names of the columns of these joints.
fn columns_of(names: &[String]) -> impl Iterator<Item = String> {
    let columns = ["position", "velocity", "effort", "command"];
    names.iter().flat_map(move |name| columns.map(|column| format!("{name}.{column}")))
}

/// Passes on time [ns] and values of each joint state and the commands with it, by the names of the joints; NaN where
/// the message has none. Ends when `row` returns `false`. Returns what the log lacks.
fn joint_rows(
    path: &Path,
    (from, to): (u64, u64),
    names: &[String],
    prints: bool,
    mut row: impl FnMut(u64, &[f64]) -> Result<bool>,
) -> Result<Option<String>> {
    let mut log = LogReader::open(path).map_err(unreadable)?;
    let mut waiting: Option<(u64, JointState)> = None;
    let mut commands = BTreeMap::<String, f64>::new();
    // A gripper keeps its command; a joint has one only on the ticks that command it.
    let mut grippers = BTreeMap::<String, f64>::new();
    let mut places = Places::new(names);
    let mut write = |time: u64, state: &JointState, commands: &BTreeMap<String, f64>| {
        let mut values = vec![f64::NAN; 4 * names.len()];
        for (column, list) in [&state.position, &state.velocity, &state.effort].into_iter().enumerate() {
            let cells = values.iter_mut().skip(column).step_by(4);
            cells.zip(places.pick(&state.name, list)).for_each(|(cell, value)| *cell = value);
        }
        for (cell, name) in values.iter_mut().skip(3).step_by(4).zip(names) {
            *cell = commands.get(name).copied().unwrap_or(f64::NAN);
        }
        row(time, &values)
    };
    let outputs: Vec<String> = log.info().topics.keys().filter(|topic| topic.starts_with(OUTPUTS)).cloned().collect();
    let topics = [STATES.to_owned(), COMMANDS.to_owned()].into_iter().chain(outputs).collect();
    let loss = each(&mut log, Selection { topics, from, to }, progress::bar(prints), |entry| {
        let values = match entry.data {
            Payload::JointState(values) => values,
            Payload::ArmOutput(output) if output.gripper_seq > 0 => {
                let arm = entry.topic.trim_start_matches(OUTPUTS);
                grippers.insert(format!("{arm}_gripper"), output.gripper);
                return Ok(true);
            }
            _ => return Ok(true),
        };
        if entry.topic == COMMANDS {
            let JointState { name, position, velocity, effort, .. } = values;
            for (i, name) in name.into_iter().enumerate() {
                // One of them has a value: an arm has one mode at a time.
                let lists = [&position, &velocity, &effort].into_iter();
                let command = lists.filter_map(|list| list.get(i)).copied().find(|v| !v.is_nan());
                commands.extend(command.map(|command| (name, command)));
            }
            return Ok(true);
        }
        let last = waiting.replace((entry.log_time, values));
        let mut commands = std::mem::take(&mut commands);
        commands.extend(grippers.clone());
        last.map_or(Ok(true), |(time, state)| write(time, &state, &commands))
    })?;
    if let Some((time, state)) = waiting {
        commands.extend(grippers);
        write(time, &state, &commands)?;
    }
    Ok(loss)
}

struct Rows<'a> {
    out: &'a mut dyn Write,
    /// Unix time of the log's beginning [ns].
    began: u64,
    count: u64,
    /// Whether they go to standard output.
    prints: bool,
}

impl Rows<'_> {
    /// Writes a row; `false` if the reader has closed the pipe.
    fn row(&mut self, time: u64, cells: impl Iterator<Item = String>) -> Result<bool> {
        self.count += 1;
        let mut line = format!("{:.9}", time.saturating_sub(self.began) as f64 * 1e-9);
        cells.for_each(|cell| {
            line.push(',');
            line.push_str(&cell);
        });
        line.push('\n');
        self.write(&line)
    }

    /// Writes to the file as it is, and to stdout as a terminal may get it.
    fn write(&mut self, text: &str) -> Result<bool> {
        written(self.out, &if self.prints { safe(text, false) } else { text.into() })
    }

    fn heading(&mut self, names: impl Iterator<Item = String>) -> Result<bool> {
        let names: String = names.map(|name| format!(",{}", quoted(&name))).collect();
        self.write(&format!("time{names}\n"))
    }

    /// Writes joint states and commands, a row for each state.
    fn joints(&mut self, path: &Path, part: (u64, u64)) -> Result<Option<String>> {
        let names = joint_names(path, part, self.prints)?;
        self.heading(columns_of(&names))?;
        joint_rows(path, part, &names, self.prints, |time, values| self.row(time, values.iter().copied().map(cell)))
    }

    /// Writes the messages of a topic, with the columns of all of them in the order in which they appear.
    fn topic(&mut self, path: &Path, topic: &str, part: (u64, u64)) -> Result<Option<String>> {
        let (mut columns, mut seen) = (Vec::new(), BTreeSet::new());
        let (loss, topics) = messages(path, topic, part, self.prints, |_, cells| {
            let new = cells.iter().filter(|(name, _)| seen.insert(name.clone()));
            columns.extend(new.map(|(name, _)| name.clone()));
            Ok(true)
        })?;
        if columns.is_empty() && loss.is_none() {
            let what = format!("there is no message on {topic} in this part of the log");
            return Err(Failure::usage(what).hint(format!("topics: {topics}")));
        }
        self.heading(columns.iter().cloned())?;
        messages(path, topic, part, self.prints, |time, cells| {
            let cells: BTreeMap<String, String> = cells.into_iter().collect();
            self.row(time, columns.iter().map(|column| cells.get(column).cloned().unwrap_or_default()))
        })?;
        Ok(loss)
    }
}

/// Passes on the time [ns] and the values of each message of a topic until `each` returns `false`. Returns what the log
/// lacks, and all topics.
fn messages(
    path: &Path,
    topic: &str,
    part: (u64, u64),
    prints: bool,
    mut each: impl FnMut(u64, Vec<(String, String)>) -> Result<bool>,
) -> Result<(Option<String>, String)> {
    let mut scan = Scan::open_part(path, &[topic.to_owned()], part).map_err(unreadable)?;
    let (mut text, mut wrong, mut bar) = (String::new(), 0, progress::of_scan(prints));
    while let Some(item) = scan.next_item().map_err(unreadable)? {
        bar(&scan);
        let Item::Messages = item else { continue };
        for (message, channel, bytes) in scan.messages() {
            if channel.topic != topic || !(part.0..=part.1).contains(&message.time) {
                continue;
            }
            text.clear();
            let Ok(()) = channel.json(bytes, &mut text) else {
                wrong += 1;
                continue;
            };
            let mut cells = Vec::new();
            flatten(String::new(), &serde_json::from_str(&text).unwrap_or_default(), &mut cells);
            if !each(message.time, cells)? {
                return Ok((None, String::new()));
            }
        }
    }
    scan.not_decoded(wrong);
    let topics: Vec<&str> = scan.channels.values().map(|channel| channel.topic.as_str()).collect();
    Ok((scan.loss().text(), topics.join(", ")))
}

/// Reads the selected messages of a log until `take` returns `false`, also after damage; returns what the part lacks.
/// `progress` gets how much of how much time is read [ns].
pub fn each(
    log: &mut LogReader,
    selection: Selection,
    mut progress: impl FnMut(u64, u64),
    mut take: impl FnMut(Entry) -> Result<bool>,
) -> Result<Option<String>> {
    let (from, length) = (selection.from, selection.to.saturating_sub(selection.from));
    log.select(selection).map_err(unreadable)?;
    let mut doubled: Option<(String, u64)> = None;
    loop {
        match log.next_entry() {
            Ok(Some(mut entry)) => {
                if let Payload::JointState(state) = &mut entry.data
                    && let Some(joint) = without_doubled(state)
                {
                    doubled.get_or_insert((joint, 0)).1 += 1;
                }
                progress(entry.log_time.saturating_sub(from), length);
                if !take(entry)? {
                    return Ok(None);
                }
            }
            Ok(None) => {
                let mut loss = log.loss();
                let text = |(joint, count)| format!("{count} messages have {joint} twice: its values are left out");
                loss.others.extend(doubled.map(text));
                return Ok(loss.text());
            }
            // It is in the loss.
            Err(ReplayError::Cut { .. } | ReplayError::Damaged { .. }) => {}
            Err(e) => return Err(unreadable(e)),
        }
    }
}

/// Removes the values of joints that are more than once in a message: none of them is known to be right. Returns one of
/// these joints.
fn without_doubled(state: &mut JointState) -> Option<String> {
    let first = twice(&state.name)?.clone();
    let count = |name: &String| state.name.iter().filter(|other| *other == name).count();
    for at in (0..state.name.len()).filter(|at| state.name.get(*at).is_some_and(|name| count(name) > 1)) {
        for list in [&mut state.position, &mut state.velocity, &mut state.effort] {
            list.get_mut(at).into_iter().for_each(|value| *value = f64::NAN);
        }
    }
    Some(first)
}

fn cell(value: f64) -> String {
    if value.is_finite() { format!("{value:?}") } else { String::new() }
}

/// Adds the values of a message with their names: `header.stamp.sec`, `position[0]`.
fn flatten(name: String, value: &Value, cells: &mut Vec<(String, String)>) {
    match value {
        Value::Object(fields) => {
            let dot = if name.is_empty() { "" } else { "." };
            fields.iter().for_each(|(field, value)| flatten(format!("{name}{dot}{field}"), value, cells));
        }
        Value::Array(list) => {
            list.iter().enumerate().for_each(|(i, value)| flatten(format!("{name}[{i}]"), value, cells));
        }
        Value::Null => cells.push((name, String::new())),
        Value::String(text) => cells.push((name, quoted(text))),
        other => cells.push((name, other.to_string())),
    }
}

fn quoted(text: &str) -> String {
    if text.contains([',', '"', '\n', '\r']) { format!("\"{}\"", text.replace('"', "\"\"")) } else { text.to_owned() }
}
