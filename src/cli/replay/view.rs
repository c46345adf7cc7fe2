//! Views of a replay: JSON lines, plain lines, or a table that is redrawn in place.

use std::collections::{BTreeMap, VecDeque};
use std::io::{self, Write};
use std::time::Duration;

use super::player::{Pace, Part};
use crate::cli::escapes::{in_json, safe};
use crate::cli::output::{self, Table};
use crate::cli::redraw::{self, Redraw};
use dimos_core::clock::Mono;
use dimos_log::messages::JointState;
use dimos_log::replay::{Entry, Payload};

/// Requests whose kind is remembered.
const KEPT_REQUESTS: usize = 64;
/// Time between two redraws of the table.
const REDRAW_EVERY: Duration = Duration::from_millis(50);
/// Log time between two plain lines of joint positions [ns].
const LINE_EVERY: u64 = 1_000_000_000;
/// Lines of the text log below the table.
const TEXT_LINES: usize = 5;
/// Largest width of the progress bar, and the columns that are left for the text behind it.
const BAR: usize = 40;
const BAR_TEXT: usize = 40;

/// A view of messages.
pub trait View {
    /// Takes a message; `now` is the time for redraws.
    fn show(&mut self, entry: &Entry, now: Mono) -> io::Result<()>;
    /// Takes how fast it plays from now on.
    fn pace(&mut self, _pace: &Pace) -> io::Result<()> {
        Ok(())
    }
    /// Ends the log, or one pass of a loop.
    fn end(&mut self) -> io::Result<()>;
}

/// One JSON object per message: `topic`, `log_time` [ns since the Unix epoch], `data`.
pub struct JsonLines<W>(W);

impl<W: Write> JsonLines<W> {
    /// Creates a view that writes to `out`.
    pub fn new(out: W) -> Self {
        Self(out)
    }
}

impl<W: Write> View for JsonLines<W> {
    fn show(&mut self, entry: &Entry, _now: Mono) -> io::Result<()> {
        let line = serde_json::to_string(entry)?;
        writeln!(self.0, "{}", in_json(&line))
    }
    fn end(&mut self) -> io::Result<()> {
        self.0.flush()
    }
}

/// One line of joint positions per second, and each line of the text log.
pub struct Plain<W> {
    out: W,
    from: u64,
    next: u64,
    joints: usize,
    others: BTreeMap<String, u64>,
    /// Number and kind of the latest requests, for the lines that answer them.
    asked: VecDeque<(String, String)>,
}

impl<W: Write> Plain<W> {
    /// Creates a view of the first `joints` joints that writes to `out`, with times relative to a Unix time [ns].
    pub fn new(out: W, from: u64, joints: usize) -> Self {
        Self { out, from, next: 0, joints, others: BTreeMap::new(), asked: VecDeque::new() }
    }
}

/// Returns number and kind of a logged request: `{"id":3,"request":{"execute":{…}}}` is `3`, `execute`.
fn request(json: &str) -> Option<(String, String)> {
    let (id, request) = json.strip_prefix("{\"id\":")?.split_once(",\"request\":{\"")?;
    Some((id.to_owned(), request.split('"').next()?.to_owned()))
}

impl<W: Write> View for Plain<W> {
    fn show(&mut self, entry: &Entry, _now: Mono) -> io::Result<()> {
        let at = entry.log_time.saturating_sub(self.from) as f64 * 1e-9;
        match &entry.data {
            Payload::JointState(joints) if entry.topic == "/joint_states" => {
                if entry.log_time >= self.next {
                    self.next = entry.log_time + LINE_EVERY;
                    let mut line = format!("{at:10.3} s");
                    for (i, name) in joints.name.iter().take(self.joints).enumerate() {
                        line.push_str(&format!("  {name} {} rad", number(&joints.position, i, 4)));
                    }
                    writeln!(self.out, "{}", safe(&line, false))?;
                }
            }
            Payload::Log(log) => {
                let answer = log.msg.strip_prefix("request ").and_then(|answer| answer.split_once(':'));
                let asked = answer.and_then(|(id, text)| Some((self.asked.iter().find(|asked| asked.0 == id)?, text)));
                let text = asked.map(|((id, kind), text)| format!("request {id} ({kind}):{text}"));
                let text = safe(text.as_ref().unwrap_or(&log.msg), false);
                writeln!(self.out, "{at:10.3} s  {}: {text}", level(log.level))?;
            }
            Payload::Text(text) if entry.topic == "/dimos/requests" => {
                self.asked.extend(request(&text.data));
                if self.asked.len() > KEPT_REQUESTS {
                    self.asked.pop_front();
                }
                *self.others.entry(entry.topic.clone()).or_default() += 1;
            }
            // Already shown as a line of the text log.
            Payload::Event(_) => {}
            _ => *self.others.entry(entry.topic.clone()).or_default() += 1,
        }
        Ok(())
    }

    fn end(&mut self) -> io::Result<()> {
        self.next = 0;
        for (topic, count) in std::mem::take(&mut self.others) {
            writeln!(self.out, "{:10}    {}: {count} messages", "", safe(&topic, false))?;
        }
        self.out.flush()
    }
}

/// A table of all joints, with arms above it and a progress bar and the latest text below. Redraws itself in place.
pub struct Live<W> {
    out: W,
    from: u64,
    to: u64,
    pace: Pace,
    at: u64,
    drawn_at: Option<Mono>,
    redraw: Redraw,
    joints: usize,
    states: Option<JointState>,
    commands: BTreeMap<String, f64>,
    arms: BTreeMap<String, String>,
    texts: VecDeque<String>,
}

impl<W: Write> Live<W> {
    /// Creates a view of the first `joints` joints that draws on `out`, a terminal.
    pub fn new(out: W, part: &Part, joints: usize) -> Self {
        Self {
            out,
            from: part.from,
            to: part.to,
            pace: Pace::new(1.0, false),
            at: part.from,
            drawn_at: None,
            redraw: Redraw::default(),
            joints,
            states: None,
            commands: BTreeMap::new(),
            arms: BTreeMap::new(),
            texts: VecDeque::new(),
        }
    }

    fn take(&mut self, entry: &Entry) {
        match &entry.data {
            Payload::JointState(joints) if entry.topic == "/joint_states" => self.states = Some(joints.clone()),
            Payload::JointState(joints) if entry.topic == "/joint_commands" => {
                self.commands = joints.name.iter().cloned().zip(joints.position.iter().copied()).collect();
            }
            Payload::ArmStatus(arm) => {
                let name = entry.topic.trim_start_matches("/arm_status/").to_owned();
                let why = if arm.cause_text.is_empty() { String::new() } else { format!(" ({})", arm.cause_text) };
                let error = if arm.error == 0 { String::new() } else { format!(", error {}", arm.error) };
                self.arms.insert(name, format!("{}{why}, link {}{error}", arm.phase, arm.link));
            }
            Payload::Log(log) => {
                let at = entry.log_time.saturating_sub(self.from) as f64 * 1e-9;
                self.texts.push_back(format!("{at:10.3} s  {}: {}", level(log.level), log.msg));
                if self.texts.len() > TEXT_LINES {
                    self.texts.pop_front();
                }
            }
            _ => {}
        }
    }

    /// Returns the lines for a terminal of this size; the older texts give way to what is above them.
    fn render(&self, (columns, rows): (usize, usize)) -> Vec<String> {
        let width = u16::try_from(columns).ok().filter(|columns| *columns > 0);
        let arm = |(name, text): (&String, &String)| output::folded(&format!("{name}: {text}"), width);
        let mut lines: Vec<String> = self.arms.iter().flat_map(arm).collect();
        if let Some(states) = &self.states {
            let mut table = Table::new(&["joint", ">rad", ">deg", ">?rad/s", ">?command rad"]);
            for (i, name) in states.name.iter().take(self.joints).enumerate() {
                let degrees: Vec<f64> = states.position.iter().map(|p| p.to_degrees()).collect();
                let command: Vec<f64> = self.commands.get(name).copied().into_iter().collect();
                table.row([
                    name.clone(),
                    number(&states.position, i, 4),
                    number(&degrees, i, 2),
                    number(&states.velocity, i, 4),
                    number(&command, 0, 4),
                ]);
            }
            lines.extend(table.lines());
        }
        lines.push(self.bar(columns));
        let texts = self.texts.iter().flat_map(|text| text.lines());
        let texts: Vec<String> = texts.flat_map(|text| output::folded(text, width)).collect();
        let room = if rows == 0 { texts.len() } else { rows.saturating_sub(lines.len() + 1) };
        lines.extend(texts.into_iter().rev().take(room).rev());
        lines
    }

    fn bar(&self, columns: usize) -> String {
        let length = if columns == 0 { BAR } else { columns.saturating_sub(BAR_TEXT).clamp(10, BAR) };
        let (at, whole) = (self.at.saturating_sub(self.from), self.to.saturating_sub(self.from));
        let full = (at as f64 / whole.max(1) as f64 * length as f64) as usize;
        let full = full.min(length);
        let (at, whole) = (at as f64 * 1e-9, whole as f64 * 1e-9);
        // 1.1, not 1.1000000000000001.
        let rate = (self.pace.rate * 1e3).round() / 1e3;
        let paused = if self.pace.paused { "  paused: space, →" } else { "" };
        format!("[{}{}] {at:.1} / {whole:.1} s  ×{}{}", "=".repeat(full), " ".repeat(length - full), rate, paused)
    }

    fn draw(&mut self) -> io::Result<()> {
        let size = redraw::stdout_size();
        let frame = self.redraw.frame(&self.render(size), size, true);
        self.out.write_all(frame.as_bytes())?;
        self.out.flush()
    }
}

impl<W: Write> View for Live<W> {
    fn show(&mut self, entry: &Entry, now: Mono) -> io::Result<()> {
        self.take(entry);
        self.at = entry.log_time;
        if self.drawn_at.is_none_or(|last| now.since(last) >= REDRAW_EVERY) {
            self.drawn_at = Some(now);
            self.draw()?;
        }
        Ok(())
    }

    fn pace(&mut self, pace: &Pace) -> io::Result<()> {
        self.pace = *pace;
        self.draw()
    }

    fn end(&mut self) -> io::Result<()> {
        self.draw()
    }
}

/// Formats a value, or a dash if there is none.
fn number(values: &[f64], i: usize, digits: usize) -> String {
    output::number(values.get(i).copied().filter(|v| !v.is_nan()), digits)
}

fn level(level: u8) -> &'static str {
    match level {
        0..=10 => "debug",
        11..=20 => "info",
        21..=30 => "warn",
        _ => "error",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_log::messages::Log;

    fn joints(log_time: u64, position: &[f64]) -> Entry {
        let name = (1..=position.len()).map(|i| format!("joint{i}")).collect();
        let data = JointState { name, position: position.to_vec(), ..JointState::default() };
        Entry { topic: "/joint_states".into(), log_time, data: Payload::JointState(data), publisher: 0 }
    }

    fn text(log_time: u64) -> Entry {
        let log = Log { level: 30, msg: "arm is held".into(), ..Log::default() };
        Entry { topic: "/rosout".into(), log_time, data: Payload::Log(log), publisher: 0 }
    }

    #[test]
    fn json_has_topic_time_and_fields_with_null_for_nan() {
        let mut out = Vec::new();
        JsonLines::new(&mut out).show(&joints(7, &[0.25, f64::NAN]), Mono::ZERO).unwrap();
        let line: serde_json::Value = serde_json::from_slice(&out).unwrap();
        assert_eq!((line["topic"].as_str(), line["log_time"].as_u64()), (Some("/joint_states"), Some(7)));
        assert_eq!(line["data"]["position"], serde_json::json!([0.25, null]));
        assert_eq!(line["data"]["header"]["stamp"]["sec"], 0);
        assert!(out.ends_with(b"}\n"));
    }

    #[test]
    fn plain_lines_come_once_a_second_and_for_each_text() {
        let mut out = Vec::new();
        let mut view = Plain::new(&mut out, 1_000_000_000, usize::MAX);
        for i in 0..=15 {
            view.show(&joints(1_000_000_000 + i * 100_000_000, &[i as f64, f64::NAN]), Mono::ZERO).unwrap();
        }
        view.show(&text(2_600_000_000), Mono::ZERO).unwrap();
        view.end().unwrap();
        let expected = "     0.000 s  joint1 0.0000 rad  joint2 - rad\n     1.000 s  joint1 10.0000 rad  joint2 - rad\n     1.600 s  warn: arm is held\n";
        assert_eq!(String::from_utf8(out).unwrap(), expected);
    }

    #[test]
    fn plain_lines_name_the_request_that_is_answered() {
        use dimos_log::messages::Text;
        let (mut out, mut answer) = (Vec::new(), text(0));
        let data = Text { data: "{\"id\":6,\"request\":{\"execute\":{\"task\":0}}}".into() };
        let request = Entry { topic: "/dimos/requests".into(), log_time: 0, data: Payload::Text(data), publisher: 0 };
        if let Payload::Log(log) = &mut answer.data {
            log.msg = "request 6: accepted".into();
        }
        let mut view = Plain::new(&mut out, 0, usize::MAX);
        view.show(&request, Mono::ZERO).unwrap();
        view.show(&answer, Mono::ZERO).unwrap();
        assert_eq!(String::from_utf8(out).unwrap(), "     0.000 s  warn: request 6 (execute): accepted\n");
    }

    #[test]
    fn the_live_table_redraws_in_place() {
        let part = Part { topics: vec![], from: 0, to: 2_000_000_000, looping: false };
        let mut out = Vec::new();
        let mut view = Live::new(&mut out, &part, usize::MAX);
        view.show(&joints(0, &[std::f64::consts::PI, f64::NAN]), Mono(0)).unwrap();
        view.show(&joints(10_000_000, &[1.0, 1.0]), Mono(10_000_000)).unwrap();
        view.show(&text(1_000_000_000), Mono(1_000_000_000)).unwrap();
        let out = String::from_utf8(out).unwrap();
        let (first, second) = out.split_once("\x1b[4A\x1b[J").expect("one redraw, four lines up");
        assert!(first.contains("3.1416") && first.contains("180.00") && first.contains("0.0 / 2.0 s"), "{first}");
        assert!(second.contains("[====================                    ] 1.0 / 2.0 s"), "{second}");
        assert!(second.contains("1.000 s  warn: arm is held"), "{second}");
    }
}
