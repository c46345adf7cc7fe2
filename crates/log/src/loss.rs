//! What a log lacks, in one sentence for all verbs.

use super::records::Damage;

/// What was found missing or wrong while a log was read.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Loss {
    /// Unix time of the log's first message [ns].
    pub began: u64,
    /// Damaged parts.
    pub damage: Vec<Damage>,
    /// Why the log ends early.
    pub cut: Option<String>,
    /// How many messages are missing, of how many that its summary counts; 0: none are, or it is not known.
    pub missing: (u64, u64),
    /// Messages of channels that nothing describes: they are left out.
    pub unknown: u64,
    /// Messages that cannot be decoded by their schema.
    pub undecoded: u64,
    /// Attachments and metadata that are damaged, with what became of them.
    pub others: Vec<String>,
}

impl Loss {
    /// Returns what is missing or wrong; `None` if nothing is.
    pub fn text(&self) -> Option<String> {
        let mut parts = Vec::new();
        if let Some(first) = self.damage.first() {
            let seconds = |time: u64| time.saturating_sub(self.began) as f64 * 1e-9;
            let span = match first.span {
                None => String::new(),
                // A file is missing, and no other one shows where that ends.
                Some((from, to)) if from == to && first.at == 0 => format!(" (at {:.3} s)", seconds(from)),
                Some((from, to)) => format!(" (messages from {:.3} s to {:.3} s)", seconds(from), seconds(to)),
            };
            let more = match self.damage.len() {
                1 => String::new(),
                n => format!("; damaged in {} more places", n - 1),
            };
            parts.push(format!("{first}{span}{more}"));
        }
        parts.extend(self.cut.clone());
        let (missing, of) = self.missing;
        let counts = [
            (missing, format!("{missing} of {of} messages are missing")),
            (self.unknown, format!("{} messages belong to no known channel", self.unknown)),
            (self.undecoded, format!("{} messages cannot be decoded by their schema", self.undecoded)),
        ];
        parts.extend(counts.into_iter().filter(|(count, _)| *count > 0).map(|(_, text)| text));
        parts.extend(self.others.iter().cloned());
        (!parts.is_empty()).then(|| parts.join("; "))
    }
}
