//! Name lookup: scopes of properties, and tables of macros. Each may have a parent that is searched next.

use std::collections::HashMap;
use std::rc::Rc;

use super::value::Value;
use crate::xml::{Element, Node, SourcePos};

/// Meaning of a name.
#[derive(Debug, Clone)]
pub(super) enum Entry {
    Value(Value),
    /// A text, evaluated on first use.
    Lazy(String, SourcePos),
    /// Under evaluation: a second visit is a cycle.
    Pending,
    /// XML: the content of a property, or a block passed to a macro.
    Block(Rc<Block>),
}

/// XML for insertion.
#[derive(Debug)]
pub(super) enum Block {
    /// An element itself.
    Whole(Element),
    /// The content of an element.
    Content(Vec<Node>, SourcePos),
}

#[derive(Debug, Default)]
struct Scope {
    names: HashMap<String, Entry>,
    parent: Option<usize>,
    namespace: bool,
}

/// All scopes; index 0 is the global one.
#[derive(Debug)]
pub(super) struct Scopes(Vec<Scope>);

impl Scopes {
    pub(super) fn new() -> Self {
        Self(vec![Scope::default()])
    }

    /// Creates a scope below another.
    pub(super) fn below(&mut self, parent: usize, namespace: bool) -> usize {
        self.0.push(Scope { names: HashMap::new(), parent: Some(parent), namespace });
        self.0.len() - 1
    }

    /// Returns the scope that has a name, from `scope` upwards.
    pub(super) fn owner(&self, scope: usize, name: &str) -> Option<usize> {
        self.chain(scope).find(|s| self.0.get(*s).is_some_and(|scope| scope.names.contains_key(name)))
    }

    /// Returns the meaning of a name, from `scope` upwards.
    pub(super) fn find(&self, scope: usize, name: &str) -> Option<&Entry> {
        self.owner(scope, name).and_then(|s| self.0.get(s)).and_then(|scope| scope.names.get(name))
    }

    pub(super) fn set(&mut self, scope: usize, name: &str, entry: Entry) {
        if let Some(scope) = self.0.get_mut(scope) {
            scope.names.insert(name.to_owned(), entry);
        }
    }

    /// Removes a name from a scope and its ancestors.
    pub(super) fn remove(&mut self, scope: usize, name: &str) {
        for scope in self.chain(scope).collect::<Vec<_>>() {
            if let Some(scope) = self.0.get_mut(scope) {
                scope.names.remove(name);
            }
        }
    }

    /// Returns the scope of `scope="parent"`: the caller's, which is not a namespace.
    pub(super) fn parent(&self, scope: usize) -> Option<usize> {
        let own = self.0.get(scope)?;
        let mut parent = own.parent?;
        while !own.namespace && self.0.get(parent).is_some_and(|p| p.namespace) {
            parent = self.0.get(parent)?.parent?;
        }
        Some(parent)
    }

    /// Returns the names of a scope and its ancestors, for hints.
    pub(super) fn names(&self, scope: usize) -> Vec<&str> {
        let scopes = self.chain(scope).filter_map(|s| self.0.get(s));
        scopes.flat_map(|s| s.names.keys()).map(String::as_str).collect()
    }

    fn chain(&self, scope: usize) -> impl Iterator<Item = usize> {
        std::iter::successors(Some(scope), |s| self.0.get(*s).and_then(|scope| scope.parent))
    }
}

/// A macro.
#[derive(Debug)]
pub(super) struct Macro {
    pub(super) name: String,
    pub(super) parameters: Vec<Parameter>,
    /// Its element; the content is the body.
    pub(super) body: Element,
}

/// A parameter of a macro. `*name` takes an element, `**name` the content of an element.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Parameter {
    pub(super) name: String,
    pub(super) default: Option<Default>,
}

/// Default of a parameter.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Default {
    /// The caller's value of the same name has priority.
    pub(super) forward: bool,
    /// A text to evaluate.
    pub(super) text: Option<String>,
}

/// Entry of a table of macros.
#[derive(Debug, Clone)]
pub(super) enum MacroEntry {
    Macro(Rc<Macro>),
    /// The table of an include with `ns`.
    Namespace(usize),
}

/// All tables of macros; index 0 is the global one.
#[derive(Debug)]
pub(super) struct Macros(Vec<(HashMap<String, MacroEntry>, Option<usize>)>);

impl Macros {
    pub(super) fn new() -> Self {
        Self(vec![(HashMap::new(), None)])
    }

    /// Creates a table; that of an include with `ns` has no parent.
    pub(super) fn below(&mut self, parent: Option<usize>) -> usize {
        self.0.push((HashMap::new(), parent));
        self.0.len() - 1
    }

    pub(super) fn find(&self, table: usize, name: &str) -> Option<&MacroEntry> {
        let mut tables = std::iter::successors(self.0.get(table), |(_, parent)| parent.and_then(|p| self.0.get(p)));
        tables.find_map(|(names, _)| names.get(name))
    }

    pub(super) fn set(&mut self, table: usize, name: &str, entry: MacroEntry) {
        if let Some((names, _)) = self.0.get_mut(table) {
            names.insert(name.to_owned(), entry);
        }
    }

    /// Returns the names of a table and its ancestors, for hints.
    pub(super) fn names(&self, table: usize) -> Vec<&str> {
        let tables = std::iter::successors(self.0.get(table), |(_, parent)| parent.and_then(|p| self.0.get(p)));
        tables.flat_map(|(names, _)| names.keys()).map(String::as_str).collect()
    }
}

/// Reads the `params` of a macro: `a b:=2 c:='x y' d:=^ e:=^|7 *block **blocks`.
pub(super) fn parameters(text: &str) -> Result<Vec<Parameter>, String> {
    let mut out: Vec<Parameter> = Vec::new();
    let mut rest = text.trim_start();
    while !rest.is_empty() {
        let end = rest.find(|c: char| c.is_whitespace() || c == ':' || c == '=').unwrap_or(rest.len());
        let (name, after) = rest.split_at(end);
        if name.is_empty() {
            return Err(format!("a parameter without name at `{rest}`"));
        }
        let spaced = after.trim_start();
        let assigned = spaced.strip_prefix(":=").or_else(|| spaced.strip_prefix('='));
        let default = match assigned {
            None if !spaced.starts_with(':') => {
                rest = spaced;
                None
            }
            None => return Err(format!("`:=` is expected after the parameter `{name}`")),
            Some(value) => {
                let value = value.trim_start();
                let (forward, value) = match value.strip_prefix('^') {
                    Some(value) => (true, value.strip_prefix('|').unwrap_or(value)),
                    None => (false, value),
                };
                let length = default_length(value)?;
                let (text, after) = value.split_at(length);
                rest = after.trim_start();
                Some(Default { forward, text: Some(text.to_owned()).filter(|t| !t.is_empty()) })
            }
        };
        // An empty default is no default: the empty text is written ''.
        let default = default.filter(|d| d.forward || d.text.is_some());
        out.push(Parameter { name: name.to_owned(), default });
    }
    Ok(out)
}

/// Returns the length of a default value: up to a space outside `${…}`, `$(…)` and quotes.
fn default_length(text: &str) -> Result<usize, String> {
    let mut at = 0;
    while let Some(c) = text[at..].chars().next() {
        let close = match c {
            c if c.is_whitespace() => break,
            '$' if text[at..].starts_with("${") => Some('}'),
            '$' if text[at..].starts_with("$(") => Some(')'),
            '\'' | '"' => Some(c),
            _ => None,
        };
        at += c.len_utf8();
        if let Some(close) = close {
            let inside =
                text[at..].find(close).ok_or_else(|| format!("`{close}` is missing in the default `{text}`"))?;
            at += inside + close.len_utf8();
        }
    }
    Ok(at)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parameters_are_read() {
        let list = parameters("a b:=2 c:='x y' d:=^ e:=^|${1 + 2} f=old g:=  *h **i j:=$(arg x)_y k:=").unwrap();
        let of = |name: &str, default: Option<(bool, Option<&str>)>| Parameter {
            name: name.to_owned(),
            default: default.map(|(forward, text)| Default { forward, text: text.map(str::to_owned) }),
        };
        assert_eq!(
            list,
            [
                of("a", None),
                of("b", Some((false, Some("2")))),
                of("c", Some((false, Some("'x y'")))),
                of("d", Some((true, None))),
                of("e", Some((true, Some("${1 + 2}")))),
                of("f", Some((false, Some("old")))),
                // As in the original: blanks after `:=` are skipped.
                of("g", Some((false, Some("*h")))),
                of("**i", None),
                of("j", Some((false, Some("$(arg x)_y")))),
                of("k", None),
            ]
        );
        for wrong in ["a:b", ":=2", "a:='x", "a:=${1"] {
            assert!(parameters(wrong).is_err(), "{wrong}");
        }
    }
}
