//! Duration of a stop with and without a flood of requests, in turns: from sending it until the reply says that the arm
//! confirmed it. Over a connection with other requests, and over a new one.

use std::io::{BufRead, BufReader, Write};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use dimos::rpc::api::{ArmEnable, ArmReset, Confirmation, Execute, Point, State, Stop, Trajectory};
use dimos::rpc::client::Client;
use serde_json::json;

use super::support::Effort;
use super::support::measure::{Goal, Measure, print, quantile};
use super::support::run::LiveRun;

/// Clients of the flood.
const CLIENTS: usize = 18;
/// Points of the rejected trajectories.
const POINTS: usize = 4_500;
/// Additional duration allowed for a stop during the flood [ms].
const MARGIN: f64 = 15.0;

/// Durations of stops [ms].
#[derive(Default)]
struct Times {
    /// Over a connection with other requests.
    kept: Vec<f64>,
    /// Over a new connection.
    new: Vec<f64>,
}

impl Times {
    fn all(&self) -> Vec<f64> {
        self.kept.iter().chain(&self.new).copied().collect()
    }
}

/// Measures and prints.
pub fn measure(effort: Effort) -> Result<(), String> {
    let (stops, turn) = (effort.of(20, 300), effort.of(5, 10));
    let mut run = LiveRun::start("coordinator-mock", &[]).map_err(|e| e.to_string())?;
    let mut client = run.client()?;
    let socket = run.folder().join("dimos/bench.sock");
    let joints = client.call(State {}).map_err(|e| e.to_string())?.arms.remove(0).joints;
    let names: Vec<String> = joints.into_iter().map(|joint| joint.name).collect();
    let flood = Flood::prepare(&socket, &names);
    let (mut calm, mut flooded, mut unconfirmed) = (Times::default(), Times::default(), 0.0);
    while flooded.all().len() < stops {
        for (beside, times) in [(false, &mut calm), (true, &mut flooded)] {
            flood.set(beside);
            std::thread::sleep(Duration::from_millis(200));
            for n in 0..turn {
                make_ready(&mut client)?;
                let began = Instant::now();
                let stopped = if n % 2 == 0 {
                    client.call(Stop { arm: None })
                } else {
                    Client::connect("bench", &socket).and_then(|mut new| new.call(Stop { arm: None }))
                };
                let list = if n % 2 == 0 { &mut times.kept } else { &mut times.new };
                list.push(began.elapsed().as_secs_f64() * 1e3);
                let reply = stopped.map_err(|e| e.to_string())?;
                unconfirmed += f64::from(u8::from(reply.arms.values().any(|c| *c != Confirmation::Confirmed)));
            }
        }
    }
    drop(flood);
    let p99 = [quantile(&calm.all(), 0.99), quantile(&flooded.all(), 0.99)];
    print(
        &format!("`stop` until it is confirmed, with and without a flood by {CLIENTS} clients, in turns"),
        &[
            Measure::new("no flood, existing connection", "ms", calm.kept),
            Measure::new("no flood, new connection", "ms", calm.new),
            Measure::new("flood, existing connection", "ms", flooded.kept),
            Measure::new("flood, new connection", "ms", flooded.new),
            Measure::new("p99 in the flood, beyond p99 without", "ms", vec![p99[1] - p99[0]])
                .goal(Goal::AtMost(MARGIN)),
            Measure::new("not confirmed", "", vec![unconfirmed]).goal(Goal::AtMost(0.0)),
        ],
    );
    Ok(())
}

/// Makes the arm ready again, retrying during the flood.
fn make_ready(client: &mut Client) -> Result<(), String> {
    let limit = Instant::now() + Duration::from_secs(20);
    loop {
        let reset = client.call(ArmReset { arm: "arm".into() });
        match reset.and_then(|_| client.call(ArmEnable::new("arm"))) {
            Ok(_) => return Ok(()),
            Err(e) if Instant::now() > limit => return Err(format!("the arm is not ready in time: {e}")),
            Err(_) => std::thread::sleep(Duration::from_millis(20)),
        }
    }
}

/// Clients that send as many requests as they can, or pause.
struct Flood {
    on: Arc<AtomicBool>,
    over: Arc<AtomicBool>,
    clients: Vec<JoinHandle<()>>,
}

impl Flood {
    fn prepare(socket: &Path, joints: &[String]) -> Self {
        let (on, over) = (Arc::<AtomicBool>::default(), Arc::<AtomicBool>::default());
        // It does not start at the arm's position, so it is rejected each time, after it was read and checked.
        let point = |i: usize| Point {
            time_from_start: i as f64,
            positions: (0..joints.len()).map(|j| 1.5 - 0.125 * j as f64).collect(),
            ..Point::default()
        };
        let trajectory = Trajectory { joint_names: joints.to_vec(), points: (0..POINTS).map(point).collect() };
        let execute =
            json!({"id": 1, "method": "execute", "params": Execute { trajectory, task: None, retraces_to: None }});
        let execute = execute.to_string() + "\n";
        let clients = (0..CLIENTS).map(|kind| {
            let (on, over, execute, socket) = (on.clone(), over.clone(), execute.clone(), socket.to_owned());
            std::thread::spawn(move || one_client(kind % 6, &socket, &execute, &on, &over))
        });
        Self { clients: clients.collect(), on, over }
    }

    fn set(&self, on: bool) {
        self.on.store(on, Ordering::Relaxed);
    }
}

impl Drop for Flood {
    fn drop(&mut self) {
        self.over.store(true, Ordering::Relaxed);
        for client in self.clients.drain(..) {
            let _ = client.join();
        }
    }
}

/// Sends requests in one of six ways; reconnects when it is disconnected.
fn one_client(kind: usize, socket: &Path, execute: &str, on: &AtomicBool, over: &AtomicBool) {
    while !over.load(Ordering::Relaxed) {
        let Ok(stream) = UnixStream::connect(socket) else { return };
        let _ = stream.set_read_timeout(Some(Duration::from_secs(1)));
        let _ = stream.set_write_timeout(Some(Duration::from_millis(100)));
        let Ok(read) = stream.try_clone() else { return };
        let mut replies = BufReader::new(read);
        let mut ask = |line: &[u8]| {
            let mut reply = String::new();
            (&stream).write_all(line).is_ok() && replies.read_line(&mut reply).is_ok_and(|length| length > 0)
        };
        let mut goes_on = true;
        while goes_on && !over.load(Ordering::Relaxed) {
            if !on.load(Ordering::Relaxed) {
                std::thread::sleep(Duration::from_millis(5));
                continue;
            }
            goes_on = match kind {
                0 => ask(b"{\"id\":1,\"method\":\"status\"}\n"),
                1 => ask(b"{\"id\":1,\n"),
                2 => ask(execute.as_bytes()),
                // Reads nothing.
                3 => (&stream).write_all(b"{\"id\":1,\"method\":\"status\"}\n").is_ok(),
                // Sends a line without end, slowly.
                4 => {
                    std::thread::sleep(Duration::from_millis(1));
                    (&stream).write_all(b"{").is_ok()
                }
                // Sends lines that are too long.
                _ => ask(&vec![b' '; 300 * 1024]),
            };
        }
    }
}
