//! The channels of all files of a log, and what its summaries count.

use std::collections::{BTreeMap, HashMap};

use mcap::parse_record;
use mcap::records::{Record, Statistics};

use super::cdr::CdrError;
use super::ros2msg::Schema;

/// A channel of a log.
#[derive(Debug, Clone, Default)]
pub struct LogChannel {
    /// Topic.
    pub topic: String,
    /// Encoding of messages: `cdr`.
    pub encoding: String,
    /// Further properties, such as the offered QoS.
    pub metadata: BTreeMap<String, String>,
    /// Name, encoding and text of the schema.
    pub schema: (String, String, Vec<u8>),
    /// The schema, to decode messages; an error if they cannot be decoded.
    pub decoder: Option<Schema>,
}

/// What describes channels, by file and its own ids.
#[derive(Default)]
pub(super) struct Described {
    schemas: HashMap<(usize, u16), (String, String, Vec<u8>)>,
    /// Ids in [`Scan::channels`](super::scan::Scan::channels).
    pub ids: HashMap<(usize, u16), u16>,
    /// Profile of the first file.
    pub profile: Option<String>,
    /// Statistics, by file.
    pub statistics: Vec<(usize, Statistics)>,
}

impl Described {
    /// Takes a record that describes messages. Equal channels of several files become one.
    pub fn learn(&mut self, channels: &mut BTreeMap<u16, LogChannel>, file: usize, opcode: u8, body: &[u8]) {
        match parse_record(opcode, body) {
            Ok(Record::Header(header)) => {
                self.profile.get_or_insert(header.profile);
            }
            Ok(Record::Schema { header, data }) => {
                self.schemas.insert((file, header.id), (header.name, header.encoding, data.into_owned()));
            }
            Ok(Record::Channel(channel)) => {
                let schema = self.schemas.get(&(file, channel.schema_id)).cloned().unwrap_or_default();
                let id = channel.id;
                let is_it = |known: &LogChannel| {
                    (&known.topic, &known.encoding, &known.metadata, &known.schema)
                        == (&channel.topic, &channel.message_encoding, &channel.metadata, &schema)
                };
                // Its own id if that is free: copies of a log have the same ids.
                let same = channels.get(&id).is_some_and(is_it).then_some(id);
                let same =
                    same.or_else(|| channels.iter().find(|(_, known)| file > 0 && is_it(known)).map(|(id, _)| *id));
                let free = || std::iter::once(id).chain(1..=u16::MAX).find(|id| !channels.contains_key(id));
                let Some(own) = same.or_else(free) else { return };
                self.ids.insert((file, id), own);
                if same.is_some() {
                    return;
                }
                let readable = schema.1 == "ros2msg" && channel.message_encoding == "cdr";
                let text = std::str::from_utf8(&schema.2).ok().filter(|_| readable);
                let decoder = text.and_then(|text| Schema::parse(&schema.0, text).ok());
                let (topic, encoding, metadata) = (channel.topic, channel.message_encoding, channel.metadata);
                channels.insert(own, LogChannel { topic, encoding, metadata, schema, decoder });
            }
            Ok(Record::Statistics(statistics)) => self.statistics.push((file, statistics)),
            _ => {}
        }
    }
}

impl LogChannel {
    /// Appends a message as JSON. An error if its schema is not understood, or if it does not match.
    pub fn json(&self, bytes: &[u8], out: &mut String) -> Result<(), CdrError> {
        self.decoder.as_ref().ok_or(CdrError::Header)?.json(bytes, out)
    }
}
