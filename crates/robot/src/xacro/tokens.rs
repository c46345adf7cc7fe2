//! Expressions: text → tokens.

use super::value::Value;

/// A token.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Token {
    Number(String),
    Text(String),
    Name(String),
    Sign(&'static str),
}

const SIGNS: &[&str] = &[
    "**", "//", "==", "!=", "<=", ">=", "=", "+", "-", "*", "/", "%", "<", ">", "(", ")", "[", "]", "{", "}", ",", ".",
    ":",
];
pub(super) const KEYWORDS: &[&str] = &[
    "and", "as", "assert", "async", "await", "break", "class", "continue", "def", "del", "elif", "else", "except",
    "finally", "for", "from", "global", "if", "import", "in", "is", "lambda", "nonlocal", "not", "or", "pass", "raise",
    "return", "try", "while", "with", "yield", "None", "True", "False",
];

/// Returns whether a text is a valid property name.
pub(super) fn is_identifier(text: &str) -> bool {
    let mut chars = text.chars();
    chars.next().is_some_and(|c| c.is_alphabetic() || c == '_')
        && chars.all(|c| c.is_alphanumeric() || c == '_')
        && !KEYWORDS.contains(&text)
}

pub(super) fn shown(token: &Token) -> String {
    match token {
        Token::Number(t) | Token::Name(t) => format!("`{t}`"),
        Token::Text(t) => format!("'{t}'"),
        Token::Sign(t) => format!("`{t}`"),
    }
}

pub(super) fn tokens(text: &str) -> Result<Vec<Token>, String> {
    let mut out = Vec::new();
    let mut rest = text.trim();
    while let Some(c) = rest.chars().next() {
        if c.is_whitespace() {
            rest = rest.trim_start();
            continue;
        }
        let second = rest[c.len_utf8()..].chars().next();
        if c.is_ascii_digit() || (c == '.' && second.is_some_and(|d| d.is_ascii_digit())) {
            let length = number_length(rest);
            out.push(Token::Number(rest[..length].to_owned()));
            rest = &rest[length..];
        } else if matches!(c, '\'' | '"') {
            let (value, length) = quoted(rest, false)?;
            out.push(Token::Text(value));
            rest = &rest[length..];
        } else if matches!(c, 'r' | 'R' | 'u' | 'U') && matches!(second, Some('\'' | '"')) {
            let (value, length) = quoted(&rest[1..], c.eq_ignore_ascii_case(&'r'))?;
            out.push(Token::Text(value));
            rest = &rest[1 + length..];
        } else if c.is_alphabetic() || c == '_' {
            let length = rest.find(|c: char| !(c.is_alphanumeric() || c == '_')).unwrap_or(rest.len());
            out.push(Token::Name(rest[..length].to_owned()));
            rest = &rest[length..];
        } else if let Some(sign) = SIGNS.iter().find(|sign| rest.starts_with(**sign)) {
            out.push(Token::Sign(sign));
            rest = &rest[sign.len()..];
        } else {
            return Err(format!("invalid syntax: `{c}` is not expected here"));
        }
    }
    Ok(out)
}

fn number_length(text: &str) -> usize {
    let bytes = text.as_bytes();
    if bytes.first() == Some(&b'0') && bytes.get(1).is_some_and(|b| b"xXoObB".contains(b)) {
        return 2 + text[2..].find(|c: char| !(c.is_ascii_alphanumeric() || c == '_')).unwrap_or(text.len() - 2);
    }
    let mut length = 0;
    while let Some(b) = bytes.get(length) {
        let exponent_sign = matches!(b, b'+' | b'-') && length > 0 && matches!(bytes[length - 1], b'e' | b'E');
        if b.is_ascii_alphanumeric() || matches!(b, b'.' | b'_') || exponent_sign {
            length += 1;
        } else {
            break;
        }
    }
    length
}

/// Returns a quoted text and its length in the source.
fn quoted(text: &str, raw: bool) -> Result<(String, usize), String> {
    let mut chars = text.char_indices();
    let quote = chars.next().map_or('\'', |(_, c)| c);
    let mut out = String::new();
    while let Some((i, c)) = chars.next() {
        if c == quote {
            return Ok((out, i + c.len_utf8()));
        }
        if c != '\\' {
            out.push(c);
            continue;
        }
        let Some((_, escaped)) = chars.next() else { break };
        if raw {
            out.push('\\');
            out.push(escaped);
            continue;
        }
        let code = |n: usize, chars: &mut std::str::CharIndices<'_>| {
            let hex: String = chars.take(n).map(|(_, c)| c).collect();
            u32::from_str_radix(&hex, 16).ok().and_then(char::from_u32).ok_or("invalid syntax: invalid escape sequence")
        };
        match escaped {
            'n' => out.push('\n'),
            't' => out.push('\t'),
            'r' => out.push('\r'),
            '0' => out.push('\0'),
            '\\' | '\'' | '"' => out.push(escaped),
            'x' => out.push(code(2, &mut chars)?),
            'u' => out.push(code(4, &mut chars)?),
            other => {
                out.push('\\');
                out.push(other);
            }
        }
    }
    Err("invalid syntax: a text without closing quote".to_owned())
}

pub(super) fn number(text: &str) -> Result<Value, String> {
    let wrong = || format!("invalid syntax: `{text}` is not a number");
    let plain = text.replace('_', "");
    if text.starts_with('_') || text.ends_with('_') || text.contains("__") {
        return Err(wrong());
    }
    let lower = plain.to_ascii_lowercase();
    for (prefix, radix) in [("0x", 16), ("0o", 8), ("0b", 2)] {
        if let Some(digits) = lower.strip_prefix(prefix) {
            return i64::from_str_radix(digits, radix).map(Value::Int).map_err(|_| wrong());
        }
    }
    if plain.bytes().all(|b| b.is_ascii_digit()) {
        if plain.len() > 1 && plain.starts_with('0') && plain.bytes().any(|b| b != b'0') {
            return Err(format!("{}: numbers in expressions must not start with 0", wrong()));
        }
        return plain.parse().map(Value::Int).map_err(|_| format!("the number {text} is too large"));
    }
    plain.parse().map(Value::Float).map_err(|_| wrong())
}
