//! YAML as xacro's `load_yaml` reads it: version 1.1 by PyYAML's rules (`on` is a boolean, `1e-3` a text), with units
//! (`!degrees 90`).

use std::collections::HashMap;
use std::rc::Rc;

use granit_parser::{Event, Parser, ScalarStyle, Tag};

use super::value::{Dict, Value};

/// Maximum file size [bytes], and maximum number of values after expanding aliases.
pub(super) const MAX_BYTES: u64 = 1 << 20;
const MAX_VALUES: usize = 200_000;
const MAX_DEPTH: usize = 32;

/// Evaluates the expression of a value with a unit.
pub(super) type Number<'a> = dyn FnMut(&str) -> Result<f64, String> + 'a;

/// Reads a document; the error names the line.
pub(super) fn load(text: &str, number: &mut Number<'_>) -> Result<Value, String> {
    let mut options = granit_parser::Options::default();
    options.set_emit_comments(false);
    let mut reader = Reader { open: Vec::new(), anchors: HashMap::new(), root: Value::None, values: 0, number };
    let mut documents = 0;
    for event in Parser::new_from_str_with_options(text, options) {
        let (event, span) = event.map_err(|e| format!("line {}: {}", e.marker().line(), e.info()))?;
        documents += usize::from(matches!(event, Event::DocumentStart(..)));
        if documents > 1 {
            return Err(format!("line {}: a second document", span.start.line()));
        }
        reader.event(event).map_err(|what| format!("line {}: {what}", span.start.line()))?;
    }
    Ok(reader.root)
}

/// A list or dictionary under construction.
struct Open {
    anchor: usize,
    content: Content,
}

enum Content {
    List(Vec<Value>),
    Dict { dict: Dict, key: Option<Value>, merged: Vec<Value> },
}

struct Reader<'a, 'n> {
    open: Vec<Open>,
    anchors: HashMap<usize, Value>,
    root: Value,
    values: usize,
    number: &'a mut Number<'n>,
}

/// Placeholder for the key `<<`.
const MERGE: Value = Value::Function("<<");

impl Reader<'_, '_> {
    fn event(&mut self, event: Event<'_>) -> Result<(), String> {
        match event {
            Event::Scalar(text, style, anchor, tag) => {
                let value = self.scalar(&text, style == ScalarStyle::Plain, tag.as_deref())?;
                self.anchors.insert(anchor, value.clone());
                self.put(value)
            }
            Event::SequenceStart(_, anchor, _) => self.start(anchor, Content::List(Vec::new())),
            Event::MappingStart(_, anchor, _) => {
                let dict = Dict { dotted: true, ..Dict::default() };
                self.start(anchor, Content::Dict { dict, key: None, merged: Vec::new() })
            }
            Event::SequenceEnd | Event::MappingEnd => self.end(),
            Event::Alias(id) => {
                let value = self.anchors.get(&id).cloned().ok_or("an alias of an unfinished value")?;
                self.put(value)
            }
            _ => Ok(()),
        }
    }

    fn start(&mut self, anchor: usize, content: Content) -> Result<(), String> {
        if self.open.len() >= MAX_DEPTH {
            return Err(format!("nested deeper than {MAX_DEPTH}"));
        }
        self.open.push(Open { anchor, content });
        Ok(())
    }

    fn end(&mut self) -> Result<(), String> {
        let Some(open) = self.open.pop() else { return Ok(()) };
        let value = match open.content {
            Content::List(items) => Value::list(items),
            Content::Dict { mut dict, merged, .. } => {
                // Own keys win over merged ones, and earlier merges over later ones.
                for entry in merged.iter().filter_map(|m| if let Value::Dict(d) = m { Some(d) } else { None }) {
                    for (key, value) in &entry.entries {
                        if dict.get(key).is_none() {
                            dict.insert(key.clone(), value.clone());
                        }
                    }
                }
                Value::Dict(Rc::new(dict))
            }
        };
        self.anchors.insert(open.anchor, value.clone());
        self.put(value)
    }

    fn put(&mut self, value: Value) -> Result<(), String> {
        self.values += size(&value);
        if self.values > MAX_VALUES {
            return Err(format!("more than {MAX_VALUES} values"));
        }
        match self.open.last_mut().map(|open| &mut open.content) {
            None => self.root = value,
            Some(Content::List(items)) => items.push(value),
            Some(Content::Dict { dict, key, merged }) => match key.take() {
                None => *key = Some(super::evaluate::hashable(value)?),
                Some(known) if known.equals(&MERGE) => match value {
                    Value::List(all) => merged.extend(all.iter().cloned()),
                    one => merged.push(one),
                },
                Some(known) => dict.insert(known, value),
            },
        }
        Ok(())
    }

    fn scalar(&mut self, text: &str, plain: bool, tag: Option<&Tag>) -> Result<Value, String> {
        let Some(tag) = tag else {
            return Ok(if plain { resolved(text) } else { text.into() });
        };
        if let Some(suffix) = tag.core_suffix() {
            return match (suffix, resolved(text)) {
                ("str", _) => Ok(text.into()),
                ("float", value) => {
                    let number = value.as_float().or_else(|| text.trim().parse().ok());
                    number.map(Value::Float).ok_or_else(|| format!("{text:?} is not a float"))
                }
                (_, value) => Ok(value),
            };
        }
        let factor = match tag.original().as_str() {
            "!radians" | "!meters" => 1.0,
            "!degrees" => std::f64::consts::PI / 180.0,
            "!millimeters" => 0.001,
            "!foot" => 0.3048,
            "!inches" => 0.0254,
            other => return Err(format!("unknown tag {other}")),
        };
        (self.number)(text).map(|value| Value::Float(value * factor))
    }
}

/// Returns the number of values in a value; limits the growth by aliases.
fn size(value: &Value) -> usize {
    match value {
        Value::List(items) => 1 + items.iter().map(size).sum::<usize>(),
        Value::Dict(dict) => 1 + dict.entries.iter().map(|(_, v)| size(v)).sum::<usize>(),
        _ => 1,
    }
}

/// Returns the meaning of a plain scalar in YAML 1.1.
fn resolved(text: &str) -> Value {
    match text {
        "" | "~" | "null" | "Null" | "NULL" => return Value::None,
        "yes" | "Yes" | "YES" | "true" | "True" | "TRUE" | "on" | "On" | "ON" => return Value::Bool(true),
        "no" | "No" | "NO" | "false" | "False" | "FALSE" | "off" | "Off" | "OFF" => return Value::Bool(false),
        ".nan" | ".NaN" | ".NAN" => return Value::Float(f64::NAN),
        "<<" => return MERGE,
        _ => {}
    }
    let (negative, digits) = match text.strip_prefix(['-', '+']) {
        Some(rest) => (text.starts_with('-'), rest),
        None => (false, text),
    };
    if matches!(digits, ".inf" | ".Inf" | ".INF") {
        return Value::Float(if negative { f64::NEG_INFINITY } else { f64::INFINITY });
    }
    let whole = whole(digits).map(|i| Value::Int(if negative { -i } else { i }));
    let float = || fraction(digits).map(|f| Value::Float(if negative { -f } else { f }));
    whole.or_else(float).unwrap_or_else(|| text.into())
}

fn whole(digits: &str) -> Option<i64> {
    let first = digits.bytes().next().filter(u8::is_ascii_digit)?;
    // Rust's parsers accept a sign, which YAML does not allow here: `0-7` is a text.
    if !digits.bytes().all(|b| b.is_ascii_alphanumeric() || matches!(b, b'_' | b':')) {
        return None;
    }
    let plain = digits.replace('_', "");
    if let Some(bits) = plain.strip_prefix("0b") {
        return i64::from_str_radix(bits, 2).ok();
    }
    if let Some(hex) = plain.strip_prefix("0x") {
        return i64::from_str_radix(hex, 16).ok();
    }
    if plain.contains(':') {
        // Sexagesimal: 1:30 is 90.
        let mut parts = plain.split(':');
        let start = parts.next().filter(|_| first != b'0')?.parse().ok()?;
        return parts.try_fold(start, |sum: i64, part| {
            let value: i64 = part.parse().ok().filter(|v| *v < 60 && part.len() <= 2)?;
            sum.checked_mul(60)?.checked_add(value)
        });
    }
    match plain.strip_prefix('0') {
        Some("") => Some(0),
        Some(octal) => i64::from_str_radix(octal, 8).ok(),
        None => plain.parse().ok(),
    }
}

/// A float has a point, and its exponent a sign.
fn fraction(digits: &str) -> Option<f64> {
    let (mantissa, exponent) = match digits.split_once(['e', 'E']) {
        Some((mantissa, exponent)) => (mantissa, Some(exponent)),
        None => (digits, None),
    };
    let (before, after) = mantissa.split_once('.')?;
    let all = |part: &str| part.bytes().all(|b| b.is_ascii_digit() || b == b'_');
    let starts = before.bytes().next().or(after.bytes().next()).is_some_and(|b| b.is_ascii_digit());
    let signed = exponent.is_none_or(|e| {
        e.strip_prefix(['+', '-']).is_some_and(|d| !d.is_empty() && d.bytes().all(|b| b.is_ascii_digit()))
    });
    (all(before) && all(after) && starts && signed).then(|| digits.replace('_', "").parse().ok()).flatten()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<String, String> {
        load(text, &mut |text| text.trim().parse().map_err(|_| "no number".to_owned())).map(|v| v.repr())
    }

    #[test]
    fn words_mean_what_pyyaml_says() {
        for (word, repr) in [
            ("on", "True"),
            ("No", "False"),
            ("'on'", "'on'"),
            ("1e-3", "'1e-3'"),
            ("1.0e-3", "0.001"),
            ("1.5e3", "'1.5e3'"),
            ("010", "8"),
            ("0x1F", "31"),
            ("1_000", "1000"),
            ("-5", "-5"),
            ("+.5", "0.5"),
            ("5.", "5.0"),
            ("~", "None"),
            ("1:30", "90"),
            ("-.inf", "-inf"),
            ("a b", "'a b'"),
            ("1.2.3", "'1.2.3'"),
            ("0o7", "'0o7'"),
            ("0-7", "'0-7'"),
            ("1:+5", "'1:+5'"),
            ("-0x-8000000000000000", "'-0x-8000000000000000'"),
            ("!!str 5", "'5'"),
            ("!!float 5", "5.0"),
            ("!degrees 180", "3.141592653589793"),
            ("!millimeters 250", "0.25"),
            ("!inches 1", "0.0254"),
            ("y", "'y'"),
        ] {
            assert_eq!(read(word).as_deref(), Ok(repr), "{word}");
        }
    }

    #[test]
    fn documents_are_read_whole() {
        let text = "a: &x {p: 1, q: 2}\nb: {<<: *x, q: 3}\nc: [*x, on, '']\non: no\n";
        let expected = "{'a': {'p': 1, 'q': 2}, 'b': {'q': 3, 'p': 1}, 'c': [{'p': 1, 'q': 2}, True, ''], True: False}";
        assert_eq!(read(text).as_deref(), Ok(expected));
        assert_eq!(read("").as_deref(), Ok("None"));
        for wrong in ["a: [1", "a: *b", "a: !what 1", "[[1]]: 2", "a: 1\n---\nb: 2", "a: !degrees x"] {
            assert!(read(wrong).unwrap_err().starts_with("line "), "{wrong}: {:?}", read(wrong));
        }
        let mut bomb = "a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1]\n".to_owned();
        for i in 1..12 {
            let before = format!("*a{}", i - 1);
            bomb += &format!("a{i}: &a{i} [{}]\n", [before.as_str(); 8].join(", "));
        }
        assert!(read(&bomb).unwrap_err().contains("more than"));
        assert!(read(&"[".repeat(10_000)).is_err());
    }
}
