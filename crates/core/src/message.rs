//! A message: what went wrong, and what to do about it. Errors of adapters and readers are text with the hint in a
//! separate line, `hint: …`; this module separates the two.

use std::fmt;

/// Separates what went wrong from the hint.
const HINT: &str = "\nhint: ";

/// A sentence without full stop, with an optional hint.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Message {
    /// What went wrong and where.
    pub what: String,
    /// What to do about it.
    pub hint: Option<String>,
}

impl Message {
    /// Splits the text of an error into what went wrong and the hint.
    pub fn of(error: impl fmt::Display) -> Self {
        error.to_string().into()
    }

    /// Returns what went wrong, and the hint or else the given one.
    pub fn or_hint(self, general: impl Into<String>) -> (String, String) {
        (self.what, self.hint.unwrap_or_else(|| general.into()))
    }
}

impl From<String> for Message {
    fn from(text: String) -> Self {
        match text.split_once(HINT) {
            Some((what, hint)) => Self { what: what.to_owned(), hint: Some(hint.to_owned()) },
            None => Self { what: text, hint: None },
        }
    }
}

impl fmt::Display for Message {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.what)?;
        match &self.hint {
            Some(hint) => write!(f, "{HINT}{hint}"),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_message_is_the_same_after_conversion_to_text_and_back() {
        let both = Message { what: "no answer".into(), hint: Some("is it powered?\nhint: look".into()) };
        assert_eq!(both.to_string(), "no answer\nhint: is it powered?\nhint: look");
        assert_eq!(Message::of(&both), both);
        let bare = Message { what: "two\nlines".into(), hint: None };
        assert_eq!((Message::of(&bare), bare.clone().or_hint("general").1), (bare, "general".to_owned()));
    }
}
