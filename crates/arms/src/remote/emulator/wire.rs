//! The protocol as the server sees it: requests in, replies out. Written from the sheet a second time, on purpose
//! without `protocol.rs`: an emulator that shared the adapter's encoders would share its mistakes.

use serde_json::{Map, Value, json};

use dimos_hardware::adapter::AdapterError;
use dimos_hardware::transport::Scan;

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
    /// The client's version of the protocol, in a hello.
    pub version: Option<u64>,
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
    /// Since version 2: lists by their names on the sheet, as far as they came.
    pub lists: Map<String, Value>,
    /// The client's time [ns], and how long it holds [s].
    pub at: Option<u64>,
    /// The same.
    pub valid: Option<f64>,
}

impl Command {
    /// One of its lists; an error for what is no list of numbers.
    pub fn list(&self, name: &str) -> Result<Option<Vec<f64>>, String> {
        let Some(list) = self.lists.get(name) else { return Ok(None) };
        let numbers = list.as_array().and_then(|list| list.iter().map(Value::as_f64).collect::<Option<Vec<_>>>());
        numbers.map(Some).ok_or_else(|| format!("{name} is no list of numbers"))
    }
}

/// Finds a line at the front of what has arrived: a request, or what to tell a client that speaks something else.
pub fn scan(bytes: &[u8]) -> Scan<Result<Request, &'static str>> {
    let Some(end) = bytes.iter().position(|byte| *byte == b'\n') else {
        let endless = bytes.len() > LONGEST;
        return if endless { Scan::Take(bytes.len(), Err("a line without end")) } else { Scan::More };
    };
    let line = bytes.get(..end).unwrap_or_default();
    let request = serde_json::from_slice::<Value>(line).map_err(|_| "a line that is not JSON");
    let what = "a request without id or do, or with a command that is none";
    Scan::Take(end + 1, request.and_then(|request| understand(&request).ok_or(what)))
}

fn understand(request: &Value) -> Option<Request> {
    let command = match request.get("command") {
        None => None,
        Some(command) => Some(Command {
            mode: command.get("mode")?.as_str()?.to_owned(),
            values: command.get("values")?.as_array()?.iter().map(Value::as_f64).collect::<Option<_>>()?,
            velocity: command.get("velocity")?.as_f64()?,
            lists: command
                .as_object()?
                .iter()
                .filter(|(_, v)| v.is_array())
                .map(|(k, v)| (k.clone(), v.clone()))
                .collect(),
            at: command.get("at").and_then(Value::as_u64),
            valid: command.get("valid").and_then(Value::as_f64),
        }),
    };
    let arguments = request.get("args").and_then(Value::as_array).cloned().unwrap_or_default();
    Some(Request {
        id: request.get("id")?.as_u64()?,
        what: request.get("do")?.as_str()?.to_owned(),
        arguments,
        command,
        version: request.get("version").and_then(Value::as_u64),
    })
}

/// Writes a good reply.
pub fn done(out: &mut Vec<u8>, id: u64, mut content: Map<String, Value>) {
    content.insert("id".to_owned(), id.into());
    out.extend(Value::Object(content).to_string().bytes().chain([b'\n']));
}

/// Writes a reply that says why not.
pub fn refused(out: &mut Vec<u8>, id: u64, error: &AdapterError) {
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
    done(out, id, content.as_object().cloned().unwrap_or_default())
}
