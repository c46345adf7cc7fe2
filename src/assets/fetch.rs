//! Brings an asset from its address into the cache: download, checksum, unpack.

use std::ffi::OsStr;
use std::fs::{self, File};
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use percent_encoding::percent_decode_str;
use sha2::{Digest, Sha256};

use super::{Asset, AssetError, Cache, Progress, download, unpack};

impl Cache {
    /// Downloads an asset that is not in the cache. Waits for another process that does so.
    pub(super) fn fetch_missing(&self, asset: &Asset, progress: &mut dyn Progress) -> Result<PathBuf, AssetError> {
        let (folder, sum) = (self.folder(&asset.sha256), asset.sha256.to_ascii_lowercase());
        fs::create_dir_all(&self.0).map_err(|e| AssetError::io(&self.0, &e))?;
        let _lock = self.lock(&asset.sha256, progress)?;
        if folder.is_dir() {
            return Ok(folder);
        }
        let part = self.file(&asset.sha256, ".part");
        let resumed = part.exists();
        download::download(&asset.url, &part, progress)?;
        let mut found = sum_of(&part)?;
        if found != sum && resumed {
            // The address may now return another file than when the download began.
            fs::remove_file(&part).map_err(|e| AssetError::io(&part, &e))?;
            progress.note("an earlier partial download does not match: downloading from scratch");
            download::download(&asset.url, &part, progress)?;
            found = sum_of(&part)?;
        }
        if found != sum {
            let _ = fs::remove_file(&part);
            return Err(AssetError::other_file(&asset.url, &sum, &found));
        }
        let fresh = self.file(&asset.sha256, ".new");
        let _ = fs::remove_dir_all(&fresh);
        let unpacked = unpack::unpack(&part, &file_name(&asset.url), &fresh);
        if let Err(error) = unpacked {
            let _ = fs::remove_dir_all(&fresh);
            let _ = fs::remove_file(&part);
            return Err(error);
        }
        fs::rename(&fresh, &folder).map_err(|e| AssetError::io(&folder, &e))?;
        let _ = fs::remove_file(&part);
        Ok(folder)
    }
}

fn sum_of(path: &Path) -> Result<String, AssetError> {
    let sum = || -> io::Result<String> {
        let (mut file, mut sum, mut room) = (File::open(path)?, Sha256::new(), vec![0; 1 << 16]);
        loop {
            match file.read(&mut room)? {
                0 => break,
                n => sum.update(room.get(..n).unwrap_or_default()),
            }
        }
        Ok(sum.finalize().iter().map(|byte| format!("{byte:02x}")).collect())
    };
    sum().map_err(|e| AssetError::io(path, &e))
}

/// Returns the name of a plain file: the last part of its address.
fn file_name(url: &str) -> String {
    let path = url.split(['?', '#']).next().unwrap_or_default();
    let last = path.rsplit('/').next().unwrap_or_default();
    let name = percent_decoded(last);
    match Path::new(&name).file_name() {
        Some(plain) if plain == OsStr::new(&name) && !name.contains('\0') => name,
        _ => "file".to_owned(),
    }
}

/// Decodes percent-encoded characters, such as `%20`, in a path.
pub(super) fn percent_decoded(text: &str) -> String {
    percent_decode_str(text).decode_utf8().map_or_else(|_| text.to_owned(), Into::into)
}
