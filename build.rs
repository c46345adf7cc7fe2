//! What the build gives the program: its version with the commit, the shipped blueprints and templates, and the page.

use std::io::{self, Write as _};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::{env, fs};

use flate2::Compression;
use flate2::write::GzEncoder;

fn main() -> io::Result<()> {
    println!("cargo::rerun-if-changed=build.rs");
    version();
    texts("blueprints")?;
    texts("assets/templates")?;
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

/// Writes the table of names and texts of the files below a folder, as `registry.rs` and `templates.rs` include it.
fn texts(folder: &str) -> io::Result<()> {
    // Relative, as all that cargo compares: a build in a folder of another name is the same build.
    println!("cargo::rerun-if-changed={folder}");
    let root = PathBuf::from(env::var("CARGO_MANIFEST_DIR").unwrap_or_default());
    let mut files = Vec::new();
    collect(Path::new(folder), &mut files)?;
    files.sort();
    let row = |path: &PathBuf| {
        let name = path.strip_prefix(folder).unwrap_or(path).display().to_string();
        format!("    ({name:?}, include_str!({:?})),\n", root.join(path).display().to_string())
    };
    let rows: String = files.iter().map(row).collect();
    let name = Path::new(folder).file_name().unwrap_or_default();
    let out = PathBuf::from(env::var("OUT_DIR").unwrap_or_default()).join(name).with_extension("rs");
    fs::write(out, format!("&[\n{rows}]\n"))
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
    let out = PathBuf::from(env::var("OUT_DIR").unwrap_or_default()).join("page.html.gz");
    let mut file = GzEncoder::new(fs::File::create(out)?, Compression::best());
    file.write_all(&text)?;
    file.finish().map(drop)
}
