//! Decoded messages of a log, and their channels.

use std::collections::{BTreeMap, HashMap};

use mcap::parse_record;
use mcap::records::{Channel, MessageHeader, Record, op};
use serde::Serialize;

use super::cdr::CdrError;
use super::messages::{
    ArmInput, ArmIo, ArmOutput, ArmStatus, Event, InertiaStamped, JointState, JointStatus, Log, PoseStamped, Text,
    Tick, WrenchStamped,
};
use super::replay::Selection;
use super::ros2msg::Schema;
use super::wire::Message;

/// Maximum length of a topic or schema name [bytes].
const MAX_NAME: usize = 1024;

/// A message of a log.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Entry {
    /// Topic.
    pub topic: String,
    /// Unix time [ns].
    pub log_time: u64,
    /// Contents.
    pub data: Payload,
    /// The publisher on this topic: a channel, which is the same in all files.
    #[serde(skip)]
    pub publisher: u16,
}

macro_rules! payloads {
    ($($name:ident)*) => {
        /// Contents of a message, for the types in logs of a run.
        #[derive(Debug, Clone, PartialEq, Serialize)]
        #[serde(untagged)]
        pub enum Payload {
            $(
                #[doc = concat!("A [`", stringify!($name), "`](super::messages::", stringify!($name), ").")]
                $name($name),
            )*
            /// Another type, decoded by the schema in the log.
            Other(serde_json::Value),
            /// A type whose schema is not understood.
            Unknown {
                /// Name of its schema.
                schema: String,
                /// Length.
                bytes: usize,
            },
            /// A message that does not match its schema.
            Damaged {
                /// Name of its schema.
                schema: String,
                /// The error.
                error: String,
            },
        }

        /// Returns how many fields of its messages are known here; `None`: the schema is unknown.
        fn known_fields(schema: &str, text: &str) -> Option<usize> {
            match schema {
                $($name::SCHEMA => $name::shared_fields(text),)*
                _ => None,
            }
        }

        fn decode(channel: &KnownChannel, bytes: &[u8]) -> Payload {
            let schema = channel.schema.as_str();
            let decoded = match (schema, channel.fields) {
                $(($name::SCHEMA, Some(fields)) => $name::decode_first(bytes, fields).map(Payload::$name),)*
                _ => match &channel.other {
                    Some(other) => by_schema(other, bytes),
                    None => return Payload::Unknown { schema: schema.into(), bytes: bytes.len() },
                },
            };
            decoded.unwrap_or_else(|e| Payload::Damaged { schema: schema.into(), error: e.to_string() })
        }
    };
}
payloads! {
    JointState Text WrenchStamped Log Tick Event ArmStatus ArmInput ArmOutput ArmIo InertiaStamped JointStatus PoseStamped
}

/// Decodes a message by the schema in the log.
fn by_schema(schema: &Schema, bytes: &[u8]) -> Result<Payload, CdrError> {
    let mut text = String::new();
    schema.json(bytes, &mut text)?;
    serde_json::from_str(&text).map(Payload::Other).map_err(|_| CdrError::Header)
}

/// Returns the header and bytes of a message record; `None` for other records.
pub(super) fn message(opcode: u8, body: &[u8]) -> Option<(MessageHeader, &[u8])> {
    if opcode != op::MESSAGE {
        return None;
    }
    let Ok(Record::Message { header, .. }) = parse_record(opcode, body) else { return None };
    Some((header, body.get(22..)?))
}

/// Name of a schema, the number of its fields that are known here, and otherwise the schema.
type KnownSchema = (String, Option<usize>, Option<Schema>);

/// The channels of a log read so far, by file and id.
#[derive(Default)]
pub(super) struct Channels {
    schemas: HashMap<(usize, u16), KnownSchema>,
    channels: HashMap<(usize, u16), KnownChannel>,
    publishers: Vec<Publisher>,
    /// Samples that the recorder lost, in the messages taken.
    pub lost: u64,
    /// Messages taken, wanted or not, and of these those of channels that are not described.
    pub count: u64,
    pub unknown: u64,
}

/// What two channels of different files have in common if they are of one publisher: topic, properties, and how many
/// equal ones its file has before.
type Publisher = (String, BTreeMap<String, String>, usize);

struct KnownChannel {
    topic: String,
    publisher: u16,
    schema: String,
    /// Number of known fields of its messages; `None`: they are not CDR with a ROS 2 schema known here.
    fields: Option<usize>,
    /// The schema of messages that are CDR with another one.
    other: Option<Schema>,
}

impl Channels {
    /// Takes schema and channel records. Skips invalid ones, and with them their messages.
    pub(super) fn learn(&mut self, file: usize, opcode: u8, body: &[u8]) {
        match opcode {
            op::SCHEMA => {
                if let Ok(Record::Schema { header, data }) = parse_record(opcode, body)
                    && header.name.len() <= MAX_NAME
                {
                    let text = std::str::from_utf8(&data).ok().filter(|_| header.encoding == "ros2msg");
                    let fields = text.and_then(|text| known_fields(&header.name, text));
                    let other =
                        text.filter(|_| fields.is_none()).and_then(|text| Schema::parse(&header.name, text).ok());
                    self.schemas.insert((file, header.id), (header.name, fields, other));
                }
            }
            op::CHANNEL => {
                if let Ok(Record::Channel(channel)) = parse_record(opcode, body)
                    && channel.topic.len() <= MAX_NAME
                {
                    self.add(file, channel);
                }
            }
            _ => {}
        }
    }

    fn add(&mut self, file: usize, channel: Channel) {
        let (schema, fields, other) = self.schemas.get(&(file, channel.schema_id)).cloned().unwrap_or_default();
        let is_cdr = channel.message_encoding == "cdr";
        let (fields, other) = (fields.filter(|_| is_cdr), other.filter(|_| is_cdr));
        let publisher = match self.channels.get(&(file, channel.id)) {
            Some(known) if known.topic == channel.topic => known.publisher,
            _ => self.publisher(file, &channel),
        };
        self.channels
            .insert((file, channel.id), KnownChannel { topic: channel.topic, publisher, schema, fields, other });
    }

    /// Returns the number of a publisher whose channel is new in a file.
    fn publisher(&mut self, file: usize, channel: &Channel) -> u16 {
        let of_file = self.channels.iter().filter(|((known, _), _)| *known == file).map(|(_, known)| known.publisher);
        let is_equal = |number: u16| {
            let known = self.publishers.get(usize::from(number));
            known.is_some_and(|(topic, metadata, _)| (topic, metadata) == (&channel.topic, &channel.metadata))
        };
        let own = (channel.topic.clone(), channel.metadata.clone(), of_file.filter(|number| is_equal(*number)).count());
        let known = self.publishers.iter().position(|known| *known == own);
        let number = known.unwrap_or(self.publishers.len());
        if known.is_none() {
            self.publishers.push(own);
        }
        number.try_into().unwrap_or(u16::MAX)
    }

    /// Returns whether all these channels of a file are described.
    pub(super) fn know(&self, file: usize, ids: &[u16]) -> bool {
        ids.iter().all(|id| self.channels.contains_key(&(file, *id)))
    }

    /// Takes a record; returns its message if it is selected.
    pub(super) fn take(&mut self, file: usize, opcode: u8, body: &[u8], wanted: &Selection) -> Option<Entry> {
        self.learn(file, opcode, body);
        let (header, bytes) = message(opcode, body)?;
        self.count += 1;
        let Some(channel) = self.channels.get(&(file, header.channel_id)) else {
            self.unknown += 1;
            return None;
        };
        if header.log_time < wanted.from || header.log_time > wanted.to {
            return None;
        }
        let chosen = wanted.topics.is_empty() || wanted.topics.contains(&channel.topic);
        if !chosen && channel.schema != Tick::SCHEMA {
            return None;
        }
        let data = decode(channel, bytes);
        if let Payload::Tick(tick) = &data {
            self.lost += u64::from(tick.dropped);
        }
        let (topic, publisher) = (channel.topic.clone(), channel.publisher);
        chosen.then_some(Entry { topic, log_time: header.log_time, data, publisher })
    }

    /// Returns the topics and their schemas.
    pub(super) fn topics(&self) -> BTreeMap<String, String> {
        self.channels.values().map(|c| (c.topic.clone(), c.schema.clone())).collect()
    }
}
