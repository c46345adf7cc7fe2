//! Copies of logs in which something was changed.

use std::borrow::Cow;
use std::path::Path;

use dimos::recording::cdr::Encoder;
use dimos::recording::replay::{LogReader, attachment};
use dimos::recording::wire::Message;

/// Copies a log message by message; `change` gets topic and bytes, and may answer with other bytes.
pub fn rewrite(from: &Path, to: &Path, change: impl FnMut(&str, &[u8]) -> Option<Vec<u8>>) {
    copy(from, to, &["coordinator.json"], change);
}

/// Copies a log without the files that go along with it.
pub fn without_attachments(from: &Path, to: &Path) {
    copy(from, to, &[], |_, _| None);
}

/// Copies a log and changes one message: that with this number on this topic, counted from 0.
pub fn tamper<M: Message>(from: &Path, to: &Path, topic: &str, number: usize, change: impl Fn(&mut M)) {
    let mut count = 0;
    let mut changed = false;
    rewrite(from, to, |t, bytes| {
        count += usize::from(t == topic);
        if t != topic || count != number + 1 {
            return None;
        }
        let mut message = M::decode(bytes).unwrap();
        change(&mut message);
        let mut out = Encoder::default();
        message.put(&mut out);
        changed = out.bytes() != bytes;
        Some(out.bytes().to_vec())
    });
    assert!(changed, "message {number} on {topic} was not changed");
}

fn copy(from: &Path, to: &Path, attachments: &[&str], mut change: impl FnMut(&str, &[u8]) -> Option<Vec<u8>>) {
    let metadata = LogReader::open(from).unwrap().info().metadata.clone();
    let mut writer = mcap::Writer::new(std::fs::File::create(to).unwrap()).unwrap();
    for name in attachments {
        let data = Cow::Owned(attachment(from, name).unwrap().unwrap());
        let media_type = "application/json".to_owned();
        let attached = mcap::Attachment { log_time: 0, create_time: 0, name: (*name).to_owned(), media_type, data };
        writer.attach(&attached).unwrap();
    }
    writer.write_metadata(&mcap::records::Metadata { name: "dimos".into(), metadata }).unwrap();
    let bytes = std::fs::read(from).unwrap();
    // In the order of the file: messages of a cut or closed log alike.
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        let mut message = message.unwrap();
        if let Some(other) = change(&message.channel.topic, &message.data) {
            message.data = Cow::Owned(other);
        }
        writer.write(&message).unwrap();
    }
    writer.finish().unwrap();
}
