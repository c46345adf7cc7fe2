//! `replay --onto`: arms follow what was recorded, within limits or not at all. The real binary, on simulated arms.

use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use dimos::blueprint::{Overrides, find, load};
use dimos::hardware::registry::Registry;
use dimos::replay::motion::RecordedMotion;
use dimos::replay::verify::{Finding, verify};
use dimos::rpc::api::{Motion, Move};
use dimos::rpc::place::RunFolder;
use dimos::runtime::{Options, Record, Run};

/// So far an arm may be from the recorded path [rad].
const PATH: f64 = 1e-3;
/// So far it may end from where the recorded motion ends [rad]: the goal tolerance of a task.
const END: f64 = 0.01;

const GOAL: [f64; 6] = [0.3, -0.25, 0.5, 0.1, 0.45, -0.2];

const MOCK: &str = "
name: mock6
hardware:
  - hardware_id: arm
    joints: {prefix: arm, count: 6}
    adapter_type: mock
tasks:
  - {name: traj_arm, type: trajectory, joint_names: {hardware: arm}}
";

struct Home(tempfile::TempDir);

impl Home {
    fn new() -> Self {
        let home = Self(tempfile::tempdir().unwrap());
        std::fs::write(home.path("mock6.yaml"), MOCK).unwrap();
        home
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn command(&self, arguments: &str) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_dimos"));
        command.args(arguments.split_whitespace()).current_dir(self.0.path()).stdin(Stdio::null());
        command.env("XDG_RUNTIME_DIR", self.0.path()).env("XDG_STATE_HOME", self.0.path());
        command
    }

    #[track_caller]
    fn run(&self, arguments: &str, code: i32) -> (String, String) {
        let Output { status, stdout, stderr } = self.command(arguments).output().unwrap();
        let text = |bytes| String::from_utf8(bytes).unwrap();
        let (out, err) = (text(stdout), text(stderr));
        assert_eq!(status.code(), Some(code), "stdout:\n{out}\nstderr:\n{err}");
        (out, err)
    }

    /// Records a move there and back on a simulated yourarm.
    fn recorded(&self) -> PathBuf {
        let log = self.path("recorded.mcap");
        let registry = Registry::builtin();
        let found = find("coordinator-yourarm").unwrap_or_else(|e| panic!("{}", e.message));
        let blueprint = load(&found, &Overrides::default(), &registry).blueprint.unwrap();
        let folder = RunFolder::at(self.path("runs"));
        let options = Options { record: Record::To(log.clone()), folder, hold_latency: false, ..Options::default() };
        let run = Run::start(&blueprint, options).unwrap();
        for target in [GOAL, [0.1; 6], GOAL] {
            let begun = run.call(&Move { arm: "arm".into(), target: target.to_vec(), speed: 0.7 }).unwrap();
            let limit = Instant::now() + Duration::from_secs(30);
            while !run.call(&Motion { motion: begun.motion }).unwrap().done {
                assert!(Instant::now() < limit, "the move does not end");
                std::thread::sleep(Duration::from_millis(10));
            }
        }
        run.stop();
        log
    }
}

fn motion(log: &Path) -> RecordedMotion {
    RecordedMotion::read(log, 0, u64::MAX).unwrap()
}

/// The distance of a pose from the straight line between two others [rad], over all joints.
fn distance(pose: &[f64], a: &[f64], b: &[f64]) -> f64 {
    let dot = |x: &dyn Fn(usize) -> f64, y: &dyn Fn(usize) -> f64| (0..pose.len()).map(|j| x(j) * y(j)).sum::<f64>();
    let (along, off) = (|j: usize| b[j] - a[j], |j: usize| pose[j] - a[j]);
    let length = dot(&along, &along);
    let t = if length > 0.0 { (dot(&along, &off) / length).clamp(0.0, 1.0) } else { 0.0 };
    let rest = |j: usize| off(j) - t * along(j);
    dot(&rest, &rest).sqrt()
}

#[track_caller]
fn assert_followed(recorded: &Path, again: &Path) {
    let (was, is) = (motion(recorded), motion(again));
    assert_eq!(was.joints, is.joints);
    for pose in &was.rows {
        let nearest = is.rows.windows(2).map(|w| distance(pose, &w[0], &w[1])).fold(f64::MAX, f64::min);
        assert!(nearest <= PATH, "{pose:?} is {nearest} rad from the path");
    }
    let ends = was.rows.last().unwrap().iter().zip(is.rows.last().unwrap());
    assert!(ends.clone().all(|(a, b)| (a - b).abs() <= 1e-6), "{ends:?}");
}

#[test]
fn a_motion_recorded_within_limits_is_followed_by_another_run_and_by_another_arm() {
    let home = Home::new();
    let log = home.recorded();
    let (out, err) = home.run("replay recorded.mcap --onto coordinator-yourarm --record again.mcap", 0);
    assert!(out.contains("motion: COMPLETED") && err.contains("approach: arm"), "{out}{err}");
    assert_followed(&log, &home.path("again.mcap"));
    assert_eq!(verify(&home.path("again.mcap")).unwrap().finding, Finding::Reproducible);

    let (out, _) = home.run("replay recorded.mcap --onto mock6.yaml --record mock.mcap --rate 0.9 --json", 0);
    assert_followed(&log, &home.path("mock.mcap"));
    let said: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert_eq!(said["completed"], true);
    let deviation = said["deviation"].as_object().unwrap();
    assert_eq!(deviation.len(), 6);
    assert!(deviation.values().all(|d| d.as_f64().unwrap().abs() <= END), "{deviation:?}");
}

#[test]
fn limits_are_kept_or_the_motion_is_refused_before_anything_moves() {
    let home = Home::new();
    home.recorded();
    let (_, err) = home.run("replay recorded.mcap --onto mock6.yaml --rate 3 --record refused.mcap", 1);
    assert!(err.contains("would break its acceleration limit by ") && err.contains("nothing has moved"), "{err}");
    let commanded = motion(&home.path("refused.mcap"));
    assert!(commanded.rows.iter().flatten().all(|q| *q == 0.0), "nothing may have moved");
    let rate = err.split("--rate ").nth(1).and_then(|rest| rest.split(';').next()).unwrap();
    assert!((1.0..3.0).contains(&rate.parse::<f64>().unwrap()), "{rate}");
    home.run(&format!("replay recorded.mcap --onto mock6.yaml --no-record --rate {rate}"), 0);

    let narrow = MOCK.replace("adapter_type: mock", "adapter_type: mock\n    limits: {position: [-1, 0.4]}");
    std::fs::write(home.path("narrow.yaml"), narrow).unwrap();
    let (_, err) = home.run("replay recorded.mcap --onto narrow.yaml --no-record", 1);
    assert!(err.contains("arm_joint3 would break its position limit by 0.1100 rad"), "{err}");
}

#[test]
fn other_joints_and_real_arms_are_refused_before_anything_is_connected() {
    let home = Home::new();
    home.recorded();
    let (_, err) = home.run("replay recorded.mcap --onto coordinator-dual-mock", 2);
    assert!(err.contains("the log moves arm_joint1, which the blueprint coordinator-dual-mock does not have"), "{err}");
    assert!(err.contains("hint: ") && err.contains("left_arm_joint1"), "{err}");
    let real = "replay recorded.mcap --onto coordinator-yourarm --set hardware.arm.address=127.0.0.1:9 --no-record";
    let (_, err) = home.run(real, 2);
    assert!(err.contains("would move for real") && err.contains("--allow-motion"), "{err}");
    // Allowed, it is tried: nobody answers there.
    home.run(&format!("{real} --allow-motion"), 3);
    home.run("replay recorded.mcap --allow-motion", 2);
    home.run("replay nothing.mcap --onto mock6.yaml", 2);
    let bare = MOCK.split("tasks:").next().unwrap();
    std::fs::write(home.path("bare.yaml"), bare).unwrap();
    let (_, err) = home.run("replay recorded.mcap --onto bare.yaml", 2);
    assert!(err.contains("no trajectory task of the blueprint covers the joints of arm"), "{err}");
}

#[test]
fn an_interrupt_in_mid_motion_ends_it_controlled() {
    let home = Home::new();
    home.recorded();
    let mut command = home.command("replay recorded.mcap --onto mock6.yaml --rate 0.1 --record cut.mcap");
    let child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let socket = home.path("dimos/mock6.sock");
    let limit = Instant::now() + Duration::from_secs(30);
    while !socket.exists() {
        assert!(Instant::now() < limit, "the run does not come up");
        std::thread::sleep(Duration::from_millis(10));
    }
    std::thread::sleep(Duration::from_millis(700));
    let pid = rustix::process::Pid::from_child(&child);
    rustix::process::kill_process(pid, rustix::process::Signal::INT).unwrap();
    let ended = child.wait_with_output().unwrap();
    let err = String::from_utf8_lossy(&ended.stderr);
    assert_eq!(ended.status.code(), Some(130), "{err}");
    assert!(err.contains("cancelling: the arms decelerate"), "{err}");
    assert_eq!(verify(&home.path("cut.mcap")).unwrap().finding, Finding::Reproducible);
}
