//! The verbs that talk to a run, as a user types them: the real binary against a scripted run.

use std::path::Path;
use std::process::{Child, Command, Output, Stdio};
use std::sync::atomic::Ordering;

use dimos::rpc::Request;
use dimos::rpc::api::{Cancel, Gripper};
use serde_json::Value;

use crate::support::fake_run::{FakeBackend, GOING, PLAN, start};
use crate::support::program::eventually;

/// A world of runs; those in it are the only ones that the binary sees.
struct Home(tempfile::TempDir);

impl Home {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn runs(&self) -> std::path::PathBuf {
        self.0.path().join("dimos")
    }

    fn command(&self, arguments: &str) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_dimos"));
        command.args(arguments.split_whitespace()).env("DIMOS_WORLD", self.0.path());
        command.env("XDG_STATE_HOME", self.0.path()).current_dir(self.0.path());
        command
    }

    fn run(&self, arguments: &str) -> Ended {
        Ended::from(self.command(arguments).output().unwrap())
    }

    fn spawn(&self, arguments: &str) -> Child {
        self.command(arguments).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
    }
}

/// Sends SIGINT.
fn interrupt(child: &Child) {
    let pid = rustix::process::Pid::from_child(child);
    rustix::process::kill_process(pid, rustix::process::Signal::INT).unwrap();
}

/// Sends SIGINT and waits for the end, with its exit code.
#[track_caller]
fn interrupted(child: Child) -> Ended {
    interrupt(&child);
    Ended::from(child.wait_with_output().unwrap()).with(130)
}

struct Ended {
    code: Option<i32>,
    out: String,
    err: String,
}

impl From<Output> for Ended {
    fn from(output: Output) -> Self {
        let text = |bytes| String::from_utf8(bytes).unwrap();
        Self { code: output.status.code(), out: text(output.stdout), err: text(output.stderr) }
    }
}

impl Ended {
    #[track_caller]
    fn with(self, code: i32) -> Self {
        assert_eq!(self.code, Some(code), "stdout:\n{}\nstderr:\n{}", self.out, self.err);
        self
    }
}

fn write(folder: &Path, name: &str, text: &str) {
    std::fs::write(folder.join(name), text).unwrap();
}

#[test]
fn without_a_run_every_verb_says_how_to_start_one() {
    let home = Home::new();
    for verb in ["state", "move arm 0", "cancel", "stop", "stop --all", "arm reset arm", "down"] {
        let ended = home.run(verb).with(1);
        assert!(
            ended.err.starts_with("error: no run of this user is live\nhint: start one: dimos run "),
            "{verb}: {}",
            ended.err
        );
        assert_eq!(ended.out, "");
    }
    let overview = home.run("status").with(0);
    assert!(overview.out.is_empty() && overview.err.contains("hint:"));
    assert_eq!(home.run("status --json").with(0).out, "[]\n");
    assert!(home.run("state --run x").with(2).err.contains("no live run is named `x`"));
}

#[test]
fn several_runs_need_a_name() {
    let home = Home::new();
    let _one = start(&home.runs(), "left", FakeBackend::default());
    let (_server, right) = start(&home.runs(), "right", FakeBackend::default());
    let ended = home.run("state").with(2);
    assert!(ended.err.contains("left, right") && ended.err.contains("hint: select one with --run"), "{}", ended.err);
    assert!(home.run("state --run rihgt").with(2).err.contains("did you mean `right`?"));
    assert!(home.run("state --run right").with(0).out.contains("arm_joint1"));
    assert_eq!(right.asked().len(), 1);
    let overview = home.run("status").with(0).out;
    assert_eq!(overview.lines().count(), 5, "two runs, and their logs: {overview}");
    let json: Value = serde_json::from_str(&home.run("status --json").with(0).out).unwrap();
    assert_eq!(json.as_array().unwrap().len(), 2);
    let stopped = home.run("stop --all").with(0).out;
    assert!(stopped.contains("left") && stopped.contains("right"), "{stopped}");
}

#[test]
fn tables_align() {
    let home = Home::new();
    let _run = start(&home.runs(), "test", FakeBackend::default());
    let state = home.run("state").with(0).out;
    let expected = "\
arm  SIMULATED  state 2.5 ms old
JOINT       POSITION rad     deg  VELOCITY rad/s        EFFORT Nm  COMMAND rad
arm_joint1        1.5000   85.94         -0.0100                -       1.5000
arm_joint2       -0.2500  -14.32         -0.0100  est.          -      -0.2500
gripper  0.0400 m
pose     link_tcp in map
         xyz 0.100000 0.200000 0.300000 m  rpy 0.000000 0.000000 0.000000 rad
";
    assert_eq!(state, expected, "\n{state}");
    let status = home.run("status").with(0).out;
    for part in ["run test  SIMULATED", "arm is held: stopped by an operator", "42 %"] {
        assert!(status.contains(part), "{part:?} is not in\n{status}");
    }
    assert!(!status.contains("NOT granted"), "a simulated arm needs no real time:\n{status}");
    let verbose = home.run("status -v").with(0).out;
    assert!(verbose.contains("NOT granted") && verbose.contains("hint: ulimit -r 80"), "{verbose}");
    assert!(!status.contains('\x1b'), "no colour without a terminal");
}

#[test]
fn move_takes_negative_numbers_waits_and_prints_the_deviation() {
    let home = Home::new();
    let (_server, run) = start(&home.runs(), "test", FakeBackend::default());
    let ended = home.run("move arm 0.3 -0.2 --speed 0.25").with(0);
    assert!(ended.err.contains("direct, not collision-checked"), "{}", ended.err);
    assert!(ended.out.contains("motion 7: COMPLETED"), "{}", ended.out);
    assert!(ended.out.contains("+0.1000"), "{}", ended.out);
    // First it asks for a planner.
    match run.asked().as_slice() {
        [Request::Planner(_), Request::Status(_), Request::Move(m), ..] => {
            assert_eq!((m.target.as_slice(), m.speed), ([0.3, -0.2].as_slice(), 0.25));
        }
        other => panic!("{other:?}"),
    }
    for target in ["-.5 -1e-3", "-0 -2"] {
        home.run(&format!("move arm {target} --no-wait")).with(0);
    }
    let json: Value = serde_json::from_str(&home.run("move arm 0 0 --json").with(0).out).unwrap();
    assert_eq!(json["state"], "COMPLETED");
}

#[test]
fn what_cannot_be_is_refused_before_it_is_sent() {
    let home = Home::new();
    let (_server, run) = start(&home.runs(), "test", FakeBackend::default());
    for line in [
        "move arm",
        "move arm nan",
        "move arm inf",
        "move arm 0.1x",
        "move arm 0 --speed 1.5",
        "move arm 0 --speed 0",
        "cancel arm --task t",
        "stop arm --all",
        "arm reset",
        "mvoe arm 0",
    ] {
        home.run(line).with(2);
    }
    assert!(home.run("mvoe arm 0").err.contains("'move'"));
    assert_eq!(run.asked(), []);
    let unknown = home.run("move rarm 0").with(2);
    assert_eq!(unknown.err, "error: no arm named `rarm` [UNKNOWN_ARM]\nhint: did you mean `arm`?\n");
}

#[test]
fn a_motion_that_ends_elsewhere_is_a_failure() {
    let home = Home::new();
    let _run = start(&home.runs(), "test", FakeBackend { aborts: true, ..Default::default() });
    let ended = home.run("move arm 0.3 -0.2").with(1);
    assert!(ended.err.contains("error: motion 7: ABORTED: arm_joint1 was 0.2000 rad off the path"), "{}", ended.err);
    assert!(ended.out.contains("arm_joint2"), "where it ended is printed all the same");
}

#[test]
fn ctrl_c_cancels_the_motion() {
    let home = Home::new();
    let (_server, run) = start(&home.runs(), "test", FakeBackend { endless: true, ..Default::default() });
    let child = home.spawn("move arm 0.3 -0.2");
    eventually("the motion is waited for", || run.asked().iter().any(|r| matches!(r, Request::Going(_))));
    let ended = interrupted(child);
    assert!(ended.err.contains("cancelling motion 7"), "{}", ended.err);
    let cancel = Request::Cancel(Cancel { going: Some(GOING), ..Cancel::default() });
    assert!(run.asked().contains(&cancel));
}

#[test]
fn ctrl_c_while_planning_cancels_this_plan_and_no_motion() {
    let home = Home::new();
    let (_server, run) = start(&home.runs(), "test", FakeBackend { plans: true, ..Default::default() });
    for (verb, cancel) in [
        ("plan", Cancel { plan: Some(PLAN), ..Cancel::default() }),
        ("move", Cancel { going: Some(GOING), ..Cancel::default() }),
    ] {
        run.asked.lock().unwrap().clear();
        let child = home.spawn(&format!("{verb} arm 0.3 -0.2"));
        eventually("it plans", || run.asked().iter().any(|r| matches!(r, Request::Planning(_) | Request::Going(_))));
        let ended = interrupted(child);
        assert!(ended.err.contains("planning was cancelled: nothing has moved"), "{}", ended.err);
        let cancels: Vec<_> = run.asked().into_iter().filter(|r| matches!(r, Request::Cancel(_))).collect();
        assert_eq!(cancels, [Request::Cancel(cancel)], "{verb}");
    }
}

#[test]
fn ctrl_c_before_a_direct_motion_begins_none() {
    let home = Home::new();
    let (_server, run) = start(&home.runs(), "test", FakeBackend { holds_planner: true.into(), ..Default::default() });
    let child = home.spawn("move arm 0.3 -0.2");
    eventually("it asks for a planner", || !run.asked().is_empty());
    interrupt(&child);
    run.holds_planner.store(false, Ordering::Relaxed);
    let ended = Ended::from(child.wait_with_output().unwrap()).with(130);
    assert!(ended.err.contains("interrupted: no motion was started"), "{}", ended.err);
    assert!(matches!(run.asked()[..], [Request::Planner(_)]), "{:?}", run.asked());
}

#[test]
fn stop_says_whether_it_was_confirmed() {
    let home = Home::new();
    let _run = start(&home.runs(), "sure", FakeBackend::default());
    assert!(home.run("stop").with(0).out.contains("confirmed"));
    let _other = start(&home.runs(), "unsure", FakeBackend { unconfirmed: true, ..Default::default() });
    let ended = home.run("stop --run unsure").with(1);
    assert!(ended.out.contains("sent, not confirmed"), "{}", ended.out);
    assert!(ended.err.contains("error: not every arm confirmed"), "{}", ended.err);
}

#[test]
fn down_requests_the_end_before_it_asks_anything() {
    let home = Home::new();
    let (server, run) = start(&home.runs(), "test", FakeBackend::default());
    let child = home.spawn("down");
    eventually("both requests", || run.asked().len() == 2);
    assert!(matches!(run.asked()[..], [Request::Shutdown(_), Request::Status(_)]), "{:?}", run.asked());
    drop(server);
    let ended = Ended::from(child.wait_with_output().unwrap()).with(0);
    assert!(ended.err.contains("test ended"), "{}", ended.err);
}

#[test]
fn arm_verbs_and_cancel_print_their_result() {
    let home = Home::new();
    let (_server, run) = start(&home.runs(), "test", FakeBackend::default());
    let reset = home.run("arm reset arm").with(0);
    assert_eq!(reset.out, "arm: standby\n");
    assert!(reset.err.contains("dimos arm enable arm"));
    assert_eq!(home.run("arm enable arm").with(0).out, "arm: activating\n");
    assert_eq!(home.run("arm disable arm").with(0).out, "arm: disabled\n");
    assert_eq!(home.run("cancel").with(0).out, "traj_arm: CANCELLED\n");
    let gripper = home.run("arm gripper arm 0.04").with(1);
    assert!(gripper.err.contains("arm has no gripper [NO_GRIPPER]"), "{}", gripper.err);
    assert!(run.asked().contains(&Request::Gripper(Gripper {
        arm: "arm".into(),
        position: 0.04,
        ..Gripper::default()
    })));
}

#[test]
fn execute_reads_json_and_csv() {
    let home = Home::new();
    let (_server, run) = start(&home.runs(), "test", FakeBackend::default());
    let folder = home.0.path();
    write(
        folder,
        "a.csv",
        "time, arm_joint1, arm_joint2, arm_joint1_vel, arm_joint2_vel\n0,0,0,0,0\n\n1.5,0.1,-0.2,0,0\n",
    );
    home.run("execute a.csv").with(0);
    write(
        folder,
        "a.json",
        r#"{"joint_names":["arm_joint1","arm_joint2"],"points":[
        {"time_from_start":0,"positions":[0,0],"velocities":[0,0]},
        {"time_from_start":1.5,"positions":[0.1,-0.2],"velocities":[0,0]}]}"#,
    );
    home.run("execute a.json --task traj_arm --no-wait").with(0);
    let sent: Vec<_> =
        run.asked().into_iter().filter_map(|r| if let Request::Execute(e) = r { Some(e) } else { None }).collect();
    let [csv, json] = sent.as_slice() else { panic!("{sent:?}") };
    assert_eq!(csv.trajectory, json.trajectory);
    assert_eq!(csv.trajectory.points[1].velocities, Some(vec![0.0, 0.0]));
    assert_eq!(json.task.as_deref(), Some("traj_arm"));
}

/// The first motions with an arm are slow until its user says otherwise.
#[test]
fn an_arm_that_is_new_to_its_user_moves_at_25_percent_until_full_speed_is_asked_for() {
    let home = Home::new();
    let csv = "time,arm_joint1,arm_joint2,arm_joint1_vel,arm_joint2_vel\n0,0,0,0,0\n1.5,0.1,-0.2,0.4,0\n";
    write(home.0.path(), "a.csv", csv);
    let new = |address| start(&home.runs(), "test", FakeBackend { address: Some(address), ..Default::default() });
    let moved = |run: &FakeBackend, line: &str| {
        run.asked.lock().unwrap().clear();
        let ended = home.run(line).with(0);
        let speed = run.asked().into_iter().find_map(|request| match request {
            Request::Move(call) => Some(call.speed),
            Request::Execute(call) => Some(1.5 / call.trajectory.points[1].time_from_start),
            _ => None,
        });
        (
            speed.unwrap(),
            ended.err.contains("arm is new to you: at most 25 % of its speed until `dimos arm full-speed arm`"),
        )
    };
    let (server, run) = new("10.0.0.1:502");
    assert_eq!(moved(&run, "move arm 0.3 -0.2"), (0.25, true));
    assert_eq!(moved(&run, "move arm 0.3 -0.2 --direct --speed 0.1"), (0.1, true));
    assert_eq!(moved(&run, "execute a.csv"), (0.25, true));
    home.run("arm full-speed amr").with(2);
    assert_eq!(moved(&run, "move arm 0 0").0, 0.25);
    assert!(home.run("arm full-speed arm").with(0).out.contains("yourarm at 10.0.0.1:502"));
    assert_eq!(moved(&run, "move arm 0.3 -0.2 --speed 1"), (1.0, false));
    assert_eq!(moved(&run, "execute a.csv"), (1.0, false));
    drop(server);
    // The run knows whether its arm is on its computer: the run may be on another one than the verb.
    for (local, speed) in [(true, 1.0), (false, 0.25)] {
        let backend = FakeBackend { address: Some("127.0.0.1:502"), local, ..Default::default() };
        let (_server, run) = start(&home.runs(), "test", backend);
        assert_eq!(moved(&run, "move arm 0 0 --speed 1").0, speed, "{local}");
    }
}

#[test]
fn mistakes_in_a_trajectory_file_are_located() {
    let home = Home::new();
    for (name, text, expected) in [
        ("a.csv", "", "a.csv:1:1: the file is empty"),
        ("a.csv", "t,j\n0,0\n1,1\n", "a.csv:1:1: the first column must be `time`"),
        ("a.csv", "time,j,j\n0,0,0\n1,1,1\n", "a.csv:1:8: "),
        ("a.csv", "time\n0\n1\n", "a.csv:1:1: no joint columns"),
        ("a.csv", "time,a,b,a_vel\n0,0,0,0\n", "a.csv:1:1: velocities of 1 of 2 joints"),
        ("a.csv", "time,j\n0,0\n1,  x\n", "a.csv:3:5: \"x\" is not a finite number"),
        ("a.csv", "time,j\n0,0\n1,inf\n", "a.csv:3:3: \"inf\""),
        ("a.csv", "time,j\n0,0\n1\n", "a.csv:3:1: 1 values for 2 columns"),
        ("a.csv", "time,j\n0,0\n", "a.csv: a trajectory needs at least two points"),
        ("a.json", "{\"joint_names\":[],\n\"pionts\":[]}", "a.json:2:8: unknown field `pionts`"),
        ("a.txt", "", "a.txt: neither .json nor .csv"),
        ("missing.csv", "", "missing.csv: "),
    ] {
        if !name.starts_with("missing") {
            write(home.0.path(), name, text);
        }
        let ended = home.run(&format!("execute {name}")).with(2);
        assert!(ended.err.starts_with(&format!("error: {expected}")), "{text:?}: {}", ended.err);
    }
}

#[test]
fn a_trajectory_too_long_for_a_request_is_refused_here() {
    let home = Home::new();
    let _run = start(&home.runs(), "test", FakeBackend::default());
    let points: String = (0..20_000).map(|i| format!("{i},0.1234567890123\n")).collect();
    write(home.0.path(), "long.csv", &format!("time,arm_joint1\n{points}"));
    let ended = home.run("execute long.csv").with(1);
    assert!(ended.err.contains("[TOO_LARGE]") && ended.err.contains("hint:"), "{}", ended.err);
}

#[test]
fn a_closed_stdout_is_no_crash() {
    let home = Home::new();
    let _run = start(&home.runs(), "test", FakeBackend::default());
    let mut child = home.command("status").stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    drop(child.stdout.take());
    Ended::from(child.wait_with_output().unwrap()).with(0);
}

#[test]
fn the_version_names_the_commit() {
    let version = Home::new().run("--version").with(0).out;
    assert_eq!(version, format!("dimos {}\n", dimos::VERSION));
    assert!(dimos::VERSION.starts_with(env!("CARGO_PKG_VERSION")));
}
