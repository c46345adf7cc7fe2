//! Elements that a truncated file leaves open: the parser reports the end of the file without saying where it is.

use std::ops::Range;

/// Returns the positions of the names of all elements that are open at the end of a text, the innermost last.
pub(super) fn open_elements(text: &str) -> Vec<Range<usize>> {
    let (mut open, mut at) = (Vec::new(), 0);
    while let Some(start) = text.get(at..).and_then(|rest| rest.find('<')).map(|next| at + next) {
        let rest = text.get(start..).unwrap_or_default();
        let through = |end: &str| rest.find(end).map_or(rest.len(), |found| found + end.len());
        let length = if rest.starts_with("<!--") {
            through("-->")
        } else if rest.starts_with("<![CDATA[") {
            through("]]>")
        } else if rest.starts_with("<?") {
            through("?>")
        } else if rest.starts_with("</") {
            let length = through(">");
            // A tag that is cut off closes nothing.
            if rest.contains('>') {
                open.pop();
            }
            length
        } else {
            let length = tag_length(rest);
            let name = rest.find(|c: char| c.is_whitespace() || c == '/' || c == '>').unwrap_or(rest.len());
            if !rest.get(..length).is_some_and(|tag| tag.ends_with("/>")) {
                open.push(start + 1..start + name.max(1));
            }
            length
        };
        at = start + length.max(1);
    }
    open
}

/// Returns the length of a start tag; signs in attributes do not end it.
fn tag_length(text: &str) -> usize {
    let mut quote = None;
    for (at, c) in text.char_indices() {
        match (quote, c) {
            (None, '>') => return at + 1,
            (None, '"' | '\'') => quote = Some(c),
            (Some(open), c) if c == open => quote = None,
            _ => {}
        }
    }
    text.len()
}
