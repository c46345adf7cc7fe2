//! Macros: definition, lookup, calls.

use std::rc::Rc;

use super::expand::{Env, Expander, insert};
use super::property::typed;
use super::scope::{Block, Entry, Macro, MacroEntry, Parameter, parameters};
use super::{ExpansionError, Result};
use crate::xml::{Element, Node};
use dimos_yaml::{Diag, closest};

/// Work of a call, in steps.
const CALL_STEPS: usize = 30;

impl Expander<'_> {
    /// `xacro:macro`
    pub(super) fn define(&mut self, element: Element, env: Env) -> Result {
        let at = element.at;
        let Some(name) = element.attribute("name").map(|a| a.value.clone()) else {
            return Err(ExpansionError::new("this xacro:macro has no `name`").at(at));
        };
        let name = name.strip_prefix("xacro:").map(str::to_owned).unwrap_or(name);
        if name == "call" {
            return Err(ExpansionError::new("Invalid use of macro name 'call'").at(at));
        }
        if name.contains('.') {
            let what = format!("macro names must not contain '.' (reserved for namespaces): {name}");
            return Err(ExpansionError::new(what).at(at));
        }
        let parameters = match element.attribute("params") {
            Some(params) => parameters(&params.value).map_err(|e| ExpansionError::new(e).at(params.at))?,
            None => Vec::new(),
        };
        let entry = Macro { name: name.clone(), parameters, body: element };
        self.macros.set(env.macros, &name, MacroEntry::Macro(Rc::new(entry)));
        Ok(())
    }

    /// `xacro:call`: the macro's name is evaluated.
    pub(super) fn dynamic_call(&mut self, mut element: Element, env: Env) -> Result<Element> {
        let name = self.needed(&element, "macro", env)?;
        if name.is_empty() {
            return Err(ExpansionError::new("xacro:call is missing the 'macro' attribute").at(element.at));
        }
        element.attributes.retain(|a| a.name != "macro");
        element.name = format!("xacro:{name}");
        Ok(element)
    }

    /// Returns the macro of a name, and the scope of its body: `lib.arm` is the macro `arm` of an include with
    /// `ns="lib"`.
    fn find_macro(&self, name: &str, env: Env) -> Option<(Rc<Macro>, Env)> {
        let found = |env: Env, name: &str| match self.macros.find(env.macros, name) {
            Some(MacroEntry::Macro(found)) => Some((found.clone(), env)),
            _ => None,
        };
        if let Some(found) = found(env, name) {
            return Some(found);
        }
        let (namespaces, name) = name.rsplit_once('.')?;
        let mut inner = env;
        for namespace in namespaces.split('.') {
            let Some(MacroEntry::Namespace(macros)) = self.macros.find(inner.macros, namespace) else { return None };
            let symbols = match self.scopes.find(inner.symbols, namespace) {
                Some(Entry::Value(super::value::Value::Namespace(scope))) => *scope,
                _ => return None,
            };
            inner = Env { symbols, macros: *macros };
        }
        found(inner, name)
    }

    /// Replaces a call with the macro's body.
    pub(super) fn macro_call(
        &mut self,
        mut call: Element,
        parent: &mut Element,
        out: &mut Vec<Node>,
        last: bool,
        env: Env,
    ) -> Result {
        let at = call.at;
        let name = call.name.trim_start_matches("xacro:").to_owned();
        let Some((found, outer)) = self.find_macro(&name, env) else {
            let near =
                closest(&name, self.macros.names(env.macros)).map(|near| format!("did you mean `xacro:{near}`?"));
            return Err(ExpansionError::new(format!("unknown macro name: {}", call.name)).at(at).hint(near));
        };
        self.enter().map_err(|e| e.at(at))?;
        // A call creates scopes and copies a body: more work than an element.
        self.charge(CALL_STEPS).map_err(|e| ExpansionError::new(e).at(at))?;
        let inner =
            Env { symbols: self.scopes.below(outer.symbols, false), macros: self.macros.below(Some(outer.macros)) };
        let mut open: Vec<&Parameter> = found.parameters.iter().collect();
        for attribute in std::mem::take(&mut call.attributes) {
            let Some(at) = open.iter().position(|p| p.name == attribute.name) else {
                let known: Vec<&str> = found.parameters.iter().map(|p| p.name.as_str()).collect();
                let hint = match closest(&attribute.name, known.iter().copied()) {
                    Some(near) => format!("did you mean `{near}`?"),
                    None => format!("the macro `{name}` takes: {}", known.join(" ")),
                };
                let what = format!("Invalid parameter \"{}\"", attribute.name);
                return Err(ExpansionError::new(what).at(attribute.at).hint(Some(hint)));
            };
            let parameter = open.remove(at);
            let value = typed(self.text(&attribute.value, env, attribute.at)?);
            self.scopes.set(inner.symbols, &parameter.name, Entry::Value(value));
        }
        self.content(&mut call, env)?;
        self.blocks(&mut open, call, inner)?;
        self.defaults(&mut open, &found, env, inner).map_err(|e| e.at(at))?;
        let mut body = Element { children: found.body.children.clone(), at: found.body.at, ..Element::default() };
        // Namespaces declared by the macro's element move along with its content.
        body.attributes = found.body.attributes.iter().filter(|a| a.name.starts_with("xmlns:")).cloned().collect();
        let number = self.calls.add(&name, at);
        body.stamp(number);
        self.element(&mut body, inner)?;
        self.drop_comments(out, last);
        self.import_namespaces(parent, &body);
        insert(out, body.children, last);
        self.leave();
        Ok(())
    }

    /// Assigns the elements inside a call to block parameters, in order.
    fn blocks(&mut self, open: &mut Vec<&Parameter>, call: Element, inner: Env) -> Result {
        let at = call.at;
        let mut elements = call.children.into_iter().filter_map(|node| match node {
            Node::Element(element) => Some(element),
            _ => None,
        });
        while let Some(i) = open.iter().position(|p| p.name.starts_with('*')) {
            let parameter = open.remove(i);
            let Some(element) = elements.next() else {
                let name = parameter.name.trim_start_matches('*');
                return Err(ExpansionError::new(format!("Not enough blocks: `{name}` is missing")).at(at));
            };
            let block = match parameter.name.starts_with("**") {
                true => Block::Content(element.children, element.at),
                false => Block::Whole(element),
            };
            self.scopes.set(inner.symbols, &parameter.name, Entry::Block(Rc::new(block)));
        }
        match elements.next() {
            Some(element) => Err(ExpansionError::new(format!("Unused block \"{}\"", element.name)).at(element.at)),
            None => Ok(()),
        }
    }

    /// Fills in parameters that were not given.
    fn defaults(&mut self, open: &mut Vec<&Parameter>, found: &Macro, env: Env, inner: Env) -> Result {
        let mut missing = Vec::new();
        for parameter in std::mem::take(open) {
            let Some(default) = &parameter.default else {
                missing.push(parameter.name.as_str());
                continue;
            };
            let place = found.body.attribute("params").map_or(found.body.at, |a| a.at);
            let forwarded = match default.forward {
                true => self.known(&parameter.name, env)?,
                false => None,
            };
            let value = match (forwarded, &default.text) {
                (Some(value), _) => value,
                (None, Some(text)) => self.text(text, env, place)?,
                (None, None) => {
                    return Err(ExpansionError::new(format!("Undefined property to forward: {}", parameter.name)));
                }
            };
            self.scopes.set(inner.symbols, &parameter.name, Entry::Value(typed(value)));
        }
        match missing.is_empty() {
            true => Ok(()),
            false => Err(ExpansionError::new(format!("Undefined parameters [{}]", missing.join(",")))
                .hint(Some(format!("the macro `{}` needs a value for each", found.name)))),
        }
    }

    /// Returns the value of a name in the caller's scope.
    fn known(&mut self, name: &str, env: Env) -> Result<Option<super::value::Value>> {
        let own = self.resolve(env.symbols, name, env.macros)?;
        Ok(own.or_else(|| super::functions::global(name)))
    }

    /// Moves namespace declarations of a replaced element to its content.
    pub(super) fn import_namespaces(&mut self, parent: &mut Element, from: &Element) {
        for declared in from.attributes.iter().filter(|a| a.name.starts_with("xmlns:") && a.name != "xmlns:xacro") {
            match parent.attribute(&declared.name) {
                Some(old) if old.value != declared.value => {
                    let what = format!("{} has two meanings: {} and {}", declared.name, old.value, declared.value);
                    self.tree.report(Diag::warning(what).at(declared.at.label()));
                }
                _ => parent.set(&declared.name, declared.value.clone(), declared.at),
            }
        }
    }
}
