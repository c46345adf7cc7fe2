//! The arguments of a call: a pickled pair of a tuple and a dict, as Python binds them to the parameters of a method.

use super::pickle_node::{Id, Node, Pickled};
use super::python_error::PythonError;

/// Largest number of named arguments: no method has more.
const MAX_NAMED: usize = 8;

/// The arguments of a call.
#[derive(Debug)]
pub struct Arguments<'p> {
    pickled: &'p Pickled<'p>,
    positional: &'p [Id],
    named: Vec<(&'p str, Id)>,
}

impl<'p> Arguments<'p> {
    /// Returns the arguments of a query's payload.
    pub fn of(pickled: &'p Pickled<'p>) -> Result<Self, PythonError> {
        let [positional, named] = *pickled.items(pickled.root(), "the payload")? else {
            return Err(PythonError::of_type("the payload is not a pair of arguments and named arguments"));
        };
        Self::of_dict(pickled, pickled.items(positional, "the arguments")?, named)
    }

    /// Returns the named arguments of a dict.
    pub fn of_dict(pickled: &'p Pickled<'p>, positional: &'p [Id], named: Id) -> Result<Self, PythonError> {
        let mut all: Vec<(&str, Id)> = Vec::new();
        for (name, value) in pickled.entries(named, "the named arguments")? {
            let name = pickled.text(*name, "the name of an argument")?;
            let given = all.len();
            match all.iter_mut().find(|(other, _)| *other == name) {
                Some(entry) => entry.1 = *value,
                None if given >= MAX_NAMED => return Err(PythonError::of_type("too many named arguments")),
                None => all.push((name, *value)),
            }
        }
        Ok(Self { pickled, positional, named: all })
    }

    /// Returns no arguments.
    pub fn empty(pickled: &'p Pickled<'p>) -> Self {
        Self { pickled, positional: &[], named: Vec::new() }
    }

    /// Binds the arguments to parameters, of which the first `required` have no default; `None`: not given.
    pub fn bind<const N: usize>(
        &self,
        method: &str,
        parameters: [&str; N],
        required: usize,
    ) -> Result<[Option<Id>; N], PythonError> {
        let wrong = |what: String| Err(PythonError::of_type(format!("{method}: {what}")));
        if self.positional.len() > N {
            return wrong(format!("takes {N} arguments, got {}", self.positional.len()));
        }
        let mut bound = [None; N];
        for (place, value) in bound.iter_mut().zip(self.positional) {
            *place = Some(*value);
        }
        for (name, value) in &self.named {
            match parameters.iter().position(|parameter| parameter == name) {
                None => {
                    let name: String = name.chars().take(80).collect();
                    let accepted = python_list(&parameters);
                    return wrong(format!("unexpected argument(s) ['{name}']; accepts {accepted}"));
                }
                Some(at) if bound[at].is_some() => return wrong(format!("multiple values for argument '{name}'")),
                Some(at) => bound[at] = Some(*value),
            }
        }
        match bound.iter().take(required).position(Option::is_none) {
            Some(at) => wrong(format!("missing a required argument: '{}'", parameters[at])),
            None => Ok(bound),
        }
    }

    /// Returns whether an argument is missing or `None`.
    pub fn is_none(&self, argument: Option<Id>) -> bool {
        argument.is_none_or(|id| *self.pickled.node(id) == Node::None)
    }
}

/// Returns strings as Python prints a list of them.
pub fn python_list(texts: &[&str]) -> String {
    let quoted: Vec<String> = texts.iter().map(|text| format!("'{text}'")).collect();
    format!("[{}]", quoted.join(", "))
}
