//! What `dimos --licenses` lists is what is linked into the program and shown in the page, and its texts are shipped.

use std::path::Path;
use std::process::Command;

use crate::support::program::Home;
use crate::support::skip::skip;

/// Returns what the script prints, or `None` (noted) without its tools.
fn notices(arguments: &[&str]) -> Option<String> {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("packaging/notices.py");
    let made = Command::new("python3").arg(script).args(arguments).output().ok()?;
    if !made.status.success() {
        // The crates of a machine for which nothing was built are not here: that is said by cargo.
        skip(&format!("sources of all crates (cargo fetch): {}", String::from_utf8_lossy(&made.stderr)));
        return None;
    }
    String::from_utf8(made.stdout).ok()
}

#[test]
fn what_is_shipped_is_listed_with_its_licences() {
    let Some(list) = notices(&["--list"]) else { return };
    let kept = Path::new(env!("CARGO_MANIFEST_DIR")).join("assets/licences.txt");
    if std::env::var_os("DIMOS_REGENERATE").is_some() {
        std::fs::write(&kept, &list).unwrap();
    }
    let hint = "packaging/notices.py --list >assets/licences.txt";
    assert_eq!(std::fs::read_to_string(&kept).unwrap(), list, "{hint}");
    for line in list.lines() {
        assert!(line.split_once(": ").is_some_and(|(_, licence)| !licence.is_empty()), "{line}");
    }
    let printed = Home::new().dimos("--licenses").with(0).out;
    assert!(printed.starts_with("dimos ") && printed.ends_with(&list), "{printed}");
    for part in ["clap ", "mcap ", "nalgebra ", "three "] {
        assert!(printed.contains(part), "{part}");
    }

    let beside = Home::new().dimos("--licenses status").with(2);
    assert!(beside.err.contains("given alone"), "{}", beside.err);

    let texts = notices(&[]).unwrap();
    for text in ["Permission is hereby granted", "Apache License", "Mozilla Public License", "three.js"] {
        assert!(texts.to_lowercase().contains(&text.to_lowercase()), "{text}");
    }
}
