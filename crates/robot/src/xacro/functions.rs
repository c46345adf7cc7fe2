//! Built-in functions and constants: the Python built-ins that xacro exposes, and the `math` module.

use std::f64::consts;
use std::rc::Rc;

use super::evaluate::{Evaluated, Interpreter, MAX_LENGTH, hashable, items, pair_work};
use super::value::{Dict, Value, integer};

/// Built-ins of the module `python`.
const PYTHON: &[&str] = &[
    "list",
    "dict",
    "map",
    "len",
    "str",
    "float",
    "int",
    "bool",
    "min",
    "max",
    "round",
    "set",
    "sorted",
    "range",
    "abs",
    "all",
    "any",
    "divmod",
    "isinstance",
    "reversed",
    "sum",
    "tuple",
    "zip",
];
/// Those that an expression may also call without the module name. The original defines no others.
const BUILT_IN: &[&str] =
    &["list", "dict", "map", "len", "str", "float", "int", "bool", "min", "max", "round", "sorted", "range"];
const MATH: &[&str] = &[
    "acos", "asin", "atan", "atan2", "ceil", "copysign", "cos", "degrees", "exp", "fabs", "floor", "fmod", "hypot",
    "isnan", "log", "log10", "pow", "radians", "sin", "sqrt", "tan", "trunc",
];
/// Functions of the module `xacro`; the host implements all but `dotify` and `tokenize`.
const XACRO: &[&str] = &[
    "load_yaml",
    "abs_filename",
    "dotify",
    "arg",
    "message",
    "warning",
    "error",
    "fatal",
    "print_location",
    "tokenize",
];
/// Functions of `xacro` that old files call without the module name.
const BARE: &[&str] = &["load_yaml", "abs_filename", "dotify"];

/// Functions of Python that the original has too, and no known description uses.
const OMITTED: &str = "acosh asinh atanh cbrt comb complex cosh dist enumerate erf erfc exp2 expm1 factorial filter \
    frexp frozenset fsum gamma gcd hash isclose isfinite isinf issubclass isqrt lcm ldexp lgamma log1p log2 modf \
    nextafter ord perm prod remainder repr sinh slice tanh type ulp vars";

/// Says that a global name is unknown, or of a function that is left out, or needs its module's name.
pub(super) fn undefined(name: &str) -> String {
    if PYTHON.contains(&name) {
        return format!("name '{name}' is not defined\nhint: xacro knows it as python.{name}");
    }
    match OMITTED.split_whitespace().any(|omitted| omitted == name) {
        true => format!("the function {name}() of Python is not supported"),
        false => format!("name '{name}' is not defined"),
    }
}

/// Says that a module has no such name, and which it has.
pub(super) fn undefined_in(module: &str, name: &str) -> String {
    let names = match module {
        "python" => PYTHON,
        "xacro" => XACRO,
        _ => MATH,
    };
    format!("{module}.{name} is not supported; the functions of {module} are {}", names.join(", "))
}

/// Returns a global name.
pub(super) fn global(name: &str) -> Option<Value> {
    let module = ["math", "python", "xacro"].into_iter().find(|m| *m == name).map(Value::Module);
    module.or_else(|| find(BUILT_IN, name)).or_else(|| in_module("math", name)).or_else(|| find(BARE, name))
}

/// Returns a name of a module.
pub(super) fn in_module(module: &str, name: &str) -> Option<Value> {
    match module {
        "python" => find(PYTHON, name),
        "xacro" => find(XACRO, name),
        _ => constant(name).map(Value::Float).or_else(|| find(MATH, name)),
    }
}

fn find(names: &'static [&'static str], name: &str) -> Option<Value> {
    names.iter().find(|n| **n == name).map(|n| Value::Function(n))
}

fn constant(name: &str) -> Option<f64> {
    Some(match name {
        "pi" => consts::PI,
        "e" => consts::E,
        "tau" => consts::TAU,
        "inf" => f64::INFINITY,
        "nan" => f64::NAN,
        _ => return None,
    })
}

/// Calls a function.
pub(super) fn call(
    interpreter: &mut Interpreter<'_>,
    name: &'static str,
    values: &[Value],
    named: &[(String, Value)],
) -> Evaluated {
    let option = |key: &str| named.iter().find(|(n, _)| n == key).map(|(_, v)| v);
    if MATH.contains(&name) {
        return math(name, values);
    }
    let one = || values.first().ok_or_else(|| format!("{name}() takes an argument"));
    match (name, values) {
        ("list", []) => Ok(Value::list(Vec::new())),
        ("list", _) => Ok(Value::list(items(one()?)?)),
        ("tuple", []) => Ok(Value::Tuple(Rc::default())),
        ("tuple", _) => Ok(Value::Tuple(Rc::new(items(one()?)?))),
        ("dict", _) => dict(values, named),
        ("set", _) => {
            let list = values.first().map(items).transpose()?.unwrap_or_default();
            interpreter.host.charge(pair_work(list.len(), list.len()))?;
            Value::set(list)
        }
        ("dotify", _) => dotify(one()?),
        ("tokenize", _) => tokenize(one()?, values.get(1).or(option("sep")), values.get(2).or(option("skip_empty"))),
        ("len", _) => Ok(Value::Int(items(one()?)?.len() as i64)),
        ("str", []) => Ok("".into()),
        ("str", _) => Ok(one()?.text().into()),
        ("float", []) => Ok(Value::Float(0.0)),
        ("float", _) => float(one()?),
        ("int", []) => Ok(Value::Int(0)),
        ("int", _) => int(one()?, values.get(1).or(option("base"))),
        ("bool", []) => Ok(Value::Bool(false)),
        ("bool", _) => Ok(Value::Bool(one()?.truth())),
        ("min" | "max", _) => extreme(name, values),
        ("round", _) => round(one()?, values.get(1).or(option("ndigits"))),
        ("abs", _) => match one()? {
            Value::Float(f) => Ok(Value::Float(f.abs())),
            other => other.as_int().and_then(i64::checked_abs).map(Value::Int).ok_or_else(|| wrong(name, other)),
        },
        ("all", _) => Ok(Value::Bool(items(one()?)?.iter().all(Value::truth))),
        ("any", _) => Ok(Value::Bool(items(one()?)?.iter().any(Value::truth))),
        ("sum", _) => {
            let start = values.get(1).cloned().unwrap_or(Value::Int(0));
            items(one()?)?.into_iter().try_fold(start, |sum, item| add(&sum, &item))
        }
        ("sorted", _) => sorted(items(one()?)?, option("reverse").is_some_and(Value::truth)),
        ("reversed", _) => Ok(Value::list(items(one()?)?.into_iter().rev().collect())),
        ("range", _) => range(values),
        ("zip", _) => zip(values),
        ("map", [function, lists @ ..]) => {
            let columns: Vec<Vec<Value>> = lists.iter().map(items).collect::<Evaluated<_>>()?;
            let rows = columns.iter().map(Vec::len).min().unwrap_or(0);
            let row = |i: usize| columns.iter().filter_map(|c| c.get(i).cloned()).collect();
            let mapped = (0..rows).map(|i| interpreter.apply(function, row(i), Vec::new()));
            Ok(Value::list(mapped.collect::<Evaluated<_>>()?))
        }
        ("isinstance", [value, kind]) => {
            let kinds = if let Value::Tuple(kinds) = kind { kinds.to_vec() } else { vec![kind.clone()] };
            let is = |kind: &Value| match kind {
                Value::Function(name) => *name == value.type_name() || (*name == "int" && value.type_name() == "bool"),
                _ => false,
            };
            Ok(Value::Bool(kinds.iter().any(is)))
        }
        ("divmod", [a, b]) => match (a.as_int(), b.as_int()) {
            (Some(a), Some(b)) if b != 0 => {
                let (q, r) = (a.wrapping_div_euclid(b), a.wrapping_rem_euclid(b));
                let (q, r) = if b < 0 && r != 0 { (q - 1, r + b) } else { (q, r) };
                Ok(Value::Tuple(Rc::new(vec![Value::Int(q), Value::Int(r)])))
            }
            _ => Err("divmod() takes two integers, the second not zero".to_owned()),
        },
        _ => Err(format!("{name}() cannot be called with these {} arguments", values.len())),
    }
}

fn wrong(name: &str, value: &Value) -> String {
    format!("{name}() takes a number, not {}", value.type_name())
}

fn add(a: &Value, b: &Value) -> Evaluated {
    match (a.as_int(), b.as_int()) {
        (Some(x), Some(y)) => x.checked_add(y).map(Value::Int).ok_or_else(|| "an integer is too large".to_owned()),
        _ => {
            let sum = a.as_float().zip(b.as_float()).map(|(x, y)| Value::Float(x + y));
            sum.ok_or_else(|| wrong("sum", if a.as_float().is_none() { a } else { b }))
        }
    }
}

fn dict(values: &[Value], named: &[(String, Value)]) -> Evaluated {
    let mut out = Dict::default();
    match values.first() {
        None => {}
        Some(Value::Dict(dict)) => out.entries = dict.entries.clone(),
        Some(list) => {
            for pair in items(list)? {
                let [key, value]: [Value; 2] =
                    items(&pair)?.try_into().map_err(|_| "dict() takes pairs of key and value".to_owned())?;
                out.insert(hashable(key)?, value);
            }
        }
    }
    for (name, value) in named {
        out.insert(name.as_str().into(), value.clone());
    }
    Ok(Value::Dict(Rc::new(out)))
}

/// Converts a dictionary so that its keys, at all levels, are also attributes.
fn dotify(value: &Value) -> Evaluated {
    fn dotted(value: &Value) -> Value {
        match value {
            Value::Dict(dict) => {
                let entries = dict.entries.iter().map(|(k, v)| (k.clone(), dotted(v))).collect();
                Value::Dict(Rc::new(Dict { entries, dotted: true }))
            }
            Value::List(items) => Value::list(items.iter().map(dotted).collect()),
            other => other.clone(),
        }
    }
    match value {
        Value::Dict(_) => Ok(dotted(value)),
        other => Err(format!("dotify() takes a dict, not {}", other.type_name())),
    }
}

fn tokenize(text: &Value, signs: Option<&Value>, skip_empty: Option<&Value>) -> Evaluated {
    let signs = signs.map_or(",; ".to_owned(), Value::text);
    let text = text.text();
    let skip = skip_empty.is_none_or(Value::truth);
    let parts = text.split(|c| signs.contains(c)).filter(|part| !(skip && part.is_empty()));
    Ok(Value::list(parts.map(Value::from).collect()))
}

fn float(value: &Value) -> Evaluated {
    if let Value::Str(text) = value {
        let parsed = text.trim().replace('_', "").parse().ok();
        return parsed.map(Value::Float).ok_or_else(|| format!("could not convert string to float: {}", value.repr()));
    }
    value.as_float().map(Value::Float).ok_or_else(|| wrong("float", value))
}

fn int(value: &Value, base: Option<&Value>) -> Evaluated {
    match value {
        Value::Str(text) => {
            let base = base.and_then(Value::as_int).unwrap_or(10);
            let parsed = match u32::try_from(base) {
                Ok(10) => integer(&text.replace('_', "")),
                Ok(radix @ 2..=36) => i64::from_str_radix(text.trim(), radix).ok(),
                _ => None,
            };
            let refused = || format!("invalid literal for int() with base {base}: {}", value.repr());
            parsed.map(Value::Int).ok_or_else(refused)
        }
        Value::Float(f) if f.abs() < 9e18 => Ok(Value::Int(f.trunc() as i64)),
        Value::Float(f) => Err(format!("cannot convert float {f} to integer")),
        other => other.as_int().map(Value::Int).ok_or_else(|| wrong("int", other)),
    }
}

fn extreme(name: &str, values: &[Value]) -> Evaluated {
    let all = if let [one] = values { items(one)? } else { values.to_vec() };
    let mut all = all.into_iter();
    let mut best = all.next().ok_or_else(|| format!("{name}() arg is an empty sequence"))?;
    for value in all {
        let refused = || format!("{name}() cannot compare '{}' and '{}'", value.type_name(), best.type_name());
        let order = value.compare(&best).ok_or_else(refused)?;
        let better = if name == "min" { std::cmp::Ordering::Less } else { std::cmp::Ordering::Greater };
        if order == Some(better) {
            best = value;
        }
    }
    Ok(best)
}

/// Python rounds halves to even, by the exact value of the number.
fn round(value: &Value, digits: Option<&Value>) -> Evaluated {
    if let (Some(whole), None) = (value.as_int(), digits) {
        return Ok(Value::Int(whole));
    }
    let number = value.as_float().ok_or_else(|| wrong("round", value))?;
    match digits.and_then(Value::as_int) {
        None if number.is_finite() => int(&Value::Float(number.round_ties_even()), None),
        None => Err(format!("cannot convert float {number} to integer")),
        Some(_) if value.as_int().is_some() => Ok(value.clone()),
        Some(digits) if digits >= 0 => {
            let text = format!("{number:.*}", digits.min(300) as usize);
            Ok(Value::Float(text.parse().unwrap_or(number)))
        }
        Some(digits) => {
            let factor = 10f64.powi(i32::try_from(-digits).unwrap_or(400));
            Ok(Value::Float((number / factor).round_ties_even() * factor))
        }
    }
}

fn sorted(mut list: Vec<Value>, reverse: bool) -> Evaluated {
    let mut refused = None;
    list.sort_by(|a, b| match a.compare(b) {
        Some(order) => order.unwrap_or(std::cmp::Ordering::Equal),
        None => {
            refused = Some(format!("sorted() cannot compare '{}' and '{}'", a.type_name(), b.type_name()));
            std::cmp::Ordering::Equal
        }
    });
    if reverse {
        list.reverse();
    }
    refused.map_or(Ok(Value::list(list)), Err)
}

fn range(values: &[Value]) -> Evaluated {
    let numbers: Option<Vec<i64>> = values.iter().map(Value::as_int).collect();
    let (start, stop, step) = match numbers.as_deref() {
        Some([stop]) => (0, *stop, 1),
        Some([start, stop]) => (*start, *stop, 1),
        Some([start, stop, step]) if *step != 0 => (*start, *stop, *step),
        _ => return Err("range() takes one to three integers".to_owned()),
    };
    let mut out = Vec::new();
    let mut i = start;
    while (step > 0 && i < stop) || (step < 0 && i > stop) {
        if out.len() >= MAX_LENGTH {
            return Err("a list is too long".to_owned());
        }
        out.push(Value::Int(i));
        i = i.saturating_add(step);
    }
    Ok(Value::list(out))
}

fn zip(values: &[Value]) -> Evaluated {
    let columns: Vec<Vec<Value>> = values.iter().map(items).collect::<Evaluated<_>>()?;
    let rows = columns.iter().map(Vec::len).min().unwrap_or(0);
    let row = |i: usize| Value::Tuple(Rc::new(columns.iter().filter_map(|c| c.get(i).cloned()).collect()));
    Ok(Value::list((0..rows).map(row).collect()))
}

fn math(name: &str, values: &[Value]) -> Evaluated {
    // Of an integer they are the integer.
    if let ("floor" | "ceil" | "trunc", Some(whole)) = (name, values.first().and_then(Value::as_int)) {
        return Ok(Value::Int(whole));
    }
    let numbers: Vec<f64> = values
        .iter()
        .map(|v| v.as_float().ok_or_else(|| format!("must be real number, not {}", v.type_name())))
        .collect::<Evaluated<_>>()?;
    let domain = |valid: bool, value: f64| if valid { Ok(value) } else { Err("math domain error".to_owned()) };
    let value = match (name, numbers.as_slice()) {
        ("isnan", [x]) => return Ok(Value::Bool(x.is_nan())),
        ("floor", [x]) => return int(&Value::Float(x.floor()), None),
        ("ceil", [x]) => return int(&Value::Float(x.ceil()), None),
        ("trunc", [x]) => return int(&Value::Float(*x), None),
        ("acos", [x]) => domain(x.abs() <= 1.0, x.acos())?,
        ("asin", [x]) => domain(x.abs() <= 1.0, x.asin())?,
        ("atan", [x]) => x.atan(),
        ("atan2", [y, x]) => y.atan2(*x),
        ("copysign", [x, y]) => x.copysign(*y),
        ("cos", [x]) => domain(x.is_finite(), x.cos())?,
        ("sin", [x]) => domain(x.is_finite(), x.sin())?,
        ("tan", [x]) => domain(x.is_finite(), x.tan())?,
        ("degrees", [x]) => x * (180.0 / consts::PI),
        ("radians", [x]) => x * (consts::PI / 180.0),
        ("exp", [x]) => x.exp(),
        ("fabs", [x]) => x.abs(),
        ("fmod", [x, y]) => domain(*y != 0.0, x % y)?,
        ("hypot", [x, y]) => x.hypot(*y),
        ("hypot", many) => many.iter().map(|x| x * x).sum::<f64>().sqrt(),
        ("log", [x]) => domain(*x > 0.0, x.ln())?,
        ("log", [x, base]) => domain(*x > 0.0 && *base > 0.0 && *base != 1.0, x.ln() / base.ln())?,
        ("log10", [x]) => domain(*x > 0.0, x.log10())?,
        ("pow", [x, y]) => domain(!(*x < 0.0 && y.fract() != 0.0 || *x == 0.0 && *y < 0.0), x.powf(*y))?,
        ("sqrt", [x]) => domain(*x >= 0.0, x.sqrt())?,
        _ => return Err(format!("{name}() cannot be called with {} arguments", values.len())),
    };
    Ok(Value::Float(value))
}
