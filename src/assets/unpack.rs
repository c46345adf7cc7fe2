//! Unpacks a downloaded file into a folder: tar, tar.gz and zip archives (including wheels) are extracted, other files
//! are copied. The first bytes decide the type; addresses often do not show it.
//!
//! An archive may contain only files, folders and links, inside itself. Links become copies (see `links`).

use std::fs::{self, File};
use std::io::{self, BufReader, Read, Seek, Write};
use std::path::{Component, Path, PathBuf};

use flate2::read::GzDecoder;

use super::AssetError;
use super::links::Links;

/// Maximum unpacked size of an archive [bytes].
const MAX_BYTES: u64 = 8 << 30;
/// Maximum unpacked size relative to the size of the archive: robot descriptions shrink to a fifth, and a decompression
/// bomb is a hundred times as large or more.
const MAX_RATIO: u64 = 100;
/// Unpacked size that any archive may have [bytes].
const SMALL: u64 = 64 << 20;
/// Maximum number of entries of an archive.
const MAX_ENTRIES: usize = 200_000;
/// Maximum depth of folders in an archive.
const MAX_DEPTH: usize = 64;
/// Position of the magic of a tar archive.
const USTAR: usize = 257;
/// Maximum length of a link's target in a zip archive [bytes].
const MAX_TARGET: u64 = 4096;
/// Archives that are not unpacked: first bytes, name, endings.
const OTHERS: [(&[u8], &str, [&str; 2]); 4] = [
    (b"\xfd7zXZ\0", "tar.xz", [".tar.xz", ".txz"]),
    (b"BZh", "tar.bz2", [".tar.bz2", ".tbz2"]),
    (b"\x28\xb5\x2f\xfd", "tar.zst", [".tar.zst", ".tzst"]),
    (b"7z\xbc\xaf\x27\x1c", "7z", [".7z", ".7z"]),
];

/// Type of a file.
#[derive(Debug, PartialEq, Eq)]
enum Kind {
    Tar,
    TarGz,
    Zip,
    /// An archive that is not unpacked.
    Other(&'static str),
    Plain,
}

/// Fills the new folder `to` from `part`; moves a plain file there, as `name`.
pub fn unpack(part: &Path, name: &str, to: &Path) -> Result<(), AssetError> {
    let in_part = |e: io::Error| AssetError::io(part, &e);
    fs::create_dir(to).map_err(|e| AssetError::io(to, &e))?;
    let mut file = File::open(part).map_err(in_part)?;
    let kind = kind(&mut file, name).map_err(in_part)?;
    let size = file.metadata().map_err(in_part)?.len();
    let bytes = size.saturating_mul(MAX_RATIO).clamp(SMALL, MAX_BYTES);
    let mut budget = Budget { bytes, most: bytes, entries: MAX_ENTRIES };
    match kind {
        Kind::Tar => untar(BufReader::new(file), to, &mut budget),
        Kind::TarGz => untar(GzDecoder::new(BufReader::new(file)), to, &mut budget),
        Kind::Zip => unzip(file, to, &mut budget),
        Kind::Other(kind) => Err(AssetError::new(format!("archives of type {kind} are not supported"))
            .hint("repack it as tar.gz, tar or zip; the download was discarded")),
        Kind::Plain => fs::rename(part, to.join(name)).map_err(in_part),
    }
}

fn kind(file: &mut File, name: &str) -> io::Result<Kind> {
    let mut start = Vec::new();
    Read::by_ref(file).take(512).read_to_end(&mut start)?;
    file.rewind()?;
    let is_tar = |header: &[u8]| header.get(USTAR..USTAR + 5) == Some(b"ustar");
    let name = name.to_ascii_lowercase();
    let other = OTHERS
        .iter()
        .find(|(magic, _, endings)| start.starts_with(magic) && endings.iter().any(|ending| name.ends_with(ending)));
    if let Some((_, kind, _)) = other {
        return Ok(Kind::Other(kind));
    }
    Ok(match start.as_slice() {
        [0x1f, 0x8b, ..] => {
            let mut header = Vec::new();
            // Anything else is not an archive.
            let read = GzDecoder::new(BufReader::new(&mut *file)).take(512).read_to_end(&mut header);
            file.rewind()?;
            if read.is_ok() && is_tar(&header) { Kind::TarGz } else { Kind::Plain }
        }
        [b'P', b'K', 3, 4, ..] | [b'P', b'K', 5, 6, ..] => Kind::Zip,
        header if is_tar(header) => Kind::Tar,
        _ => Kind::Plain,
    })
}

/// Remaining limits of an archive.
pub(super) struct Budget {
    bytes: u64,
    /// Limit of its unpacked size [bytes].
    most: u64,
    entries: usize,
}

impl Budget {
    pub(super) fn entry(&mut self, name: &str) -> Result<(), AssetError> {
        let left = self.entries.checked_sub(1);
        self.entries = left.ok_or_else(|| AssetError::entry(name, &format!("is one of more than {MAX_ENTRIES}")))?;
        Ok(())
    }

    /// Counts unpacked bytes.
    fn spend(&mut self, name: &str, bytes: usize) -> Result<(), AssetError> {
        let left = self.bytes.checked_sub(bytes as u64);
        let most = || format!("exceeds the limit of {} MiB unpacked (100 times the archive)", self.most >> 20);
        self.bytes = left.ok_or_else(|| AssetError::entry(name, &most()))?;
        Ok(())
    }

    /// Writes a file. Counts the bytes read, not the size in the header.
    pub(super) fn copy_stream(&mut self, name: &str, mut from: impl Read, to: &Path) -> Result<(), AssetError> {
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
            self.spend(name, n)?;
            file.write_all(buffer.get(..n).unwrap_or_default()).map_err(write)?;
        }
    }
}

fn untar(file: impl Read, to: &Path, budget: &mut Budget) -> Result<(), AssetError> {
    let damaged = |e: io::Error| AssetError::new(format!("the archive is damaged: {e}"));
    let mut archive = tar::Archive::new(file);
    let mut links = Links::default();
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
            kind @ (tar::EntryType::Symlink | tar::EntryType::Link) => {
                let target = entry.link_name().map_err(damaged)?;
                let target = target.ok_or_else(|| AssetError::entry(&name, "is a link without a target"))?;
                match kind {
                    tar::EntryType::Symlink => links.symbolic(to, &path, &target)?,
                    _ => links.hard(to, &path, &target)?,
                }
            }
            _ => return Err(AssetError::entry(&name, "is neither file nor folder")),
        }
    }
    // The checksum of gzip is at its end.
    let (mut rest, mut buffer) = (archive.into_inner(), vec![0; 1 << 16]);
    loop {
        match rest.read(&mut buffer).map_err(damaged)? {
            0 => break,
            n => budget.spend("the end of the archive", n)?,
        }
    }
    links.copy(to, budget)
}

fn unzip(file: File, to: &Path, budget: &mut Budget) -> Result<(), AssetError> {
    let damaged = |e: zip::result::ZipError| AssetError::new(format!("the archive is damaged: {e}"));
    let mut archive = zip::ZipArchive::new(BufReader::new(file)).map_err(damaged)?;
    let mut links = Links::default();
    for index in 0..archive.len() {
        let mut entry = archive.by_index(index).map_err(damaged)?;
        let name = entry.name().map_err(damaged)?.into_owned();
        budget.entry(&name)?;
        if entry.is_symlink() {
            let mut target = String::new();
            let read = Read::by_ref(&mut entry).take(MAX_TARGET).read_to_string(&mut target);
            read.map_err(|e| AssetError::entry(&name, &format!("is a link that cannot be read: {e}")))?;
            links.symbolic(to, Path::new(&name), Path::new(&target))?;
            continue;
        }
        let path = inside(to, Path::new(&name))?;
        if entry.is_dir() { folder(&path)? } else { budget.copy_stream(&name, entry, &path)? }
    }
    links.copy(to, budget)
}

pub(super) fn folder(path: &Path) -> Result<(), AssetError> {
    fs::create_dir_all(path).map_err(|e| AssetError::io(path, &e))
}

/// Returns the target path of an entry. Rejects paths outside the folder.
pub(super) fn inside(to: &Path, path: &Path) -> Result<PathBuf, AssetError> {
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
