//! What a benchmark printed, as a section of docs/figures.md. `make bench` asks for it with `DIMOS_FIGURES=FILE`; each
//! benchmark replaces its own section and leaves the rest.

use std::path::Path;
use std::sync::Mutex;
use std::{env, fs};

use super::machine;

/// Titles and rows so far.
static TABLES: Mutex<Vec<(String, Vec<Vec<String>>)>> = Mutex::new(Vec::new());

/// Keeps a table for the page.
pub fn keep(title: &str, rows: &[Vec<String>]) {
    if let Ok(mut tables) = TABLES.lock() {
        tables.push((title.to_owned(), rows.to_vec()));
    }
}

/// Writes the section of this benchmark, if that was asked for. Returns whether nothing failed.
pub fn write() -> bool {
    let Some(path) = env::var_os("DIMOS_FIGURES") else { return true };
    // The executable is NAME-HASH.
    let name =
        env::current_exe().ok().and_then(|path| Some(path.file_stem()?.to_str()?.rsplit_once('-')?.0.to_owned()));
    let done = name.ok_or_else(|| "the benchmark has no name".to_owned()).and_then(|name| put(Path::new(&path), &name));
    if let Err(why) = &done {
        eprintln!("{}: {why}", path.display());
    }
    done.is_ok()
}

fn put(path: &Path, name: &str) -> Result<(), String> {
    let text = fs::read_to_string(path).map_err(|e| e.to_string())?;
    let (begin, end) = (format!("<!-- begin {name} -->\n"), format!("<!-- end {name} -->\n"));
    let (before, rest) = text.split_once(&begin).ok_or_else(|| format!("there is no line {begin}"))?;
    let (_, after) = rest.split_once(&end).ok_or_else(|| format!("there is no line {end}"))?;
    let section = section(name);
    fs::write(path, format!("{before}{begin}{section}{end}{after}")).map_err(|e| e.to_string())
}

fn section(name: &str) -> String {
    let mut out = format!("\n### {name}\n\n{}\n", machine::line());
    let tables = TABLES.lock().map(|tables| tables.clone()).unwrap_or_default();
    for (title, rows) in tables {
        let columns = rows.iter().map(Vec::len).max().unwrap_or_default();
        out += &format!("\n{title}:\n\n");
        for (n, row) in rows.iter().enumerate() {
            let cells: Vec<&str> = (0..columns).map(|c| row.get(c).map_or("", String::as_str)).collect();
            out += &format!("| {} |\n", cells.join(" | ").replace("  ", " "));
            if n == 0 {
                out += &format!("|{}\n", "---|".repeat(columns));
            }
        }
    }
    out + "\n"
}
