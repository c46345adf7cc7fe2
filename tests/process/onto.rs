//! `replay --onto`: arms follow what was recorded, within limits or not at all. The real binary, on simulated arms.

use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use dimos::blueprint::{Overrides, find, load};
use dimos::control::point_to_point::point_to_point;
use dimos::control::request::Request;
use dimos::control::task_spec::TaskTable;
use dimos::joint::make_joints;
use dimos::replay::motion::RecordedMotion;
use dimos::replay::verify::{Finding, verify};
use dimos::rpc::api::{Motion, Move};
use dimos::rpc::run_dir::RunDir;
use dimos::runtime::{Options, Record, Run};
use dimos::telemetry::TaskState;

use crate::support::virtual_run::{VirtualRun, one_arm};
use crate::support::wire::watch::Watch;

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
        command.env("DIMOS_WORLD", self.0.path()).env("XDG_STATE_HOME", self.0.path());
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

    /// Runs the program, which records `again.mcap`, to its success.
    #[track_caller]
    fn run_in_time(&self, arguments: &str) -> (String, String) {
        let log = self.path("again.mcap");
        Watch::of_processors().unless_stalled(|| {
            let _ = std::fs::remove_file(&log);
            let ended = self.command(&format!("{arguments} --record again.mcap")).output().unwrap();
            let (out, err) = (String::from_utf8(ended.stdout).unwrap(), String::from_utf8(ended.stderr).unwrap());
            if ended.status.success() { Ok((out, err)) } else { Err(format!("stdout:\n{out}\nstderr:\n{err}")) }
        })
    }

    /// Records moves to and fro on a simulated yourarm.
    fn recorded_on_yourarm(&self) -> PathBuf {
        let registry = dimos::arms::registry();
        let found = find("coordinator-yourarm").unwrap_or_else(|e| panic!("{}", e.message));
        let blueprint = load(&found, &Overrides::default(), &registry).blueprint.unwrap();
        let log = self.path("yourarm.mcap");
        Watch::of_processors().unless_stalled(|| {
            let _ = std::fs::remove_file(&log);
            let record = Record::To(log.clone());
            let folder = RunDir::closed(self.path("runs"));
            let run = Run::start(&blueprint, Options { record, folder, hold_latency: false, ..Options::default() });
            let run = run.unwrap();
            let poses = [(GOAL, 0.02), ([0.1; 6], 0.07), (GOAL, 0.05)];
            let done = poses.iter().try_for_each(|(target, opening)| {
                run.gripper("arm", *opening).map_err(|e| e.to_string())?;
                moved(&run, target)
            });
            run.stop();
            done
        });
        log
    }

    /// Records the same moves on an ideal arm, on a clock that is set forward.
    fn recorded(&self) -> PathBuf {
        let log = self.path("recorded.mcap");
        let config = one_arm(6);
        let mut run = VirtualRun::start(&config, &log);
        run.step();
        run.ask(Request::Enabled { arm: 0, outside: false });
        (0..40).for_each(|_| run.step());
        let mut from = [0.0; 6];
        for target in [GOAL, [0.1; 6], GOAL] {
            let names = make_joints("arm", 6);
            run.execute(0, &point_to_point(&names, &from, &target, &config.arms[0].limits, 0.8).unwrap());
            run.step();
            while run.tasks[0].state == TaskState::Executing {
                run.step();
            }
            assert_eq!(run.tasks[0].state, TaskState::Completed);
            from = target;
        }
        run.finish();
        log
    }
}

/// Moves the arm; an error unless the move is completed.
fn moved(run: &Run, target: &[f64]) -> Result<(), String> {
    let begun = run.call(Move::new("arm", target, 0.7)).map_err(|e| e.to_string())?;
    let limit = Instant::now() + Duration::from_secs(30);
    loop {
        let report = run.call(Motion { motion: begun.motion }).unwrap();
        if report.done {
            return if report.state == "COMPLETED" { Ok(()) } else { Err(format!("{report:?}")) };
        }
        assert!(Instant::now() < limit, "the move does not end");
        std::thread::sleep(Duration::from_millis(10));
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
    // A task may end a step before its goal, when the arm is there within the goal tolerance.
    let (end, goal) = (is.rows.last().unwrap(), was.rows.last().unwrap());
    assert!(end.iter().zip(goal).all(|(a, b)| (a - b).abs() <= PATH), "{end:?} is not {goal:?}");
}

#[test]
fn a_motion_recorded_within_limits_is_followed_by_another_run_and_by_another_arm() {
    let home = Home::new();
    let log = home.recorded_on_yourarm();
    let (out, err) = home.run_in_time(&format!("replay {} --onto coordinator-yourarm", log.display()));
    assert!(out.contains("motion: COMPLETED") && err.contains("approach: arm"), "{out}{err}");
    assert_followed(&log, &home.path("again.mcap"));
    // The gripper, too: the same commands, in the same parts of the motion.
    let openings = |log: &Path| motion(log).grips.iter().map(|grip| grip.position).collect::<Vec<_>>();
    assert_eq!((openings(&log), openings(&home.path("again.mcap"))), (vec![0.02, 0.07, 0.05], vec![0.02, 0.07, 0.05]));
    let [_, second, third] = motion(&home.path("again.mcap")).grips.try_into().unwrap();
    assert!(third.time > second.time + 0.3, "{second:?} {third:?}");
    assert_eq!(verify(&home.path("again.mcap"), &TaskTable::builtin()).unwrap().finding, Finding::Reproducible);

    let (out, _) = home.run_in_time(&format!("replay {} --onto mock6.yaml --rate 0.9 --json", log.display()));
    assert_followed(&log, &home.path("again.mcap"));
    let said: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert_eq!(said["completed"], true);
    let deviation = said["deviation"].as_object().unwrap();
    assert_eq!(deviation.len(), 6);
    assert!(deviation.values().all(|d| d.as_f64().unwrap().abs() <= END), "{deviation:?}");
}

#[test]
fn limits_are_kept_or_the_motion_is_refused_before_anything_moves() {
    let home = Home::new();
    let log = home.recorded();
    let (_, err) = home.run("replay recorded.mcap --onto mock6.yaml --rate 4 --record refused.mcap", 1);
    assert!(err.contains("exceeds its acceleration limit by 10.48") && err.contains("nothing has moved"), "{err}");
    let commanded = motion(&home.path("refused.mcap"));
    assert!(commanded.rows.iter().flatten().all(|q| *q == 0.0), "nothing may have moved");
    let rate = err.split("--rate ").nth(1).and_then(|rest| rest.split(';').next()).unwrap();
    assert!((1.5..4.0).contains(&rate.parse::<f64>().unwrap()), "{rate}");
    home.run_in_time(&format!("replay recorded.mcap --onto mock6.yaml --rate {rate}"));
    assert_followed(&log, &home.path("again.mcap"));

    let narrow = |limits| {
        let text = MOCK.replace("adapter_type: mock", &format!("adapter_type: mock\n    limits: {limits}"));
        std::fs::write(home.path("narrow.yaml"), text).unwrap();
        home.run("replay recorded.mcap --onto narrow.yaml --no-record", 1).1
    };
    let err = narrow("{position: [-1, 0.4]}");
    assert!(err.contains("arm_joint3 exceeds its position limit by 0.1100 rad: 0.5000 of 0.3900 rad"), "{err}");
    // Recorded at 0.8 times the speed: with 0.64 times 2 rad/s².
    let err = narrow("{acceleration: 1}");
    assert!(err.contains("exceeds its acceleration limit by 0.28"), "{err}");
    assert!(err.contains("--rate 0.88"), "{err}");
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
    assert!(err.contains("are real arms") && err.contains("--allow-motion"), "{err}");
    // Allowed, it is tried; no arm answers there.
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
    assert_eq!(verify(&home.path("cut.mcap"), &TaskTable::builtin()).unwrap().finding, Finding::Reproducible);
}
