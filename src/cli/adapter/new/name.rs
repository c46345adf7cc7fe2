//! The name of a new arm, in the forms in which code and files write it.

use dimos_hardware::registry::Registry;

/// Longest name: it is part of lines of code.
const LONGEST: usize = 24;

/// Words of Rust that no module can be called.
const KEYWORDS: &str = "abstract as async await become box break const continue crate do dyn else enum extern false \
    final fn for gen if impl in let loop macro match mod move mut override priv pub ref return self static struct \
    super trait true try type typeof unsafe unsized use virtual where while yield";
/// Crates that the new one uses or that Rust brings: it cannot be called like them.
const CRATES: &str = "dimos schemars serde core std alloc test proc_macro";

/// A name that was found good.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Name {
    /// Of the crate and the blueprint: `acme-arm`.
    pub kebab: String,
    /// Of the module, and `adapter_type`: `acme_arm`.
    pub snake: String,
    /// Of types, and for people: `AcmeArm`.
    pub camel: String,
}

impl Name {
    /// Reads a name; what is wrong with it, in a sentence without full stop.
    pub fn parse(text: &str) -> Result<Self, String> {
        let good = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || matches!(c, '-' | '_');
        let parts: Vec<&str> = text.split(['-', '_']).collect();
        let snake = parts.join("_");
        let is = |list: &str| list.split_whitespace().any(|word| word == snake);
        let problem = if !text.starts_with(|c: char| c.is_ascii_lowercase()) || !text.chars().all(good) {
            "begin it with a lower-case letter; lower-case letters, digits, - and _ may follow".to_owned()
        } else if parts.iter().any(|part| part.is_empty()) {
            "- and _ stand between letters".to_owned()
        } else if text.len() > LONGEST {
            format!("it may have {LONGEST} characters")
        } else if is(KEYWORDS) {
            "it is a word of Rust".to_owned()
        } else if is(CRATES) {
            "a crate that the adapter uses has that name".to_owned()
        } else {
            let camel = parts.iter().map(|part| part[..1].to_uppercase() + &part[1..]).collect();
            return Ok(Self { kebab: parts.join("-"), snake, camel });
        };
        Err(format!("an arm cannot be named {text:?}: {problem}"))
    }

    /// Whether an adapter has the name already, in this build or in another.
    pub fn is_taken(&self, registry: &Registry) -> bool {
        registry.get(&self.snake).is_some() || registry.absent().any(|absent| absent.name == self.snake)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_take_three_forms() {
        for (typed, kebab, snake, camel) in [
            ("acme", "acme", "acme", "Acme"),
            ("acme-arm", "acme-arm", "acme_arm", "AcmeArm"),
            ("ur5_e", "ur5-e", "ur5_e", "Ur5E"),
            ("x", "x", "x", "X"),
        ] {
            let name = Name::parse(typed).unwrap();
            assert_eq!((name.kebab.as_str(), name.snake.as_str(), name.camel.as_str()), (kebab, snake, camel));
        }
    }

    #[test]
    fn bad_names_are_refused_with_the_reason() {
        for (typed, part) in [
            ("", "lower-case"),
            ("Acme", "lower-case"),
            ("6dof", "lower-case"),
            ("-a", "lower-case"),
            ("ácme", "lower-case"),
            ("a/b", "lower-case"),
            ("..", "lower-case"),
            ("acme--arm", "between"),
            ("acme_", "between"),
            ("a-very-long-name-for-an-arm", "24"),
            ("loop", "word of Rust"),
            ("proc-macro", "crate"),
            ("serde", "crate"),
        ] {
            let error = Name::parse(typed).unwrap_err();
            assert!(error.contains(part), "{error}");
        }
    }

    #[test]
    fn adapters_that_there_are_keep_their_names() {
        assert!(Name::parse("yourarm").unwrap().is_taken(&dimos_arms::registry()));
        assert!(!Name::parse("acme").unwrap().is_taken(&dimos_arms::registry()));
    }
}
