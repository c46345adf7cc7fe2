//! Evaluates texts: `${…}` with the names in scope, `$(…)`, and both inside a text.

use std::path::Path;

use super::evaluate::{Evaluated, Host, evaluate};
use super::expand::{Env, Expander};
use super::text::{Part, Substitution, converted, parts, substitution};
use super::value::Value;
use super::{ExpansionError, Result, functions};
use crate::packages::absolute;
use crate::xml::{Element, SourcePos};
use dimos_core::message::Message;
use dimos_yaml::{Diag, closest};

/// Maximum length of an evaluated attribute [bytes].
const MAX_TEXT: usize = 1 << 20;

impl Expander<'_> {
    /// Returns a required attribute, evaluated.
    pub(super) fn needed(&mut self, element: &Element, name: &str, env: Env) -> Result<String> {
        match element.attribute(name).cloned() {
            Some(attribute) => Ok(self.text(&attribute.value, env, attribute.at)?.text()),
            None => Err(ExpansionError::new(format!("{}: missing attribute '{name}'", element.name)).at(element.at)),
        }
    }

    /// Evaluates a text. A text that is a single expression keeps the expression's type.
    pub(super) fn text(&mut self, text: &str, env: Env, at: SourcePos) -> Result<Value> {
        if !text.contains('$') {
            return Ok(text.into());
        }
        let parts = parts(text).map_err(|e| ExpansionError::new(e).at(at))?;
        let mut values = Vec::with_capacity(parts.len());
        for part in parts {
            values.push(match part {
                Part::Plain(text) => text.into(),
                Part::Expression(inside) => self.expression(&inside, env, at)?,
                Part::Substitution(inside) => {
                    let inside = self.text(&inside, env, at)?.text();
                    self.substitution(&inside).map_err(|e| ExpansionError::new(e).at(at))?.into()
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
                return Err(ExpansionError::new(format!("a text is longer than {MAX_TEXT} bytes")).at(at));
            }
        }
        Ok(out.into())
    }

    fn expression(&mut self, inside: &str, env: Env, at: SourcePos) -> Result<Value> {
        let expression = self.text(inside, env, at)?.text();
        let mut host = Names { expander: self, env, trouble: None };
        let value = evaluate(&expression, &mut host);
        let trouble = host.trouble.take();
        value.map_err(|what| {
            if let Some(trouble) = trouble {
                return trouble.also(at, "used here");
            }
            let Message { what, hint } = what.into();
            let hint = hint.or_else(|| self.near_name(&what, env));
            let shown: String = expression.chars().take(120).collect();
            ExpansionError::new(format!("{what}, when evaluating the expression '{}'", shown.trim())).at(at).hint(hint)
        })
    }

    /// Returns a name similar to an undefined one.
    fn near_name(&self, what: &str, env: Env) -> Option<String> {
        let name = what.strip_prefix("name '")?.strip_suffix("' is not defined")?;
        let near = closest(name, self.scopes.names(env.symbols))?;
        Some(format!("did you mean `{near}`?"))
    }

    /// Returns the text of a `$(…)`.
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
}

/// Names in `${…}`: properties, then built-in ones.
struct Names<'e, 't> {
    expander: &'e mut Expander<'t>,
    env: Env,
    /// Error in a property, with its own position.
    trouble: Option<Box<ExpansionError>>,
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

/// Names in `$(eval …)`: arguments and built-in ones, no properties.
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
