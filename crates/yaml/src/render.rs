//! Diagnostics as text: message, position, source lines, notes and a hint.

use annotate_snippets::{AnnotationKind, Group, Level, Origin, Renderer, Snippet};

use crate::diag::{Diag, Label, Severity};
use crate::tree::Tree;

/// Maximum length of a line that is shown [bytes].
const MAX_LINE: usize = 2000;

/// Renders a diagnostic for a terminal.
pub fn render(tree: &Tree, diag: &Diag, colour: bool) -> String {
    let level = match diag.severity {
        Severity::Error => Level::ERROR,
        Severity::Warning => Level::WARNING,
    };
    let mut group: Group<'_> = Group::with_title(level.primary_title(diag.message.as_str()));
    let windows: Vec<_> = match &diag.at {
        Some(at) => windows(tree, at, &diag.also),
        None => Vec::new(),
    };
    for window in &windows {
        group = match &window.text {
            Some(text) => {
                let marks = window.marks.iter().map(|mark| {
                    let kind = if mark.primary { AnnotationKind::Primary } else { AnnotationKind::Context };
                    let label = Some(mark.text).filter(|t| !t.is_empty());
                    kind.span(mark.start..mark.end).label(label)
                });
                let snippet = Snippet::source(*text).path(window.file).line_start(window.line).fold(false);
                group.element(snippet.annotations(marks))
            }
            None => group.element(Origin::path(window.file).line(window.line)),
        };
    }
    for note in &diag.notes {
        group = group.element(Level::NOTE.message(note.as_str()));
    }
    if let Some(hint) = &diag.hint {
        group = group.element(Level::HELP.with_name("hint").message(hint.as_str()));
    }
    let renderer = if colour { Renderer::styled() } else { Renderer::plain() };
    renderer.render(&[group])
}

/// Source lines of a diagnostic.
struct Window<'a> {
    file: &'a str,
    /// Number of the first line.
    line: usize,
    /// The lines; `None` if they are too long.
    text: Option<&'a str>,
    marks: Vec<Mark<'a>>,
}

/// A marked range, in bytes of the window's text.
struct Mark<'a> {
    start: usize,
    end: usize,
    text: &'a str,
    primary: bool,
}

/// Returns one window per label; labels on neighbouring lines share one.
fn windows<'a>(tree: &'a Tree, at: &'a Label, also: &'a [Label]) -> Vec<Window<'a>> {
    let mut out: Vec<(u32, usize, usize, Window<'a>)> = Vec::new();
    for (label, primary) in std::iter::once((at, true)).chain(also.iter().map(|label| (label, false))) {
        let Some(source) = tree.source(label.source) else { continue };
        let text = source.text.as_str();
        let place = text.floor_char_boundary(label.range.start);
        let start = text.get(..place).and_then(|t| t.rfind('\n')).map_or(0, |i| i + 1);
        let end = text.get(place..).and_then(|t| t.find('\n')).map_or(text.len(), |i| place + i);
        let line = text.get(..start).map_or(0, |t| t.matches('\n').count()) + 1;
        let mark = |from: usize| Mark {
            start: place - from,
            end: text.ceil_char_boundary(label.range.end).clamp(place, end) - from,
            text: &label.text,
            primary,
        };
        let touching = out.iter_mut().find(|(src, from, to, _)| {
            *src == label.source && start <= *to + 1 && end + 1 >= *from && start.abs_diff(*from) < MAX_LINE
        });
        match touching {
            Some((_, from, to, window)) if window.text.is_some() && end - start <= MAX_LINE => {
                let moved = *from - start.min(*from);
                for mark in &mut window.marks {
                    mark.start += moved;
                    mark.end += moved;
                }
                (*from, *to) = (start.min(*from), end.max(*to));
                window.line = window.line.min(line);
                window.text = text.get(*from..*to);
                window.marks.push(mark(*from));
            }
            _ => {
                let shown = text.get(start..end).filter(|t| t.len() <= MAX_LINE);
                let window = Window { file: &source.name, line, text: shown, marks: vec![mark(start)] };
                out.push((label.source, start, end, window));
            }
        }
    }
    out.into_iter().map(|(_, _, _, window)| window).collect()
}
