//! Text → located tree, from the events of `granit-parser`. Aliases are expanded in place, so that every node has one
//! parent; their number and depth are limited.

use std::collections::HashMap;
use std::ops::Range;

use granit_parser::{Event, Parser, ScalarStyle, Span, StructureStyle};

use crate::diag::{Diag, Label};
use crate::suggest::quote;
use crate::tree::{Kind, MAX_DEPTH, MAX_NODES, NodeId, SourceId, Tree};

impl Tree {
    /// Parses a source. Reports mistakes; returns `None` if nothing is usable. A syntax error hides the rest of its
    /// file, so the part before it is not used either.
    pub fn parse(&mut self, source: SourceId) -> Option<NodeId> {
        let text = self.source(source)?.text.clone();
        Builder { tree: self, source, text: &text, open: Vec::new(), anchors: HashMap::new(), root: None }.run()
    }
}

/// A list or group under construction.
struct Open {
    node: NodeId,
    anchor: usize,
    flow: bool,
    content: Content,
}

enum Content {
    Seq(Vec<NodeId>),
    Map {
        entries: Vec<(NodeId, NodeId)>,
        /// A key waiting for its value.
        key: Option<NodeId>,
        /// Index by key: a linear search would take seconds for a file with many keys.
        seen: HashMap<String, usize>,
    },
}

struct Builder<'t> {
    tree: &'t mut Tree,
    source: SourceId,
    text: &'t str,
    open: Vec<Open>,
    anchors: HashMap<usize, NodeId>,
    root: Option<NodeId>,
}

/// The file is unusable; the reason has been reported.
struct Unusable;

impl<'t> Builder<'t> {
    fn run(mut self) -> Option<NodeId> {
        let mut options = granit_parser::Options::default();
        options.set_emit_comments(false);
        options.emit_unresolved_aliases = true;
        let text = self.text;
        let mut documents = 0;
        for event in Parser::new_from_str_with_options(text, options) {
            let (event, span) = match event {
                Ok(pair) => pair,
                Err(error) => {
                    let at = error.marker().byte_offset().unwrap_or_else(|| self.byte_of(error.marker().index()));
                    self.syntax_error(at, &error.info());
                    return None;
                }
            };
            if matches!(event, Event::DocumentStart(..)) {
                documents += 1;
                if documents > 1 {
                    let diag = Diag::error("a second document starts here").hint("a file holds one; remove `---`");
                    self.fail(self.range(&span), diag);
                    return None;
                }
            }
            self.event(event, &span).ok()?;
        }
        self.root
    }

    fn event(&mut self, event: Event<'_>, span: &Span) -> Result<(), Unusable> {
        if let Some(tag) = event.tag()
            && !tag.is_yaml_core_schema()
        {
            let diag = Diag::error(format!("unknown tag {}", quote(&tag.original())));
            let at = span.tag_span().unwrap_or(*span);
            self.fail(self.range(&at), diag.hint("remove it; values are written plainly"));
        }
        match event {
            Event::Scalar(text, style, anchor, _) => {
                let mut range = self.range(span);
                if matches!(style, ScalarStyle::Literal | ScalarStyle::Folded) {
                    range.end = range.start + self.text.get(range.clone()).map_or(0, |t| t.trim_end().len());
                }
                let kind = Kind::Scalar { text: text.into_owned(), plain: style == ScalarStyle::Plain };
                let node = self.add(range, kind)?;
                if anchor > 0 {
                    self.anchors.insert(anchor, node);
                }
                self.place(node)
            }
            Event::SequenceStart(style, anchor, _) => self.start(span, style, anchor, Content::Seq(Vec::new())),
            Event::MappingStart(style, anchor, _) => {
                let content = Content::Map { entries: Vec::new(), key: None, seen: HashMap::new() };
                self.start(span, style, anchor, content)
            }
            Event::SequenceEnd | Event::MappingEnd => self.end(span),
            Event::Alias(id) => {
                let Some(target) = self.anchors.get(&id).copied() else {
                    let diag = Diag::error("this alias refers to a value that contains it");
                    self.fail(self.range(span), diag.hint("an alias repeats a finished value"));
                    return Err(Unusable);
                };
                let copy = self.copy(target, self.open.len(), span)?;
                self.place(copy)
            }
            Event::UnresolvedAlias(name) => {
                let diag = Diag::error(format!("no value above has the anchor {}", quote(&name)));
                self.fail(self.range(span), diag.hint("a text that starts with `*` needs quotes"));
                Err(Unusable)
            }
            _ => Ok(()),
        }
    }

    fn start(&mut self, span: &Span, style: StructureStyle, anchor: usize, content: Content) -> Result<(), Unusable> {
        if self.open.len() >= MAX_DEPTH {
            return self.too_deep(span);
        }
        let node = self.add(self.range(span), Kind::Seq(Vec::new()))?;
        self.open.push(Open { node, anchor, flow: style == StructureStyle::Flow, content });
        Ok(())
    }

    fn end(&mut self, span: &Span) -> Result<(), Unusable> {
        let Some(Open { node, anchor, flow, content }) = self.open.pop() else { return Ok(()) };
        let (kind, first, last) = match content {
            Content::Seq(items) => {
                let (first, last) = (items.first().copied(), items.last().copied());
                (Kind::Seq(items), first, last)
            }
            Content::Map { entries, .. } => {
                let (first, last) = (entries.first().map(|e| e.0), entries.last().map(|e| e.1));
                (Kind::Map(entries), first, last)
            }
        };
        let own = self.tree.node(node).map_or(0..0, |n| n.range.clone());
        let of = |id: Option<NodeId>| id.and_then(|id| self.tree.node(id)).map(|n| n.range.clone());
        // The parser ends a block at the start of the next item; readers expect it to end with its last value.
        let range = match flow {
            true => own.start..self.range(span).end,
            false => {
                let first = of(first).map_or(own.start, |r| r.start);
                // A list starts with its dash, if that precedes its first value.
                let dash = self.text.get(own.start..first).is_some_and(|t| t.starts_with('-') && !t.contains('\n'));
                let start = if dash { own.start } else { first };
                start..of(last).map_or(own.end, |r| r.end)
            }
        };
        // An alias has the position of its original value.
        let range = if range.end < range.start { own } else { range };
        self.tree.set_kind(node, kind);
        self.tree.set_range(node, range);
        if anchor > 0 {
            self.anchors.insert(anchor, node);
        }
        self.place(node)
    }

    /// Adds a finished node to the open list or group, or makes it the root.
    fn place(&mut self, node: NodeId) -> Result<(), Unusable> {
        let Some(open) = self.open.last_mut() else {
            self.root = Some(node);
            return Ok(());
        };
        let map = open.node;
        match &mut open.content {
            Content::Seq(items) => items.push(node),
            Content::Map { entries, key, seen } => match key.take() {
                None => *key = Some(node),
                Some(key) => {
                    let Some(name) = self.tree.text(key) else {
                        let diag = Diag::error("a key must be a word, not a list or group");
                        let diag = diag.at(self.tree.label(key));
                        self.tree.report(diag.hint("write one word before the colon"));
                        return Ok(());
                    };
                    if let Some(&(first, value)) = seen.get(name).and_then(|&at| entries.get(at)) {
                        let also = self.tree.label(first).with_text("first used here");
                        let diag = Diag::error(format!("the key {} is used twice", quote(name)));
                        let diag = diag.at(self.tree.label(key)).also(also).hint("remove one of the two");
                        self.tree.report(diag);
                        self.tree.damaged.extend([map, value]);
                        return Ok(());
                    }
                    seen.insert(name.to_owned(), entries.len());
                    entries.push((key, node));
                    // A missing value is reported at its key.
                    let empty = self.tree.node(node).is_some_and(|n| n.range.is_empty());
                    if let Some(range) = self.tree.node(key).map(|n| n.range.clone()).filter(|_| empty) {
                        self.tree.set_range(node, range);
                    }
                }
            },
        }
        Ok(())
    }

    /// Copies the value of an alias, with its original position.
    fn copy(&mut self, id: NodeId, depth: usize, span: &Span) -> Result<NodeId, Unusable> {
        let Some(node) = self.tree.node(id).cloned() else { return Err(Unusable) };
        if depth >= MAX_DEPTH && !matches!(node.kind, Kind::Scalar { .. }) {
            return self.too_deep(span);
        }
        let kind = match node.kind {
            Kind::Scalar { .. } => node.kind,
            Kind::Seq(items) => {
                Kind::Seq(items.into_iter().map(|i| self.copy(i, depth + 1, span)).collect::<Result<_, _>>()?)
            }
            Kind::Map(entries) => Kind::Map(
                entries
                    .into_iter()
                    .map(|(k, v)| Ok((self.copy(k, depth + 1, span)?, self.copy(v, depth + 1, span)?)))
                    .collect::<Result<_, Unusable>>()?,
            ),
        };
        self.add(node.range, kind)
    }

    fn add(&mut self, range: Range<usize>, kind: Kind) -> Result<NodeId, Unusable> {
        if self.tree.len() >= MAX_NODES {
            let diag = Diag::error(format!("more than {MAX_NODES} values, aliases counted each time they are used"));
            self.fail(range, diag.hint("a blueprint has a few hundred; is this the right file?"));
            return Err(Unusable);
        }
        Ok(self.tree.add(self.source, range, kind))
    }

    fn too_deep<T>(&mut self, span: &Span) -> Result<T, Unusable> {
        let diag = Diag::error(format!("lists and groups are nested more than {MAX_DEPTH} levels deep"));
        self.fail(self.range(span), diag.hint("a blueprint needs about five; check the indentation and brackets"));
        Err(Unusable)
    }

    fn syntax_error(&mut self, at: usize, info: &str) {
        let line_start = self.text.get(..at).and_then(|t| t.rfind('\n')).map_or(0, |i| i + 1);
        let line = self.text.get(line_start..).unwrap_or("").lines().next().unwrap_or("");
        let before = self.text.get(..at).unwrap_or(self.text);
        let hint = if line.trim_start_matches([' ', '-']).starts_with('\t') || line.starts_with('\t') {
            "indent with spaces; YAML does not allow tabs"
        } else if before.matches('"').count() % 2 == 1 && info.contains("quoted") {
            "a quotation mark is not closed"
        } else if info.contains("flow") || info.contains("expected ',' or") || info.contains("bracket") {
            "close each bracket, and put commas between the values"
        } else {
            "check the indentation, and that each key is followed by a colon and a space"
        };
        let mut diag = Diag::error(format!("YAML syntax: {info}")).hint(hint);
        if let Some(start) = self.open_bracket() {
            diag = diag.also(Label { source: self.source, range: start..start + 1, text: "open bracket".to_owned() });
        }
        self.fail(at..at, diag);
    }

    /// Returns the position of the innermost open bracket. A pair in a list, `[a: b]`, is a group without one.
    fn open_bracket(&self) -> Option<usize> {
        let starts = self.open.iter().rev().filter(|open| open.flow);
        let mut starts = starts.filter_map(|open| self.tree.node(open.node)).map(|node| node.range.start);
        starts.find(|start| self.text.get(*start..).is_some_and(|text| text.starts_with(['[', '{'])))
    }

    fn fail(&mut self, mut range: Range<usize>, diag: Diag) {
        let line_end = self.text.get(range.start..).and_then(|t| t.find('\n')).map(|n| range.start + n);
        range.end = range.end.min(line_end.unwrap_or(self.text.len())).max(range.start);
        self.tree.report(diag.at(Label { source: self.source, range, text: String::new() }));
    }

    fn range(&self, span: &Span) -> Range<usize> {
        span.byte_range().unwrap_or_else(|| self.byte_of(span.start.index())..self.byte_of(span.end.index()))
    }

    fn byte_of(&self, character: usize) -> usize {
        self.text.char_indices().nth(character).map_or(self.text.len(), |(at, _)| at)
    }
}
