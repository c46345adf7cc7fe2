//! The tests' own helpers: what a skipped test needs, and addresses that tests do not share.

use std::collections::BTreeSet;
use std::fs;
use std::net::TcpListener;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use crate::support::loopback::{numbered, own_address};
use crate::support::skip::required;
use crate::support::wire::watch::Watch;

#[test]
fn only_the_value_1_makes_a_skipped_test_fail() {
    assert!(required(Some("1")));
    for value in [None, Some(""), Some("0"), Some("yes")] {
        assert!(!required(value), "{value:?}");
    }
}

#[test]
fn tests_are_skipped_in_one_way() {
    let mut open = vec![Path::new(env!("CARGO_MANIFEST_DIR")).join("tests")];
    let mut found = Vec::new();
    while let Some(folder) = open.pop() {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                open.push(path);
            } else if path.extension().is_some_and(|e| e == "rs") && !path.ends_with("support/skip.rs") {
                let text = fs::read_to_string(&path).unwrap();
                // Split, so that this file does not contain them.
                let ways = [concat!("\"DIMOS_NO", "_SKIP\""), concat!("\"SKIP", "PED"), concat!("\"not ", "checked")];
                found.extend(ways.iter().filter(|way| text.contains(**way)).map(|way| format!("{path:?}: {way}")));
            }
        }
    }
    assert!(found.is_empty(), "use support::skip:\n{}", found.join("\n"));
}

#[test]
fn no_two_tests_have_the_same_address() {
    let numbers: BTreeSet<_> = (1_000_000..1_100_000).map(numbered).collect();
    assert_eq!(numbers.len(), 100_000);
    let own: BTreeSet<_> = (0..300).map(|_| own_address()).collect();
    assert_eq!(own.len(), 300);
    assert!(own.iter().all(|address| TcpListener::bind((*address, 0)).is_ok()));
}

#[test]
fn a_failure_without_a_stall_is_final() {
    let host = Watch::of_programs();
    let mut attempts = 0;
    let mut attempt = || {
        attempts += 1;
        if attempts == 1 { Err("wrong".to_owned()) } else { Ok(()) }
    };
    let ended = catch_unwind(AssertUnwindSafe(|| host.unless_stalled(&mut attempt)));
    assert!(ended.is_err(), "it was repeated");
}
