//! How a mesh file is stored: files of another kind, and the encodings of text.

use std::borrow::Cow;

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

/// Returns the text of a file: UTF-8, or UTF-16 with a byte order mark; other bytes, such as those of a name in ISO
/// 8859-1, are replaced. The numbers of a mesh are ASCII.
pub(super) fn text(bytes: &[u8]) -> Cow<'_, str> {
    let utf16 = |read: fn([u8; 2]) -> u16| {
        let units: Vec<u16> = bytes.chunks_exact(2).skip(1).map(|pair| read([pair[0], pair[1]])).collect();
        Cow::Owned(String::from_utf16_lossy(&units))
    };
    match bytes {
        [0xff, 0xfe, ..] => utf16(u16::from_le_bytes),
        [0xfe, 0xff, ..] => utf16(u16::from_be_bytes),
        [0xef, 0xbb, 0xbf, rest @ ..] => String::from_utf8_lossy(rest),
        _ => String::from_utf8_lossy(bytes),
    }
}
