//! The house rules that neither the manifests of the crates nor clippy check: who may use whom inside of a crate, how
//! long a file may be.

use std::fs;
use std::path::{Path, PathBuf};

/// The program's own modules, with those that each may use besides itself. What the crates may use of each other is in
/// their manifests. `ALL`: everything above it.
const ALL: &[&str] = &["*"];
const LAYERS: &[(&str, &[&str])] = &[
    ("assets", &[]),
    ("blueprint", &["assets"]),
    ("http", &[]),
    ("metrics", &["http"]),
    ("ros_messages", &[]),
    ("view", &["blueprint", "http", "ros_messages"]),
    ("share", &["blueprint", "ros_messages"]),
    ("runtime", ALL),
    ("offline", &[]),
    ("replay", ALL),
    ("cli", ALL),
];
/// Sources of the program and of all crates.
const CODE: [&str; 2] = ["src", "crates"];

/// A source file: its path below the checkout, its text, its code without comments and strings.
struct Source {
    path: String,
    text: String,
    code: String,
}

fn sources(folder: &str) -> Vec<Source> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut paths = Vec::new();
    collect(&root.join(folder), &mut paths);
    paths.sort();
    assert!(paths.len() > 5, "no sources in {folder}");
    let texts: Vec<String> = paths.iter().map(|path| fs::read_to_string(path).unwrap()).collect();
    let source = |(path, text): (&PathBuf, &String)| {
        let code = code(text);
        Source { path: path.strip_prefix(root).unwrap().to_string_lossy().into_owned(), text: text.clone(), code }
    };
    paths.iter().zip(&texts).map(source).collect()
}

fn collect(folder: &Path, paths: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            collect(&path, paths);
        } else if path.extension().is_some_and(|e| e == "rs") {
            paths.push(path);
        }
    }
}

/// The text with comments, strings and characters blanked out. Lines stay where they are.
fn code(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(c) = rest.chars().next() {
        let raw = rest.strip_prefix('r').map(|r| r.chars().take_while(|c| *c == '#').count());
        let is_raw = raw.is_some_and(|n| rest[1 + n..].starts_with('"'))
            && !out.ends_with(|c: char| c.is_alphanumeric() || c == '_');
        let length = if rest.starts_with("//") {
            rest.find('\n').unwrap_or(rest.len())
        } else if is_raw {
            let n = raw.unwrap_or(0);
            let end = format!("\"{}", "#".repeat(n));
            rest[n + 2..].find(&end).map_or(rest.len(), |at| n + 2 + at + end.len())
        } else if c == '"' {
            let mut escaped = false;
            let end = rest[1..].find(|c| {
                let ends = c == '"' && !escaped;
                escaped = c == '\\' && !escaped;
                ends
            });
            end.map_or(rest.len(), |at| at + 2)
        } else if let Some(escape) = rest.strip_prefix("'\\") {
            escape.find('\'').map_or(1, |at| at + 3)
        } else if c == '\'' && rest.chars().nth(2) == Some('\'') {
            rest.char_indices().nth(3).map_or(rest.len(), |(at, _)| at)
        } else {
            out.push(c);
            rest = &rest[c.len_utf8()..];
            continue;
        };
        out.extend(rest[..length].chars().map(|c| if c == '\n' { '\n' } else { ' ' }));
        rest = &rest[length..];
    }
    out
}

/// The paths below the crate that a file names: `(line, module, part)`.
fn used(code: &str) -> Vec<(usize, String, String)> {
    let mut all = Vec::new();
    let word = |s: &str| s.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect::<String>();
    for (at, _) in code.match_indices("crate::") {
        if code[..at].ends_with(|c: char| c.is_alphanumeric() || c == '_' || c == '$') {
            continue;
        }
        let line = code[..at].matches('\n').count() + 1;
        let after = &code[at + "crate::".len()..];
        let Some(group) = after.strip_prefix('{') else {
            let module = word(after);
            let part = after[module.len()..].strip_prefix("::").map(word).unwrap_or_default();
            all.push((line, module, part));
            continue;
        };
        let (mut depth, mut fresh) = (0, true);
        for (i, c) in group.char_indices() {
            match c {
                '{' => depth += 1,
                '}' if depth == 0 => break,
                '}' => depth -= 1,
                ',' if depth == 0 => fresh = true,
                c if fresh && c.is_alphabetic() => {
                    let module = word(&group[i..]);
                    let part = group[i + module.len()..].strip_prefix("::").map(word).unwrap_or_default();
                    all.push((line, module, part));
                    fresh = false;
                }
                _ => {}
            }
        }
    }
    // `crate::VERSION` is no module.
    all.retain(|(_, module, _)| module.starts_with(char::is_lowercase));
    all
}

fn module_of(path: &str) -> &str {
    let below = path.strip_prefix("src/").or(path.strip_prefix("crates/")).unwrap();
    below.split(['/', '.']).next().unwrap()
}

fn fail_on(found: &[String], rule: &str) {
    assert!(found.is_empty(), "{rule}:\n  {}", found.join("\n  "));
}

#[test]
fn a_module_uses_only_what_stands_above_it() {
    let mut found = Vec::new();
    for source in sources("src") {
        let module = module_of(&source.path);
        if matches!(module, "lib" | "main") {
            continue;
        }
        let Some(place) = LAYERS.iter().position(|(name, _)| *name == module) else {
            found.push(format!("{}: `{module}` has no layer; give it one here and in src/lib.rs", source.path));
            continue;
        };
        for (line, target, _) in used(&source.code) {
            let (_, allowed) = LAYERS[place];
            let known = LAYERS.iter().position(|(name, _)| *name == target);
            let fine = target == module
                || allowed.contains(&target.as_str())
                || (allowed == ALL && known.is_some_and(|k| k < place));
            if !fine {
                found.push(format!("{}:{line}: `{module}` may not use `{target}`", source.path));
            }
        }
    }
    fail_on(&found, "layers (`src/lib.rs`)");
}

/// The verbs show what the run does; without a run they plan through `offline`.
#[test]
fn the_verbs_use_neither_control_nor_the_planner() {
    let mut found = Vec::new();
    for source in sources("src").iter().filter(|source| module_of(&source.path) == "cli") {
        for krate in ["dimos_control", "dimos_planner"] {
            for (at, _) in source.code.match_indices(krate) {
                let line = source.code[..at].matches('\n').count() + 1;
                found.push(format!("{}:{line}: {krate}", source.path));
            }
        }
    }
    fail_on(&found, "`cli` asks the run, or `offline`");
}

const ARMS: [&str; 8] = ["franka", "mock", "piper", "remote", "so101", "ur", "xarm", "yourarm"];

#[test]
fn one_arm_does_not_use_another() {
    let mut found = Vec::new();
    for source in CODE.into_iter().flat_map(sources) {
        let Some(arm) = source.path.strip_prefix("crates/arms/src/").and_then(|p| p.split_once('/')) else {
            continue;
        };
        for (at, start) in source.code.match_indices("crate::") {
            let used = source.code[at + start.len()..].split(|c: char| !(c.is_alphanumeric() || c == '_')).next();
            if used != Some(arm.0) && used.is_some_and(|used| ARMS.contains(&used)) {
                found.push(format!("{}: {}", source.path, source.code[at..].lines().next().unwrap_or_default()));
            }
        }
    }
    fail_on(&found, "arms do not use each other");
}

#[test]
fn one_task_type_does_not_use_another_and_the_coordinator_uses_none() {
    let mut found = Vec::new();
    for source in CODE.into_iter().flat_map(sources).filter(|source| source.path.starts_with("crates/control/src/")) {
        let own =
            source.path.strip_prefix("crates/control/src/tasks/").and_then(|p| p.split_once('/')).map(|(own, _)| own);
        // The table, what a configuration is written with, and the suite's stronger tasks name types.
        let names_types = [
            "crates/control/src/tasks/mod.rs",
            "crates/control/src/config.rs",
            "crates/control/src/conformance/bench.rs",
        ];
        if names_types.contains(&source.path.as_str()) {
            continue;
        }
        for (at, start) in source.code.match_indices("tasks::") {
            let rest = &source.code[at + start.len()..];
            let table = source.path == "crates/control/src/task_spec.rs" && rest.starts_with("TABLE");
            if !table && own.is_none_or(|own| !rest.starts_with(own)) {
                found.push(format!("{}: {}", source.path, source.code[at..].lines().next().unwrap_or_default()));
            }
        }
    }
    fail_on(&found, "task types do not use each other; only the table has all");
}

#[test]
fn no_file_is_too_long_and_no_test_is_skipped_for_good() {
    let mut found = Vec::new();
    for source in CODE.into_iter().chain(["tests"]).flat_map(sources) {
        let lines = source.text.lines().count();
        if lines > 800 {
            found.push(format!("{}: {lines} lines", source.path));
        }
        if source.code.contains("#[ignore") {
            found.push(format!("{}: an ignored test", source.path));
        }
    }
    fail_on(&found, "no file over 800 lines, no ignored test");
}

/// rustfmt leaves comments as they are.
#[test]
fn no_comment_is_wider_than_the_code() {
    let mut found = Vec::new();
    for source in ["src", "crates", "tests", "benches", "fuzz"].into_iter().flat_map(sources) {
        for (i, line) in source.text.lines().enumerate() {
            let width = line.chars().count();
            let comment = line.trim_start().strip_prefix("//");
            // A table, or an address that cannot be broken.
            let fixed = |text: &str| text.trim_start_matches(['/', '!', ' ']).starts_with('|') || text.contains("://");
            if width > 120 && comment.is_some_and(|text| !fixed(text)) {
                found.push(format!("{}:{}: {width} columns", source.path, i + 1));
            }
        }
    }
    fail_on(&found, "comments of at most 120 columns");
}

#[test]
fn the_checks_see_what_they_should() {
    let text = "use crate::{rt::slot, clock};\n// crate::cli\nlet s = \"crate::cli // unsafe\";\nlet c = '\"';\ncrate::rpc::x();\nr#\"a \"crate::cli\"#;\n";
    let seen: Vec<(usize, String)> = used(&code(text)).into_iter().map(|(line, module, _)| (line, module)).collect();
    let expected = [(1, "rt"), (1, "clock"), (5, "rpc")].map(|(line, module)| (line, module.to_owned()));
    assert_eq!(seen, expected);
    assert!(!code(text).contains("unsafe"));
    assert_eq!(module_of("crates/arms/src/mock/mod.rs"), "arms");
}
