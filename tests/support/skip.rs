//! Tests that cannot run on this computer. `DIMOS_NO_SKIP=1` (`.ci/run`) lets none be skipped.

use rustix::thread::{CapabilitySet, capabilities};

/// Prints that a test, or a part of one, is skipped. Panics with `DIMOS_NO_SKIP=1`. `what`: what is missing, and in
/// parentheses how to get it.
#[track_caller]
pub fn skip(what: &str) {
    println!("SKIPPED: {what}");
    assert!(!required(std::env::var("DIMOS_NO_SKIP").ok().as_deref()), "missing, with DIMOS_NO_SKIP=1: {what}");
}

/// [`skip`] for a tool that `make test-tools` installs.
#[track_caller]
pub fn skip_tool(tool: &str) {
    skip(&format!("{tool} (make test-tools)"));
}

/// [`skip`] for what takes long to build: a run of all tests does without it.
pub fn skip_optional(what: &str) {
    println!("SKIPPED: {what}");
}

/// [`skip`] for what needs a privilege. A process without that privilege skips it even with `DIMOS_NO_SKIP=1`: no
/// installation helps there.
#[track_caller]
pub fn skip_privileged(what: &str, privilege: CapabilitySet) {
    if capabilities(None).is_ok_and(|own| own.effective.contains(privilege)) {
        skip(what);
    } else {
        println!("SKIPPED: {what}: this process lacks {privilege:?}");
    }
}

/// [`skip`] for port 502 of an xArm.
#[track_caller]
pub fn skip_port_502() {
    let how = "root, or sysctl net.ipv4.ip_unprivileged_port_start=502";
    skip_privileged(&format!("port 502 ({how})"), CapabilitySet::NET_BIND_SERVICE);
}

/// Whether this value of `DIMOS_NO_SKIP` makes a skipped test fail.
pub fn required(no_skip: Option<&str>) -> bool {
    no_skip == Some("1")
}
