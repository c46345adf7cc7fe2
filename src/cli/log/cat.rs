//! `dimos log cat`: the messages of a log.

use std::fmt::Write as _;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use serde_json::Value;

use super::{Part, ended, progress, unreadable, written};
use crate::cli::escapes::{in_json, safe};
use crate::cli::exit::{Exit, Failure, Result};
use crate::cli::output;
use dimos_log::replay::LogReader;
use dimos_log::scan::{Item, Scan};

/// Prints messages, one a line.
pub fn run(path: &Path, part: &Part, topics: &[String], json: bool) -> Result {
    let (from, to) = part.of(path)?;
    let known = LogReader::open(path).map_err(unreadable)?.info().topics.clone();
    if let Some(unknown) = topics.iter().find(|topic| !known.contains_key(*topic)) {
        let all = known.into_keys().collect::<Vec<_>>().join(", ");
        return Err(Failure::usage(format!("the log has no topic {unknown}")).hint(format!("topics: {all}")));
    }
    let began = from.saturating_sub(part.from.as_nanos() as u64);
    let mut scan = Scan::open_part(path, topics, (from, to)).map_err(unreadable)?;
    let mut out = BufWriter::with_capacity(256 * 1024, io::stdout().lock());
    let (mut line, mut unknown, mut bar) = (String::new(), 0, progress::of_scan(true));
    while let Some(item) = scan.next_item().map_err(unreadable)? {
        bar(&scan);
        let Item::Messages = item else { continue };
        for (message, channel, bytes) in scan.messages() {
            if !(from..=to).contains(&message.time) || !(topics.is_empty() || topics.contains(&channel.topic)) {
                continue;
            }
            line.clear();
            let (time, topic) = (message.time, &channel.topic);
            let _ = match json {
                true => write!(line, "{{\"topic\":{},\"log_time\":{time},\"data\":", Value::from(topic.as_str())),
                false => {
                    write!(line, "{:10.3}  {}  ", time.saturating_sub(began) as f64 * 1e-9, safe(topic, false))
                }
            };
            let start = line.len();
            if channel.json(bytes, &mut line).is_err() {
                line.truncate(start);
                line.push_str("null");
                unknown += 1;
            }
            line.push_str(if json { "}\n" } else { "\n" });
            if !written(&mut out, &in_json(&line))? {
                return Ok(Exit::Ok);
            }
        }
    }
    if !written(&mut out, "")? || !output::written(out.flush()) {
        return Ok(Exit::Ok);
    }
    scan.not_decoded(unknown);
    Ok(ended(scan.loss().text().as_deref()))
}
