//! `dimos log info`: what is in a log.

use std::collections::BTreeMap;
use std::path::Path;

use serde_json::{Value, json};

use super::{ended, progress, unreadable};
use crate::cli::exit::Result;
use crate::cli::output::{self, Table, fixed};
use dimos_log::attachment::{Other, check};
use dimos_log::disk_space::Megabytes;
use dimos_log::files;
use dimos_log::replay::{LogInfo, LogReader, ReplayError};
use dimos_log::scan::{Item, Scan};

/// Prints what is in a log.
pub fn run(path: &Path, json: bool) -> Result {
    let reader = LogReader::open(path).map_err(unreadable)?;
    let info = reader.info();
    let mut scan = Scan::open(path).map_err(unreadable)?;
    let (mut counts, mut attachments, mut bar) = (BTreeMap::<u16, u64>::new(), Vec::new(), progress::of_scan(false));
    while let Some(item) = scan.next_item().map_err(unreadable)? {
        match item {
            Item::Messages => {
                scan.messages().for_each(|(message, ..)| *counts.entry(message.channel).or_default() += 1);
            }
            Item::Other(_, record) => {
                let other = check(&record);
                other.damage(record.at).into_iter().for_each(|damage| scan.lacks(damage));
                if let Other::Attachment(found) = other {
                    attachments.push(json!({"name": found.header.name, "size": found.data.len()}));
                }
            }
        }
        bar(&scan);
    }
    drop(bar);
    let (faults, _) = faults(path, info, false).map_err(unreadable)?;
    let loss = scan.loss().text();
    let state = state(info, loss.is_some());
    let length = length(info);
    let mut topics: Vec<_> = scan.channels.iter().collect();
    topics.sort_by_key(|(_, channel)| &channel.topic);
    let count = |id: &u16| counts.get(id).copied().unwrap_or(0);
    let rate = |id: &u16| if length > 0.0 { count(id) as f64 / length } else { 0.0 };
    let size = files::size(path);
    if json {
        let topics = topics.iter().map(|(id, channel)| {
            let (messages, rate) = (count(id), rate(id));
            json!({"topic": channel.topic, "schema": channel.schema.0, "messages": messages, "rate": rate})
        });
        let mut data = json!({
            "path": path, "size": size, "length": length, "start": info.span.map(|(start, _)| start),
            "state": state, "loss": loss, "metadata": info.metadata, "topics": topics.collect::<Vec<_>>(),
            "attachments": attachments, "faults": faults,
        });
        if let Some(arms) = arms(info) {
            data["arms"] = json!(arms);
        }
        output::json(&data);
        return Ok(ended(loss.as_deref()));
    }
    let text = |key: &str| info.metadata.get(key).map_or("-", String::as_str);
    output::line(format_args!("{}: {state}", path.display()));
    output::line(format_args!("run {}, started {}, {length:.3} s, {}", text("run"), started(info), Megabytes(size)));
    let (version, config) = (text("dimos_version"), text("config_version"));
    output::line(format_args!("dimos {version}, config version {config}, tick rate {} Hz", text("tick_rate")));
    output::line(format_args!("arms: {}", arms(info).map_or_else(|| "-".to_owned(), |arms| arms.join(", "))));
    let mut table = Table::new(&["TOPIC", "?SCHEMA", ">MESSAGES", ">HZ"]);
    for (id, channel) in topics {
        table.row([channel.topic.clone(), channel.schema.0.clone(), count(id).to_string(), fixed(rate(id), 1)]);
    }
    table.print();
    let sizes = attachments.iter().filter_map(|a| Some(format!("{} ({} B)", a["name"].as_str()?, a["size"])));
    output::wrapped(format_args!("attachments: {}", sizes.collect::<Vec<_>>().join(", ")));
    output::line(format_args!("faults: {}", faults.len()));
    for fault in &faults {
        let time = fault["time"].as_f64().unwrap_or(0.0);
        output::line(format_args!("{time:10.3} s  {}", fault["text"].as_str().unwrap_or_default()));
    }
    Ok(ended(loss.as_deref()))
}

/// Returns the length of a log [s].
pub fn length(info: &LogInfo) -> f64 {
    info.span.map_or(0.0, |(start, end)| (end - start) as f64 * 1e-9)
}

/// Returns the UTC time of the first message.
pub fn started(info: &LogInfo) -> String {
    let time = info.span.and_then(|(start, _)| jiff::Timestamp::from_second((start / 1_000_000_000) as i64).ok());
    time.map_or_else(|| "-".to_owned(), |time| time.to_string())
}

/// Returns whether a log is whole, as far as it was read.
pub fn state(info: &LogInfo, lacks: bool) -> &'static str {
    match (info.live, info.complete) {
        (true, _) => "live",
        (_, true) if lacks => "damaged",
        (_, true) => "complete",
        _ => "cut",
    }
}

/// Returns the names of the arms.
pub fn arms(info: &LogInfo) -> Option<Vec<String>> {
    let arms: BTreeMap<String, Value> = serde_json::from_str(info.metadata.get("arms")?).ok()?;
    Some(arms.into_keys().collect())
}

/// Returns the errors among the events of a log, with their times [s from its start], and what it lacks as far as it
/// was read: no more than events need, or `all` of it.
pub fn faults(
    path: &Path,
    info: &LogInfo,
    all: bool,
) -> std::result::Result<(Vec<Value>, Option<String>), ReplayError> {
    let events = "/dimos/events".to_owned();
    let topics = if all { &[] } else { std::slice::from_ref(&events) };
    let mut scan = Scan::open_part(path, topics, (0, u64::MAX))?;
    let (start, mut faults, mut text) = (info.span.map_or(0, |(start, _)| start), Vec::new(), String::new());
    while let Some(item) = scan.next_item()? {
        if let Item::Other(_, record) = &item {
            check(record).damage(record.at).into_iter().for_each(|damage| scan.lacks(damage));
            continue;
        }
        for (message, _, bytes) in scan.messages().filter(|(_, channel, _)| channel.topic == events) {
            text.clear();
            let channel = scan.channels.get(&message.channel);
            let known = channel.is_some_and(|channel| channel.json(bytes, &mut text).is_ok());
            let event: Value = serde_json::from_str(&text).ok().filter(|_| known).unwrap_or_default();
            if event["severity"] == "error" {
                let time = message.time.saturating_sub(start) as f64 * 1e-9;
                faults.push(json!({"time": time, "text": event["text"], "arm": event["arm"]}));
            }
        }
    }
    Ok((faults, scan.loss().text()))
}
