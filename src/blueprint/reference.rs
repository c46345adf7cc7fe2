//! Writes `docs/blueprint-reference.md` from the JSON Schema.
pub fn reference() -> String {
    String::new()
}
