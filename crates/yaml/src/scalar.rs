//! Plain scalars: their type by the core schema of YAML 1.2, and hints for a wrong type.

/// A resolved scalar.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Scalar<'a> {
    Null,
    Bool(bool),
    Int(i128),
    Float(f64),
    Text(&'a str),
}

/// Resolves a scalar. Quoted ones are always text.
pub(super) fn resolve(text: &str, plain: bool) -> Scalar<'_> {
    if !plain {
        return Scalar::Text(text);
    }
    match text {
        "" | "~" | "null" | "Null" | "NULL" => Scalar::Null,
        "true" | "True" | "TRUE" => Scalar::Bool(true),
        "false" | "False" | "FALSE" => Scalar::Bool(false),
        _ => number(text).unwrap_or(Scalar::Text(text)),
    }
}

fn number(text: &str) -> Option<Scalar<'static>> {
    for (prefix, radix) in [("0o", 8), ("0x", 16)] {
        if let Some(digits) = text.strip_prefix(prefix) {
            let whole = digits.chars().all(|c| c.is_digit(radix));
            return i128::from_str_radix(digits, radix).ok().filter(|_| whole).map(Scalar::Int);
        }
    }
    let unsigned = text.strip_prefix(['+', '-']).unwrap_or(text);
    match unsigned {
        ".inf" | ".Inf" | ".INF" => {
            return Some(Scalar::Float(if text.starts_with('-') { f64::NEG_INFINITY } else { f64::INFINITY }));
        }
        ".nan" | ".NaN" | ".NAN" if unsigned == text => return Some(Scalar::Float(f64::NAN)),
        _ => {}
    }
    let first = unsigned.trim_start_matches('.').chars().next()?;
    if !first.is_ascii_digit() || !unsigned.chars().all(|c| matches!(c, '0'..='9' | '.' | 'e' | 'E' | '+' | '-')) {
        return None;
    }
    if unsigned.chars().all(|c| c.is_ascii_digit())
        && let Ok(value) = text.parse()
    {
        return Some(Scalar::Int(value));
    }
    text.parse().ok().map(Scalar::Float)
}

/// Describes a found value for messages.
pub(super) fn describe(text: &str, plain: bool) -> String {
    let shown = crate::quote(text);
    match resolve(text, plain) {
        Scalar::Null => "nothing".to_owned(),
        Scalar::Bool(_) => format!("the boolean {shown}"),
        Scalar::Int(_) | Scalar::Float(_) => format!("the number {shown}"),
        Scalar::Text("") => "an empty text".to_owned(),
        Scalar::Text(_) => format!("the text {shown}"),
    }
}

/// Returns the hint for a boolean.
pub(super) fn bool_hint(text: &str) -> Option<String> {
    match text.to_lowercase().as_str() {
        "yes" | "y" | "on" | "1" | "true" => Some("write true".to_owned()),
        "no" | "n" | "off" | "0" | "false" => Some("write false".to_owned()),
        _ => Some("write true or false".to_owned()),
    }
}

/// Returns the hint for a number, if it can be derived from the text.
pub(super) fn number_hint(text: &str, plain: bool) -> Option<String> {
    let is_number = |t: &str| matches!(resolve(t, true), Scalar::Int(_) | Scalar::Float(_));
    let trimmed = text.trim();
    if !plain && is_number(trimmed) {
        return Some(format!("write it without quotes: {trimmed}"));
    }
    let joined = trimmed.replace('_', "");
    if joined != trimmed && is_number(&joined) {
        return Some(format!("write {joined}"));
    }
    let pointed = trimmed.replacen(',', ".", 1);
    if pointed != trimmed && is_number(&pointed) {
        return Some(format!("write {pointed}"));
    }
    let end = trimmed.find(|c: char| c.is_alphabetic() || matches!(c, '°' | '%' | '/' | ' ')).unwrap_or(trimmed.len());
    let (head, unit) = trimmed.split_at(end);
    if is_number(head) && !unit.is_empty() {
        return Some(match unit.trim().to_lowercase().as_str() {
            "deg" | "°" | "degrees" | "°/s" | "deg/s" => {
                let radians = head.parse::<f64>().unwrap_or_default().to_radians();
                format!("angles are in radians: write {radians:.4}")
            }
            "ms" => format!("times are in seconds: write {}", head.parse::<f64>().unwrap_or_default() / 1000.0),
            _ => format!("numbers are written without a unit: {head}"),
        });
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_of_yaml_1_2() {
        for (text, want) in [
            ("", Scalar::Null),
            ("~", Scalar::Null),
            ("true", Scalar::Bool(true)),
            ("yes", Scalar::Text("yes")),
            ("12", Scalar::Int(12)),
            ("-12", Scalar::Int(-12)),
            ("+1", Scalar::Int(1)),
            ("0x1F", Scalar::Int(31)),
            ("0o17", Scalar::Int(15)),
            ("017", Scalar::Int(17)),
            ("1e3", Scalar::Float(1000.0)),
            (".5", Scalar::Float(0.5)),
            ("1.", Scalar::Float(1.0)),
            ("-.inf", Scalar::Float(f64::NEG_INFINITY)),
            ("1_000", Scalar::Text("1_000")),
            ("192.168.1.100", Scalar::Text("192.168.1.100")),
            ("1-2", Scalar::Text("1-2")),
            ("infinity", Scalar::Text("infinity")),
            ("nan", Scalar::Text("nan")),
            ("0x-1", Scalar::Text("0x-1")),
            ("sim", Scalar::Text("sim")),
        ] {
            assert_eq!(resolve(text, true), want, "{text}");
        }
        assert_eq!(resolve("12", false), Scalar::Text("12"));
    }

    #[test]
    fn hints_say_what_to_write() {
        for (text, want) in [
            ("1_000", "write 1000"),
            ("0,5", "write 0.5"),
            ("100Hz", "numbers are written without a unit: 100"),
            ("90deg", "angles are in radians: write 1.5708"),
            ("20 ms", "times are in seconds: write 0.02"),
        ] {
            assert_eq!(number_hint(text, true).as_deref(), Some(want), "{text}");
        }
        assert_eq!(number_hint("fast", true), None);
        assert_eq!(number_hint("12", false).as_deref(), Some("write it without quotes: 12"));
    }
}
