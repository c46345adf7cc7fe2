//! One mistake gives one report, at its place: every key of a blueprint with all sections is misspelt in turn, every
//! value is replaced by one that is wrong everywhere. What follows from a mistake must not be reported as another.

use std::path::{Path, PathBuf};

use dimos::blueprint::{Found, Loaded, Overrides, SearchPath, Source, load_from};
use dimos::yaml::{Kind, NodeId, Tree};

use crate::support::fake_arms;

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/blueprints")
}

/// Loads a text in the place of the fixture, so that its paths lead to what is there.
fn load(text: &str) -> Loaded {
    let source = Source::Path(folder().join("full.yaml"));
    let found = Found { name: "one".to_owned(), source, bytes: text.as_bytes().to_vec() };
    load_from(&SearchPath::default(), &found, &Overrides::default(), &fake_arms::registry())
}

/// `full.yaml` with its include written out.
fn good() -> String {
    let folder = folder();
    let search = SearchPath { folders: vec![folder.clone()] };
    let found = search.find(folder.join("full.yaml").to_str().unwrap()).unwrap();
    let loaded = load_from(&search, &found, &Overrides::default(), &fake_arms::registry());
    assert_eq!(loaded.render(false), "");
    loaded.blueprint.unwrap().source_yaml
}

/// Paths below which keys are free.
const FREE: [&str; 7] =
    ["planner.world", "xacro_args", "package_paths", "named_poses", "collision_shapes", "assets", "share.users"];

struct Place {
    path: String,
    node: NodeId,
}

/// All keys and values with their paths.
fn places(tree: &Tree, node: NodeId, path: &str, keys: &mut Vec<Place>, values: &mut Vec<Place>) {
    match &tree.node(node).unwrap().kind {
        Kind::Scalar { .. } => {}
        Kind::Seq(items) => {
            for item in items {
                values.push(Place { path: format!("{path}[]"), node: *item });
                places(tree, *item, path, keys, values);
            }
        }
        Kind::Map(entries) => {
            for (key, value) in entries {
                let inner = format!("{path}.{}", tree.text(*key).unwrap());
                keys.push(Place { path: path.to_owned(), node: *key });
                values.push(Place { path: inner.clone(), node: *value });
                places(tree, *value, &inner, keys, values);
            }
        }
    }
}

fn all_places(text: &str) -> (Tree, Vec<Place>, Vec<Place>) {
    let mut tree = Tree::new();
    let source = tree.add_source("one", text);
    let root = tree.parse(source).unwrap();
    let (mut keys, mut values) = (Vec::new(), Vec::new());
    places(&tree, root, "", &mut keys, &mut values);
    (tree, keys, values)
}

fn line_and_column(text: &str, at: usize) -> (usize, usize) {
    let before = &text[..at];
    (before.matches('\n').count() + 1, at - before.rfind('\n').map_or(0, |i| i + 1) + 1)
}

/// Checks that a changed text has exactly one report, at `at`.
fn one_report(changed: &str, at: usize, what: &str) {
    let loaded = load(changed);
    let found: Vec<_> = loaded.reports().iter().map(|r| (r.line.unwrap(), r.column.unwrap())).collect();
    assert_eq!(found, [line_and_column(changed, at)], "{what}\n{}", loaded.render(false));
}

#[test]
fn a_misspelt_key_gives_one_report() {
    let text = good();
    let (tree, keys, _) = all_places(&text);
    let mut tried = 0;
    for Place { path, node } in keys {
        if FREE.iter().any(|free| path.ends_with(free)) || path.contains("world") {
            continue;
        }
        let range = tree.node(node).unwrap().range.clone();
        let key = &text[range.clone()];
        let mut letters: Vec<char> = key.chars().collect();
        let last = letters.pop().unwrap();
        letters.extend([last, last]);
        let slip: String = letters.into_iter().collect();
        let changed = format!("{}{slip}{}", &text[..range.start], &text[range.end..]);
        one_report(&changed, range.start, &format!("`{key}` in {path} written as `{slip}`"));
        tried += 1;
    }
    assert!(tried > 60, "{tried}");
}

#[test]
fn a_wrong_value_gives_one_report() {
    let text = good();
    let (tree, _, values) = all_places(&text);
    let mut tried = 0;
    for Place { path, node } in values {
        if path.contains("xacro_args.") {
            continue;
        }
        let range = tree.node(node).unwrap().range.clone();
        let block = text[range.clone()].contains('\n');
        // A block is replaced in place, indented below its key.
        let changed = format!("{}.nan{}", &text[..range.start], &text[range.end..]);
        one_report(&changed, range.start, &format!("{path} replaced (block: {block})"));
        tried += 1;
    }
    assert!(tried > 100, "{tried}");
}

#[test]
fn a_missing_line_gives_no_riddles() {
    // Without any one of its lines the file may be fine or wrong; when it is wrong, every report has a hint.
    let text = good();
    let lines: Vec<&str> = text.lines().collect();
    for skip in 0..lines.len() {
        let changed: Vec<&str> = lines.iter().enumerate().filter(|(i, _)| *i != skip).map(|(_, l)| *l).collect();
        let loaded = load(&changed.join("\n"));
        for report in loaded.reports() {
            assert!(report.hint.is_some(), "without {:?}: {}", lines[skip], report.message);
        }
    }
}
