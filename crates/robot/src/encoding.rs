//! Reads the text of a description: guards against files that are none, and decodes the encodings that XML files
//! declare.

use std::path::Path;

use dimos_core::bounded;

/// Reads a text file of at most `max` bytes. The error names no file; it may end with a hint.
pub fn read(path: &Path, max: u64) -> Result<String, String> {
    let bytes = bounded::read(path, max).map_err(|e| e.to_string())?;
    decode(bytes)
}

/// Decodes UTF-8, UTF-16 with a byte order mark, and the 8-bit encodings that an XML declaration names.
fn decode(bytes: Vec<u8>) -> Result<String, String> {
    let utf16 = |read: fn([u8; 2]) -> u16| {
        let units: Vec<u16> = bytes.chunks_exact(2).skip(1).map(|pair| read([pair[0], pair[1]])).collect();
        String::from_utf16(&units).map_err(|_| "the file is not valid UTF-16".to_owned())
    };
    match bytes.as_slice() {
        [0xff, 0xfe, ..] => return utf16(u16::from_le_bytes),
        [0xfe, 0xff, ..] => return utf16(u16::from_be_bytes),
        _ => {}
    }
    let declared = declared(&bytes);
    if declared.as_deref().is_some_and(|name| matches!(name, "iso-8859-1" | "latin1" | "latin-1" | "l1")) {
        // Every byte is the code point of the same number.
        return Ok(bytes.into_iter().map(char::from).collect());
    }
    String::from_utf8(bytes).map_err(|error| {
        let at = error.utf8_error().valid_up_to();
        let line = 1 + error.as_bytes()[..at].iter().filter(|byte| **byte == b'\n').count();
        let byte = error.as_bytes()[at];
        let from = declared.unwrap_or_else(|| "ISO-8859-1".to_owned()).to_uppercase();
        format!("line {line}: the byte 0x{byte:02x} is not UTF-8\nhint: convert it: iconv -f {from} -t UTF-8 OLD > NEW")
    })
}

/// Returns the encoding that an XML declaration names, in lower case.
fn declared(bytes: &[u8]) -> Option<String> {
    let start = String::from_utf8_lossy(bytes.get(..bytes.len().min(200)).unwrap_or_default()).into_owned();
    let declaration = start.strip_prefix("<?xml")?.split_once("?>")?.0.to_owned();
    let (_, value) = declaration.split_once("encoding")?;
    let value = value.trim_start().strip_prefix('=')?.trim_start();
    let quote = value.chars().next().filter(|quote| matches!(quote, '"' | '\''))?;
    let (name, _) = value.get(1..)?.split_once(quote)?;
    Some(name.to_ascii_lowercase())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn declared_encodings_are_decoded() {
        let text = "<?xml version=\"1.0\" encoding=\"ISO-8859-1\"?>\n<!-- Gelenk f\u{fc}r -->";
        let latin: Vec<u8> = text.chars().map(|c| c as u8).collect();
        assert_eq!(decode(latin).as_deref(), Ok(text));
        for (mark, bytes) in [([0xff, 0xfe], u16::to_le_bytes as fn(u16) -> [u8; 2]), ([0xfe, 0xff], u16::to_be_bytes)]
        {
            let units = text.encode_utf16().flat_map(bytes);
            assert_eq!(decode(mark.into_iter().chain(units).collect()).as_deref(), Ok(text));
        }
        assert_eq!(decode("f\u{fc}r".into()).as_deref(), Ok("f\u{fc}r"));
    }

    #[test]
    fn undeclared_bytes_are_reported_with_their_line_and_the_conversion() {
        let error = decode(b"<robot>\n<!-- f\xfcr".to_vec()).unwrap_err();
        assert!(
            error.contains("line 2: the byte 0xfc is not UTF-8") && error.contains("iconv -f ISO-8859-1"),
            "{error}"
        );
        let error = decode(b"<?xml version='1.0' encoding='windows-1252'?>\x80".to_vec()).unwrap_err();
        assert!(error.contains("iconv -f WINDOWS-1252"), "{error}");
    }

    #[test]
    fn only_regular_files_of_a_limited_size_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("f");
        std::fs::write(&file, [b'x'; 100]).unwrap();
        assert_eq!(read(&file, 100).unwrap().len(), 100);
        assert!(read(&file, 99).unwrap_err().contains("is larger than"));
        assert!(read(folder.path(), 99).unwrap_err().contains("folder"));
        assert!(read(Path::new("/dev/zero"), 99).unwrap_err().contains("not a regular file"));
        let pipe = folder.path().join("pipe");
        let (kind, mode) = (rustix::fs::FileType::Fifo, rustix::fs::Mode::RUSR);
        rustix::fs::mknodat(rustix::fs::CWD, &pipe, kind, mode, 0).unwrap();
        assert!(read(&pipe, 99).unwrap_err().contains("not a regular file"));
    }
}
