//! A stop needs no place among the connections of a run, and a thread that hangs does not keep it from being answered.
//! Judged on the verb, as a user types it, and on its exit code.

use std::io::{BufRead, BufReader, Write};
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixStream};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use dimos::rpc::api::{Confirmation, Stop};
use dimos::rpc::client::Client;
use rustix::thread::CapabilitySet;

use crate::support::program::{Home, Started, eventually};
use crate::support::skip::{skip, skip_privileged};

/// Maximum duration of a stop beside a hung thread: the run notices that after 0.5 s.
const STOP_LIMIT: Duration = Duration::from_secs(2);

/// Clients that occupy places, until it is dropped.
struct Flood {
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

impl Flood {
    /// Three threads connect as fast as they can, send `first`, and keep the last 100 connections each.
    fn begin(socket: &Path, first: &'static [u8]) -> Self {
        let stop = Arc::new(AtomicBool::new(false));
        let threads = (0..3).map(|_| {
            let (stop, socket) = (stop.clone(), socket.to_owned());
            std::thread::spawn(move || {
                let mut kept = std::collections::VecDeque::new();
                while !stop.load(Ordering::Relaxed) {
                    if let Ok(mut stream) = connect(&socket) {
                        let _ = stream.write_all(first);
                        kept.push_back(stream);
                    }
                    if kept.len() > 100 {
                        kept.pop_front();
                    }
                }
            })
        });
        Self { threads: threads.collect(), stop }
    }
}

impl Drop for Flood {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        self.threads.drain(..).for_each(|thread| drop(thread.join()));
    }
}

/// Connects to a path, or to the mark `@NAME`.
fn connect(at: &Path) -> std::io::Result<UnixStream> {
    match at.to_str().unwrap().strip_prefix('@') {
        Some(name) => UnixStream::connect_addr(&SocketAddr::from_abstract_name(name)?),
        None => UnixStream::connect(at),
    }
}

/// Where the run is reached without its folder.
fn mark(home: &Home) -> PathBuf {
    let folder = home.runs();
    let mark = folder.lasting(&folder.runs().unwrap()[0]);
    assert!(mark.to_str().unwrap().starts_with("@dimos/run/"), "{mark:?}");
    mark
}

/// Asks for a stop at a socket, as the verb does.
fn stop_at(socket: &Path) -> Confirmation {
    let connect = || Client::connect("cell", socket);
    Client::urgent(None, connect, &Stop::default()).unwrap().1.arms["arm"]
}

fn socket(home: &Home) -> PathBuf {
    home.path().join("run/dimos/coordinator-mock.sock")
}

/// Subscribers that never read: they keep their places.
fn pins(home: &Home) -> Vec<UnixStream> {
    let subscribe = b"{\"id\":1,\"method\":\"subscribe\",\"params\":{\"stream\":\"coordinator_joint_state\"}}\n";
    let pin = |_| {
        let mut stream = UnixStream::connect(socket(home)).unwrap();
        stream.write_all(subscribe).unwrap();
        stream
    };
    (0..128).map(pin).collect()
}

/// Judges several stops, each followed by a cancel.
fn stops_get_through(home: &Home, beside: &str) {
    for n in 0..5 {
        let stopped = home.dimos("stop").with(0).out;
        assert!(stopped.contains("confirmed"), "stop {n} beside {beside}: {stopped}");
        home.dimos("cancel --json").with(0);
    }
}

#[test]
fn a_stop_beside_floods_of_connections_is_answered() {
    let home = Home::new();
    let _run = home.run("coordinator-mock --no-record");
    let half = b"{\"id\":1,\"method\":\"stop\",\"params\":{";
    for (first, kind) in [(&b""[..], "silent connections"), (half, "halves of stops")] {
        let _flood = Flood::begin(&socket(&home), first);
        stops_get_through(&home, kind);
    }
    let pins = pins(&home);
    stops_get_through(&home, "128 subscribers");
    for (first, kind) in [(&b""[..], "128 subscribers and silent connections"), (half, "128 and halves of stops")] {
        let _flood = Flood::begin(&socket(&home), first);
        stops_get_through(&home, kind);
    }
    let _flood = Flood::begin(&socket(&home), b"{\"id\":1,\"method\":\"status\"}\n");
    stops_get_through(&home, "128 subscribers and requests for the status");
    home.dimos("down").with(0);
    drop(pins);
}

#[test]
fn a_stop_that_needs_no_place_leaves_a_connection_that_can_be_used() {
    let home = Home::new();
    let _run = home.run("coordinator-mock --no-record");
    let mut client = home.client();
    for _ in 0..3 {
        client.call(Stop::default()).unwrap();
        assert_eq!(client.call(dimos::rpc::api::State {}).unwrap().arms.len(), 1);
        client.call(dimos::rpc::api::Cancel::default()).unwrap();
    }
}

/// Stops a thread of the run for good, by its name, as a debugger does; ends with the value. `None` where that is not
/// allowed.
fn hang(run: &Started, name: &str) -> Option<Started> {
    let of_thread = |task: std::fs::DirEntry| {
        let comm = std::fs::read_to_string(task.path().join("comm")).ok()?;
        let id: u32 = task.file_name().to_string_lossy().parse().ok()?;
        (comm.trim() == name).then_some(id)
    };
    let tasks = std::fs::read_dir(format!("/proc/{}/task", run.pid())).unwrap();
    // The newest one: older ones hang already.
    let thread = tasks.filter_map(|task| of_thread(task.unwrap())).max().unwrap();
    let script = format!(
        "import ctypes; c = ctypes.CDLL(None); n = ctypes.c_void_p(0)\n\
         if c.ptrace(16, {thread}, n, n): raise SystemExit('not allowed')\n\
         c.waitpid({thread}, n, 0x40000000); print('it hangs', flush=True); c.waitpid({thread}, n, 0x40000000)"
    );
    let mut python = Command::new("python3");
    let probe = python.arg("-c").arg("print()").stdout(Stdio::null()).status();
    if !probe.is_ok_and(|status| status.success()) {
        skip("python3");
        return None;
    }
    let debugger = Started::of(Command::new("python3").args(["-c", &script]).stdin(Stdio::null()));
    let says = |what: &str| debugger.out().contains(what) || debugger.err().contains(what);
    eventually("it hangs or may not", || says("it hangs") || says("not allowed"));
    if says("not allowed") {
        skip_privileged("a debugger's rights", CapabilitySet::SYS_PTRACE);
        return None;
    }
    Some(debugger)
}

#[test]
fn a_hung_thread_for_stops_is_replaced() {
    let home = Home::new();
    let run = home.run("coordinator-mock --no-record");
    // A silent connection with a lease is served by that thread.
    let mut holder = home.client();
    holder.call(dimos::rpc::api::Lease { arm: None }).unwrap();
    std::thread::sleep(Duration::from_millis(500));
    let mut debuggers = Vec::new();
    for hung in 1..=3 {
        let Some(debugger) = hang(&run, "rpc-stop") else { return };
        debuggers.push(debugger);
        let began = Instant::now();
        let stopped = home.dimos("stop").with(0).out;
        assert!(stopped.contains("confirmed") && began.elapsed() < STOP_LIMIT, "{:?}: {stopped}", began.elapsed());
        let replaced = run.err().matches("the thread that answers stops hangs; another one takes its place").count();
        assert_eq!(replaced, hung, "{}", run.err());
    }
    // Its client gets an end, no endless wait; the lease is free.
    assert!(holder.call(dimos::rpc::api::Status {}).is_err());
    assert!(home.status()["arms"][0]["commander"].is_null());
    // As many as hang at the same time are replaced, and one that recovers counts no longer.
    let Some(last) = hang(&run, "rpc-stop") else { return };
    eventually("it says that it is at its end", || run.err().contains("hangs, like 3 before it"));
    drop(debuggers);
    eventually("it is replaced", || run.err().matches("another one takes its place").count() == 4);
    assert!(home.dimos("stop").with(0).out.contains("confirmed"));
    drop(last);
    home.dimos("arm reset arm").with(0);
    home.dimos("down").with(0);
    run.wait().with(0);
}

#[test]
fn a_stop_without_a_folder_is_answered_beside_floods_and_a_hung_thread() {
    let home = Home::new();
    let run = home.run("coordinator-mock --no-record");
    let mark = mark(&home);
    for first in [&b""[..], b"{\"id\":1,\"method\":\"stop\",\"params\":{"] {
        let _flood = Flood::begin(&mark, first);
        for _ in 0..5 {
            assert_eq!(stop_at(&mark), Confirmation::Confirmed);
        }
    }
    let Some(_debugger) = hang(&run, "rpc-stop") else { return };
    // What waits for the thread that hangs is answered by the next one.
    let began = Instant::now();
    let mut waiting = connect(&mark).unwrap();
    waiting.set_read_timeout(Some(2 * STOP_LIMIT)).unwrap();
    waiting.write_all(b"{\"id\":1,\"method\":\"stop\"}\n").unwrap();
    let mut reply = String::new();
    BufReader::new(waiting).read_line(&mut reply).unwrap();
    assert!(reply.contains("confirmed") && began.elapsed() < STOP_LIMIT, "{:?}: {reply}", began.elapsed());
    assert_eq!(stop_at(&mark), Confirmation::Confirmed);
}

#[test]
fn stops_that_are_under_way_when_a_thread_hangs_end() {
    let home = Home::new();
    let run = home.run("coordinator-mock --no-record");
    let (socket, ended) = (socket(&home), Arc::new(AtomicBool::new(false)));
    let until = ended.clone();
    let asking = std::thread::spawn(move || {
        let mut longest = Duration::ZERO;
        while !until.load(Ordering::Relaxed) {
            let Ok(mut stream) = connect(&socket) else { continue };
            stream.set_read_timeout(Some(Duration::from_secs(5))).unwrap();
            let began = Instant::now();
            let _ = stream.write_all(b"{\"id\":1,\"method\":\"stop\"}\n");
            // A reply, or an end: then it is asked again.
            BufReader::new(stream).read_line(&mut String::new()).expect("an end");
            longest = longest.max(began.elapsed());
        }
        longest
    });
    for _ in 0..3 {
        let Some(_debugger) = hang(&run, "rpc-stop") else { break };
        std::thread::sleep(Duration::from_secs(1));
    }
    ended.store(true, Ordering::Relaxed);
    let longest = asking.join().unwrap();
    assert!(longest < STOP_LIMIT, "{longest:?}");
}

#[test]
fn the_python_client_stops_beside_a_hung_thread() {
    let home = Home::new();
    let run = home.run("coordinator-mock --no-record");
    let script = "import dimos_client as d, sys; c = d.Client.connect(); c.status(); print('connected', flush=True)
sys.stdin.readline(); print(c.stop(), c.cancel(), flush=True)";
    let mut python = Command::new("python3");
    home.settle(python.args(["-c", script]).env("PYTHONDONTWRITEBYTECODE", "1").stdin(Stdio::piped()));
    python.env("PYTHONPATH", concat!(env!("CARGO_MANIFEST_DIR"), "/assets/python"));
    let mut client = Started::of(&mut python);
    client.until("connected");
    let Some(_debugger) = hang(&run, "rpc-stop") else { return };
    let began = Instant::now();
    client.stdin().write_all(b"\n").unwrap();
    client.wait().with(0).shows(&["{'arm': 'confirmed'}"]);
    assert!(began.elapsed() < STOP_LIMIT, "{:?}", began.elapsed());
}

#[test]
fn a_file_system_that_hangs_delays_neither_a_stop_nor_the_end() {
    let home = Home::new();
    let run = home.run("coordinator-mock --no-record");
    let Some(_debugger) = hang(&run, "rpc-look") else { return };
    std::fs::remove_file(socket(&home)).unwrap();
    let began = Instant::now();
    assert!(home.dimos("stop").with(0).out.contains("confirmed"));
    home.dimos("arm reset arm").with(0);
    home.dimos("down").with(0);
    run.wait().with(0);
    assert!(began.elapsed() < Duration::from_secs(10), "{:?}", began.elapsed());
}
