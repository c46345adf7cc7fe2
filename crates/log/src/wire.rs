//! Rust types as fields of ROS 2 messages. [`message!`](crate::wire::message) declares a message once:
//! struct, schema text, encoder and decoder all follow from one list of fields.

use serde::Serialize;

use super::cdr::{CdrError, Decoder, Encoder};

/// Definitions that a message depends on: name (`pkg/Type`) and text.
pub type Definitions = Vec<(&'static str, String)>;

/// A type that can be a field of a message.
pub trait Field: Sized {
    /// Its type in a message definition, e.g. `float64[]`.
    const ROS: &'static str;
    /// Minimum size [bytes], to bound the length that a sequence may claim.
    const MIN_SIZE: usize;
    /// Encodes it.
    fn put(&self, out: &mut Encoder);
    /// Decodes it.
    fn get(from: &mut Decoder<'_>) -> Result<Self, CdrError>;
    /// Adds the definitions it needs, its own included, each once.
    fn define(_known: &mut Definitions) {}
}

/// A named message type.
pub trait Message: Field + Serialize {
    /// Schema name, e.g. `sensor_msgs/msg/JointState`.
    const SCHEMA: &'static str;
    /// Returns its fields, one per line.
    fn fields() -> String;
    /// Decodes its first `count` fields; the others have their defaults.
    fn get_first(from: &mut Decoder<'_>, count: usize) -> Result<Self, CdrError>;

    /// Returns the schema text: its fields, then the definitions they need, in the format of the `ros2msg` encoding.
    fn schema_text() -> String {
        let mut known = Definitions::new();
        Self::define(&mut known);
        let mut text = Self::fields();
        for (name, fields) in known.iter().filter(|(name, _)| *name != Self::ROS) {
            text.push_str(&format!("{}\nMSG: {name}\n{fields}", "=".repeat(80)));
        }
        text
    }

    /// Decodes a message.
    fn decode(bytes: &[u8]) -> Result<Self, CdrError> {
        Self::get(&mut Decoder::new(bytes)?)
    }

    /// Decodes a message of which only the first `count` fields were written.
    fn decode_first(bytes: &[u8], count: usize) -> Result<Self, CdrError> {
        Self::get_first(&mut Decoder::new(bytes)?, count)
    }

    /// Returns how many fields messages of the schema `text` share with this type. Versions only append fields: `None`
    /// if the schema differs in any other way.
    fn shared_fields(text: &str) -> Option<usize> {
        let lines = |text: &str| {
            let own = text.lines().take_while(|line| !line.starts_with('=')).map(str::trim);
            own.filter(|line| !line.is_empty() && !line.starts_with('#')).map(str::to_owned).collect::<Vec<_>>()
        };
        let (theirs, ours) = (lines(text), lines(&Self::fields()));
        let same = theirs.iter().zip(&ours).all(|(a, b)| a == b);
        same.then_some(theirs.len().min(ours.len()))
    }
}

macro_rules! numbers {
    ($($rust:ty => $ros:literal, $list:literal;)*) => {$(
        impl Field for $rust {
            const ROS: &'static str = $ros;
            const MIN_SIZE: usize = size_of::<$rust>();
            fn put(&self, out: &mut Encoder) {
                out.number(self.to_le_bytes());
            }
            fn get(from: &mut Decoder<'_>) -> Result<Self, CdrError> {
                Ok(<$rust>::from_le_bytes(from.number()?))
            }
        }
        sequences!($rust => $list;);
    )*};
}

/// Lists of types of fields: the type in Rust, the list in a message definition.
macro_rules! sequences {
    ($($rust:ty => $list:literal;)*) => {$(
        impl $crate::wire::Field for Vec<$rust> {
            const ROS: &'static str = $list;
            const MIN_SIZE: usize = 4;
            fn put(&self, out: &mut $crate::cdr::Encoder) {
                out.length(self.len());
                self.iter().for_each(|element| $crate::wire::Field::put(element, out));
            }
            fn get(
                from: &mut $crate::cdr::Decoder<'_>,
            ) -> Result<Self, $crate::cdr::CdrError> {
                let length = from.length(<$rust as $crate::wire::Field>::MIN_SIZE)?;
                (0..length).map(|_| <$rust as $crate::wire::Field>::get(from)).collect()
            }
            fn define(known: &mut $crate::wire::Definitions) {
                <$rust as $crate::wire::Field>::define(known);
            }
        }
    )*};
}
pub(crate) use sequences;

numbers! {
    u8 => "uint8", "uint8[]";
    i8 => "int8", "int8[]";
    u16 => "uint16", "uint16[]";
    i32 => "int32", "int32[]";
    u32 => "uint32", "uint32[]";
    u64 => "uint64", "uint64[]";
    f32 => "float32", "float32[]";
    f64 => "float64", "float64[]";
}
sequences! { String => "string[]"; }

/// Octets of a fixed number, such as those of a UUID.
impl Field for [u8; 16] {
    const ROS: &'static str = "uint8[16]";
    const MIN_SIZE: usize = 16;
    fn put(&self, out: &mut Encoder) {
        self.iter().for_each(|octet| octet.put(out));
    }
    fn get(from: &mut Decoder<'_>) -> Result<Self, CdrError> {
        let mut octets = [0; 16];
        for octet in &mut octets {
            *octet = u8::get(from)?;
        }
        Ok(octets)
    }
}

impl Field for bool {
    const ROS: &'static str = "bool";
    const MIN_SIZE: usize = 1;
    fn put(&self, out: &mut Encoder) {
        out.number([u8::from(*self)]);
    }
    fn get(from: &mut Decoder<'_>) -> Result<Self, CdrError> {
        Ok(from.number()? != [0])
    }
}

impl Field for String {
    const ROS: &'static str = "string";
    const MIN_SIZE: usize = 4;
    fn put(&self, out: &mut Encoder) {
        out.text(self);
    }
    fn get(from: &mut Decoder<'_>) -> Result<Self, CdrError> {
        Ok(from.text()?.to_owned())
    }
}

/// Declares a message: `"pkg/msg/Type" "pkg/Type" Name { field: type, … }`. Doc comments of fields become comments of
/// the schema, so that a log is self-describing.
macro_rules! message {
    ($(#[$meta:meta])* $schema:literal $ros:literal $name:ident {
        $($(#[doc = $doc:literal])* $field:ident: $type:ty,)*
    }) => {
        $(#[$meta])*
        #[derive(Debug, Clone, PartialEq, Default, serde::Serialize)]
        pub struct $name {
            $($(#[doc = $doc])* pub $field: $type,)*
        }

        impl $crate::wire::Field for $name {
            const ROS: &'static str = $ros;
            const MIN_SIZE: usize = 0 $(+ <$type as $crate::wire::Field>::MIN_SIZE)*;
            fn put(&self, out: &mut $crate::cdr::Encoder) {
                $(self.$field.put(out);)*
            }
            fn get(
                from: &mut $crate::cdr::Decoder<'_>,
            ) -> Result<Self, $crate::cdr::CdrError> {
                <Self as $crate::wire::Message>::get_first(from, usize::MAX)
            }
            fn define(known: &mut $crate::wire::Definitions) {
                if known.iter().all(|(name, _)| *name != Self::ROS) {
                    known.push((Self::ROS, <Self as $crate::wire::Message>::fields()));
                    $(<$type as $crate::wire::Field>::define(known);)*
                }
            }
        }

        impl $crate::wire::Message for $name {
            const SCHEMA: &'static str = $schema;
            fn fields() -> String {
                let mut text = String::new();
                $(
                    $(text.push_str(concat!("#", $doc, "\n"));)*
                    text.push_str(<$type as $crate::wire::Field>::ROS);
                    text.push_str(concat!(" ", stringify!($field), "\n").replace(" r#", " ").as_str());
                )*
                text
            }
            fn get_first(
                from: &mut $crate::cdr::Decoder<'_>,
                count: usize,
            ) -> Result<Self, $crate::cdr::CdrError> {
                let mut fields = 0..count;
                // Fields of a struct literal are evaluated in the order written: the wire's.
                Ok(Self {
                    $($field: match fields.next() {
                        Some(_) => $crate::wire::Field::get(from)?,
                        None => Default::default(),
                    },)*
                })
            }
        }
    };
}
pub(crate) use message;
