//! `dimos jog` as a user runs it: in a terminal, with keys, beside a run.

use std::time::{Duration, Instant};

use dimos::rpc::api::{Lease, State, Status};
use dimos::rpc::client::Client;
use dimos::rpc::report::ArmReport;
use rustix::process::Signal;

use crate::support::program::{Home, Started, TIMEOUT, eventually};
use crate::support::terminal::Terminal;

/// An arm with an emulator, and a task that lets the keyboard move its joints.
const YOURARM: &str = "
name: jogged
include: [coordinator-yourarm]
tasks:
  - {name: velocity_arm, type: velocity, joint_names: {hardware: arm}, priority: 20}
";
/// The same arm with nothing that moves its end effector.
const JOINTS_ONLY: &str = "
name: jogged
hardware:
  - {hardware_id: arm, joints: {prefix: arm, count: 6}, adapter_type: yourarm, address: sim}
tasks:
  - {name: velocity_arm, type: velocity, joint_names: {hardware: arm}, priority: 20}
";
/// The keys of one joint, as often as a held key comes, and so that a busy machine is no gap.
const HOLD: Duration = Duration::from_millis(40);

struct Rig {
    home: Home,
    run: Option<Started>,
    watcher: Client,
}

impl Rig {
    fn new(blueprint: &str) -> Self {
        let home = Home::new();
        home.write("jogged.yaml", blueprint);
        let run = home.run("jogged.yaml --sim --no-record");
        let watcher = home.client();
        Self { home, run: Some(run), watcher }
    }

    fn joint(&mut self, joint: usize) -> (f64, f64) {
        let joint = self.watcher.call(State {}).unwrap().arms[0].joints[joint].clone();
        (joint.position.unwrap(), joint.velocity.unwrap())
    }

    fn arm(&mut self) -> ArmReport {
        self.watcher.call(Status {}).unwrap().arms.remove(0)
    }

    /// Holds a key down until a joint has gone so far [rad].
    #[track_caller]
    fn hold(&mut self, terminal: &Terminal, key: &str, joint: usize, by: f64) {
        let (from, began) = (self.joint(joint).0, Instant::now());
        while (self.joint(joint).0 - from) / by < 1.0 {
            assert!(began.elapsed() < TIMEOUT, "{key:?} does not move joint {joint}:\n{}", terminal.text());
            terminal.keys(key);
            std::thread::sleep(HOLD);
        }
    }

    /// Waits until nothing moves; how long that took.
    #[track_caller]
    fn rest(&mut self) -> Duration {
        let began = Instant::now();
        eventually("the arm is at rest", || {
            let joints = self.watcher.call(State {}).unwrap().arms.remove(0).joints;
            joints.iter().all(|joint| joint.velocity.unwrap().abs() < 1e-4)
        });
        began.elapsed()
    }
}

#[test]
fn a_held_key_moves_the_arm_and_letting_go_stops_it() {
    let mut rig = Rig::new(YOURARM);
    let terminal = Terminal::new(80, 24);
    let jog = terminal.start(&rig.home, "jog arm --joints");
    terminal.until("task velocity_arm IDLE  at rest");
    rig.hold(&terminal, "+", 0, 0.05);
    terminal.until_with("moving +0.100 rad/s", || terminal.keys("+"));
    let holder = rig.arm().commander.unwrap();
    assert_eq!((holder.pid, holder.program.as_str()), (Some(jog.pid() as i32), "dimos jog"));

    let (at, letting_go) = (rig.joint(0).0, Instant::now());
    rig.rest();
    // 0.25 s at 0.1 rad/s and the way of slowing down: far less than a second's, on however slow a machine.
    let (further, took) = (rig.joint(0).0 - at, letting_go.elapsed());
    assert!(further < 0.1 && took < Duration::from_secs(5), "{further:.3} rad further, at rest after {took:?}");
    terminal.until("at rest");
    // Once it is over the task lets go of the joints, and others may have them.
    terminal.until("task velocity_arm IDLE (its stream was ended)");

    terminal.keys("3");
    terminal.until("> 3 arm_joint3");
    let before = rig.joint(0).0;
    rig.hold(&terminal, "\x1b[B", 2, -0.03);
    rig.rest();
    assert!((rig.joint(0).0 - before).abs() < 1e-3, "only the chosen joint moves");

    terminal.keys("]]");
    terminal.until("speed 60 %: 0.300 rad/s");
    rig.hold(&terminal, "+", 2, 0.05);
    terminal.keys(" ");
    terminal.until("at rest");
    rig.rest();

    // The gripper opens and closes while its key is held.
    let mut hold_until = |key: &str, there: fn(f64) -> bool| {
        let began = Instant::now();
        while !there(rig.watcher.call(State {}).unwrap().arms[0].gripper.unwrap()) {
            assert!(began.elapsed() < TIMEOUT, "{key:?} does not move the gripper:\n{}", terminal.text());
            terminal.keys(key);
            std::thread::sleep(HOLD);
        }
    };
    hold_until("o", |opening| opening > 0.07);
    hold_until("C", |opening| opening < 0.01);
    terminal.until("O/C open/close the gripper");
    terminal.keys("\x1b");
    jog.wait().with(0);
    eventually("the terminal is given back", || terminal.is_as_before());
    assert!(rig.arm().commander.is_none());
}

#[test]
fn the_end_effector_moves_along_the_axes_of_its_keys() {
    let home = Home::new();
    let run = home.run("keyboard-teleop-yourarm --no-record");
    let watcher = home.client();
    let mut rig = Rig { home, run: Some(run), watcher };
    // Away from the straight arm, where not every direction is free.
    rig.home.dimos("move arm 0 -0.3 0.9 0 0.8 0").with(0);
    let terminal = Terminal::new(80, 24);
    let jog = terminal.start(&rig.home, "jog arm");
    terminal.until("CARTESIAN along the axes of the base");
    terminal.until("task twist_arm IDLE  at rest");
    let mut pose = || rig.watcher.call(State {}).unwrap().arms[0].pose.clone().unwrap();
    for (key, axis, sign) in
        [("w", 0, 1.0), ("s", 0, -1.0), ("a", 1, 1.0), ("D", 1, -1.0), ("q", 2, 1.0), ("e", 2, -1.0)]
    {
        let (from, began) = (pose().xyz, Instant::now());
        while (pose().xyz[axis] - from[axis]) * sign < 0.015 {
            assert!(began.elapsed() < TIMEOUT, "{key:?} does not move it:\n{}", terminal.text());
            terminal.keys(key);
            std::thread::sleep(HOLD);
        }
        terminal.until("at rest");
        let to = pose().xyz;
        for other in (0..3).filter(|other| *other != axis) {
            assert!((to[other] - from[other]).abs() < 0.004, "{key:?}: {from:?} to {to:?}");
        }
    }
    // Turning leaves the place as it is.
    let (from, began) = (pose(), Instant::now());
    while (pose().rpy[2] - from.rpy[2]).abs() < 0.05 {
        assert!(began.elapsed() < TIMEOUT, "it does not turn:\n{}", terminal.text());
        terminal.keys("y");
        std::thread::sleep(HOLD);
    }
    terminal.until("at rest");
    let to = pose();
    assert!(to.xyz.iter().zip(from.xyz).all(|(to, from)| (to - from).abs() < 0.004), "{from:?} to {to:?}");

    // B: along the tool's own axes.
    terminal.keys("b");
    terminal.until("CARTESIAN along the axes of the tool");
    terminal.keys("q");
    terminal.until_with("moving +z", || terminal.keys("q"));
    terminal.until("at rest");
    terminal.keys("\t");
    terminal.until("JOINT arm_joint1");
    rig.hold(&terminal, "+", 0, 0.03);
    rig.rest();
    terminal.keys("\x1b");
    jog.wait().with(0);
    // The planner's own motions are none of its business.
    rig.home.dimos("move arm --named home").with(0);
}

#[test]
fn the_screen_shows_the_arm_in_80_columns_and_in_few() {
    let mut rig = Rig::new(JOINTS_ONLY);
    let terminal = Terminal::new(80, 24);
    let jog = terminal.start(&rig.home, "jog arm");
    // There is no task for the end effector: it begins with joints and says why.
    terminal.until("twist_arm, type: eef_twist, joint_names: {hardware: arm}");
    terminal.until("ms old");
    terminal.until("pose  flange in base (device)");
    let text = terminal.text();
    let lines: Vec<&str> = text.lines().collect();
    assert!(lines[0].starts_with("jog arm  run jogged  SIMULATED  state "), "{text}");
    assert!(lines[1].starts_with("ready  link up"), "{text}");
    for (joint, row) in (1..=6).zip(&lines[4..]) {
        let cells: Vec<&str> = row.trim_start_matches('>').split_whitespace().collect();
        let (position, _) = rig.joint(joint - 1);
        assert_eq!(cells[..2], [joint.to_string(), format!("arm_joint{joint}")], "{text}");
        assert!((cells[2].parse::<f64>().unwrap() - position).abs() < 1e-3, "{row} {position}");
        assert!((cells[3].parse::<f64>().unwrap() - position.to_degrees()).abs() < 0.1, "{row} {position}");
        assert!(cells[5].starts_with('[') && cells[5].contains('#') && cells[5].ends_with(']'), "{row}");
    }
    for part in ["JOINT arm_joint1", "+/- or arrows move it", "Space rest", "X stop, latched", "Esc leave"] {
        assert!(text.contains(part), "no {part:?} in\n{text}");
    }
    terminal.keys("\t");
    terminal.until("add to `tasks`");
    terminal.resize(40, 16);
    terminal.until("jog arm");
    let fits =
        |text: &str| ["ready", "arm_joint6", "task velocity_arm", "add to"].iter().all(|part| text.contains(part));
    let began = Instant::now();
    while !fits(&terminal.text()) || terminal.text().contains('#') {
        assert!(began.elapsed() < TIMEOUT, "{}", terminal.text());
        std::thread::sleep(HOLD);
    }
    eventually("what is good is green", || terminal.has_colour());
    jog.end(Signal::TERM).with(143);
    eventually("the terminal is given back", || terminal.is_as_before());

    let terminal = Terminal::new(80, 24);
    let jog = terminal.start_with(&rig.home, "jog arm", &[("NO_COLOR", "1")]);
    terminal.until("ready");
    assert!(!terminal.has_colour());
    terminal.keys("\x03");
    jog.wait().with(130);
    eventually("the terminal is given back", || terminal.is_as_before());
}

#[test]
fn when_jog_dies_or_loses_its_terminal_the_arm_stops() {
    let mut rig = Rig::new(YOURARM);
    let mut terminal = Terminal::new(80, 24);
    for how in ["kill -9", "the terminal is closed"] {
        let jog = terminal.start(&rig.home, "jog arm --joints");
        terminal.until("at rest");
        rig.hold(&terminal, "+", 0, 0.03);
        terminal.keys("+");
        match how {
            "kill -9" => {
                let ended = jog.end(Signal::KILL);
                assert_eq!(ended.signal, Some(Signal::KILL.as_raw()));
                terminal = Terminal::new(80, 24);
            }
            _ => {
                terminal.close();
                let code = jog.wait().code;
                assert!(matches!(code, Some(1 | 130)), "{code:?}");
            }
        }
        let took = rig.rest();
        assert!(took < Duration::from_secs(5), "{how}: {took:?}");
        eventually("the lease is free", || rig.arm().commander.is_none());
        assert_eq!(rig.arm().phase, "ready", "{how} is no fault");
    }
}

#[test]
fn a_run_that_ends_gives_the_terminal_back() {
    let mut rig = Rig::new(YOURARM);
    let terminal = Terminal::new(80, 24);
    let jog = terminal.start(&rig.home, "jog arm");
    terminal.until("ready");
    rig.run.take().unwrap().end(Signal::TERM).with(143);
    jog.wait().with(1);
    eventually("the terminal is given back", || terminal.is_as_before());
    terminal.until("error: run \"jogged\"");
}

#[test]
fn the_latched_stop_holds_the_arm_until_somebody_resets_it() {
    let mut rig = Rig::new(YOURARM);
    let terminal = Terminal::new(80, 24);
    let jog = terminal.start(&rig.home, "jog arm --joints");
    terminal.until("at rest");
    rig.hold(&terminal, "+", 0, 0.03);
    terminal.keys("x");
    terminal.until("stop of arm: confirmed");
    terminal.until("held: ");
    assert_eq!((rig.arm().phase.as_str(), rig.arm().commander), ("held", None));
    let held = rig.joint(0).0;
    terminal.keys("++++");
    terminal.until("arm is held");
    assert!((rig.joint(0).0 - held).abs() < 5e-3);
    // The lease is free, so that an operator at the arm can make it ready again.
    let mut free = 0;
    eventually("every refused key is answered: no client holds the lease for a while", || {
        free = if rig.arm().commander.is_none() { free + 1 } else { 0 };
        free >= 20
    });
    rig.home.dimos("arm reset arm").with(0);
    rig.home.dimos("arm enable arm").with(0);
    terminal.until("ready  link up");
    rig.hold(&terminal, "-", 0, -0.03);
    terminal.keys("\x1b");
    jog.wait().with(0);
}

#[test]
fn where_the_terminal_tells_that_keys_go_up_that_counts() {
    let mut rig = Rig::new(YOURARM);
    let terminal = Terminal::new(80, 24);
    let jog = terminal.start(&rig.home, "jog arm --joints");
    terminal.until("at rest");
    // `=` goes up, by the kitty keyboard protocol: from here on a motion lasts until its key goes up.
    terminal.keys("=\x1b[61;1:3u");
    terminal.until("moves while a key is down");
    let from = rig.joint(0).0;
    terminal.keys("=");
    eventually("it moves on without repeats", || {
        terminal.keys("\x1b[61;1:2u");
        rig.joint(0).0 - from > 0.08
    });
    terminal.keys("\x1b[61;1:3u");
    terminal.until("at rest");
    rig.rest();
    // A key-up that gets lost costs a second.
    let from = rig.joint(0).0;
    terminal.keys("=");
    terminal.until("moving +0.100 rad/s");
    terminal.until("at rest");
    rig.rest();
    let went = rig.joint(0).0 - from;
    assert!((0.05..0.5).contains(&went), "{went:.3} rad in about a second at 0.1 rad/s");
    // And so does the keyboard, when another window has it.
    terminal.keys("=");
    terminal.until("moving +0.100 rad/s");
    terminal.keys("\x1b[O");
    terminal.until("at rest");
    jog.end(Signal::INT).with(130);
}

#[test]
fn without_a_velocity_task_positions_are_streamed() {
    let mock = "
name: jogged
hardware:
  - {hardware_id: arm, joints: {prefix: arm, count: 2}, adapter_type: mock}
tasks:
  - {name: servo_arm, type: servo, joint_names: {hardware: arm}, priority: 20}
";
    let home = Home::new();
    home.write("jogged.yaml", mock);
    let run = home.run("jogged.yaml --no-record");
    let watcher = home.client();
    let mut rig = Rig { home, run: Some(run), watcher };
    let terminal = Terminal::new(80, 24);
    let jog = terminal.start(&rig.home, "jog arm");
    terminal.until("task servo_arm IDLE  at rest");
    rig.hold(&terminal, "+", 0, 0.1);
    terminal.until("at rest");
    rig.rest();
    terminal.keys("2");
    rig.hold(&terminal, "-", 1, -0.1);
    rig.rest();
    let reached = rig.joint(0).0;
    assert!((0.1..0.3).contains(&reached), "{reached}");
    terminal.keys("\x1b");
    jog.wait().with(0);
}

#[test]
fn what_is_missing_is_said_before_the_screen_is_taken() {
    let home = Home::new();
    home.dimos("jog arm").with(2).says(&["error: jog needs a terminal", "hint: `dimos task stream"]);
    let _run = home.run("coordinator-mock --no-record");
    let terminal = Terminal::new(100, 24);
    terminal.start(&home, "jog arm").wait().with(2);
    terminal.until("no task of the run can be jogged on arm");
    terminal.until("- {name: servo_arm, type: servo, joint_names: {hardware: arm}, priority: 20}");
    eventually("the terminal is given back", || terminal.is_as_before());
    let terminal = Terminal::new(100, 24);
    terminal.start(&home, "jog rarm").wait().with(2);
    terminal.until("did you mean `arm`?");
    home.dimos("jog arm --linear 0").with(2);
}

#[test]
fn an_arm_that_somebody_else_commands_is_left_alone() {
    let mut rig = Rig::new(YOURARM);
    rig.watcher.call(Lease { arm: None }).unwrap();
    let terminal = Terminal::new(100, 24);
    terminal.start(&rig.home, "jog arm").wait().with(1);
    terminal.until("[LEASE_HELD]");
    eventually("the terminal is given back", || terminal.is_as_before());
}
