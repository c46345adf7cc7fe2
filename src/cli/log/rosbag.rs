//! `dimos log export --rosbag2`: a folder that `ros2 bag` opens.

use std::fmt::Write as _;
use std::path::Path;

use serde_json::json;

use super::copy::failure;
use super::export::cannot_write;
use super::{Part, ended, progress, unreadable};
use crate::cli::exit::Result;
use crate::cli::output;
use dimos_log::rewrite::{Label, copy};
use dimos_log::scan::Scan;

/// Writes a log, or a part of it, as one file with a `metadata.yaml`.
pub fn run(path: &Path, part: &Part, folder: &Path, json: bool) -> Result {
    let part = part.of(path)?;
    std::fs::create_dir(folder).map_err(|e| cannot_write(folder, e))?;
    let name = format!("{}_0.mcap", folder.file_name().unwrap_or_default().display());
    let to = folder.join(&name);
    let mut scan = Scan::open_part(path, &[], part).map_err(unreadable)?.with_earlier();
    // Readers of bags refuse other profiles.
    let label = Label { profile: Some("ros2"), ..Label::default() };
    copy(&mut scan, &to, label, progress::of_scan(false)).map_err(|e| failure(e, &to))?;
    let others = scan.channels.values().filter(|channel| channel.encoding != "cdr");
    let others: Vec<&str> = others.map(|channel| channel.topic.as_str()).collect();
    if !others.is_empty() {
        output::note(format_args!("warning: ROS 2 cannot read {}: the messages are not CDR", others.join(", ")));
    }
    let metadata = metadata(&to, &name).map_err(unreadable)?;
    let file = folder.join("metadata.yaml");
    std::fs::write(&file, metadata).map_err(|e| cannot_write(&file, e))?;
    let lost = scan.loss().text();
    output::done(format_args!("{}", folder.display()), json!({"folder": folder, "loss": lost}), json);
    Ok(ended(lost.as_deref()))
}

/// Returns the description of a complete file, in version 5 of rosbag2's form: that of ROS 2 Humble, which later ones
/// read.
fn metadata(path: &Path, name: &str) -> std::result::Result<String, dimos_log::replay::ReplayError> {
    // Nothing of the file but its summary.
    let scan = Scan::open_part(path, &[], (0, 0))?;
    let figures = scan.statistics().map(|(_, figures)| figures.clone()).unwrap_or_default();
    let (start, messages) = (figures.message_start_time, figures.message_count);
    let duration = figures.message_end_time.saturating_sub(start);
    let mut topics = String::new();
    for (id, channel) in &scan.channels {
        let qos = channel.metadata.get("offered_qos_profiles").map_or("", String::as_str);
        // JSON texts are YAML texts.
        let texts = [&*channel.topic, &*channel.schema.0, qos, &*channel.encoding];
        let [topic, schema, qos, encoding] = texts.map(|text| json!(text));
        let count = figures.channel_message_counts.get(id).unwrap_or(&0);
        let _ = writeln!(
            topics,
            "    - topic_metadata:\n        name: {topic}\n        type: {schema}\n        serialization_format: {encoding}\n        \
             offered_qos_profiles: {qos}\n      message_count: {count}"
        );
    }
    let name = json!(name);
    Ok(format!(
        "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: mcap\n  duration:\n    nanoseconds: {duration}\n  \
         starting_time:\n    nanoseconds_since_epoch: {start}\n  message_count: {messages}\n  \
         topics_with_message_count:\n{topics}  compression_format: \"\"\n  compression_mode: \"\"\n  \
         relative_file_paths:\n    - {name}\n  files:\n    - path: {name}\n      starting_time:\n        \
         nanoseconds_since_epoch: {start}\n      duration:\n        nanoseconds: {duration}\n      \
         message_count: {messages}\n"
    ))
}
