//! The located YAML reader: caps, healing, merging. What blueprints make of it is in `blueprints.rs`.

use std::fmt::Write;

use dimos::yaml::{Located, MAX_BYTES, MergeRules, Missing, NOWHERE, Raw, Tree, merge, read, render, set};
use serde::Deserialize;

/// Reads a text and gives the value with all mistakes, one `line:column message` each.
fn read_text<T: serde::de::DeserializeOwned>(text: &str) -> (Option<T>, Vec<String>) {
    let mut tree = Tree::new();
    let value = parse(&mut tree, text).and_then(|root| read::<T>(&mut tree, root, Missing::Report).0);
    (value, mistakes(&tree))
}

fn parse(tree: &mut Tree, text: &str) -> Option<u32> {
    let source = tree.add_bytes("test.yaml", text.as_bytes())?;
    tree.parse(source)
}

fn mistakes(tree: &Tree) -> Vec<String> {
    let line = |d: &dimos::yaml::Diag| {
        let report = d.located(tree);
        format!("{}:{} {}", report.line.unwrap(), report.column.unwrap(), report.message)
    };
    tree.diags().iter().map(line).collect()
}

fn only_mistake(text: &str) -> String {
    let (_, mistakes) = read_text::<serde_json::Value>(text);
    assert_eq!(mistakes.len(), 1, "{mistakes:?}");
    mistakes[0].clone()
}

#[derive(Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
struct Outer {
    name: String,
    #[serde(default)]
    even: Option<Even>,
    #[serde(default)]
    point: [f64; 3],
    #[serde(default)]
    inner: Vec<Inner>,
}

#[derive(Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
struct Inner {
    id: u8,
    shape: Shape,
}

#[derive(Debug, PartialEq, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
enum Shape {
    Round,
    Box(f64),
    Cone { height: f64 },
}

#[derive(Debug, PartialEq, Deserialize)]
#[serde(try_from = "u32")]
struct Even(u32);

impl TryFrom<u32> for Even {
    type Error = String;
    fn try_from(n: u32) -> Result<Self, String> {
        if n.is_multiple_of(2) { Ok(Self(n)) } else { Err(format!("{n} is odd\nhint: write an even number")) }
    }
}

#[test]
fn reads_what_is_right() {
    let text = "name: x\neven: 0x10\npoint: [1, 2.5, -3e-1]\ninner:\n- {id: 1, shape: round}\n- {id: 2, shape: {box: 2}}\n- id: 3\n  shape: {cone: {height: 1}}\n";
    let (value, mistakes) = read_text::<Outer>(text);
    assert!(mistakes.is_empty(), "{mistakes:?}");
    let value = value.unwrap();
    assert_eq!((value.even, value.point), (Some(Even(16)), [1.0, 2.5, -0.3]));
    let shapes: Vec<Shape> = value.inner.into_iter().map(|i| i.shape).collect();
    assert_eq!(shapes, [Shape::Round, Shape::Box(2.0), Shape::Cone { height: 1.0 }]);
}

#[test]
fn every_mistake_is_found_at_its_place() {
    let text = "even: 3\npoint: [1, x, .nan]\nextra: 1\ninner:\n- {id: 256, shape: round}\n- {id: 1, shape: {cone: {hight: 1}}}\n- {id: 2, shape: rond}\n- 5\n";
    let (_, mut found) = read_text::<Outer>(text);
    found.sort();
    let mut want = [
        "1:1 the key `name` is missing",
        "1:7 `even`: 3 is odd",
        "2:12 `point[1]`: expected a number, found the text `x`",
        "2:15 `point[2]`: expected a finite number, found the number `.nan`",
        "3:1 unknown key `extra`",
        "5:8 `id`: expected a whole number from 0 to 255, found the number `256`",
        "6:26 unknown key `hight`",
        "7:18 `shape`: `rond` is not one of round, box, cone",
        "8:3 `inner[3]`: expected a group of keys, found the number `5`",
    ]
    .map(str::to_owned);
    want.sort();
    assert_eq!(found, want);
}

#[test]
fn a_misspelt_key_is_not_missing_too() {
    #[derive(Debug, Deserialize)]
    #[serde(deny_unknown_fields)]
    #[allow(dead_code, reason = "read by deserialization only")]
    struct Two {
        address: String,
        port: u16,
    }
    assert_eq!(read_text::<Two>("{adress: x, prot: 1}").1, ["1:2 unknown key `adress`", "1:13 unknown key `prot`"]);
    let unrelated = read_text::<Two>("{colour: x, port: 1}").1;
    assert_eq!(unrelated, ["1:2 unknown key `colour`", "1:1 the key `address` is missing"]);
}

#[test]
fn what_was_lost_can_be_asked_for() {
    let mut tree = Tree::new();
    let root = parse(&mut tree, "{name: x, even: 3, inner: [{id: 1, shape: round}, {id: x, shape: round}]}").unwrap();
    let (value, lost) = read::<Outer>(&mut tree, root, Missing::Report);
    assert_eq!(value.unwrap().even, None);
    assert!(lost.key(root, "even") && !lost.key(root, "name"));
    let inner = tree.get(root, "inner").unwrap();
    let items = tree.items(inner).to_vec();
    assert!(lost.contains(inner) && !lost.contains(items[0]) && lost.contains(items[1]));
}

#[test]
fn places_survive_and_are_nowhere_without_a_file() {
    let mut tree = Tree::new();
    let root = parse(&mut tree, "a: [1, {b: two}]").unwrap();
    let (value, _) = read::<std::collections::BTreeMap<String, Vec<Raw>>>(&mut tree, root, Missing::Report);
    let raw = value.unwrap()["a"][1].clone();
    assert_eq!(raw.value, serde_json::json!({"b": "two"}));
    assert_eq!(tree.label(raw.at).range, 7..15);
    let by_hand: Located<u8> = serde_json::from_str("7").unwrap();
    assert_eq!((by_hand.at, by_hand.value), (NOWHERE, 7));
}

#[test]
fn caps_have_clear_errors() {
    let deep = format!("a: {}{}", "[".repeat(40), "]".repeat(40));
    assert_eq!(only_mistake(&deep), "1:35 lists and groups are nested more than 32 levels deep");

    let big = format!("a: {}", "x".repeat(MAX_BYTES));
    assert_eq!(only_mistake(&big), "1:1 the file is larger than 1 MiB");

    let mut bomb = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n".to_owned();
    for i in 1..12 {
        let _ = writeln!(bomb, "a{i}: &a{i} [{}]", vec![format!("*a{}", i - 1); 10].join(", "));
    }
    assert!(only_mistake(&bomb).contains("more than 200000 values"), "{}", only_mistake(&bomb));

    let mut ladder = "a0: &a0 [x]\n".to_owned();
    for i in 1..60 {
        let _ = writeln!(ladder, "a{i}: &a{i} [*a{}]", i - 1);
    }
    assert!(only_mistake(&ladder).contains("nested more than"), "depth counts through aliases");

    assert_eq!(only_mistake("a: &a [*a]"), "1:8 this alias refers to a value that contains it");
    assert_eq!(only_mistake("a: *b"), "1:4 no value above has the anchor `b`");
    assert_eq!(only_mistake("a: 1\n---\nb: 2\n"), "2:1 a second document starts here");
    assert_eq!(only_mistake("a: 1\nb: \0\n"), "2:4 the file has a NUL byte here");
}

#[test]
fn bytes_that_are_no_text_are_refused() {
    let mut tree = Tree::new();
    assert_eq!(tree.add_bytes("x", b"a: 1\nb: \xff"), None);
    assert_eq!(mistakes(&tree), ["2:4 the file has bytes that are not UTF-8 here"]);
    let mut tree = Tree::new();
    let utf16: Vec<u8> = "a: 1".encode_utf16().flat_map(u16::to_le_bytes).collect();
    assert_eq!(tree.add_bytes("x", &utf16), None);
    assert_eq!(mistakes(&tree).len(), 1);
}

#[test]
fn sixty_thousand_duplicate_keys_take_no_longer_each_than_a_few() {
    // Processor time of this thread, so that nothing else on the machine counts.
    let time = |keys: usize| {
        let text = (0..keys).fold(String::new(), |text, i| text + &format!("k{}: 1\n", i % (keys / 2)));
        let began = dimos::rt::host::thread_cpu_time();
        let (_, mistakes) = read_text::<serde_json::Value>(&text);
        assert_eq!(mistakes.len(), 100, "the list of mistakes is bounded");
        (dimos::rt::host::thread_cpu_time() - began).as_secs_f64()
    };
    let (few, many) = (time(6_000), time(60_000));
    // Ten times the keys: a search through all of them for each would take a hundred times as long.
    assert!(many < 40.0 * few, "{few} s, {many} s");
}

#[test]
fn a_file_full_of_unknown_keys_ends() {
    let text: String = (0..20_000).map(|i| format!("k{i}: 1\n")).collect();
    let (value, mistakes) = read_text::<Outer>(&text);
    assert_eq!((value, mistakes.len()), (None, 100));
}

const RULES: MergeRules = MergeRules { by_id: &[("arms", "id")], whole: &["pose"] };

fn merged(base: &str, over: &str, sets: &[&str]) -> (serde_json::Value, Vec<String>) {
    let mut tree = Tree::new();
    let base = parse(&mut tree, base).unwrap();
    let over = parse(&mut tree, over).unwrap();
    let root = merge(&mut tree, base, over, &RULES);
    for argument in sets {
        set(&mut tree, root, argument, &RULES);
    }
    let (value, _) = read::<serde_json::Value>(&mut tree, root, Missing::Report);
    (value.unwrap(), mistakes(&tree))
}

#[test]
fn merging_goes_by_key_and_by_id() {
    let base = "{rate: 1, keep: 2, pose: {x: 1, y: 2}, list: [1, 2], arms: [{id: a, n: 1}, {id: b, n: 2}]}";
    let over = "{rate: 9, pose: {x: 5}, list: [3], arms: [{id: b, m: 3}, {id: c}]}";
    let want = serde_json::json!({
        "rate": 9, "keep": 2, "pose": {"x": 5}, "list": [3],
        "arms": [{"id": "a", "n": 1}, {"id": "b", "n": 2, "m": 3}, {"id": "c"}],
    });
    assert_eq!(merged(base, over, &[]), (want, vec![]));
}

#[test]
fn an_id_given_twice_in_one_file_stays_twice() {
    let (value, _) = merged("arms: [{id: a}]", "arms: [{id: a}, {id: a}]", &[]);
    assert_eq!(value["arms"].as_array().unwrap().len(), 2);
}

#[test]
fn set_changes_one_value() {
    let base = "{rate: 1, list: [1, 2], arms: [{id: a, n: 1}], empty: }";
    let sets = ["rate=2.5", "list.1=[x]", "arms.a.n=yes", "arms.a.new.deep={k: v}", "empty.x=", "text='a=b: c'"];
    let (value, mistakes) = merged("{}", base, &sets);
    assert!(mistakes.is_empty(), "{mistakes:?}");
    let want = serde_json::json!({
        "rate": 2.5, "list": [1, ["x"]], "arms": [{"id": "a", "n": "yes", "new": {"deep": {"k": "v"}}}],
        "empty": {"x": null}, "text": "a=b: c",
    });
    assert_eq!(value, want);
}

#[test]
fn set_says_what_is_wrong_with_it() {
    let base = "{rate: 1, list: [1, 2], arms: [{id: arm}]}";
    for (argument, want) in [
        ("rate", "1:1 expected `path=value`"),
        ("=1", "1:1 expected `path=value`"),
        ("rate.x=1", "1:6 `rate` is a single value without keys"),
        ("list.7=1", "1:6 `list` has no entry `7`; it has 2"),
        ("arms.amr.n=1", "1:6 no entry of `arms` has the id `amr`"),
    ] {
        assert_eq!(merged("{}", base, &[argument]).1, [want], "{argument}");
    }
    let (_, mistakes) = merged("{}", base, &["rate=[1"]);
    assert!(mistakes[0].contains("YAML syntax"), "{mistakes:?}");
}

#[test]
fn control_characters_do_not_reach_the_terminal() {
    let mut tree = Tree::new();
    let root = parse(&mut tree, "\"a\\e[31mb\": 1\nname: \"\\u202e x\"\n").unwrap();
    read::<Outer>(&mut tree, root, Missing::Report);
    for diag in tree.diags() {
        assert!(!render(&tree, diag, false).contains(['\x1b', '\u{202e}']), "{diag:?}");
    }
}

#[test]
fn long_lines_are_not_drawn() {
    let text = format!("name: x\nextra: {}\n", "y".repeat(100_000));
    let mut tree = Tree::new();
    let root = parse(&mut tree, &text).unwrap();
    read::<Outer>(&mut tree, root, Missing::Report);
    let drawn = render(&tree, &tree.diags()[0], false);
    assert!(drawn.len() < 1000 && drawn.contains("test.yaml:2"), "{drawn}");
}
