//! Blueprints changed at random: whatever comes out, the reader ends, does not panic, and points into the file.

use std::path::Path;

use dimos::blueprint::{Found, Overrides, SearchPath, Source, load_from};
use proptest::prelude::*;

use crate::support::fake_arms;

/// Blueprints without mistakes, to be changed.
fn good() -> Vec<String> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    [
        "blueprints/coordinator-yourarm.yaml",
        "blueprints/coordinator-dual-mock.yaml",
        "tests/fixtures/blueprints/full.yaml",
    ]
    .map(|file| std::fs::read_to_string(root.join(file)).unwrap())
    .to_vec()
}

/// Reads a text and checks what may be checked without knowing what it says.
fn survives(text: &[u8], overrides: &Overrides) {
    let search = SearchPath { folders: vec![Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/blueprints")] };
    let found = Found { name: "fuzz".to_owned(), source: Source::Embedded, bytes: text.to_vec() };
    let loaded = load_from(&search, &found, overrides, &fake_arms::registry());
    assert_eq!(loaded.blueprint.is_none(), loaded.errors() > 0, "a blueprint, or a reason why not");
    assert!(loaded.diagnostics().len() <= 100);
    let drawn = loaded.render(false);
    assert!(
        drawn.lines().filter(|l| l.starts_with("error") || l.starts_with("warning")).count()
            >= loaded.diagnostics().len()
    );
    for report in loaded.reports() {
        assert!(!report.message.is_empty());
        assert!(report.line.is_some(), "no place: {}", report.message);
    }
    loaded.to_json();
}

/// A change of a text.
#[derive(Debug, Clone)]
enum Change {
    Delete(prop::sample::Index, usize),
    Insert(prop::sample::Index, &'static str),
    SwapLines(prop::sample::Index, prop::sample::Index),
    RepeatLine(prop::sample::Index),
    Indent(prop::sample::Index, bool),
}

const PIECES: [&str; 33] = [
    ":",
    "- ",
    "{",
    "}",
    "[",
    "]",
    "\"",
    "'",
    "\n",
    "\t",
    "#",
    "&a ",
    "*a",
    "!t ",
    "|\n",
    "? ",
    ": ",
    ",",
    "null",
    "yes",
    ".nan",
    "-1",
    "1e999",
    "joints",
    "hardware:",
    "<<: ",
    "é",
    "\u{202e}",
    "%",
    "---\n",
    "  ",
    "99999999999999999999",
    "0,5",
];

fn change() -> impl Strategy<Value = Change> {
    use prop::sample::{Index, select};
    prop_oneof![
        (any::<Index>(), 1..20_usize).prop_map(|(at, n)| Change::Delete(at, n)),
        (any::<Index>(), select(&PIECES[..])).prop_map(|(at, piece)| Change::Insert(at, piece)),
        (any::<Index>(), any::<Index>()).prop_map(|(a, b)| Change::SwapLines(a, b)),
        any::<Index>().prop_map(Change::RepeatLine),
        (any::<Index>(), any::<bool>()).prop_map(|(at, more)| Change::Indent(at, more)),
    ]
}

fn apply(text: &str, change: &Change) -> String {
    let mut letters: Vec<char> = text.chars().collect();
    let mut lines: Vec<String> = text.lines().map(str::to_owned).collect();
    if letters.is_empty() || lines.is_empty() {
        return text.to_owned();
    }
    match change {
        Change::Delete(at, n) => {
            let at = at.index(letters.len());
            letters.drain(at..(at + n).min(letters.len()));
            return letters.into_iter().collect();
        }
        Change::Insert(at, piece) => {
            let at = at.index(letters.len());
            letters.splice(at..at, piece.chars());
            return letters.into_iter().collect();
        }
        Change::SwapLines(a, b) => {
            let (a, b) = (a.index(lines.len()), b.index(lines.len()));
            lines.swap(a, b);
        }
        Change::RepeatLine(at) => {
            let at = at.index(lines.len());
            lines.insert(at, lines[at].clone());
        }
        Change::Indent(at, more) => {
            let line = at.index(lines.len());
            lines[line] = match more {
                true => format!("  {}", lines[line]),
                false => lines[line].trim_start().to_owned(),
            };
        }
    }
    lines.join("\n")
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn changed_blueprints_are_survived(which in 0..3_usize, changes in prop::collection::vec(change(), 1..8)) {
        let text = changes.iter().fold(good()[which].clone(), |text, change| apply(&text, change));
        survives(text.as_bytes(), &Overrides::default());
    }

    #[test]
    fn token_soup_is_survived(pieces in prop::collection::vec(prop::sample::select(&PIECES[..]), 0..60)) {
        survives(pieces.concat().as_bytes(), &Overrides::default());
    }

    #[test]
    fn bytes_are_survived(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        survives(&bytes, &Overrides::default());
    }

    #[test]
    fn arguments_are_survived(pieces in prop::collection::vec(prop::sample::select(&[
        "hardware", "arm", ".", "=", "tasks", "0", "address", "{", "[", "]", "&a", "*a", "\n", ": ", "'", "é", "sim", "joints",
    ][..]), 0..12)) {
        let overrides = Overrides { set: vec![pieces.concat()], sim: true, ..Overrides::default() };
        survives(good()[0].as_bytes(), &overrides);
    }
}
