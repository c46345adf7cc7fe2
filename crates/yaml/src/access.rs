//! Access of the Deserializer to lists, groups and choices. Each level adds its node to a passing error.

use serde::de::value::{BorrowedStrDeserializer, U32Deserializer};
use serde::de::{
    DeserializeSeed, Deserializer, EnumAccess, IntoDeserializer, MapAccess, SeqAccess, VariantAccess, Visitor,
};

use crate::de::De;
use crate::error::{ReadError, What};
use crate::placeholder::Placeholder;
use crate::tree::NodeId;

/// Sequence that yields the position, then the value, of a [`Located`].
pub(super) struct Placed<'a> {
    de: De<'a>,
    step: u8,
}

impl<'a> Placed<'a> {
    pub(super) fn new(de: De<'a>) -> Self {
        Self { de, step: 0 }
    }
}

impl<'a> SeqAccess<'a> for Placed<'a> {
    type Error = ReadError;

    fn next_element_seed<T: DeserializeSeed<'a>>(&mut self, seed: T) -> Result<Option<T::Value>, ReadError> {
        self.step += 1;
        match self.step {
            1 => {
                let at: U32Deserializer<ReadError> = self.de.node.into_deserializer();
                seed.deserialize(at).map(Some)
            }
            2 => seed.deserialize(self.de).map(Some),
            _ => Ok(None),
        }
    }
}

/// The elements of a list.
pub(super) struct Items<'a> {
    de: De<'a>,
    items: std::slice::Iter<'a, NodeId>,
}

impl<'a> Items<'a> {
    pub(super) fn new(de: De<'a>, items: &'a [NodeId]) -> Self {
        Self { de, items: items.iter() }
    }
}

impl<'a> SeqAccess<'a> for Items<'a> {
    type Error = ReadError;

    fn next_element_seed<T: DeserializeSeed<'a>>(&mut self, seed: T) -> Result<Option<T::Value>, ReadError> {
        let Some(&item) = self.items.find(|item| !self.de.workaround.dropped.contains(item)) else { return Ok(None) };
        // Errors raised after the Deserializer returned, as by `try_from`, also belong to this element.
        seed.deserialize(self.de.of(item)).map(Some).map_err(|e| e.inside(item))
    }
}

/// The value of the key just read.
enum Next {
    None,
    Value(NodeId),
    Placeholder,
}

/// The entries of a group, then its placeholders.
pub(super) struct Entries<'a> {
    de: De<'a>,
    entries: std::slice::Iter<'a, (NodeId, NodeId)>,
    placeholders: std::slice::Iter<'a, &'static str>,
    next: Next,
}

impl<'a> Entries<'a> {
    pub(super) fn new(de: De<'a>, entries: &'a [(NodeId, NodeId)]) -> Self {
        let placeholders = de.workaround.placeholders.get(&de.node).map_or(&[][..], Vec::as_slice);
        Self { de, entries: entries.iter(), placeholders: placeholders.iter(), next: Next::None }
    }
}

impl<'a> MapAccess<'a> for Entries<'a> {
    type Error = ReadError;

    fn next_key_seed<K: DeserializeSeed<'a>>(&mut self, seed: K) -> Result<Option<K::Value>, ReadError> {
        if let Some(&(key, value)) = self.entries.find(|(_, value)| !self.de.workaround.dropped.contains(value)) {
            self.next = Next::Value(value);
            let de = De { key: true, ..self.de.of(key) };
            return seed.deserialize(de).map(Some).map_err(|e| e.inside(key).inside(value));
        }
        let Some(&name) = self.placeholders.next() else { return Ok(None) };
        self.next = Next::Placeholder;
        seed.deserialize(BorrowedStrDeserializer::<ReadError>::new(name)).map(Some)
    }

    fn next_value_seed<V: DeserializeSeed<'a>>(&mut self, seed: V) -> Result<V::Value, ReadError> {
        match std::mem::replace(&mut self.next, Next::None) {
            Next::Value(value) => seed.deserialize(self.de.of(value)).map_err(|e| e.inside(value)),
            Next::Placeholder => seed.deserialize(Placeholder { node: self.de.node }).map_err(|_| {
                // Ignore its error: the missing key has been reported.
                ReadError::new(What::Placeholder)
            }),
            Next::None => Err(ReadError::value("a value without a key", None)),
        }
    }
}

/// An enum variant, with its content if any.
pub(super) struct Choice<'a> {
    de: De<'a>,
    word: NodeId,
    content: Option<NodeId>,
}

impl<'a> Choice<'a> {
    pub(super) fn new(de: De<'a>, word: NodeId, content: Option<NodeId>) -> Self {
        Self { de, word, content }
    }
}

impl<'a> EnumAccess<'a> for Choice<'a> {
    type Error = ReadError;
    type Variant = Self;

    fn variant_seed<V: DeserializeSeed<'a>>(self, seed: V) -> Result<(V::Value, Self), ReadError> {
        let de = De { key: true, ..self.de.of(self.word) };
        let value = seed.deserialize(de)?;
        Ok((value, self))
    }
}

impl<'a> VariantAccess<'a> for Choice<'a> {
    type Error = ReadError;

    fn unit_variant(self) -> Result<(), ReadError> {
        match self.content {
            None => Ok(()),
            Some(_) => Err(ReadError::value("expected a word without a value", None)),
        }
    }

    fn newtype_variant_seed<T: DeserializeSeed<'a>>(self, seed: T) -> Result<T::Value, ReadError> {
        let content = self.content.ok_or_else(|| ReadError::value("this word needs a value", None))?;
        seed.deserialize(self.de.of(content)).map_err(|e| e.inside(content))
    }

    fn tuple_variant<V: Visitor<'a>>(self, len: usize, visitor: V) -> Result<V::Value, ReadError> {
        let content = self.content.ok_or_else(|| ReadError::value("this word needs a list", None))?;
        self.de.of(content).deserialize_tuple(len, visitor).map_err(|e| e.inside(content))
    }

    fn struct_variant<V: Visitor<'a>>(
        self,
        _fields: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, ReadError> {
        let content = self.content.ok_or_else(|| ReadError::value("this word needs a group", None))?;
        self.de.of(content).deserialize_map(visitor).map_err(|e| e.inside(content))
    }
}
