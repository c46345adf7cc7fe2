//! `'%.3f' % x`: Python's printf-style formatting.

use super::evaluate::Evaluated;
use super::value::{Value, float_repr};

/// Maximum field width and number of decimals.
const MAX_WIDTH: usize = 200;

/// Formats values.
pub(super) fn percent(format: &str, values: &Value) -> Evaluated<String> {
    let mut values = match values {
        Value::Tuple(items) => items.to_vec(),
        one => vec![one.clone()],
    }
    .into_iter();
    let mut out = String::new();
    let mut chars = format.chars().peekable();
    while let Some(c) = chars.next() {
        if c != '%' {
            out.push(c);
            continue;
        }
        let mut field = Field::default();
        while let Some(flag) = chars.next_if(|c| "-+ 0#".contains(*c)) {
            match flag {
                '-' => field.left = true,
                '+' => field.plus = true,
                '0' => field.zeros = true,
                _ => {}
            }
        }
        let mut number = || {
            let mut digits = String::new();
            while let Some(digit) = chars.next_if(char::is_ascii_digit) {
                digits.push(digit);
            }
            digits.parse::<usize>().ok().map(|n| n.min(MAX_WIDTH))
        };
        field.width = number().unwrap_or(0);
        let dotted = chars.next_if_eq(&'.').is_some();
        let mut digits = String::new();
        while let Some(digit) = chars.next_if(char::is_ascii_digit) {
            digits.push(digit);
        }
        field.decimals = dotted.then(|| digits.parse::<usize>().unwrap_or(0).min(MAX_WIDTH));
        let kind = chars.next().ok_or("incomplete format")?;
        if kind == '%' {
            out.push('%');
            continue;
        }
        let value = values.next().ok_or("not enough arguments for format string")?;
        out.push_str(&field.lay_out(kind, &value)?);
    }
    match values.next() {
        None => Ok(out),
        Some(_) => Err("not all arguments converted during string formatting".to_owned()),
    }
}

#[derive(Debug, Default)]
struct Field {
    left: bool,
    plus: bool,
    zeros: bool,
    width: usize,
    decimals: Option<usize>,
}

impl Field {
    fn lay_out(&self, kind: char, value: &Value) -> Evaluated<String> {
        let number = || value.as_float().ok_or_else(|| format!("must be real number, not {}", value.type_name()));
        let decimals = self.decimals.unwrap_or(6);
        let body = match kind {
            's' => value.text(),
            'r' => value.repr(),
            'd' | 'i' | 'u' => match value.as_int() {
                Some(i) => i.to_string(),
                None => format!("{:.0}", number()?.trunc()),
            },
            'x' => format!("{:x}", value.as_int().ok_or("%x format: an integer is required")?),
            'f' | 'F' => named(number()?).unwrap_or(format!("{:.decimals$}", number()?)),
            'e' | 'E' => named(number()?).unwrap_or_else(|| exponent(number().unwrap_or(0.0), decimals)),
            'g' | 'G' => named(number()?).unwrap_or_else(|| general(number().unwrap_or(0.0), decimals.max(1))),
            other => return Err(format!("unsupported format character '{other}'")),
        };
        let text = kind == 's' || kind == 'r';
        let body = match self.decimals {
            Some(longest) if text => body.chars().take(longest).collect(),
            _ => body,
        };
        let body = if self.plus && !text && !body.starts_with('-') { format!("+{body}") } else { body };
        let missing = self.width.saturating_sub(body.chars().count());
        Ok(if self.left {
            body + &" ".repeat(missing)
        } else if self.zeros && !text {
            let sign = usize::from(body.starts_with(['-', '+']));
            let (sign, digits) = body.split_at(sign);
            format!("{sign}{}{digits}", "0".repeat(missing))
        } else {
            " ".repeat(missing) + &body
        })
    }
}

/// Returns the text of a number without digits (`inf`, `nan`).
fn named(value: f64) -> Option<String> {
    (!value.is_finite()).then(|| float_repr(value))
}

fn exponent(value: f64, decimals: usize) -> String {
    let text = format!("{value:.decimals$e}");
    let (digits, exponent) = text.split_once('e').unwrap_or((&text, "0"));
    let exponent: i32 = exponent.parse().unwrap_or(0);
    format!("{digits}e{}{:02}", if exponent < 0 { '-' } else { '+' }, exponent.abs())
}

fn general(value: f64, digits: usize) -> String {
    let scientific = format!("{value:.*e}", digits - 1);
    let power: i32 = scientific.split_once('e').and_then(|(_, e)| e.parse().ok()).unwrap_or(0);
    let trimmed = |text: &str| match text.contains('.') {
        true => text.trim_end_matches('0').trim_end_matches('.').to_owned(),
        false => text.to_owned(),
    };
    if power < -4 || power >= digits as i32 {
        let text = exponent(value, digits - 1);
        let (mantissa, power) = text.split_once('e').unwrap_or((&text, "+00"));
        return format!("{}e{power}", trimmed(mantissa));
    }
    let decimals = usize::try_from(digits as i32 - 1 - power).unwrap_or(0);
    trimmed(&format!("{value:.decimals$}"))
}

#[cfg(test)]
mod tests {
    use std::rc::Rc;

    use super::*;

    #[test]
    fn formats_are_pythons() {
        for (format, value, text) in [
            ("%.3f", Value::Float(0.1), "0.100"),
            ("%d", Value::Float(3.9), "3"),
            ("%05d|", Value::Int(-42), "-0042|"),
            ("%+.1e", Value::Float(12345.0), "+1.2e+04"),
            ("%g", Value::Float(0.0001), "0.0001"),
            ("%g", Value::Float(1e-5), "1e-05"),
            ("%g", Value::Float(1234567.0), "1.23457e+06"),
            ("%-6s|", "ab".into(), "ab    |"),
            ("%6.2f%%", Value::Int(1), "  1.00%"),
            ("%x", Value::Int(255), "ff"),
            ("%r", "a".into(), "'a'"),
            ("%f", Value::Float(f64::INFINITY), "inf"),
        ] {
            assert_eq!(percent(format, &value).unwrap(), text, "{format}");
        }
        let two = Value::Tuple(Rc::new(vec![Value::Int(1), "b".into()]));
        assert_eq!(percent("%d-%s", &two).unwrap(), "1-b");
        for wrong in ["%d %d %d", "%d", "%z %s", "%"] {
            assert!(percent(wrong, &two).is_err(), "{wrong}");
        }
    }
}
