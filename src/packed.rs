//! Texts of `assets` that are seldom needed: robots, templates, the protocol's schema. They are deflated in the
//! program, which is smaller for it, and unpacked when they are asked for.

use std::collections::BTreeMap;
use std::sync::Mutex;

use crate::sync::lock;

/// Names, as `robots/xarm6.urdf`, with the deflated texts.
static PACKED: &[(&str, &[u8])] = include!(concat!(env!("OUT_DIR"), "/packed.rs"));
/// What was unpacked so far.
static UNPACKED: Mutex<BTreeMap<&'static str, &'static str>> = Mutex::new(BTreeMap::new());

/// Returns the text of a file below `assets`; `None` if it is none of those.
pub fn text(name: &str) -> Option<&'static str> {
    let (name, deflated) = PACKED.iter().find(|(packed, _)| *packed == name)?;
    let mut unpacked = lock(&UNPACKED);
    if let Some(text) = unpacked.get(name) {
        return Some(text);
    }
    let text = String::from_utf8(miniz_oxide::inflate::decompress_to_vec(deflated).ok()?).ok()?;
    // Kept for the rest of the program, as a text in it would be.
    let text: &'static str = Box::leak(text.into_boxed_str());
    unpacked.insert(name, text);
    Some(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_text_is_unpacked_as_it_is_in_its_file() {
        for (name, _) in PACKED {
            let file = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("assets").join(name);
            assert_eq!(text(name).unwrap(), std::fs::read_to_string(file).unwrap(), "{name}");
        }
        assert!(PACKED.len() > 20 && text("robots/xarm6.urdf").is_some() && text("robots/none.urdf").is_none());
        assert_eq!(text("rpc.schema.json").unwrap().as_ptr(), text("rpc.schema.json").unwrap().as_ptr(), "once");
    }
}
