//! Jobs: pick-and-place cycles with an emulated arm, and what remains of each fault. `DIMOS_JOBS=1000` does that many
//! picks instead of a few.

use std::sync::Mutex;
use std::time::{Duration, Instant};

use dimos::arms::yourarm::emulator::{SimOptions, YourArmEmulator};
use dimos::hardware::registry::Emulator;
use dimos::hardware::sim::faults::{Fault, FaultKind};
use dimos::rpc::api::{
    ArmEnable, ArmReset, Cancel, Detach, Move, PoseSpec, ShapeSpec, Speed, State, Status, Stop, World, WorldAdd,
    WorldMove, WorldObject, WorldRemove,
};
use dimos::rpc::client::Client;
use rustix::process::Signal;
use serde_json::Value;

use crate::support::program::{Home, Started, eventually};

/// A job that picks a part at A, places it at B, and takes it back.
const JOB: &str = "\
arm: arm
speed: 100%
on_fault:
  - gripper: 0.05
  - detach: part
  - move: home
steps:
  - move: home
  - move: {joints: [0.3, -0.3, 0.6, 0, 0.8, 0]}
  - gripper: 0.05
  - move: {joints: [0.3, -0.26, 0.64, 0, 0.8, 0]}
  - gripper: {to: close, object: true}
  - attach: {object: part, touch: [link6]}
  - move: {joints: [0.3, -0.3, 0.6, 0, 0.8, 0]}
  - wait: {input: di0, is: high, timeout: 500ms}
  - move: {joints: [-0.3, -0.3, 0.6, 0, 0.8, 0]}
  - move: {joints: [-0.3, -0.26, 0.64, 0, 0.8, 0]}
  - gripper: 0.05
  - detach: part
  - output: {do0: high}
  - wait: 50ms
  - output: {do0: low}
  - gripper: {to: close, object: true}
  - attach: {object: part, touch: [link6]}
  - through: {waypoints: [{joints: [-0.3, -0.3, 0.6, 0, 0.8, 0]}, {joints: [0.3, -0.3, 0.6, 0, 0.8, 0]}], blend: 0.01}
  - move: {joints: [0.3, -0.26, 0.64, 0, 0.8, 0]}
  - gripper: 0.05
  - detach: part
";
/// Its lines that end a pick.
const PICK_LINES: [u64; 2] = [19, 28];
const HOME: [f64; 6] = [0.0, -0.3, 0.6, 0.0, 0.8, 0.0];

/// What goes wrong during a job.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Trouble {
    None,
    OperatorStop,
    Estop,
    /// By the script of the emulator.
    Disconnect,
    NothingToGrip,
    InputLow,
    GoalBlocked,
    WayBlocked,
    Cancelled,
    Interrupted,
    Killed,
    Paused,
}

const TROUBLES: [Trouble; 12] = [
    Trouble::None,
    Trouble::OperatorStop,
    Trouble::NothingToGrip,
    Trouble::Interrupted,
    Trouble::GoalBlocked,
    Trouble::Estop,
    Trouble::InputLow,
    Trouble::Cancelled,
    Trouble::Disconnect,
    Trouble::WayBlocked,
    Trouble::Paused,
    Trouble::Killed,
];

/// xorshift64*.
struct Random(u64);

impl Random {
    fn below(&mut self, bound: usize) -> usize {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        ((self.0.wrapping_mul(0x2545_F491_4F6C_DD1D) >> 33) as usize) % bound
    }
}

/// A run with its arm and its part.
struct Cell {
    home: Home,
    arm: YourArmEmulator,
    _run: Started,
    /// Where the part lies at A.
    part: [f64; 3],
    /// Where the flange is at B.
    place: [f64; 3],
}

impl Cell {
    /// Starts a run. The connection to its arm breaks after these times since its start.
    fn start(breaks: &[Duration]) -> Self {
        let home = Home::new();
        let at = |at: &Duration| -> Fault {
            serde_json::from_value(serde_json::json!({"at": at.as_secs_f64(), "kind": FaultKind::Disconnect})).unwrap()
        };
        let options = SimOptions { faults: breaks.iter().map(at).collect(), ..SimOptions::default() };
        let arm = YourArmEmulator::with(&options).unwrap();
        arm.set_input(0, true);
        let set = "--set planner.robots.arm.max_velocity=2 --set planner.robots.arm.max_acceleration=6";
        let run = home.run(&format!("yourarm-planner --set hardware.arm.address={} {set}", arm.address()));
        home.write("pick.yaml", JOB);
        home.dimos("move arm -0.3 -0.26 0.64 0 0.8 0 --speed 1").with(0);
        let place = flange(&mut home.client());
        home.dimos("move arm 0.3 -0.26 0.64 0 0.8 0 --speed 1").with(0);
        let mut part = flange(&mut home.client());
        part[2] -= 0.05;
        let cell = Self { home, arm, _run: run, part, place };
        let object = cell.object("part", ShapeSpec::Sphere(0.01), part);
        cell.home.client().call(WorldAdd(object)).unwrap();
        cell
    }

    fn object(&self, name: &str, shape: ShapeSpec, xyz: [f64; 3]) -> WorldObject {
        let pose = PoseSpec { xyz, ..PoseSpec::default() };
        WorldObject { name: name.into(), shape, pose, padding: 0.0, held_by: None }
    }

    fn wall(&self, xyz: [f64; 3]) {
        self.home.client().call(WorldAdd(self.object("wall", ShapeSpec::Sphere(0.02), xyz))).unwrap();
    }

    fn phase(&self) -> (String, Option<String>) {
        let arm = self.home.client().call(Status {}).unwrap().arms.remove(0);
        (arm.phase, arm.cause.map(|cause| cause.name))
    }

    fn held_objects(&self) -> Vec<String> {
        let objects = self.home.client().call(World {}).unwrap().objects;
        objects.into_iter().filter(|o| o.held_by.is_some()).map(|o| o.name).collect()
    }

    /// The arm does not move.
    fn rests(&self) -> bool {
        let before = self.home.positions("arm");
        std::thread::sleep(Duration::from_millis(120));
        before.iter().zip(self.home.positions("arm")).all(|(a, b)| (a - b).abs() < 1e-3)
    }

    fn at(&self, pose: [f64; 6]) -> bool {
        self.home.positions("arm").iter().zip(pose).all(|(a, b)| (a - b).abs() < 0.01)
    }

    /// What an operator does before the next job: no obstacle, the part at A, the arm ready.
    fn recover(&self) {
        let mut client = self.home.client();
        let _ = client.call(WorldRemove { name: Some("wall".into()) });
        self.arm.release_estop();
        self.arm.put_object(0.0);
        self.arm.set_input(0, true);
        client.call(Speed { fraction: None, paused: Some(false) }).unwrap();
        for name in self.held_objects() {
            client.call(Detach { name }).unwrap();
        }
        let arm = || "arm".to_owned();
        let pose = PoseSpec { xyz: [0.0, 0.5, 0.5], ..PoseSpec::default() };
        client.call(WorldMove { name: "part".into(), pose }).unwrap();
        eventually("the arm is ready again, and at home", || {
            if self.phase().0 != "ready" {
                let _ = client.call(ArmReset { arm: arm() });
                let _ = client.call(ArmEnable::new(arm()));
            }
            self.home.start("move arm --named home --speed 1").wait().code == Some(0) && self.at(HOME)
        });
        let pose = PoseSpec { xyz: self.part, ..PoseSpec::default() };
        client.call(WorldMove { name: "part".into(), pose }).unwrap();
    }

    /// Does one job with a trouble at a random time. Returns what was picked, and how the job ended.
    fn job(&self, trouble: Trouble, random: &mut Random) -> (usize, &'static str) {
        let job = self.home.start("do pick.yaml --json");
        let began = Instant::now();
        let strikes = Duration::from_millis(500 + random.below(4500) as u64);
        let mut struck: Option<Instant> = None;
        match trouble {
            Trouble::InputLow => self.arm.set_input(0, false),
            Trouble::GoalBlocked => self.wall(self.place),
            _ => {}
        }
        while !job.over() {
            assert!(began.elapsed() < Duration::from_secs(60), "{trouble:?}: the job does not end: {}", job.err());
            // The part is between the fingers while they are open above it.
            let open = || self.home.client().call(State {}).unwrap().arms[0].gripper.is_some_and(|at| at > 0.045);
            if trouble != Trouble::NothingToGrip && open() {
                self.arm.put_object(0.03);
            }
            if struck.is_none() && began.elapsed() >= strikes {
                struck = Some(Instant::now());
                let mut client = self.home.client();
                match trouble {
                    Trouble::OperatorStop => drop(client.call(Stop::default()).unwrap()),
                    Trouble::Estop => self.arm.press_estop(),
                    Trouble::WayBlocked => self.wall(self.place),
                    Trouble::Interrupted => job.signal(Signal::INT),
                    Trouble::Killed => job.signal(Signal::KILL),
                    Trouble::Paused => {
                        client.call(Speed { fraction: None, paused: Some(true) }).unwrap();
                        std::thread::sleep(Duration::from_millis(300));
                        client.call(Speed { fraction: None, paused: Some(false) }).unwrap();
                    }
                    _ => {}
                }
            }
            // It ends the job only while something moves.
            if struck.is_some() && trouble == Trouble::Cancelled {
                let _ = self.home.client().call(Cancel::default());
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        let ended = job.wait();
        if ended.signal == Some(9) {
            assert_eq!(trouble, Trouble::Killed);
            eventually("the arm rests after its last motion", || self.rests());
            return (0, "killed");
        }
        let report: Value = serde_json::from_str(&ended.out).unwrap_or_else(|e| panic!("{e}: {ended:?}"));
        let steps = report["steps"].as_array().unwrap();
        let picks = steps.iter().filter(|s| s["line"].as_u64().is_some_and(|line| PICK_LINES.contains(&line)));
        let picks = picks.map(|s| s["count"].as_u64().unwrap() as usize).sum();
        // Just before the end of a job a trouble may come too late.
        let in_time = struck.is_some_and(|at| at.elapsed() > Duration::from_millis(500));
        (picks, self.judge((trouble, in_time), &report, &ended))
    }

    /// Checks that what a job left is what its report says.
    fn judge(
        &self,
        (trouble, in_time): (Trouble, bool),
        report: &Value,
        ended: &crate::support::program::Ended,
    ) -> &'static str {
        let (phase, cause) = self.phase();
        let said = report["ended"].as_str().unwrap();
        let of = |key| report.get(key).map(Value::to_string).unwrap_or_default();
        let (step, after, held) = (of("step"), of("on_fault"), of("held"));
        let told = format!("{trouble:?}: {said} {step} {after} {held}; {} phase {phase} {cause:?}", ended.err);
        // The script of the emulator may break the connection in any job; a loaded computer may read too late.
        let lost = matches!(cause.as_deref(), Some("link_lost" | "stale"));
        // A job ends when the arm is held, which then decelerates.
        match phase == "ready" {
            false => eventually("the arm rests", || self.rests()),
            true => assert!(self.rests(), "the arm moves after the job: {told}"),
        }
        let code = ended.code.unwrap();
        match said {
            "done" => {
                assert!(code == 0 && (phase == "ready" || lost), "{told}");
                assert!(self.held_objects().is_empty(), "{told}");
                match trouble {
                    Trouble::NothingToGrip | Trouble::InputLow | Trouble::GoalBlocked => panic!("{told}"),
                    Trouble::OperatorStop | Trouble::Estop | Trouble::Interrupted => assert!(!in_time, "{told}"),
                    // The connection was there, the way behind the arm, or nothing moved.
                    _ => {}
                }
                "done"
            }
            "interrupted" => {
                assert!(code == 130 && trouble == Trouble::Interrupted && (phase == "ready" || lost), "{told}");
                "interrupted"
            }
            "stopped" | "fault" => {
                assert_eq!(code, 1, "{told}");
                let line = report["step"]["line"].as_u64().unwrap();
                assert!((8..=28).contains(&line) && ended.err.contains(&format!("pick.yaml:{line}: ")), "{told}");
                let on_fault = report["on_fault"].as_str();
                let is_held = phase != "ready";
                match trouble {
                    _ if lost => assert!(is_held && on_fault != Some("done"), "{told}"),
                    Trouble::OperatorStop => {
                        let cause = cause.as_deref();
                        assert_eq!((said, on_fault, cause), ("stopped", None, Some("operator_stop")), "{told}");
                    }
                    Trouble::Cancelled => assert_eq!((said, on_fault, is_held), ("stopped", None, false), "{told}"),
                    Trouble::NothingToGrip | Trouble::InputLow | Trouble::GoalBlocked => {
                        assert_eq!((said, on_fault, is_held), ("fault", Some("done"), false), "{told}");
                        assert!(self.at(HOME) && self.held_objects().is_empty(), "{told}");
                    }
                    // The arm may be free, or held before the obstacle.
                    Trouble::WayBlocked => assert!(is_held == (said == "stopped"), "{told}"),
                    // A hold is not cleared, and nothing else was done.
                    _ => {
                        let kept = on_fault.is_none_or(|after| after.starts_with("not run: arm is "));
                        assert!(is_held || on_fault == Some("done") || !kept, "{told}");
                    }
                }
                if on_fault == Some("done") {
                    assert!(self.at(HOME) && self.held_objects().is_empty(), "{told}");
                }
                if is_held {
                    let kept =
                        on_fault.is_none_or(|after| after.starts_with("not run: ") || after.starts_with("failed"));
                    assert!(kept, "a job cleared a hold: {told}");
                }
                if said == "fault" { "fault" } else { "stopped" }
            }
            other => panic!("{other}: {told}"),
        }
    }
}

fn flange(client: &mut Client) -> [f64; 3] {
    client.call(State {}).unwrap().arms[0].pose.clone().unwrap().xyz
}

/// Does jobs until this number of parts was picked; a job that ends before its first counts as one.
fn shift(seed: u64, picks: usize, counts: &Mutex<std::collections::BTreeMap<String, usize>>) {
    let mut random = Random(seed);
    let breaks: Vec<Duration> =
        (1..200).map(|k| Duration::from_millis(k * 40_000 + random.below(20_000) as u64)).collect();
    let cell = Cell::start(&breaks);
    let (mut picked, mut turn, long) = (0, seed as usize, picks > 50);
    while picked < picks {
        // Each kind in turn in the short form; in the long one at random, half of the jobs without.
        let trouble = match long {
            true if random.below(2) == 0 => Trouble::None,
            true => TROUBLES[random.below(TROUBLES.len())],
            false => TROUBLES[turn % TROUBLES.len()],
        };
        turn += 1;
        cell.recover();
        let (more, ended) = cell.job(trouble, &mut random);
        picked += more.max(1);
        let mut counts = counts.lock().unwrap();
        *counts.entry(format!("{trouble:?} {ended}")).or_default() += 1;
        *counts.entry("cycles".into()).or_default() += more.max(1);
        *counts.entry("picks".into()).or_default() += more;
        if long && turn.is_multiple_of(10) {
            eprintln!("{counts:?}");
        }
    }
}

#[test]
fn picks_with_seeded_faults_end_in_known_states() {
    let picks = std::env::var("DIMOS_JOBS").ok().and_then(|text| text.parse().ok()).unwrap_or(0);
    let counts = Mutex::default();
    let cells = if picks > 50 { 8 } else { 2 };
    let began = Instant::now();
    std::thread::scope(|scope| {
        let counts = &counts;
        let cells: Vec<_> =
            (0..cells as u64).map(|k| scope.spawn(move || shift(1 + 6 * k, (picks / cells).max(8), counts))).collect();
        cells.into_iter().for_each(|cell| cell.join().unwrap());
    });
    eprintln!("{:.0} s: {:#?}", began.elapsed().as_secs_f64(), counts.lock().unwrap());
}

/// The files and the commands of a page: blocks of YAML whose first line is the file's name, and lines of shell.
fn recipes(page: &str) -> (Vec<(String, String)>, Vec<String>) {
    let (mut files, mut commands) = (Vec::new(), Vec::new());
    for block in page.split("```").skip(1).step_by(2) {
        let (kind, text) = block.split_once('\n').unwrap();
        match kind {
            "yaml" => files.push((text.lines().next().unwrap().trim_start_matches("# ").to_owned(), text.to_owned())),
            _ => commands.extend(text.lines().map(|line| line.split('#').next().unwrap().trim().to_owned())),
        }
    }
    (files, commands)
}

#[test]
fn the_recipes_of_the_page_work() {
    let home = Home::new();
    let (files, commands) = recipes(include_str!("../../docs/jobs.md"));
    assert!(files.len() >= 2 && commands.len() >= 8, "{files:?} {commands:?}");
    files.iter().for_each(|(name, text)| home.write(name, text));
    for command in commands {
        let ended = home.dimos(command.strip_prefix("dimos ").unwrap());
        assert_eq!(ended.code, Some(0), "{command}: {}{}", ended.out, ended.err);
        if command == "dimos do pick.yaml" {
            let ended = ended.shows(&["P95 s", "move: home", "cycle"]).says(&["cycle 2 of 2: "]);
            let cycle = ended.out.lines().last().unwrap().split_whitespace().collect::<Vec<_>>();
            assert_eq!((cycle[0], cycle[1], cycle.len()), ("cycle", "2", 6), "{cycle:?}");
        }
    }
    // Names that the run does not have, each at its place.
    home.write(
        "names.yaml",
        "steps:\n  - move: hom\n  - move: {joints: [1, 2]}\n  - wait: {input: di31}\n  - attach: prat\n  - gripper: {to: open, arm: amr}\n  - gripper: 0.5\n  - gripper: {to: open, force: 1000}\n  - mov: home\n",
    );
    let before = home.positions("arm");
    for verb in ["do names.yaml", "do --check names.yaml"] {
        home.dimos(verb).with(2).says(&[
            // Of the file as well, at once.
            "names.yaml:9:5",
            "did you mean `move`?",
            "names.yaml:2:5",
            "did you mean `home`?",
            "names.yaml:3:5",
            "arm has 6 joints, the goal 2 values",
            "names.yaml:4:5",
            "arm has no di31",
            "did you mean `part`?",
            "names.yaml:6:5",
            "did you mean `arm`?",
            "names.yaml:7:5",
            "cannot go to 0.5 m",
            "names.yaml:8:5",
            "cannot hold with 1000 N",
            "nothing has moved",
        ]);
    }
    assert!(before.iter().zip(home.positions("arm")).all(|(a, b)| (a - b).abs() < 1e-4));
    home.dimos("down").with(0);
    for verb in ["do names.yaml", "do --check names.yaml"] {
        home.dimos(verb).with(2).says(&["names.yaml:9:5", "did you mean `move`?"]);
    }
    let fault = "steps: [{move: home}, {repeat: {times: 2, steps: [{wait: 1s}]}}]\non_fault: [{gripper: open}]\n";
    home.write("sound.yaml", fault);
    let checked = home.dimos("do --check sound.yaml").with(0).says(&["were not checked"]);
    assert_eq!(checked.out, "sound.yaml: 3 steps and 1 on a fault, no mistakes\n");
}

/// As a job's: what a client wanted before a stop moves nothing after it, though the arm was reset and enabled since.
#[test]
fn a_request_of_before_a_stop_is_superseded() {
    let home = Home::new();
    let run = home.run("coordinator-yourarm --sim --no-record");
    let mut client = home.client();
    let epoch = client.call(Status {}).unwrap().epoch;
    client.since(epoch);
    home.dimos("stop").with(0);
    home.dimos("arm reset arm").with(0);
    home.dimos("arm enable arm").with(0);
    let refused = client.call(Move::new("arm", HOME, 0.5)).unwrap_err().to_string();
    assert!(refused.contains("SUPERSEDED") || refused.contains("stopped"), "{refused}");
    let now = client.call(Status {}).unwrap().epoch;
    assert!(now > epoch, "{epoch} to {now}");
    client.since(now);
    client.call(Move::new("arm", HOME, 0.5)).unwrap();
    run.end(Signal::INT).with(130);
}
