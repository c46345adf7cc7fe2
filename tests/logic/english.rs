//! Checks the English of comments, string literals and documents against a list of phrases that have no right use
//! (`tests/fixtures/phrases.txt`, each with what to write instead).
//!
//! `tests/fixtures/phrases_pending.txt` lists files and folders that are not clean yet; they must still contain a
//! phrase, so that the list shrinks.

use std::collections::{BTreeSet, HashMap};
use std::fs;
use std::path::{Path, PathBuf};

/// Folders and files whose text is checked.
const CHECKED: [&str; 13] = [
    "src",
    "crates",
    "fuzz",
    "tests",
    "benches",
    "blueprints",
    "docs",
    "assets",
    "viewer/src",
    "README.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "SECURITY.md",
];
/// Texts of other programs, and the lists themselves.
const FIXTURES: &str = "tests/fixtures";
/// File types besides Rust that are checked as a whole.
const TEXT_TYPES: [&str; 9] = ["md", "py", "yaml", "json", "urdf", "service", "ts", "css", "html"];
/// Identifiers that a term of the field has replaced, in code of any language.
const REPLACED: [&str; 11] = [
    "motion_is_easily_free", // certify_within_budget
    "look_blocked",          // any_contact_batch
    "GivenUp",               // PaddingException
    "give_up",               // relax
    "give_up_again",         // relax_again
    "kept_on",               // clearance_along
    "Looking",               // EdgeCheck::Coarse
    "JointBound",            // JointBounds
    "Face",                  // Bridge
    "rival",                 // conflict
    "rivals",                // conflicts
];
/// Ends a sentence: no phrase continues over it.
const BREAK: &str = ".";

/// A piece of text for readers, and the line where it begins.
#[derive(Debug, PartialEq, Eq)]
struct Text {
    line: usize,
    text: String,
}

/// A phrase to replace, as lower-case words.
struct Phrase {
    words: Vec<String>,
    instead: String,
}

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Returns the lower-case words of a text; punctuation becomes [`BREAK`].
fn words(text: &str) -> Vec<(usize, String)> {
    let (mut words, mut line, mut word) = (Vec::new(), 0, String::new());
    for c in text.chars().chain(['\n']) {
        if c.is_alphanumeric() || c == '_' {
            word.extend(c.to_lowercase());
            continue;
        }
        if !word.is_empty() {
            words.push((line, std::mem::take(&mut word)));
        }
        line += usize::from(c == '\n');
        if matches!(c, '.' | ',' | ';' | ':' | '!' | '?' | '(' | ')' | '|' | '"' | '`') {
            words.push((line, BREAK.to_owned()));
        }
    }
    words
}

fn phrases() -> Vec<Phrase> {
    let lines = entries("phrases.txt");
    let phrase = |line: &String| {
        let (phrase, instead) =
            line.split_once(" = ").unwrap_or_else(|| panic!("{line:?} is not PHRASE = REPLACEMENT"));
        Phrase { words: words(phrase).into_iter().map(|(_, word)| word).collect(), instead: instead.trim().to_owned() }
    };
    lines.iter().map(phrase).collect()
}

/// Returns the lines of a list, without comments and blank lines.
fn entries(name: &str) -> Vec<String> {
    let text = fs::read_to_string(root().join(FIXTURES).join(name)).unwrap();
    let kept = text.lines().map(str::trim).filter(|line| !line.is_empty() && !line.starts_with('#'));
    kept.map(str::to_owned).collect()
}

/// Returns the comments and string literals of Rust code. Consecutive comment lines are one text.
fn rust_texts(code: &str) -> Vec<Text> {
    let mut texts: Vec<Text> = Vec::new();
    let mut last_comment = None;
    let (mut rest, mut line) = (code, 1);
    while let Some(c) = rest.chars().next() {
        let length = if rest.starts_with("//") {
            let end = rest.find('\n').unwrap_or(rest.len());
            let text = rest[..end].trim_start_matches(['/', '!']);
            match texts.last_mut().filter(|_| last_comment == Some(line - 1)) {
                Some(before) => before.text = format!("{}\n{text}", before.text),
                None => texts.push(Text { line, text: text.to_owned() }),
            }
            last_comment = Some(line);
            end
        } else if let Some((open, close)) = string_ends(rest) {
            let inside = &rest[open..];
            let end = closing(inside, &close);
            texts.push(Text { line, text: without_placeholders(&inside[..end].replace("\\n", " ")) });
            last_comment = None;
            (open + end + close.len()).min(rest.len())
        } else if c == '\'' {
            char_literal(rest)
        } else if c.is_alphanumeric() || c == '_' {
            // Skip identifiers as a whole: an `r` at their end begins no raw string.
            rest.find(|c: char| !c.is_alphanumeric() && c != '_').unwrap_or(rest.len())
        } else {
            c.len_utf8()
        };
        line += rest[..length].matches('\n').count();
        rest = &rest[length..];
    }
    texts
}

/// Returns the length of the opening of a string literal, and its closing; `None` for other code.
fn string_ends(code: &str) -> Option<(usize, String)> {
    let prefix = ["br", "b", "r", ""].into_iter().find(|prefix| {
        let after = code.strip_prefix(prefix).map(|after| after.trim_start_matches('#'));
        after.is_some_and(|after| after.starts_with('"'))
    })?;
    let hashes = code[prefix.len()..].chars().take_while(|c| *c == '#').count();
    (hashes == 0 || prefix.ends_with('r')).then(|| {
        let close = if prefix.ends_with('r') { format!("\"{}", "#".repeat(hashes)) } else { "\"".to_owned() };
        (prefix.len() + hashes + 1, close)
    })
}

/// Returns where a string literal ends. Only raw ones with `#` may contain quotes without a backslash.
fn closing(inside: &str, close: &str) -> usize {
    let mut escaped = false;
    for (at, c) in inside.char_indices() {
        if !escaped && inside[at..].starts_with(close) {
            return at;
        }
        escaped = close == "\"" && c == '\\' && !escaped;
    }
    inside.len()
}

/// Returns the length of a character literal, or of the quote of a lifetime.
fn char_literal(code: &str) -> usize {
    let mut chars = code.char_indices().skip(1);
    match (chars.next(), chars.next()) {
        (Some((_, '\\')), Some(_)) => code[3..].find('\'').map_or(1, |end| end + 4),
        (Some(_), Some((at, '\''))) => at + 1,
        _ => 1,
    }
}

/// Removes `{…}` of format strings: names of variables are code.
fn without_placeholders(text: &str) -> String {
    let mut out = String::new();
    let mut depth = 0_usize;
    for c in text.chars() {
        match c {
            '{' => depth += 1,
            '}' => depth = depth.saturating_sub(1),
            _ if depth == 0 || c == '\n' => out.push(c),
            _ => {}
        }
    }
    out
}

fn files() -> Vec<PathBuf> {
    let mut files = Vec::new();
    let mut folders: Vec<PathBuf> = CHECKED.iter().map(|name| root().join(name)).collect();
    while let Some(path) = folders.pop() {
        if path.is_dir() {
            let entries = fs::read_dir(&path).unwrap().map(|entry| entry.unwrap().path());
            folders.extend(entries.filter(|path| {
                !path.ends_with(FIXTURES) && !path.ends_with("node_modules") && !path.ends_with(file!())
            }));
        } else {
            files.push(path);
        }
    }
    files.sort();
    files
}

/// Returns the texts of a file that readers see.
fn texts(path: &Path) -> Vec<Text> {
    let kind = path.extension().and_then(|kind| kind.to_str()).unwrap_or_default();
    if kind != "rs" && !TEXT_TYPES.contains(&kind) {
        return Vec::new();
    }
    let text = fs::read_to_string(path).unwrap();
    if kind == "rs" { rust_texts(&text) } else { vec![Text { line: 1, text }] }
}

/// Returns the line and the index of every phrase in a text.
fn found(text: &Text, phrases: &[Phrase], by_first: &HashMap<&str, Vec<usize>>) -> Vec<(usize, usize)> {
    let words = words(&text.text);
    let begins = |at: usize, phrase: &Phrase| {
        let there = words[at..].iter().map(|(_, word)| word);
        words.len() - at >= phrase.words.len() && phrase.words.iter().eq(there.take(phrase.words.len()))
    };
    let candidates = words.iter().enumerate().filter_map(|(at, (_, word))| Some((at, by_first.get(word.as_str())?)));
    let matches = candidates.flat_map(|(at, known)| known.iter().map(move |phrase| (at, *phrase)));
    matches.filter(|(at, phrase)| begins(*at, &phrases[*phrase])).map(|(at, i)| (text.line + words[at].0, i)).collect()
}

fn by_first_word(phrases: &[Phrase]) -> HashMap<&str, Vec<usize>> {
    let mut by_first: HashMap<&str, Vec<usize>> = HashMap::new();
    for (i, phrase) in phrases.iter().enumerate() {
        by_first.entry(&phrase.words[0]).or_default().push(i);
    }
    by_first
}

#[test]
fn comments_messages_and_documents_use_none_of_the_listed_phrases() {
    let (phrases, pending) = (phrases(), entries("phrases_pending.txt"));
    let by_first = by_first_word(&phrases);
    let (mut wrong, mut still_pending) = (Vec::new(), BTreeSet::new());
    for path in files() {
        let name = path.strip_prefix(root()).unwrap();
        let excused = pending.iter().find(|pending| name.starts_with(pending));
        for (line, i) in texts(&path).iter().flat_map(|text| found(text, &phrases, &by_first)) {
            match excused {
                Some(pending) => {
                    still_pending.insert(pending);
                }
                None => {
                    let Phrase { words, instead } = &phrases[i];
                    wrong.push(format!("{}:{line}: `{}`: write {instead}", name.display(), words.join(" ")));
                }
            }
        }
    }
    assert!(wrong.is_empty(), "{} phrases:\n{}", wrong.len(), wrong.join("\n"));
    let clean: Vec<&String> = pending.iter().filter(|path| !still_pending.contains(path)).collect();
    assert!(clean.is_empty(), "clean now, remove from tests/fixtures/phrases_pending.txt: {clean:?}");
}

#[test]
fn code_uses_none_of_the_replaced_identifiers() {
    let mut wrong = Vec::new();
    for path in files().into_iter().filter(|path| path.extension().is_some_and(|kind| kind == "rs" || kind == "ts")) {
        let code = fs::read_to_string(&path).unwrap();
        let names = code.split(|c: char| !c.is_alphanumeric() && c != '_');
        let found = names.filter(|name| REPLACED.contains(name)).collect::<BTreeSet<_>>();
        wrong.extend(found.into_iter().map(|name| format!("{}: {name}", path.display())));
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn only_comments_and_strings_of_code_are_read_and_phrases_continue_over_lines() {
    let code = "let told = 'a'; // is not\n// told, nor by\n/// itself\nfn f<'a>() { s(\"so\\nmany {nobody} \\\" whoever\") }\n\
                let raw = r#\"it \"shall\" pass\"#; let c = '\\''; let anew = br\"x\"; for_r(\"anew\");\n";
    let phrases = phrases();
    let by_first = by_first_word(&phrases);
    let found = rust_texts(code).iter().flat_map(|text| found(text, &phrases, &by_first)).collect::<Vec<_>>();
    let found: Vec<(usize, String)> = found.into_iter().map(|(line, i)| (line, phrases[i].words.join(" "))).collect();
    let expected = [(2, "told"), (2, "by itself"), (4, "so many"), (4, "whoever"), (5, "shall"), (5, "anew")]
        .map(|(l, w)| (l, w.to_owned()));
    assert_eq!(found, expected);
}
