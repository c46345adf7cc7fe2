//! The walk over the elements: each is copied, filled in, or replaced by what it stands for.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::{Path, PathBuf};
use std::rc::Rc;

use super::evaluate::{Evaluated, Host, evaluate};
use super::functions;
use super::scope::{Block, Entry, Macros, Scopes};
use super::text::{Part, Substitution, converted, parts, substitution};
use super::value::Value;
use super::{Expansion, Result, Trouble};
use crate::robot::packages::{Packages, absolute, plain};
use crate::robot::xml::{Calls, Document, Element, Node, Place};
use crate::yaml::{Diag, Tree, closest};

/// The deepest nesting of elements, macro calls and properties that wait for each other.
const MAX_DEPTH: usize = 400;
/// The most work of one expansion, in elements, attributes and steps of expressions.
const MAX_STEPS: usize = 3_000_000;
/// The longest text that an attribute may come to [bytes].
const MAX_TEXT: usize = 1 << 20;

/// Where names are looked up.
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
    /// Arguments that the files know.
    declared: BTreeSet<String>,
    pub(super) scopes: Scopes,
    pub(super) macros: Macros,
    pub(super) calls: Calls,
    /// The files that are being read, the innermost last.
    pub(super) files: Vec<PathBuf>,
    pub(super) read: Vec<PathBuf>,
    pub(super) parsed: HashMap<PathBuf, Rc<Document>>,
    /// Folders that files may be read from.
    pub(super) roots: Vec<PathBuf>,
    /// Properties that are being evaluated, for naming a circle.
    pub(super) pending: Vec<String>,
    depth: usize,
    steps: usize,
    /// Number of the barrier that stands; earlier ones have moved there.
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
        if let Err(trouble) = done {
            self.tree.report(trouble.diag(&self.calls, source));
            return None;
        }
        let unknown = self.given.keys().filter(|name| !self.declared.contains(*name));
        let near = |name: &str| closest(name, self.declared.iter().map(String::as_str)).map(str::to_owned);
        let unknown_args = unknown.map(|name| (name.clone(), near(name))).collect();
        Some(Expansion { document, calls: self.calls, files: self.read, unknown_args })
    }

    /// Goes one level deeper; `leave` comes back.
    pub(super) fn enter(&mut self) -> Result {
        self.depth += 1;
        self.charge(1).map_err(Trouble::new)?;
        if self.depth > MAX_DEPTH {
            let what = format!("elements and macro calls are nested deeper than {MAX_DEPTH}");
            return Err(Trouble::new(what).hint(Some("does a macro call itself without end?".to_owned())));
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

    /// Evaluates what an element contains.
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

    /// Evaluates one child; what it comes to goes to `out`.
    fn child(&mut self, child: Element, parent: &mut Element, out: &mut Vec<Node>, last: bool, env: Env) -> Result {
        let at = child.at;
        self.charge(1).map_err(|e| Trouble::new(e).at(at))?;
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
                    return Err(Trouble::new("this xacro:attribute has an empty name").at(at));
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
            return Err(Trouble::new(format!("`{name}` is no name for an element")).at(child.at));
        }
        if name == "xacro:element" {
            return Err(Trouble::new("xacro:element cannot make another xacro:element").at(child.at));
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
            return Err(Trouble::new(format!("this {} has no `value`", child.name)).at(child.at));
        };
        let value = self.text(&condition.value, env, condition.at)?;
        let holds = boolean(&value, &condition.value).map_err(|e| Trouble::new(e).at(condition.at))?;
        if holds == (child.name == "xacro:if") {
            // What it keeps belongs to the parent; so do namespaces that includes and macros inside declare.
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
            None => return Err(Trouble::new("this xacro:arg has no `name`").at(child.at)),
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

    /// The content of an `xacro:insert_block`.
    fn block(&mut self, child: &Element, env: Env) -> Result<Vec<Node>> {
        let Some(name) = child.attribute("name") else {
            return Err(Trouble::new("this xacro:insert_block has no `name`").at(child.at));
        };
        let find = |prefix: &str| match self.scopes.find(env.symbols, &format!("{prefix}{}", name.value)) {
            Some(Entry::Block(block)) => Some(block.clone()),
            _ => None,
        };
        let block = find("**").or_else(|| find("*"));
        let Some(block) = block else {
            return Err(Trouble::new(format!("Undefined block \"{}\"", name.value)).at(name.at));
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

    /// Comments right before an element of xacro's go with it. A barrier keeps those that were decided on.
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

    /// An attribute that must be there, evaluated.
    pub(super) fn needed(&mut self, element: &Element, name: &str, env: Env) -> Result<String> {
        match element.attribute(name).cloned() {
            Some(attribute) => Ok(self.text(&attribute.value, env, attribute.at)?.text()),
            None => Err(Trouble::new(format!("{}: missing attribute '{name}'", element.name)).at(element.at)),
        }
    }

    /// The value of a text. A text that is nothing but one expression keeps the expression's type.
    pub(super) fn text(&mut self, text: &str, env: Env, at: Place) -> Result<Value> {
        if !text.contains('$') {
            return Ok(text.into());
        }
        let parts = parts(text).map_err(|e| Trouble::new(e).at(at))?;
        let mut values = Vec::with_capacity(parts.len());
        for part in parts {
            values.push(match part {
                Part::Plain(text) => text.into(),
                Part::Expression(inside) => self.expression(&inside, env, at)?,
                Part::Substitution(inside) => {
                    let inside = self.text(&inside, env, at)?.text();
                    self.substitution(&inside).map_err(|e| Trouble::new(e).at(at))?.into()
                }
            });
        }
        if let [value] = values.as_slice() {
            return Ok(value.clone());
        }
        let mut out = String::new();
        for value in values {
            out.push_str(&value.text());
            if out.len() > MAX_TEXT {
                return Err(Trouble::new(format!("a text is longer than {MAX_TEXT} bytes")).at(at));
            }
        }
        Ok(out.into())
    }

    fn expression(&mut self, inside: &str, env: Env, at: Place) -> Result<Value> {
        let expression = self.text(inside, env, at)?.text();
        let mut host = Names { expander: self, env, trouble: None };
        let value = evaluate(&expression, &mut host);
        let trouble = host.trouble.take();
        value.map_err(|what| {
            if let Some(trouble) = trouble {
                return trouble.also(at, "used here");
            }
            let (what, hint) = match what.split_once("\nhint: ") {
                Some((what, hint)) => (what.to_owned(), Some(hint.to_owned())),
                None => (what, None),
            };
            let hint = hint.or_else(|| self.near_name(&what, env));
            let shown: String = expression.chars().take(120).collect();
            Trouble::new(format!("{what}, when evaluating the expression '{}'", shown.trim())).at(at).hint(hint)
        })
    }

    /// A name close to one that is not defined.
    fn near_name(&self, what: &str, env: Env) -> Option<String> {
        let name = what.strip_prefix("name '")?.strip_suffix("' is not defined")?;
        let near = closest(name, self.scopes.names(env.symbols))?;
        Some(format!("did you mean `{near}`?"))
    }

    /// The text of a `$(…)`.
    fn substitution(&mut self, inside: &str) -> Evaluated<String> {
        match substitution(inside)? {
            Substitution::Arg(name) => self.argument(name),
            Substitution::Find(package) => self.package(package),
            Substitution::Env(name) => {
                std::env::var(name).map_err(|_| format!("the environment variable {name} is not set"))
            }
            Substitution::OptEnv(name, otherwise) => Ok(std::env::var(name).unwrap_or(otherwise)),
            Substitution::Dirname => Ok(self.folder().display().to_string()),
            Substitution::Cwd => Ok(absolute(Path::new(".")).display().to_string()),
            Substitution::Eval(expression) => {
                if expression.contains("__") {
                    return Err("$(eval …) may not contain double underscores".to_owned());
                }
                Ok(evaluate(expression, &mut Arguments { expander: self })?.text())
            }
        }
    }

    pub(super) fn argument(&mut self, name: &str) -> Evaluated<String> {
        self.declared.insert(name.to_owned());
        self.args.get(name).cloned().ok_or_else(|| {
            format!(
                "Undefined substitution argument {name}\nhint: give it a value: --xacro-arg {name}:=…, or `xacro_args`"
            )
        })
    }

    fn package(&mut self, package: &str) -> Evaluated<String> {
        let found = self.packages.find(package, &self.folder())?;
        if !self.roots.contains(&found) {
            self.roots.push(found.clone());
        }
        Ok(found.display().to_string())
    }

    /// The folder of the file that is being read.
    pub(super) fn folder(&self) -> PathBuf {
        self.files.last().and_then(|file| file.parent()).map(Path::to_owned).unwrap_or_default()
    }

    /// A path beside the file that is being read, made plain.
    pub(super) fn beside(&self, path: &str) -> PathBuf {
        plain(&self.folder().join(path))
    }

    pub(super) fn charge(&mut self, steps: usize) -> Evaluated<()> {
        self.steps += steps;
        match self.steps > MAX_STEPS {
            true => Err("the expansion is too much work\nhint: does a macro call itself without end?".to_owned()),
            false => Ok(()),
        }
    }
}

/// Whether a text between elements is a blank with one line break at most.
fn is_small_gap(text: &str) -> bool {
    !text.is_empty() && text.trim().is_empty() && text.matches('\n').count() <= 1
}

/// Puts content where an element of xacro's stood: before the barrier that was set for it.
pub(super) fn insert(out: &mut Vec<Node>, content: Vec<Node>, last: bool) {
    let at = if !last && matches!(out.last(), Some(Node::Barrier(_))) { out.len() - 1 } else { out.len() };
    out.splice(at..at, content);
}

/// The truth of a condition: xacro takes fewer texts for booleans than Python does.
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

/// Names of `${…}`: properties, then built-in ones.
struct Names<'e, 't> {
    expander: &'e mut Expander<'t>,
    env: Env,
    /// What went wrong in a property, with its own place.
    trouble: Option<Box<Trouble>>,
}

impl Host for Names<'_, '_> {
    fn name(&mut self, name: &str) -> Evaluated<Option<Value>> {
        match self.member(self.env.symbols, name)? {
            Some(value) => Ok(Some(value)),
            None => Ok(functions::global(name)),
        }
    }

    fn member(&mut self, namespace: usize, name: &str) -> Evaluated<Option<Value>> {
        self.expander.resolve(namespace, name, self.env.macros).map_err(|trouble| {
            let message = trouble.message.clone();
            self.trouble = Some(trouble);
            message
        })
    }

    fn call(&mut self, function: &str, values: &[Value]) -> Option<Evaluated> {
        let text = || values.iter().map(Value::text).collect::<Vec<_>>().join(" ");
        let first = || values.first().map(Value::text).ok_or_else(|| format!("{function}() takes an argument"));
        Some(match function {
            "load_yaml" => first().and_then(|path| self.expander.load_yaml(&path)),
            "abs_filename" => first().map(|path| self.expander.beside(&path).display().to_string().into()),
            "arg" => first().and_then(|name| self.expander.argument(&name)).map(Value::from),
            "fatal" => Err(text()),
            "warning" | "error" => {
                self.expander.tree.report(Diag::warning(format!("the file says: {}", text())));
                Ok("".into())
            }
            "message" | "print_location" => Ok("".into()),
            _ => return None,
        })
    }

    fn charge(&mut self, steps: usize) -> Evaluated<()> {
        self.expander.charge(steps)
    }
}

/// Names of `$(eval …)`: arguments and built-in ones, no properties.
struct Arguments<'e, 't> {
    expander: &'e mut Expander<'t>,
}

impl Host for Arguments<'_, '_> {
    fn name(&mut self, name: &str) -> Evaluated<Option<Value>> {
        Ok(match name {
            "true" => Some(Value::Bool(true)),
            "false" => Some(Value::Bool(false)),
            "arg" => Some(Value::Function("arg")),
            "env" => Some(Value::Function("env")),
            "optenv" => Some(Value::Function("optenv")),
            "find" => Some(Value::Function("find")),
            "dirname" => Some(Value::Function("dirname")),
            _ => functions::global(name).or_else(|| {
                let text = self.expander.args.get(name)?.clone();
                self.expander.declared.insert(name.to_owned());
                Some(converted(&text))
            }),
        })
    }

    fn member(&mut self, _: usize, _: &str) -> Evaluated<Option<Value>> {
        Ok(None)
    }

    fn call(&mut self, function: &str, values: &[Value]) -> Option<Evaluated> {
        let first = || values.first().map(Value::text).ok_or_else(|| format!("{function}() takes an argument"));
        Some(match function {
            "arg" => first().and_then(|name| self.expander.argument(&name)).map(|text| converted(&text)),
            "find" => first().and_then(|name| self.expander.package(&name)).map(Value::from),
            "dirname" => Ok(self.expander.folder().display().to_string().into()),
            "env" => first().and_then(|name| {
                std::env::var(&name).map(Value::from).map_err(|_| format!("environment variable {name} is not set"))
            }),
            "optenv" => first().map(|name| {
                let otherwise = values.get(1).map(Value::text).unwrap_or_default();
                std::env::var(name).unwrap_or(otherwise).into()
            }),
            _ => return None,
        })
    }

    fn charge(&mut self, steps: usize) -> Evaluated<()> {
        self.expander.charge(steps)
    }
}
