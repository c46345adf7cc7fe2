//! Runs without a terminal, with the real binary: in the background, under a service manager, and what is known of
//! them when they are gone.

use std::net::TcpListener;
use std::os::fd::OwnedFd;
use std::os::unix::net::{UnixDatagram, UnixStream};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

use crate::support::program;
use crate::support::program::{Ended, Home, Started, eventually};
use crate::support::skip::skip;

const RUN: &str = "coordinator-mock";

/// A run in the background. It is killed when it is dropped, whatever a test does.
struct Daemon {
    report: Value,
    pid: Pid,
}

impl Daemon {
    #[track_caller]
    fn start(home: &Home, arguments: &str) -> Self {
        // Ends on its own if this test is killed.
        let report = home.dimos(&format!("run -d --json --duration 2m {arguments}")).with(0).json();
        let pid = Pid::from_raw(i32::try_from(report["pid"].as_i64().unwrap()).unwrap()).unwrap();
        Self { report, pid }
    }

    fn kill(&self) {
        let _ = kill_process(self.pid, Signal::KILL);
    }

    fn text_log(&self) -> PathBuf {
        self.report["text_log"].as_str().unwrap().into()
    }

    fn proc(&self, what: &str) -> PathBuf {
        format!("/proc/{}/{what}", self.pid.as_raw_nonzero()).into()
    }

    fn is_alive(&self) -> bool {
        let stat = std::fs::read_to_string(self.proc("stat")).unwrap_or_default();
        stat.rsplit_once(") ").is_some_and(|(_, rest)| !rest.starts_with('Z'))
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        if self.is_alive() {
            self.kill();
        }
    }
}

fn text(path: &Path) -> String {
    std::fs::read_to_string(path).unwrap()
}

#[test]
fn it_returns_when_the_arms_are_up_and_prints_run_pid_and_logs() {
    let home = Home::new();
    let daemon = Daemon::start(&home, RUN);
    let status = home.status();
    assert_eq!(status["arms"][0]["phase"], "ready");
    for (report, is) in [("run", &status["run"]), ("pid", &status["pid"]), ("log", &status["log"])] {
        assert_eq!(&daemon.report[report], is);
    }
    // An ordinary thread writes it.
    eventually("the banner is in the text log", || text(&daemon.text_log()).contains("run coordinator-mock"));
    let report = home.dimos(&format!("run -d --duration 2m --no-record {RUN} --name plain")).with(0);
    for part in ["run       plain", "pid       ", "arm       arm: ready", "log       none", "text log  "] {
        assert!(report.out.contains(part), "no {part:?} in\n{}", report.out);
    }
    report.says(&["dimos down plain"]);
    home.dimos("down plain").with(0).says(&["plain ended"]);
    home.dimos(&format!("move --run {RUN} arm 0.1 0 0 0 0 0 0 --speed 1")).with(0);
    home.dimos("down").with(0).says(&["coordinator-mock ended; log: "]);
    assert!(!daemon.is_alive(), "down waits until the process has ended");
    assert!(text(&daemon.text_log()).contains("shutdown requested"));
}

#[test]
fn it_survives_its_terminal() {
    let home = Home::new();
    let daemon = Daemon::start(&home, RUN);
    let stat = text(&daemon.proc("stat"));
    let fields: Vec<&str> = stat.rsplit_once(") ").unwrap().1.split(' ').collect();
    // state, parent, group, session, terminal
    assert_eq!(fields[3], daemon.pid.as_raw_nonzero().to_string(), "its own session: {stat}");
    assert_eq!(fields[4], "0", "no terminal: {stat}");
    let open = |fd| std::fs::read_link(daemon.proc(&format!("fd/{fd}"))).unwrap();
    assert_eq!(open(0), Path::new("/dev/null"));
    assert_eq!([open(1), open(2)], [daemon.text_log(), daemon.text_log()]);
    home.dimos("down").with(0);
}

#[test]
fn a_failed_start_is_reported_with_its_exit_code() {
    let home = Home::new();
    home.dimos("run -d no-such-blueprint").with(2).says(&["error: ", "hint: "]);
    home.dimos(&format!("run -d {RUN} --set coordinator.tick_rate=-1")).with(2).says(&["tick_rate"]);
    home.dimos(&format!("run -d {RUN} --name ../x")).with(2).says(&["cannot be the name of a run"]);
    let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let unreachable = format!("run -d coordinator-yourarm --set hardware.arm.address={port}");
    let ended = home.dimos(&unreachable).with(3).says(&["error: arm: ", "hint: "]);
    assert_eq!(ended.out, "");
    let left = std::fs::read_dir(home.path().join("state/dimos")).unwrap().count();
    assert_eq!(left, 0, "nothing is left of them");
    let _daemon = Daemon::start(&home, RUN);
    home.dimos(&format!("run -d {RUN}")).with(1).says(&["is live already", "hint: "]);
    home.dimos("down").with(0);
    assert_eq!(home.dimos("status --json").with(0).out, "[]\n", "none of these fell");
}

#[test]
fn a_crash_during_startup_is_reported() {
    let home = Home::new();
    // A controller that takes the connection and says nothing: the start waits for it.
    let silent = TcpListener::bind("127.0.0.1:0").unwrap();
    let slow = format!("run -d coordinator-yourarm --set hardware.arm.address={}", silent.local_addr().unwrap());
    let command = home.start(&slow);
    let pid = || home.runs().runs().unwrap().iter().map(|run| run.pid as i32).find_map(Pid::from_raw);
    eventually("it starts", || pid().is_some());
    kill_process(pid().unwrap(), Signal::KILL).unwrap();
    command.wait().with(1).says(&["coordinator-yourarm crashed during startup (signal: 9 (SIGKILL))", "hint: "]);
}

#[test]
fn it_ends_when_its_starter_has_exited() {
    let home = Home::new();
    // What `run -d` starts, after that has been killed.
    let (ours, theirs) = UnixStream::pair().unwrap();
    drop(ours);
    let mut command = home.command(&format!("run --text-log text.log {RUN}"));
    let ended = Started::of(command.stdin(Stdio::from(OwnedFd::from(theirs)))).wait();
    ended.with(0).says(&["the starting process exited before the run was ready", "shutdown requested"]);
}

#[test]
fn logs_shows_and_follows_the_text_of_the_living_and_the_dead() {
    let home = Home::new();
    home.dimos("logs").with(1).says(&["no run of this user is live"]);
    home.dimos("logs missing").with(2).says(&["no record of a run named missing"]);
    let daemon = Daemon::start(&home, RUN);
    // The file is written after what it says.
    eventually("it is in the file", || {
        text(&daemon.text_log()).contains("Press Ctrl-C") || text(&daemon.text_log()).contains("dimos down")
    });
    assert_eq!(home.dimos("logs").with(0).out, text(&daemon.text_log()));
    let following = home.start("logs -f");
    following.until("run coordinator-mock");
    home.dimos("down").with(0);
    let followed = following.wait().with(0);
    assert!(followed.out.contains("shutdown requested") && followed.out.contains("ended; log: "), "{}", followed.out);
    for dead in ["logs", "logs coordinator-mock", "logs --run coordinator-mock"] {
        assert_eq!(home.dimos(dead).with(0).out, followed.out, "{dead}");
    }
    let record = home.dimos("logs --json").with(0).json();
    assert_eq!((&record["end"]["exit"], &record["end"]["why"]), (&0.into(), &"shutdown requested".into()));
    // A run in a terminal has none.
    let foreground = home.run(&format!("{RUN} --name front"));
    home.dimos("logs").with(1).says(&["front has no text log", "hint: "]);
    foreground.end(Signal::INT).with(130);
}

#[test]
fn a_crashed_run_is_shown_with_its_last_words_until_it_is_started_again() {
    let home = Home::new();
    let daemon = Daemon::start(&home, RUN);
    let other = home.run(&format!("{RUN} --name other"));
    daemon.kill();
    eventually("it is gone", || !daemon.is_alive());
    let words = "Run `dimos down` for a controlled stop.";
    let shown = home.dimos("status").with(0).out;
    assert!(shown.contains("run other") && shown.contains("crashed") && shown.contains(words), "{shown}");
    other.end(Signal::TERM).with(143);
    let shown = home.dimos("status").with(0).out;
    assert!(shown.contains("CRASHED") && shown.contains(words) && !shown.contains("other"), "{shown}");
    let listed = home.dimos("status --json").with(0).json();
    assert_eq!(listed.as_array().unwrap().len(), 1);
    assert_eq!((&listed[0]["run"], &listed[0]["crashed"]), (&RUN.into(), &true.into()));
    assert_eq!(listed[0]["last_words"].as_array().unwrap().last().unwrap(), words);
    home.dimos(&format!("status --run {RUN}")).with(1).says(&["crashed", words, "hint: "]);
    home.dimos(&format!("down {RUN}")).with(1).says(&["crashed"]);
    assert!(home.dimos("logs").with(0).out.contains(words));
    let _again = Daemon::start(&home, RUN);
    home.dimos("down").with(0);
    assert_eq!(home.dimos("status --json").with(0).out, "[]\n");
}

#[test]
fn a_panic_is_in_the_text_log() {
    let home = Home::new();
    home.write(
        "panics.yaml",
        "hardware:\n  - {hardware_id: arm, adapter_type: mock, joints: {prefix: arm, count: 2},\n     \
         options: {faults: [{at: 1.0, kind: panic}]}}\n\
         tasks:\n  - {name: traj_arm, type: trajectory, joint_names: {hardware: arm}}\n",
    );
    let daemon = Daemon::start(&home, "panics.yaml");
    eventually("the panic is in the text log", || text(&daemon.text_log()).contains("panicked at"));
    let _ = home.dimos("down");
}

/// A service manager that receives the notifications of a run.
struct Manager {
    socket: UnixDatagram,
    address: PathBuf,
}

impl Manager {
    fn new(home: &Home) -> Self {
        let address = home.path().join("notify");
        let socket = UnixDatagram::bind(&address).unwrap();
        socket.set_read_timeout(Some(program::TIMEOUT)).unwrap();
        Self { socket, address }
    }

    fn run(&self, home: &Home, arguments: &str) -> Started {
        let mut command = home.command(&format!("run {arguments}"));
        let run = Started::of(self.settle(&mut command).stdin(Stdio::null()));
        run.until(program::UP);
        run
    }

    fn settle<'c>(&self, command: &'c mut Command) -> &'c mut Command {
        command.env("NOTIFY_SOCKET", &self.address).env("WATCHDOG_USEC", "300000").env_remove("WATCHDOG_PID")
    }

    /// The next message.
    fn heard(&self) -> String {
        let mut buffer = [0; 1024];
        let length = self.socket.recv(&mut buffer).expect("the run says something");
        String::from_utf8_lossy(&buffer[..length]).into_owned()
    }

    /// The messages up to one that begins like this.
    fn until(&self, start: &str) -> Vec<String> {
        let began = Instant::now();
        let mut all = Vec::new();
        while !all.last().is_some_and(|m: &String| m.starts_with(start)) {
            assert!(began.elapsed() < program::TIMEOUT, "no {start:?} in {all:?}");
            all.push(self.heard());
        }
        all
    }
}

#[test]
fn the_service_manager_hears_that_it_is_up_that_it_beats_and_that_it_ends() {
    let home = Home::new();
    let manager = Manager::new(&home);
    let run = manager.run(&home, "coordinator-yourarm");
    let mut heard = manager.until("READY=1");
    let ready = heard.pop().unwrap();
    assert_eq!(ready, "READY=1\nSTATUS=coordinator-yourarm: arm ready, SIMULATED");
    assert!(heard.iter().all(|message| message == "WATCHDOG=1"), "{heard:?}");
    (0..3).for_each(|_| assert_eq!(manager.heard(), "WATCHDOG=1"));
    run.signal(Signal::TERM);
    assert!(manager.until("STOPPING=1").iter().rev().skip(1).all(|m| m == "WATCHDOG=1"));
    run.wait().with(143);
}

#[test]
fn a_stopped_process_sends_no_watchdog_pings() {
    let home = Home::new();
    let manager = Manager::new(&home);
    let run = manager.run(&home, RUN);
    manager.until("READY=1");
    run.signal(Signal::STOP);
    // What is on its way arrives; then nothing does.
    manager.socket.set_read_timeout(Some(Duration::from_millis(900))).unwrap();
    let mut buffer = [0; 64];
    let arrived = std::iter::from_fn(|| manager.socket.recv(&mut buffer).ok()).take(20).count();
    assert!(arrived < 20, "a stopped process says nothing");
    run.signal(Signal::CONT);
    run.end(Signal::KILL);
}

#[test]
fn who_asks_a_stopped_process_is_not_left_without_a_word() {
    let home = Home::new();
    let run = home.run(RUN);
    run.signal(Signal::STOP);
    let status = home.start("status");
    status.until(&format!("run coordinator-mock (pid {}) has not answered for 1 s: still waiting", run.pid()));
    run.signal(Signal::CONT);
    let ended = status.wait();
    assert!(ended.with(0).out.contains("coordinator-mock"));
    run.end(Signal::INT).with(130);
}

#[test]
fn the_service_manager_hears_why_it_does_not_come_up() {
    let home = Home::new();
    let manager = Manager::new(&home);
    let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let mut command = home.command(&format!("run coordinator-yourarm --set hardware.arm.address={port}"));
    let ended: Ended = Started::of(manager.settle(&mut command).stdin(Stdio::null())).wait();
    ended.with(3);
    assert!(manager.heard().starts_with("STATUS=arm: "));
}

#[test]
fn the_unit_files_are_units() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("assets/system");
    let ours = ["Type=notify", "Restart=no", "WatchdogSec=2", "KillSignal=SIGTERM"];
    for (unit, file, has) in [
        (
            "dimos@.service",
            "dimos-system@.service",
            &[&ours[..], &["LimitRTPRIO=95", "LimitMEMLOCK=infinity"]].concat(),
        ),
        ("dimos@.service", "dimos-user@.service", &ours.to_vec()),
        ("dimos-can@.service", "dimos-can@.service", &vec!["Type=oneshot", "RemainAfterExit=yes"]),
    ] {
        let lines = text(&folder.join(file));
        for line in has {
            assert!(lines.lines().any(|l| l == *line), "{file}: {line}");
        }
        // It must name a program that is there.
        let home = Home::new();
        home.write(unit, &lines.replace("/usr/local/bin/dimos", env!("CARGO_BIN_EXE_dimos")));
        let verified =
            Command::new("systemd-analyze").args(["verify", "--man=no", unit]).current_dir(home.path()).output();
        match verified {
            Ok(output) => {
                let said = String::from_utf8_lossy(&output.stderr);
                assert!(!said.lines().any(|line| line.contains("dimos")), "{file}: {said}");
            }
            Err(_) => skip("systemd-analyze"),
        }
    }
}
