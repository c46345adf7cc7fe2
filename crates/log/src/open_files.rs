//! The files of a log that are open: a log may have more of them than a process may open.

use std::collections::VecDeque;
use std::path::Path;

use super::records::{RecordReader, ReplayError};

/// Files that are open at a time, at most.
const MAX_OPEN: usize = 16;

/// Readers of the files that were used last, by index.
#[derive(Default)]
pub struct OpenFiles(VecDeque<(usize, RecordReader)>);

impl OpenFiles {
    /// Takes the reader of a file, which is opened if it is not.
    pub fn take(&mut self, file: usize, path: &Path) -> Result<RecordReader, ReplayError> {
        let open = self.0.iter().position(|(known, _)| *known == file).and_then(|at| self.0.remove(at));
        match open {
            Some((_, records)) => Ok(records),
            None => Ok(RecordReader::open(path)?.with_attachments()),
        }
    }

    /// Keeps a reader for the next time.
    pub fn keep(&mut self, file: usize, records: RecordReader) {
        if self.0.len() >= MAX_OPEN {
            self.0.pop_front();
        }
        self.0.push_back((file, records));
    }
}
