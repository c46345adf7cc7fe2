//! The error of the Deserializer: what is wrong, and the nodes around it, innermost first.

use std::fmt;

use serde::de::{Expected, Unexpected};

use crate::tree::NodeId;
use dimos_core::message::Message;

/// Kind of error.
#[derive(Debug, Clone)]
pub(super) enum What {
    /// A value has the wrong type or range.
    Value { message: String, hint: Option<String> },
    /// An unknown enum variant.
    Variant { given: String, known: &'static [&'static str] },
    /// An unknown key.
    UnknownKey { given: String, known: &'static [&'static str] },
    /// A missing required key.
    MissingKey(&'static str),
    /// A placeholder for a missing value was rejected; the missing key has been reported.
    Placeholder,
}

/// An error on its way out of the Deserializer.
#[derive(Debug, Clone)]
pub(super) struct ReadError {
    pub(super) what: What,
    /// The nodes around it, innermost first.
    pub(super) trail: Vec<NodeId>,
}

impl ReadError {
    pub(super) fn new(what: What) -> Self {
        Self { what, trail: Vec::new() }
    }

    pub(super) fn value(message: impl Into<String>, hint: Option<String>) -> Self {
        Self::new(What::Value { message: message.into(), hint })
    }

    /// Adds an enclosing node.
    pub(super) fn inside(mut self, node: NodeId) -> Self {
        if self.trail.last() != Some(&node) {
            self.trail.push(node);
        }
        self
    }
}

impl fmt::Display for ReadError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.what {
            What::Value { message, .. } => f.write_str(message),
            What::Variant { given, .. } => write!(f, "unknown word `{given}`"),
            What::UnknownKey { given, .. } => write!(f, "unknown key `{given}`"),
            What::MissingKey(key) => write!(f, "the key `{key}` is missing"),
            What::Placeholder => f.write_str("a required value is missing"),
        }
    }
}

impl std::error::Error for ReadError {}

impl serde::de::Error for ReadError {
    /// Splits a `hint: …` line off the message.
    fn custom<T: fmt::Display>(message: T) -> Self {
        let Message { what, hint } = Message::of(message);
        Self::value(what, hint)
    }

    fn invalid_type(found: Unexpected<'_>, expected: &dyn Expected) -> Self {
        let found = match found {
            Unexpected::Seq => "a list".to_owned(),
            Unexpected::Map => "a group of keys".to_owned(),
            Unexpected::Unit | Unexpected::Option => "nothing".to_owned(),
            Unexpected::Str(text) => format!("the text {}", crate::quote(text)),
            Unexpected::Unsigned(n) => format!("the number `{n}`"),
            Unexpected::Signed(n) => format!("the number `{n}`"),
            Unexpected::Float(n) => format!("the number `{n}`"),
            Unexpected::Bool(b) => format!("the boolean `{b}`"),
            other => other.to_string(),
        };
        Self::value(format!("expected {expected}, found {found}"), None)
    }

    fn invalid_value(found: Unexpected<'_>, expected: &dyn Expected) -> Self {
        Self::invalid_type(found, expected)
    }

    fn unknown_variant(given: &str, known: &'static [&'static str]) -> Self {
        Self::new(What::Variant { given: given.to_owned(), known })
    }

    fn unknown_field(given: &str, known: &'static [&'static str]) -> Self {
        Self::new(What::UnknownKey { given: given.to_owned(), known })
    }

    fn missing_field(field: &'static str) -> Self {
        Self::new(What::MissingKey(field))
    }
}
