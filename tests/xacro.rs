//! xacro against the original: every case of `../shared/xacro` must come to the same XML tree, or fail for the same
//! cause.

#[path = "support/shared.rs"]
mod support;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use dimos::robot::urdf::Meshes;
use dimos::robot::{Source, load};
use serde_json::Value;

/// An element as it is compared: name, attributes in order, texts and elements inside.
#[derive(Debug, PartialEq)]
struct Tree {
    name: String,
    attributes: BTreeMap<String, String>,
    text: Vec<String>,
    elements: Vec<Tree>,
}

fn tree(node: roxmltree::Node<'_, '_>) -> Tree {
    let words = |text: &str| text.split_whitespace().collect::<Vec<_>>().join(" ");
    let full = |ns: Option<&str>, name: &str| ns.map_or(name.to_owned(), |ns| format!("{{{ns}}}{name}"));
    Tree {
        name: full(node.tag_name().namespace(), node.tag_name().name()),
        attributes: node.attributes().map(|a| (full(a.namespace(), a.name()), a.value().to_owned())).collect(),
        text: node
            .children()
            .filter(|c| c.is_text())
            .map(|c| words(c.text().unwrap()))
            .filter(|t| !t.is_empty())
            .collect(),
        elements: node.children().filter(|c| c.is_element()).map(tree).collect(),
    }
}

/// The comments of a file without the banner.
fn comments(text: &str) -> Vec<String> {
    let xml = roxmltree::Document::parse(text).unwrap();
    let all = xml.descendants().filter(|n| n.is_comment()).map(|n| n.text().unwrap().to_owned());
    all.filter(|c| !c.starts_with(" =====") && !c.starts_with(" |    ")).collect()
}

/// The first place where two trees differ.
fn difference(ours: &Tree, theirs: &Tree, path: &str) -> Option<String> {
    let path = format!("{path}/{}", theirs.name);
    if ours.name != theirs.name || ours.attributes != theirs.attributes || ours.text != theirs.text {
        let show = |t: &Tree| format!("<{} {:?}> {:?}", t.name, t.attributes, t.text);
        return Some(format!("{path}:\n  ours   {}\n  theirs {}", show(ours), show(theirs)));
    }
    if ours.elements.len() != theirs.elements.len() {
        let names = |t: &Tree| t.elements.iter().map(|e| e.name.clone()).collect::<Vec<_>>();
        return Some(format!("{path}: ours {:?}, theirs {:?}", names(ours), names(theirs)));
    }
    ours.elements.iter().zip(&theirs.elements).find_map(|(a, b)| difference(a, b, &path))
}

/// What a message must say for the original's message.
fn cause(error: &str) -> &str {
    for cause in [
        "which is not a boolean expression",
        "circular variable definition: a -> b -> a",
        "division by zero",
        "Use of invalid name(s)",
        "Invalid parameter \"q\"",
        "No such file or directory",
        "Undefined parameters [p]",
        "invalid syntax",
        "Undefined substitution argument nope",
        "name 'nope' is not defined",
        "unknown macro name: xacro:nope",
    ] {
        if error.contains(cause) {
            return cause;
        }
    }
    panic!("a new cause: {error}");
}

fn expand(case: &Value, root: &Path) -> Result<String, String> {
    let args = case["args"].as_object().unwrap();
    let packages = std::fs::read_dir(root.join("pkgs")).unwrap().map(|entry| {
        let path = entry.unwrap().path();
        (path.file_name().unwrap().to_string_lossy().into_owned(), path)
    });
    let source = Source {
        path: root.join(case["file"].as_str().unwrap()),
        packages: packages.collect(),
        xacro_args: args.iter().map(|(k, v)| (k.clone(), v.as_str().unwrap().to_owned())).collect(),
        meshes: Meshes::Ignore,
    };
    let loaded = load(&source);
    loaded.urdf().ok_or_else(|| loaded.render(false))
}

fn check(case: &Value, root: &Path) -> Result<(), String> {
    let ours = expand(case, root);
    if let Some(error) = case["error"].as_str() {
        let cause = cause(error);
        return match ours {
            Err(text) if text.contains(cause) => Ok(()),
            Err(text) => Err(format!("{cause:?} is not in\n{text}")),
            Ok(_) => Err(format!("came to something, instead of: {error}")),
        };
    }
    let theirs = std::fs::read_to_string(root.join(case["out"].as_str().unwrap())).unwrap();
    let theirs = theirs.replace("@ROOT@", &root.display().to_string());
    let ours = ours?;
    let parsed = |text: &str| tree(roxmltree::Document::parse(text).unwrap().root_element());
    if let Some(difference) = difference(&parsed(&ours), &parsed(&theirs), "") {
        return Err(difference);
    }
    let (a, b) = (comments(&ours), comments(&theirs));
    if a == b { Ok(()) } else { Err(format!("comments: ours {a:#?}, theirs {b:#?}")) }
}

#[test]
fn every_case_of_the_original_matches() {
    let Some(root) = support::shared("xacro") else { return };
    let root: PathBuf = std::path::absolute(root).unwrap();
    let cases: Vec<Value> = serde_json::from_str(&std::fs::read_to_string(root.join("cases.json")).unwrap()).unwrap();
    assert!(cases.len() >= 45, "{} cases", cases.len());
    let results: Vec<_> = cases.iter().map(|case| (case["name"].as_str().unwrap(), check(case, &root))).collect();
    let good = results.iter().filter(|(_, r)| r.is_ok()).count();
    println!("{good} of {} cases match", cases.len());
    let bad: Vec<String> =
        results.iter().filter_map(|(name, r)| r.as_ref().err().map(|e| format!("{name}: {e}"))).collect();
    assert!(bad.is_empty(), "{good} of {} cases match\n{}", cases.len(), bad.join("\n"));
}
