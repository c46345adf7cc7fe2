//! `make bench-share`: a run on the network, on the loopback interface: what it costs the tick, how old states are at
//! subscribers, round trips, how soon leases are free and clients connected again, stops beside a flood, memory, and a
//! fleet behind one router. Prints and judges figures; no figure fails it. `make bench-share PART=stops` measures one
//! part: `tick round-trips arms losses stops memory fleet`. Parts with eclipse-zenoh need `make test-tools`.

mod fleet;
mod judge;
mod losses;
mod streams;
#[path = "../support/mod.rs"]
#[allow(dead_code, reason = "shared with the other benchmarks")]
mod support;
mod trips;

use std::net::TcpListener;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use dimos::rpc::api::Status;
use dimos::rpc::client::Client;
use support::run::LiveRun;
use support::{Effort, machine};

/// A part of the benchmark, by name.
type Part = (&'static str, fn(Effort) -> Result<(), String>);

fn main() -> ExitCode {
    let effort = Effort::from_environment();
    println!("\ndimos: a run on the network{}\n", effort.of(" (quick)", ""));
    machine::print();
    let parts: [Part; 7] = [
        ("tick", streams::tick),
        ("round-trips", trips::round_trips),
        ("arms", streams::arms),
        ("losses", losses::measure),
        ("stops", trips::stops),
        ("memory", trips::memory),
        ("fleet", fleet::measure),
    ];
    let named: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with("--")).collect();
    for (name, part) in parts {
        if (named.is_empty() || named.iter().any(|n| n == name))
            && let Err(why) = part(effort)
        {
            support::skipped(&format!("{name}: {why}"));
        }
    }
    effort.end()
}

/// A shared run.
struct Shared {
    run: LiveRun,
    at: String,
}

impl Shared {
    /// Starts a run that everyone on this computer may command.
    fn start(blueprint: &str, rate: u32) -> Result<Self, String> {
        let at = format!("tcp/127.0.0.1:{}", free_port());
        let (listen, tick) = (format!("share.listen=[{at}]"), format!("coordinator.tick_rate={rate}"));
        let set = ["--set", &listen, "--set", "share.users={'-': owner}", "--set", &tick];
        let mut shared = Self { run: LiveRun::start(blueprint, &set).map_err(text)?, at };
        let mut local = shared.run.client()?;
        eventually("the run is shared", || gateway(&mut local).is_some())?;
        eventually("clients find it", || dimos::share::runs(&shared.at).is_ok_and(|runs| !runs.is_empty()))?;
        Ok(shared)
    }

    /// Connects as a client on another computer does.
    fn connect(&self) -> Result<Client, String> {
        dimos::share::connect(&self.at, None).map_err(text)
    }

    /// Returns the pid of its gateway.
    fn gateway(&mut self) -> Result<u32, String> {
        gateway(&mut self.run.client()?).ok_or_else(|| "no gateway".to_owned())
    }
}

fn gateway(client: &mut Client) -> Option<u32> {
    client.call(Status {}).ok()?.share?.pid.map(|pid| pid as u32)
}

fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").and_then(|listener| listener.local_addr()).map_or(0, |at| at.port())
}

/// Waits for something, at most 60 s; returns the time that took.
fn eventually(what: &str, mut holds: impl FnMut() -> bool) -> Result<Duration, String> {
    let began = Instant::now();
    while !holds() {
        if began.elapsed() > Duration::from_secs(60) {
            return Err(format!("{what}: not within 60 s"));
        }
        std::thread::sleep(Duration::from_millis(1));
    }
    Ok(began.elapsed())
}

fn text(error: impl std::fmt::Display) -> String {
    error.to_string()
}
