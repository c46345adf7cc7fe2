//! Reads files whole: of limited size, and none that would be waited for or read without end.

use std::fs::{File, OpenOptions};
use std::io::{self, ErrorKind, Read};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

/// Maximum size of settings, lists and jobs [bytes].
pub const SMALL: u64 = 1 << 20;
/// Maximum size of meshes and clouds that are shown [bytes].
pub const LARGE: u64 = 1 << 30;

/// Reads a regular file of at most `max` bytes. The error names no file; it may end with a hint.
pub fn read(path: &Path, max: u64) -> io::Result<Vec<u8>> {
    take(open(path)?, max)
}

/// Opens a regular file to read it.
pub fn open(path: &Path) -> io::Result<File> {
    // A pipe would be waited for until a program writes to it.
    let flags = rustix::fs::OFlags::NONBLOCK.bits().cast_signed();
    let file = OpenOptions::new().read(true).custom_flags(flags).open(path)?;
    let about = file.metadata()?;
    if about.is_dir() {
        return Err(io::Error::new(ErrorKind::IsADirectory, "this is a folder, not a file"));
    }
    // A device would be read without end.
    if !about.is_file() {
        let what = "not a regular file\nhint: write the output of a command to a file first";
        return Err(io::Error::new(ErrorKind::InvalidInput, what));
    }
    Ok(file)
}

/// Reads what is at most `max` bytes to its end: a file, or a pipe that a program writes to.
pub fn take(from: impl Read, max: u64) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    from.take(max + 1).read_to_end(&mut bytes)?;
    match bytes.len() as u64 > max {
        true => {
            let size = if max >> 20 > 0 { format!("{} MiB", max >> 20) } else { format!("{max} bytes") };
            Err(io::Error::new(ErrorKind::FileTooLarge, format!("the file is larger than {size}")))
        }
        false => Ok(bytes),
    }
}

/// Reads a text file as [`read`] does.
pub fn read_text(path: &Path, max: u64) -> io::Result<String> {
    String::from_utf8(read(path, max)?).map_err(|error| io::Error::new(ErrorKind::InvalidData, error.utf8_error()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn devices_pipes_folders_and_large_files_are_not_read() {
        let folder = tempfile::tempdir().unwrap();
        let (file, pipe) = (folder.path().join("file"), folder.path().join("pipe"));
        std::fs::write(&file, "four").unwrap();
        let (fifo, mode) = (rustix::fs::FileType::Fifo, rustix::fs::Mode::RWXU);
        rustix::fs::mknodat(rustix::fs::CWD, &pipe, fifo, mode, 0).unwrap();
        assert_eq!(read_text(&file, 4).unwrap(), "four");
        let kind = |path: &Path, max| read(path, max).unwrap_err().kind();
        assert_eq!(kind(&file, 3), ErrorKind::FileTooLarge);
        assert_eq!(kind(&pipe, 9), ErrorKind::InvalidInput);
        assert_eq!(kind(Path::new("/dev/zero"), 9), ErrorKind::InvalidInput);
        assert_eq!(kind(folder.path(), 9), ErrorKind::IsADirectory);
        assert_eq!(kind(&folder.path().join("none"), 9), ErrorKind::NotFound);
        assert_eq!(take(io::repeat(1), 9).unwrap_err().kind(), ErrorKind::FileTooLarge);
    }
}
