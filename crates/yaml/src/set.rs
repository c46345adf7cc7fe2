//! `--set path=value`: changes one value of a tree. The argument is a source like a file, so that mistakes are shown in
//! it.

use std::ops::Range;

use crate::diag::{Diag, Label};
use crate::merge::MergeRules;
use crate::scalar::{Scalar, resolve};
use crate::suggest::{did_you_mean, quote};
use crate::tree::{Kind, NodeId, SourceId, Tree};

/// Applies `path=value` to the tree below `root`. Keys are separated by dots; list entries are addressed by id if
/// `rules` define one, otherwise by index. The value is YAML. Reports mistakes.
pub fn set(tree: &mut Tree, root: NodeId, argument: &str, rules: &MergeRules) {
    let source = tree.add_source("--set", argument);
    let Some(equals) = argument.find('=').filter(|at| *at > 0) else {
        let at = Label { source, range: 0..argument.len(), text: String::new() };
        let diag = Diag::error("expected `path=value`").at(at);
        tree.report(diag.hint("for example --set hardware.arm.address=192.168.1.100"));
        return;
    };
    let value = parse_value(tree, source, argument, equals + 1);
    let Some(value) = value else { return };

    let mut segments = Vec::new();
    let mut start = 0;
    for part in argument.get(..equals).unwrap_or_default().split('.') {
        segments.push((part, start..start + part.len()));
        start += part.len() + 1;
    }
    let Some(((last, last_at), steps)) = segments.split_last() else { return };
    let mut walk = Walk { tree, source, rules, node: root, path: String::new() };
    for (segment, at) in steps {
        if !walk.step(segment, at.clone()) {
            return;
        }
    }
    walk.put(last, last_at.clone(), value);
}

/// Parses the value with the path blanked out, so that positions are those of the argument.
fn parse_value(tree: &mut Tree, source: SourceId, argument: &str, start: usize) -> Option<NodeId> {
    let value = argument.get(start..).unwrap_or_default();
    if value.trim().is_empty() {
        let kind = Kind::Scalar { text: String::new(), plain: true };
        return Some(tree.add(source, 0..argument.len(), kind));
    }
    tree.set_text(source, format!("{}{value}", " ".repeat(start)));
    let node = tree.parse(source);
    tree.set_text(source, argument.to_owned());
    node
}

struct Walk<'t> {
    tree: &'t mut Tree,
    source: SourceId,
    rules: &'t MergeRules,
    node: NodeId,
    /// Path in the form of [`MergeRules`].
    path: String,
}

impl Walk<'_> {
    /// Enters a key or a list entry; creates missing groups.
    fn step(&mut self, segment: &str, at: Range<usize>) -> bool {
        let next = match self.tree.node(self.node).map(|n| n.kind.clone()) {
            Some(Kind::Seq(items)) => {
                let Some(index) = self.index(&items, segment, at) else { return false };
                items.get(index).copied()
            }
            Some(Kind::Map(_)) => match self.tree.get(self.node, segment) {
                Some(next) if !self.is_null(next) => Some(next),
                _ => {
                    let next = self.tree.add(self.source, at.clone(), Kind::Map(Vec::new()));
                    self.put(segment, at, next);
                    Some(next)
                }
            },
            _ => {
                self.fail_below_value(at);
                return false;
            }
        };
        let Some(next) = next else { return false };
        let is_seq = matches!(self.tree.node(self.node).map(|n| &n.kind), Some(Kind::Seq(_)));
        match (is_seq, self.path.is_empty()) {
            (true, _) => self.path.push_str("[]"),
            (false, true) => segment.clone_into(&mut self.path),
            (false, false) => self.path = format!("{}.{segment}", self.path),
        }
        self.node = next;
        true
    }

    /// Sets the value at the last segment.
    fn put(&mut self, segment: &str, at: Range<usize>, value: NodeId) {
        match self.tree.node(self.node).map(|n| n.kind.clone()) {
            Some(Kind::Seq(mut items)) => {
                let Some(index) = self.index(&items, segment, at) else { return };
                if let Some(item) = items.get_mut(index) {
                    *item = value;
                }
                self.tree.set_kind(self.node, Kind::Seq(items));
            }
            Some(Kind::Map(mut entries)) => {
                let key = Kind::Scalar { text: segment.to_owned(), plain: true };
                let key = self.tree.add(self.source, at, key);
                match entries.iter_mut().find(|(k, _)| self.tree.text(*k) == Some(segment)) {
                    Some(entry) => *entry = (key, value),
                    None => entries.push((key, value)),
                }
                self.tree.set_kind(self.node, Kind::Map(entries));
            }
            _ => self.fail_below_value(at),
        }
    }

    /// Returns the index of a list entry given by id or index.
    fn index(&mut self, items: &[NodeId], segment: &str, at: Range<usize>) -> Option<usize> {
        let id_key = self.rules.id_key(&self.path);
        let ids: Vec<String> = match id_key {
            Some(key) => {
                let id = |item: &NodeId| self.tree.get(*item, key).and_then(|id| self.tree.text(id));
                items.iter().map(|item| id(item).unwrap_or_default().to_owned()).collect()
            }
            None => (0..items.len()).map(|i| i.to_string()).collect(),
        };
        let found = ids.iter().position(|id| id == segment);
        if found.is_none() {
            let list = quote(self.walked(&at));
            let diag = match id_key {
                Some(key) => Diag::error(format!("no entry of {list} has the {key} {}", quote(segment))),
                None => Diag::error(format!("{list} has no entry {}; it has {}", quote(segment), items.len())),
            };
            let hint = did_you_mean(segment, ids.iter().map(String::as_str), "there are");
            self.fail(at, diag.maybe_hint(hint));
        }
        found
    }

    fn is_null(&self, node: NodeId) -> bool {
        let kind = self.tree.node(node).map(|n| &n.kind);
        matches!(kind, Some(Kind::Scalar { text, plain }) if resolve(text, *plain) == Scalar::Null)
    }

    /// Returns the path walked so far, as typed.
    fn walked(&self, at: &Range<usize>) -> &str {
        let argument = self.tree.source(self.source).map_or("", |s| s.text.as_str());
        argument.get(..at.start.saturating_sub(1)).unwrap_or_default()
    }

    fn fail_below_value(&mut self, at: Range<usize>) {
        let diag = Diag::error(format!("{} is a single value without keys", quote(self.walked(&at))));
        self.fail(at, diag.hint("end the path before this"));
    }

    fn fail(&mut self, range: Range<usize>, diag: Diag) {
        self.tree.report(diag.at(Label { source: self.source, range, text: String::new() }));
    }
}
