//! Encoding of lines: requests, replies, stream messages.

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::error::{Code, RpcError};

/// Maximum length of a string `id` [bytes]; it is repeated in the reply.
const MAX_ID: usize = 128;

/// A request line; its parameters are not parsed yet.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Envelope {
    /// Chosen by the client, repeated in the reply: a number, a string, or null.
    #[serde(default)]
    pub id: Value,
    pub method: String,
    #[serde(default)]
    pub params: Value,
    /// The epoch (`status`) in which the client wanted it, if that was earlier.
    #[serde(default)]
    pub epoch: Option<u64>,
}

/// Parses a request line. An error has the id, or null if that could not be read.
pub(crate) fn read(line: &[u8]) -> Result<Envelope, (Value, RpcError)> {
    let malformed = |id: Value, what: String| {
        let hint = r#"one JSON object per line: {"id":1,"method":"state","params":{}}"#;
        Err((id, RpcError::new(Code::Malformed, what).hint(hint)))
    };
    let value: Value = match serde_json::from_slice(line) {
        Ok(value) => value,
        Err(e) => return malformed(Value::Null, format!("not a line of JSON: {e}")),
    };
    let id = match value.get("id") {
        Some(Value::Number(n)) => Value::Number(n.clone()),
        Some(Value::String(s)) if s.len() <= MAX_ID => Value::String(s.clone()),
        None | Some(Value::Null) => Value::Null,
        Some(_) => return malformed(Value::Null, "id is neither a number nor a short string".into()),
    };
    match serde_json::from_value(value) {
        Ok(envelope) => Ok(envelope),
        Err(e) => malformed(id, format!("not a request: {e}")),
    }
}

/// Encodes the reply to a request as a line.
pub(crate) fn reply<T: Serialize>(id: &Value, result: Result<T, RpcError>) -> String {
    #[derive(Serialize)]
    #[serde(rename_all = "snake_case")]
    enum Outcome<T> {
        Result(T),
        Error(RpcError),
    }
    #[derive(Serialize)]
    struct Line<'a, T> {
        id: &'a Value,
        #[serde(flatten)]
        outcome: Outcome<T>,
    }
    let outcome = match result {
        Ok(value) => Outcome::Result(value),
        Err(error) => Outcome::Error(error),
    };
    match serde_json::to_string(&Line { id, outcome }) {
        Ok(line) => line + "\n",
        Err(e) => reply::<()>(id, Err(RpcError::new(Code::Internal, format!("the reply cannot be encoded: {e}")))),
    }
}

/// Encodes a message of a subscription as a line. `data` is JSON; `lost` counts the messages that this client missed
/// just before.
pub(crate) fn message(stream: &str, subscription: u64, lost: u64, data: &str) -> String {
    let lost = if lost == 0 { String::new() } else { format!(r#","lost":{lost}"#) };
    format!("{{\"stream\":\"{stream}\",\"subscription\":{subscription}{lost},\"data\":{data}}}\n")
}

/// Encodes a message that was published before the subscription.
pub(crate) fn past_message(stream: &str, subscription: u64, data: &str) -> String {
    format!("{{\"stream\":\"{stream}\",\"subscription\":{subscription},\"past\":true,\"data\":{data}}}\n")
}

/// A line received by a client: a reply or a message of a subscription.
#[derive(Debug, Deserialize)]
pub(crate) struct Incoming {
    pub id: Option<u64>,
    #[serde(default)]
    pub result: Value,
    pub error: Option<RpcError>,
    pub stream: Option<String>,
    #[serde(default)]
    pub subscription: u64,
    #[serde(default)]
    pub lost: u64,
    #[serde(default)]
    pub past: bool,
    #[serde(default)]
    pub data: Value,
}
