//! From a fetched file to a folder: a tar.gz or a zip (a wheel is one) is unpacked, anything else is put there as it is.
//! What a file is, its first bytes say: addresses often do not.
//!
//! An archive may hold files and folders inside itself and nothing else. Links are refused even where they stay inside:
//! what is read later by the name of a file must be that file.

use std::fs::{self, File};
use std::io::{self, BufReader, Read, Seek, Write};
use std::path::{Component, Path, PathBuf};

use flate2::read::GzDecoder;

use super::AssetError;

/// Most bytes that an archive may come to.
const MAX_BYTES: u64 = 8 << 30;
/// Most entries of an archive.
const MAX_ENTRIES: usize = 200_000;
/// Deepest folder of an archive.
const MAX_DEPTH: usize = 64;
/// Where a tar archive says that it is one.
const USTAR: usize = 257;

/// What a file is.
#[derive(Debug, PartialEq, Eq)]
enum Kind {
    TarGz,
    Zip,
    Plain,
}

/// Fills the new folder `to` with what `part` holds; a plain file is moved there, as `name`.
pub fn unpack(part: &Path, name: &str, to: &Path) -> Result<(), AssetError> {
    let in_part = |e: io::Error| AssetError::io(part, &e);
    fs::create_dir(to).map_err(|e| AssetError::io(to, &e))?;
    let mut file = File::open(part).map_err(in_part)?;
    let kind = kind(&mut file).map_err(in_part)?;
    let mut room = Room { bytes: MAX_BYTES, entries: MAX_ENTRIES };
    match kind {
        Kind::TarGz => untar(file, to, &mut room),
        Kind::Zip => unzip(file, to, &mut room),
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
            // What cannot be unpacked is no archive of ours.
            let read = GzDecoder::new(BufReader::new(&mut *file)).take(512).read_to_end(&mut header);
            file.rewind()?;
            let tar = read.is_ok() && header.get(USTAR..USTAR + 5) == Some(b"ustar");
            if tar { Kind::TarGz } else { Kind::Plain }
        }
        b"PK\x03\x04" | b"PK\x05\x06" => Kind::Zip,
        _ => Kind::Plain,
    })
}

/// What an archive may still come to.
struct Room {
    bytes: u64,
    entries: usize,
}

impl Room {
    fn entry(&mut self, name: &str) -> Result<(), AssetError> {
        let left = self.entries.checked_sub(1);
        self.entries = left.ok_or_else(|| AssetError::entry(name, &format!("is one of more than {MAX_ENTRIES}")))?;
        Ok(())
    }

    /// Writes a file. Counts what comes, not what the archive says.
    fn pour(&mut self, name: &str, mut from: impl Read, to: &Path) -> Result<(), AssetError> {
        let damaged = |e: io::Error| AssetError::entry(name, &format!("cannot be unpacked: {e}"));
        let write = |e: io::Error| AssetError::io(to, &e);
        if let Some(folder) = to.parent() {
            fs::create_dir_all(folder).map_err(|e| AssetError::io(folder, &e))?;
        }
        let (mut file, mut room) = (File::create(to).map_err(write)?, vec![0; 1 << 16]);
        loop {
            let n = match from.read(&mut room).map_err(damaged)? {
                0 => return Ok(()),
                n => n,
            };
            self.bytes = self
                .bytes
                .checked_sub(n as u64)
                .ok_or_else(|| AssetError::entry(name, &format!("makes it more than {} GiB", MAX_BYTES >> 30)))?;
            file.write_all(room.get(..n).unwrap_or_default()).map_err(write)?;
        }
    }
}

fn untar(file: File, to: &Path, room: &mut Room) -> Result<(), AssetError> {
    let damaged = |e: io::Error| AssetError::new(format!("its archive is damaged: {e}"));
    let mut archive = tar::Archive::new(GzDecoder::new(BufReader::new(file)));
    for entry in archive.entries().map_err(damaged)? {
        let mut entry = entry.map_err(damaged)?;
        let path = entry.path().map_err(damaged)?.into_owned();
        let name = path.display().to_string();
        room.entry(&name)?;
        match entry.header().entry_type() {
            tar::EntryType::Directory => folder(&inside(to, &path)?)?,
            tar::EntryType::Regular | tar::EntryType::Continuous => {
                room.pour(&name, &mut entry, &inside(to, &path)?)?;
            }
            // Notes of the archiver, such as git's.
            tar::EntryType::XGlobalHeader => {}
            tar::EntryType::Symlink | tar::EntryType::Link => return Err(AssetError::entry(&name, "is a link")),
            _ => return Err(AssetError::entry(&name, "is neither file nor folder")),
        }
    }
    Ok(())
}

fn unzip(file: File, to: &Path, room: &mut Room) -> Result<(), AssetError> {
    let damaged = |e: zip::result::ZipError| AssetError::new(format!("its archive is damaged: {e}"));
    let mut archive = zip::ZipArchive::new(BufReader::new(file)).map_err(damaged)?;
    for index in 0..archive.len() {
        let entry = archive.by_index(index).map_err(damaged)?;
        let name = entry.name().map_err(damaged)?.into_owned();
        room.entry(&name)?;
        if entry.is_symlink() {
            return Err(AssetError::entry(&name, "is a link"));
        }
        let path = inside(to, Path::new(&name))?;
        if entry.is_dir() { folder(&path)? } else { room.pour(&name, entry, &path)? }
    }
    Ok(())
}

fn folder(path: &Path) -> Result<(), AssetError> {
    fs::create_dir_all(path).map_err(|e| AssetError::io(path, &e))
}

/// Where an entry goes. One that would lie elsewhere is refused.
fn inside(to: &Path, path: &Path) -> Result<PathBuf, AssetError> {
    let name = path.display().to_string();
    let mut out = to.to_owned();
    for part in path.components() {
        match part {
            Component::Normal(part) if !part.as_encoded_bytes().contains(&0) => out.push(part),
            Component::CurDir => {}
            _ => return Err(AssetError::entry(&name, "leads out of it")),
        }
    }
    if path.components().count() > MAX_DEPTH {
        return Err(AssetError::entry(&name, "is too deep"));
    }
    Ok(out)
}
