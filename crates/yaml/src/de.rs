//! The Deserializer over a [`Tree`]. Applies the omissions and placeholders of the recovery while reading; the tree
//! itself is not modified. Each level adds its node to a passing error.

use std::collections::{HashMap, HashSet};

use serde::de::{Deserializer, Visitor};
use serde::forward_to_deserialize_any;

use crate::access::{Choice, Entries, Items, Placed};
use crate::error::ReadError;
use crate::located::{LOCATED, TEXT};
use crate::scalar::{self, Scalar};
use crate::tree::{Kind, NodeId, Tree};

/// Omissions and placeholders of a read.
#[derive(Debug, Default)]
pub(super) struct Workaround {
    /// Values and list elements to skip.
    pub(super) dropped: HashSet<NodeId>,
    /// Keys to fill with placeholders, by group.
    pub(super) placeholders: HashMap<NodeId, Vec<&'static str>>,
}

/// One node to read.
#[derive(Clone, Copy)]
pub(super) struct De<'a> {
    pub(super) tree: &'a Tree,
    pub(super) workaround: &'a Workaround,
    pub(super) node: NodeId,
    /// Whether it is a key: always text.
    pub(super) key: bool,
}

impl<'a> De<'a> {
    pub(super) fn of(&self, node: NodeId) -> Self {
        Self { node, key: false, ..*self }
    }

    fn kind(&self) -> Result<&'a Kind, ReadError> {
        self.tree.node(self.node).map(|n| &n.kind).ok_or_else(|| ReadError::value("the value does not exist", None))
    }

    fn found(&self) -> String {
        match self.tree.node(self.node).map(|n| &n.kind) {
            Some(Kind::Scalar { text, plain }) => scalar::describe(text, *plain),
            Some(Kind::Seq(_)) => "a list".to_owned(),
            Some(Kind::Map(_)) => "a group of keys".to_owned(),
            None => "nothing".to_owned(),
        }
    }

    fn wrong(&self, expected: &str, hint: Option<String>) -> ReadError {
        ReadError::value(format!("expected {expected}, found {}", self.found()), hint)
    }

    fn scalar(&self) -> Option<(&'a str, bool, Scalar<'a>)> {
        match self.kind() {
            Ok(Kind::Scalar { text, plain }) => Some((text, *plain, scalar::resolve(text, *plain && !self.key))),
            _ => None,
        }
    }

    fn is_null(&self) -> bool {
        matches!(self.scalar(), Some((_, _, Scalar::Null)))
    }

    fn integer(&self, expected: &str) -> Result<i128, ReadError> {
        match self.scalar() {
            Some((_, _, Scalar::Int(value))) => Ok(value),
            Some((_, _, Scalar::Float(value))) if value.fract() == 0.0 && value.abs() < 1e15 => {
                Err(self.wrong(expected, Some(format!("write {value:.0}"))))
            }
            Some((text, plain, _)) => Err(self.wrong(expected, scalar::number_hint(text, plain))),
            None => Err(self.wrong(expected, None)),
        }
    }

    fn float(&self) -> Result<f64, ReadError> {
        let value = match self.scalar() {
            Some((_, _, Scalar::Int(value))) => value as f64,
            Some((_, _, Scalar::Float(value))) => value,
            Some((text, plain, _)) => {
                let hint = match text.trim_start_matches(['-', '+']).to_lowercase().as_str() {
                    "inf" | "infinity" | "nan" => Some("numbers must be finite".to_owned()),
                    _ => scalar::number_hint(text, plain),
                };
                return Err(self.wrong("a number", hint));
            }
            None => return Err(self.wrong("a number", None)),
        };
        self.finite(value)
    }

    fn finite(&self, value: f64) -> Result<f64, ReadError> {
        match value.is_finite() {
            true => Ok(value),
            false => Err(self.wrong("a finite number", Some("infinity and NaN are not accepted anywhere".to_owned()))),
        }
    }

    fn map<V: Visitor<'a>>(self, entries: &'a [(NodeId, NodeId)], visitor: V) -> Result<V::Value, ReadError> {
        visitor.visit_map(Entries::new(self, entries))
    }

    fn seq<V: Visitor<'a>>(self, items: &'a [NodeId], visitor: V) -> Result<V::Value, ReadError> {
        visitor.visit_seq(Items::new(self, items))
    }
}

macro_rules! integers {
    ($($method:ident $type:ty),*) => {$(
        fn $method<V: Visitor<'a>>(self, visitor: V) -> Result<V::Value, ReadError> {
            let expected = if <$type>::MIN == 0 { "a whole number, 0 or more" } else { "a whole number" };
            let value = self.integer(expected)?;
            match i64::try_from(value) {
                _ if <$type>::try_from(value).is_err() && value < 0 && <$type>::MIN == 0 => {
                    Err(self.wrong(expected, None))
                }
                Ok(value) if <$type>::try_from(value).is_ok() => visitor.visit_i64(value),
                _ => match u64::try_from(value) {
                    Ok(value) if <$type>::try_from(value).is_ok() => visitor.visit_u64(value),
                    _ => Err(self.wrong(&format!("a whole number from {} to {}", <$type>::MIN, <$type>::MAX), None)),
                },
            }
        }
    )*};
}

impl<'a> Deserializer<'a> for De<'a> {
    type Error = ReadError;

    integers!(deserialize_i8 i8, deserialize_i16 i16, deserialize_i32 i32, deserialize_i64 i64,
              deserialize_u8 u8, deserialize_u16 u16, deserialize_u32 u32, deserialize_u64 u64);

    fn deserialize_any<V: Visitor<'a>>(self, visitor: V) -> Result<V::Value, ReadError> {
        match self.kind()? {
            Kind::Seq(items) => self.seq(items, visitor),
            Kind::Map(entries) => self.map(entries, visitor),
            Kind::Scalar { text, plain } => match scalar::resolve(text, *plain && !self.key) {
                Scalar::Null => visitor.visit_unit(),
                Scalar::Bool(value) => visitor.visit_bool(value),
                Scalar::Int(value) => match (i64::try_from(value), u64::try_from(value)) {
                    (Ok(value), _) => visitor.visit_i64(value),
                    (_, Ok(value)) => visitor.visit_u64(value),
                    _ => visitor.visit_f64(value as f64),
                },
                Scalar::Float(value) => visitor.visit_f64(self.finite(value)?),
                Scalar::Text(text) => visitor.visit_borrowed_str(text),
            },
        }
    }

    fn deserialize_bool<V: Visitor<'a>>(self, visitor: V) -> Result<V::Value, ReadError> {
        match self.scalar() {
            Some((_, _, Scalar::Bool(value))) => visitor.visit_bool(value),
            Some((text, _, _)) => Err(self.wrong("true or false", scalar::bool_hint(text))),
            None => Err(self.wrong("true or false", None)),
        }
    }

    fn deserialize_f32<V: Visitor<'a>>(self, visitor: V) -> Result<V::Value, ReadError> {
        visitor.visit_f64(self.float()?)
    }

    fn deserialize_f64<V: Visitor<'a>>(self, visitor: V) -> Result<V::Value, ReadError> {
        visitor.visit_f64(self.float()?)
    }

    fn deserialize_str<V: Visitor<'a>>(self, visitor: V) -> Result<V::Value, ReadError> {
        match self.scalar() {
            Some((_, _, Scalar::Text(text))) => visitor.visit_borrowed_str(text),
            Some((_, _, Scalar::Null)) | None => Err(self.wrong("a text", None)),
            Some((text, ..)) => Err(self.wrong("a text", Some(format!("write it in quotes: \"{text}\"")))),
        }
    }

    fn deserialize_string<V: Visitor<'a>>(self, visitor: V) -> Result<V::Value, ReadError> {
        self.deserialize_str(visitor)
    }

    fn deserialize_identifier<V: Visitor<'a>>(self, visitor: V) -> Result<V::Value, ReadError> {
        match self.kind()? {
            Kind::Scalar { text, .. } => visitor.visit_borrowed_str(text),
            _ => Err(self.wrong("a word", None)),
        }
    }

    fn deserialize_option<V: Visitor<'a>>(self, visitor: V) -> Result<V::Value, ReadError> {
        if self.is_null() { visitor.visit_none() } else { visitor.visit_some(self) }
    }

    fn deserialize_newtype_struct<V: Visitor<'a>>(self, name: &'static str, visitor: V) -> Result<V::Value, ReadError> {
        match name {
            LOCATED => visitor.visit_seq(Placed::new(self)),
            TEXT => match self.scalar() {
                Some((_, _, Scalar::Null)) | None => Err(self.wrong("a word, number or boolean", None)),
                Some((text, ..)) => visitor.visit_borrowed_str(text),
            },
            _ => visitor.visit_newtype_struct(self),
        }
    }

    fn deserialize_seq<V: Visitor<'a>>(self, visitor: V) -> Result<V::Value, ReadError> {
        match self.kind()? {
            Kind::Seq(items) => self.seq(items, visitor),
            // An empty `tasks:` is an empty list: its entries may be commented out.
            _ if self.is_null() => self.seq(&[], visitor),
            Kind::Scalar { .. } => Err(self.wrong("a list", None)),
            _ => Err(self.wrong("a list", Some("start each entry with `- `".to_owned()))),
        }
    }

    fn deserialize_tuple<V: Visitor<'a>>(self, len: usize, visitor: V) -> Result<V::Value, ReadError> {
        match self.kind()? {
            Kind::Seq(items) if items.len() == len => self.seq(items, visitor),
            Kind::Seq(items) => {
                let hint = format!("write {len} values in brackets");
                Err(ReadError::value(format!("expected a list of {len} values, found {}", items.len()), Some(hint)))
            }
            _ => Err(self.wrong(&format!("a list of {len} values"), None)),
        }
    }

    fn deserialize_tuple_struct<V: Visitor<'a>>(
        self,
        _name: &'static str,
        len: usize,
        visitor: V,
    ) -> Result<V::Value, ReadError> {
        self.deserialize_tuple(len, visitor)
    }

    fn deserialize_map<V: Visitor<'a>>(self, visitor: V) -> Result<V::Value, ReadError> {
        match self.kind()? {
            Kind::Map(entries) => self.map(entries, visitor),
            _ if self.is_null() => self.map(&[], visitor),
            Kind::Seq(_) => {
                Err(self
                    .wrong("a group of keys", Some("write its keys below it, without dashes or brackets".to_owned())))
            }
            Kind::Scalar { .. } => Err(self.wrong("a group of keys", None)),
        }
    }

    fn deserialize_struct<V: Visitor<'a>>(
        self,
        _name: &'static str,
        _fields: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, ReadError> {
        self.deserialize_map(visitor)
    }

    fn deserialize_enum<V: Visitor<'a>>(
        self,
        _name: &'static str,
        variants: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, ReadError> {
        match self.kind()? {
            Kind::Scalar { .. } if self.is_null() => Err(self.wrong(&format!("one of {}", variants.join(", ")), None)),
            Kind::Scalar { .. } => visitor.visit_enum(Choice::new(self, self.node, None)),
            Kind::Map(entries) => match entries.as_slice() {
                [(word, content)] => visitor.visit_enum(Choice::new(self, *word, Some(*content))),
                _ => Err(ReadError::value(format!("expected one of {}", variants.join(", ")), None)),
            },
            Kind::Seq(_) => Err(self.wrong(&format!("one of {}", variants.join(", ")), None)),
        }
    }

    fn deserialize_ignored_any<V: Visitor<'a>>(self, visitor: V) -> Result<V::Value, ReadError> {
        visitor.visit_unit()
    }

    forward_to_deserialize_any! { <V: Visitor<'a>> i128 u128 char bytes byte_buf unit unit_struct }
}
