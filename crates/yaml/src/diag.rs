//! A diagnostic: what is wrong, where, and how to fix it.

use std::ops::Range;

use serde::Serialize;

use crate::tree::{SourceId, Tree};

/// Severity.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// Must be fixed before anything starts.
    Error,
    /// Works, but is probably not intended.
    Warning,
}

/// A marked range in a source.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Label {
    /// The source.
    pub source: SourceId,
    /// Bytes of its text.
    pub range: Range<usize>,
    /// Text beside the mark; may be empty.
    pub text: String,
}

impl Label {
    /// Returns a label at the start of a source.
    pub fn start_of(source: SourceId) -> Self {
        Self { source, range: 0..0, text: String::new() }
    }

    /// Returns the same label with a text.
    pub fn with_text(mut self, text: impl Into<String>) -> Self {
        self.text = text.into();
        self
    }
}

/// A diagnostic.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Diag {
    /// Severity.
    pub severity: Severity,
    /// What is wrong: a sentence without full stop.
    pub message: String,
    /// Position.
    pub at: Option<Label>,
    /// Related positions.
    pub also: Vec<Label>,
    /// Additional facts.
    pub notes: Vec<String>,
    /// How to fix it.
    pub hint: Option<String>,
}

impl Diag {
    fn new(severity: Severity, message: String) -> Self {
        Self { severity, message, at: None, also: Vec::new(), notes: Vec::new(), hint: None }
    }

    /// Creates an error.
    pub fn error(message: impl Into<String>) -> Self {
        Self::new(Severity::Error, message.into())
    }

    /// Creates a warning.
    pub fn warning(message: impl Into<String>) -> Self {
        Self::new(Severity::Warning, message.into())
    }

    /// Sets the position.
    pub fn at(mut self, label: Label) -> Self {
        self.at = Some(label);
        self
    }

    /// Adds a related position.
    pub fn also(mut self, label: Label) -> Self {
        self.also.push(label);
        self
    }

    /// Adds a fact.
    pub fn note(mut self, note: impl Into<String>) -> Self {
        self.notes.push(note.into());
        self
    }

    /// Sets the hint.
    pub fn hint(mut self, hint: impl Into<String>) -> Self {
        self.hint = Some(hint.into());
        self
    }

    /// Sets the hint, if there is one.
    pub fn maybe_hint(mut self, hint: Option<String>) -> Self {
        self.hint = hint.or(self.hint);
        self
    }

    /// Converts it to data, with file, line and column.
    pub fn located(&self, tree: &Tree) -> Report {
        let (file, line, column) = match &self.at {
            Some(label) => {
                let source = tree.source(label.source);
                let text = source.map_or("", |s| s.text.as_str());
                let before = text.get(..label.range.start).unwrap_or(text);
                let line_start = before.rfind('\n').map_or(0, |at| at + 1);
                let line = before.matches('\n').count() + 1;
                let column = before.get(line_start..).map_or(0, |t| t.chars().count()) + 1;
                (source.map(|s| s.name.clone()), Some(line), Some(column))
            }
            None => (None, None, None),
        };
        Report {
            severity: self.severity,
            file,
            line,
            column,
            message: self.message.clone(),
            notes: self.notes.clone(),
            hint: self.hint.clone(),
        }
    }
}

/// A diagnostic as data, for `--json`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Report {
    /// Severity.
    pub severity: Severity,
    /// The file, or the command-line option.
    pub file: Option<String>,
    /// Line, counted from 1.
    pub line: Option<usize>,
    /// Column in characters, counted from 1.
    pub column: Option<usize>,
    /// What is wrong.
    pub message: String,
    /// Additional facts.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub notes: Vec<String>,
    /// How to fix it.
    pub hint: Option<String>,
}

impl Report {
    /// Returns what is wrong, after the position if there is one.
    pub fn placed(&self) -> String {
        match (&self.file, self.line, self.column) {
            (Some(file), Some(line), Some(column)) => format!("{file}:{line}:{column}: {}", self.message),
            _ => self.message.clone(),
        }
    }
}
