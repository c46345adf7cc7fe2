//! Methods of texts, lists and dictionaries that do not modify their object.

use std::rc::Rc;

use super::evaluate::{Evaluated, MAX_LENGTH, items};
use super::value::{Dict, Value};

/// Calls a method.
pub(super) fn call(object: &Value, name: &str, values: &[Value], named: &[(String, Value)]) -> Evaluated {
    let missing = || format!("'{}' object has no attribute '{name}' that is supported", object.type_name());
    match object {
        Value::Str(text) => of_text(text, name, values, named).unwrap_or_else(|| Err(missing())),
        Value::Set(set) => of_set(set, name, values).unwrap_or_else(|| Err(missing())),
        Value::Dict(dict) => of_dict(dict, name, values).unwrap_or_else(|| Err(missing())),
        _ => Err(missing()),
    }
}

fn text_at<'v>(values: &'v [Value], at: usize, name: &str) -> Evaluated<&'v str> {
    match values.get(at) {
        Some(Value::Str(text)) => Ok(text),
        Some(other) => Err(format!("{name}() takes a str, not {}", other.type_name())),
        None => Err(format!("{name}() takes more arguments")),
    }
}

fn of_text(text: &str, name: &str, values: &[Value], named: &[(String, Value)]) -> Option<Evaluated> {
    let chars = |byte: usize| text[..byte].chars().count() as i64;
    // `startswith` and `endswith` accept a tuple.
    let any = |test: &dyn Fn(&str) -> bool| match values.first() {
        Some(Value::Tuple(ends)) => Ok(Value::Bool(ends.iter().any(|end| matches!(end, Value::Str(e) if test(e))))),
        _ => text_at(values, 0, name).map(|end| Value::Bool(test(end))),
    };
    Some(match name {
        "upper" => Ok(text.to_uppercase().into()),
        "lower" => Ok(text.to_lowercase().into()),
        "title" => {
            let mut start = true;
            let cased = text.chars().flat_map(|c| {
                let cased = if start { c.to_uppercase().collect::<String>() } else { c.to_lowercase().collect() };
                start = !c.is_alphabetic();
                cased.chars().collect::<Vec<_>>()
            });
            Ok(cased.collect::<String>().into())
        }
        "strip" => Ok(match values.first() {
            Some(Value::Str(chars)) => text.trim_matches(|c| chars.contains(c)),
            _ => text.trim(),
        }
        .into()),
        "startswith" => any(&|end| text.starts_with(end)),
        "endswith" => any(&|end| text.ends_with(end)),
        "find" => text_at(values, 0, name).map(|part| Value::Int(text.find(part).map_or(-1, chars))),
        "isalpha" => Ok(Value::Bool(!text.is_empty() && text.chars().all(char::is_alphabetic))),
        "zfill" => {
            let width = values.first().and_then(Value::as_int).unwrap_or(0).clamp(0, 1000) as usize;
            let sign = usize::from(text.starts_with(['-', '+']));
            let (sign, digits) = text.split_at(sign);
            let zeros = "0".repeat(width.saturating_sub(text.chars().count()));
            Ok(format!("{sign}{zeros}{digits}").into())
        }
        "replace" => replaced(text, values),
        "join" => values.first().ok_or_else(|| "join() takes a list".to_owned()).and_then(|list| joined(text, list)),
        "split" | "rsplit" => split(text, name, values, named),
        "partition" => text_at(values, 0, name).map(|sign| {
            let (a, s, b) = text.split_once(sign).map_or((text, "", ""), |(a, b)| (a, sign, b));
            Value::Tuple(Rc::new(vec![a.into(), s.into(), b.into()]))
        }),
        _ => return None,
    })
}

fn replaced(text: &str, values: &[Value]) -> Evaluated {
    let (from, to) = (text_at(values, 0, "replace")?, text_at(values, 1, "replace")?);
    if text.len().saturating_add(text.matches(from).count().saturating_mul(to.len())) > MAX_LENGTH {
        return Err("a text is too long".to_owned());
    }
    Ok(match values.get(2).and_then(Value::as_int) {
        Some(times) if times >= 0 => text.replacen(from, to, times as usize).into(),
        _ => text.replace(from, to).into(),
    })
}

fn joined(sign: &str, list: &Value) -> Evaluated {
    let mut out = String::new();
    for (i, item) in items(list)?.iter().enumerate() {
        let Value::Str(text) = item else {
            return Err(format!("sequence item {i}: expected str instance, {} found", item.type_name()));
        };
        if i > 0 {
            out.push_str(sign);
        }
        out.push_str(text);
        if out.len() > MAX_LENGTH {
            return Err("a text is too long".to_owned());
        }
    }
    Ok(out.into())
}

fn split(text: &str, name: &str, values: &[Value], named: &[(String, Value)]) -> Evaluated {
    let given = |at: usize, key: &str| values.get(at).or_else(|| named.iter().find(|(n, _)| n == key).map(|(_, v)| v));
    let most = given(1, "maxsplit").and_then(Value::as_int).filter(|n| *n >= 0).map(|n| n as usize);
    let parts: Vec<&str> = match given(0, "sep") {
        None | Some(Value::None) => match most {
            None => text.split_whitespace().collect(),
            Some(most) => {
                let mut parts = Vec::new();
                let mut rest = text.trim();
                while parts.len() < most && !rest.is_empty() {
                    let (first, after) = rest.split_once(char::is_whitespace).unwrap_or((rest, ""));
                    parts.push(first);
                    rest = after.trim_start();
                }
                parts.extend(Some(rest).filter(|r| !r.is_empty()));
                parts
            }
        },
        Some(Value::Str(sign)) if sign.is_empty() => return Err("empty separator".to_owned()),
        Some(Value::Str(sign)) => match (most, name) {
            (None, _) => text.split(&**sign).collect(),
            (Some(most), "rsplit") => {
                let mut parts: Vec<&str> = text.rsplitn(most + 1, &**sign).collect();
                parts.reverse();
                parts
            }
            (Some(most), _) => text.splitn(most + 1, &**sign).collect(),
        },
        Some(other) => return Err(format!("{name}() takes a str, not {}", other.type_name())),
    };
    Ok(Value::list(parts.into_iter().map(Value::from).collect()))
}

fn of_dict(dict: &Dict, name: &str, values: &[Value]) -> Option<Evaluated> {
    let entries = || dict.entries.iter().cloned();
    Some(match name {
        "keys" => Ok(Value::list(entries().map(|(k, _)| k).collect())),
        "values" => Ok(Value::list(entries().map(|(_, v)| v).collect())),
        "items" => Ok(Value::list(entries().map(|(k, v)| Value::Tuple(Rc::new(vec![k, v]))).collect())),
        "get" => match values.first() {
            Some(key) => Ok(dict.get(key).or(values.get(1)).cloned().unwrap_or(Value::None)),
            None => Err("get() takes a key".to_owned()),
        },
        _ => return None,
    })
}

fn of_set(set: &[Value], name: &str, values: &[Value]) -> Option<Evaluated> {
    let other = || Ok::<_, String>(values.first().map(items).transpose()?.unwrap_or_default());
    Some(match name {
        "union" => other().and_then(|other| Value::set([set, &other[..]].concat())),
        "intersection" => other().and_then(|other| selected(set, &other, true)),
        "difference" => other().and_then(|other| selected(set, &other, false)),
        "issubset" => other().map(|other| Value::Bool(set.iter().all(|item| other.iter().any(|o| o.equals(item))))),
        _ => return None,
    })
}

/// The elements of a set that are in another one, or are not.
pub(super) fn selected(set: &[Value], other: &[Value], inside: bool) -> Evaluated {
    let wanted = |item: &&Value| other.iter().any(|o| o.equals(item)) == inside;
    Value::set(set.iter().filter(wanted).cloned().collect())
}
