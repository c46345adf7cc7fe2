//! Error recovery: reads again after each mistake until none is left. One pass per mistake.
//!
//! * unknown key: skip it;
//! * bad value: skip its entry, so that its default applies;
//! * missing key: use a placeholder;
//! * rejected placeholder: skip the group around it.
//!
//! Mistakes that only follow from these are not reported.

use std::collections::{HashMap, HashSet};

use serde::de::DeserializeOwned;

use crate::de::{De, Workaround};
use crate::diag::Diag;
use crate::error::{ReadError, What};
use crate::scalar::number_hint;
use crate::suggest::{closest, did_you_mean, quote};
use crate::tree::{Kind, NodeId, Tree};

/// Maximum number of passes, and so of mistakes.
const MAX_PASSES: usize = 100;

/// Whether a missing key is a mistake: not if part of the file could not be read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Missing {
    /// It is a mistake.
    Report,
    /// It may be in the unreadable part.
    Ignore,
}

/// Nodes that a read skipped. Later checks consult it to avoid complaints about values that are present but wrong.
#[derive(Debug, Clone, Default)]
pub struct Lost {
    nodes: HashSet<NodeId>,
    keys: HashMap<NodeId, HashSet<String>>,
    dropped: HashSet<NodeId>,
}

impl Lost {
    /// Returns whether something in or under a node was skipped.
    pub fn contains(&self, node: NodeId) -> bool {
        self.nodes.contains(&node)
    }

    /// Returns whether a value was skipped as a whole.
    pub fn dropped(&self, node: NodeId) -> bool {
        self.dropped.contains(&node)
    }

    /// Returns whether a key of a group was skipped, or a skipped one was probably meant to be this key.
    pub fn key(&self, map: NodeId, key: &str) -> bool {
        self.keys.get(&map).is_some_and(|keys| keys.contains(key))
    }

    /// Adds the nodes skipped by another read.
    pub fn extend(&mut self, other: Lost) {
        self.nodes.extend(other.nodes);
        self.dropped.extend(other.dropped);
        for (map, keys) in other.keys {
            self.keys.entry(map).or_default().extend(keys);
        }
    }

    fn note(&mut self, trail: &[NodeId]) {
        self.nodes.extend(trail);
    }

    fn note_key(&mut self, map: NodeId, key: &str) {
        self.keys.entry(map).or_default().insert(key.to_owned());
    }
}

/// Reads `root` as `T` and reports every mistake. Returns `None` if no value could be built.
pub fn read<T: DeserializeOwned>(tree: &mut Tree, root: NodeId, missing: Missing) -> (Option<T>, Lost) {
    let mut recovery = Recovery {
        workaround: Workaround::default(),
        lost: Lost { nodes: tree.damaged.clone(), ..Lost::default() },
        missing,
    };
    for _ in 0..MAX_PASSES {
        let de = De { tree, workaround: &recovery.workaround, node: root, key: false };
        match T::deserialize(de) {
            Ok(value) => return (Some(value), recovery.lost),
            Err(error) => {
                if !recovery.recover(tree, error.inside(root)) {
                    return (None, recovery.lost);
                }
            }
        }
    }
    tree.unlisted[0] += 1;
    recovery.lost.note(&[root]);
    (None, recovery.lost)
}

struct Recovery {
    workaround: Workaround,
    lost: Lost,
    missing: Missing,
}

impl Recovery {
    /// Reports a mistake and makes the next pass avoid it; `false` if that is impossible.
    fn recover(&mut self, tree: &mut Tree, error: ReadError) -> bool {
        let ReadError { what, trail } = error;
        let Some(&at) = trail.first() else { return false };
        match what {
            What::UnknownKey { given, known } => {
                let meant = closest(&given, known.iter().copied());
                let hint = unknown_key_hint(tree, &given, known);
                let diag = Diag::error(format!("unknown key {}", quote(&given))).at(tree.label(at));
                tree.report(diag.maybe_hint(hint));
                if let (Some(&map), Some(meant)) = (trail.get(2), meant) {
                    self.lost.note_key(map, meant);
                }
                self.drop_innermost(tree, &trail)
            }
            What::MissingKey(key) => {
                let known = self.lost.key(at, key);
                if !known && self.missing == Missing::Report && !tree.damaged.contains(&at) {
                    let diag = Diag::error(format!("the key `{key}` is missing{}", self.context(tree, &trail)));
                    tree.report(diag.at(tree.label(at)).hint(format!("add `{key}: …` to this group")));
                }
                self.lost.note(&trail);
                self.lost.note_key(at, key);
                let placeholders = self.workaround.placeholders.entry(at).or_default();
                if placeholders.contains(&key) {
                    return self.drop_innermost(tree, &trail);
                }
                placeholders.push(key);
                true
            }
            What::Placeholder => self.drop_innermost(tree, &trail),
            What::Value { message, hint } => {
                self.report_value(tree, &trail, message, hint);
                self.drop_innermost(tree, &trail)
            }
            What::Variant { given, known } => {
                let hint = did_you_mean(&given, known.iter().copied(), "known words");
                let message = format!("{} is not one of {}", quote(&given), known.join(", "));
                let hint = hint.filter(|h| h.starts_with("did"));
                self.report_value(tree, &trail, message, hint.or_else(|| Some("write one of these words".to_owned())));
                self.drop_innermost(tree, &trail)
            }
        }
    }

    /// Reports a bad value, unless something inside was skipped or another read already reported this position: then it
    /// is only a consequence.
    fn report_value(&self, tree: &mut Tree, trail: &[NodeId], message: String, hint: Option<String>) {
        let Some(&at) = trail.first() else { return };
        if self.lost.contains(at) || tree.has_report_at(at) {
            return;
        }
        let name = name_of(tree, trail);
        let hint = hint.or_else(|| value_hint(tree, at, &message));
        let message = if name.is_empty() { message } else { format!("`{name}`: {message}") };
        tree.report(Diag::error(message).at(tree.label(at)).maybe_hint(hint));
    }

    /// Returns ` in …` if the group has a name.
    fn context(&self, tree: &Tree, trail: &[NodeId]) -> String {
        match name_of(tree, trail) {
            name if name.is_empty() => String::new(),
            name => format!(" in `{name}`"),
        }
    }

    /// Skips the innermost entry or element; `false` if the mistake is in the root itself.
    fn drop_innermost(&mut self, tree: &Tree, trail: &[NodeId]) -> bool {
        self.lost.note(trail);
        let (value, parent) = match *trail {
            // The mistake is in a key: skip its value too.
            [key, value, map, ..] if tree.entries(map).contains(&(key, value)) => (value, map),
            [value, parent, ..] => (value, parent),
            _ => return false,
        };
        if let Some((key, _)) = tree.entries(parent).iter().find(|(_, v)| *v == value)
            && let Some(key) = tree.text(*key)
        {
            self.lost.note_key(parent, key);
        }
        self.lost.dropped.insert(value);
        self.workaround.dropped.insert(value)
    }
}

/// Returns the hint for an unknown key.
fn unknown_key_hint(tree: &Tree, given: &str, known: &[&'static str]) -> Option<String> {
    if given == "<<" {
        return Some("YAML 1.2 has no merge keys; repeat the keys, or use `include`".to_owned());
    }
    if !given.is_empty() && given.chars().all(|c| c.is_ascii_digit()) {
        return Some(format!("if this is part of a number, use a decimal point: 0.{given}"));
    }
    if closest(given, known.iter().copied()).is_none()
        && let Some(hint) = tree.hint_of(given)
    {
        return Some(hint);
    }
    match known.is_empty() {
        true => Some("remove it; this group takes no keys".to_owned()),
        false => did_you_mean(given, known.iter().copied(), "known keys"),
    }
}

/// Returns the hint for a value of the wrong kind, if the Deserializer gave none.
fn value_hint(tree: &Tree, at: NodeId, message: &str) -> Option<String> {
    let wanted = message.strip_prefix("expected ")?.split(", found").next()?;
    let general = match () {
        _ if wanted.contains("whole number") => "write a whole number, such as 6",
        _ if wanted.contains("number") => "write a number, such as 1.5",
        _ if wanted.contains("group") => "write its keys below it: `key: value`",
        _ if wanted.contains("list") => "write the values in brackets: [A, B]",
        _ if wanted.contains("text") => "write a word, or a text in quotes",
        _ => "see docs/blueprint-reference.md for the allowed values",
    };
    let specific = match tree.node(at).map(|n| &n.kind) {
        Some(Kind::Scalar { text, plain }) if wanted.contains("number") => number_hint(text, *plain),
        Some(Kind::Scalar { text, .. }) if wanted.contains("list") && !text.is_empty() => {
            Some(format!("write it in brackets: [{text}]"))
        }
        Some(Kind::Seq(_)) if wanted.contains("number") && !wanted.contains("list") => {
            Some("write one number, without brackets".to_owned())
        }
        _ => None,
    };
    specific.or_else(|| Some(general.to_owned()))
}

/// Returns the name of the innermost node: its key, or `key[2]` for an element of a list.
fn name_of(tree: &Tree, trail: &[NodeId]) -> String {
    let mut suffix = String::new();
    for pair in trail.windows(2) {
        let &[node, parent] = pair else { break };
        match tree.node(parent).map(|n| &n.kind) {
            Some(Kind::Map(entries)) => {
                let key = entries.iter().find(|(k, v)| *v == node || *k == node).and_then(|(k, _)| tree.text(*k));
                return key.map(|key| format!("{}{suffix}", quote(key).trim_matches('`'))).unwrap_or_default();
            }
            Some(Kind::Seq(items)) => {
                let index = items.iter().position(|i| *i == node).unwrap_or_default();
                suffix = format!("[{index}]{suffix}");
            }
            _ => break,
        }
    }
    String::new()
}
