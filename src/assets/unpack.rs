//! Unpacks a downloaded file into a folder: tar.gz and zip archives (including wheels) are extracted, other files are
//! copied. The first bytes decide the type; addresses often do not show it.
//!
//! An archive may contain only files and folders, inside itself. Links are rejected even if they stay inside: a file
//! read later by name must be that file.

use std::fs::{self, File};
use std::io::{self, BufReader, Read, Seek, Write};
use std::path::{Component, Path, PathBuf};

use flate2::read::GzDecoder;

use super::AssetError;

/// Maximum unpacked size of an archive [bytes].
const MAX_BYTES: u64 = 8 << 30;
/// Maximum number of entries of an archive.
const MAX_ENTRIES: usize = 200_000;
/// Maximum depth of folders in an archive.
const MAX_DEPTH: usize = 64;
/// Position of the magic of a tar archive.
const USTAR: usize = 257;

/// Type of a file.
#[derive(Debug, PartialEq, Eq)]
enum Kind {
    TarGz,
    Zip,
    Plain,
}

/// Fills the new folder `to` from `part`; moves a plain file there, as `name`.
pub fn unpack(part: &Path, name: &str, to: &Path) -> Result<(), AssetError> {
    let in_part = |e: io::Error| AssetError::io(part, &e);
    fs::create_dir(to).map_err(|e| AssetError::io(to, &e))?;
    let mut file = File::open(part).map_err(in_part)?;
    let kind = kind(&mut file).map_err(in_part)?;
    let mut budget = Budget { bytes: MAX_BYTES, entries: MAX_ENTRIES };
    match kind {
        Kind::TarGz => untar(file, to, &mut budget),
        Kind::Zip => unzip(file, to, &mut budget),
        Kind::Plain => fs::rename(part, to.join(name)).map_err(in_part),
    }
}

fn kind(file: &mut File) -> io::Result<Kind> {
    let mut start = Vec::new();
    Read::by_ref(file).take(4).read_to_end(&mut start)?;
    file.rewind()?;
    Ok(match start.as_slice() {
        [0x1f, 0x8b, ..] => {
            let mut header = Vec::new();
            // Anything else is not an archive.
            let read = GzDecoder::new(BufReader::new(&mut *file)).take(512).read_to_end(&mut header);
            file.rewind()?;
            let tar = read.is_ok() && header.get(USTAR..USTAR + 5) == Some(b"ustar");
            if tar { Kind::TarGz } else { Kind::Plain }
        }
        b"PK\x03\x04" | b"PK\x05\x06" => Kind::Zip,
        _ => Kind::Plain,
    })
}

/// Remaining limits of an archive.
struct Budget {
    bytes: u64,
    entries: usize,
}

impl Budget {
    fn entry(&mut self, name: &str) -> Result<(), AssetError> {
        let left = self.entries.checked_sub(1);
        self.entries = left.ok_or_else(|| AssetError::entry(name, &format!("is one of more than {MAX_ENTRIES}")))?;
        Ok(())
    }

    /// Writes a file. Counts the bytes read, not the size in the header.
    fn copy_stream(&mut self, name: &str, mut from: impl Read, to: &Path) -> Result<(), AssetError> {
        let damaged = |e: io::Error| AssetError::entry(name, &format!("cannot be unpacked: {e}"));
        let write = |e: io::Error| AssetError::io(to, &e);
        if let Some(folder) = to.parent() {
            fs::create_dir_all(folder).map_err(|e| AssetError::io(folder, &e))?;
        }
        let (mut file, mut buffer) = (File::create(to).map_err(write)?, vec![0; 1 << 16]);
        loop {
            let n = match from.read(&mut buffer).map_err(damaged)? {
                0 => return Ok(()),
                n => n,
            };
            self.bytes = self
                .bytes
                .checked_sub(n as u64)
                .ok_or_else(|| AssetError::entry(name, &format!("exceeds {} GiB in total", MAX_BYTES >> 30)))?;
            file.write_all(buffer.get(..n).unwrap_or_default()).map_err(write)?;
        }
    }
}

fn untar(file: File, to: &Path, budget: &mut Budget) -> Result<(), AssetError> {
    let damaged = |e: io::Error| AssetError::new(format!("the archive is damaged: {e}"));
    let mut archive = tar::Archive::new(GzDecoder::new(BufReader::new(file)));
    for entry in archive.entries().map_err(damaged)? {
        let mut entry = entry.map_err(damaged)?;
        let path = entry.path().map_err(damaged)?.into_owned();
        let name = path.display().to_string();
        budget.entry(&name)?;
        match entry.header().entry_type() {
            tar::EntryType::Directory => folder(&inside(to, &path)?)?,
            tar::EntryType::Regular | tar::EntryType::Continuous => {
                budget.copy_stream(&name, &mut entry, &inside(to, &path)?)?;
            }
            // Metadata of the archiver, such as git's.
            tar::EntryType::XGlobalHeader => {}
            tar::EntryType::Symlink | tar::EntryType::Link => return Err(AssetError::entry(&name, "is a link")),
            _ => return Err(AssetError::entry(&name, "is neither file nor folder")),
        }
    }
    Ok(())
}

fn unzip(file: File, to: &Path, budget: &mut Budget) -> Result<(), AssetError> {
    let damaged = |e: zip::result::ZipError| AssetError::new(format!("the archive is damaged: {e}"));
    let mut archive = zip::ZipArchive::new(BufReader::new(file)).map_err(damaged)?;
    for index in 0..archive.len() {
        let entry = archive.by_index(index).map_err(damaged)?;
        let name = entry.name().map_err(damaged)?.into_owned();
        budget.entry(&name)?;
        if entry.is_symlink() {
            return Err(AssetError::entry(&name, "is a link"));
        }
        let path = inside(to, Path::new(&name))?;
        if entry.is_dir() { folder(&path)? } else { budget.copy_stream(&name, entry, &path)? }
    }
    Ok(())
}

fn folder(path: &Path) -> Result<(), AssetError> {
    fs::create_dir_all(path).map_err(|e| AssetError::io(path, &e))
}

/// Returns the target path of an entry. Rejects paths outside the folder.
fn inside(to: &Path, path: &Path) -> Result<PathBuf, AssetError> {
    let name = path.display().to_string();
    let mut out = to.to_owned();
    for part in path.components() {
        match part {
            Component::Normal(part) if !part.as_encoded_bytes().contains(&0) => out.push(part),
            Component::CurDir => {}
            _ => return Err(AssetError::entry(&name, "leads out of its folder")),
        }
    }
    if path.components().count() > MAX_DEPTH {
        return Err(AssetError::entry(&name, "is nested too deeply"));
    }
    Ok(out)
}
