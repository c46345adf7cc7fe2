//! `dimos top` in a terminal, in a pipe, and beside runs that move, hold, hang and die.

use std::process::Stdio;

use rustix::process::Signal;
use serde_json::Value;

use crate::support::program::{Home, Started, eventually};
use crate::support::terminal::Terminal;

const RUN: &str = "coordinator-yourarm";

#[test]
fn it_shows_what_the_runs_do_until_q() {
    let (home, terminal) = (Home::new(), Terminal::new(80, 30));
    let top = terminal.start(&home, "top --hz 10");
    terminal.until("no live run");
    let run = home.run(RUN);
    for part in ["1 live run", "run coordinator-yourarm", "SIMULATED", "tick 100 Hz", "arm  ready", "overruns"] {
        terminal.until(part);
    }
    terminal.until(&home.logs()[0].file_name().unwrap().to_string_lossy()[..RUN.len()]);
    terminal.until("0.0000");

    let moving = home.start("move arm 2 -0.3 0.6 0 0.8 0 --speed 0.1");
    terminal.until("of traj_arm: EXECUTING");
    terminal.until(&format!("dimos move (pid {}", moving.pid()));
    home.dimos("speed 30%").with(0);
    terminal.until("speed 30 %");
    home.dimos("stop").with(0);
    for part in ["arm  held", "! arm is held: ", "dimos arm reset arm, then dimos arm enable arm"] {
        terminal.until(part);
    }
    moving.wait().with(1);
    assert!(terminal.has_colour());

    let second = home.run("coordinator-mock --no-record --name other");
    terminal.until("2 live runs");
    terminal.until("log none");
    // A run that dies is shown as gone, and why.
    second.end(Signal::KILL);
    terminal.until("run other  GONE for ");
    terminal.until("crashed");
    terminal.until("1 live run");
    run.end(Signal::TERM).with(143);
    terminal.until("run coordinator-yourarm  GONE for ");
    terminal.until("SIGTERM");
    // One that is started again takes its place.
    let again = home.run(RUN);
    terminal.until("arm  ready");
    assert_eq!(terminal.text().matches("run coordinator-yourarm").count(), 1, "{}", terminal.text());

    terminal.keys("q");
    top.wait().with(0);
    assert!(terminal.is_as_before());
    again.end(Signal::TERM).with(143);
}

#[test]
fn a_run_that_hangs_is_shown_with_the_age_of_what_is_known() {
    let (home, terminal) = (Home::new(), Terminal::new(80, 24));
    let run = home.run("coordinator-mock --no-record");
    let other = home.run("coordinator-mock --no-record --name other");
    let top = terminal.start(&home, "top --hz 10");
    terminal.until("2 live runs");
    terminal.until("read 0.");
    run.signal(Signal::STOP);
    terminal.until("read 2.");
    // The other one is read as before.
    let text = terminal.text();
    let other_line = text.lines().find(|line| line.starts_with("run other")).unwrap();
    assert!(other_line.contains("read 0."), "{text}");
    run.signal(Signal::CONT);
    eventually("it is read again", || !terminal.text().contains("read 2.") && !terminal.text().contains("read 3."));
    terminal.keys("\x03");
    top.wait().with(130);
    assert!(terminal.is_as_before());
    drop((run, other));
}

#[test]
fn elsewhere_than_on_a_terminal_it_prints_one_frame_or_objects() {
    let home = Home::new();
    home.dimos("top").with(0).shows(&["no live run"]);
    home.dimos("top --run nope").with(2);
    let _run = home.run(&format!("{RUN} --no-record"));
    let frame = home.dimos("top").with(0).shows(&["run coordinator-yourarm", "arm  ready", "log none"]);
    assert!(!frame.out.contains('\x1b') && frame.out.lines().all(|line| line.chars().count() <= 80), "{}", frame.out);

    let once = home.dimos("top --json --once").with(0).json();
    let run = &once["runs"][0];
    assert_eq!((&run["run"], &run["state"]), (&RUN.into(), &"live".into()));
    assert!(run["age"].as_f64().unwrap() < 1.0 && run["status"]["arms"][0]["phase"] == "ready", "{run}");
    assert_eq!(run["arms"][0]["joints"].as_array().unwrap().len(), 6);

    let objects = Started::of(home.command("top --json --hz 20").stdin(Stdio::null()));
    eventually("three objects", || objects.out().lines().count() >= 3);
    let ended = objects.end(Signal::TERM).with(143);
    let lines: Vec<Value> = ended.out.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let ticks: Vec<u64> = lines.iter().map(|o| o["runs"][0]["status"]["ticks"]["count"].as_u64().unwrap()).collect();
    assert!(ticks.is_sorted() && ticks.first() < ticks.last(), "{ticks:?}");
}
