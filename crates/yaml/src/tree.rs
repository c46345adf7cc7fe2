//! The located tree: YAML values that keep their position in the source.

use std::collections::HashSet;
use std::ops::Range;

use crate::diag::{Diag, Label, Severity};

/// Maximum file size [bytes].
pub const MAX_BYTES: usize = 1 << 20;
/// Maximum nesting of lists and groups, aliases expanded.
pub const MAX_DEPTH: usize = 32;
/// Maximum number of values, aliases expanded.
pub const MAX_NODES: usize = 200_000;
/// Maximum number of listed errors, and of listed warnings.
const MAX_DIAGS: usize = 100;

/// A node of a [`Tree`].
pub type NodeId = u32;
/// A text of a [`Tree`]: a file or a command-line argument.
pub type SourceId = u32;
/// Position of values that come from Rust code instead of a file.
pub const NOWHERE: NodeId = NodeId::MAX;

/// A named text that nodes point into.
#[derive(Debug, Clone)]
pub struct Source {
    /// Display name: a path, or `--set`.
    pub name: String,
    /// The text.
    pub text: String,
}

/// A value and its position.
#[derive(Debug, Clone)]
pub struct Node {
    /// The source.
    pub source: SourceId,
    /// Range in its text [bytes].
    pub range: Range<usize>,
    /// Kind.
    pub kind: Kind,
}

/// Kind of a node.
#[derive(Debug, Clone)]
pub enum Kind {
    /// A word, number or text. `plain` means written without quotes, so that it may be a number or a boolean.
    Scalar {
        /// The text, escapes resolved.
        text: String,
        /// Whether it is written without quotes.
        plain: bool,
    },
    /// A list.
    Seq(Vec<NodeId>),
    /// A group of keys and values, in order of the source. Keys are scalars and unique.
    Map(Vec<(NodeId, NodeId)>),
}

/// Sources, their nodes, and the diagnostics so far.
#[derive(Debug, Clone, Default)]
pub struct Tree {
    sources: Vec<Source>,
    nodes: Vec<Node>,
    diags: Vec<Diag>,
    /// Nodes with skipped parts, whose absence must not be reported.
    pub(super) damaged: HashSet<NodeId>,
    /// Looks up the group of a misplaced key.
    hints: Option<fn(&str) -> Option<String>>,
    /// Number of errors and of warnings that are not listed.
    pub(super) unlisted: [usize; 2],
}

impl Tree {
    /// Creates an empty tree.
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds a source.
    pub fn add_source(&mut self, name: impl Into<String>, text: impl Into<String>) -> SourceId {
        self.sources.push(Source { name: name.into(), text: text.into() });
        (self.sources.len() - 1) as SourceId
    }

    /// Adds a file's bytes; reports what makes them unusable as text.
    pub fn add_bytes(&mut self, name: impl Into<String>, bytes: &[u8]) -> Option<SourceId> {
        let name = name.into();
        if bytes.len() > MAX_BYTES {
            let source = self.add_source(name, "");
            self.report(
                Diag::error(format!("the file is larger than {} MiB", MAX_BYTES >> 20))
                    .at(Label::start_of(source))
                    .hint("a blueprint has a few hundred lines; is this the right file?"),
            );
            return None;
        }
        let (valid, problem) = match std::str::from_utf8(bytes) {
            Ok(text) => match text.find('\0') {
                Some(at) => (&text[..at], Some(("a NUL byte", "remove it; a blueprint is plain text"))),
                None => (text, None),
            },
            Err(error) => {
                let valid = bytes.get(..error.valid_up_to()).unwrap_or_default();
                let hint = "save the file as UTF-8 text";
                (std::str::from_utf8(valid).unwrap_or_default(), Some(("bytes that are not UTF-8", hint)))
            }
        };
        let source = self.add_source(name, valid);
        if let Some((what, hint)) = problem {
            let at = Label { source, range: valid.len()..valid.len(), text: String::new() };
            self.report(Diag::error(format!("the file has {what} here")).at(at).hint(hint));
            return None;
        }
        Some(source)
    }

    /// Returns all sources, in order of addition.
    pub fn sources(&self) -> &[Source] {
        &self.sources
    }

    /// Returns a source by id.
    pub fn source(&self, id: SourceId) -> Option<&Source> {
        self.sources.get(id as usize)
    }

    pub(super) fn set_text(&mut self, id: SourceId, text: String) {
        if let Some(source) = self.sources.get_mut(id as usize) {
            source.text = text;
        }
    }

    /// Returns a node by id.
    pub fn node(&self, id: NodeId) -> Option<&Node> {
        self.nodes.get(id as usize)
    }

    /// Returns the number of nodes.
    pub fn len(&self) -> usize {
        self.nodes.len()
    }

    /// Returns whether there are no nodes.
    pub fn is_empty(&self) -> bool {
        self.nodes.is_empty()
    }

    pub(super) fn add(&mut self, source: SourceId, range: Range<usize>, kind: Kind) -> NodeId {
        self.nodes.push(Node { source, range, kind });
        (self.nodes.len() - 1) as NodeId
    }

    /// Adds an empty group at the position of another node, for a group that is absent.
    pub fn add_empty_map(&mut self, at: NodeId) -> NodeId {
        let (source, range) = self.node(at).map_or((0, 0..0), |n| (n.source, n.range.clone()));
        self.add(source, range, Kind::Map(Vec::new()))
    }

    pub(super) fn set_kind(&mut self, id: NodeId, kind: Kind) {
        if let Some(node) = self.nodes.get_mut(id as usize) {
            node.kind = kind;
        }
    }

    pub(super) fn set_range(&mut self, id: NodeId, range: Range<usize>) {
        if let Some(node) = self.nodes.get_mut(id as usize) {
            node.range = range;
        }
    }

    /// Returns the text of a scalar.
    pub fn text(&self, id: NodeId) -> Option<&str> {
        match &self.node(id)?.kind {
            Kind::Scalar { text, .. } => Some(text),
            _ => None,
        }
    }

    /// Returns keys and values of a group; empty for other nodes.
    pub fn entries(&self, id: NodeId) -> &[(NodeId, NodeId)] {
        match self.node(id).map(|n| &n.kind) {
            Some(Kind::Map(entries)) => entries,
            _ => &[],
        }
    }

    /// Returns the elements of a list; empty for other nodes.
    pub fn items(&self, id: NodeId) -> &[NodeId] {
        match self.node(id).map(|n| &n.kind) {
            Some(Kind::Seq(items)) => items,
            _ => &[],
        }
    }

    /// Returns the nodes of a key and its value.
    pub fn entry(&self, map: NodeId, key: &str) -> Option<(NodeId, NodeId)> {
        self.entries(map).iter().copied().find(|(k, _)| self.text(*k) == Some(key))
    }

    /// Returns the value of a key.
    pub fn get(&self, map: NodeId, key: &str) -> Option<NodeId> {
        self.entry(map, key).map(|(_, value)| value)
    }

    /// Returns the node at a path of keys and indices with dots (`sim.faults.0`) below `root`, or its nearest existing
    /// ancestor.
    pub fn nearest(&self, root: NodeId, path: &str) -> NodeId {
        let mut at = root;
        for step in path.split('.') {
            let next = match step.parse().ok().and_then(|index: usize| self.items(at).get(index)) {
                Some(item) => Some(*item),
                None => self.get(at, step),
            };
            match next {
                Some(next) => at = next,
                None => break,
            }
        }
        at
    }

    /// Removes a key from a group.
    pub fn remove(&mut self, map: NodeId, key: &str) {
        let kept = self.entries(map).iter().copied().filter(|(k, _)| self.text(*k) != Some(key)).collect();
        if matches!(self.node(map).map(|n| &n.kind), Some(Kind::Map(_))) {
            self.set_kind(map, Kind::Map(kept));
        }
    }

    /// Sets a key of a group; a new key and value get the position of `at`.
    pub fn put_text(&mut self, map: NodeId, key: &str, value: &str, at: (SourceId, Range<usize>)) {
        let scalar = |text: &str| Kind::Scalar { text: text.to_owned(), plain: false };
        let value = self.add(at.0, at.1.clone(), scalar(value));
        let mut entries = self.entries(map).to_vec();
        match entries.iter_mut().find(|(k, _)| self.text(*k) == Some(key)) {
            Some(entry) => entry.1 = value,
            None => entries.push((self.add(at.0, at.1, scalar(key)), value)),
        }
        self.set_kind(map, Kind::Map(entries));
    }

    /// Returns whether part of a node was dropped because it was written twice.
    pub fn is_damaged(&self, id: NodeId) -> bool {
        self.damaged.contains(&id)
    }

    /// Sets what is said of an unknown key: where it belongs, or what took its place.
    pub fn know_hints(&mut self, hints: fn(&str) -> Option<String>) {
        self.hints = Some(hints);
    }

    pub(super) fn hint_of(&self, key: &str) -> Option<String> {
        self.hints.and_then(|hints| hints(key))
    }

    /// Returns a label on a node; of lists and groups only the first line is marked.
    pub fn label(&self, id: NodeId) -> Label {
        let Some(node) = self.node(id) else { return Label::start_of(0) };
        let text = self.source(node.source).map_or("", |s| s.text.as_str());
        let end = match text.get(node.range.clone()).and_then(|t| t.find(['\n', '\r'])) {
            Some(line) => node.range.start + line,
            None => node.range.end,
        };
        Label { source: node.source, range: node.range.start..end, text: String::new() }
    }

    /// Adds a diagnostic, unless the same one exists at the same position.
    pub fn report(&mut self, diag: Diag) {
        if self.diags.contains(&diag) {
            return;
        }
        let listed = self.diags.iter().filter(|other| other.severity == diag.severity).count();
        let [errors, warnings] = &mut self.unlisted;
        match diag.severity {
            _ if listed < MAX_DIAGS => self.diags.push(diag),
            Severity::Error => *errors += 1,
            Severity::Warning => *warnings += 1,
        }
    }

    /// Returns the number of errors, also of those that are not listed.
    pub fn errors(&self) -> usize {
        self.count(Severity::Error) + self.unlisted[0]
    }

    /// Returns the number of warnings, also of those that are not listed.
    pub fn warnings(&self) -> usize {
        self.count(Severity::Warning) + self.unlisted[1]
    }

    fn count(&self, severity: Severity) -> usize {
        self.diags.iter().filter(|diag| diag.severity == severity).count()
    }

    /// Returns the number of diagnostics that are not listed.
    pub fn unlisted(&self) -> usize {
        self.unlisted.iter().sum()
    }

    /// Returns whether there is a diagnostic at exactly this node.
    pub(super) fn has_report_at(&self, id: NodeId) -> bool {
        let label = self.label(id);
        self.diags.iter().any(|d| d.at.as_ref().is_some_and(|at| at.source == label.source && at.range == label.range))
    }

    /// Returns whether there are errors.
    pub fn has_errors(&self) -> bool {
        self.errors() > 0
    }

    /// Returns the diagnostics, in order of detection.
    pub fn diags(&self) -> &[Diag] {
        &self.diags
    }
}
