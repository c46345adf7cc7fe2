//! A motion that the run carries out as a whole: whatever ends it, nothing of it begins afterwards. Judged by what the
//! arm's emulator receives.

use std::io::{BufRead, BufReader, ErrorKind, Write};
use std::os::unix::net::UnixStream;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::{Arc, Mutex};
use std::thread::sleep;
use std::time::{Duration, Instant};

use dimos::arms::yourarm::emulator::wire::Request;
use dimos::arms::yourarm::emulator::{SimOptions, YourArmEmulator};
use dimos::hardware::registry::Emulator;
use dimos::hardware::sim::faults::{Fault, FaultKind};
use dimos::rpc::Code;
use dimos::rpc::api::{
    Cancel, EndedBy, Go, GoGripper, GoPhase, GoStep, Going, GoingReport, GripperEnd, Lease, Move, Opening, Plan,
    PlanGoal, State, Status, Stop,
};
use dimos::rpc::client::{Client, ClientError};
use serde_json::{Value, json};

use crate::support::program::{Home, Started, eventually};
use crate::support::wire::watch::Watch;

const JOINTS: [&str; 6] = ["arm_joint1", "arm_joint2", "arm_joint3", "arm_joint4", "arm_joint5", "arm_joint6"];

/// A run with an arm whose emulator is in this process.
struct Cell {
    home: Home,
    arm: YourArmEmulator,
    _run: Started,
}

/// What ends a motion.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Event {
    Stop,
    Cancel,
    CancelGoing,
    Gone,
}

const EVENTS: [Event; 4] = [Event::Stop, Event::Cancel, Event::CancelGoing, Event::Gone];

fn up(blueprint: &str) -> Cell {
    let (home, arm) = (Home::new(), YourArmEmulator::with(&SimOptions::default()).unwrap());
    let run = home.run(&format!("{blueprint} --no-record --set hardware.arm.address={}", arm.address()));
    Cell { home, arm, _run: run }
}

impl Cell {
    fn joint1(&self) -> f64 {
        self.home.positions("arm")[0]
    }

    /// Makes it happen to a `go`, and waits until that is over. Returns its report.
    fn happens(&self, event: Event, mover: Client, going: u64) -> GoingReport {
        let mut watcher = self.home.client();
        let mover = match event {
            Event::Stop => {
                watcher.call(Stop { arm: None }).unwrap();
                Some(mover)
            }
            Event::Cancel => {
                watcher.call(Cancel::default()).unwrap();
                Some(mover)
            }
            Event::CancelGoing => {
                watcher.call(Cancel { going: Some(going), ..Cancel::default() }).unwrap();
                Some(mover)
            }
            Event::Gone => {
                drop(mover);
                None
            }
        };
        eventually("it is over", || watcher.call(Going { going }).unwrap().done);
        drop(mover);
        watcher.call(Going { going }).unwrap()
    }

    /// Fails if a setpoint moves the arm, or the fingers, from now on.
    #[track_caller]
    fn nothing_moves(&self, event: Event) {
        eventually("the arm is at rest", || self.arm.joints().1.iter().all(|velocity| velocity.abs() < 1e-3));
        sleep(Duration::from_millis(200));
        let before = self.arm.joints().0;
        self.arm.record();
        sleep(Duration::from_millis(900));
        let sent: Vec<Request> = self.arm.trace().into_iter().map(|received| received.request).collect();
        let mut moving = sent.iter().filter(|request| request.moves());
        let Some(first) = moving.next() else { return };
        assert!(first.setpoint().is_some(), "{event:?}: {first:?}");
        for request in moving {
            assert_eq!(request.setpoint(), first.setpoint(), "{event:?}: a setpoint moves the arm");
        }
        let moved = before.iter().zip(self.arm.joints().0).any(|(a, b)| (a - b).abs() > 1e-3);
        assert!(!moved, "{event:?}: the arm has moved");
    }

    fn revive(&self, event: Event) {
        if event == Event::Stop {
            self.home.dimos("arm reset arm").with(0);
            self.home.dimos("arm enable arm").with(0);
        }
        self.home.dimos("move arm 0 0.05 0 0 0 0 --direct --speed 0.3").with(0);
    }
}

fn go(client: &mut Client, steps: Vec<GoStep>) -> u64 {
    client.call(Go { steps, ..Go::default() }).unwrap().going
}

fn refused<T: std::fmt::Debug>(result: Result<T, ClientError>) -> Code {
    match result {
        Err(ClientError::Refused(refusal)) => refusal.code,
        other => panic!("{other:?}"),
    }
}

fn to(angle: f64, speed: f64) -> GoStep {
    GoStep::Move(Box::new(Move::direct("arm", [angle, 0.05, 0.0, 0.0, 0.0, 0.0], speed)))
}

fn plan(goal: PlanGoal) -> GoStep {
    let goals = vec![PlanGoal { robot: "arm".into(), ..goal }];
    GoStep::Plan(Box::new(Plan { goals, ..Plan::default() }))
}

fn grip(end: GripperEnd) -> GoStep {
    let (arm, to) = ("arm".to_owned(), Opening::End(end));
    GoStep::Gripper(Box::new(GoGripper { arm, to, force: None, speed: None, timeout: None, objects: None }))
}

fn ended_by(report: &GoingReport) -> EndedBy {
    report.outcome.as_ref().expect("it has ended").ended_by
}

/// A planner in this process, attached over the run's socket: it plans, and releases its plan, when the test says so.
struct Planner(Arc<Mutex<Script>>);

#[derive(Default)]
struct Script {
    planned: bool,
    cancelled: bool,
    asked_to_plan: bool,
    asked_to_release: bool,
    releases: bool,
    over: bool,
}

impl Planner {
    fn attach(cell: &Cell) -> Self {
        let socket = cell.home.path().join("run/dimos/coordinator-yourarm.sock");
        let mut stream = UnixStream::connect(socket).unwrap();
        let robot = json!({"name": "arm", "joints": JOINTS, "task": "traj_arm"});
        let register =
            json!({"id": 0, "method": "register_planner", "params": {"name": "scripted", "robots": [robot]}});
        stream.write_all(format!("{register}\n").as_bytes()).unwrap();
        stream.set_read_timeout(Some(Duration::from_millis(5))).unwrap();
        let script = Arc::new(Mutex::new(Script::default()));
        let planner = script.clone();
        std::thread::spawn(move || serve(stream, &planner));
        let planner = Self(script);
        eventually("it is attached", || cell.home.status()["planner"].is_object());
        planner
    }

    fn set(&self, change: impl FnOnce(&mut Script)) {
        change(&mut self.0.lock().unwrap());
    }

    fn asked_to_release(&self) -> bool {
        self.0.lock().unwrap().asked_to_release
    }
}

impl Drop for Planner {
    fn drop(&mut self) {
        self.set(|script| script.over = true);
    }
}

fn serve(stream: UnixStream, script: &Mutex<Script>) {
    let mut from = BufReader::new(stream.try_clone().unwrap());
    let (mut to, mut line, mut held) = (stream, String::new(), None);
    loop {
        match from.read_line(&mut line) {
            Ok(0) => return,
            Ok(_) => {}
            Err(e) if matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {}
            Err(_) => return,
        }
        let mut script = script.lock().unwrap();
        if script.over {
            return;
        }
        let mut answer = |request: &Value, result: Value| {
            let params = json!({"request": request["request"], "result": result});
            let message = json!({"id": 1, "method": "planner_answer", "params": params});
            // The run may have ended.
            let _ = to.write_all(format!("{message}\n").as_bytes());
        };
        if script.releases
            && let Some(request) = held.take()
        {
            answer(&request, released(&request));
        }
        if !line.ends_with('\n') {
            continue;
        }
        let message: Value = serde_json::from_str(&line).unwrap();
        line.clear();
        let request = &message["data"];
        let Some(method) = request["method"].as_str() else { continue };
        let plan = &request["params"]["plan"];
        match method {
            "planner" => {
                let robot = json!({"name": "arm", "end_effector_link": "flange", "joints": JOINTS, "limits": [],
                    "task": "traj_arm", "named_poses": {}});
                answer(request, json!({"state": "IDLE", "robots": [robot], "always_touching": {}}));
            }
            "plan" => {
                script.asked_to_plan = true;
                answer(request, json!({"plan": request["moment"]["plan"]}));
            }
            "planning" if script.cancelled => {
                answer(request, json!({"plan": plan, "state": "CANCELLED", "elapsed": 0.1, "error": "cancelled"}));
            }
            "planning" if script.planned => {
                let summary = json!({"joints": JOINTS, "start": [], "goal": [], "waypoints": 2, "length": 0.5,
                    "duration": 1.0, "seed": 0, "times": {}});
                answer(request, json!({"plan": plan, "state": "PLANNED", "elapsed": 0.1, "summary": summary}));
            }
            "planning" => answer(request, json!({"plan": plan, "state": "PLANNING", "elapsed": 0.1})),
            "execute_plan" => {
                script.asked_to_release = true;
                held = Some(request.clone());
            }
            "cancel" => {
                script.cancelled = !script.planned;
                answer(request, json!({"tasks": {}, "planning": script.cancelled}));
            }
            "recheck" => answer(request, json!({})),
            other => panic!("{other} is not expected"),
        }
    }
}

/// A motion by 0.5 rad from where the arm is.
fn released(request: &Value) -> Value {
    let at = JOINTS.map(|joint| request["moment"]["positions"][joint].as_f64().unwrap());
    let goal = [&[at[0] + 0.5], &at[1..]].concat();
    let point = |time: f64, positions: &[f64]| json!({"time_from_start": time, "positions": positions, "velocities": vec![0.0; 6]});
    let trajectory = json!({"joint_names": JOINTS, "points": [point(0.0, &at), point(1.5, &goal)]});
    json!({"plan": request["params"]["plan"], "trajectory": trajectory, "task": "traj_arm"})
}

/// Plays a scenario; a failure counts unless this computer was stalled: a state of this arm is stale after 50 ms.
fn judged(scenario: impl Fn()) {
    let watch = Watch::of_processors();
    for _ in 0..5 {
        let began = Instant::now();
        let Err(why) = catch_unwind(AssertUnwindSafe(&scenario)) else { return };
        let longest = watch.longest_since(began);
        if longest < Duration::from_millis(30) {
            resume_unwind(why);
        }
        println!("not judged: this computer was stalled for {longest:?}");
    }
    panic!("this computer was stalled in each attempt");
}

#[test]
fn a_stop_a_cancel_and_the_end_of_the_client_end_a_motion_that_is_planned() {
    judged(|| {
        let cell = up("coordinator-yourarm");
        cell.home.dimos("move arm 0 0.05 0 0 0 0 --speed 0.3").with(0);
        for event in EVENTS {
            let planner = Planner::attach(&cell);
            let mut mover = cell.home.client();
            let going = go(&mut mover, vec![plan(PlanGoal { joints: Some(vec![0.5; 6]), ..PlanGoal::default() })]);
            eventually("it plans", || {
                let report = mover.call(Going { going }).unwrap();
                report.phase == GoPhase::Planning && report.steps.first().is_some_and(|step| step.planning.is_some())
            });
            cell.arm.record();
            if event == Event::Stop {
                // The arm is held at once; that its plan is worth nothing shows when it is to be executed.
                cell.home.client().call(Stop { arm: None }).unwrap();
                planner.set(|script| (script.planned, script.releases) = (true, true));
            }
            let report = cell.happens(event, mover, going);
            planner.set(|script| (script.planned, script.releases) = (true, true));
            let expected = match event {
                Event::Stop => EndedBy::Stop,
                Event::Cancel | Event::CancelGoing => EndedBy::Cancelled,
                Event::Gone => EndedBy::ClientGone,
            };
            assert_eq!(ended_by(&report), expected, "{event:?}: {report:?}");
            assert!(report.steps[0].begun.is_none(), "{event:?}: {report:?}");
            cell.nothing_moves(event);
            drop(planner);
            eventually("the planner is gone", || !cell.home.status()["planner"].is_object());
            cell.revive(event);
        }
    });
}

#[test]
fn a_stop_a_cancel_and_the_end_of_the_client_come_between_a_plan_and_its_motion() {
    judged(|| {
        let cell = up("coordinator-yourarm");
        cell.home.dimos("move arm 0 0.05 0 0 0 0 --speed 0.3").with(0);
        for event in EVENTS {
            let planner = Planner::attach(&cell);
            planner.set(|script| script.planned = true);
            let mut mover = cell.home.client();
            let going = go(&mut mover, vec![plan(PlanGoal { joints: Some(vec![0.5; 6]), ..PlanGoal::default() })]);
            eventually("the plan is to be executed", || planner.asked_to_release());
            let mut watcher = cell.home.client();
            match event {
                Event::Stop => drop(watcher.call(Stop { arm: None }).unwrap()),
                Event::Cancel => drop(watcher.call(Cancel::default()).unwrap()),
                Event::CancelGoing => drop(watcher.call(Cancel { going: Some(going), ..Cancel::default() }).unwrap()),
                Event::Gone => {}
            }
            let mover = Some(mover).filter(|_| event != Event::Gone);
            if event == Event::Gone {
                // Its lease ends with it.
                eventually("its lease ends", || watcher.call(Status {}).unwrap().arms[0].commander.is_none());
            }
            // The planner is slow: it releases the plan after that.
            planner.set(|script| script.releases = true);
            eventually("it is over", || watcher.call(Going { going }).unwrap().done);
            let report = watcher.call(Going { going }).unwrap();
            assert!(report.steps[0].motions.is_empty(), "{event:?}: {report:?}");
            assert!(report.error.as_ref().is_some_and(|error| error.hint.is_some()), "{report:?}");
            cell.nothing_moves(event);
            assert!(cell.joint1().abs() < 0.01, "{event:?}");
            drop((planner, mover));
            eventually("the planner is gone", || !cell.home.status()["planner"].is_object());
            cell.revive(event);
        }
        // With nothing in between it moves.
        let planner = Planner::attach(&cell);
        planner.set(|script| (script.planned, script.releases) = (true, true));
        let mut mover = cell.home.client();
        let going = go(&mut mover, vec![plan(PlanGoal { joints: Some(vec![0.5; 6]), ..PlanGoal::default() })]);
        eventually("it is over", || mover.call(Going { going }).unwrap().done);
        let report = mover.call(Going { going }).unwrap();
        assert_eq!(ended_by(&report), EndedBy::Goal, "{report:?}");
        assert!((cell.joint1() - 0.5).abs() < 0.01, "{}", cell.joint1());
    });
}

#[test]
fn a_stop_a_cancel_and_the_end_of_the_client_end_what_follows_a_motion() {
    judged(|| {
        let cell = up("coordinator-yourarm");
        cell.home.dimos("arm gripper arm open").with(0);
        for event in EVENTS {
            cell.home.dimos("move arm 0 0.05 0 0 0 0 --speed 0.3").with(0);
            let mut mover = cell.home.client();
            let going = go(&mut mover, vec![to(0.8, 0.15), grip(GripperEnd::Close), to(0.0, 1.0)]);
            eventually("it moves", || cell.joint1() > 0.1);
            cell.arm.record();
            let report = cell.happens(event, mover, going);
            let gripped = cell.arm.trace().iter().any(|received| matches!(received.request, Request::Gripper(_)));
            assert!(!gripped, "{event:?}: the fingers were commanded");
            assert_eq!(report.steps.len(), if event == Event::Gone { 2 } else { 1 }, "{event:?}: {report:?}");
            cell.nothing_moves(event);
            let (outcome, at) = (report.outcome.unwrap(), cell.joint1());
            match event {
                // What has begun continues, as that of `move` does.
                Event::Gone => {
                    assert!((at - 0.8).abs() < 0.01 && outcome.ended_by == EndedBy::ClientGone, "{outcome:?}")
                }
                Event::Stop => assert_eq!(outcome.ended_by, EndedBy::Stop),
                _ => assert_eq!(outcome.ended_by, EndedBy::Cancelled),
            }
            assert!(event == Event::Gone || at < 0.7, "{event:?}: at {at}");
            assert!(outcome.motion.unwrap().done);
            cell.revive(event);
        }
    });
}

#[test]
fn a_stop_a_cancel_and_the_end_of_the_client_come_while_fingers_move() {
    judged(|| {
        let cell = up("coordinator-yourarm");
        cell.home.dimos("arm gripper arm open").with(0);
        cell.home.dimos("move arm 0 0.05 0 0 0 0 --speed 0.3").with(0);
        for event in EVENTS {
            // They do not begin to move: that this is their end is known after 1 s.
            cell.arm.inject(Fault::new(FaultKind::GripperBlocked).lasting(3.0)).unwrap();
            let mut mover = cell.home.client();
            let close = GoGripper {
                objects: None,
                ..match grip(GripperEnd::Close) {
                    GoStep::Gripper(g) => *g,
                    _ => panic!(),
                }
            };
            let going = go(&mut mover, vec![GoStep::Gripper(Box::new(close)), to(0.8, 1.0)]);
            eventually("the fingers are commanded", || {
                mover.call(Going { going }).unwrap().steps.first().is_some_and(|step| step.grip.is_some())
            });
            let report = cell.happens(event, mover, going);
            assert_ne!(ended_by(&report), EndedBy::Goal, "{event:?}: {report:?}");
            assert_eq!(report.steps.len(), 1, "{event:?}: {report:?}");
            cell.nothing_moves(event);
            assert!(cell.joint1().abs() < 0.01, "{event:?}");
            cell.revive(event);
            sleep(Duration::from_secs(2));
            cell.home.dimos("arm gripper arm open").with(0);
        }
    });
}

/// The end of a real process, not only of its connection.
#[test]
fn a_move_that_is_killed_while_it_plans_moves_nothing() {
    judged(|| {
        let cell = up("coordinator-yourarm");
        cell.home.dimos("move arm 0 0.05 0 0 0 0 --speed 0.3").with(0);
        let planner = Planner::attach(&cell);
        let killed = cell.home.start("move arm 0.5 0.05 0 0 0 0");
        eventually("it plans", || planner.0.lock().unwrap().asked_to_plan);
        killed.end(rustix::process::Signal::KILL);
        sleep(Duration::from_millis(300));
        planner.set(|script| (script.planned, script.releases) = (true, true));
        cell.nothing_moves(Event::Gone);
        assert!(cell.joint1().abs() < 0.01);
    });
}

#[test]
fn one_request_moves_grips_and_attaches_and_has_one_outcome() {
    judged(|| {
        let cell = up("yourarm-planner");
        let mut client = cell.home.client();
        cell.home.dimos("world add cup --sphere 0.02 --at 0.266 0 0.314").with(0);
        cell.home.dimos("arm gripper arm open").with(0);
        cell.arm.put_object(0.03);
        let step = |to: &str, objects: Value| json!({"gripper": {"arm": "arm", "to": to, "objects": objects}});
        let named = json!({"plan": {"goals": [{"robot": "arm", "named": "home"}], "speed": 1.0}});
        let away = json!({"plan": {"goals": [{"robot": "arm", "joints": [0.3, -0.3, 0.6, 0, 0.8, 0]}], "speed": 1.0}});
        let steps =
            json!([named, step("close", json!({"attach": "cup"})), away, step("open", json!({"either": "cup"}))]);
        let request: Go = serde_json::from_value(json!({ "steps": steps })).unwrap();
        let going = client.call(request).unwrap().going;
        eventually("it is over", || client.call(Going { going }).unwrap().done);
        let report = client.call(Going { going }).unwrap();
        assert_eq!(ended_by(&report), EndedBy::Goal, "{report:?}");
        assert_eq!(
            (&report.steps[1].attached[..], &report.steps[3].detached[..]),
            (&["cup".to_owned()][..], &["cup".to_owned()][..])
        );
        let outcome = report.outcome.unwrap();
        let motion = outcome.motion.unwrap();
        assert_eq!((motion.state.as_str(), motion.collision_checked), ("COMPLETED", true));
        let state = client.call(State {}).unwrap().arms.remove(0).pose.unwrap();
        let pose = outcome.pose.expect("the model is known");
        assert!(pose.xyz.iter().zip(state.xyz).all(|(a, b)| (a - b).abs() < 2e-3), "{pose:?} {state:?}");

        // What is wrong with a later step is found before the first one moves.
        let before = cell.home.positions("arm");
        let wrong = |last: Value| serde_json::from_value::<Go>(json!({"steps": [away.clone(), last]})).unwrap();
        for (last, code) in [
            (json!({"plan": {"goals": [{"robot": "arm", "named": "nowhere"}]}}), Code::InvalidParams),
            (step("close", json!({"attach": "cap"})), Code::UnknownObject),
            (json!({"gripper": {"arm": "arm", "to": 0.5}}), Code::OutOfLimits),
            (json!({"gripper": {"arm": "rarm", "to": "open"}}), Code::UnknownArm),
            (json!({"move": {"arm": "arm", "target": [0, 0, 0, 0, 0, 0]}}), Code::NotPlanned),
        ] {
            assert_eq!(refused(client.call(wrong(last))), code);
        }
        assert!(before.iter().zip(cell.home.positions("arm")).all(|(a, b)| (a - b).abs() < 1e-3));
        assert_eq!(refused(client.call(Going { going: going + 999 })), Code::UnknownMotion);
    });
}

#[test]
fn each_step_needs_the_lease_and_one_request_at_a_time_moves_an_arm() {
    judged(|| {
        let cell = up("coordinator-yourarm");
        cell.home.dimos("move arm 0 0.05 0 0 0 0 --speed 0.3").with(0);
        let (mut one, mut two) = (cell.home.client(), cell.home.client());
        // Without a motion, no lease is taken.
        assert_eq!(
            refused(two.call(Go { steps: vec![plan(PlanGoal::default())], ..Go::default() })),
            Code::InvalidParams
        );
        one.call(Lease::default()).unwrap();
        let going = go(&mut two, vec![to(0.8, 1.0)]);
        eventually("it is over", || two.call(Going { going }).unwrap().done);
        let report = two.call(Going { going }).unwrap();
        assert_eq!(report.error.map(|error| error.code), Some(Code::LeaseHeld));
        assert!(cell.joint1().abs() < 0.01, "nothing has moved");

        let first = go(&mut one, vec![to(0.8, 0.3)]);
        eventually("it moves", || cell.joint1() > 0.1);
        assert_eq!(refused(one.call(Go { steps: vec![to(0.0, 1.0)], ..Go::default() })), Code::AlreadyExecuting);
        cell.home.dimos("speed 50%").with(0);
        eventually("it is slower", || one.call(Going { going: first }).unwrap().steps[0].motions[0].speed.is_some());
        let by = one.call(Going { going: first }).unwrap().by.expect("a client asked for it");
        assert_eq!(by.pid, Some(std::process::id() as i32));
        cell.home.dimos("speed 100%").with(0);
        eventually("it is over", || one.call(Going { going: first }).unwrap().done);
        // At once: its end is known to the run when it is known to its client.
        for angle in [0.1, 0.0] {
            let next = go(&mut one, vec![to(angle, 1.0)]);
            let motion = || {
                one.call(Going { going: next }).unwrap().steps.first().and_then(|step| step.motions.first().cloned())
            };
            let mut motion = motion;
            eventually("its motion ends", || motion().is_some_and(|motion| motion.done));
        }

        // What it was asked for before a stop is not done after it.
        let epoch = one.call(Status {}).unwrap().epoch;
        cell.home.dimos("stop").with(0);
        cell.home.dimos("arm reset arm").with(1); // the lease is held
        drop(one);
        eventually("the lease ends", || two.call(Status {}).unwrap().arms[0].commander.is_none());
        cell.home.dimos("arm reset arm").with(0);
        cell.home.dimos("arm enable arm").with(0);
        two.since(epoch);
        let late = go(&mut two, vec![to(0.8, 1.0)]);
        eventually("it is over", || two.call(Going { going: late }).unwrap().done);
        let report = two.call(Going { going: late }).unwrap();
        assert_eq!(report.error.map(|error| error.code), Some(Code::Superseded));
        assert!(cell.joint1().abs() < 0.01, "nothing has moved");
    });
}
