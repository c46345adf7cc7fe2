//! Losses: how soon a lease is free when its holder is closed, killed or frozen, and how soon a client is connected
//! again when the gateway is back.

use std::io::{BufRead, BufReader, Write};
use std::net::TcpStream;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use dimos::rpc::api::Status;
use dimos::rpc::client::Client;
use rustix::process::{Pid, Signal, kill_process};

use crate::support::Effort;
use crate::support::measure::{Goal, Measure, print};
use crate::{Shared, eventually, gateway, text};

/// A way to lose a commander.
#[derive(Clone, Copy, PartialEq)]
enum Loss {
    Closed,
    Killed,
    Frozen,
}

/// Measures all of them, on the run's side.
pub fn measure(effort: Effort) -> Result<(), String> {
    let folder = tempfile::tempdir().map_err(text)?;
    let blueprint = folder.path().join("servo.yaml");
    let tasks = "tasks:\n  - {name: velocity_arm, type: velocity, joint_names: {hardware: arm}, priority: 20}\n";
    std::fs::write(&blueprint, format!("include: [coordinator-mock]\n{tasks}")).map_err(text)?;
    let mut shared = Shared::start(&blueprint.display().to_string(), 100)?;
    let mut local = shared.run.client()?;
    let repeats = effort.of(1, 20);
    let (mut closed, mut killed, mut frozen) = (Vec::new(), Vec::new(), Vec::new());
    for _ in 0..repeats {
        closed.push(lease_free(&shared, &mut local, Loss::Closed)?);
        killed.push(lease_free(&shared, &mut local, Loss::Killed)?);
        frozen.push(lease_free(&shared, &mut local, Loss::Frozen)?);
    }
    let mut again = Vec::new();
    for _ in 0..repeats {
        again.push(connected_again(&shared, &mut local)?);
    }
    print(
        "after a loss",
        &[
            Measure::new("lease free, commander closed", "ms", closed).goal(Goal::AtMost(50.0)),
            Measure::new("lease free, commander killed", "ms", killed).goal(Goal::AtMost(50.0)),
            Measure::new("lease free, commander frozen (limit 1 s)", "ms", frozen).goal(Goal::AtMost(1300.0)),
            Measure::new("connected again, since the gateway listens", "ms", again).goal(Goal::AtMost(600.0)),
        ],
    );
    Ok(())
}

/// Starts a verb on another computer.
fn verb(shared: &Shared, arguments: &str) -> Result<Child, String> {
    let mut command = Command::new(env!("CARGO_BIN_EXE_dimos"));
    command.args(["--at", &shared.at]).args(arguments.split(' '));
    command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped());
    command.spawn().map_err(text)
}

fn is_commanded(client: &mut Client) -> bool {
    client.call(Status {}).is_ok_and(|status| status.arms.iter().any(|arm| arm.commander.is_some()))
}

fn lease_free(shared: &Shared, local: &mut Client, loss: Loss) -> Result<f64, String> {
    let mut commander = verb(shared, "task stream velocity_arm")?;
    let mut targets = commander.stdin.take().ok_or("no stdin")?;
    writeln!(targets, "0 0 0 0 0 0 0").map_err(text)?;
    eventually("it holds the lease", || is_commanded(local))?;
    // Closed in order: the verb's own end is part of it, so its start is the end of its input.
    let pid = Pid::from_raw(commander.id() as i32).ok_or("no pid")?;
    let signal = match loss {
        Loss::Closed => None,
        Loss::Killed => Some(Signal::KILL),
        Loss::Frozen => Some(Signal::STOP),
    };
    let began = Instant::now();
    match signal {
        Some(signal) => kill_process(pid, signal).map_err(text)?,
        None => drop(targets),
    }
    eventually("the lease is free", || !is_commanded(local))?;
    let took = began.elapsed().as_secs_f64() * 1e3;
    let _ = (commander.kill(), commander.wait());
    Ok(took)
}

/// Lines of a process, as they come.
fn lines(child: &mut Child) -> Result<Receiver<(Instant, String)>, String> {
    let (from, (said, lines)) = (child.stderr.take().ok_or("no stderr")?, channel());
    std::thread::spawn(move || {
        for line in BufReader::new(from).lines().map_while(Result::ok) {
            let _ = said.send((Instant::now(), line));
        }
    });
    Ok(lines)
}

fn connected_again(shared: &Shared, local: &mut Client) -> Result<f64, String> {
    let mut watch = verb(shared, "state --watch --hz 50")?;
    let lines = lines(&mut watch)?;
    std::thread::sleep(Duration::from_millis(300));
    let first = gateway(local).ok_or("no gateway")?;
    kill_process(Pid::from_raw(first as i32).ok_or("no pid")?, Signal::KILL).map_err(text)?;
    let address = shared.at.trim_start_matches("tcp/");
    // Between the end of the old one and the start of the new one nothing listens.
    eventually("the old one is gone", || TcpStream::connect(address).is_err())?;
    eventually("the new one listens", || TcpStream::connect(address).is_ok())?;
    let listens = Instant::now();
    let again = loop {
        let (at, line) = lines.recv_timeout(Duration::from_secs(10)).map_err(|_| "it is not connected again")?;
        if line.starts_with("connected to run") {
            break at;
        }
    };
    let _ = (watch.kill(), watch.wait());
    eventually("the gateway is registered", || gateway(local).is_some_and(|pid| pid != first))?;
    Ok(again.saturating_duration_since(listens).as_secs_f64() * 1e3)
}
