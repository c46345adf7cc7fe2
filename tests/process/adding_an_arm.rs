//! `docs/adding-an-arm.md`, executed from its beginning to its end.
//!
//! Blocks and what becomes of them: `console`: the lines after `$ ` are run by a shell, the lines below each are what
//! they must print, loosely (`…`: anything). `console up=TERMINAL`: the same, and the last command keeps running in
//! that terminal until the next such block. `rust in=FILE`, `xml in=FILE`: FILE contains these lines. `diff in=FILE`:
//! the change is made there. `yaml file=NAME`, `python …`, `xml …`: the file is written. `checkout=NAME`: a copy of
//! this checkout. `needs=ARM`: only where the table has that arm.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process_group};
use std::os::unix::process::CommandExt;

use crate::support::crates::{programs, share_builds, without_cargo_settings};
use crate::support::loopback::own_address;
use crate::support::program::{Home, Started};
use crate::support::skip::skip;

const PAGE: &str = include_str!("../../docs/adding-an-arm.md");
/// The longest that a command may take: the first builds all of dimos for another crate, on a busy machine.
const TIMEOUT: Duration = Duration::from_secs(1500);

/// A fenced block.
struct Block {
    line: usize,
    kind: String,
    words: Vec<String>,
    text: String,
}

impl Block {
    fn value(&self, key: &str) -> Option<&str> {
        self.words.iter().find_map(|word| word.strip_prefix(key)?.strip_prefix('='))
    }
}

fn blocks(page: &str) -> Vec<Block> {
    let (mut blocks, mut open) = (Vec::new(), None::<Block>);
    for (i, line) in page.lines().enumerate() {
        match (line.strip_prefix("```"), &mut open) {
            (Some(_), Some(_)) => blocks.extend(open.take()),
            (Some(info), None) => {
                let mut words = info.split_whitespace().map(str::to_owned);
                let kind = words.next().unwrap_or_default();
                open = Some(Block { line: i + 1, kind, words: words.collect(), text: String::new() });
            }
            (None, Some(block)) => block.text += &format!("{line}\n"),
            (None, None) => {}
        }
    }
    assert!(open.is_none(), "a block is not closed");
    blocks
}

/// Whether a text says what is expected: its lines in that order, `…` for anything within a line, and for any lines
/// when alone on its line.
fn says(text: &str, expected: &[&str]) -> Result<(), String> {
    let mut lines = text.lines();
    let mut anything = false;
    for wanted in expected {
        if wanted.trim() == "…" {
            anything = true;
            continue;
        }
        let found = if anything {
            lines.by_ref().any(|line| like(line, wanted))
        } else {
            lines.next().is_some_and(|line| like(line, wanted))
        };
        if !found {
            return Err(format!("no line like {wanted:?}"));
        }
        anything = false;
    }
    let rest = lines.next();
    if anything || rest.is_none() { Ok(()) } else { Err(format!("nothing is expected after that, but {rest:?}")) }
}

/// Whether a line is like a pattern, spaces apart.
fn like(line: &str, pattern: &str) -> bool {
    let squeezed = |text: &str| text.split_whitespace().collect::<Vec<_>>().join(" ");
    let (line, pattern) = (squeezed(line), squeezed(pattern));
    let mut parts: VecDeque<&str> = pattern.split('…').map(str::trim).collect();
    let (first, last) = (parts.pop_front().unwrap_or_default(), parts.pop_back());
    let Some(mut rest) = line.strip_prefix(first) else { return false };
    let Some(last) = last else { return rest.is_empty() };
    for part in parts {
        let Some(at) = rest.find(part) else { return false };
        rest = &rest[at + part.len()..];
    }
    rest.ends_with(last)
}

/// A reader who follows the page.
struct Reader {
    home: Home,
    /// Where the shell is.
    folder: PathBuf,
    path: String,
    /// The running commands, with their terminals.
    up: Vec<(Started, String, String)>,
}

impl Reader {
    fn new() -> Self {
        let home = Home::new();
        let path = format!("{}:{}", programs().display(), std::env::var("PATH").unwrap());
        Self { folder: home.path().to_owned(), home, path, up: Vec::new() }
    }

    fn shell(&self, line: &str) -> Command {
        let mut command = Command::new("bash");
        // Cargo's own folders are the user's, not this home's.
        let real = |name: &str, folder: &str| {
            std::env::var(name).unwrap_or_else(|_| format!("{}/{folder}", std::env::var("HOME").unwrap()))
        };
        let (cargo, rustup) = (real("CARGO_HOME", ".cargo"), real("RUSTUP_HOME", ".rustup"));
        self.home.settle(command.args(["-o", "pipefail", "-c", line]));
        command.env("PATH", &self.path).env("CARGO_HOME", cargo).env("RUSTUP_HOME", rustup);
        without_cargo_settings(&mut command);
        command.env("DIMOS", env!("CARGO_MANIFEST_DIR")).env("NO_COLOR", "1");
        command.current_dir(&self.folder).stdin(Stdio::null());
        command
    }

    fn run(&mut self, command: &str, expected: &[&str]) {
        if let Some(folder) = command.strip_prefix("cd ") {
            self.folder = self.folder.join(folder);
            assert!(self.folder.is_dir(), "{command}");
            if self.folder.join("Cargo.toml").is_file() {
                share_builds(&self.folder);
            }
            return;
        }
        if let Some(path) = command.strip_prefix("export PATH=") {
            self.path = path.replace("$PWD", self.folder.to_str().unwrap()).replace("$PATH", &self.path);
            return;
        }
        let began = Instant::now();
        let started = Started::of(&mut self.shell(command));
        while !started.over() {
            assert!(began.elapsed() < TIMEOUT, "{command}: does not end\n{}{}", started.out(), started.err());
            std::thread::sleep(Duration::from_millis(10));
        }
        let ended = started.wait();
        println!("$ {command}  [{:.1} s]", began.elapsed().as_secs_f64());
        let (out, err) = (&ended.out, &ended.err);
        assert_eq!(ended.code, Some(0), "{command}\n{out}{err}");
        if let Err(why) = says(out, expected) {
            panic!("{command}: {why} in\n{out}{err}");
        }
    }

    /// Starts a command that runs until the next one in its terminal.
    fn up(&mut self, terminal: &str, command: &str, expected: &[&str]) {
        self.down(|other| other == terminal);
        let began = Instant::now();
        let started = Started::of(self.shell(&format!("exec {command}")).process_group(0));
        loop {
            let text = format!("{}{}", started.out(), started.err());
            // Stalls of this computer are not part of the page.
            let text: String = text.split_inclusive('\n').filter(|line| !line.contains(" WARN overrun: ")).collect();
            match says(&text, expected) {
                Ok(()) => break,
                Err(why) => assert!(began.elapsed() < Duration::from_secs(60), "{command}: {why} in\n{text}"),
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        println!("$ {command}  [keeps running]");
        self.up.push((started, command.to_owned(), terminal.to_owned()));
    }

    /// Ctrl-C in terminals, the last first.
    fn down(&mut self, which: impl Fn(&str) -> bool) {
        for index in (0..self.up.len()).rev().filter(|index| which(&self.up[*index].2)).collect::<Vec<_>>() {
            let (started, command, _) = self.up.remove(index);
            kill_process_group(Pid::from_raw(started.pid() as i32).unwrap(), Signal::INT).unwrap();
            let ended = started.wait();
            assert!(matches!(ended.code, Some(0 | 130)), "{command}: {:?}\n{}{}", ended.code, ended.out, ended.err);
        }
    }
}

/// A copy of what is needed of this checkout.
fn check_out(into: &Path) {
    let copy = format!("mkdir {0} && cp -r Cargo.toml src crates blueprints {0}", into.display());
    let done = Command::new("sh").args(["-c", &copy]).current_dir(env!("CARGO_MANIFEST_DIR")).status().unwrap();
    assert!(done.success());
}

/// Commands and what each must say.
fn commands(text: &str) -> Vec<(&str, Vec<&str>)> {
    let mut commands: Vec<(&str, Vec<&str>)> = Vec::new();
    for line in text.lines() {
        match (line.strip_prefix("$ "), commands.last_mut()) {
            (Some(command), _) => commands.push((command, Vec::new())),
            (None, Some((_, expected))) => expected.push(line),
            (None, None) => panic!("output without a command: {line}"),
        }
    }
    commands
}

/// Checks that a file contains the lines of a block, in that order; `…` for lines between.
fn contains_lines(file: &Path, block: &str) {
    let text = std::fs::read_to_string(file).unwrap();
    let mut rest = text.as_str();
    for part in block.split("…\n") {
        let at = rest.find(part.trim_end()).unwrap_or_else(|| panic!("not in {}:\n{part}", file.display()));
        rest = &rest[at..];
    }
}

/// Makes the change that a block shows.
fn change(file: &Path, block: &str) {
    let part = |sign: char| -> String {
        block.lines().filter_map(|line| line.strip_prefix(sign)).map(|line| format!("{line}\n")).collect()
    };
    let text = std::fs::read_to_string(file).unwrap();
    assert_eq!(text.matches(&part('-')).count(), 1, "once in {}:\n{}", file.display(), part('-'));
    std::fs::write(file, text.replace(&part('-'), &part('+'))).unwrap();
}

#[test]
fn every_command_of_the_page_works() {
    let page = PAGE.replace("127.0.0.9", &own_address().to_string());
    let mut reader = Reader::new();
    let mut made = 0;
    for block in blocks(&page) {
        if let Some(arm) = block.value("needs").filter(|arm| !dimos::arms::available().contains(arm)) {
            skip(&format!("line {}: the arm {arm} (its cargo feature)", block.line));
            continue;
        }
        println!("--- line {}", block.line);
        if let Some(name) = block.value("checkout") {
            check_out(&reader.folder.join(name));
        }
        match (block.kind.as_str(), block.value("in"), block.value("file")) {
            ("console", ..) => {
                let mut commands = commands(&block.text);
                let last = block.value("up").and_then(|terminal| Some((terminal.to_owned(), commands.pop()?)));
                commands.iter().for_each(|(command, expected)| reader.run(command, expected));
                last.iter().for_each(|(terminal, (command, expected))| reader.up(terminal, command, expected));
            }
            ("rust" | "xml", Some(file), _) => contains_lines(&reader.folder.join(file), &block.text),
            ("diff", Some(file), _) => change(&reader.folder.join(file), &block.text),
            ("yaml" | "python" | "xml", _, Some(file)) => {
                std::fs::write(reader.folder.join(file), &block.text).unwrap()
            }
            ("text", None, None) => continue,
            _ => panic!("line {}: nothing is known of {:?} {:?}", block.line, block.kind, block.words),
        }
        made += 1;
    }
    reader.down(|_| true);
    assert!(made > 15, "{made} blocks");
}

#[test]
fn the_table_has_every_method_of_the_trait() {
    let spec = include_str!("../../crates/hardware/src/adapter.rs");
    let body = spec.split("pub trait ManipulatorAdapter").nth(1).unwrap();
    let methods: Vec<&str> =
        body.lines().filter_map(|line| line.strip_prefix("    fn ")?.split(['(', '<']).next()).collect();
    assert!(methods.len() > 25, "{methods:?}");
    for method in methods {
        assert!(PAGE.lines().any(|line| line.starts_with('|') && line.contains(&format!("`{method}"))), "{method}");
    }
}

#[test]
fn expectations_can_fail() {
    assert!(says("a b\nc\n", &["a …", "c"]).is_ok());
    assert!(says("a b\nx\nc d\n", &["a b", "…", "c …"]).is_ok());
    assert!(says("a b\nc\n", &["a b"]).is_err(), "more than expected");
    assert!(says("a b\n", &["a b", "c"]).is_err(), "less than expected");
    assert!(says("a\n", &["b"]).is_err());
    assert!(like("passed   1  position  ±2.00", "passed 1 position …") && !like("failed 1", "passed …"));
    assert!(like("12 checks passed, 0 failed, 3 do", "… 0 failed, …") && !like("2 failed, 0", "… 0 failed, …"));
    assert_eq!(blocks("x\n```console up\n$ a\n```\n")[0].words, ["up"]);
}
