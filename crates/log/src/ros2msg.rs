//! Decodes any message of a log by the schema in the log: definitions in the `ros2msg` encoding, messages in CDR.

use std::fmt::Write;

use super::cdr::{CdrError, Decoder};

/// Maximum number of types and of fields in a schema, and maximum depth of a message.
const MAX_TYPES: usize = 200;
const MAX_FIELDS: usize = 1000;
const MAX_DEPTH: usize = 16;

/// The types of a message: its own first, then those that it depends on.
#[derive(Debug, Clone, PartialEq)]
pub struct Schema(Vec<Vec<Field>>);

#[derive(Debug, Clone, PartialEq)]
struct Field {
    name: String,
    kind: Kind,
    many: Many,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Kind {
    Bool,
    /// An integer of this many bytes, signed or not.
    Integer(u8, bool),
    Float,
    Double,
    Text,
    /// Index of the type.
    Message(usize),
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Many {
    One,
    Fixed(usize),
    Sequence,
}

impl Schema {
    /// Reads the definition of a type (`pkg/msg/Type`). The error says which line is not understood.
    pub fn parse(name: &str, text: &str) -> Result<Self, String> {
        let mut sections: Vec<(String, Vec<&str>)> = vec![(short(name), Vec::new())];
        for line in text.lines() {
            let line = line.trim();
            match line.strip_prefix("MSG:") {
                Some(own) => sections.push((short(own.trim()), Vec::new())),
                None if line.starts_with("===") => {}
                None => sections.last_mut().into_iter().for_each(|(_, lines)| lines.push(line)),
            }
        }
        if sections.len() > MAX_TYPES || text.lines().count() > MAX_FIELDS {
            return Err("the schema is too long".to_owned());
        }
        let names: Vec<String> = sections.iter().map(|(name, _)| name.clone()).collect();
        let types = sections.iter().map(|(own, lines)| {
            let fields = lines.iter().filter_map(|line| field(own, line, &names).transpose());
            fields.collect::<Result<Vec<_>, _>>()
        });
        types.collect::<Result<_, _>>().map(Self)
    }

    /// Appends a message as JSON; numbers that are not finite become `null`.
    pub fn json(&self, bytes: &[u8], out: &mut String) -> Result<(), CdrError> {
        let mut from = Decoder::new(bytes)?;
        // Fields without bytes must not multiply.
        let mut budget = 1024 + 16 * bytes.len();
        self.message(0, &mut from, out, 0, &mut budget)
    }

    fn message(
        &self,
        index: usize,
        from: &mut Decoder<'_>,
        out: &mut String,
        depth: usize,
        budget: &mut usize,
    ) -> Result<(), CdrError> {
        out.push('{');
        let fields = self.0.get(index).filter(|_| depth < MAX_DEPTH).ok_or(CdrError::Header)?;
        if fields.is_empty() {
            // A structure without members has one unused byte.
            from.number::<1>()?;
        }
        for (at, field) in fields.iter().enumerate() {
            let _ = write!(out, "{}\"{}\":", if at > 0 { "," } else { "" }, field.name);
            let count = match field.many {
                Many::One => {
                    self.value(field.kind, from, out, depth, budget)?;
                    continue;
                }
                Many::Fixed(count) => count,
                Many::Sequence => from.length(1)?,
            };
            out.push('[');
            for element in 0..count {
                if element > 0 {
                    out.push(',');
                }
                self.value(field.kind, from, out, depth, budget)?;
            }
            out.push(']');
        }
        out.push('}');
        Ok(())
    }

    fn value(
        &self,
        kind: Kind,
        from: &mut Decoder<'_>,
        out: &mut String,
        depth: usize,
        budget: &mut usize,
    ) -> Result<(), CdrError> {
        *budget = budget.checked_sub(1).ok_or(CdrError::Header)?;
        let mut number = |value: f64| {
            let _ = if value.is_finite() { write!(out, "{value:?}") } else { write!(out, "null") };
        };
        match kind {
            Kind::Double => number(f64::from_le_bytes(from.number()?)),
            Kind::Float => number(f32::from_le_bytes(from.number()?).into()),
            Kind::Bool => out.push_str(if from.number()? == [0] { "false" } else { "true" }),
            Kind::Integer(size, signed) => {
                let value = match (size, signed) {
                    (1, false) => u8::from_le_bytes(from.number()?).into(),
                    (1, true) => i8::from_le_bytes(from.number()?).into(),
                    (2, false) => u16::from_le_bytes(from.number()?).into(),
                    (2, true) => i16::from_le_bytes(from.number()?).into(),
                    (4, false) => u32::from_le_bytes(from.number()?).into(),
                    (4, true) => i32::from_le_bytes(from.number()?).into(),
                    (_, false) => u64::from_le_bytes(from.number()?).into(),
                    (_, true) => i128::from(i64::from_le_bytes(from.number()?)),
                };
                let _ = write!(out, "{value}");
            }
            // A string always encodes.
            Kind::Text => out.push_str(&serde_json::to_string(from.text()?).unwrap_or_default()),
            Kind::Message(index) => self.message(index, from, out, depth + 1, budget)?,
        }
        Ok(())
    }
}

/// Returns a type's name without the `msg` in its middle.
fn short(name: &str) -> String {
    name.replace("/msg/", "/")
}

/// Reads a line; `None` if it has no field: a comment, a constant.
fn field(own: &str, line: &str, names: &[String]) -> Result<Option<Field>, String> {
    let mut words = line.split('#').next().unwrap_or_default().split_whitespace();
    let Some(kind) = words.next() else { return Ok(None) };
    let name = words.next().ok_or_else(|| format!("{line:?} has no name"))?;
    if name.contains('=') || words.next().is_some_and(|word| word.starts_with('=')) {
        return Ok(None);
    }
    if !name.chars().all(|c| c.is_ascii_alphanumeric() || c == '_') {
        return Err(format!("{name:?} is no name of a field"));
    }
    let wrong = || format!("the type of {line:?} is unknown");
    let (kind, many) = match kind.strip_suffix(']').and_then(|kind| kind.split_once('[')) {
        None => (kind, Many::One),
        Some((kind, "")) => (kind, Many::Sequence),
        Some((kind, count)) if count.starts_with("<=") => (kind, Many::Sequence),
        Some((kind, count)) => (kind, Many::Fixed(count.parse().map_err(|_| wrong())?)),
    };
    let kind = match kind.split("<=").next().unwrap_or_default() {
        "bool" => Kind::Bool,
        "byte" | "uint8" => Kind::Integer(1, false),
        "char" => Kind::Integer(1, false),
        "int8" => Kind::Integer(1, true),
        "uint16" => Kind::Integer(2, false),
        "int16" => Kind::Integer(2, true),
        "uint32" => Kind::Integer(4, false),
        "int32" => Kind::Integer(4, true),
        "uint64" => Kind::Integer(8, false),
        "int64" => Kind::Integer(8, true),
        "float32" => Kind::Float,
        "float64" => Kind::Double,
        "string" => Kind::Text,
        other => {
            let package = own.split('/').next().unwrap_or_default();
            let full = match other {
                "Header" => "std_msgs/Header".to_owned(),
                _ if other.contains('/') => short(other),
                _ => format!("{package}/{other}"),
            };
            Kind::Message(names.iter().position(|name| *name == full).ok_or_else(wrong)?)
        }
    };
    Ok(Some(Field { name: name.to_owned(), kind, many }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cdr::Encoder;
    use crate::display_messages::{Marker, MarkerArray};
    use crate::messages::{JointState, Point};
    use crate::wire::Message;

    fn json<M: Message>(message: &M) -> serde_json::Value {
        let mut bytes = Encoder::default();
        message.put(&mut bytes);
        let mut text = String::new();
        Schema::parse(M::SCHEMA, &M::schema_text()).unwrap().json(bytes.bytes(), &mut text).unwrap();
        serde_json::from_str(&text).unwrap()
    }

    #[test]
    fn a_message_decoded_by_its_schema_is_the_same_as_by_its_type() {
        let joints = JointState {
            name: vec!["a\"b".into(), "ä".into()],
            position: vec![0.1 + 0.2, -0.0, f64::NAN, 1e-310, 1e300],
            ..JointState::default()
        };
        let points = vec![Point { x: 1.0, y: 2.0, z: 3.0 }; 3];
        let marker = Marker { r#type: 4, frame_locked: true, points, text: "x".into(), ..Marker::default() };
        assert_eq!(json(&joints), serde_json::to_value(&joints).unwrap());
        let array = MarkerArray { markers: vec![marker; 2] };
        assert_eq!(json(&array), serde_json::to_value(&array).unwrap());
    }

    #[test]
    fn definitions_of_ros_are_understood() {
        let text = "# comment\nint8 X=1\nstring NAME = 'a#b'\nuint16[2] pair\nstring<=10[<=3] names\nInner inner 5\n\
                    char c 7\nint64 big\nEmpty nothing\n====\nMSG: pkg/Inner\nfloat32 f 0.5\n===\nMSG: pkg/Empty\n";
        let schema = Schema::parse("pkg/msg/Outer", text).unwrap();
        let mut out = Encoder::default();
        out.number(3u16.to_le_bytes());
        out.number(4u16.to_le_bytes());
        out.length(1);
        out.text("one");
        out.number(0.5f32.to_le_bytes());
        out.number([7]);
        out.number((-9i64).to_le_bytes());
        out.number([0]);
        let mut text = String::new();
        schema.json(out.bytes(), &mut text).unwrap();
        let expected = r#"{"pair":[3,4],"names":["one"],"inner":{"f":0.5},"c":7,"big":-9,"nothing":{}}"#;
        assert_eq!(text, expected);
    }

    #[test]
    fn hostile_schemas_and_messages_are_refused() {
        assert!(Schema::parse("a/B", "c/D d").is_err());
        assert!(Schema::parse("a/B", "float64[x] d").is_err());
        assert!(Schema::parse("a/B", "float64").is_err());
        let mut text = String::new();
        let endless = Schema::parse("a/B", "B b").unwrap();
        assert!(endless.json(&[0, 1, 0, 0, 0], &mut text).is_err());
        let huge = Schema::parse("a/B", "C[1000000000] c\n===\nMSG: a/C\nE[0] e\n===\nMSG: a/E\n").unwrap();
        assert!(huge.json(&[0, 1, 0, 0, 0], &mut text).is_err());
        let long = Schema::parse("a/B", "float64[] d").unwrap();
        assert!(long.json(&[0, 1, 0, 0, 255, 255, 255, 255], &mut text).is_err());
    }
}
