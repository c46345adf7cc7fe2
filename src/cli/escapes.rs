//! Texts of devices, logs, blueprints and other computers as a terminal may get them: what it would execute, or what
//! would reorder the text around it, is shown instead.

use std::borrow::Cow;
use std::fmt::Write;

/// Returns a text for a terminal. Keeps line breaks, tabs and, with `colour`, the colours that this program prints.
pub fn safe(text: &str, colour: bool) -> Cow<'_, str> {
    if text.chars().all(|c| matches!(c, '\n' | '\t') || !is_hidden(c)) {
        return Cow::Borrowed(text);
    }
    let mut shown = String::with_capacity(text.len() + 16);
    let mut rest = text;
    while let Some(c) = rest.chars().next() {
        let length = match own_colour(rest).filter(|_| colour) {
            Some(length) => {
                shown.push_str(rest.get(..length).unwrap_or_default());
                length
            }
            None => {
                match c {
                    '\n' | '\t' => shown.push(c),
                    _ if is_hidden(c) => shown.extend(c.escape_unicode()),
                    _ => shown.push(c),
                }
                c.len_utf8()
            }
        };
        rest = rest.get(length..).unwrap_or_default();
    }
    Cow::Owned(shown)
}

/// Returns JSON whose hidden characters are escapes of JSON: the same values for every reader.
pub fn in_json(json: &str) -> Cow<'_, str> {
    // Those below the blank are escaped in strings already; between values they are blanks.
    let is_open = |c: char| c >= ' ' && is_hidden(c);
    if !json.contains(is_open) {
        return Cow::Borrowed(json);
    }
    let mut shown = String::with_capacity(json.len() + 16);
    for c in json.chars() {
        if is_open(c) {
            let _ = write!(shown, "\\u{:04x}", u32::from(c));
        } else {
            shown.push(c);
        }
    }
    Cow::Owned(shown)
}

/// Returns whether a terminal executes a character (C0, DEL, C1), or lets it change the order of others.
pub fn is_hidden(c: char) -> bool {
    c.is_control()
        || matches!(c, '\u{61c}' | '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

/// Returns the length of the colour or weight at the front of a text, if this program prints such ones: a foreground,
/// bold, dim, italic, and their ends.
fn own_colour(text: &str) -> Option<usize> {
    let (parameters, _) = text.strip_prefix("\x1b[")?.split_once('m')?;
    let is_own = |code: &str| matches!(code, "" | "0" | "1" | "2" | "3" | "22" | "23" | "39") || is_foreground(code);
    let indexed = parameters.strip_prefix("38;5;").is_some_and(|index| index.parse::<u8>().is_ok());
    (indexed || parameters.split(';').all(is_own)).then_some(parameters.len() + 3)
}

fn is_foreground(code: &str) -> bool {
    matches!(code.parse(), Ok(30..=37 | 90..=97_u8)) && code.len() == 2
}

#[cfg(test)]
mod tests {
    use super::*;

    const HOSTILE: &str = "\x1b]0;owned\x07\x1b[2J\u{202e}evil\u{9b}31m\x7f\r\n\ttail";

    #[test]
    fn what_a_terminal_would_execute_is_shown() {
        let shown = r"\u{1b}]0;owned\u{7}\u{1b}[2J\u{202e}evil\u{9b}31m\u{7f}\u{d}".to_owned() + "\n\ttail";
        assert_eq!((safe(HOSTILE, true), safe(HOSTILE, false)), (shown.as_str().into(), shown.as_str().into()));
        for plain in ["", "µ and 漢字", "two\nlines\tand a tab"] {
            assert!(matches!(safe(plain, false), Cow::Borrowed(same) if same == plain));
        }
    }

    #[test]
    fn only_colours_of_this_program_pass_and_only_where_it_prints_colours() {
        for own in ["\x1b[1;31m", "\x1b[0m", "\x1b[m", "\x1b[38;5;10m", "\x1b[2m", "\x1b[39m", "\x1b[91m"] {
            assert_eq!(safe(own, true), own, "{own:?}");
            assert!(!safe(own, false).contains('\x1b'), "{own:?}");
        }
        for other in
            ["\x1b[8m", "\x1b[5;31m", "\x1b[7m", "\x1b[38;5;900m", "\x1b[41m", "\x1b[1", "\x1b[2Km", "\x1b[031m"]
        {
            assert!(!safe(other, true).contains('\x1b'), "{other:?}");
        }
    }

    #[test]
    fn json_has_the_same_values() {
        let value = serde_json::json!({"text": HOSTILE, "plain": "µ"});
        let text = value.to_string();
        let shown = in_json(&text);
        assert!(!shown.contains(is_hidden), "{shown}");
        assert_eq!(serde_json::from_str::<serde_json::Value>(&shown).unwrap(), value);
        assert!(matches!(in_json("{\n  \"a\": \"µ\"\n}"), Cow::Borrowed(_)));
    }
}
