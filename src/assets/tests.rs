#![cfg(feature = "fetch")]

use std::io::Write;
use std::path::Path;
use std::sync::Barrier;

use sha2::{Digest, Sha256};

use super::*;

#[path = "../../tests/support/file_server.rs"]
mod file_server;

use file_server::{FileServer, Misdeed};

/// Records its progress and messages.
#[derive(Default)]
struct ProgressLog {
    notes: Vec<String>,
    most: u64,
}

impl Progress for ProgressLog {
    fn at(&mut self, bytes: u64, _: Option<u64>) {
        self.most = self.most.max(bytes);
    }

    fn note(&mut self, text: &str) {
        self.notes.push(text.to_owned());
    }
}

fn sum(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|b| format!("{b:02x}")).collect()
}

fn asset(url: &str, bytes: &[u8]) -> Asset {
    Asset { name: "arm".into(), url: url.into(), sha256: sum(bytes), place: "cell.yaml:3:5".into() }
}

/// Incompressible bytes.
fn noise(count: usize) -> Vec<u8> {
    let mut state = 1_u64;
    let mut next = || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 56) as u8
    };
    (0..count).map(|_| next()).collect()
}

/// Returns a tar.gz of these entries: name, type, content or link target.
fn tar_gz(entries: &[(&str, tar::EntryType, &str)]) -> Vec<u8> {
    let mut archive = tar::Builder::new(flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast()));
    for (name, kind, content) in entries {
        let mut header = tar::Header::new_gnu();
        header.set_entry_type(*kind);
        header.set_mode(0o644);
        let body = if kind.is_file() { content.as_bytes() } else { &[] };
        header.set_size(body.len() as u64);
        if kind.is_symlink() || kind.is_hard_link() {
            header.set_link_name(content).unwrap();
        }
        // The crate refuses to write some of the names that it must reject when reading.
        let raw = &mut header.as_old_mut().name;
        raw[..name.len()].copy_from_slice(name.as_bytes());
        header.set_cksum();
        archive.append(&header, body).unwrap();
    }
    archive.into_inner().unwrap().finish().unwrap()
}

fn zip_of(entries: &[(&str, &str)]) -> Vec<u8> {
    let mut archive = zip::ZipWriter::new(io::Cursor::new(Vec::new()));
    for (name, content) in entries {
        archive.start_file(*name, zip::write::SimpleFileOptions::default()).unwrap();
        archive.write_all(content.as_bytes()).unwrap();
    }
    archive.finish().unwrap().into_inner()
}

fn cache() -> (tempfile::TempDir, Cache) {
    let folder = tempfile::tempdir().unwrap();
    let cache = Cache::at(folder.path().join("assets"));
    (folder, cache)
}

fn put(folder: &Path, name: &str, bytes: &[u8]) -> String {
    let path = folder.join(name);
    fs::write(&path, bytes).unwrap();
    format!("file://{}", path.display())
}

fn names(folder: &Path) -> Vec<String> {
    let mut all: Vec<_> =
        fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    all.sort();
    all
}

const FILE: tar::EntryType = tar::EntryType::Regular;

#[test]
fn archives_are_unpacked_and_plain_files_are_copied() {
    let (folder, cache) = cache();
    let tar = tar_gz(&[("arm/", tar::EntryType::Directory, ""), ("./arm/arm.urdf", FILE, "<robot/>")]);
    let zip = zip_of(&[("arm/arm.urdf", "<robot/>"), ("arm-1.0.dist-info/RECORD", "")]);
    for (name, bytes) in [("a.tar.gz", tar), ("no ending", zip.clone()), ("arm-1.0-py3-none-any.whl", zip)] {
        let asset = asset(&put(folder.path(), name, &bytes).replace(' ', "%20"), &bytes);
        let mut log = ProgressLog::default();
        let at = cache.fetch(&asset, &mut log).unwrap();
        assert_eq!(log.most, bytes.len() as u64, "{name}");
        assert_eq!(fs::read_to_string(at.join("arm/arm.urdf")).unwrap(), "<robot/>", "{name}");
        assert!(cache.has(&asset.sha256.to_uppercase()) && cache.size(&asset.sha256) == 8, "{name}");
        assert_eq!(cache.remove(&asset), Ok(true));
        assert_eq!((cache.has(&asset.sha256), cache.remove(&asset)), (false, Ok(false)));
    }
    // A compressed file that is not an archive is kept unchanged.
    let mut gz = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    gz.write_all(b"solid").unwrap();
    for (name, bytes) in [("hand.stl", b"solid".to_vec()), ("hand.stl.gz", gz.finish().unwrap())] {
        let asset = asset(&put(folder.path(), name, &bytes), &bytes);
        let at = cache.fetch(&asset, &mut NoProgress).unwrap();
        assert_eq!((names(&at), fs::read(at.join(name)).unwrap()), (vec![name.to_owned()], bytes));
    }
    let left = names(&cache.0);
    assert!(left.iter().all(|name| !name.ends_with(".part") && !name.ends_with(".new")), "{left:?}");
}

#[test]
fn a_cached_asset_is_not_downloaded_again() {
    let (_folder, cache) = cache();
    let server = FileServer::new(b"<robot/>".to_vec(), &[]);
    let asset = asset(&server.url("a%20b.urdf?raw=1"), b"<robot/>");
    for _ in 0..3 {
        assert!(cache.fetch(&asset, &mut NoProgress).unwrap().join("a b.urdf").is_file());
    }
    assert_eq!(server.ranges().len(), 1);
}

#[test]
fn an_interrupted_download_resumes() {
    let (_folder, cache) = cache();
    let file = noise(300_000);
    let misdeeds = [Misdeed::Cut(100_000), Misdeed::Status(503), Misdeed::Cut(50_000)];
    let server = FileServer::new(file.clone(), &misdeeds);
    let asset = asset(&server.url("arm.bin"), &file);
    let mut log = ProgressLog::default();
    let at = cache.fetch(&asset, &mut log).unwrap();
    assert_eq!(fs::read(at.join("arm.bin")).unwrap(), file);
    assert_eq!(server.ranges(), ["", "bytes=100000-", "bytes=100000-", "bytes=150000-"]);
    assert!(log.notes[0].contains("was interrupted after 100000 bytes"), "{:?}", log.notes);
}

#[test]
fn a_partial_download_of_an_earlier_process_is_used_and_checked() {
    let (_folder, cache) = cache();
    let file = noise(10_000);
    let fetch = |left: &[u8], misdeeds: &[Misdeed]| {
        let server = FileServer::new(file.clone(), misdeeds);
        let asset = asset(&server.url("arm.bin"), &file);
        fs::create_dir_all(&cache.0).unwrap();
        fs::write(cache.file(&asset.sha256, ".part"), left).unwrap();
        assert_eq!(cache.part(&asset.sha256), Some(left.len() as u64));
        let at = cache.fetch(&asset, &mut NoProgress).unwrap();
        assert_eq!(fs::read(at.join("arm.bin")).unwrap(), file);
        cache.remove(&asset).unwrap();
        server.ranges()
    };
    assert_eq!(fetch(&file[..4_000], &[]), ["bytes=4000-"]);
    assert_eq!(fetch(&file, &[]), ["bytes=10000-"], "complete file");
    assert_eq!(fetch(&file[..4_000], &[Misdeed::NoRanges]), ["bytes=4000-"], "restarted by the server");
    assert_eq!(fetch(&file[..4_000], &[Misdeed::WrongRange]), ["bytes=4000-", ""]);
    assert_eq!(fetch(&[7; 4_000], &[]), ["bytes=4000-", ""], "another file's beginning");
    assert_eq!(fetch(&[7; 20_000], &[]), ["bytes=20000-", ""], "another, longer file");
}

#[test]
fn a_file_with_another_checksum_is_rejected_and_discarded() {
    let (folder, cache) = cache();
    let mut asset = asset(&put(folder.path(), "arm.urdf", b"<robot/>"), b"another");
    let error = cache.fetch(&asset, &mut NoProgress).unwrap_err();
    assert!(error.what.starts_with("cell.yaml:3:5: the asset `arm`: file://"), "{error}");
    assert!(error.what.contains(&sum(b"<robot/>")) && error.what.contains(&sum(b"another")), "{error}");
    assert!(!cache.has(&asset.sha256) && cache.part(&asset.sha256).is_none());
    asset.sha256 = "../../../etc".into();
    assert!(cache.fetch(&asset, &mut NoProgress).unwrap_err().what.contains("64 hexadecimal digits"));
}

#[test]
fn after_a_resumed_download_the_error_names_the_checksum_of_the_whole_file() {
    let (_folder, cache) = cache();
    let served = noise(10_000);
    let server = FileServer::new(served.clone(), &[]);
    let asset = asset(&server.url("arm.bin"), b"another");
    fs::create_dir_all(&cache.0).unwrap();
    fs::write(cache.file(&asset.sha256, ".part"), [7; 4_000]).unwrap();
    let error = cache.fetch(&asset, &mut NoProgress).unwrap_err();
    assert!(error.what.contains(&sum(&served)), "{error}");
}

#[test]
fn an_unreachable_server_or_a_missing_file_is_reported() {
    let (folder, cache) = cache();
    let nobody = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let error = cache.fetch(&asset(&format!("http://{nobody}/a.zip"), b""), &mut NoProgress).unwrap_err();
    assert!(error.what.contains(&format!("{nobody}/a.zip: connection refused")), "{error}");
    assert!(error.hint.unwrap().contains("check both, and whether the server runs"));
    let secret = cache.fetch(&asset(&format!("http://me:secret@{nobody}/a.zip"), b""), &mut NoProgress).unwrap_err();
    assert!(secret.what.contains("http://me:***@") && !secret.what.contains("secret"), "{secret}");

    let server = FileServer::new(Vec::new(), &[Misdeed::Status(404)]);
    let error = cache.fetch(&asset(&server.url("a.zip"), b""), &mut NoProgress).unwrap_err();
    assert!(error.what.contains("404"), "{error}");
    assert_eq!(server.ranges().len(), 1, "permanent error");

    let server =
        FileServer::new(noise(9_000), &[Misdeed::Cut(5_000), Misdeed::Cut(0), Misdeed::Cut(0), Misdeed::Cut(0)]);
    let broken = asset(&server.url("a.zip"), &noise(9_000));
    let error = cache.fetch(&broken, &mut NoProgress).unwrap_err();
    assert!(error.what.contains("5000 bytes are kept"), "{error}");
    assert!(cache.fetch(&broken, &mut NoProgress).is_ok(), "the next attempt resumes");
    assert_eq!(server.ranges().last().unwrap(), "bytes=5000-");

    for (url, what) in
        [(format!("file://{}", folder.path().display()), "is not a file"), ("file:///nowhere/a".into(), "No such file")]
    {
        let error = cache.fetch(&asset(&url, b""), &mut NoProgress).unwrap_err();
        assert!(error.what.contains(what), "{error}");
    }
}

#[test]
fn archives_with_links_or_paths_outside_their_folder_are_rejected() {
    let (folder, cache) = cache();
    let link = tar::EntryType::Symlink;
    let long = "d/".repeat(49) + "f";
    for (what, bytes) in [
        ("leads out", tar_gz(&[("ok", FILE, "1"), ("../evil", FILE, "2")])),
        ("leads out", tar_gz(&[("a/../../evil", FILE, "2")])),
        ("leads out", tar_gz(&[("/evil", FILE, "2")])),
        ("leads out of the archive", tar_gz(&[("a", link, "/etc/passwd")])),
        ("leads out of the archive", tar_gz(&[("a", link, ".."), ("a/evil", FILE, "2")])),
        ("leads out of the archive", tar_gz(&[("d/a", link, "../../evil")])),
        ("leads out of the archive", tar_gz(&[("a", tar::EntryType::Link, "/etc/passwd")])),
        ("a folder that contains it", tar_gz(&[("d/f", FILE, "1"), ("d/a", link, ".")])),
        ("a folder that contains it", tar_gz(&[("f", FILE, "1"), ("d/a", link, "..")])),
        ("unpacked (100 times the archive)", tar_gz(&[("bomb", FILE, &"0".repeat(70 << 20))])),
        ("neither file nor folder", tar_gz(&[("a", tar::EntryType::Fifo, "")])),
        ("leads out", zip_of(&[("ok", "1"), ("../evil", "2")])),
        ("leads out", zip_of(&[("/evil", "2")])),
        ("damaged", [b"PK\x03\x04".to_vec(), noise(100)].concat()),
        ("damaged", tar_gz(&[(&long, FILE, &"1".repeat(600_000))])[..900].to_vec()),
    ] {
        let asset = asset(&put(folder.path(), "evil.bin", &bytes), &bytes);
        let error = cache.fetch(&asset, &mut NoProgress).unwrap_err();
        assert!(
            error.what.contains(what) || what == "damaged" && error.what.contains("cannot be unpacked"),
            "{what}: {error}"
        );
        assert!(!cache.has(&asset.sha256) && cache.part(&asset.sha256).is_none(), "{what}");
        let left: Vec<_> = names(&cache.0).into_iter().filter(|name| !name.ends_with(".lock")).collect();
        assert!(left.is_empty(), "{what}: {left:?}");
        assert!(!folder.path().join("evil").exists() && !cache.0.join("evil").exists(), "{what}");
    }
    let mut link = zip::ZipWriter::new(io::Cursor::new(Vec::new()));
    link.add_symlink("a", "/etc/passwd", zip::write::SimpleFileOptions::default()).unwrap();
    let bytes = link.finish().unwrap().into_inner();
    let error = cache.fetch(&asset(&put(folder.path(), "l.zip", &bytes), &bytes), &mut NoProgress).unwrap_err();
    assert!(error.what.contains("leads out of the archive"), "{error}");
}

#[test]
fn links_within_an_archive_become_copies() {
    let (folder, cache) = cache();
    let (link, hard) = (tar::EntryType::Symlink, tar::EntryType::Link);
    let tar = tar_gz(&[
        ("arm/urdf/second", link, "first.urdf"),
        ("arm/urdf/first.urdf", link, "../robot.urdf"),
        ("arm/robot.urdf", FILE, "<robot/>"),
        ("arm/hard.urdf", hard, "arm/robot.urdf"),
        ("arm/all", link, "meshes/"),
        ("arm/meshes/a.stl", FILE, "solid"),
        ("arm/lost", link, "not/part/of/it"),
    ]);
    let asset = asset(&put(folder.path(), "arm.tar.gz", &tar), &tar);
    let at = cache.fetch(&asset, &mut NoProgress).unwrap().join("arm");
    for (name, text) in [
        ("urdf/second", "<robot/>"),
        ("urdf/first.urdf", "<robot/>"),
        ("hard.urdf", "<robot/>"),
        ("all/a.stl", "solid"),
    ] {
        assert_eq!(fs::read_to_string(at.join(name)).unwrap(), text, "{name}");
        assert!(!fs::symlink_metadata(at.join(name)).unwrap().is_symlink(), "{name}");
    }
    assert!(!at.join("lost").exists());
}

#[test]
fn a_tar_is_unpacked_and_other_archives_are_refused_by_their_type() {
    let (folder, cache) = cache();
    let mut tar = Vec::new();
    io::Read::read_to_end(&mut flate2::read::GzDecoder::new(&tar_gz(&[("a/b", FILE, "1")])[..]), &mut tar).unwrap();
    let at = cache.fetch(&asset(&put(folder.path(), "a.tar", &tar), &tar), &mut NoProgress).unwrap();
    assert_eq!(fs::read_to_string(at.join("a/b")).unwrap(), "1");
    for (name, start) in [("a.tar.xz", &b"\xfd7zXZ\0"[..]), ("a.tar.bz2", b"BZh9"), ("a.tzst", b"\x28\xb5\x2f\xfd")] {
        let bytes = [start, &noise(600)].concat();
        let error = cache.fetch(&asset(&put(folder.path(), name, &bytes), &bytes), &mut NoProgress).unwrap_err();
        assert!(error.what.contains("are not supported") && error.hint.unwrap().contains("tar.gz"), "{}", error.what);
    }
}

#[test]
fn a_damaged_gzip_checksum_is_found() {
    let (folder, cache) = cache();
    let mut bytes = tar_gz(&[("a", FILE, "text")]);
    let crc = bytes.len() - 8;
    bytes[crc] ^= 1;
    let error = cache.fetch(&asset(&put(folder.path(), "a.tar.gz", &bytes), &bytes), &mut NoProgress).unwrap_err();
    assert!(error.what.contains("the archive is damaged"), "{error}");
}

#[test]
fn a_local_file_may_name_its_host() {
    let (folder, cache) = cache();
    let url = put(folder.path(), "a.urdf", b"<robot/>").replace("file://", "file://localhost");
    assert!(cache.fetch(&asset(&url, b"<robot/>"), &mut NoProgress).unwrap().join("a.urdf").is_file());
}

#[test]
fn wrong_protocols_and_circular_redirects_are_reported_at_once() {
    use std::io::{BufRead, BufReader};
    let (_folder, cache) = cache();
    // Answers each connection with the same bytes, after the first line of a request.
    let answering = |answer: String| {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        let answer = answer.replace("HERE", &address.to_string());
        std::thread::spawn(move || {
            for mut client in listener.incoming().take(12).flatten() {
                let mut line = Vec::new();
                let _ = BufReader::new(&client).read_until(b'\n', &mut line);
                let _ = client.write_all(answer.as_bytes());
            }
        });
        address
    };
    let redirect = "HTTP/1.1 302 Found\r\nlocation: http://HERE/a\r\ncontent-length: 0\r\nconnection: close\r\n\r\n";
    for (scheme, answer, what, hint) in [
        ("http", redirect, "redirects in a circle", "check the address"),
        ("http", "\x15\x03\x01\0\x02\x02\x46", "", "https:// instead of http://?"),
    ] {
        let url = format!("{scheme}://{}/a.zip", answering(answer.to_owned()));
        let mut log = ProgressLog::default();
        let error = cache.fetch(&asset(&url, b""), &mut log).unwrap_err();
        assert!(error.what.contains(what) && error.hint.as_ref().unwrap().contains(hint), "{error:?}");
        assert!(log.notes.is_empty(), "tried once: {:?}", log.notes);
    }
}

#[test]
fn passwords_are_not_shown() {
    for (url, shown) in [
        ("https://me:pw@host/a:b@c", "https://me:***@host/a:b@c"),
        ("https://me@host/a", "https://me@host/a"),
        ("file:///a:b@c", "file:///a:b@c"),
        ("http://u:p:q@h:80/", "http://u:***@h:80/"),
    ] {
        assert_eq!(without_password(url), shown);
    }
}

#[test]
fn two_concurrent_requests_download_an_asset_once() {
    let (_folder, cache) = cache();
    let file = noise(200_000);
    let server = FileServer::new(file.clone(), &[]);
    let asset = asset(&server.url("arm.bin"), &file);
    let start = Barrier::new(4);
    std::thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(|| {
                start.wait();
                let at = cache.fetch(&asset, &mut NoProgress).unwrap();
                assert_eq!(fs::read(at.join("arm.bin")).unwrap(), file);
            });
        }
    });
    assert_eq!(server.ranges().len(), 1);
}

#[test]
fn paths_into_assets_are_split() {
    assert_eq!(split("asset:panda/urdf/panda.urdf"), Some(("panda", "urdf/panda.urdf")));
    assert_eq!(split("asset:panda"), Some(("panda", "")));
    assert_eq!(split("panda.urdf"), None);
}
