//! A run without real-time rights whose tick gets no processor beside busy programs: its arm is held, it does not end,
//! and it continues afterwards. A tick that is stopped ends the run.

use std::process::{Command, Stdio};
use std::time::Duration;

use rustix::process::Pid;
use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};

use crate::support::program::{Home, Started, eventually};
use crate::support::skip::skip;

/// A program that uses a processor without end.
fn busy() -> Started {
    Started::of(Command::new("sh").args(["-c", "while :; do :; done"]).stdin(Stdio::null()))
}

fn pin(task: u32, cpu: usize) {
    let mut one = CpuSet::new();
    one.set(cpu);
    sched_setaffinity(Pid::from_raw(task as i32), &one).unwrap();
}

/// The thread of this name.
fn thread(run: &Started, name: &str) -> u32 {
    let tasks = std::fs::read_dir(format!("/proc/{}/task", run.pid())).unwrap().map(|task| task.unwrap());
    let is_it = |path: &std::path::Path| std::fs::read_to_string(path.join("comm")).is_ok_and(|it| it.trim() == name);
    let found = tasks.filter(|task| is_it(&task.path())).find_map(|task| task.file_name().to_str()?.parse().ok());
    found.unwrap_or_else(|| panic!("no thread {name}"))
}

#[test]
fn a_starved_tick_does_not_end_the_run() {
    let home = Home::new();
    let mut command = Command::new("setpriv");
    command.args(["--bounding-set", "-sys_nice", "--inh-caps", "-sys_nice", "prlimit", "--rtprio=0"]);
    command.args([env!("CARGO_BIN_EXE_dimos"), "run", "coordinator-mock", "--no-record", "--no-view"]);
    home.settle(&mut command).stdin(Stdio::null());
    if !["setpriv", "prlimit", "renice"].iter().all(|tool| Command::new(tool).arg("--version").output().is_ok()) {
        return skip("setpriv, prlimit and renice of util-linux");
    }
    let run = Started::of(&mut command);
    eventually("it is up or was refused", || run.over() || run.err().contains("Press Ctrl-C"));
    if run.over() {
        return skip(&format!("setpriv as this user: {}", run.err()));
    }
    let tick = thread(&run, "tick");
    let own = sched_getaffinity(None).unwrap();
    let cpu = (0..CpuSet::MAX_CPU).find(|cpu| own.is_set(*cpu)).unwrap();
    pin(tick, cpu);
    assert!(Command::new("renice").args(["-n", "19", "-p", &tick.to_string()]).output().unwrap().status.success());
    let hogs: Vec<Started> = (0..6).map(|_| busy()).collect();
    hogs.iter().for_each(|hog| pin(hog.pid(), cpu));
    std::thread::sleep(Duration::from_secs(6));
    assert!(!run.over(), "it has ended: {}", run.err());
    let arm = &home.status()["arms"][0];
    assert_eq!((&arm["phase"], &arm["enabled"]), (&"held".into(), &true.into()), "{arm}");
    drop(hogs);
    let mut client = home.client();
    eventually("it ticks again, and the arm can be made ready", || {
        let _ = client.call(dimos::rpc::api::ArmReset { arm: "arm".into() });
        let _ = client.call(dimos::rpc::api::ArmEnable::new("arm"));
        home.status()["arms"][0]["phase"] == "ready"
    });
}
