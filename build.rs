//! What the build tells the program: its version with the commit, the shipped blueprints, and the texts that it packs.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::{env, fs, io};

fn main() -> io::Result<()> {
    println!("cargo::rerun-if-changed=build.rs");
    version();
    blueprints()?;
    packed()?;
    page()
}

/// Sets `DIMOS_VERSION`: the package's version, with the commit where there is one: `0.1.0 (1d8ac97f)`.
fn version() {
    let git = |arguments: &[&str]| {
        let output = Command::new("git").args(arguments).output().ok()?;
        let text = String::from_utf8(output.stdout).ok()?.trim().to_owned();
        (output.status.success() && !text.is_empty()).then_some(text)
    };
    let package = env!("CARGO_PKG_VERSION");
    match git(&["rev-parse", "--short=8", "HEAD"]) {
        Some(commit) => println!("cargo::rustc-env=DIMOS_VERSION={package} ({commit})"),
        None => println!("cargo::rustc-env=DIMOS_VERSION={package}"),
    }
    // Each commit, checkout and reset adds a line to this file.
    if let Some(log) = git(&["rev-parse", "--git-path", "logs/HEAD"]).filter(|path| Path::new(path).exists()) {
        println!("cargo::rerun-if-changed={log}");
    }
}

/// Writes the table of names and texts of `blueprints/*.yaml` that `src/blueprint/registry.rs` includes.
fn blueprints() -> io::Result<()> {
    let root = PathBuf::from(env::var("CARGO_MANIFEST_DIR").unwrap_or_default());
    let out = PathBuf::from(env::var("OUT_DIR").unwrap_or_default());
    let folder = root.join("blueprints");
    // Relative, as all that cargo compares: a build in a folder of another name is the same build.
    println!("cargo::rerun-if-changed=blueprints");

    let mut files: Vec<PathBuf> = fs::read_dir(&folder)?.map(|e| e.map(|e| e.path())).collect::<Result<_, _>>()?;
    files.retain(|path| path.extension().is_some_and(|ext| ext == "yaml"));
    files.sort();

    let row = |path: &PathBuf| {
        let name = path.file_stem().unwrap_or_default().to_string_lossy();
        format!("    ({name:?}, include_str!({:?})),\n", path.display().to_string())
    };
    let rows: String = files.iter().map(row).collect();
    fs::write(out.join("blueprints.rs"), format!("&[\n{rows}]\n"))
}

const SCHEMAS: [&str; 2] = ["assets/job.schema.json", "assets/rpc.schema.json"];

/// Deflates the texts that are seldom needed, and writes the table of their names that `src/packed.rs` includes.
fn packed() -> io::Result<()> {
    let out = PathBuf::from(env::var("OUT_DIR").unwrap_or_default());
    let mut files: Vec<_> = SCHEMAS.iter().map(PathBuf::from).collect();
    for folder in ["assets/robots", "assets/templates"] {
        println!("cargo::rerun-if-changed={folder}");
        collect(Path::new(folder), &mut files)?;
    }
    SCHEMAS.iter().for_each(|file| println!("cargo::rerun-if-changed={file}"));
    files.sort();
    let mut rows = String::new();
    for (number, file) in files.iter().enumerate() {
        let text = fs::read(file)?;
        let deflated = out.join(format!("{number}.deflated"));
        fs::write(&deflated, miniz_oxide::deflate::compress_to_vec(&text, 9))?;
        let name = file.strip_prefix("assets").unwrap_or(file).display().to_string();
        rows += &format!("    ({name:?}, include_bytes!({:?})),\n", deflated.display().to_string());
    }
    fs::write(out.join("packed.rs"), format!("&[\n{rows}]\n"))
}

/// Adds the files below a folder.
fn collect(folder: &Path, files: &mut Vec<PathBuf>) -> io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let path = entry?.path();
        if path.is_dir() { collect(&path, files)? } else { files.push(path) }
    }
    Ok(())
}

/// The page of the live view, which `make viewer` makes, and the one that says so while there is none.
const PAGE: &str = "viewer/dist/index.html";
const NO_PAGE: &str = "assets/no-viewer.html";

/// Compresses the page of the live view, as browsers take it.
fn page() -> io::Result<()> {
    // The folder, not the file: a file that is missing would build the program again each time.
    let folder = Path::new(PAGE).parent().filter(|folder| folder.is_dir());
    for watched in folder.and_then(Path::to_str).into_iter().chain([NO_PAGE]) {
        println!("cargo::rerun-if-changed={watched}");
    }
    let text = fs::read(PAGE).or_else(|_| fs::read(NO_PAGE))?;
    let mut file = vec![0x1f, 0x8b, 8, 0, 0, 0, 0, 0, 2, 255];
    file.extend(miniz_oxide::deflate::compress_to_vec(&text, 9));
    file.extend(crc32(&text).to_le_bytes());
    file.extend((text.len() as u32).to_le_bytes());
    fs::write(PathBuf::from(env::var("OUT_DIR").unwrap_or_default()).join("page.html.gz"), file)
}

/// The check sum at the end of a gzip file.
fn crc32(bytes: &[u8]) -> u32 {
    let bit = |crc: u32, _| if crc & 1 == 1 { (crc >> 1) ^ 0xedb8_8320 } else { crc >> 1 };
    !bytes.iter().fold(!0, |crc, byte| (0..8).fold(crc ^ u32::from(*byte), bit))
}
