//! xacro against the original: every case of `../shared/xacro` must come to the same XML tree, or fail for the same
//! cause.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use dimos::robot::urdf::Meshes;
use dimos::robot::{Source, load};
use serde_json::Value;

use crate::support::shared;

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

/// Whether two values are equal; the last bit of a number may differ, as it does between two C libraries.
fn same(ours: &str, theirs: &str) -> bool {
    let close = |(a, b): (&str, &str)| match (a.parse::<f64>(), b.parse::<f64>()) {
        _ if a == b => true,
        (Ok(a), Ok(b)) => (a - b).abs() <= f64::EPSILON * b.abs(),
        _ => false,
    };
    let count = |text: &str| text.split_whitespace().count();
    count(ours) == count(theirs) && ours.split_whitespace().zip(theirs.split_whitespace()).all(close)
}

/// The first place where two trees differ.
fn difference(ours: &Tree, theirs: &Tree, path: &str) -> Option<String> {
    let path = format!("{path}/{}", theirs.name);
    let pairs = || ours.attributes.iter().zip(&theirs.attributes);
    let attributes = ours.attributes.len() == theirs.attributes.len()
        && pairs().all(|((name, a), (other, b))| name == other && (a == b || same(a, b)));
    if ours.name != theirs.name || !attributes || ours.text != theirs.text {
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
        ..Source::default()
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
    let Some(root) = shared::shared("xacro") else { return };
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

/// One feature each, with what the original (2.1.1) made of it.
#[test]
fn every_construct_comes_to_what_the_original_makes_of_it() {
    let text = include_str!("../fixtures/xacro/constructs.txt");
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("t.xacro");
    let mut bad = Vec::new();
    let mut count = 0;
    for block in text.split("### ").skip(1) {
        count += 1;
        let (name, rest) = block.split_once('\n').unwrap();
        let (body, expected) = rest.split_once("\n--- \n").unwrap();
        let document = format!("<robot xmlns:xacro=\"http://www.ros.org/wiki/xacro\" name=\"t\">{body}</robot>");
        std::fs::write(&file, document).unwrap();
        let loaded = load(&Source { meshes: Meshes::Ignore, ..Source::new(&file) });
        let ours = loaded.urdf().ok_or_else(|| loaded.render(false));
        let parsed = |text: &str| tree(roxmltree::Document::parse(text).unwrap().root_element());
        let wrong = match (ours, expected.trim().strip_prefix("error: ")) {
            (Err(ours), Some(cause)) => (!ours.contains(cause)).then(|| format!("{cause:?} is not in\n{ours}")),
            (Ok(ours), None) => {
                let difference = difference(&parsed(&ours), &parsed(expected), "");
                let (a, b) = (comments(&ours), comments(expected));
                difference.or_else(|| (a != b).then(|| format!("comments: ours {a:?}, theirs {b:?}")))
            }
            (Ok(ours), Some(cause)) => Some(format!("came to\n{ours}\ninstead of: {cause}")),
            (Err(ours), None) => Some(format!("failed: {ours}")),
        };
        bad.extend(wrong.map(|wrong| format!("{name}: {wrong}")));
    }
    println!("{} of {count} constructs match", count - bad.len());
    assert!(bad.is_empty() && count > 70, "{} of {count} differ\n{}", bad.len(), bad.join("\n"));
}

fn write(folder: &Path, name: &str, body: &str) -> PathBuf {
    let path = folder.join(name);
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    std::fs::write(
        &path,
        format!("<robot xmlns:xacro=\"http://www.ros.org/wiki/xacro\" name=\"t\">\n{body}\n</robot>"),
    )
    .unwrap();
    path
}

fn mistakes(path: &Path) -> String {
    let started = std::time::Instant::now();
    let text = load(&Source { meshes: Meshes::Ignore, ..Source::new(path) }).render(false);
    assert!(started.elapsed().as_secs() < 60, "{path:?} took {:?}", started.elapsed());
    text
}

#[test]
fn files_never_lead_out_of_their_packages() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    write(root, "secret/a.xacro", "<link name='s'/>");
    std::fs::write(root.join("secret/a.yaml"), "a: 1").unwrap();
    std::fs::create_dir_all(root.join("pkg")).unwrap();
    std::fs::write(root.join("pkg/package.xml"), "<package><name>pkg</name></package>").unwrap();
    write(root, "pkg/common/b.xacro", "<link name='b'/>");
    for (body, what) in [
        ("<xacro:include filename='../common/b.xacro'/>", ""),
        ("<xacro:include filename='$(find pkg)/common/b.xacro'/>", ""),
        ("<xacro:include filename='../../secret/a.xacro'/>", "is not in the package of this description"),
        ("<xacro:include filename='$(find pkg)/../secret/a.xacro'/>", "is not in the package of this description"),
        ("<xacro:include filename='/etc/passwd'/>", "is not in the package of this description"),
        (
            "<x a=\"${xacro.load_yaml('../../secret/a.yaml')}\"/><link name='b'/>",
            "is not in the package of this description",
        ),
        ("<xacro:include filename='$(find ..)/secret/a.xacro'/>", "is not a package name"),
    ] {
        let path = write(root, "pkg/urdf/t.xacro", body);
        let found = mistakes(&path);
        assert!(if what.is_empty() { found.is_empty() } else { found.contains(what) }, "{body}: {found}");
    }
}

#[test]
fn mistakes_stand_where_they_were_written_with_the_way_there() {
    let folder = tempfile::tempdir().unwrap();
    write(
        folder.path(),
        "inc.xacro",
        "<xacro:macro name='arm' params='n'>\n  <link name='${n}_${wrong}'/>\n</xacro:macro>",
    );
    let path = write(folder.path(), "t.xacro", "<xacro:include filename='inc.xacro'/>\n<xacro:arm n='a'/>");
    let found = mistakes(&path);
    for what in ["name 'wrong' is not defined", "inc.xacro:3:", "in this call of the macro `arm`", "t.xacro:3:"] {
        assert!(found.contains(what), "{what}\n{found}");
    }
    // What a macro makes wrong is a mistake of the macro's line, too.
    write(
        folder.path(),
        "inc.xacro",
        "<xacro:macro name='arm' params='r'>\n<link name='l'><collision><geometry><sphere radius='${r}'/></geometry></collision></link>\n</xacro:macro>",
    );
    let path = write(folder.path(), "t.xacro", "<xacro:include filename='inc.xacro'/>\n<xacro:arm r='${-1}'/>");
    let found = mistakes(&path);
    for what in ["the radius of this sphere is -1", "inc.xacro:3:", "in this call of the macro `arm`"] {
        assert!(found.contains(what), "{what}\n{found}");
    }
}

#[test]
fn functions_that_are_left_out_are_named() {
    let folder = tempfile::tempdir().unwrap();
    for (expression, what) in [
        ("abs(-1)", "name 'abs' is not defined"),
        ("abs(-1)", "hint: xacro knows it as python.abs"),
        ("sum([1])", "name 'sum' is not defined"),
        ("tuple([1])", "name 'tuple' is not defined"),
        ("zip([1], [2])", "name 'zip' is not defined"),
        ("any([1])", "name 'any' is not defined"),
        ("all([1])", "name 'all' is not defined"),
        ("reversed([1])", "name 'reversed' is not defined"),
        ("isinstance(1, int)", "name 'isinstance' is not defined"),
        ("divmod(7, 2)", "name 'divmod' is not defined"),
        ("set([1])", "name 'set' is not defined"),
        ("enumerate([1])", "enumerate() of Python is not supported"),
        ("filter(None, [1])", "filter() of Python is not supported"),
        ("ord('a')", "ord() of Python is not supported"),
        ("repr(1)", "repr() of Python is not supported"),
        ("cosh(1)", "the function cosh() of Python is not supported"),
        ("python.enumerate([1])", "python.enumerate is not supported; the functions of python are list, dict,"),
        ("math.gcd(4, 6)", "math.gcd is not supported; the functions of math are acos, asin,"),
        ("xacro.nope()", "xacro.nope is not supported; the functions of xacro are load_yaml,"),
        ("'a'.capitalize()", "'str' object has no attribute 'capitalize' that is supported"),
        ("python.set([1]).add(2)", "'set' object has no attribute 'add' that is supported"),
    ] {
        let found = mistakes(&write(folder.path(), "t.xacro", &format!("<a b=\"${{{expression}}}\"/>")));
        assert!(found.contains(what), "{expression}:\n{found}");
    }
}

#[test]
fn a_misspelt_argument_is_reported_with_the_mistake_that_it_causes() {
    let folder = tempfile::tempdir().unwrap();
    let path =
        write(folder.path(), "t.xacro", "<xacro:arg name='limited' default='x'/>\n<a b='${1 / $(arg limited)}'/>");
    let with = |name: &str| {
        let xacro_args = BTreeMap::from([(name.to_owned(), "2".to_owned())]);
        load(&Source { meshes: Meshes::Ignore, xacro_args, ..Source::new(&path) }).render(false)
    };
    let found = with("limted");
    assert!(found.contains("error") && found.contains("there is no xacro:arg `limted`"), "{found}");
    assert!(found.contains("did you mean `limited`?"), "{found}");
    assert!(!with("other").contains("`other`"), "files after the mistake may declare it");
}

#[test]
fn work_is_bounded() {
    let folder = tempfile::tempdir().unwrap();
    let doubling: String =
        (1..60).map(|i| format!("<xacro:property name='p{i}' value='${{p{}}}${{p{}}}'/>", i - 1, i - 1)).collect();
    let own = "<xacro:include filename='t.xacro'/>";
    for (body, what) in [
        ("<xacro:macro name='m'><xacro:m/></xacro:macro><xacro:m/>".to_owned(), "nested deeper than"),
        ("<xacro:macro name='m'><a/><xacro:m/><xacro:m/></xacro:macro><xacro:m/>".to_owned(), "nested deeper than"),
        (
            "<xacro:macro name='m' params='n'><xacro:if value='${n}'><xacro:m n='${n-1}'/><xacro:m n='${n-1}'/></xacro:if></xacro:macro><xacro:m n='50'/>".to_owned(),
            "too many steps",
        ),
        (own.to_owned(), "includes are nested deeper than"),
        (format!("<xacro:property name='p0' value='xxxxxxxxxx'/>{doubling}<a b='${{p59}}'/>"), "longer than"),
        ("<a b=\"${'x'*10**9}\"/>".to_owned(), "too long"),
        ("<a b='${[0]*10**9}'/>".to_owned(), "too long"),
        ("<a b='${len(list(range(10**12)))}'/>".to_owned(), "too long"),
        ("<a b='${2**10**10}'/>".to_owned(), "too large"),
        ("<a b='${len(python.set(list(range(10**6))))}'/>".to_owned(), "too many steps"),
        ("<a b='${len([1 for a in range(10000) for b in range(10000)])}'/>".to_owned(), "too"),
        (format!("<a b='${{{}1{}}}'/>", "(".repeat(500), ")".repeat(500)), "nested too deeply"),
        (format!("<a b='${{1{}}}'/>", "+1".repeat(5000)), "more than"),
    ] {
        let path = write(folder.path(), "t.xacro", &body);
        let found = mistakes(&path);
        assert!(found.contains(what) && !found.contains("bug in this program"), "{what}: {:.300}\n{found:.1500}", body);
    }
}

/// Changed bytes of real files must not bring the program down, nor take long.
#[test]
fn damaged_files_are_refused_quietly() {
    let folder = tempfile::tempdir().unwrap();
    let fixtures = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/xacro/synthetic");
    let names = ["arith.xacro", "props.xacro", "macros.xacro", "args.xacro", "comments.xacro"];
    std::fs::create_dir_all(folder.path().join("inc")).unwrap();
    for name in ["params.yaml", "inc/part.xacro"] {
        std::fs::copy(fixtures.join(name), folder.path().join(name)).unwrap();
    }
    let mut state = 11_u64;
    let mut random = move || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as usize
    };
    let urdf = dimos::robot::builtin::text("xarm6_gripper").unwrap().to_owned();
    let mut files: Vec<String> = names.iter().map(|n| std::fs::read_to_string(fixtures.join(n)).unwrap()).collect();
    files.push(urdf);
    let pieces =
        ["${", "}", "$(", ")", "'", "[", "]", "*", "-", "1e999", "xacro:", "/>", "<", ">", "^", "**", "0", "nan", "if"];
    for round in 0..600 {
        let mut bytes = files[round % files.len()].clone().into_bytes();
        for _ in 0..1 + random() % 3 {
            let at = random() % bytes.len();
            match random() % 4 {
                0 => bytes[at] = random() as u8,
                1 => drop(bytes.drain(at..(at + random() % 40).min(bytes.len()))),
                2 => drop(bytes.splice(at..at, pieces[random() % pieces.len()].bytes())),
                _ => {
                    let from = random() % bytes.len();
                    let piece = bytes[from..(from + random() % 60).min(bytes.len())].to_vec();
                    bytes.splice(at..at, piece);
                }
            }
            if bytes.is_empty() {
                bytes.push(b'<');
            }
        }
        let path = folder.path().join(if round % files.len() == files.len() - 1 { "t.urdf" } else { "t.xacro" });
        std::fs::write(&path, &bytes).unwrap();
        let found = mistakes(&path);
        assert!(!found.contains("bug in this program"), "{}\n{found}", String::from_utf8_lossy(&bytes));
    }
}
