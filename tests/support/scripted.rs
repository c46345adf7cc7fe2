//! A script of another program that answers line by line: to each line of JSON with one of its own.

use std::io::{BufRead, BufReader, Write};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use serde_json::{Value, json};

/// The running script; ends when dropped.
pub struct Scripted {
    child: Child,
    to: ChildStdin,
    from: BufReader<ChildStdout>,
}

impl Scripted {
    pub fn start(command: &mut Command) -> Self {
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
        let (to, from) = (child.stdin.take().unwrap(), BufReader::new(child.stdout.take().unwrap()));
        Self { child, to, from }
    }

    /// Sends a line with all of these; its answer.
    #[track_caller]
    pub fn say(&mut self, mut line: Value, more: Value) -> Value {
        line.as_object_mut().unwrap().extend(more.as_object().cloned().unwrap_or_default());
        writeln!(self.to, "{line}").unwrap();
        let mut answer = String::new();
        self.from.read_line(&mut answer).unwrap();
        serde_json::from_str(&answer).unwrap_or_else(|e| panic!("{line}: {e}: {answer:?}"))
    }

    /// Does what the script names so.
    #[track_caller]
    pub fn does(&mut self, what: &str, arguments: Value) -> Value {
        self.say(json!({"do": what}), arguments)
    }

    pub fn pid(&self) -> u32 {
        self.child.id()
    }
}

impl Drop for Scripted {
    fn drop(&mut self) {
        let _ = (self.child.kill(), self.child.wait());
    }
}
