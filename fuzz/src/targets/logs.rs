//! Logs, and the messages in them.

use std::path::{Path, PathBuf};

use dimos::recording::cdr::{CdrError, Encoder};
use dimos::recording::messages::{ArmInput, ArmOutput, ArmStatus, Event, JointState, Log, Tick};
use dimos::recording::node_messages::{CancelRequest, FollowGoal, GoalStatusArray, MultiDofTrajectory};
use dimos::recording::records::check_sections;
use dimos::recording::replay::{LogReader, ReplayError};
use dimos::recording::ros2msg::Schema;
use dimos::recording::scan::Scan;
use dimos::recording::wire::Message;

use super::text;
use crate::{Target, bug};

/// A folder whose files are in memory.
pub fn memory() -> PathBuf {
    let shared = Path::new("/dev/shm");
    if shared.is_dir() { shared.to_owned() } else { std::env::temp_dir() }
}

/// Logs.
pub const MCAP: Target = Target {
    name: "mcap",
    about: "messages, damage with its place, or an error; never more entries than bytes",
    run: mcap,
    seeds: || vec![plain_log()],
};

/// A log without compression and checksums, which an engine can change.
fn plain_log() -> Vec<u8> {
    let mut out = std::io::Cursor::new(Vec::new());
    let options =
        mcap::WriteOptions::new().compression(None).calculate_chunk_crcs(false).calculate_data_section_crc(false);
    let options = options.calculate_summary_section_crc(false).calculate_attachment_crcs(false);
    let Ok(mut writer) = options.create(&mut out) else { return Vec::new() };
    let written = (|| -> mcap::McapResult<()> {
        let schema = writer.add_schema(JointState::SCHEMA, "ros2msg", JointState::schema_text().as_bytes())?;
        let channel = writer.add_channel(schema, "/joint_states", "cdr", &std::collections::BTreeMap::new())?;
        for sequence in 0..3 {
            let header = mcap::records::MessageHeader {
                channel_id: channel,
                sequence,
                log_time: u64::from(sequence) * 1000,
                publish_time: u64::from(sequence) * 1000,
            };
            writer.write_to_known_channel(
                &header,
                &encoded(&JointState { name: vec!["j".into()], position: vec![0.5], ..JointState::default() }),
            )?;
        }
        writer.finish().map(drop)
    })();
    drop(writer);
    written.map_or_else(|_| Vec::new(), |()| out.into_inner())
}

fn mcap(data: &[u8]) {
    let folder = tempfile::tempdir_in(memory()).expect("a folder");
    let path = folder.path().join("log.mcap");
    std::fs::write(&path, data).expect("a file");
    let sections = check_sections(&path);
    let (mut messages, mut damaged) = (0, 0);
    if let Ok(mut reader) = LogReader::open(&path) {
        loop {
            match reader.next_entry() {
                Ok(Some(_)) => messages += 1,
                Ok(None) => break,
                Err(ReplayError::Damaged { .. } | ReplayError::Cut { .. }) => damaged += 1,
                Err(_) => break,
            }
            assert!(messages + damaged <= data.len(), "more entries than bytes");
        }
        let _ = reader.loss();
    }
    if let Ok(mut scan) = Scan::open(&path) {
        let mut items = 0;
        while let Ok(Some(_)) = scan.next_item() {
            items += 1;
            assert!(items <= data.len(), "more items than bytes");
        }
    }
    bug(1, messages == 4);
    bug(2, damaged > 0 && messages > 0);
    bug(3, matches!(sections, Ok(Some(_))) && messages > 1);
}

/// Messages in CDR; the first byte is the type.
pub const CDR: Target = Target {
    name: "cdr",
    about: "a message that is the same written and read, or an error, without large allocations",
    run: cdr,
    seeds: || {
        let with = |kind: u8, bytes: Vec<u8>| [vec![kind], bytes].concat();
        vec![
            with(
                0,
                encoded(&JointState {
                    name: vec!["a".into(), "b".into()],
                    position: vec![1.0, 2.0],
                    ..JointState::default()
                }),
            ),
            with(1, encoded(&Tick::default())),
            with(2, encoded(&Event::default())),
            with(3, encoded(&ArmInput::default())),
            with(4, encoded(&ArmOutput::default())),
            with(5, encoded(&ArmStatus::default())),
            with(6, encoded(&Log::default())),
            with(7, encoded(&FollowGoal::default())),
            with(8, encoded(&CancelRequest::default())),
            with(9, encoded(&GoalStatusArray::default())),
            with(10, encoded(&MultiDofTrajectory::default())),
        ]
    },
};

fn encoded<M: Message>(message: &M) -> Vec<u8> {
    let mut out = Encoder::default();
    out.restart();
    message.put(&mut out);
    out.bytes().to_vec()
}

/// Decodes a message; what is written of it must be read as the same.
fn both_ways<M: Message>(bytes: &[u8]) -> Result<M, CdrError> {
    let message = M::decode(bytes)?;
    let first = encoded(&message);
    let again = M::decode(&first).expect("what was written is read");
    assert_eq!(encoded(&again), first, "another message");
    Ok(message)
}

fn cdr(data: &[u8]) {
    let Some((kind, bytes)) = data.split_first() else { return };
    match kind % 11 {
        0 => {
            let Ok(state) = both_ways::<JointState>(bytes) else { return };
            bug(1, state.position.len() == 4);
            bug(2, state.name.iter().any(|name| name.len() > 2) && state.velocity.len() == 1);
        }
        1 => drop(both_ways::<Tick>(bytes)),
        2 => drop(both_ways::<Event>(bytes)),
        3 => drop(both_ways::<ArmInput>(bytes)),
        4 => drop(both_ways::<ArmOutput>(bytes)),
        5 => drop(both_ways::<ArmStatus>(bytes)),
        6 => drop(both_ways::<Log>(bytes)),
        7 => {
            let Ok(goal) = both_ways::<FollowGoal>(bytes) else { return };
            bug(3, !goal.trajectory.points.is_empty());
        }
        8 => drop(both_ways::<CancelRequest>(bytes)),
        9 => drop(both_ways::<GoalStatusArray>(bytes)),
        _ => drop(both_ways::<MultiDofTrajectory>(bytes)),
    }
}

/// A schema, a zero, and a message of it.
pub const SCHEMA: Target = Target {
    name: "schema",
    about: "a message as JSON in bounded time and memory, or an error",
    run: schema,
    seeds: || {
        let state = JointState { name: vec!["a".into()], position: vec![1.0], ..JointState::default() };
        let with = |text: String, bytes: Vec<u8>| [text.into_bytes(), vec![0], bytes].concat();
        vec![
            with(JointState::schema_text(), encoded(&state)),
            with(
                "uint8[3] a\nstring<=5 b 'x'\nMy[] c\n===\nMSG: p/My\nfloat32 d\nbool[] e\nint8 F=3\n".into(),
                vec![0, 1, 0, 0, 1, 2, 3, 0, 0, 0, 0, 0],
            ),
        ]
    },
};

fn schema(data: &[u8]) {
    let Some(at) = data.iter().position(|byte| *byte == 0) else { return };
    let (Some(definition), message) = (text(&data[..at]), &data[at + 1..]) else { return };
    let Ok(schema) = Schema::parse("p/msg/Type", definition) else { return };
    let mut out = String::new();
    if schema.json(message, &mut out).is_ok() {
        serde_json::from_str::<serde_json::Value>(&out).expect("it is JSON");
        bug(1, out.contains("null"));
        bug(2, out.contains("[[") || out.contains("[{"));
        bug(3, out.contains("true"));
    }
    assert!(out.len() <= (1024 + 16 * message.len()) * 512, "{} bytes of {}", out.len(), message.len());
}
