//! The words of a program.

use super::Refused;

/// A word.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Token {
    Name(String),
    Int(i32),
    Float(f64),
    Text,
    Sign(&'static str),
    /// End of a line that ends a statement.
    Newline,
}

/// Signs, longer ones before their beginnings.
const SIGNS: [&str; 20] =
    ["==", "!=", "<=", ">=", "<", ">", "=", "+", "-", "*", "/", "%", "(", ")", "[", "]", ",", ":", ".", ";"];

/// Splits a text into words, each with its line. A line continues within brackets and after an operator.
pub(super) fn tokens(text: &str) -> Result<Vec<(u32, Token)>, Refused> {
    let mut found: Vec<(u32, Token)> = Vec::new();
    let mut depth = 0_u32;
    for (line, content) in (1..).zip(text.lines()) {
        let mut rest = content.trim();
        while let Some(first) = rest.chars().next().filter(|first| *first != '#') {
            let (token, length) = if first == '"' {
                let Some(length) = rest.get(1..).and_then(|rest| rest.find('"')) else {
                    return Refused::new(line, "a text without end");
                };
                (Token::Text, length + 2)
            } else if first.is_ascii_digit() || (first == '.' && rest.as_bytes().get(1).is_some_and(u8::is_ascii_digit))
            {
                number(line, rest)?
            } else if first.is_ascii_alphabetic() || first == '_' {
                let length = rest.find(|c: char| !c.is_ascii_alphanumeric() && c != '_').unwrap_or(rest.len());
                (Token::Name(rest.chars().take(length).collect()), length)
            } else {
                let Some(sign) = SIGNS.into_iter().find(|sign| rest.starts_with(sign)) else {
                    return Refused::new(line, format!("{first:?} is no sign of the language"));
                };
                match sign {
                    "(" | "[" => depth += 1,
                    ")" | "]" => depth = depth.saturating_sub(1),
                    _ => {}
                }
                (Token::Sign(sign), sign.len())
            };
            found.push((line, token));
            rest = rest.get(length..).unwrap_or_default().trim_start();
        }
        if depth == 0 && found.last().is_some_and(|(_, last)| ends_line(last)) {
            found.push((line, Token::Newline));
        }
    }
    Ok(found)
}

/// Whether a statement may end behind this word.
fn ends_line(last: &Token) -> bool {
    match last {
        Token::Newline => false,
        Token::Name(name) => !["and", "or", "not"].contains(&name.as_str()),
        Token::Sign(sign) => [")", "]", ":"].contains(sign),
        _ => true,
    }
}

/// A number, and its length.
fn number(line: u32, text: &str) -> Result<(Token, usize), Refused> {
    let mut length = 0;
    let mut before = ' ';
    for c in text.chars() {
        let exponent = matches!(c, 'e' | 'E') || (matches!(c, '+' | '-') && matches!(before, 'e' | 'E'));
        if !(c.is_ascii_digit() || c == '.' || exponent) {
            break;
        }
        (length, before) = (length + 1, c);
    }
    let digits = text.get(..length).unwrap_or_default();
    let token = match (digits.parse(), digits.parse()) {
        (Ok(whole), _) => Some(Token::Int(whole)),
        (_, Ok(value)) if digits.contains(['.', 'e', 'E']) => Some(Token::Float(value)),
        _ => None,
    };
    let follows = text.chars().nth(length).is_some_and(|c| c.is_ascii_alphabetic() || c == '_');
    match token.filter(|_| !follows) {
        Some(token) => Ok((token, length)),
        None => Refused::new(line, format!("{digits:?} is no number")),
    }
}
