//! `dimos log export`: joint values as CSV or Parquet, or the messages of a topic as CSV.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use serde_json::{Value, json};

use super::{Part, ended, progress, unreadable, written};
use crate::cli::exit::{Exit, Failure, Result};
use crate::cli::output;
use crate::recording::messages::JointState;
use crate::recording::parquet::{Column, ParquetWriter};
use crate::recording::replay::{Entry, LogReader, Payload, ReplayError, Selection};
use crate::recording::scan::{Item, Scan};

/// Exports a log as text.
pub fn csv(path: &Path, part: &Part, topic: Option<&str>, to: Option<&Path>, json: bool) -> Result {
    let (from, until) = part.of(path)?;
    let began = from.saturating_sub(part.from.as_nanos() as u64);
    let mut out: Box<dyn Write> = match to {
        None => Box::new(BufWriter::new(io::stdout().lock())),
        Some(to) => Box::new(new_file(to)?),
    };
    let mut rows = Rows { out: &mut *out, began, count: 0, prints: to.is_none() };
    let exit = match topic {
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
        output::done(format_args!("{count} rows: {}", to.display()), json!({"file": to, "rows": count}), json);
    }
    Ok(exit)
}

/// Exports joint states and commands as a Parquet file, with the columns of the text; unknown values are NaN.
pub fn parquet(path: &Path, part: &Part, to: &Path, json: bool) -> Result {
    let part_of_log = part.of(path)?;
    let began = part_of_log.0.saturating_sub(part.from.as_nanos() as u64);
    let out = new_file(to)?;
    let names = joint_names(path, part_of_log, false)?;
    let numbers = || Column::Numbers(Vec::new());
    let mut columns = vec![("time".to_owned(), numbers()), ("log_time".to_owned(), Column::Integers(Vec::new()))];
    columns.extend(columns_of(&names).map(|name| (name, numbers())));
    let failed = |e| cannot_write(to, e);
    let mut file = ParquetWriter::new(out, columns).map_err(failed)?;
    let exit = joint_rows(path, part_of_log, names.len(), false, |time, values| {
        for (column, value) in file.columns.iter_mut().skip(2).zip(values) {
            if let Column::Numbers(list) = column {
                list.push(value.unwrap_or(f64::NAN));
            }
        }
        if let [Column::Numbers(seconds), Column::Integers(times), ..] = &mut file.columns[..] {
            seconds.push(time.saturating_sub(began) as f64 * 1e-9);
            times.push(time as i64);
        }
        file.row_added().map_err(failed).map(|()| true)
    })?;
    let rows = file.finish(&[]).map_err(failed)?;
    output::done(format_args!("{rows} rows: {}", to.display()), json!({"file": to, "rows": rows}), json);
    Ok(exit)
}

/// Creates a file that must not exist yet.
pub fn new_file(to: &Path) -> Result<BufWriter<File>> {
    File::create_new(to).map(BufWriter::new).map_err(|e| cannot_write(to, e))
}

/// Returns the failure of a file that cannot be written.
pub fn cannot_write(to: &Path, e: io::Error) -> Failure {
    Failure::new(Exit::Failed, format!("cannot write {}: {e}", to.display())).hint("choose another file")
}

const STATES: &str = "/joint_states";
const COMMANDS: &str = "/joint_commands";

/// Returns the names in joint states; a gripper gets its name when it is first measured.
fn joint_names(path: &Path, (from, to): (u64, u64), prints: bool) -> Result<Vec<String>> {
    let mut names: Vec<String> = Vec::new();
    let mut log = LogReader::open(path).map_err(unreadable)?;
    let states = Selection { topics: vec![STATES.to_owned()], from, to };
    each(&mut log, states, progress::bar(prints), |entry| {
        if let Payload::JointState(state) = entry.data
            && state.name.len() > names.len()
        {
            names = state.name;
        }
        Ok(true)
    })?;
    Ok(names)
}

/// Returns the names of the columns of these joints.
fn columns_of(names: &[String]) -> impl Iterator<Item = String> {
    let columns = ["position", "velocity", "effort", "command"];
    names.iter().flat_map(move |name| columns.map(|column| format!("{name}.{column}")))
}

/// Passes on time [ns] and values of each joint state and the commands with it, until `row` returns `false`.
fn joint_rows(
    path: &Path,
    (from, to): (u64, u64),
    joints: usize,
    prints: bool,
    mut row: impl FnMut(u64, &[Option<f64>]) -> Result<bool>,
) -> Result {
    let mut log = LogReader::open(path).map_err(unreadable)?;
    let mut waiting: Option<(u64, JointState)> = None;
    let mut commands = JointState::default();
    let mut write = |time: u64, state: &JointState, commands: &JointState| {
        let lists = [&commands.position, &commands.velocity, &commands.effort];
        // One of them has a value: an arm has one mode at a time.
        let command = |i: usize| lists.iter().filter_map(|list| list.get(i)).copied().find(|v| !v.is_nan());
        let of = |list: &[f64], i: usize| list.get(i).copied();
        let values = |i| [of(&state.position, i), of(&state.velocity, i), of(&state.effort, i), command(i)];
        let values: Vec<Option<f64>> = (0..joints).flat_map(values).collect();
        row(time, &values)
    };
    let both = Selection { topics: vec![STATES.to_owned(), COMMANDS.to_owned()], from, to };
    let cut = each(&mut log, both, progress::bar(prints), |entry| {
        let Payload::JointState(values) = entry.data else { return Ok(true) };
        if entry.topic == COMMANDS {
            commands = values;
            return Ok(true);
        }
        let last = waiting.replace((entry.log_time, values));
        let commands = std::mem::take(&mut commands);
        last.map_or(Ok(true), |(time, state)| write(time, &state, &commands))
    })?;
    if let Some((time, state)) = waiting {
        write(time, &state, &commands)?;
    }
    match cut.filter(|_| !log.info().live) {
        Some(cut) => {
            output::note(format_args!("warning: {cut}"));
            Ok(Exit::Log)
        }
        None => Ok(Exit::Ok),
    }
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
        written(self.out, &line)
    }

    fn heading(&mut self, names: impl Iterator<Item = String>) -> Result<bool> {
        let names: String = names.map(|name| format!(",{}", quoted(&name))).collect();
        written(self.out, &format!("time{names}\n"))
    }

    /// Writes joint states and commands, a row for each state.
    fn joints(&mut self, path: &Path, part: (u64, u64)) -> Result {
        let names = joint_names(path, part, self.prints)?;
        self.heading(columns_of(&names))?;
        joint_rows(path, part, names.len(), self.prints, |time, values| {
            self.row(time, values.iter().copied().map(cell))
        })
    }

    /// Writes the messages of a topic, with the columns of the first one.
    fn topic(&mut self, path: &Path, topic: &str, part: (u64, u64)) -> Result {
        let mut scan = Scan::open_part(path, &[topic.to_owned()], part).map_err(unreadable)?;
        let (mut columns, mut text, mut bar) = (Vec::<String>::new(), String::new(), progress::of_scan(self.prints));
        while let Some(item) = scan.next_item().map_err(unreadable)? {
            bar(&scan);
            let Item::Messages = item else { continue };
            for (message, channel, bytes) in scan.messages() {
                if channel.topic != topic || !(part.0..=part.1).contains(&message.time) {
                    continue;
                }
                text.clear();
                let Ok(()) = channel.json(bytes, &mut text) else { continue };
                let mut cells = Vec::new();
                flatten(String::new(), &serde_json::from_str(&text).unwrap_or_default(), &mut cells);
                if columns.is_empty() {
                    columns = cells.iter().map(|(name, _)| name.clone()).collect();
                    self.heading(columns.iter().cloned())?;
                }
                let of = |column: &String| cells.iter().find(|(name, _)| name == column);
                let row = columns.iter().map(|column| of(column).map_or_else(String::new, |(_, value)| value.clone()));
                if !self.row(message.time, row)? {
                    return Ok(Exit::Ok);
                }
            }
        }
        if columns.is_empty() {
            let topics: Vec<&str> = scan.channels.values().map(|channel| channel.topic.as_str()).collect();
            let what = format!("there is no message on {topic} in this part of the log");
            return Err(Failure::usage(what).hint(format!("topics: {}", topics.join(", "))));
        }
        Ok(ended(&scan))
    }
}

/// Reads the selected messages of a log until `take` returns `false`; returns the cut, if they reach to it. `progress`
/// gets how much of how much time is read [ns].
pub fn each(
    log: &mut LogReader,
    selection: Selection,
    mut progress: impl FnMut(u64, u64),
    mut take: impl FnMut(Entry) -> Result<bool>,
) -> Result<Option<ReplayError>> {
    let (from, length) = (selection.from, selection.to.saturating_sub(selection.from));
    let reaches_end = log.info().span.is_none_or(|(_, end)| selection.to >= end);
    log.select(selection).map_err(unreadable)?;
    loop {
        match log.next_entry() {
            Ok(Some(entry)) => {
                progress(entry.log_time.saturating_sub(from), length);
                if !take(entry)? {
                    return Ok(None);
                }
            }
            Ok(None) => return Ok(None),
            Err(cut @ ReplayError::Cut { .. }) => return Ok(Some(cut).filter(|_| reaches_end)),
            Err(e) => return Err(unreadable(e)),
        }
    }
}

fn cell(value: Option<f64>) -> String {
    value.filter(|v| v.is_finite()).map_or_else(String::new, |v| format!("{v:?}"))
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
