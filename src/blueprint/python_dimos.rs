//! The section `share.python_dimos`: the run as the coordinator of Python dimos.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::resolve::Checker;
use crate::yaml::{Diag, Keyed, Located, did_you_mean, quote};

/// The run as the `ControlCoordinator` of Python dimos 0.0.15: its programs read joint states and, with `command`,
/// execute trajectories. Reaches this computer only. See `docs/many-machines.md`.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct PythonDimosEntry {
    /// Name of the coordinator there; one of a name can be on a bus.
    pub name: Located<String>,
    /// Domain of the streams, if Python dimos has one: `--zenoh-domain`.
    pub domain: Located<String>,
    /// Whether Python dimos may move arms. Every program on this computer can then.
    pub command: bool,
    /// Names of joints for Python dimos, by joint. Without an entry `PREFIX_jointN` is `PREFIX/jointN`, and any other
    /// joint `HARDWARE_ID/JOINT`.
    pub joints: Keyed<Located<String>>,
    /// Multicast group on which Python dimos finds its peers, if not its own default: `ZENOH_SCOUT_ADDR`.
    pub scout_addr: Option<Located<String>>,
}

impl Default for PythonDimosEntry {
    fn default() -> Self {
        let config = PythonDimosConfig::default();
        Self {
            name: config.name.into(),
            domain: config.domain.into(),
            command: config.command,
            joints: Keyed::default(),
            scout_addr: None,
        }
    }
}

/// The run as the coordinator of Python dimos, checked.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct PythonDimosConfig {
    /// Name of the coordinator.
    pub name: String,
    /// Domain of the streams; empty: none.
    pub domain: String,
    /// Whether Python dimos may move arms.
    pub command: bool,
    /// Names of joints for Python dimos, by joint.
    pub joints: BTreeMap<String, String>,
    /// Multicast group of the bus; `None`: zenoh's own.
    pub scout_addr: Option<String>,
}

impl Default for PythonDimosConfig {
    fn default() -> Self {
        Self {
            name: "ControlCoordinator".into(),
            domain: String::new(),
            command: false,
            joints: BTreeMap::new(),
            scout_addr: None,
        }
    }
}

/// Returns whether a word can be part of a key: it has no separators and no wildcards.
fn is_word(word: &str) -> bool {
    word.len() <= 64 && word.chars().all(|c| c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | '_'))
}

/// Checks the section. `joints`: those of all arms; `None`: not known completely, because of other mistakes.
pub(super) fn resolve(
    checker: &mut Checker<'_>,
    entry: &Located<PythonDimosEntry>,
    joints: Option<&[&str]>,
) -> PythonDimosConfig {
    for (key, word) in [("name", &entry.name), ("domain", &entry.domain)] {
        if !is_word(&word.value) || (key == "name" && word.value.is_empty()) {
            let diag = Diag::error(format!("{key} {} has characters that separate keys", quote(&word.value)));
            checker.error(word.at, diag.hint("use letters, digits, '.', '-' and '_', at most 64"));
        }
    }
    let group = entry.scout_addr.as_ref().filter(|group| {
        let address = group.value.parse::<std::net::SocketAddrV4>();
        !address.is_ok_and(|address| address.ip().is_multicast() && address.port() != 0)
    });
    if let Some(group) = group {
        let diag = Diag::error(format!("{} is no multicast group with a port", quote(&group.value)));
        checker.error(group.at, diag.hint("such as 224.0.0.224:7446, as in ZENOH_SCOUT_ADDR"));
    }
    let mut seen: BTreeMap<&str, &str> = BTreeMap::new();
    for (joint, theirs) in &entry.joints.0 {
        if let Some(joints) = joints.filter(|joints| !joints.contains(&joint.value.as_str())) {
            let diag = Diag::error(format!("no arm has a joint named {}", quote(&joint.value)));
            let hint = did_you_mean(&joint.value, joints.iter().copied(), "joints");
            checker.error(joint.at, hint.into_iter().fold(diag, |diag, hint| diag.hint(hint)));
        }
        let parts: Vec<&str> = theirs.value.split('/').collect();
        if parts.len() != 2 || parts.iter().any(|part| part.is_empty()) {
            let diag = Diag::error(format!("{} is no joint of Python dimos", quote(&theirs.value)));
            checker.error(theirs.at, diag.hint("write ARM/JOINT: arm/joint1"));
        } else if let Some(other) = seen.insert(&theirs.value, &joint.value) {
            let text = format!("{} and {} would both be {}", other, joint.value, quote(&theirs.value));
            checker.error(theirs.at, Diag::error(text));
        }
    }
    PythonDimosConfig {
        name: entry.name.value.clone(),
        domain: entry.domain.value.clone(),
        command: entry.command,
        joints: entry.joints.0.iter().map(|(ours, theirs)| (ours.value.clone(), theirs.value.clone())).collect(),
        scout_addr: entry.scout_addr.as_ref().map(|group| group.value.clone()),
    }
}
