//! Writes pickles of protocol 4, without a memo: CPython reads them.

/// A value to be pickled.
#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    /// `None`.
    None,
    /// A truth value.
    Bool(bool),
    /// An integer.
    Int(i64),
    /// A number.
    Float(f64),
    /// A string.
    Text(String),
    /// A list.
    List(Vec<Value>),
    /// A tuple.
    Tuple(Vec<Value>),
    /// A dict with strings as keys.
    Dict(Vec<(&'static str, Value)>),
    /// A dict with names as keys.
    Map(Vec<(String, Value)>),
    /// A member of an enumeration: module, class, value.
    Member(&'static str, &'static str, i64),
    /// An object: module, class, state.
    Object(&'static str, &'static str, Box<Value>),
}

impl From<&str> for Value {
    fn from(text: &str) -> Self {
        Self::Text(text.to_owned())
    }
}

impl From<String> for Value {
    fn from(text: String) -> Self {
        Self::Text(text)
    }
}

/// Returns a list of strings.
pub fn texts<T: AsRef<str>>(texts: impl IntoIterator<Item = T>) -> Value {
    Value::List(texts.into_iter().map(|text| text.as_ref().into()).collect())
}

/// Returns the pickle of a value.
pub fn write(value: &Value) -> Vec<u8> {
    // PROTO 4 … STOP
    let mut out = vec![0x80, 4];
    put(&mut out, value);
    out.push(b'.');
    out
}

fn put(out: &mut Vec<u8>, value: &Value) {
    match value {
        Value::None => out.push(b'N'),
        Value::Bool(value) => out.push(if *value { 0x88 } else { 0x89 }),
        Value::Int(value) => match i32::try_from(*value) {
            Ok(value) => {
                out.push(b'J');
                out.extend(value.to_le_bytes());
            }
            Err(_) => {
                // LONG1 with 8 bytes
                out.extend([0x8a, 8]);
                out.extend(value.to_le_bytes());
            }
        },
        Value::Float(value) => {
            out.push(b'G');
            out.extend(value.to_be_bytes());
        }
        Value::Text(text) => put_text(out, text),
        Value::List(values) => {
            out.extend(*b"](");
            values.iter().for_each(|value| put(out, value));
            out.push(b'e');
        }
        Value::Tuple(values) => {
            out.push(b'(');
            values.iter().for_each(|value| put(out, value));
            out.push(b't');
        }
        Value::Dict(entries) => put_dict(out, entries.iter().map(|(key, value)| (*key, value))),
        Value::Map(entries) => put_dict(out, entries.iter().map(|(key, value)| (key.as_str(), value))),
        Value::Member(module, class, value) => {
            put_class(out, module, class);
            put(out, &Value::Tuple(vec![Value::Int(*value)]));
            // REDUCE
            out.push(b'R');
        }
        Value::Object(module, class, state) => {
            put_class(out, module, class);
            // EMPTY_TUPLE NEWOBJ
            out.extend([b')', 0x81]);
            put(out, state);
            // BUILD
            out.push(b'b');
        }
    }
}

fn put_text(out: &mut Vec<u8>, text: &str) {
    out.push(b'X');
    out.extend((text.len() as u32).to_le_bytes());
    out.extend(text.as_bytes());
}

fn put_dict<'v>(out: &mut Vec<u8>, entries: impl Iterator<Item = (&'v str, &'v Value)>) {
    out.extend(*b"}(");
    for (key, value) in entries {
        put_text(out, key);
        put(out, value);
    }
    out.push(b'u');
}

fn put_class(out: &mut Vec<u8>, module: &str, class: &str) {
    put_text(out, module);
    put_text(out, class);
    // STACK_GLOBAL
    out.push(0x93);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_value_has_the_bytes_that_cpython_reads() {
        let value = Value::Tuple(vec![
            texts(["a", "bc"]),
            Value::Dict(vec![("x", Value::Float(1.0)), ("y", Value::None)]),
            Value::Member("m", "C", 3),
            Value::Object("m", "D", Box::new(Value::Int(1 << 40))),
        ]);
        let wanted: &[&[u8]] = &[
            b"\x80\x04(](X\x01\0\0\0aX\x02\0\0\0bce",
            b"}(X\x01\0\0\0xG\x3f\xf0\0\0\0\0\0\0X\x01\0\0\0yNu",
            b"X\x01\0\0\0mX\x01\0\0\0C\x93(J\x03\0\0\0tR",
            b"X\x01\0\0\0mX\x01\0\0\0D\x93)\x81\x8a\x08\0\0\0\0\0\x01\0\0b",
            b"t.",
        ];
        assert_eq!(write(&value), wanted.concat());
    }
}
