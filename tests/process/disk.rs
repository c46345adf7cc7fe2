//! The disk of a log: too little room refuses a start, and a log that ends early ends its run, with words and exit
//! code 5. The real binary, on a small file system of its own where this user may mount one.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use rustix::process::Signal;
use rustix::thread::CapabilitySet;

use crate::support::program::{Home, Started, UP, eventually};
use crate::support::skip::skip_privileged;

const RUN: &str = "coordinator-mock";

/// A small file system in memory. Gone when this is dropped.
struct Disk(PathBuf);

impl Disk {
    /// Returns `None` where a mount fails; the test is skipped then.
    fn mount(home: &Home, megabytes: u64) -> Option<Self> {
        let at = home.path().join("disk");
        std::fs::create_dir(&at).unwrap();
        let mut mount = Command::new("mount");
        mount.args(["-t", "tmpfs", "-o", &format!("size={megabytes}m"), "dimos-test"]).arg(&at);
        let output = mount.output().unwrap();
        if !output.status.success() {
            let why = String::from_utf8_lossy(&output.stderr);
            skip_privileged(&format!("a mounted file system: {}", why.trim()), CapabilitySet::SYS_ADMIN);
            return None;
        }
        Some(Self(at))
    }

    fn write(&self, name: &str, megabytes: usize) {
        std::fs::write(self.0.join(name), vec![1; megabytes << 20]).unwrap();
    }
}

impl Drop for Disk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg(&self.0).status();
    }
}

fn run(home: &Home, log: &Path, more: &str) -> Started {
    home.run(&format!("{RUN} --record {} {more}", log.display()))
}

#[test]
fn a_start_with_too_little_room_is_refused() {
    let home = Home::new();
    let Some(disk) = Disk::mount(&home, 8) else { return };
    let log = disk.0.join("logs/run.mcap");
    let start = format!("run {RUN} --record {}", log.display());
    let refused = home.dimos(&format!("{start} --duration 300ms")).with(1);
    let refused = refused.says(&["MB free on its disk (minimum 200.0 MB)", "hint: free some space"]);
    assert!(!log.exists(), "{}", refused.err);
    // The limit is the blueprint's.
    home.dimos(&format!("{start} --duration 300ms --set recording.min_free=1MB")).with(0);
    home.dimos(&format!("{start} --set recording.min_free=lots")).with(2).says(&["recording.min_free", "200 MB"]);
}

#[test]
fn a_disk_that_fills_up_ends_the_run_with_a_log_that_is_whole() {
    let home = Home::new();
    let Some(disk) = Disk::mount(&home, 64) else { return };
    let log = disk.0.join("run.mcap");
    let run = run(&home, &log, "--set recording.min_free=32MB");
    let moving = home.start("move arm 2 0 0 0 0 0 0 --speed 0.02");
    moving.until("motion ");
    disk.write("other", 40);
    moving.wait().with(1).says(&["ABORTED: the log has ended, and with it the run"]);
    run.wait().with(5).says(&["MB free on its disk (minimum 32.0 MB)", "the log is incomplete"]);
    home.dimos(&format!("replay {} --verify", log.display())).with(0);
    assert_eq!(home.runs().runs().unwrap(), []);
    assert!(home.dimos("status").with(0).out.contains("MB free"), "status shows its end");
}

#[test]
fn a_run_without_a_log_names_the_log_of_its_fault_at_the_end() {
    let home = Home::new();
    let fault = "options: {sim: {faults: [{at: 1.0, kind: error_code}]}}";
    home.write("f.yaml", &format!("include: [coordinator-yourarm]\nhardware: [{{hardware_id: arm, {fault}}}]\n"));
    let run = home.run("f.yaml --no-record");
    eventually("its arm is held", || home.status()["arms"][0]["phase"] == "held");
    let ended = run.end(Signal::INT).with(130);
    let logs = home.logs();
    assert_eq!(logs.len(), 1);
    ended.says(&["ended; logs of faults: ", &logs[0].display().to_string()]);
    home.dimos("log verify --last").with(0);
}

#[test]
fn a_disk_without_any_room_left_ends_the_run() {
    let home = Home::new();
    let Some(disk) = Disk::mount(&home, 8) else { return };
    let run = run(&home, &disk.0.join("run.mcap"), "--set recording.min_free=0");
    let _ = std::fs::write(disk.0.join("other"), vec![1; 16 << 20]);
    run.wait().with(5).says(&["ends here: ", "the log is incomplete"]);
}

#[test]
fn a_log_that_is_removed_ends_the_run() {
    let home = Home::new();
    let folder = home.path().join("logs");
    let first = run(&home, &folder.join("run.mcap"), "");
    std::fs::remove_dir_all(&folder).unwrap();
    first.wait().with(5).says(&["it was removed or replaced", "the log is incomplete"]);
    let status = home.dimos("status").with(0).out;
    assert!(status.contains("LOG ENDED") && !status.contains("FAULT"), "{status}");
    // In the background no terminal shows it: `down` and `status` say what became of the run.
    let log = folder.join("again.mcap");
    home.dimos(&format!("run {RUN} -d --record {}", log.display())).with(0);
    std::fs::remove_file(&log).unwrap();
    eventually("the run has ended", || home.runs().runs().unwrap().is_empty());
    home.dimos(&format!("down {RUN}")).with(1).says(&["it was removed or replaced"]);
}

/// A disk on which a sync takes longer than the recorder's ring lasts.
const SLOW_SYNC: &str = "
#include <unistd.h>
int fdatasync(int file) { (void)file; return sleep(7); }
";

#[test]
fn a_disk_that_syncs_slowly_costs_no_sample_and_delays_no_end() {
    let home = Home::new();
    home.write("slow.c", SLOW_SYNC);
    let (library, log) = (home.path().join("slow.so"), home.path().join("run.mcap"));
    let mut compiler = Command::new("cc");
    compiler.args(["-shared", "-fPIC", "-o"]).arg(&library).arg(home.path().join("slow.c"));
    assert!(compiler.status().unwrap().success());
    let mut command = home.command(&format!("run {RUN} --record {}", log.display()));
    let run = Started::of(command.stdin(Stdio::null()).env("LD_PRELOAD", &library));
    run.until(UP);
    // The first sync begins after a second and lasts seven; the ring holds five.
    std::thread::sleep(Duration::from_millis(8500));
    let asked = Instant::now();
    let ended = run.end(Signal::INT).with(130).says(&["the log is closed, but its disk", "keep the power on"]);
    assert!(asked.elapsed() < Duration::from_secs(5), "{:?}", asked.elapsed());
    assert!(!ended.err.contains("fell behind"), "{}", ended.err);
    home.dimos(&format!("replay {} --verify", log.display())).with(0);
}
