//! Pages for those who begin: every command in them is run, as written, with emulated arms. Those of the arms begin
//! with a picture and five lines.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use crate::support::program::{Home, Started, UP};

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn read(page: &str) -> String {
    std::fs::read_to_string(root().join("docs").join(page)).unwrap()
}

/// The code blocks of a page in a language.
fn blocks(page: &str, language: &str) -> Vec<String> {
    let open = format!("```{language}\n");
    page.split(&open).skip(1).map(|rest| rest.split("```").next().unwrap().to_owned()).collect()
}

/// Words as a shell splits them.
fn words(line: &str) -> Vec<String> {
    let quoted = line.split('"').enumerate();
    let words = quoted.flat_map(|(index, part)| match index % 2 {
        0 => part.split_whitespace().map(str::to_owned).collect::<Vec<_>>(),
        _ => vec![part.to_owned()],
    });
    words.collect()
}

/// A user who types what a page shows.
struct Reader {
    home: Home,
    runs: Vec<Started>,
}

impl Reader {
    fn new() -> Self {
        Self { home: Home::new(), runs: Vec::new() }
    }

    /// Runs one line to its end; a run, until it is up.
    #[track_caller]
    fn types(&mut self, line: &str) {
        let line = line.split(" #").next().unwrap().trim();
        let command = match line.split_once(' ') {
            Some(("dimos", arguments)) if arguments.starts_with("run ") => {
                let run = self.home.start(&format!("{arguments} --sim"));
                run.until(if self.runs.is_empty() { UP } else { "attached to run" });
                return self.runs.push(run);
            }
            Some(("dimos", arguments)) => {
                let mut command = Command::new(env!("CARGO_BIN_EXE_dimos"));
                command.args(words(arguments)).env("PYTHONPATH", root().join("tests/python/recorded"));
                command
            }
            Some(("python3", file)) => {
                let mut command = Command::new("python3");
                command.arg(file).env("PYTHONPATH", root().join("assets/python"));
                command
            }
            _ => panic!("{line}: neither dimos nor python3"),
        };
        let mut command = command;
        let ended = Started::of(self.home.settle(&mut command).stdin(Stdio::null())).wait();
        assert_eq!(ended.code, Some(0), "{line}\n{}{}", ended.out, ended.err);
        if line == "dimos down" {
            self.runs.drain(..).for_each(|run| drop(run.wait().with(0)));
        }
    }

    /// Runs everything that a page shows, and writes the files that it shows.
    #[track_caller]
    fn reads(mut self, page: &str) {
        for file in blocks(page, "python") {
            if let Some(name) = file.strip_prefix("# ").and_then(|rest| rest.split([';', '\n']).next()) {
                self.home.write(name, &file);
            }
        }
        let lines: Vec<String> =
            blocks(page, "sh").iter().flat_map(|block| block.lines().map(str::to_owned).collect::<Vec<_>>()).collect();
        assert!(lines.len() >= 4, "{lines:?}");
        lines.iter().for_each(|line| self.types(line));
    }
}

#[test]
fn from_ros() {
    Reader::new().reads(&read("from-ros.md"));
}

#[test]
fn from_a_vendors_sdk() {
    Reader::new().reads(&read("from-vendor-sdk.md"));
}

#[test]
fn from_python_dimos() {
    Reader::new().reads(&read("from-python-dimos.md"));
}

#[test]
fn from_lerobot() {
    Reader::new().reads(&read("from-lerobot.md"));
}

/// The pages that begin with where somebody comes from are read at one sitting.
#[test]
fn pages_for_newcomers_are_short() {
    for page in ["from-ros.md", "from-vendor-sdk.md", "from-python-dimos.md", "from-lerobot.md"] {
        let words = read(page).split_whitespace().count();
        assert!(words <= 600, "{page} has {words} words");
    }
}

/// Picture and five lines at the head of an arm's page.
fn begins(arm: &str) {
    let page = read(&format!("arms/{arm}.md"));
    let mut parts = page.split("\n\n").skip(1);
    let picture = parts.next().unwrap();
    let path =
        picture.split_once("](").and_then(|(_, rest)| rest.strip_suffix(')')).unwrap_or_else(|| panic!("{picture}"));
    let path: PathBuf = root().join("docs/arms").join(path);
    let bytes = std::fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    assert!(
        bytes.starts_with(b"RIFF") && (5_000..=60_000).contains(&bytes.len()),
        "{}: {}",
        path.display(),
        bytes.len()
    );
    let lines = parts.next().unwrap().strip_prefix("```sh\n").unwrap().strip_suffix("\n```").unwrap();
    assert_eq!(lines.lines().count(), 5, "{lines}");
    let mut reader = Reader::new();
    lines.lines().for_each(|line| reader.types(line));
}

macro_rules! pages {
    ($($test:ident: $arm:literal;)*) => { $(
        #[test]
        fn $test() {
            begins($arm);
        }
    )* };
}

pages! {
    the_page_of_the_xarm: "xarm";
    the_page_of_the_ur: "ur";
    the_page_of_the_franka: "franka";
    the_page_of_the_so101: "so101";
}

#[test]
#[cfg(feature = "can")]
fn the_page_of_the_piper() {
    begins("piper");
}
