//! `dimos log doctor`: reads all of a log and checks it.

use std::collections::BTreeMap;
use std::path::Path;

use serde_json::{Value, json};

use super::{progress, unreadable};
use crate::cli::exit::{Exit, Result};
use crate::cli::output;
use dimos_log::attachment::check;
use dimos_log::messages::Tick;
use dimos_log::records::check_sections;
use dimos_log::replay::parts;
use dimos_log::scan::{Item, Scan};
use dimos_log::wire::Message;

/// Checks a log and prints the findings.
pub fn run(path: &Path, json: bool) -> Result {
    let mut scan = Scan::open(path).map_err(unreadable)?;
    let (mut found, mut bar) = (Findings::default(), progress::of_scan(false));
    while let Some(item) = scan.next_item().map_err(unreadable)? {
        match item {
            Item::Messages => found.batch(&scan),
            Item::Other(_, record) => {
                check(&record).damage(record.at).into_iter().for_each(|damage| scan.lacks(damage));
            }
        }
        bar(&scan);
    }
    drop(bar);
    let loss = scan.loss();
    let counted = scan.statistics().map(|(count, _)| count).filter(|count| *count < found.messages);
    found.problems.extend(loss.text());
    if let Some(counted) = counted.filter(|_| scan.is_complete()) {
        found.problems.push(format!("the summary counts {counted} messages, the log has {}", found.messages));
    }
    if scan.is_complete() && loss.damage.is_empty() {
        for part in parts(path).map_err(unreadable)? {
            let wrong = check_sections(&part).map_err(unreadable)?;
            found.problems.extend(wrong.map(|wrong| format!("{}: {wrong}", part.display())));
        }
    }
    if found.undecoded > 0 {
        found.problems.push(format!("{} messages do not match their schema", found.undecoded));
    }
    if found.lost > 0 {
        found.problems.push(format!("{} samples of ticks were lost while recording", found.lost));
    }
    let (healthy, unordered) = (found.problems.is_empty(), found.unordered);
    if json {
        let data = json!({
            "healthy": healthy, "out_of_order": unordered, "live": scan.is_live(), "messages": found.messages,
            "ticks": found.ticks, "topics": found.times.len(), "problems": found.problems,
        });
        output::json(&data);
    } else {
        found.problems.iter().for_each(|problem| output::line(format_args!("problem: {problem}")));
        let (verdict, recovers) = match (healthy, unordered) {
            (true, 0) => ("healthy", None),
            // Nothing is missing, and every verb reads it in order.
            (true, _) => ("whole, but out of order", Some("the messages in order of time")),
            (false, _) => ("not whole", Some("what can be read")),
        };
        if unordered > 0 {
            output::line(format_args!("{unordered} messages are older than the one before on their topic"));
        }
        let (messages, topics) = (found.messages, found.times.len());
        let live = if scan.is_live() { ", live: read up to its newest chunk" } else { "" };
        output::line(format_args!("{verdict}: {messages} messages on {topics} topics, {} ticks{live}", found.ticks));
        if let Some(recovers) = recovers {
            output::note(format_args!("hint: `dimos log recover` writes {recovers} to a new file"));
        }
    }
    Ok(if healthy { Exit::Ok } else { Exit::Log })
}

#[derive(Default)]
struct Findings {
    messages: u64,
    ticks: u64,
    /// Index of the next tick.
    next: Option<u64>,
    lost: u64,
    undecoded: u64,
    /// Messages that were written before older ones of their channel.
    unordered: u64,
    /// Where the latest message of each channel was written.
    times: BTreeMap<u16, (usize, u64, u32)>,
    problems: Vec<String>,
    text: String,
}

impl Findings {
    fn batch(&mut self, scan: &Scan) {
        for (message, channel, bytes) in scan.messages() {
            self.messages += 1;
            self.text.clear();
            // Only schemas that are understood can be checked.
            let wrong = channel.decoder.is_some() && channel.json(bytes, &mut self.text).is_err();
            self.undecoded += u64::from(wrong);
            let last = self.times.insert(message.channel, message.place);
            // Notes of other threads have their own times.
            let of_ticks =
                !matches!(channel.topic.as_str(), "/rosout" | "/dimos/requests" | "/markers" | "/joint_trajectory");
            self.unordered += u64::from(of_ticks && last.is_some_and(|last| message.place < last));
            if channel.topic == "/dimos/tick" {
                self.tick(bytes);
            }
        }
    }

    fn tick(&mut self, bytes: &[u8]) {
        let number = |data: &Value, key: &str| data.get(key).and_then(Value::as_u64).unwrap_or(0);
        // The type is tried first: it is faster.
        let (tick, dropped) = match Tick::decode(bytes) {
            Ok(tick) => (tick.tick, u64::from(tick.dropped)),
            Err(_) => {
                let data = serde_json::from_str(&self.text).unwrap_or_default();
                (number(&data, "tick"), number(&data, "dropped"))
            }
        };
        self.ticks += 1;
        self.lost += dropped;
        let gap = self.next.replace(tick + 1).filter(|next| *next != tick);
        if let Some(next) = gap.filter(|_| self.problems.len() < 20) {
            self.problems.push(format!("ticks {next} to {} are missing", tick.saturating_sub(1)));
        }
    }
}
