//! Targets of a stream, one per line, from a file or stdin; mistakes are reported with their line.

use std::fs::File;
use std::io::{self, BufRead, BufReader, Read};
use std::path::Path;
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::time::Duration;

use super::exit::{Failure, Result};

/// Maximum length of a line [bytes].
const MAX_LINE: u64 = 64 * 1024;
/// Lines queued ahead; a faster writer blocks.
const QUEUE: usize = 1;

/// Number of values of a target.
#[derive(Debug, Clone, Copy)]
pub enum Width {
    /// One per joint.
    Joints(usize),
    /// One per joint, and one for the gripper.
    JointsAndGripper(usize),
    /// Six: linear and angular velocity.
    Twist,
    /// Six or seven: position, and roll, pitch, yaw or a quaternion.
    Pose,
}

impl Width {
    fn check(self, given: usize) -> std::result::Result<(), String> {
        match (self, given) {
            (Self::Joints(joints), _) if given != joints => Err(format!("{given} numbers for {joints} joints")),
            (Self::JointsAndGripper(joints), _) if given != joints + 1 => {
                Err(format!("{given} numbers for {joints} joints and the gripper"))
            }
            (Self::Twist, _) if given != 6 => Err(format!("{given} numbers for a twist, which has 6")),
            (Self::Pose, _) if given != 6 && given != 7 => Err(format!("{given} numbers for a pose, which has 6 or 7")),
            _ => Ok(()),
        }
    }
}

/// A source of targets.
pub struct Source {
    lines: Receiver<Result<Vec<f64>>>,
    over: bool,
}

impl Source {
    /// Reads a whole file, so that a mistake in its last line moves nothing. Opens it once: it may be a pipe.
    pub fn file(path: &Path, width: Width, verb: &'static str) -> Result<Self> {
        let file = File::open(path).map_err(|e| Failure::usage(format!("{}: {e}", path.display())))?;
        let targets = Lines::new(file, path.display().to_string(), width, verb).collect::<Result<Vec<_>>>()?;
        Ok(Self::read(targets.into_iter().map(Ok)))
    }

    /// Opens stdin, read line by line. The help of `verb` shows the format.
    pub fn stdin(width: Width, verb: &'static str) -> Self {
        Self::read(Lines::new(io::stdin(), "stdin".into(), width, verb))
    }

    /// Reads on a separate thread, so that a wait for the next line can be abandoned.
    fn read(lines: impl Iterator<Item = Result<Vec<f64>>> + Send + 'static) -> Self {
        let (sender, receiver) = sync_channel(QUEUE);
        std::thread::spawn(move || {
            for line in lines {
                if sender.send(line).is_err() {
                    return;
                }
            }
        });
        Self { lines: receiver, over: false }
    }

    /// Returns the next target; `None` if none arrived within `timeout`, or at the end.
    pub fn next(&mut self, timeout: Duration) -> Result<Option<Vec<f64>>> {
        match self.lines.recv_timeout(timeout) {
            Ok(target) => target.map(Some),
            Err(RecvTimeoutError::Timeout) => Ok(None),
            Err(RecvTimeoutError::Disconnected) => {
                self.over = true;
                Ok(None)
            }
        }
    }

    /// Returns whether the source has ended.
    pub fn is_over(&self) -> bool {
        self.over
    }
}

/// Parser of the targets in a text.
struct Lines<R> {
    from: BufReader<R>,
    name: String,
    width: Width,
    /// The verb whose help shows the format.
    verb: &'static str,
    line: usize,
}

impl<R: Read> Lines<R> {
    fn new(from: R, name: String, width: Width, verb: &'static str) -> Self {
        Self { from: BufReader::new(from), name, width, verb, line: 0 }
    }

    fn mistake(&self, what: impl std::fmt::Display) -> Failure {
        Failure::usage(format!("{}:{}: {what}", self.name, self.line))
            .hint(format!("`dimos {} --help` shows the format", self.verb))
    }
}

impl<R: Read> Iterator for Lines<R> {
    type Item = Result<Vec<f64>>;

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            self.line += 1;
            let mut text = Vec::new();
            match (&mut self.from).take(MAX_LINE).read_until(b'\n', &mut text) {
                Ok(0) => return None,
                Ok(_) if text.len() as u64 == MAX_LINE => return Some(Err(self.mistake("the line is too long"))),
                Ok(_) => {}
                Err(e) => return Some(Err(self.mistake(e))),
            }
            let Ok(text) = std::str::from_utf8(&text) else { return Some(Err(self.mistake("not UTF-8"))) };
            let text = text.trim_start_matches('\u{feff}').trim();
            if text.is_empty() || text.starts_with('#') {
                continue;
            }
            let target = numbers(text).and_then(|numbers| self.width.check(numbers.len()).map(|()| numbers));
            return Some(target.map_err(|what| self.mistake(what)));
        }
    }
}

/// Parses the numbers of a line: a JSON array, or numbers separated by blanks or commas.
fn numbers(text: &str) -> std::result::Result<Vec<f64>, String> {
    if text.starts_with('[') {
        return serde_json::from_str(text).map_err(|e| e.to_string());
    }
    let cells = text.split([',', ' ', '\t', ';']).filter(|cell| !cell.is_empty());
    let number = |cell: &str| match cell.parse::<f64>() {
        Ok(value) if value.is_finite() => Ok(value),
        _ => Err(format!("{cell:?} is not a finite number")),
    };
    cells.map(number).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pipe_is_read_like_a_file() {
        use std::io::Write;
        use std::os::fd::AsRawFd;
        let (reader, mut writer) = io::pipe().unwrap();
        writer.write_all(b"1 2\n3 4\n").unwrap();
        drop(writer);
        let path = format!("/proc/self/fd/{}", reader.as_raw_fd());
        let mut source = Source::file(Path::new(&path), Width::Joints(2), "task stream").unwrap();
        let mut next = || source.next(Duration::from_secs(5)).unwrap();
        assert_eq!((next(), next(), next()), (Some(vec![1.0, 2.0]), Some(vec![3.0, 4.0]), None));
        assert!(source.is_over());
    }

    fn all(text: &str, width: usize) -> Vec<std::result::Result<Vec<f64>, String>> {
        let lines = Lines::new(text.as_bytes(), "t".into(), Width::Joints(width), "task stream");
        lines.map(|target| target.map_err(|failure| failure.what)).collect()
    }

    #[test]
    fn lines_are_json_or_numbers_and_mistakes_have_their_line() {
        let good = vec![Ok(vec![1.0, -0.5]); 4];
        assert_eq!(all("[1, -0.5]\n1 -.5\n\n# note\n1,-0.5\n 1;\t-5e-1", 2), good);
        for (text, expected) in [
            ("1 2\n3", "t:2: 1 numbers for 2 joints"),
            ("1 x", "t:1: \"x\" is not a finite number"),
            ("1 inf", "t:1: \"inf\" is not a finite number"),
            ("[1, 2", "t:1: EOF"),
            ("[1, \"2\"]", "t:1: invalid type"),
            ("[1e999, 1]", "t:1: number out of range"),
        ] {
            let last = all(text, 2).pop().unwrap().unwrap_err();
            assert!(last.starts_with(expected), "{text:?}: {last}");
        }
        for (width, fits, text) in
            [(Width::Twist, 6, "a twist, which has 6"), (Width::Pose, 7, "a pose, which has 6 or 7")]
        {
            assert!(width.check(fits).is_ok() && width.check(6).is_ok());
            let with_gripper = Width::JointsAndGripper(6);
            assert!(with_gripper.check(6).is_err() && with_gripper.check(7).is_ok() && with_gripper.check(8).is_err());
            assert_eq!(width.check(5), Err(format!("5 numbers for {text}")));
            assert_eq!(width.check(8), Err(format!("8 numbers for {text}")));
        }
        assert!(all(&"1 ".repeat(40_000), 2)[0].as_ref().unwrap_err().contains("too long"));
        assert!(all("\u{fffd}", 2)[0].is_err());
    }
}
