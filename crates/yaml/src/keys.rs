//! The keys that a type reads.

use serde::de::{Deserialize, Deserializer, Visitor};

type Keys = &'static [&'static str];

/// The keys of a type in the order of its fields, which its JSON Schema does not keep; none for what is no struct.
pub fn keys<T: Deserialize<'static>>() -> Keys {
    match T::deserialize(AskKeys) {
        Err(Asked(keys)) => keys,
        Ok(_) => &[],
    }
}

/// A deserializer that fails with the keys of the struct that is read from it.
struct AskKeys;

#[derive(Debug)]
struct Asked(Keys);

impl std::fmt::Display for Asked {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:?}", self.0)
    }
}

impl std::error::Error for Asked {}

impl serde::de::Error for Asked {
    fn custom<T: std::fmt::Display>(_: T) -> Self {
        Self(&[])
    }
}

impl Deserializer<'static> for AskKeys {
    type Error = Asked;

    fn deserialize_any<V: Visitor<'static>>(self, _visitor: V) -> Result<V::Value, Asked> {
        Err(Asked(&[]))
    }

    fn deserialize_struct<V: Visitor<'static>>(
        self,
        _name: &'static str,
        fields: Keys,
        _visitor: V,
    ) -> Result<V::Value, Asked> {
        Err(Asked(fields))
    }

    serde::forward_to_deserialize_any! {
        <V: Visitor<'static>>
        bool i8 i16 i32 i64 i128 u8 u16 u32 u64 u128 f32 f64 char str string bytes byte_buf option unit unit_struct
        newtype_struct seq tuple tuple_struct map enum identifier ignored_any
    }
}
