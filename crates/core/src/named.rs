//! Enums whose variants have names in tables, rpc and logs.

/// Defines an enum from rows `variant = name`, with `ALL`, `name` and `of_name`.
#[macro_export]
macro_rules! named {
    ($(#[$meta:meta])* pub enum $enum:ident {
        $($(#[$variant_meta:meta])* $variant:ident = $name:literal,)*
    }) => {
        $(#[$meta])*
        pub enum $enum { $($(#[$variant_meta])* $variant,)* }

        impl $enum {
            /// All variants.
            pub const ALL: &[Self] = &[$(Self::$variant),*];

            /// Returns the name used in tables, rpc and logs.
            pub const fn name(self) -> &'static str {
                match self { $(Self::$variant => $name,)* }
            }

            /// Returns the variant with that name.
            pub fn of_name(name: &str) -> Option<Self> {
                Self::ALL.iter().copied().find(|one| one.name() == name)
            }
        }
    };
}

pub use named;

#[cfg(test)]
mod tests {
    named! {
        /// Example of a test.
        #[derive(Debug, Clone, Copy, PartialEq)]
        pub enum Colour {
            /// Red.
            Red = "red",
            /// Without colour.
            Clear = "",
        }
    }

    #[test]
    fn names_lead_to_variants_and_back() {
        assert_eq!(Colour::ALL, [Colour::Red, Colour::Clear]);
        assert_eq!(
            (Colour::of_name("red"), Colour::of_name(""), Colour::of_name("Red")),
            (Some(Colour::Red), Some(Colour::Clear), None)
        );
    }
}
