use super::*;

fn read(text: &str) -> (Tree, Option<Document>) {
    let mut tree = Tree::new();
    let source = tree.add_source("t.xml", text);
    let document = parse(&mut tree, source);
    (tree, document)
}

#[test]
fn a_truncated_file_is_reported_at_its_end_with_the_open_element() {
    for (text, name, opened) in [
        ("<robot>\n<!-- <x> --><link name='a>'>\n<visual/><b></b>\n", "link", 8 + 13),
        ("<robot>\n<link/>\n", "robot", 1),
        ("<robot>\n<link name='a", "link", 9),
        ("<robot>\n<link>\n</li", "link", 9),
    ] {
        let (tree, document) = read(text);
        let found = &tree.diags()[0];
        let what = format!("the file ends inside the element `{name}`");
        assert!(document.is_none() && found.message.contains(&what), "{text:?}: {found:?}");
        assert_eq!(
            (found.at.as_ref().unwrap().range.start, found.also[0].range.start),
            (text.trim_end().len(), opened)
        );
    }
}

#[test]
fn places_prefixes_and_namespaces_are_kept() {
    let text = "<r xmlns:g='http://g' a='1 &amp; 2'>\n <g:x g:y=\"µ\"/></r>";
    let (_, document) = read(text);
    let root = document.unwrap().root;
    let x = root.elements().next().unwrap();
    assert_eq!((x.name.as_str(), x.attributes[0].name.as_str()), ("g:x", "g:y"));
    let place = x.attributes[0].at;
    assert_eq!(&text[place.start as usize..place.end as usize], "µ");
    assert_eq!(root.attribute("a").unwrap().value, "1 & 2");
    assert_eq!(root.attribute("xmlns:g").unwrap().value, "http://g");
    assert!(x.attribute("xmlns:g").is_none());
}

#[test]
fn cdata_and_text_are_distinguished() {
    for (text, expected) in [
        ("<r><![CDATA[a<b]]></r>", vec![Node::CData("a<b".into())]),
        (
            "<r>x&amp;<![CDATA[&amp;]]></r>",
            vec![Node::Text("x&".into(), SourcePos::default()), Node::CData("&amp;".into())],
        ),
        (
            "<r><![CDATA[1]]>y<!--c--></r>",
            vec![
                Node::CData("1".into()),
                Node::Text("y".into(), SourcePos::default()),
                Node::Comment("c".into(), SourcePos::default()),
            ],
        ),
    ] {
        let plain = |node: Node| match node {
            Node::Text(t, _) => Node::Text(t, SourcePos::default()),
            Node::Comment(t, _) => Node::Comment(t, SourcePos::default()),
            other => other,
        };
        let (_, document) = read(text);
        let children: Vec<Node> = document.unwrap().root.children.into_iter().map(plain).collect();
        assert_eq!(children, expected, "{text}");
    }
}

#[test]
fn mistakes_have_places() {
    let (tree, none) = read("<r>\n  <a></b>\n</r>");
    assert!(none.is_none());
    let report = tree.diags()[0].located(&tree);
    assert_eq!((report.line, report.column), (Some(2), Some(6)), "{report:?}");
    let (tree, _) = read("<r><xacro:if value='1'/></r>");
    assert!(tree.diags()[0].hint.as_ref().unwrap().contains("xmlns:xacro"));
    let (tree, _) = read("<!DOCTYPE r [<!ENTITY a 'x'>]><r>&a;</r>");
    assert_eq!(tree.diags().len(), 1);
}

#[test]
fn depth_is_bounded() {
    let deep = |n: usize| format!("{}{}", "<a>".repeat(n), "</a>".repeat(n));
    assert!(read(&deep(MAX_DEPTH)).1.is_some());
    assert!(read(&deep(MAX_DEPTH + 5)).1.is_none());
    assert!(read(&deep(200_000)).1.is_none());
}
