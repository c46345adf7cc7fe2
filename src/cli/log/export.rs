//! `dimos log export`: joint values, or the messages of a topic, as CSV.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use serde_json::{Value, json};

use super::{Part, ended, unreadable, written};
use crate::cli::exit::{Exit, Failure, Result};
use crate::cli::output;
use crate::recording::messages::JointState;
use crate::recording::replay::{Entry, LogReader, Payload, ReplayError, Selection};
use crate::recording::scan::{Item, Scan};

/// Exports a log.
pub fn run(path: &Path, part: &Part, topic: Option<&str>, to: Option<&Path>, json: bool) -> Result {
    let (from, until) = part.of(path)?;
    let began = from.saturating_sub(part.from.as_nanos() as u64);
    let mut out: Box<dyn Write> = match to {
        None => Box::new(BufWriter::new(io::stdout().lock())),
        Some(to) => {
            let failed = |e: io::Error| {
                Failure::new(Exit::Failed, format!("cannot write {}: {e}", to.display())).hint("choose another file")
            };
            Box::new(BufWriter::new(File::create_new(to).map_err(failed)?))
        }
    };
    let mut rows = Rows { out: &mut *out, began, count: 0 };
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

struct Rows<'a> {
    out: &'a mut dyn Write,
    /// Unix time of the log's beginning [ns].
    began: u64,
    count: u64,
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
    fn joints(&mut self, path: &Path, (from, to): (u64, u64)) -> Result {
        let topics = vec!["/joint_states".to_owned(), "/joint_commands".to_owned()];
        let mut log = LogReader::open(path).map_err(unreadable)?;
        // A gripper gets its name when it is first measured.
        let mut names: Vec<String> = Vec::new();
        let mut exit = Exit::Ok;
        each(&mut log, Selection { topics: topics[..1].to_vec(), from, to }, |entry| {
            if let Payload::JointState(state) = entry.data
                && state.name.len() > names.len()
            {
                names = state.name;
            }
            Ok(true)
        })?;
        let columns = ["position", "velocity", "effort", "command"];
        self.heading(names.iter().flat_map(|name| columns.map(|column| format!("{name}.{column}"))))?;
        let mut waiting: Option<(u64, JointState)> = None;
        let mut commands = JointState::default();
        let row = |rows: &mut Self, time: u64, state: &JointState, commands: &JointState| {
            let lists = [&commands.position, &commands.velocity, &commands.effort];
            // One of them has a value: an arm has one mode at a time.
            let command = |i: usize| lists.iter().filter_map(|list| list.get(i)).copied().find(|v| !v.is_nan());
            let of = |list: &[f64], i: usize| list.get(i).copied();
            let cells = (0..names.len()).flat_map(|i| {
                [of(&state.position, i), of(&state.velocity, i), of(&state.effort, i), command(i)].map(cell)
            });
            rows.row(time, cells)
        };
        let cut = each(&mut log, Selection { topics: topics.clone(), from, to }, |entry| {
            let Payload::JointState(values) = entry.data else { return Ok(true) };
            if entry.topic == topics[1] {
                commands = values;
                return Ok(true);
            }
            let last = waiting.replace((entry.log_time, values));
            let commands = std::mem::take(&mut commands);
            last.map_or(Ok(true), |(time, state)| row(self, time, &state, &commands))
        })?;
        if let Some((time, state)) = waiting {
            row(self, time, &state, &commands)?;
        }
        if let Some(cut) = cut.filter(|_| !log.info().live) {
            output::note(format_args!("warning: {cut}"));
            exit = Exit::Log;
        }
        Ok(exit)
    }

    /// Writes the messages of a topic, with the columns of the first one.
    fn topic(&mut self, path: &Path, topic: &str, part: (u64, u64)) -> Result {
        let mut scan = Scan::open_part(path, &[topic.to_owned()], part).map_err(unreadable)?;
        let (mut columns, mut text) = (Vec::<String>::new(), String::new());
        while let Some(item) = scan.next_item().map_err(unreadable)? {
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

/// Reads the selected messages of a log until `take` returns `false`; returns the cut.
pub fn each(
    log: &mut LogReader,
    selection: Selection,
    mut take: impl FnMut(Entry) -> Result<bool>,
) -> Result<Option<ReplayError>> {
    log.select(selection).map_err(unreadable)?;
    loop {
        match log.next_entry() {
            Ok(Some(entry)) => {
                if !take(entry)? {
                    return Ok(None);
                }
            }
            Ok(None) => return Ok(None),
            Err(cut @ ReplayError::Cut { .. }) => return Ok(Some(cut)),
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
