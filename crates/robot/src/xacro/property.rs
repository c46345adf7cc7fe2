//! Properties: set, looked up on use, evaluated once.

use std::rc::Rc;

use super::expand::{Env, Expander, boolean};
use super::functions;
use super::scope::{Block, Entry};
use super::tokens::is_identifier;
use super::value::{Value, literal};
use super::{ExpansionError, Result};
use crate::xml::{Attribute, Element};
use dimos_yaml::Diag;

impl Expander<'_> {
    /// `xacro:property`
    pub(super) fn property(&mut self, element: Element, env: Env) -> Result {
        let at = element.at;
        let name = self.needed(&element, "name", env)?;
        if !is_identifier(&name) {
            return Err(ExpansionError::new(format!("Property names must be valid python identifiers: {name}")).at(at));
        }
        if name.starts_with("__") {
            return Err(
                ExpansionError::new(format!("Property names must not start with double underscore: {name}")).at(at)
            );
        }
        let flag = |expander: &mut Self, key: &str, otherwise: bool| match element.attribute(key).cloned() {
            Some(a) => {
                let value = expander.text(&a.value, env, a.at)?;
                boolean(&value, &a.value).map_err(|e| ExpansionError::new(e).at(a.at))
            }
            None => Ok(otherwise),
        };
        let remove = flag(self, "remove", false)?;
        let value = element.attribute("value").cloned();
        let default = element.attribute("default").cloned();
        if usize::from(value.is_some()) + usize::from(default.is_some()) + usize::from(remove) > 1 {
            let what = format!("Property attributes default, value, and remove are mutually exclusive: {name}");
            return Err(ExpansionError::new(what).at(at));
        }
        let known = self.scopes.find(env.symbols, &name).is_some() || functions::global(&name).is_some();
        if remove && known {
            self.scopes.remove(env.symbols, &name);
            return Ok(());
        }
        if default.is_some() && known {
            return Ok(());
        }
        let lazy = flag(self, "lazy_eval", true)?;
        let scope = element.attribute("scope").map(|a| a.value.as_str());
        let (target, lazy) = match scope {
            Some("global") => (0, false),
            Some("parent") => match self.scopes.parent(env.symbols) {
                Some(parent) => (parent, false),
                None => {
                    let what = format!("the property `{name}` has no parent scope: it is global already");
                    self.tree.report(Diag::warning(what).at(at.label()));
                    (env.symbols, false)
                }
            },
            _ => (env.symbols, lazy),
        };
        match value.or(default) {
            Some(value) => self.assign(target, &name, &value, lazy, env),
            None => {
                let block = Block::Content(element.children, at);
                self.scopes.set(target, &format!("**{name}"), Entry::Block(Rc::new(block)));
                Ok(())
            }
        }
    }

    fn assign(&mut self, target: usize, name: &str, value: &Attribute, lazy: bool, env: Env) -> Result {
        let entry = if lazy {
            match literal(&value.value) {
                // Not a literal: evaluated on first use.
                Value::Str(text) => Entry::Lazy(text.to_string(), value.at),
                other => Entry::Value(other),
            }
        } else {
            Entry::Value(typed(self.text(&value.value, env, value.at)?))
        };
        self.scopes.set(target, name, entry);
        Ok(())
    }

    /// Returns the value of a name from a scope upwards. A lazy property is evaluated in its own scope.
    pub(super) fn resolve(&mut self, scope: usize, name: &str, macros: usize) -> Result<Option<Value>> {
        let Some(owner) = self.scopes.owner(scope, name) else { return Ok(None) };
        let (text, at) = match self.scopes.find(owner, name) {
            Some(Entry::Value(value)) => return Ok(Some(value.clone())),
            Some(Entry::Lazy(text, at)) => (text.clone(), *at),
            Some(Entry::Pending) => {
                let from = self.pending.iter().position(|p| p == name).unwrap_or(0);
                let circle = self.pending.get(from..).unwrap_or_default().join(" -> ");
                let hint = "lazy_eval=\"false\" evaluates a property at its definition".to_owned();
                return Err(
                    ExpansionError::new(format!("circular variable definition: {circle} -> {name}")).hint(Some(hint))
                );
            }
            Some(Entry::Block(_)) | None => return Ok(None),
        };
        self.enter().map_err(|e| e.at(at))?;
        self.scopes.set(owner, name, Entry::Pending);
        self.pending.push(name.to_owned());
        let value = typed(self.text(&text, Env { symbols: owner, macros }, at)?);
        self.pending.pop();
        self.scopes.set(owner, name, Entry::Value(value.clone()));
        self.leave();
        Ok(Some(value))
    }
}

/// Converts texts that are numbers or booleans.
pub(super) fn typed(value: Value) -> Value {
    match value {
        Value::Str(text) => literal(&text),
        other => other,
    }
}
