//! Values of expressions, with Python's rules for truth, equality, order and text.

use std::cmp::Ordering;
use std::fmt::Write;
use std::rc::Rc;

/// A value.
#[derive(Debug, Clone)]
pub(super) enum Value {
    None,
    Bool(bool),
    Int(i64),
    Float(f64),
    Str(Rc<str>),
    List(Rc<Vec<Value>>),
    Tuple(Rc<Vec<Value>>),
    /// Different values, in order of insertion.
    Set(Rc<Vec<Value>>),
    Dict(Rc<Dict>),
    /// A built-in function.
    Function(&'static str),
    /// `math`, `python` or `xacro`.
    Module(&'static str),
    /// The definitions of an include with `ns`: a scope.
    Namespace(usize),
}

/// A dictionary, in order of insertion.
#[derive(Debug, Clone, Default)]
pub(super) struct Dict {
    pub(super) entries: Vec<(Value, Value)>,
    /// Whether keys are attributes too.
    pub(super) dotted: bool,
}

impl Dict {
    pub(super) fn get(&self, key: &Value) -> Option<&Value> {
        self.entries.iter().find(|(k, _)| k.equals(key)).map(|(_, v)| v)
    }

    pub(super) fn insert(&mut self, key: Value, value: Value) {
        match self.entries.iter_mut().find(|(k, _)| k.equals(&key)) {
            Some(entry) => entry.1 = value,
            None => self.entries.push((key, value)),
        }
    }
}

impl From<&str> for Value {
    fn from(text: &str) -> Self {
        Self::Str(text.into())
    }
}

impl From<String> for Value {
    fn from(text: String) -> Self {
        Self::Str(text.into())
    }
}

impl Value {
    pub(super) fn list(items: Vec<Self>) -> Self {
        Self::List(Rc::new(items))
    }

    /// A set of the different ones among these; fails if one is not hashable.
    pub(super) fn set(items: Vec<Self>) -> Result<Self, String> {
        let mut set: Vec<Self> = Vec::new();
        for item in items {
            let item = super::evaluate::hashable(item)?;
            if !set.iter().any(|known| known.equals(&item)) {
                set.push(item);
            }
        }
        Ok(Self::Set(Rc::new(set)))
    }

    /// Returns Python's name of its type.
    pub(super) fn type_name(&self) -> &'static str {
        match self {
            Self::None => "NoneType",
            Self::Bool(_) => "bool",
            Self::Int(_) => "int",
            Self::Float(_) => "float",
            Self::Str(_) => "str",
            Self::List(_) => "list",
            Self::Tuple(_) => "tuple",
            Self::Set(_) => "set",
            Self::Dict(_) => "dict",
            Self::Function(_) => "builtin_function_or_method",
            Self::Module(_) | Self::Namespace(_) => "namespace",
        }
    }

    /// Returns its truth value.
    pub(super) fn truth(&self) -> bool {
        match self {
            Self::None => false,
            Self::Bool(b) => *b,
            Self::Int(i) => *i != 0,
            Self::Float(f) => *f != 0.0,
            Self::Str(s) => !s.is_empty(),
            Self::List(v) | Self::Tuple(v) | Self::Set(v) => !v.is_empty(),
            Self::Dict(d) => !d.entries.is_empty(),
            Self::Function(_) | Self::Module(_) | Self::Namespace(_) => true,
        }
    }

    /// Returns it as an integer; booleans count as 0 and 1.
    pub(super) fn as_int(&self) -> Option<i64> {
        match self {
            Self::Bool(b) => Some(i64::from(*b)),
            Self::Int(i) => Some(*i),
            _ => None,
        }
    }

    /// Returns it as a number.
    pub(super) fn as_float(&self) -> Option<f64> {
        match self {
            Self::Float(f) => Some(*f),
            other => other.as_int().map(|i| i as f64),
        }
    }

    /// `==`
    pub(super) fn equals(&self, other: &Self) -> bool {
        let all = |a: &[Self], b: &[Self]| a.len() == b.len() && a.iter().zip(b).all(|(x, y)| x.equals(y));
        match (self, other) {
            (Self::None, Self::None) => true,
            (Self::Str(a), Self::Str(b)) => a == b,
            (Self::List(a), Self::List(b)) | (Self::Tuple(a), Self::Tuple(b)) => all(a, b),
            (Self::Set(a), Self::Set(b)) => a.len() == b.len() && a.iter().all(|x| b.iter().any(|y| x.equals(y))),
            (Self::Dict(a), Self::Dict(b)) => {
                let same = |(k, v): &(Self, Self)| b.get(k).is_some_and(|w| v.equals(w));
                a.entries.len() == b.entries.len() && a.entries.iter().all(same)
            }
            (Self::Function(a), Self::Function(b)) | (Self::Module(a), Self::Module(b)) => a == b,
            (a, b) => match (a.as_int(), b.as_int()) {
                (Some(x), Some(y)) => x == y,
                _ => matches!((a.as_float(), b.as_float()), (Some(x), Some(y)) if x == y),
            },
        }
    }

    /// `<`, `>`: outer `None` if Python raises a TypeError, inner `None` for NaN.
    pub(super) fn compare(&self, other: &Self) -> Option<Option<Ordering>> {
        match (self, other) {
            (Self::Str(a), Self::Str(b)) => Some(Some(a.cmp(b))),
            (Self::List(a), Self::List(b)) | (Self::Tuple(a), Self::Tuple(b)) => {
                let different = a.iter().zip(b.iter()).find(|(x, y)| !x.equals(y));
                match different {
                    Some((x, y)) => x.compare(y),
                    None => Some(Some(a.len().cmp(&b.len()))),
                }
            }
            (a, b) => match (a.as_int(), b.as_int()) {
                (Some(x), Some(y)) => Some(Some(x.cmp(&y))),
                _ => Some(a.as_float()?.partial_cmp(&b.as_float()?)),
            },
        }
    }

    /// `str(x)`
    pub(super) fn text(&self) -> String {
        match self {
            Self::Str(s) => s.to_string(),
            other => other.repr(),
        }
    }

    /// `repr(x)`
    pub(super) fn repr(&self) -> String {
        let mut out = String::new();
        self.write_repr(&mut out);
        out
    }

    fn write_repr(&self, out: &mut String) {
        let items = |items: &[Self], out: &mut String| {
            for (i, item) in items.iter().enumerate() {
                out.push_str(if i > 0 { ", " } else { "" });
                item.write_repr(out);
            }
        };
        match self {
            Self::None => out.push_str("None"),
            Self::Bool(true) => out.push_str("True"),
            Self::Bool(false) => out.push_str("False"),
            Self::Int(i) => {
                let _ = write!(out, "{i}");
            }
            Self::Float(f) => out.push_str(&float_repr(*f)),
            Self::Str(s) => write_quoted(s, out),
            Self::List(v) => {
                out.push('[');
                items(v, out);
                out.push(']');
            }
            Self::Tuple(v) => {
                out.push('(');
                items(v, out);
                out.push_str(if v.len() == 1 { ",)" } else { ")" });
            }
            Self::Set(v) if v.is_empty() => out.push_str("set()"),
            Self::Set(v) => {
                out.push('{');
                items(v, out);
                out.push('}');
            }
            Self::Dict(d) => {
                out.push('{');
                for (i, (key, value)) in d.entries.iter().enumerate() {
                    out.push_str(if i > 0 { ", " } else { "" });
                    key.write_repr(out);
                    out.push_str(": ");
                    value.write_repr(out);
                }
                out.push('}');
            }
            Self::Function(name) => {
                let _ = write!(out, "<built-in function {name}>");
            }
            Self::Module(name) => {
                let _ = write!(out, "<namespace {name}>");
            }
            Self::Namespace(_) => out.push_str("<namespace>"),
        }
    }
}

/// Writes a text in Python's quotes.
fn write_quoted(text: &str, out: &mut String) {
    let quote = if text.contains('\'') && !text.contains('"') { '"' } else { '\'' };
    out.push(quote);
    for c in text.chars() {
        match c {
            '\\' => out.push_str("\\\\"),
            '\n' => out.push_str("\\n"),
            '\t' => out.push_str("\\t"),
            '\r' => out.push_str("\\r"),
            c if c == quote => {
                out.push('\\');
                out.push(c);
            }
            c if (c as u32) < 0x20 || c as u32 == 0x7f => {
                let _ = write!(out, "\\x{:02x}", c as u32);
            }
            c => out.push(c),
        }
    }
    out.push(quote);
}

/// Formats a float as Python does: the shortest text that reads back the same, `.0` on whole numbers, an exponent
/// outside 1e-4 … 1e16.
pub(super) fn float_repr(value: f64) -> String {
    if value.is_nan() {
        return "nan".to_owned();
    }
    if value.is_infinite() {
        return if value > 0.0 { "inf" } else { "-inf" }.to_owned();
    }
    let scientific = format!("{value:e}");
    let (digits, exponent) = scientific.split_once('e').unwrap_or((&scientific, "0"));
    let exponent: i32 = exponent.parse().unwrap_or(0);
    if !(-4..16).contains(&exponent) {
        let sign = if exponent < 0 { '-' } else { '+' };
        return format!("{digits}e{sign}{:02}", exponent.abs());
    }
    let text = format!("{value}");
    if text.contains('.') { text } else { text + ".0" }
}

/// Converts the text of a property or parameter: a quoted text, an integer, a float, a boolean, otherwise the text
/// itself.
pub(super) fn literal(text: &str) -> Value {
    if text.len() >= 2
        && let Some(inside) = text.strip_prefix('\'').and_then(|t| t.strip_suffix('\''))
    {
        return inside.into();
    }
    // Python reads `1_0` as 10; here it is a name.
    if text.contains('_') {
        return text.into();
    }
    if let Some(number) = integer(text) {
        return Value::Int(number);
    }
    if let Ok(number) = text.trim().parse() {
        // An integer beyond our range keeps its digits.
        let digits = text.trim().trim_start_matches(['-', '+']);
        return if digits.bytes().all(|b| b.is_ascii_digit()) { text.into() } else { Value::Float(number) };
    }
    match text {
        "true" | "True" => Value::Bool(true),
        "false" | "False" => Value::Bool(false),
        other => other.into(),
    }
}

/// Python's `int(text)`.
pub(super) fn integer(text: &str) -> Option<i64> {
    let text = text.trim();
    let digits = text.strip_prefix(['-', '+']).unwrap_or(text);
    let plain = !digits.is_empty() && digits.bytes().all(|b| b.is_ascii_digit());
    if plain { text.strip_prefix('+').unwrap_or(text).parse().ok() } else { None }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn floats_print_as_in_python() {
        for (value, text) in [
            (0.1 + 0.2, "0.30000000000000004"),
            (1e-5, "1e-05"),
            (1e20, "1e+20"),
            (2.0, "2.0"),
            (-0.0, "-0.0"),
            (1e16, "1e+16"),
            (123456789012345.0, "123456789012345.0"),
            (0.0001, "0.0001"),
            (1.5e-7, "1.5e-07"),
            (f64::INFINITY, "inf"),
            (5e-324, "5e-324"),
        ] {
            assert_eq!(float_repr(value), text);
        }
    }

    #[test]
    fn texts_become_numbers_by_pythons_rules() {
        for (text, repr) in [
            ("007", "7"),
            ("-3", "-3"),
            ("1.50", "1.5"),
            ("1e3", "1000.0"),
            (" 4 ", "4"),
            ("'12'", "'12'"),
            ("1_0", "'1_0'"),
            ("true", "True"),
            ("False", "False"),
            ("inf", "inf"),
            ("", "''"),
            ("0x10", "'0x10'"),
            ("99999999999999999999", "'99999999999999999999'"),
        ] {
            assert_eq!(literal(text).repr(), repr, "{text}");
        }
    }

    #[test]
    fn containers_print_and_compare_as_in_python() {
        let one = Value::list(vec![Value::Int(1), Value::Float(2.0), "it's".into()]);
        assert_eq!(one.repr(), "[1, 2.0, \"it's\"]");
        assert_eq!(Value::Tuple(Rc::new(vec![Value::None])).repr(), "(None,)");
        assert!(Value::Int(1).equals(&Value::Float(1.0)) && Value::Bool(true).equals(&Value::Int(1)));
        assert!(!Value::from("1").equals(&Value::Int(1)));
        assert_eq!(Value::Int(1).compare(&"a".into()), None);
        assert_eq!(Value::from("a").compare(&"b".into()), Some(Some(Ordering::Less)));
    }
}
