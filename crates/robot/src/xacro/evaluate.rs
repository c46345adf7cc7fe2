//! Expressions → values.

use std::cmp::Ordering;
use std::rc::Rc;

use super::functions;
use super::methods;
use super::syntax::{Expr, Loop, parse};
use super::value::{Dict, Value};

/// Maximum length of a text or list made by an expression.
pub(super) const MAX_LENGTH: usize = 1 << 20;

/// Result of an expression; errors use Python's wording where it exists.
pub(super) type Evaluated<T = Value> = Result<T, String>;

/// Environment of an expression.
pub(super) trait Host {
    /// Returns the value of a name.
    fn name(&mut self, name: &str) -> Evaluated<Option<Value>>;
    /// Returns the value of a name in a namespace.
    fn member(&mut self, namespace: usize, name: &str) -> Evaluated<Option<Value>>;
    /// Calls a function that needs files, arguments or messages; `None` if there is no such function.
    fn call(&mut self, function: &str, values: &[Value]) -> Option<Evaluated>;
    /// Counts work; fails beyond the limit.
    fn charge(&mut self, steps: usize) -> Evaluated<()>;
}

/// Evaluates an expression.
pub(super) fn evaluate(text: &str, host: &mut dyn Host) -> Evaluated {
    let expr = parse(text)?;
    Interpreter { host, locals: Vec::new() }.value(&expr)
}

/// Evaluates one expression.
pub(super) struct Interpreter<'h> {
    pub(super) host: &'h mut dyn Host,
    /// Names bound by comprehensions, innermost last.
    locals: Vec<(String, Value)>,
}

impl Interpreter<'_> {
    fn value(&mut self, expr: &Expr) -> Evaluated {
        self.host.charge(1)?;
        match expr {
            Expr::Const(value) => Ok(value.clone()),
            Expr::Name(name) => self.name(name),
            Expr::Not(inner) => Ok(Value::Bool(!self.value(inner)?.truth())),
            Expr::Negative(inner) => negative(&self.value(inner)?),
            Expr::Positive(inner) => {
                let value = self.value(inner)?;
                match (value.as_int(), &value) {
                    (Some(i), _) => Ok(Value::Int(i)),
                    (None, Value::Float(_)) => Ok(value),
                    _ => Err(format!("bad operand type for unary +: '{}'", value.type_name())),
                }
            }
            Expr::Binary(sign, left, right) => {
                let (left, right) = (self.value(left)?, self.value(right)?);
                self.host.charge(set_work(&left, &right))?;
                let value = binary(sign, &left, &right)?;
                self.host.charge(length(&value))?;
                Ok(value)
            }
            Expr::Compare(first, steps) => self.compare(first, steps),
            Expr::And(left, right) => {
                let left = self.value(left)?;
                if left.truth() { self.value(right) } else { Ok(left) }
            }
            Expr::Or(left, right) => {
                let left = self.value(left)?;
                if left.truth() { Ok(left) } else { self.value(right) }
            }
            Expr::If(condition, then, otherwise) => {
                let chosen = if self.value(condition)?.truth() { then } else { otherwise };
                self.value(chosen)
            }
            Expr::Attribute(object, name) => {
                let object = self.value(object)?;
                self.attribute(&object, name)
            }
            Expr::Index(object, index) => {
                let (object, index) = (self.value(object)?, self.value(index)?);
                self.index(&object, &index)
            }
            Expr::Slice(object, parts) => self.slice(object, parts),
            Expr::Call(function, values, named) => self.call(function, values, named),
            Expr::List(items) => Ok(Value::list(self.values(items)?)),
            Expr::Tuple(items) => Ok(Value::Tuple(Rc::new(self.values(items)?))),
            Expr::Dict(entries) => {
                let mut dict = Dict::default();
                for (key, value) in entries {
                    let key = hashable(self.value(key)?)?;
                    dict.insert(key, self.value(value)?);
                }
                Ok(Value::Dict(Rc::new(dict)))
            }
            Expr::Each(item, loops) => {
                let mut out = Vec::new();
                self.each(item, loops, &mut out)?;
                Ok(Value::list(out))
            }
        }
    }

    fn values(&mut self, items: &[Expr]) -> Evaluated<Vec<Value>> {
        items.iter().map(|item| self.value(item)).collect()
    }

    fn name(&mut self, name: &str) -> Evaluated {
        if let Some((_, value)) = self.locals.iter().rev().find(|(local, _)| local == name) {
            return Ok(value.clone());
        }
        self.host.name(name)?.ok_or_else(|| functions::undefined(name))
    }

    fn attribute(&mut self, object: &Value, name: &str) -> Evaluated {
        match object {
            Value::Dict(dict) if dict.dotted => {
                let value = dict.get(&name.into()).cloned();
                value.ok_or_else(|| format!("The yaml dictionary has no key '{name}'"))
            }
            Value::Module(module) => {
                let value = functions::in_module(module, name);
                value.ok_or_else(|| functions::undefined_in(module, name))
            }
            Value::Namespace(scope) => {
                let value = self.host.member(*scope, name)?;
                value.ok_or_else(|| format!("name '{name}' is not defined"))
            }
            other => Err(format!("'{}' object has no attribute '{name}'", other.type_name())),
        }
    }

    fn index(&mut self, object: &Value, index: &Value) -> Evaluated {
        let position = |length: usize| {
            let Some(i) = index.as_int() else {
                let what = format!("indices must be integers or slices, not {}", index.type_name());
                return Err(format!("{} {what}", object.type_name()));
            };
            let from_end = if i < 0 { i + length as i64 } else { i };
            usize::try_from(from_end)
                .ok()
                .filter(|p| *p < length)
                .ok_or_else(|| format!("{} index out of range: {i} of {length}", object.type_name()))
        };
        match object {
            Value::List(items) | Value::Tuple(items) => {
                let place = position(items.len())?;
                items.get(place).cloned().ok_or_else(|| "index out of range".to_owned())
            }
            Value::Str(text) => {
                let place = position(text.chars().count())?;
                Ok(text.chars().nth(place).map(String::from).unwrap_or_default().into())
            }
            Value::Dict(dict) => dict.get(index).cloned().ok_or_else(|| match dict.dotted {
                true => format!("The yaml dictionary has no key '{}'", index.text()),
                false => format!("no key {} in the dictionary", index.repr()),
            }),
            Value::Namespace(scope) => {
                let value = self.host.member(*scope, &index.text())?;
                value.ok_or_else(|| format!("name '{}' is not defined", index.text()))
            }
            other => Err(format!("'{}' object is not subscriptable", other.type_name())),
        }
    }

    fn slice(&mut self, object: &Expr, parts: &[Option<Box<Expr>>; 3]) -> Evaluated {
        let object = self.value(object)?;
        let mut bounds = [None; 3];
        for (bound, part) in bounds.iter_mut().zip(parts) {
            let Some(part) = part else { continue };
            match self.value(part)? {
                Value::None => {}
                value => *bound = Some(value.as_int().ok_or("slice indices must be integers or None")?),
            }
        }
        let [start, stop, step] = bounds;
        match &object {
            Value::Str(text) => {
                let chars: Vec<char> = text.chars().collect();
                let picked: String = sliced(&chars, start, stop, step)?.into_iter().collect();
                Ok(picked.into())
            }
            Value::List(items) => Ok(Value::list(sliced(items, start, stop, step)?)),
            Value::Tuple(items) => Ok(Value::Tuple(Rc::new(sliced(items, start, stop, step)?))),
            other => Err(format!("'{}' object is not subscriptable", other.type_name())),
        }
    }

    fn compare(&mut self, first: &Expr, steps: &[(&'static str, Expr)]) -> Evaluated {
        let mut left = self.value(first)?;
        for (sign, right) in steps {
            let right = self.value(right)?;
            self.host.charge(set_work(&left, &right))?;
            if !compared(sign, &left, &right)? {
                return Ok(Value::Bool(false));
            }
            left = right;
        }
        Ok(Value::Bool(true))
    }

    fn call(&mut self, function: &Expr, values: &[Expr], named: &[(String, Expr)]) -> Evaluated {
        // A method call: a bound method is not a value.
        if let Expr::Attribute(object, name) = function {
            let object = self.value(object)?;
            if !matches!(object, Value::Module(_) | Value::Namespace(_)) {
                let (values, named) = (self.values(values)?, self.named(named)?);
                self.host.charge(values.first().map_or(0, |value| set_work(&object, value)))?;
                let value = methods::call(&object, name, &values, &named)?;
                self.host.charge(length(&value))?;
                return Ok(value);
            }
            let function = self.attribute(&object, name)?;
            let (values, named) = (self.values(values)?, self.named(named)?);
            return self.apply(&function, values, named);
        }
        let function = self.value(function)?;
        let (values, named) = (self.values(values)?, self.named(named)?);
        self.apply(&function, values, named)
    }

    fn named(&mut self, named: &[(String, Expr)]) -> Evaluated<Vec<(String, Value)>> {
        named.iter().map(|(name, value)| Ok((name.clone(), self.value(value)?))).collect()
    }

    /// Calls a function value.
    pub(super) fn apply(&mut self, function: &Value, values: Vec<Value>, named: Vec<(String, Value)>) -> Evaluated {
        let Value::Function(name) = function else {
            return Err(format!("'{}' object is not callable", function.type_name()));
        };
        if let Some(answer) = self.host.call(name, &values) {
            return answer;
        }
        let value = functions::call(self, name, &values, &named)?;
        self.host.charge(length(&value))?;
        Ok(value)
    }

    fn each(&mut self, item: &Expr, loops: &[Loop], out: &mut Vec<Value>) -> Evaluated<()> {
        let Some((first, inner)) = loops.split_first() else {
            let value = self.value(item)?;
            out.push(value);
            return if out.len() > MAX_LENGTH { Err("a list is too long".to_owned()) } else { Ok(()) };
        };
        let source = self.value(&first.source)?;
        for value in items(&source)? {
            let known = self.locals.len();
            match first.names.as_slice() {
                [name] => self.locals.push((name.clone(), value)),
                names => {
                    let parts = items(&value)?;
                    if parts.len() != names.len() {
                        return Err(format!("{} values to unpack, expected {}", parts.len(), names.len()));
                    }
                    self.locals.extend(names.iter().cloned().zip(parts));
                }
            }
            let mut wanted = true;
            for condition in &first.conditions {
                wanted = wanted && self.value(condition)?.truth();
            }
            if wanted {
                self.each(item, inner, out)?;
            }
            self.locals.truncate(known);
        }
        Ok(())
    }
}

/// Returns the elements that a loop visits: items, characters, keys.
pub(super) fn items(value: &Value) -> Evaluated<Vec<Value>> {
    match value {
        Value::List(items) | Value::Tuple(items) | Value::Set(items) => Ok(items.to_vec()),
        Value::Str(text) => Ok(text.chars().map(|c| String::from(c).into()).collect()),
        Value::Dict(dict) => Ok(dict.entries.iter().map(|(key, _)| key.clone()).collect()),
        other => Err(format!("'{}' object is not iterable", other.type_name())),
    }
}

/// Returns the value if it is hashable.
pub(super) fn hashable(value: Value) -> Evaluated {
    match value {
        Value::List(_) | Value::Dict(_) | Value::Set(_) => Err(format!("unhashable type: '{}'", value.type_name())),
        value => Ok(value),
    }
}

/// Returns the work of making this value.
fn length(value: &Value) -> usize {
    match value {
        Value::Str(text) => text.len() / 16,
        Value::List(items) | Value::Tuple(items) | Value::Set(items) => items.len(),
        _ => 0,
    }
}

/// Returns the work of comparing each of one list with each of another.
pub(super) fn pair_work(a: usize, b: usize) -> usize {
    a.saturating_mul(b) / 16
}

/// Returns the work of an operation between a set and something else.
fn set_work(left: &Value, right: &Value) -> usize {
    let sets = matches!(left, Value::Set(_)) || matches!(right, Value::Set(_));
    if sets { pair_work(length(left).max(1), length(right).max(1)) } else { 0 }
}

fn negative(value: &Value) -> Evaluated {
    match (value.as_int(), value) {
        (Some(i), _) => i.checked_neg().map(Value::Int).ok_or_else(too_large),
        (None, Value::Float(f)) => Ok(Value::Float(-f)),
        _ => Err(format!("bad operand type for unary -: '{}'", value.type_name())),
    }
}

fn too_large() -> String {
    "an integer is too large".to_owned()
}

fn sliced<T: Clone>(items: &[T], start: Option<i64>, stop: Option<i64>, step: Option<i64>) -> Evaluated<Vec<T>> {
    let length = items.len() as i64;
    let step = step.unwrap_or(1);
    if step == 0 {
        return Err("slice step cannot be zero".to_owned());
    }
    let (lowest, highest) = if step > 0 { (0, length) } else { (-1, length - 1) };
    let bound = |bound: Option<i64>, otherwise: i64| match bound {
        Some(i) => (if i < 0 { i.saturating_add(length) } else { i }).clamp(lowest, highest),
        None => otherwise,
    };
    let first = bound(start, if step > 0 { lowest } else { highest });
    let last = bound(stop, if step > 0 { highest } else { lowest });
    let mut out = Vec::new();
    let mut i = first;
    while (step > 0 && i < last) || (step < 0 && i > last) {
        out.extend(usize::try_from(i).ok().and_then(|i| items.get(i)).cloned());
        i = i.saturating_add(step);
    }
    Ok(out)
}

fn compared(sign: &str, left: &Value, right: &Value) -> Evaluated<bool> {
    match sign {
        "==" => Ok(left.equals(right)),
        "!=" => Ok(!left.equals(right)),
        "in" => contains(right, left),
        "not in" => contains(right, left).map(|found| !found),
        "is" => Ok(left.type_name() == right.type_name() && left.equals(right)),
        "is not" => Ok(!(left.type_name() == right.type_name() && left.equals(right))),
        _ => {
            let (a, b) = (left.type_name(), right.type_name());
            let refused = || format!("'{sign}' not supported between instances of '{a}' and '{b}'");
            let order = left.compare(right).ok_or_else(refused)?;
            Ok(match sign {
                "<" => order == Some(Ordering::Less),
                "<=" => matches!(order, Some(Ordering::Less | Ordering::Equal)),
                ">" => order == Some(Ordering::Greater),
                _ => matches!(order, Some(Ordering::Greater | Ordering::Equal)),
            })
        }
    }
}

fn contains(container: &Value, item: &Value) -> Evaluated<bool> {
    match (container, item) {
        (Value::Str(text), Value::Str(part)) => Ok(text.contains(&**part)),
        (Value::Str(_), other) => {
            Err(format!("'in <string>' requires string as left operand, not {}", other.type_name()))
        }
        (Value::Dict(dict), key) => Ok(dict.get(key).is_some()),
        (Value::List(items) | Value::Tuple(items) | Value::Set(items), item) => {
            Ok(items.iter().any(|i| i.equals(item)))
        }
        (other, _) => Err(format!("argument of type '{}' is not iterable", other.type_name())),
    }
}

fn binary(sign: &str, left: &Value, right: &Value) -> Evaluated {
    match (sign, left, right) {
        ("+", Value::Str(a), Value::Str(b)) => limited(a.len() + b.len(), || format!("{a}{b}").into()),
        ("+", Value::Str(_), other) => Err(format!("can only concatenate str (not \"{}\") to str", other.type_name())),
        ("+", Value::List(a), Value::List(b)) => limited(a.len() + b.len(), || Value::list([&a[..], &b[..]].concat())),
        ("+", Value::Tuple(a), Value::Tuple(b)) => {
            limited(a.len() + b.len(), || Value::Tuple(Rc::new([&a[..], &b[..]].concat())))
        }
        ("-", Value::Set(a), Value::Set(b)) => methods::selected(a, b, false),
        ("*", Value::Str(text), n) | ("*", n, Value::Str(text)) if n.as_int().is_some() => {
            let n = repeats(n);
            limited(text.len().saturating_mul(n), || text.repeat(n).into())
        }
        ("*", Value::List(items), n) | ("*", n, Value::List(items)) if n.as_int().is_some() => {
            let n = repeats(n);
            limited(items.len().saturating_mul(n), || {
                Value::list(std::iter::repeat_n(&items[..], n).flatten().cloned().collect())
            })
        }
        ("%", Value::Str(format), values) => super::format::percent(format, values).map(Value::from),
        _ => arithmetic(sign, left, right),
    }
}

fn repeats(n: &Value) -> usize {
    n.as_int().map_or(0, |n| usize::try_from(n).unwrap_or(0))
}

fn limited(length: usize, make: impl FnOnce() -> Value) -> Evaluated {
    if length > MAX_LENGTH { Err("a text or list is too long".to_owned()) } else { Ok(make()) }
}

fn arithmetic(sign: &str, left: &Value, right: &Value) -> Evaluated {
    let refused = || {
        let (a, b) = (left.type_name(), right.type_name());
        format!("unsupported operand type(s) for {sign}: '{a}' and '{b}'")
    };
    if let (Some(a), Some(b)) = (left.as_int(), right.as_int()) {
        return integers(sign, a, b);
    }
    let (a, b) = (left.as_float().ok_or_else(refused)?, right.as_float().ok_or_else(refused)?);
    floats(sign, a, b).map(Value::Float)
}

fn integers(sign: &str, a: i64, b: i64) -> Evaluated {
    let whole = |value: Option<i64>| value.map(Value::Int).ok_or_else(too_large);
    match sign {
        "+" => whole(a.checked_add(b)),
        "-" => whole(a.checked_sub(b)),
        "*" => whole(a.checked_mul(b)),
        "/" if b == 0 => Err("division by zero".to_owned()),
        "//" if b == 0 => Err("integer division or modulo by zero".to_owned()),
        "%" if b == 0 => Err("integer modulo by zero".to_owned()),
        "/" => Ok(Value::Float(a as f64 / b as f64)),
        // Rounded down; the remainder has the divisor's sign.
        "//" => whole(a.checked_div(b).map(|q| if (a % b != 0) && ((a < 0) != (b < 0)) { q - 1 } else { q })),
        "%" => whole(a.checked_rem(b).map(|r| if r != 0 && ((r < 0) != (b < 0)) { r + b } else { r })),
        "**" => match u32::try_from(b) {
            Ok(exponent) => whole(a.checked_pow(exponent)),
            Err(_) if b > 0 => Err(too_large()),
            Err(_) => floats(sign, a as f64, b as f64).map(Value::Float),
        },
        other => Err(format!("no operator {other}")),
    }
}

fn floats(sign: &str, a: f64, b: f64) -> Evaluated<f64> {
    match sign {
        "+" => Ok(a + b),
        "-" => Ok(a - b),
        "*" => Ok(a * b),
        "/" if b == 0.0 => Err("float division by zero".to_owned()),
        "//" | "%" if b == 0.0 => Err("float floor division or modulo by zero".to_owned()),
        "/" => Ok(a / b),
        "//" => Ok(((a - floats("%", a, b)?) / b).round()),
        "%" => {
            let rest = a % b;
            let rest = if rest != 0.0 && ((rest < 0.0) != (b < 0.0)) { rest + b } else { rest };
            Ok(if rest == 0.0 { 0.0_f64.copysign(b) } else { rest })
        }
        "**" if a == 0.0 && b < 0.0 => Err("0.0 cannot be raised to a negative power".to_owned()),
        "**" if a < 0.0 && b.fract() != 0.0 => Err("complex numbers are not supported".to_owned()),
        "**" => Ok(a.powf(b)),
        other => Err(format!("no operator {other}")),
    }
}
