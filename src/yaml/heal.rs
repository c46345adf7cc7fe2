//! Reading that does not stop at the first mistake: note it, work round it, read again. One pass for each mistake.
//!
//! * an unknown key: leave it out;
//! * a bad value: leave its entry out, so that its default steps in;
//! * a missing key: put a stand-in for it;
//! * the stand-in is refused: leave the group around it out.
//!
//! A mistake that only follows from one of these is not reported.

use std::collections::{HashMap, HashSet};

use serde::de::DeserializeOwned;

use crate::yaml::de::{De, Detour};
use crate::yaml::diag::Diag;
use crate::yaml::error::{ReadError, What};
use crate::yaml::scalar::number_hint;
use crate::yaml::suggest::{closest, did_you_mean, quote};
use crate::yaml::tree::{Kind, NodeId, Tree};

/// More mistakes than these are not looked for.
const MAX_PASSES: usize = 100;

/// Whether a missing key is a mistake: not when a part of the file could not be read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Missing {
    /// It is.
    Report,
    /// It may be in the part that could not be read.
    Ignore,
}

/// What a read had to leave out. Whoever checks the meaning afterwards asks here, to not complain of the absence of
/// something that is there but wrong.
#[derive(Debug, Clone, Default)]
pub struct Lost {
    nodes: HashSet<NodeId>,
    keys: HashMap<NodeId, HashSet<String>>,
    dropped: HashSet<NodeId>,
}

impl Lost {
    /// Whether something in or under a node was left out.
    pub fn contains(&self, node: NodeId) -> bool {
        self.nodes.contains(&node)
    }

    /// Whether a value was left out as a whole.
    pub fn dropped(&self, node: NodeId) -> bool {
        self.dropped.contains(&node)
    }

    /// Whether a key of a group was left out, or what was left out was probably meant to be this key.
    pub fn key(&self, map: NodeId, key: &str) -> bool {
        self.keys.get(&map).is_some_and(|keys| keys.contains(key))
    }

    /// Adds what another read left out.
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

/// Reads `root` as `T` and reports every mistake. Gives `None` when nothing of the kind could be made of it.
pub fn read<T: DeserializeOwned>(tree: &mut Tree, root: NodeId, missing: Missing) -> (Option<T>, Lost) {
    let mut healer =
        Healer { detour: Detour::default(), lost: Lost { nodes: tree.damaged.clone(), ..Lost::default() }, missing };
    for _ in 0..MAX_PASSES {
        let de = De { tree, detour: &healer.detour, node: root, key: false };
        match T::deserialize(de) {
            Ok(value) => return (Some(value), healer.lost),
            Err(error) => {
                if !healer.work_round(tree, error.inside(root)) {
                    return (None, healer.lost);
                }
            }
        }
    }
    tree.unlisted += 1;
    healer.lost.note(&[root]);
    (None, healer.lost)
}

struct Healer {
    detour: Detour,
    lost: Lost,
    missing: Missing,
}

impl Healer {
    /// Reports a mistake and arranges that the next pass does not meet it; `false` when that is not possible.
    fn work_round(&mut self, tree: &mut Tree, error: ReadError) -> bool {
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
                let stand_ins = self.detour.stand_ins.entry(at).or_default();
                if stand_ins.contains(&key) {
                    return self.drop_innermost(tree, &trail);
                }
                stand_ins.push(key);
                true
            }
            What::StandIn => self.drop_innermost(tree, &trail),
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

    /// Reports a bad value, unless something in it was left out before, or another read of the same place
    /// has reported it: then this is only a consequence.
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

    /// ` in …`, where the group has a name.
    fn context(&self, tree: &Tree, trail: &[NodeId]) -> String {
        match name_of(tree, trail) {
            name if name.is_empty() => String::new(),
            name => format!(" in `{name}`"),
        }
    }

    /// Leaves the innermost entry or element out; `false` when the mistake is in the root itself.
    fn drop_innermost(&mut self, tree: &Tree, trail: &[NodeId]) -> bool {
        self.lost.note(trail);
        let (value, parent) = match *trail {
            // The mistake is in a key: leave its value out with it.
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
        self.detour.dropped.insert(value)
    }
}

/// What to do about an unknown key.
fn unknown_key_hint(tree: &Tree, given: &str, known: &[&'static str]) -> Option<String> {
    if given == "<<" {
        return Some("YAML 1.2 has no merge keys; repeat the keys, or use `include`".to_owned());
    }
    if !given.is_empty() && given.chars().all(|c| c.is_ascii_digit()) {
        return Some(format!("if this is part of a number, write a point: 0.{given}"));
    }
    if closest(given, known.iter().copied()).is_none()
        && let Some(home) = tree.home_of(given)
    {
        return Some(match home.is_empty() {
            true => format!("`{given}` belongs at the top of the file, without indentation"),
            false => format!("`{given}` belongs under `{home}`"),
        });
    }
    match known.is_empty() {
        true => Some("remove it; this group takes no keys".to_owned()),
        false => did_you_mean(given, known.iter().copied(), "known keys"),
    }
}

/// What to do about a value of the wrong kind, where the Deserializer did not know better.
fn value_hint(tree: &Tree, at: NodeId, message: &str) -> Option<String> {
    let wanted = message.strip_prefix("expected ")?.split(", found").next()?;
    let general = match () {
        _ if wanted.contains("whole number") => "write a whole number, such as 6",
        _ if wanted.contains("number") => "write a number, such as 1.5",
        _ if wanted.contains("group") => "write its keys below it: `key: value`",
        _ if wanted.contains("list") => "write the values in brackets: [A, B]",
        _ if wanted.contains("text") => "write a word, or a text in quotes",
        _ => "see docs/blueprint-reference.md for what may stand here",
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

/// How the innermost node of a trail is called: its key, or `key[2]` for an element of a list.
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
