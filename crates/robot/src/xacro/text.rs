//! Splits texts with `${expressions}` and `$(substitutions)`.

/// A part of a text.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Part {
    /// Literal text.
    Plain(String),
    /// Inside `${…}`.
    Expression(String),
    /// Inside `$(…)`.
    Substitution(String),
}

/// Splits a text. `$${` and `$$(` stand for themselves with one dollar less; a dollar before anything else is literal.
pub(super) fn parts(text: &str) -> Result<Vec<Part>, String> {
    let mut out = Vec::new();
    let mut rest = text;
    while !rest.is_empty() {
        let dollars = rest.bytes().take_while(|b| *b == b'$').count();
        let after = &rest[dollars..];
        let (part, left) = match (dollars, after.chars().next()) {
            (0, _) => {
                let (plain, left) = rest.split_at(rest.find('$').unwrap_or(rest.len()));
                (Part::Plain(plain.to_owned()), left)
            }
            (2.., Some('{' | '(')) => (Part::Plain(rest[1..=dollars].to_owned()), &after[1..]),
            (1, Some('{')) => {
                let (inside, left) = after[1..].split_once('}').ok_or_else(|| unclosed(rest, '}'))?;
                (Part::Expression(inside.to_owned()), left)
            }
            (1, Some('(')) => {
                let (inside, left) = after[1..].split_once(')').ok_or_else(|| unclosed(rest, ')'))?;
                (Part::Substitution(inside.to_owned()), left)
            }
            (1, _) => {
                let end = after.find(['{', '(', '$']).map_or(rest.len(), |i| i + 1);
                (Part::Plain(rest[..end].to_owned()), &rest[end..])
            }
            _ => return Err(format!("invalid expression: {rest}")),
        };
        out.push(part);
        rest = left;
    }
    Ok(out)
}

fn unclosed(text: &str, sign: char) -> String {
    let shown: String = text.chars().take(60).collect();
    format!("invalid expression: `{sign}` is missing after `{shown}`")
}

/// A `$(…)` command.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Substitution<'t> {
    Arg(&'t str),
    Find(&'t str),
    Env(&'t str),
    OptEnv(&'t str, String),
    Dirname,
    Cwd,
    Eval(&'t str),
}

/// Parses the inside of a `$(…)`.
pub(super) fn substitution(inside: &str) -> Result<Substitution<'_>, String> {
    if let Some(expression) = inside.strip_prefix("eval ") {
        return Ok(Substitution::Eval(expression));
    }
    let words: Vec<&str> = inside.split(' ').filter(|w| !w.is_empty()).collect();
    match words.as_slice() {
        ["arg", name] => Ok(Substitution::Arg(name)),
        ["find", package] => Ok(Substitution::Find(package)),
        ["env", name] => Ok(Substitution::Env(name)),
        ["optenv", name, otherwise @ ..] => Ok(Substitution::OptEnv(name, otherwise.join(" "))),
        ["dirname"] => Ok(Substitution::Dirname),
        ["cwd"] => Ok(Substitution::Cwd),
        [command @ ("arg" | "find" | "env"), ..] => Err(format!("$({command} …) takes exactly one name")),
        ["optenv"] => Err("$(optenv …) needs the name of a variable".to_owned()),
        [] => Err("$() is empty".to_owned()),
        [other, ..] => Err(format!(
            "Unknown substitution command [{other}]: the commands are arg, find, env, optenv, dirname, eval and cwd"
        )),
    }
}

/// Converts an argument's text as `$(eval …)` does.
pub(super) fn converted(text: &str) -> super::value::Value {
    use super::value::{Value, integer};
    let number = match text.contains('.') {
        true => text.trim().parse().ok().map(Value::Float),
        false => integer(text).map(Value::Int),
    };
    number.unwrap_or_else(|| match text.to_lowercase().as_str() {
        "true" => Value::Bool(true),
        "false" => Value::Bool(false),
        _ => text.into(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_are_taken_apart() {
        let plain = |t: &str| Part::Plain(t.to_owned());
        let expression = |t: &str| Part::Expression(t.to_owned());
        for (text, expected) in [
            ("", vec![]),
            ("a ${b}c", vec![plain("a "), expression("b"), plain("c")]),
            ("$(arg x)", vec![Part::Substitution("arg x".into())]),
            ("$${a}$$$(b)", vec![plain("${"), plain("a}"), plain("$$("), plain("b)")]),
            ("5$ and $", vec![plain("5"), plain("$ and "), plain("$")]),
            ("$a{b", vec![plain("$a"), plain("{b")]),
        ] {
            assert_eq!(parts(text).unwrap(), expected, "{text}");
        }
        for wrong in ["${a", "$(arg x", "$$x", "$$"] {
            assert!(parts(wrong).unwrap_err().starts_with("invalid expression"), "{wrong}");
        }
    }

    #[test]
    fn substitutions_are_read() {
        assert_eq!(substitution("arg  x "), Ok(Substitution::Arg("x")));
        assert_eq!(substitution("optenv A b c"), Ok(Substitution::OptEnv("A", "b c".into())));
        assert_eq!(substitution("eval 1 + 2"), Ok(Substitution::Eval("1 + 2")));
        for wrong in ["", "arg", "arg a b", "find", "nothing x", "optenv"] {
            assert!(substitution(wrong).is_err(), "{wrong}");
        }
    }
}
