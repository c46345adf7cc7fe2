//! What a mesh file is, before the mesh library reads it: files of another kind, and binary STL files whose length
//! does not fit their header. The library takes the number of triangles from the length and ignores the header.

/// Length of the header of a binary STL file, with the number of triangles [bytes].
const STL_HEADER: usize = 84;
/// Length of a triangle in a binary STL file [bytes].
const STL_TRIANGLE: u64 = 50;
/// Length of the start of a file in which text formats are recognized [bytes].
const START: usize = 512;

/// Rejects files that are not meshes although they are named like one: Git LFS pointers, web pages.
pub(super) fn refuse_other_files(bytes: &[u8]) -> Result<(), String> {
    let start = bytes.get(..bytes.len().min(START)).unwrap_or_default();
    let start = String::from_utf8_lossy(start).trim_start().to_ascii_lowercase();
    if start.starts_with("version https://git-lfs") {
        return Err("this is a Git LFS pointer, not the mesh\nhint: run `git lfs pull` in its repository".to_owned());
    }
    if start.starts_with("<!doctype html") || start.starts_with("<html") {
        let hint = "download the file itself: on GitHub, its `raw` address";
        return Err(format!("this is a web page, not a mesh\nhint: {hint}"));
    }
    Ok(())
}

/// Checks that an STL file is text, or binary of the length that its header states: a truncated or padded file would
/// be read as another, smaller or larger mesh.
pub(super) fn check_stl(bytes: &[u8]) -> Result<(), String> {
    let length = bytes.len() as u64;
    let declared = bytes.get(80..STL_HEADER).and_then(|count| <[u8; 4]>::try_from(count).ok()).map(u32::from_le_bytes);
    let expected = declared.map(|count| STL_HEADER as u64 + STL_TRIANGLE * u64::from(count));
    // Some exporters end the file with a line break.
    if expected.is_some_and(|expected| {
        let rest = usize::try_from(expected).ok().and_then(|expected| bytes.get(expected..));
        rest.is_some_and(|rest| matches!(rest, b"" | b"\n" | b"\r\n"))
    }) {
        return Ok(());
    }
    if is_text(bytes) {
        return Ok(());
    }
    let (Some(declared), Some(expected)) = (declared, expected) else {
        return Err(format!("the file is truncated: {length} bytes are less than the header of an STL file"));
    };
    let what = if length < expected { "truncated or not STL" } else { "damaged" };
    Err(format!(
        "the file is {what}: its header declares {declared} triangles ({expected} bytes), it has {length} bytes"
    ))
}

/// Returns whether an STL file is text: it begins with `solid`, and its start has no bytes that text does not have.
fn is_text(bytes: &[u8]) -> bool {
    let after = bytes.trim_ascii_start().strip_prefix(b"solid");
    let begins = after.is_some_and(|after| after.first().is_some_and(u8::is_ascii_whitespace));
    let start = bytes.get(..bytes.len().min(START)).unwrap_or_default();
    begins && start.iter().all(|byte| *byte >= b' ' || byte.is_ascii_whitespace())
}

/// Returns an error of the OBJ reader in terms of the file: indices count from 1, the reader's from 0.
pub(super) fn obj_error(what: String) -> String {
    if what.contains("out of bounds (4294967295)") {
        return "a face refers to vertex 0: the vertices of an OBJ file count from 1".to_owned();
    }
    what
}
