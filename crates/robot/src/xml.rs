//! XML as an owned tree; every element and attribute keeps its position in the source.
//!
//! Parsed by `roxmltree`. This tree can be modified (by xacro), keeps prefixes and CDATA as written, and prints in one
//! canonical form. Entities and DTDs are rejected.

mod unclosed;

use roxmltree::{ParsingOptions, TextPos};

use dimos_yaml::{Diag, Label, SourceId, Tree};

/// Maximum file size [bytes].
pub const MAX_BYTES: usize = 8 << 20;
/// Maximum nesting of elements.
pub const MAX_DEPTH: usize = 128;
/// Maximum number of nodes per file.
const MAX_NODES: u32 = 1_000_000;
/// The namespace of xacro's elements.
const XACRO: &str = "xmlns:xacro=\"http://www.ros.org/wiki/xacro\"";

/// Position in a source.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SourcePos {
    /// The source.
    pub source: SourceId,
    /// First byte.
    pub start: u32,
    /// One past the last byte.
    pub end: u32,
    /// Macro call that it was expanded from: an index into [`Calls`]; 0 for none.
    pub call: u32,
}

impl SourcePos {
    pub(super) fn new(source: SourceId, range: std::ops::Range<usize>) -> Self {
        Self { source, start: range.start as u32, end: range.end as u32, call: 0 }
    }

    /// Returns a diagnostic label for the position.
    pub fn label(self) -> Label {
        Label { source: self.source, range: self.start as usize..self.end as usize, text: String::new() }
    }
}

/// An attribute.
#[derive(Debug, Clone, PartialEq)]
pub struct Attribute {
    /// Name with prefix, as written.
    pub name: String,
    /// Value, entities resolved.
    pub value: String,
    /// Position of the value.
    pub at: SourcePos,
}

/// An element.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Element {
    /// Name with prefix, as written.
    pub name: String,
    /// Position of the name in the start tag.
    pub at: SourcePos,
    /// Attributes, in the order of the source.
    pub attributes: Vec<Attribute>,
    /// Content.
    pub children: Vec<Node>,
}

/// Content of an element.
#[derive(Debug, Clone, PartialEq)]
pub enum Node {
    /// An element.
    Element(Element),
    /// Text.
    Text(String, SourcePos),
    /// A CDATA section.
    CData(String),
    /// A comment.
    Comment(String, SourcePos),
    /// A processing instruction.
    Instruction(String),
    /// Marks where xacro keeps the comments above; prints nothing.
    Barrier(u32),
}

/// A file: comments around a root element.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Document {
    /// Comments and instructions before the root.
    pub before: Vec<Node>,
    /// The root element.
    pub root: Element,
}

/// The macro calls of an expansion, to trace expanded elements. Index 0 is no call.
#[derive(Debug, Clone, Default)]
pub struct Calls(Vec<(String, SourcePos)>);

impl Calls {
    /// Records a call and returns its index.
    pub(super) fn add(&mut self, name: &str, at: SourcePos) -> u32 {
        self.0.push((name.to_owned(), at));
        self.0.len() as u32
    }

    /// Adds to a diagnostic the calls that led to its position, innermost first.
    pub fn explain(&self, mut diag: Diag, at: SourcePos) -> Diag {
        let mut call = at.call;
        // Two are enough to find it; a recursive macro has hundreds.
        for _ in 0..2 {
            let Some((name, place)) = (call as usize).checked_sub(1).and_then(|i| self.0.get(i)) else { break };
            diag = diag.also(place.label().with_text(format!("in this call of the macro `{name}`")));
            call = place.call;
        }
        diag
    }
}

impl Element {
    /// Returns an attribute by name.
    pub fn attribute(&self, name: &str) -> Option<&Attribute> {
        self.attributes.iter().find(|a| a.name == name)
    }

    /// Sets an attribute, replacing one of the same name.
    pub fn set(&mut self, name: &str, value: String, at: SourcePos) {
        match self.attributes.iter_mut().find(|a| a.name == name) {
            Some(attribute) => attribute.value = value,
            None => self.attributes.push(Attribute { name: name.to_owned(), value, at }),
        }
    }

    /// Returns the child elements.
    pub fn elements(&self) -> impl Iterator<Item = &Element> {
        self.children.iter().filter_map(|node| match node {
            Node::Element(element) => Some(element),
            _ => None,
        })
    }

    /// Returns the child elements with a name.
    pub fn named<'a>(&'a self, name: &'a str) -> impl Iterator<Item = &'a Element> {
        self.elements().filter(move |e| e.name == name)
    }

    /// Returns the first child element with a name.
    pub fn child<'a>(&'a self, name: &'a str) -> Option<&'a Element> {
        self.elements().find(|e| e.name == name)
    }

    /// Marks all content as expanded from a macro call.
    pub(super) fn stamp(&mut self, call: u32) {
        self.at.call = call;
        self.attributes.iter_mut().for_each(|a| a.at.call = call);
        for node in &mut self.children {
            match node {
                Node::Element(element) => element.stamp(call),
                Node::Text(_, at) | Node::Comment(_, at) => at.call = call,
                _ => {}
            }
        }
    }
}

/// Parses a source. Reports errors with their position, and then returns nothing.
pub fn parse(tree: &mut Tree, source: SourceId) -> Option<Document> {
    let text = tree.source(source)?.text.clone();
    if text.len() > MAX_BYTES {
        let what = format!("the file is larger than {} MiB", MAX_BYTES >> 20);
        tree.report(Diag::error(what).at(Label::start_of(source)));
        return None;
    }
    let options = ParsingOptions { nodes_limit: MAX_NODES, ..ParsingOptions::default() };
    match roxmltree::Document::parse_with_options(&text, options) {
        Ok(xml) => {
            let mut copy = Copy { source, text: &text, too_deep: None };
            let before =
                xml.root().children().take_while(|n| !n.is_element()).filter_map(|n| copy.node(n, 0)).collect();
            let root = copy.element(xml.root_element(), 0);
            if let Some(at) = copy.too_deep {
                let what = format!("elements are nested deeper than {MAX_DEPTH}");
                tree.report(Diag::error(what).at(at.label()));
                return None;
            }
            Some(Document { before, root })
        }
        Err(error) => {
            use roxmltree::Error::{UnclosedRootNode, UnexpectedEndOfStream};

            if matches!(error, UnclosedRootNode | UnexpectedEndOfStream) {
                tree.report(truncated(source, &text));
                return None;
            }
            let at = offset(&text, error.pos());
            let label = Label { source, range: at..at, text: String::new() };
            let hint = match &error {
                roxmltree::Error::UnknownNamespace(prefix, _) if prefix == "xacro" => {
                    Some(format!("declare it in the root element: {XACRO}"))
                }
                roxmltree::Error::DtdDetected => Some("remove the DOCTYPE; a robot description needs none".to_owned()),
                _ => None,
            };
            let words = error.to_string();
            let what = words.rsplit_once(" at ").map_or(words.as_str(), |(what, _)| what);
            tree.report(Diag::error(format!("not well-formed XML: {what}")).at(label).maybe_hint(hint));
            None
        }
    }
}

/// Returns the diagnostic of a file that ends too early.
fn truncated(source: SourceId, text: &str) -> Diag {
    let last = text.trim_end().len();
    let end = Label { source, range: last..last, text: String::new() };
    match unclosed::open_elements(text).pop() {
        Some(range) => {
            let name = text.get(range.clone()).unwrap_or_default().to_owned();
            let diag = Diag::error(format!("not well-formed XML: the file ends inside the element `{name}`")).at(end);
            diag.also(Label { source, range, text: "opened here".to_owned() }).hint("is the file complete?")
        }
        None => Diag::error("not well-formed XML: the file ends too early").at(end),
    }
}

/// Returns the byte offset of a row and column, both from 1.
fn offset(text: &str, pos: TextPos) -> usize {
    let line = text.split_inclusive('\n').take(pos.row.saturating_sub(1) as usize).map(str::len).sum::<usize>();
    let rest = text.get(line..).unwrap_or_default();
    let column = rest.chars().take(pos.col.saturating_sub(1) as usize).map(char::len_utf8).sum::<usize>();
    (line + column).min(text.len())
}

/// Copies roxmltree's tree.
struct Copy<'t> {
    source: SourceId,
    text: &'t str,
    too_deep: Option<SourcePos>,
}

impl Copy<'_> {
    fn element(&mut self, node: roxmltree::Node<'_, '_>, depth: usize) -> Element {
        let start = node.range().start + 1;
        let rest = self.text.get(start..).unwrap_or_default();
        let length = rest.find(|c: char| c.is_whitespace() || c == '/' || c == '>').unwrap_or(rest.len());
        let at = SourcePos::new(self.source, start..start + length);
        let name = rest.get(..length).unwrap_or_default().to_owned();
        if depth > MAX_DEPTH {
            self.too_deep.get_or_insert(at);
            return Element { name, at, ..Element::default() };
        }
        let mut attributes = self.declarations(node, at);
        for attribute in node.attributes() {
            let name = self.text.get(attribute.range_qname()).unwrap_or_default().to_owned();
            let at = SourcePos::new(self.source, attribute.range_value());
            attributes.push(Attribute { name, value: attribute.value().to_owned(), at });
        }
        let mut children = Vec::new();
        for child in node.children() {
            match child.is_text() {
                true => self.texts(child, &mut children),
                false => children.extend(self.node(child, depth + 1)),
            }
        }
        Element { name, at, attributes, children }
    }

    /// Returns the namespaces declared by the element itself.
    fn declarations(&self, node: roxmltree::Node<'_, '_>, at: SourcePos) -> Vec<Attribute> {
        let parent = node.parent_element();
        let own = |ns: &&roxmltree::Namespace<'_>| {
            ns.name() != Some("xml") && parent.is_none_or(|p| p.lookup_namespace_uri(ns.name()) != Some(ns.uri()))
        };
        let attribute = |ns: &roxmltree::Namespace<'_>| Attribute {
            name: ns.name().map_or_else(|| "xmlns".to_owned(), |prefix| format!("xmlns:{prefix}")),
            value: ns.uri().to_owned(),
            at,
        };
        node.namespaces().filter(own).map(attribute).collect()
    }

    fn node(&mut self, node: roxmltree::Node<'_, '_>, depth: usize) -> Option<Node> {
        let at = SourcePos::new(self.source, node.range());
        if node.is_element() {
            return Some(Node::Element(self.element(node, depth)));
        }
        if node.is_comment() {
            let text = node.text().unwrap_or_default();
            // A line end is one character in XML; the parser ensures that in texts only.
            return Some(Node::Comment(text.replace("\r\n", "\n").replace('\r', "\n"), at));
        }
        let instruction = node.pi()?;
        Some(Node::Instruction(format!("{} {}", instruction.target, instruction.value.unwrap_or_default())))
    }

    /// Splits a text into CDATA sections and text: roxmltree joins them.
    fn texts(&self, node: roxmltree::Node<'_, '_>, children: &mut Vec<Node>) {
        const OPEN: &str = "<![CDATA[";
        let at = SourcePos::new(self.source, node.range());
        let text = node.text().unwrap_or_default();
        let end = match node.next_sibling() {
            Some(next) => next.range().start,
            None => {
                let all = node.parent().map_or(0..0, |p| p.range());
                let tag = self.text.get(all.clone()).and_then(|t| t.rfind("</")).unwrap_or(0);
                all.start + tag
            }
        };
        let raw = self.text.get(node.range().start..end).unwrap_or_default();
        if !raw.contains(OPEN) {
            children.push(Node::Text(text.to_owned(), at));
            return;
        }
        let mut rest = raw;
        while let Some((before, inside)) = rest.split_once(OPEN) {
            let (data, after) = inside.split_once("]]>").unwrap_or((inside, ""));
            if !before.is_empty() {
                children.push(Node::Text(resolved(before), at));
            }
            children.push(Node::CData(data.replace("\r\n", "\n")));
            rest = after;
        }
        if !rest.is_empty() {
            children.push(Node::Text(resolved(rest), at));
        }
    }
}

/// Returns text with its character references resolved.
fn resolved(raw: &str) -> String {
    let wrapped = format!("<t>{raw}</t>");
    let parsed = roxmltree::Document::parse(&wrapped);
    parsed.ok().and_then(|d| d.root_element().text().map(str::to_owned)).unwrap_or_default()
}

impl Document {
    /// Returns the canonical text: two spaces per level, attributes sorted by name, only line breaks between elements.
    /// Equals xacro's output without its banner.
    pub fn to_text(&self) -> String {
        let mut out = String::from("<?xml version=\"1.0\" ?>\n");
        self.before.iter().for_each(|node| write_node(node, 0, &mut out));
        write_element(&self.root, 0, &mut out);
        out
    }
}

fn write_node(node: &Node, depth: usize, out: &mut String) {
    let indent = |out: &mut String| out.extend(std::iter::repeat_n("  ", depth));
    match node {
        Node::Element(element) => write_element(element, depth, out),
        Node::Text(text, _) => {
            if !text.trim().is_empty() {
                indent(out);
                escape(text, out);
                out.push('\n');
            }
        }
        Node::CData(text) => {
            // The text of a section must not end it.
            let text = text.replace("]]>", "]]]]><![CDATA[>");
            out.push_str(&format!("<![CDATA[{text}]]>"));
        }
        Node::Comment(text, _) => {
            indent(out);
            out.push_str(&format!("<!--{text}-->\n"));
        }
        Node::Instruction(text) => {
            indent(out);
            out.push_str(&format!("<?{text}?>\n"));
        }
        Node::Barrier(_) => {}
    }
}

fn write_element(element: &Element, depth: usize, out: &mut String) {
    let indent: String = "  ".repeat(depth);
    out.push_str(&format!("{indent}<{}", element.name));
    let mut attributes: Vec<&Attribute> = element.attributes.iter().collect();
    attributes.sort_by(|a, b| a.name.cmp(&b.name));
    for attribute in attributes {
        out.push_str(&format!(" {}=\"", attribute.name));
        escape(&attribute.value, out);
        out.push('"');
    }
    let visible: Vec<&Node> = element.children.iter().filter(|n| !matches!(n, Node::Barrier(_))).collect();
    match visible[..] {
        [] => out.push_str("/>\n"),
        [Node::Text(text, _)] => {
            out.push('>');
            escape(text, out);
            out.push_str(&format!("</{}>\n", element.name));
        }
        _ => {
            out.push_str(">\n");
            visible.iter().for_each(|node| write_node(node, depth + 1, out));
            out.push_str(&format!("{indent}</{}>\n", element.name));
        }
    }
}

fn escape(text: &str, out: &mut String) {
    for c in text.chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            c => out.push(c),
        }
    }
}

#[cfg(test)]
mod tests;
