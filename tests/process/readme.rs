//! README as a newcomer reads it: its commands, word by word and in its order, in terminals of several widths. Tables
//! fit, and what is redrawn is there once.

use rustix::process::Signal;

use crate::support::program::{Home, Started, eventually};
use crate::support::terminal::Terminal;

const README: &str = include_str!("../../README.md");
/// Rows of a terminal that shows all that a verb prints, and of one in which a replay is redrawn.
const ALL: u16 = 120;
const WINDOW: u16 = 24;

/// The commands of README's quick start, without the first one, which builds.
fn quick_start() -> Vec<&'static str> {
    let part = README.split("## Quick start").nth(1).unwrap().split("\n## ").next().unwrap();
    let lines = part.split("```sh\n").skip(1).flat_map(|block| block.split("```").next().unwrap().lines());
    let commands = lines.flat_map(|line| line.split('#').next().unwrap().split("&&"));
    commands.filter_map(|command| command.trim().strip_prefix("dimos ")).collect()
}

/// The commands of the table below it.
fn every_day() -> Vec<&'static str> {
    let part = README.split("## Every day").nth(1).unwrap().split("\n## ").next().unwrap();
    let words = part.lines().filter(|line| line.starts_with("| ")).flat_map(|line| line.split('`').skip(1).step_by(2));
    words.filter_map(|command| command.strip_prefix("dimos ")).collect()
}

/// Starts a run as typed, in a terminal.
fn start(home: &Home, name: &str, columns: u16) -> (Started, Terminal) {
    let terminal = Terminal::new(columns, ALL);
    let run = terminal.start(home, &format!("run {name} --no-view"));
    eventually("the run is up", || home.dimos("state").code == Some(0));
    fits(&terminal, columns, name);
    (run, terminal)
}

/// No line is wider than the terminal but one with a path; at 50 columns, prose, and names of logs.
#[track_caller]
fn fits(terminal: &Terminal, columns: u16, command: &str) {
    let is_prose = |line: &String| columns < 80 && (command == "log list" || !line.trim().contains("  "));
    let wrapped = terminal.wrapped().into_iter().filter(|line| !line.contains('/') && !is_prose(line));
    assert_eq!(wrapped.collect::<Vec<_>>(), [""; 0], "`{command}` at {columns} columns:\n{}", terminal.text());
}

/// Runs a command to its end, in a terminal.
#[track_caller]
fn shows(home: &Home, command: &str, columns: u16) {
    let terminal = Terminal::new(columns, ALL);
    let ended = terminal.start(home, command).wait();
    // `doctor` fails on a computer that it finds wanting.
    assert!(ended.code == Some(0) || command == "doctor", "`{command}`: {ended:?}\n{}", terminal.text());
    fits(&terminal, columns, command);
    assert!(!terminal.text().contains("[=") || command.contains("replay"), "a bar is left:\n{}", terminal.text());
}

/// A replay is redrawn twenty times a second: its table and its bar are there once, also when it pauses.
#[track_caller]
fn replays(home: &Home, command: &str, columns: u16) {
    let terminal = Terminal::new(columns, WINDOW);
    let replay = terminal.start(home, command);
    terminal.until("1.");
    for key in [" ", " "] {
        std::thread::sleep(std::time::Duration::from_secs(1));
        terminal.keys(key);
    }
    std::thread::sleep(std::time::Duration::from_secs(2));
    let text = terminal.text();
    let lines = |what: &str| text.lines().filter(|line| line.trim_start().starts_with(what)).count();
    assert_eq!((lines("joint "), lines("[")), (1, 1), "at {columns} columns:\n{text}");
    fits(&terminal, columns, command);
    terminal.keys("q");
    replay.wait().with(0);
}

fn readme_at(columns: u16) {
    let home = Home::new();
    let (run, terminal) = start(&home, "coordinator-yourarm", columns);
    let commands = quick_start();
    assert!(commands.len() >= 6 && commands.contains(&"replay --last"), "{commands:?}");
    for command in commands {
        match command {
            "replay --last" => replays(&home, command, columns),
            command => shows(&home, command, columns),
        }
    }
    shows(&home, "state", columns);
    run.end(Signal::INT).with(130);
    fits(&terminal, columns, "its end");

    let (run, _terminal) = start(&home, "yourarm-planner", columns);
    let job = include_str!("../../docs/jobs.md").split("```yaml\n").nth(1).unwrap().split("```").next().unwrap();
    home.write("pick.yaml", job);
    shows(&home, "world add part --sphere 0.01 --at 0.243 0 0.2", columns);
    let commands = every_day();
    assert!(commands.len() >= 8, "{commands:?}");
    // These last until somebody ends them.
    let lasts = |command: &str| command.starts_with("run ") || matches!(command, "view" | "top");
    for command in commands.into_iter().filter(|command| !lasts(command)) {
        shows(&home, command, columns);
    }
    run.end(Signal::INT).with(130);
}

#[test]
fn at_80_columns() {
    readme_at(80);
}

#[test]
fn at_50_columns() {
    readme_at(50);
}

#[test]
fn at_200_columns() {
    readme_at(200);
}
