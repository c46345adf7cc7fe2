//! An exception that the caller's Python raises.

use super::pickle_reader::PickleError;
use super::pickle_writer::{Value, write};
use crate::rpc::client::ClientError;

/// Encoding of an exception. A reply in any other one leaves a caller waiting for its whole timeout, 120 s.
pub const ENCODING: &str = "dimos/rpc-exception";

/// An exception: one of Python's own classes, with its text.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PythonError {
    /// The class: `TypeError`.
    pub class: &'static str,
    /// The text.
    pub text: String,
}

impl PythonError {
    /// A wrong argument.
    pub fn of_type(text: impl Into<String>) -> Self {
        Self { class: "TypeError", text: text.into() }
    }

    /// A method that does not exist.
    pub fn attribute(text: impl Into<String>) -> Self {
        Self { class: "AttributeError", text: text.into() }
    }

    /// What this coordinator does not do.
    pub fn unsupported(text: impl Into<String>) -> Self {
        Self { class: "NotImplementedError", text: text.into() }
    }

    /// What the run's owner does not allow.
    pub fn forbidden(text: impl Into<String>) -> Self {
        Self { class: "PermissionError", text: text.into() }
    }

    /// What failed.
    pub fn failed(text: impl Into<String>) -> Self {
        Self { class: "RuntimeError", text: text.into() }
    }

    /// Returns the bytes of the reply.
    pub fn encode(&self) -> Vec<u8> {
        write(&Value::Dict(vec![
            ("type_name", self.class.into()),
            ("type_module", "builtins".into()),
            ("args", Value::Tuple(vec![self.text.as_str().into()])),
            ("traceback", Value::Text(String::new())),
        ]))
    }
}

impl From<PickleError> for PythonError {
    fn from(error: PickleError) -> Self {
        Self::of_type(error.0)
    }
}

impl From<ClientError> for PythonError {
    fn from(error: ClientError) -> Self {
        Self::failed(text_of(&error))
    }
}

/// Returns an error of the run in one line, with its hint.
pub fn text_of(error: &ClientError) -> String {
    match error.hint() {
        Some(hint) => format!("{error} (hint: {hint})"),
        None => error.to_string(),
    }
}
