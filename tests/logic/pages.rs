//! The pages refer only to what exists: links and their anchors, the tests of each fault in `docs/faults.md`, commands
//! and blueprints.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// All files below a directory of the checkout whose names end so, by their paths from its root.
fn files(directory: &str, ending: &str) -> BTreeMap<String, String> {
    let mut found = BTreeMap::new();
    let mut open = vec![root().join(directory)];
    while let Some(directory) = open.pop() {
        for entry in std::fs::read_dir(directory).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                open.push(path);
            } else if path.to_str().is_some_and(|p| p.ends_with(ending)) {
                let name = path.strip_prefix(root()).unwrap().to_str().unwrap().to_owned();
                found.insert(name, std::fs::read_to_string(&path).unwrap());
            }
        }
    }
    found
}

fn pages() -> BTreeMap<String, String> {
    let mut pages = files("docs", ".md");
    pages.insert("README.md".into(), std::fs::read_to_string(root().join("README.md")).unwrap());
    pages
}

/// The lines of a page outside of its code blocks.
fn prose(page: &str) -> impl Iterator<Item = &str> {
    let mut code = false;
    page.lines().filter(move |line| {
        let fence = line.starts_with("```");
        code ^= fence;
        !code && !fence
    })
}

/// The anchors that GitHub makes of a page's headings.
fn anchors(page: &str) -> BTreeSet<String> {
    let heading = |line: &str| line.starts_with('#').then(|| line.trim_start_matches('#').trim().to_lowercase());
    let kept = |c: char| match c {
        ' ' => Some('-'),
        c if c.is_alphanumeric() || c == '-' || c == '_' => Some(c),
        _ => None,
    };
    prose(page).filter_map(heading).map(|text| text.chars().filter_map(kept).collect()).collect()
}

/// The targets of a page's links.
fn links(page: &str) -> Vec<String> {
    let text = prose(page).collect::<Vec<_>>().join("\n");
    text.split("](").skip(1).filter_map(|rest| Some(rest.split_once(')')?.0.to_owned())).collect()
}

#[test]
fn every_link_leads_to_a_file_and_a_heading() {
    let pages = pages();
    let mut wrong = Vec::new();
    let mut checked = 0;
    for (name, page) in &pages {
        for link in links(page).into_iter().filter(|link| !link.contains("://")) {
            checked += 1;
            let (path, anchor) =
                link.split_once('#').map_or((link.as_str(), None), |(path, anchor)| (path, Some(anchor)));
            let target: PathBuf = match path {
                "" => root().join(name),
                path => root().join(name).parent().unwrap().join(path),
            };
            let Ok(target) = target.canonicalize() else {
                wrong.push(format!("{name}: {link}: no such file"));
                continue;
            };
            let Some(anchor) = anchor else { continue };
            let text = std::fs::read_to_string(&target).unwrap_or_default();
            if !anchors(&text).contains(anchor) {
                wrong.push(format!("{name}: {link}: no such heading"));
            }
        }
    }
    assert!(checked > 60, "links are not found: {checked}");
    assert!(wrong.is_empty(), "{wrong:#?}");
}

/// The fault ids that begin the name of a test function: `f08_f09_…` has two.
fn ids(function: &str) -> impl Iterator<Item = String> {
    let number =
        |word: &&str| word.len() == 3 && word.starts_with('f') && word[1..].bytes().all(|b| b.is_ascii_digit());
    function.split('_').take_while(number).map(str::to_uppercase)
}

/// Every function name in a source file.
fn functions(text: &str) -> impl Iterator<Item = &str> {
    text.lines().filter_map(|line| line.trim_start().strip_prefix("fn ")?.split(['(', '<']).next())
}

#[test]
fn every_fault_has_its_row_and_every_test_of_a_fault_is_in_it() {
    let mut sources = files("src", ".rs");
    sources.append(&mut files("crates", ".rs"));
    sources.append(&mut files("tests", ".rs"));
    sources.append(&mut files("fuzz", ".rs"));
    let mut tested: BTreeMap<String, BTreeSet<&str>> = BTreeMap::new();
    for (path, text) in &sources {
        for id in functions(text).flat_map(ids) {
            tested.entry(id).or_default().insert(path);
        }
    }
    let page = std::fs::read_to_string(root().join("docs/faults.md")).unwrap();
    let rows: Vec<Vec<&str>> = page
        .lines()
        .filter(|line| line.starts_with("| F"))
        .map(|line| line.split(" | ").map(|cell| cell.trim_matches(['|', ' '])).collect())
        .collect();
    let expected: Vec<String> = (1..=rows.len()).map(|number| format!("F{number:02}")).collect();
    assert_eq!(rows.iter().map(|row| row[0]).collect::<Vec<_>>(), expected, "ids in order, none left out");
    assert!(rows.len() >= 36);
    let mut wrong = Vec::new();
    for row in rows {
        let named: Vec<&str> = row[3].split('`').skip(1).step_by(2).collect();
        if named.is_empty() {
            wrong.push(format!("{}: no test", row[0]));
        }
        let whole: BTreeSet<&str> = named.iter().copied().filter(|name| !name.contains("::")).collect();
        let found = tested.remove(row[0]).unwrap_or_default();
        if whole != found {
            wrong.push(format!("{}: the page names {whole:?}, its tests are in {found:?}", row[0]));
        }
        for (path, function) in named.iter().filter_map(|name| name.split_once("::")) {
            if !sources.get(path).is_some_and(|text| functions(text).any(|f| f == function)) {
                wrong.push(format!("{}: no test {function} in {path}", row[0]));
            }
        }
    }
    wrong.extend(tested.iter().map(|(id, paths)| format!("{id}: in {paths:?}, without a row")));
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn every_way_in_has_a_test_that_exists_or_says_that_nothing_bars_it() {
    let mut sources = files("src", ".rs");
    sources.append(&mut files("crates", ".rs"));
    sources.append(&mut files("tests", ".rs"));
    let page = std::fs::read_to_string(root().join("docs/threat-model.md")).unwrap();
    let rows: Vec<&str> = page.lines().filter(|line| line.starts_with("| ")).skip(1).collect();
    assert!(rows.len() >= 14, "{rows:?}");
    let exists = |name: &str| {
        let (path, function) = name.split_once("::").unwrap_or((name, ""));
        sources.get(path).is_some_and(|text| functions(text).any(|f| f == function))
    };
    let wrong = |row: &&str| {
        let tests = row.trim_end_matches(" |").rsplit(" | ").next().unwrap_or_default();
        let named: Vec<&str> = tests.split('`').skip(1).step_by(2).collect();
        tests != "nothing bars it" && (named.is_empty() || !named.into_iter().all(exists))
    };
    let wrong: Vec<&str> = rows.into_iter().filter(wrong).collect();
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn f30_only_the_clock_reads_the_wall_clock() {
    let readers: Vec<String> = files("src", ".rs")
        .into_iter()
        .chain(files("crates", ".rs"))
        .filter(|(_, text)| ["SystemTime::now", "CLOCK_REALTIME", "ClockId::Realtime"].iter().any(|t| text.contains(t)))
        .map(|(path, _)| path)
        .collect();
    assert_eq!(readers, ["crates/core/src/clock.rs"]);
}

/// The command lines of a page, and whether each is part of a sentence: those of its code blocks and in backticks.
fn commands(page: &str) -> Vec<(String, bool)> {
    let mut code = false;
    let blocks = page.lines().filter(|line| {
        let fence = line.starts_with("```");
        code ^= fence;
        code && !fence
    });
    let blocks = blocks.flat_map(|line| line.split(" #").next().unwrap_or_default().split("&&").map(str::to_owned));
    let text = prose(page).collect::<Vec<_>>().join("\n").replace('\n', " ");
    let inline = text.split('`').skip(1).step_by(2).map(str::to_owned);
    let all = blocks.map(|line| (line, false)).chain(inline.map(|line| (line, true)));
    // A diagram lists verbs: `dimos run, move`.
    let is_command = |line: &str| line.starts_with("dimos ") && !line.split(' ').any(|word| word.ends_with(','));
    all.map(|(line, said)| (line.trim().to_owned(), said)).filter(|(line, _)| is_command(line)).collect()
}

/// Words as a shell splits them.
fn words(line: &str) -> Vec<String> {
    let (mut words, mut quote) = (vec![String::new()], None);
    for c in line.chars() {
        match quote {
            Some(open) if c == open => quote = None,
            None if c == '\'' || c == '"' => quote = Some(c),
            None if c == ' ' => words.push(String::new()),
            _ => words.last_mut().unwrap().push(c),
        }
    }
    words.into_iter().filter(|word| !word.is_empty()).collect()
}

/// Every command that a page shows is understood. One with a placeholder is left to the reader; one in a sentence may
/// lack arguments, but for those of the README.
#[test]
fn every_command_of_a_page_is_understood() {
    let (mut wrong, mut seen) = (Vec::new(), 0);
    for (page, text) in pages().into_iter().filter(|(page, _)| !page.starts_with("docs/decisions")) {
        for (line, said) in commands(&text) {
            let words = words(&line);
            let is_placeholder = |word: &String| {
                word.contains(['…', '|', '[', '<', '>']) && !word.contains('=')
                    || ["X", "Q", "TIME", "PORT", "WIDTH", "N"].contains(&word.as_str())
            };
            if words.iter().any(is_placeholder) || words.iter().any(|word| word == "2>&1") {
                continue;
            }
            seen += 1;
            use clap::error::ErrorKind::*;
            match dimos::cli::command().try_get_matches_from(&words).map_err(|error| (error.kind(), error)) {
                Ok(_) | Err((DisplayHelp | DisplayVersion | DisplayHelpOnMissingArgumentOrSubcommand, _)) => {}
                Err((MissingRequiredArgument | MissingSubcommand, _)) if said && page != "README.md" => {}
                Err((_, error)) => wrong.push(format!("{page}: {line}\n{error}")),
            }
        }
    }
    assert!(seen > 150, "{seen}");
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// The blueprints of the pages, also those that belong into another one, have neither mistakes nor warnings.
#[test]
fn blueprints_of_the_pages_are_right() {
    use dimos::blueprint::{Overrides, SearchPath, load_from};
    let folder = tempfile::tempdir().unwrap();
    for (page, include) in [
        ("docs/cartesian.md", "include: [coordinator-yourarm]"),
        ("docs/leader-follower.md", "include: [leader-follower]"),
        ("docs/proxy.md", ""),
        ("docs/python.md", ""),
    ] {
        let text = std::fs::read_to_string(root().join(page)).unwrap();
        let block = text.split("```yaml\n").nth(1).and_then(|rest| rest.split("```").next()).unwrap();
        let file = folder.path().join("cell.yaml");
        std::fs::write(&file, format!("{include}\n{block}")).unwrap();
        let search = SearchPath { folders: vec![root().join("blueprints")] };
        let found = search.find(file.to_str().unwrap()).unwrap();
        let said = load_from(&search, &found, &Overrides::default(), &dimos::arms::registry()).render(false);
        assert!(said.is_empty(), "{page}:\n{said}");
    }
}

#[test]
fn the_checks_see_what_they_should() {
    let block = "```sh\ndimos a b # c\ndimos d && dimos e\n```\nuse `dimos f\n'g h'` or `x`\n";
    let found = [("dimos a b", false), ("dimos d", false), ("dimos e", false), ("dimos f 'g h'", true)];
    assert_eq!(commands(block), found.map(|(line, said)| (line.to_owned(), said)));
    assert_eq!(words("a 'b c' d=\"e\""), ["a", "b c", "d=e"]);
    let page = "# A `b`: c, d\n```\n# no heading\n[no](link)\n```\n[x](y.md#z) [w](#a-b-c-d)\n";
    assert_eq!(anchors(page), BTreeSet::from(["a-b-c-d".to_owned()]));
    assert_eq!(links(page), ["y.md#z", "#a-b-c-d"]);
    assert_eq!(ids("f08_f09_no_command").collect::<Vec<_>>(), ["F08", "F09"]);
    assert_eq!(ids("f1_x").count() + ids("fast_stream").count(), 0);
    assert_eq!(functions("    fn f01_a(x: T) {\nlet fn_x = 1;\n").collect::<Vec<_>>(), ["f01_a"]);
}
