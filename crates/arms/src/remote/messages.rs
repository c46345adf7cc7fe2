//! The messages of captures.

use serde_json::Value;

use super::address::Address;
use super::protocol::Reply;
use dimos_hardware::transport::Scan;
use dimos_hardware::wire::{Message, Place, Wire, line, no_checksum};

/// How captures of this arm are read.
pub const WIRE: Wire = Wire {
    connections: |address| Address::parse(address).map(|at| vec![("peer", at.to_string())]).unwrap_or_default(),
    scan,
    mend: no_checksum,
};

fn scan(place: Place<'_>, bytes: &[u8]) -> Scan<Message> {
    line(bytes, |text| {
        let Ok(Value::Object(content)) = serde_json::from_str(text) else {
            return Message::named("no JSON").decoded(false);
        };
        if place.sent {
            let command = if content.contains_key("command") { " with a command" } else { "" };
            return Message::named(format!(
                "{}{command}",
                content.get("do").and_then(Value::as_str).unwrap_or("nothing")
            ));
        }
        let kind = ["info", "position", "error"].into_iter().find(|key| content.contains_key(*key)).unwrap_or("done");
        let status = i64::from(content.get("error").is_some_and(|error| !error.is_null()));
        // A hello has another form than all other replies.
        let takes = kind == "info" || Reply::decode(text.as_bytes()).is_ok();
        Message::named(format!("reply: {kind}")).status(status).decoded(takes)
    })
}
