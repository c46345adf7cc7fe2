//! Walks the elements: each is copied, evaluated, or replaced by its expansion.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::{Path, PathBuf};
use std::rc::Rc;

use super::evaluate::Evaluated;
use super::scope::{Block, Entry, Macros, Scopes};
use super::value::Value;
use super::{Expansion, ExpansionError, Result, unknown_argument};
use crate::packages::{Packages, absolute, plain};
use crate::xml::{Calls, Document, Element, Node};
use dimos_yaml::{Diag, Tree, closest};

/// Maximum nesting of elements, macro calls and properties under evaluation.
const MAX_DEPTH: usize = 400;
/// Maximum work of one expansion, in elements, attributes and steps of expressions.
const MAX_STEPS: usize = 3_000_000;

/// Scope in which names are looked up.
#[derive(Debug, Clone, Copy)]
pub(super) struct Env {
    pub(super) symbols: usize,
    pub(super) macros: usize,
}

/// One expansion.
pub(super) struct Expander<'t> {
    pub(super) tree: &'t mut Tree,
    pub(super) packages: &'t Packages,
    given: &'t BTreeMap<String, String>,
    pub(super) args: BTreeMap<String, String>,
    /// Arguments declared by the files.
    pub(super) declared: BTreeSet<String>,
    pub(super) scopes: Scopes,
    pub(super) macros: Macros,
    pub(super) calls: Calls,
    /// Stack of files being read, the innermost last.
    pub(super) files: Vec<PathBuf>,
    pub(super) read: Vec<PathBuf>,
    pub(super) parsed: HashMap<PathBuf, Rc<Document>>,
    /// Folders that files may be read from.
    pub(super) roots: Vec<PathBuf>,
    /// Properties under evaluation, to report a cycle.
    pub(super) pending: Vec<String>,
    depth: usize,
    steps: usize,
    /// Number of the current barrier; earlier ones have moved there.
    barrier: u32,
}

impl<'t> Expander<'t> {
    pub(super) fn new(
        tree: &'t mut Tree,
        path: &Path,
        packages: &'t Packages,
        args: &'t BTreeMap<String, String>,
    ) -> Self {
        let path = absolute(path);
        let folder = path.parent().unwrap_or(&path).to_owned();
        Self {
            tree,
            packages,
            given: args,
            args: args.clone(),
            declared: BTreeSet::new(),
            scopes: Scopes::new(),
            macros: Macros::new(),
            calls: Calls::default(),
            roots: vec![packages.own(&folder)],
            files: vec![path.clone()],
            read: vec![path],
            parsed: HashMap::new(),
            pending: Vec::new(),
            depth: 0,
            steps: 0,
            barrier: 0,
        }
    }

    pub(super) fn run(mut self, mut document: Document) -> Option<Expansion> {
        let source = document.root.at.source;
        if let Some(at) = document.root.attributes.iter().position(|a| a.name == "xacro:targetNamespace") {
            let target = document.root.attributes.remove(at);
            document.root.set("xmlns", target.value, target.at);
        }
        let done = self.element(&mut document.root, Env { symbols: 0, macros: 0 });
        let unknown = self.given.keys().filter(|name| !self.declared.contains(*name));
        let near = |name: &str| closest(name, self.declared.iter().map(String::as_str)).map(str::to_owned);
        let unknown_args: Vec<_> = unknown.map(|name| (name.clone(), near(name))).collect();
        if let Err(trouble) = done {
            // A misspelt argument may be the cause. The files after the mistake may declare others.
            for (name, near) in unknown_args.iter().filter(|(_, near)| near.is_some()) {
                self.tree.report(unknown_argument(name, near.as_deref(), source));
            }
            self.tree.report(trouble.diag(&self.calls, source));
            return None;
        }
        Some(Expansion { document, calls: self.calls, files: self.read, unknown_args })
    }

    /// Enters a level of nesting; `leave` undoes it.
    pub(super) fn enter(&mut self) -> Result {
        self.depth += 1;
        self.charge(1).map_err(ExpansionError::new)?;
        if self.depth > MAX_DEPTH {
            let what = format!("elements and macro calls are nested deeper than {MAX_DEPTH}");
            return Err(ExpansionError::new(what).hint(Some("does a macro call itself without end?".to_owned())));
        }
        Ok(())
    }

    pub(super) fn leave(&mut self) {
        self.depth -= 1;
    }

    /// Evaluates an element in place: its attributes, then what it contains.
    pub(super) fn element(&mut self, element: &mut Element, env: Env) -> Result {
        self.enter().map_err(|e| e.at(element.at))?;
        let attributes = std::mem::take(&mut element.attributes);
        for mut attribute in attributes {
            if attribute.name.starts_with("xacro:") || attribute.name == "xmlns:xacro" {
                continue;
            }
            attribute.value = self.text(&attribute.value, env, attribute.at)?.text();
            element.attributes.push(attribute);
        }
        self.content(element, env)?;
        self.leave();
        Ok(())
    }

    /// Evaluates an element's content.
    pub(super) fn content(&mut self, element: &mut Element, env: Env) -> Result {
        let nodes = std::mem::take(&mut element.children);
        let count = nodes.len();
        let mut out = Vec::with_capacity(count);
        let mut eval_comments = false;
        for (i, node) in nodes.into_iter().enumerate() {
            let last = i + 1 == count;
            match node {
                Node::Element(child) => {
                    eval_comments = false;
                    self.child(child, element, &mut out, last, env)?;
                }
                Node::Text(text, at) => {
                    let text = self.text(&text, env, at)?.text();
                    eval_comments &= text.trim().is_empty();
                    out.push(Node::Text(text, at));
                }
                Node::Comment(text, _) if text.contains("xacro:eval-comments") => {
                    eval_comments = !text.contains("xacro:eval-comments:off");
                }
                Node::Comment(text, at) if eval_comments => {
                    let text = self.text(&text, env, at)?.text();
                    out.push(Node::Comment(text, at));
                }
                other => out.push(other),
            }
        }
        element.children = out;
        Ok(())
    }

    /// Evaluates one child and appends the result to `out`.
    fn child(&mut self, child: Element, parent: &mut Element, out: &mut Vec<Node>, last: bool, env: Env) -> Result {
        let at = child.at;
        self.charge(1).map_err(|e| ExpansionError::new(e).at(at))?;
        match child.name.as_str() {
            "xacro:property" => {
                self.drop_comments(out, last);
                self.property(child, env)
            }
            "xacro:macro" => {
                self.drop_comments(out, last);
                self.define(child, env)
            }
            "xacro:arg" => {
                self.arg(&child, env)?;
                self.drop_comments(out, last);
                Ok(())
            }
            "xacro:include" => {
                let content = self.include(&child, parent, env)?;
                self.drop_comments(out, last);
                insert(out, content, last);
                Ok(())
            }
            "xacro:if" | "xacro:unless" => {
                self.drop_comments(out, last);
                self.condition(child, parent, out, last, env)
            }
            "xacro:insert_block" => {
                let content = self.block(&child, env)?;
                out.extend(content);
                Ok(())
            }
            "xacro:attribute" => {
                let name = self.needed(&child, "name", env)?;
                let value = self.needed(&child, "value", env)?;
                if name.is_empty() {
                    return Err(ExpansionError::new("this xacro:attribute has an empty name").at(at));
                }
                if matches!(parent.name.as_str(), "xacro:if" | "xacro:unless") {
                    let what = "inside a condition xacro:attribute has no effect: the element it would change is gone";
                    let hint = "put the condition into the value, or into the name of the element";
                    self.tree.report(Diag::warning(what).at(at.label()).hint(hint));
                }
                parent.set(&name, value, at);
                Ok(())
            }
            "xacro:element" => self.renamed(child, parent, out, last, env),
            "xacro:call" => {
                let call = self.dynamic_call(child, env)?;
                self.macro_call(call, parent, out, last, env)
            }
            name if name.starts_with("xacro:") => self.macro_call(child, parent, out, last, env),
            _ => {
                let mut child = child;
                self.element(&mut child, env)?;
                out.push(Node::Element(child));
                Ok(())
            }
        }
    }

    /// `xacro:element`: an element whose name is evaluated.
    fn renamed(
        &mut self,
        mut child: Element,
        parent: &mut Element,
        out: &mut Vec<Node>,
        last: bool,
        env: Env,
    ) -> Result {
        let name = self.needed(&child, "xacro:name", env)?;
        if name.is_empty() || name.contains(|c: char| c.is_whitespace() || "<>&\"'/=".contains(c)) {
            return Err(ExpansionError::new(format!("`{name}` is not an element name")).at(child.at));
        }
        if name == "xacro:element" {
            return Err(ExpansionError::new("xacro:element cannot make another xacro:element").at(child.at));
        }
        child.attributes.retain(|a| a.name != "xacro:name");
        child.name = name;
        self.child(child, parent, out, last, env)
    }

    fn condition(
        &mut self,
        mut child: Element,
        parent: &mut Element,
        out: &mut Vec<Node>,
        last: bool,
        env: Env,
    ) -> Result {
        let Some(condition) = child.attribute("value").cloned() else {
            return Err(ExpansionError::new(format!("this {} has no `value`", child.name)).at(child.at));
        };
        let value = self.text(&condition.value, env, condition.at)?;
        let holds = boolean(&value, &condition.value).map_err(|e| ExpansionError::new(e).at(condition.at))?;
        if holds == (child.name == "xacro:if") {
            // Its content belongs to the parent; so do namespaces declared by includes and macros inside.
            child.attributes.clear();
            self.element(&mut child, env)?;
            for declared in child.attributes.iter().filter(|a| a.name.starts_with("xmlns:")) {
                parent.set(&declared.name, declared.value.clone(), declared.at);
            }
            insert(out, child.children, last);
        }
        Ok(())
    }

    fn arg(&mut self, child: &Element, env: Env) -> Result {
        let name = match child.attribute("name") {
            Some(name) => name.value.clone(),
            None => return Err(ExpansionError::new("this xacro:arg has no `name`").at(child.at)),
        };
        self.declared.insert(name.clone());
        if !self.args.contains_key(&name)
            && let Some(default) = child.attribute("default")
        {
            let value = self.text(&default.value, env, default.at)?.text();
            self.args.insert(name, value);
        }
        Ok(())
    }

    /// Returns the content of an `xacro:insert_block`.
    fn block(&mut self, child: &Element, env: Env) -> Result<Vec<Node>> {
        let Some(name) = child.attribute("name") else {
            return Err(ExpansionError::new("this xacro:insert_block has no `name`").at(child.at));
        };
        let find = |prefix: &str| match self.scopes.find(env.symbols, &format!("{prefix}{}", name.value)) {
            Some(Entry::Block(block)) => Some(block.clone()),
            _ => None,
        };
        let block = find("**").or_else(|| find("*"));
        let Some(block) = block else {
            return Err(ExpansionError::new(format!("Undefined block \"{}\"", name.value)).at(name.at));
        };
        match &*block {
            Block::Whole(element) => {
                let mut element = element.clone();
                self.element(&mut element, env)?;
                Ok(vec![Node::Element(element)])
            }
            Block::Content(nodes, at) => {
                let mut holder = Element { children: nodes.clone(), at: *at, ..Element::default() };
                self.element(&mut holder, env)?;
                Ok(holder.children)
            }
        }
    }

    /// Removes comments right before an xacro element, up to the last barrier.
    pub(super) fn drop_comments(&mut self, out: &mut Vec<Node>, last: bool) {
        let mut at = out.len();
        loop {
            let before = |at: usize| {
                (0..at).rev().find(|i| !matches!(out.get(*i), Some(Node::Barrier(n)) if *n != self.barrier))
            };
            let Some(mut previous) = before(at) else { return };
            if matches!(out.get(previous), Some(Node::Text(text, _)) if is_small_gap(text)) {
                match before(previous) {
                    Some(further) => previous = further,
                    None => break,
                }
            }
            if !matches!(out.get(previous), Some(Node::Comment(..))) {
                break;
            }
            out.remove(previous);
            at = previous;
        }
        if !last {
            self.barrier += 1;
            out.push(Node::Barrier(self.barrier));
        }
    }

    /// Returns the folder of the file being read.
    pub(super) fn folder(&self) -> PathBuf {
        self.files.last().and_then(|file| file.parent()).map(Path::to_owned).unwrap_or_default()
    }

    /// Resolves a path relative to the file being read and normalizes it.
    pub(super) fn beside(&self, path: &str) -> PathBuf {
        plain(&self.folder().join(path))
    }

    pub(super) fn charge(&mut self, steps: usize) -> Evaluated<()> {
        self.steps += steps;
        match self.steps > MAX_STEPS {
            true => Err("the expansion takes too many steps\nhint: does a macro call itself without end?".to_owned()),
            false => Ok(()),
        }
    }
}

/// Returns whether a text between elements is blank with at most one line break.
fn is_small_gap(text: &str) -> bool {
    !text.is_empty() && text.trim().is_empty() && text.matches('\n').count() <= 1
}

/// Inserts content in place of an xacro element: before its barrier.
pub(super) fn insert(out: &mut Vec<Node>, content: Vec<Node>, last: bool) {
    let at = if !last && matches!(out.last(), Some(Node::Barrier(_))) { out.len() - 1 } else { out.len() };
    out.splice(at..at, content);
}

/// Returns a condition's value: xacro accepts fewer texts as booleans than Python.
pub(super) fn boolean(value: &Value, condition: &str) -> std::result::Result<bool, String> {
    let Value::Str(text) = value else { return Ok(value.truth()) };
    match &**text {
        "true" | "True" => Ok(true),
        "false" | "False" => Ok(false),
        other => super::value::integer(other).map(|i| i != 0).ok_or_else(|| {
            format!("Xacro conditional \"{condition}\" evaluated to \"{other}\", which is not a boolean expression")
        }),
    }
}
