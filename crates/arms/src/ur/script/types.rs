//! Which names and types a program may use. Variables keep the type of their first value; int and float are distinct.

use std::collections::BTreeMap;

use super::names::Builtin;
use super::{Action, Expression, Function, Kind, Operator, Refused, Statement};

/// Type of a value. The numbers of a list may be mixed: they are floats then.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Type {
    /// A parameter of a function that nothing calls, or what the manual leaves open.
    Any,
    Int,
    Float,
    Bool,
    Text,
    Ints,
    Floats,
    /// A list of other values.
    List,
    Pose,
    /// A function that returns nothing.
    Nothing,
}

use Type::{Any, Bool, Float, Floats, Int, Ints, List, Nothing, Pose, Text};

impl Type {
    fn is_number(self) -> bool {
        matches!(self, Int | Float | Any)
    }

    fn is_list(self) -> bool {
        matches!(self, Ints | Floats | List)
    }

    /// Whether a parameter of this letter takes it.
    fn suits(self, letter: char) -> bool {
        match letter {
            _ if self == Any => true,
            'n' => self.is_number(),
            'i' => self == Int,
            'b' => self == Bool,
            's' => self == Text,
            'l' | 'p' => self.is_list() || self == Pose,
            _ => self != Nothing,
        }
    }

    /// Type of a variable of this type after a value of type `new`; `None`: it may not have that. The vendor's programs
    /// put lists of floats into variables with lists of ints, and poses and lists of six numbers into the same one.
    fn assigned(self, new: Self) -> Option<Self> {
        match (self, new) {
            (_, Nothing) => None,
            (old, new) if old == new => Some(old),
            (Any, known) | (known, Any) => Some(known),
            (Ints | Floats, Ints | Floats) => Some(Floats),
            (Pose, list) | (list, Pose) if list.is_list() => Some(Floats),
            _ => None,
        }
    }
}

/// Checks a program.
pub(super) fn check(program: &[Statement]) -> Result<(), Refused> {
    let mut checker = Checker { globals: BTreeMap::new(), functions: BTreeMap::new(), seen: BTreeMap::new() };
    let mut top = Scope { locals: None, returns: None };
    checker.block(program, &mut top)?;
    // Those that nothing calls: the program itself, too. A function within them is known only now.
    loop {
        let called = |wanted: &str| checker.seen.keys().any(|(name, _)| *name == wanted);
        let Some(name) = checker.functions.keys().copied().find(|name| !called(name)) else { return Ok(()) };
        let Some(function) = checker.functions.get(name).copied() else { return Ok(()) };
        let arguments = vec![Any; function.parameters.len()];
        checker.enter(function, arguments)?;
    }
}

struct Checker<'a> {
    globals: BTreeMap<&'a str, Type>,
    functions: BTreeMap<&'a str, &'a Function>,
    /// What functions return for arguments of these types.
    seen: BTreeMap<(&'a str, Vec<Type>), Type>,
}

/// Where statements are.
struct Scope<'a> {
    /// The variables of a function.
    locals: Option<BTreeMap<&'a str, Type>>,
    returns: Option<Type>,
}

impl<'a> Checker<'a> {
    fn block(&mut self, statements: &'a [Statement], scope: &mut Scope<'a>) -> Result<(), Refused> {
        statements.iter().try_for_each(|statement| self.statement(statement, scope))
    }

    fn statement(&mut self, statement: &'a Statement, scope: &mut Scope<'a>) -> Result<(), Refused> {
        let line = statement.line;
        match &statement.action {
            Action::Assign { local, name, value } => {
                let new = self.value(value, scope)?;
                let known = scope.locals.as_ref().is_some_and(|locals| locals.contains_key(name.as_str()));
                let variables = match &mut scope.locals {
                    Some(locals) if *local || known || !self.globals.contains_key(name.as_str()) => locals,
                    _ => &mut self.globals,
                };
                let old = *variables.entry(name).or_insert(new);
                match old.assigned(new) {
                    Some(kept) => drop(variables.insert(name, kept)),
                    None => return Refused::new(line, format!("{name} is {old:?}, and cannot become {new:?}")),
                }
            }
            Action::AssignItem { name, index, value } => {
                let list = self.variable(line, name, scope)?;
                let (index, new) = (self.value(index, scope)?, self.value(value, scope)?);
                let item = item(line, list, index)?;
                if item != new && item != Any && new != Any {
                    return Refused::new(line, format!("an item of {name} is {item:?}, and cannot become {new:?}"));
                }
            }
            Action::Evaluate(call) => drop(self.expression(call, scope)?),
            Action::If { cases, otherwise } => {
                for (condition, body) in cases {
                    self.condition(condition, scope)?;
                    self.block(body, scope)?;
                }
                self.block(otherwise, scope)?;
            }
            Action::While(condition, body) => {
                self.condition(condition, scope)?;
                self.block(body, scope)?;
            }
            Action::Define(function) => {
                let before = self.functions.insert(&function.name, function);
                let again = before.is_some_and(|before| !std::ptr::eq(before, function));
                if again || Builtin::find(&function.name).is_some() {
                    return Refused::new(line, format!("there is a function {} already", function.name));
                }
            }
            Action::Return(value) => {
                let new = value.as_ref().map_or(Ok(Nothing), |value| self.value(value, scope))?;
                let old = scope.returns.unwrap_or(new);
                // One that returns nothing in some cases: what it returns elsewhere is checked where it is used.
                let Some(kept) = (if new == Nothing { Some(old) } else { old.assigned(new) }) else {
                    return Refused::new(line, format!("the function returns {old:?}, and cannot return {new:?}"));
                };
                scope.returns = Some(kept);
            }
            Action::Thread(thread) => {
                if !matches!(self.value(thread, scope)?, Int | Any) {
                    return Refused::new(line, "this is no thread");
                }
            }
            Action::Loop | Action::Other => {}
        }
        Ok(())
    }

    /// A function's body, for arguments of these types; returns what it returns.
    fn enter(&mut self, function: &'a Function, arguments: Vec<Type>) -> Result<Type, Refused> {
        let key = (function.name.as_str(), arguments);
        if let Some(known) = self.seen.get(&key) {
            return Ok(*known);
        }
        // For a call within it.
        self.seen.insert(key.clone(), Any);
        let names = function.parameters.iter().map(|(name, _)| name.as_str());
        let locals = names.zip(key.1.iter().copied()).collect();
        let mut scope = Scope { locals: Some(locals), returns: None };
        self.block(&function.body, &mut scope)?;
        let returns = scope.returns.unwrap_or(Nothing);
        self.seen.insert(key, returns);
        Ok(returns)
    }

    fn variable(&self, line: u32, name: &str, scope: &Scope<'a>) -> Result<Type, Refused> {
        let local = scope.locals.as_ref().and_then(|locals| locals.get(name));
        match local.or_else(|| self.globals.get(name)) {
            Some(found) => Ok(*found),
            None => Refused::new(line, format!("{name} has no value yet")),
        }
    }

    fn condition(&mut self, condition: &'a Expression, scope: &Scope<'a>) -> Result<(), Refused> {
        match self.value(condition, scope)? {
            Bool | Int | Float | Any => Ok(()),
            other => Refused::new(condition.line, format!("a condition is Bool, not {other:?}")),
        }
    }

    /// An expression that has a value.
    fn value(&mut self, expression: &'a Expression, scope: &Scope<'a>) -> Result<Type, Refused> {
        match self.expression(expression, scope)? {
            Nothing => Refused::new(expression.line, "this function returns nothing"),
            found => Ok(found),
        }
    }

    fn expression(&mut self, expression: &'a Expression, scope: &Scope<'a>) -> Result<Type, Refused> {
        let line = expression.line;
        Ok(match &expression.kind {
            Kind::Int(_) => Int,
            Kind::Float(_) => Float,
            Kind::Bool(_) => Bool,
            Kind::Text => Text,
            Kind::Name(name) => self.variable(line, name, scope)?,
            Kind::List(items) => {
                let kinds = items.iter().map(|item| self.value(item, scope)).collect::<Result<Vec<_>, _>>()?;
                match &kinds[..] {
                    kinds if kinds.iter().all(|kind| *kind == Int) => Ints,
                    kinds if kinds.iter().all(|kind| kind.is_number()) => Floats,
                    [first, rest @ ..] if rest.iter().all(|kind| first.assigned(*kind).is_some()) => List,
                    _ => return Refused::new(line, "the items of a list have one type"),
                }
            }
            Kind::Pose(items) => {
                for item in items {
                    if !self.value(item, scope)?.is_number() {
                        return Refused::new(line, "a pose has six numbers");
                    }
                }
                if items.len() == 6 { Pose } else { return Refused::new(line, "a pose has six numbers") }
            }
            Kind::Item(list, index) => {
                let (list, index) = (self.value(list, scope)?, self.value(index, scope)?);
                item(line, list, index)?
            }
            Kind::Call(name, arguments) => self.call(line, name, arguments, scope)?,
            Kind::Run(call) => match &call.kind {
                Kind::Call(name, _) if self.functions.contains_key(name.as_str()) => {
                    self.expression(call, scope)?;
                    Int
                }
                _ => return Refused::new(line, "this is no thread"),
            },
            Kind::Not(operand) => match self.value(operand, scope)? {
                Bool | Any => Bool,
                other => return Refused::new(line, format!("not takes Bool, not {other:?}")),
            },
            Kind::Negative(operand) => match self.value(operand, scope)? {
                found if found.is_number() || found.is_list() => found,
                other => return Refused::new(line, format!("{other:?} has no sign")),
            },
            Kind::Binary(operator, left, right) => {
                let (left, right) = (self.value(left, scope)?, self.value(right, scope)?);
                let Some(result) = result(*operator, left, right) else {
                    return Refused::new(line, format!("{operator:?} does not take {left:?} and {right:?}"));
                };
                result
            }
        })
    }

    fn call(
        &mut self,
        line: u32,
        name: &'a str,
        arguments: &'a [(Option<String>, Expression)],
        scope: &Scope<'a>,
    ) -> Result<Type, Refused> {
        let own = self.functions.get(name).copied();
        let parameters: Vec<(&str, char, bool)> = match (own, Builtin::find(name)) {
            (Some(function), _) => {
                let parameters = function.parameters.iter();
                parameters.map(|(name, default)| (name.as_str(), 'x', default.is_some())).collect()
            }
            (None, Some(builtin)) => builtin.parameters().collect(),
            (None, None) => return Refused::new(line, format!("there is no function {name}")),
        };
        let mut given = vec![None; parameters.len()];
        for (i, (keyword, value)) in arguments.iter().enumerate() {
            let found = self.value(value, scope)?;
            let at = match keyword {
                Some(keyword) => parameters.iter().position(|(parameter, ..)| parameter == keyword),
                None => Some(i),
            };
            let slot = at.and_then(|at| given.get_mut(at).zip(parameters.get(at)));
            match slot {
                Some((Some(_), (parameter, ..))) => {
                    return Refused::new(line, format!("{name} gets {parameter} twice"));
                }
                Some((slot, (parameter, letter, _))) => {
                    if !found.suits(*letter) {
                        return Refused::new(line, format!("{parameter} of {name} cannot be {found:?}"));
                    }
                    *slot = Some(found);
                }
                None => return Refused::new(line, format!("{name} takes {} arguments", parameters.len())),
            }
        }
        if let Some((_, (parameter, ..))) =
            given.iter().zip(&parameters).find(|(given, (.., may))| given.is_none() && !may)
        {
            return Refused::new(line, format!("{name} needs {parameter}"));
        }
        let Some(function) = own else { return Ok(Builtin::find(name).map_or(Any, |builtin| builtin.returns)) };
        let mut types = Vec::new();
        for (given, (_, default)) in given.into_iter().zip(&function.parameters) {
            types.push(match (given, default) {
                (Some(given), _) => given,
                (None, Some(default)) => self.value(default, scope)?,
                (None, None) => Any,
            });
        }
        self.enter(function, types)
    }
}

/// The type of an item of a list.
fn item(line: u32, list: Type, index: Type) -> Result<Type, Refused> {
    if !matches!(index, Int | Any) {
        return Refused::new(line, format!("an index is Int, not {index:?}"));
    }
    match list {
        Ints => Ok(Int),
        Floats | Pose => Ok(Float),
        List | Any => Ok(Any),
        other => Refused::new(line, format!("{other:?} has no items")),
    }
}

/// What an operator makes of two values; `None` if it does not take them.
fn result(operator: Operator, left: Type, right: Type) -> Option<Type> {
    let both = |is: fn(Type) -> bool| is(left) && is(right);
    match operator {
        Operator::And | Operator::Or => both(|kind| matches!(kind, Bool | Any)).then_some(Bool),
        Operator::Less | Operator::Greater | Operator::LessOrEqual | Operator::GreaterOrEqual => {
            both(Type::is_number).then_some(Bool)
        }
        Operator::Equal | Operator::Unequal => {
            let same = both(Type::is_number) || left.assigned(right).is_some();
            same.then_some(Bool)
        }
        Operator::Divide if left == Int && right == Int => Some(Float),
        _ if both(|kind| kind == Int) => Some(Int),
        _ if left == Any || right == Any => {
            let known = if left == Any { right } else { left };
            // A list times a number, or plus a list: nothing is known of the other one.
            (known.is_number() || known.is_list()).then_some(if known.is_list() { Floats } else { Any })
        }
        _ if both(Type::is_number) => Some(Float),
        Operator::Add | Operator::Subtract if both(Type::is_list) => Some(if left == right { left } else { Floats }),
        Operator::Multiply | Operator::Divide if left.is_list() && right.is_number() => Some(Floats),
        Operator::Multiply if left.is_number() && right.is_list() => Some(Floats),
        _ => None,
    }
}
