//! Hands rows of numbers to Python, which writes them with the writers of the field: `assets/python/dimos_export.py`.

use std::ffi::OsString;
use std::io::{self, BufRead, BufReader, BufWriter, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::thread::{self, JoinHandle};

use serde_json::Value;

use super::export::cannot_write;
use crate::cli::exit::{Failure, Result};

const SCRIPT: &str = include_str!("../../../assets/python/dimos_export.py");
/// Names another interpreter than `python3`, such as that of a virtual environment.
const PYTHON: &str = "DIMOS_PYTHON";
/// The script's exit code if a package is missing.
const MISSING: i32 = 3;

/// The program in Python that writes one file or folder. Dropped before its end, it writes nothing more.
pub struct PythonWriter {
    child: Child,
    rows: Option<BufWriter<ChildStdin>>,
    errors: Option<JoinHandle<String>>,
    to: PathBuf,
}

impl Drop for PythonWriter {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl PythonWriter {
    /// Starts it. `format`: `parquet` or `lerobot`; `package`: what `pip` installs for it; `header`: the columns.
    ///
    /// # Errors
    /// Python or the package is missing: a failure of usage. `to` exists or cannot be written.
    pub fn start(format: &str, package: &str, to: &Path, header: &Value) -> Result<Self> {
        if to.symlink_metadata().is_ok() {
            return Err(cannot_write(to, io::ErrorKind::AlreadyExists.into()));
        }
        let python = std::env::var_os(PYTHON).unwrap_or_else(|| OsString::from("python3"));
        let shown = Path::new(&python).display();
        let mut command = Command::new(&python);
        command.args(["-c", SCRIPT, format]).arg(std::path::absolute(to).map_err(|e| cannot_write(to, e))?);
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().map_err(|e| {
            let what = format!("Python writes {format} files, and {shown} does not start: {e}");
            Failure::usage(what).hint(format!("install Python 3, or set {PYTHON} to another interpreter"))
        })?;
        let broken = || cannot_write(to, io::ErrorKind::BrokenPipe.into());
        let mut out = BufReader::new(child.stdout.take().ok_or_else(broken)?);
        let mut err = child.stderr.take().ok_or_else(broken)?;
        let errors = thread::spawn(move || {
            let mut text = Vec::new();
            let _ = err.read_to_end(&mut text);
            String::from_utf8_lossy(&text).into_owned()
        });
        let rows = child.stdin.take().map(BufWriter::new);
        let mut ready = String::new();
        let _ = out.read_line(&mut ready);
        // What a library prints is not ours to print.
        thread::spawn(move || io::copy(&mut out, &mut io::sink()));
        let mut writer = Self { child, rows, errors: Some(errors), to: to.to_owned() };
        if ready.trim() != "ready" {
            let (code, text) = writer.end();
            return Err(match code {
                Some(MISSING) => Failure::usage(format!("{shown} has no package to write {format} files: {text}"))
                    .hint(format!("{shown} -m pip install {package}, or set {PYTHON} to a Python that has it")),
                _ => cannot_write(to, io::Error::other(text)),
            });
        }
        writer.write(format!("{header}\n").as_bytes())?;
        Ok(writer)
    }

    /// Writes a row: numbers of 8 bytes, little endian.
    pub fn row(&mut self, cells: impl IntoIterator<Item = [u8; 8]>) -> Result<()> {
        cells.into_iter().try_for_each(|cell| self.write(&cell))
    }

    fn write(&mut self, bytes: &[u8]) -> Result<()> {
        let written = self.rows.as_mut().map_or(Ok(()), |rows| rows.write_all(bytes));
        written.map_err(|e| self.failed(e))
    }

    /// Ends the file.
    pub fn finish(mut self) -> Result<()> {
        if let Err(e) = self.rows.as_mut().map_or(Ok(()), Write::flush) {
            return Err(self.failed(e));
        }
        match self.end() {
            (Some(0), _) => Ok(()),
            (_, text) => Err(cannot_write(&self.to, io::Error::other(text))),
        }
    }

    /// What Python says explains a closed pipe better than the pipe does.
    fn failed(&mut self, e: io::Error) -> Failure {
        let (_, text) = self.end();
        cannot_write(&self.to, if text.is_empty() { e } else { io::Error::other(text) })
    }

    /// Closes its input and waits for its end. Returns the exit code and the last line of what it wrote.
    fn end(&mut self) -> (Option<i32>, String) {
        // What is left to write has failed before, or was flushed.
        drop(self.rows.take().map(BufWriter::into_parts));
        let code = self.child.wait().ok().and_then(|status| status.code());
        let text = self.errors.take().and_then(|errors| errors.join().ok()).unwrap_or_default();
        (code, text.trim_end().lines().next_back().unwrap_or_default().to_owned())
    }
}
