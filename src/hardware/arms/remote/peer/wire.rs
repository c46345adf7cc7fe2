//! The protocol as a peer sees it: requests in, replies out. Written from the sheet a second time, on purpose without
//! `protocol.rs`: a double that shared the adapter's encoders would share its mistakes.

use serde_json::{Map, Value, json};

use crate::hardware::spec::AdapterError;

/// Longest line of a client [bytes].
const LONGEST: usize = 16384;

/// A request as it came: its number, what it asks, and with what.
#[derive(Debug, Clone, PartialEq)]
pub struct Request {
    /// Repeated in the reply.
    pub id: u64,
    /// `hello`, `cycle`, or a method of the adapter.
    pub what: String,
    /// Arguments of a method.
    pub arguments: Vec<Value>,
    /// The command of a cycle.
    pub command: Option<Command>,
}

/// The command of a cycle.
#[derive(Debug, Clone, PartialEq)]
pub struct Command {
    /// As in a blueprint.
    pub mode: String,
    /// Positions [rad] or velocities [rad/s].
    pub values: Vec<f64>,
    /// Fraction of the top speed.
    pub velocity: f64,
}

/// Takes the first request off what has arrived; an error is what to tell a client that speaks something else.
pub fn take(arrived: &mut Vec<u8>) -> Result<Option<Request>, &'static str> {
    let Some(end) = arrived.iter().position(|byte| *byte == b'\n') else {
        return if arrived.len() > LONGEST { Err("a line without end") } else { Ok(None) };
    };
    let line: Vec<u8> = arrived.drain(..=end).collect();
    let request = serde_json::from_slice::<Value>(&line).map_err(|_| "a line that is not JSON")?;
    understand(&request).map(Some).ok_or("a request without id or do, or with a command that is none")
}

fn understand(request: &Value) -> Option<Request> {
    let command = match request.get("command") {
        None => None,
        Some(command) => Some(Command {
            mode: command.get("mode")?.as_str()?.to_owned(),
            values: command.get("values")?.as_array()?.iter().map(Value::as_f64).collect::<Option<_>>()?,
            velocity: command.get("velocity")?.as_f64()?,
        }),
    };
    let arguments = request.get("args").and_then(Value::as_array).cloned().unwrap_or_default();
    Some(Request {
        id: request.get("id")?.as_u64()?,
        what: request.get("do")?.as_str()?.to_owned(),
        arguments,
        command,
    })
}

/// A good reply.
pub fn done(id: u64, mut content: Map<String, Value>) -> Vec<u8> {
    content.insert("id".to_owned(), id.into());
    let mut line = Value::Object(content).to_string().into_bytes();
    line.push(b'\n');
    line
}

/// A reply that says why not.
pub fn refused(id: u64, error: &AdapterError) -> Vec<u8> {
    let (name, code) = match error {
        AdapterError::Io(_) => ("io", 0),
        AdapterError::Timeout(_) => ("timeout", 0),
        AdapterError::Protocol(_) => ("protocol", 0),
        AdapterError::Fault { code, .. } => ("fault", *code),
        AdapterError::Busy | AdapterError::Rejected(_) => ("rejected", 0),
        AdapterError::Unsupported => ("unsupported", 0),
        AdapterError::NotConnected => ("not_connected", 0),
    };
    let text = if let AdapterError::Fault { text, .. } = error { text.clone() } else { error.to_string() };
    let content = json!({ "error": name, "text": text, "code": code });
    done(id, content.as_object().cloned().unwrap_or_default())
}
