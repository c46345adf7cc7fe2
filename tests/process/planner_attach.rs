//! A planner that attaches to a running coordinator, with the real binary in two processes: every verb still
//! addresses one run, each process reports the end of the other, and the coordinator never waits.

use std::io::{BufRead, BufReader, Write};
use std::os::unix::net::UnixStream;
use std::time::{Duration, Instant};

use dimos::rpc::api::{Lease, Status};
use rustix::process::Signal;
use serde_json::{Value, json};

use crate::support::program::{Home, Started, TIMEOUT, eventually};

/// An ideal arm in memory. `OPTIONS` is replaced by each test.
const COORDINATOR: &str = "
name: cell
hardware:
  - {hardware_id: arm, joints: {prefix: arm, count: 6}, adapter_type: mock, limits: {position: {arm_joint1: [-2.0, 2.0]}}}
tasks:
  - {name: traj_arm, type: trajectory, joint_names: {hardware: arm}}
  - {name: servo_arm, type: servo, joint_names: {hardware: arm}, priority: 20}
";
const PLANNER: &str = "
name: lab
include: [cell.yaml]
planner:
  robots:
    - name: arm
      model_path: builtin:yourarm
      end_effector_link: flange
      tool: {xyz: [0, 0, 0.1]}
      joint_names: [joint1, joint2, joint3, joint4, joint5, joint6]
      joint_prefix: arm_
      coordinator_task_name: traj_arm
      named_poses:
        home: [0, -0.3, 0.6, 0, 0.8, 0]
  world:
    table: {shape: {box: [1.2, 1.2, 0.02]}, pose: {xyz: [0, 0, -0.02]}}
";
const ATTACHED: &str = "attached to run cell";
const AGAIN: &str = "attached to run cell again";
const WALLS: [&str; 2] = ["world add front --box 2 0.02 4 --at 1.1 0 0", "world add back --box 2 0.02 4 --at -1.1 0 0"];

fn home() -> Home {
    let home = Home::new();
    home.write("cell.yaml", COORDINATOR);
    home.write("lab.yaml", PLANNER);
    home
}

fn planner(home: &Home, arguments: &str) -> Started {
    let planner = home.start(&format!("run lab.yaml {arguments}"));
    planner.until("attached");
    planner
}

fn up() -> (Home, Started, Started) {
    let home = home();
    let run = home.run("cell.yaml --no-record");
    let planner = planner(&home, "");
    home.dimos("move arm --named home --speed 1").with(0);
    (home, run, planner)
}

#[track_caller]
fn is_at(home: &Home, goal: &[f64]) {
    let is = home.positions("arm");
    assert!(is.iter().zip(goal).all(|(is, goal)| (is - goal).abs() < 0.01), "{is:?} for {goal:?}");
}

#[test]
fn down_without_a_name_ends_no_planner_while_several_runs_are_live() {
    let (home, _run, planner) = up();
    let _other = home.run("cell.yaml --no-record --name other");
    home.dimos("down").with(2).says(&["cell", "other", "hint: "]);
    assert!(home.dimos("status").with(0).out.contains("other"));
    assert_eq!(home.dimos("status --run cell --json").with(0).json()["planner"]["state"], "COMPLETED");
    home.dimos("down lab").with(0);
    planner.wait().with(143);
}

#[test]
fn every_verb_goes_on_addressing_one_run() {
    let (home, _run, planner) = up();
    let planned = home.dimos("plan arm 0.3 -0.2 0.5 0 0.4 0").with(0).says(&["nothing has moved"]);
    assert!(planned.out.contains("clearance"), "{}", planned.out);
    let preview = home.dimos("preview --json").with(0).json();
    let path = preview["end_effectors"]["arm"].as_array().unwrap();
    assert!(path.len() > 2, "{preview}");
    home.dimos("execute").with(0).says(&["planned, collision-checked"]);
    is_at(&home, &[0.3, -0.2, 0.5, 0.0, 0.4, 0.0]);
    // The run has the attached planner's model: it shows where the tool is, as the planner means it.
    home.dimos("state").with(0).shows(&["the tool on flange in map"]);
    let state = home.dimos("state --json").with(0).json();
    let shown = [0, 1, 2].map(|i| state["arms"][0]["pose"]["xyz"][i].as_f64().unwrap());
    let end = path.last().unwrap();
    assert!((0..3).all(|i| (shown[i] - end[i].as_f64().unwrap()).abs() < 5e-4), "{shown:?} for {end}");
    home.dimos("arm tool arm --none").with(0).shows(&["arm: flange (no tool)"]);
    home.dimos("state").with(0).shows(&["pose     flange in map"]);
    home.dimos("arm tool arm --xyz 0 0 0.2").with(0).shows(&["the tool on flange at xyz 0.0000 0.0000 0.2000 m"]);
    home.dimos("move arm --named home").with(0).says(&["planned, collision-checked"]);
    assert!(home.dimos("world list").with(0).out.contains("table"));
    home.dimos("world add cup --cylinder 0.03 0.1 --at 0.3 0.3 0.4").with(0);
    home.dimos("world attach cup arm")
        .with(1)
        .says(&["it is not what the gripper holds", "world attach cup arm --within 1"]);
    home.dimos("world attach cup arm --within 1").with(0);
    assert!(home.dimos("world list").with(0).out.contains("arm flange"));
    home.dimos("world detach cup").with(0);
    home.dimos("world move cup --at 0.6 0.6 0.6").with(0);
    home.dimos("world remove cup").with(0);
    home.dimos("plan arm --named hme").with(2).says(&["did you mean `home`?"]);
    home.dimos("execute --plan 4711").with(2).says(&["UNKNOWN_PLAN"]);

    // The run says who plans for it; the planner is not a run.
    let status = home.status();
    let expected = json!({"state": "COMPLETED", "error": null, "robots": ["arm"],
        "attached": {"name": "lab", "pid": planner.pid()}});
    assert_eq!(status["planner"], expected);
    let shown = home.dimos("status").with(0).out;
    assert!(shown.contains(&format!("lab (pid {})", planner.pid())) && shown.contains("COMPLETED"), "{shown}");
    assert_eq!(home.runs().runs().unwrap().len(), 1);
    // A second planner is refused, whatever it is called.
    for how in ["", "--name two", "--attach cell --name two"] {
        home.dimos(&format!("run lab.yaml {how}"))
            .with(1)
            .says(&["run cell has a planner already: lab (pid ", "hint: "]);
    }

    // Only the lease holder may execute a plan: the planner's process has no part in it.
    let mut holder = home.client();
    holder.call(Lease { arm: Some("arm".into()) }).unwrap();
    home.dimos("plan arm 0.5 -0.3 0.6 0 0.8 0").with(0);
    home.dimos("execute").with(1).says(&["LEASE_HELD", "arm is commanded by "]);
    holder.call(dimos::rpc::api::ExecutePlan::default()).unwrap();
    eventually("it arrives", || home.status()["planner"]["state"] == "COMPLETED");
    is_at(&home, &[0.5, -0.3, 0.6, 0.0, 0.8, 0.0]);
    drop(holder);

    // It ends, and the run continues; a move that relied on it is not made without it.
    home.dimos("down lab").with(0).says(&["planner lab ended"]);
    planner.wait().with(143).says(&["planner lab ended; run cell continues without it"]);
    for verb in ["plan arm --named home", "preview", "execute", "world list", "move arm 0 0 0 0 0 0"] {
        home.dimos(verb).with(1).says(&["NO_PLANNER", "the planner that was attached to this run has gone", "hint: "]);
    }
    assert_eq!(home.status()["planner"], Value::Null);
    home.dimos("move arm 0 -0.3 0.6 0 0.8 0 --direct --speed 1").with(0);
    let planner = self::planner(&home, "--json");
    home.dimos("move arm 0.2 -0.3 0.6 0 0.8 0 --speed 1").with(0);
    let ended = planner.end(Signal::INT).with(130);
    let events: Vec<Value> = ended.out.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!((&events[0]["event"], &events[0]["run"]), (&json!("attached"), &json!("cell")));
    assert_eq!((&events[1]["event"], &events[1]["why"]), (&json!("ended"), &json!("SIGINT")));
}

#[test]
fn planning_is_cancelled_and_limits_are_the_runs() {
    let (home, _run, _planner) = up();
    // The model reaches to 2.967 rad, the arm of this run to 2, and commands stay 0.01 rad inside.
    let refused = home.dimos("plan arm 1.995 -0.3 0.6 0 0.8 0").with(1);
    let refused = refused.says(&["goal: arm_joint1 at 1.9950 rad is outside its limits -1.9900 … 1.9900", "hint: "]);
    assert!(!refused.err.contains("OUT_OF_LIMITS"), "{}", refused.err);
    home.dimos("move arm 1.99 -0.3 0.6 0 0.8 0 --speed 1").with(0);
    home.dimos("move arm 1.5 -0.3 0.6 0 0.8 0 --speed 1").with(0);
    WALLS.iter().for_each(|wall| drop(home.dimos(wall).with(0)));
    let planning = home.start("plan arm -1.5 -0.3 0.6 0 0.8 0 --timeout 60s");
    eventually("it plans", || home.status()["planner"]["state"] == "PLANNING");
    home.dimos("plan arm --named home").with(1).says(&["PLANNING"]);
    assert!(home.dimos("cancel").with(0).out.contains("planning: CANCELLED"));
    planning.wait().with(1).says(&["no plan: cancelled"]);
    home.dimos("plan arm -1.5 -0.3 0.6 0 0.8 0 --timeout 300ms").with(1).says(&["in time"]);
    assert_eq!(home.status()["planner"]["state"], "FAULT");
    home.dimos("plan arm 1.2 -0.3 0.6 0 0.8 0").with(0);
    assert_eq!(home.status()["planner"]["state"], "COMPLETED", "of the motion before");
}

#[test]
fn a_run_that_goes_away_is_waited_for() {
    let (home, run, planner) = up();
    home.dimos("world add post --box 0.04 0.04 0.4 --at 0.22 0.12 0.2").with(0);
    home.dimos("plan arm 1.0 -0.3 0.6 0 0.8 0").with(0);
    run.end(Signal::TERM).with(143);
    planner.until("planner lab: FAULT: run cell: the run is gone");
    let waiting = home.dimos("status").with(0).out;
    assert!(waiting.contains("lab") && waiting.contains("a planner waiting for its run"), "{waiting}");
    let run = home.run("cell.yaml --no-record");
    planner.until(AGAIN);
    // The world is as it was; the plans of the run that is gone are gone with it.
    assert!(home.dimos("world list").with(0).out.contains("post"));
    home.dimos("execute").with(1).says(&["NO_PLAN"]);
    home.dimos("move arm --named home").with(0).says(&["planned, collision-checked"]);
    // The same when the run has no time for a word, more than once.
    run.signal(Signal::KILL);
    drop(run.wait());
    eventually("it is noticed", || planner.err().matches("FAULT: run cell").count() == 2);
    home.dimos("plan arm --named home").with(1);
    // Another arm under the same name is not planned for as if it were the same.
    home.write("cell.yaml", &COORDINATOR.replace("2.0]", "1.0]"));
    let other = home.run("cell.yaml --no-record");
    planner.until("FAULT: run cell: the run has other limits now: start the planner again");
    home.dimos("plan arm --named home").with(1).says(&["NO_PLANNER"]);
    other.end(Signal::TERM).with(143);
    home.write("cell.yaml", COORDINATOR);
    let _run = home.run("cell.yaml --no-record");
    eventually("it is back", || planner.err().matches(AGAIN).count() == 2);
    home.dimos("plan arm --named home").with(0);
    planner.end(Signal::TERM).with(143);
    // One that waits for a run is ended like one that has one.
    let planner = self::planner(&home, "--duration 60s");
    home.dimos("down cell").with(0).says(&["planner lab waits for another run; to end it: dimos down lab"]);
    planner.until("FAULT: run cell");
    home.dimos("down").with(1).says(&["no run is live; planners wait for one: lab", "hint: dimos down lab"]);
    home.dimos("down lab").with(0).says(&["planner lab ended"]);
    planner.wait().with(143);
}

#[test]
fn f23_a_planner_process_that_hangs_or_dies_delays_no_client() {
    let (home, _run, planner) = up();
    home.dimos("move arm 1.5 -0.3 0.6 0 0.8 0 --direct --speed 0.1 --no-wait").with(0);
    planner.signal(Signal::STOP);
    let began = Instant::now();
    home.dimos("plan arm --named home").with(1).says(&[
        "NO_ANSWER",
        "the planner did not answer within 3.0 s",
        "(pid ",
    ]);
    let status = home.status();
    assert_eq!(status["planner"]["state"], "FAULT", "{}", status["planner"]);
    assert_eq!((&status["arms"][0]["phase"], &status["tasks"][0]["state"]), (&json!("ready"), &json!("EXECUTING")));
    // Motion ends at once; only the word about planning is waited for.
    let cancelling = home.start("cancel arm");
    eventually("it stops", || home.client().call(Status {}).unwrap().tasks[0].state != "EXECUTING");
    cancelling.wait().with(0);
    // Far more requests than may wait for it are refused, not gathered.
    let mut flood: Vec<Started> = (0..4).map(|_| home.start("world list")).collect();
    home.dimos("stop").with(0);
    flood.drain(..).for_each(|asked| drop(asked.wait().with(1).says(&["NO_ANSWER"])));
    assert!(began.elapsed() < TIMEOUT, "{:?}", began.elapsed());
    planner.signal(Signal::CONT);
    home.dimos("world list").with(0);
    home.dimos("arm reset arm").with(0);
    home.dimos("arm enable arm").with(0);
    home.dimos("move arm --named home --speed 1").with(0);
    // And it dies in the middle of a request.
    home.dimos("move arm 1.5 -0.3 0.6 0 0.8 0 --speed 1").with(0);
    WALLS.iter().for_each(|wall| drop(home.dimos(wall).with(0)));
    let planning = home.start("plan arm -1.5 -0.3 0.6 0 0.8 0 --timeout 60s");
    eventually("it plans", || home.status()["planner"]["state"] == "PLANNING");
    let before = home.client().call(Status {}).unwrap().ticks.count;
    planner.signal(Signal::KILL);
    planning.wait().with(1).says(&["NO_PLANNER"]);
    drop(planner.wait());
    let after = home.client().call(Status {}).unwrap();
    assert!(after.ticks.count > before && after.arms[0].phase == "ready");
    home.dimos("move arm 1 -0.3 0.6 0 0.8 0 --direct --speed 1").with(0);
    // Its name is free, and the run takes another.
    let _planner = self::planner(&home, "");
    home.dimos("plan arm --named home").with(0);
}

#[test]
fn a_run_that_fits_is_attached_to_and_others_are_refused_with_a_reason() {
    let home = home();
    home.dimos("run lab.yaml --attach cell").with(2).says(&["no live run is named `cell`"]);
    home.dimos("run cell.yaml --attach cell").with(2).says(&["has no planner to attach"]);
    let run = home.run("cell.yaml --no-record");
    home.dimos("run lab.yaml --standalone --attach cell").with(2);
    home.dimos("run lab.yaml --record x.mcap").with(2).says(&["an attached planner writes no log", "hint: "]);
    // Somebody else's arm is not taken for this one, unless one insists.
    home.write(
        "other.yaml",
        &PLANNER.replace(
            "include: [cell.yaml]",
            "
include: [cell.yaml]
hardware: [{hardware_id: arm, adapter_type: yourarm, address: sim}]
",
        ),
    );
    let alone = home.run("other.yaml --no-record --name other");
    assert!(!alone.err().contains("attached to"), "{}", alone.err());
    home.dimos("run lab.yaml --attach other").with(1).says(&["does not fit run other: it has its own planner"]);
    alone.end(Signal::TERM).with(143);
    let insisting = home.start("run other.yaml --attach cell");
    insisting.until(ATTACHED);
    insisting.end(Signal::TERM).with(143);
    // A second run, beside the one that it could attach to.
    let alone = home.run("lab.yaml --no-record --standalone");
    assert_eq!(home.runs().runs().unwrap().len(), 2);
    alone.end(Signal::TERM).with(143);
    // What is missing is named.
    home.write(
        "two.yaml",
        &PLANNER.replace("traj_arm", "traj_b").replace("arm_", "b_").replace("name: arm\n", "name: b\n").replace(
            "include: [cell.yaml]",
            "
hardware: [{hardware_id: b, joints: {prefix: b, count: 6}, adapter_type: mock}]
tasks: [{name: traj_b, type: trajectory, joint_names: {hardware: b}}]
",
        ),
    );
    let reasons = ["does not fit run cell: no arm b; no trajectory task traj_b", "hint: "];
    home.dimos("run two.yaml --attach cell").with(1).says(&reasons);
    let alone = home.run("two.yaml --no-record");
    alone.end(Signal::TERM).with(143);
    // Two runs that fit: one must be named.
    let twin = home.run("cell.yaml --no-record --name twin");
    home.dimos("run lab.yaml").with(2).says(&["several runs own the planner's arms: cell, twin", "--attach RUN"]);
    let chosen = home.start("run lab.yaml --attach twin");
    chosen.until("attached to run twin");
    home.dimos("plan arm --named home --run twin").with(0);
    home.dimos("plan arm --named home --run cell").with(1).says(&["NO_PLANNER"]);
    drop((chosen, twin));
    // A model that is another arm's.
    home.write("cell.yaml", &COORDINATOR.replace("[-2.0, 2.0]", "[3.5, 4.0]"));
    run.end(Signal::TERM).with(143);
    let _run = home.run("cell.yaml --no-record");
    home.dimos("run lab.yaml")
        .with(1)
        .says(&["arm_joint1 ranges from -2.967 to 2.967 rad in the model", "the ranges do not overlap"]);
    home.dimos("run lab.yaml --standalone --name x").with(1).says(&["the ranges do not overlap"]);
}

#[test]
fn in_the_background_it_is_one_line_and_a_name() {
    let home = home();
    let _run = home.run("cell.yaml --no-record");
    let up = home.dimos("run lab.yaml -d --json").with(0).json();
    assert_eq!((&up["run"], &up["attached"]), (&json!("lab"), &json!("cell")));
    home.dimos("plan arm --named home").with(0);
    home.dimos("run lab.yaml -d").with(1).says(&["run cell has a planner already: lab"]);
    assert!(home.dimos("logs lab").with(0).out.contains(ATTACHED));
    home.dimos("down lab").with(0).says(&["planner lab ended"]);
    let shown = Started::of(&mut home.as_typed("run lab.yaml -d --set view.port=0")).wait().with(0);
    let shown = shown.says(&["attached to run cell; end it with: dimos down lab"]).shows(&["planner   lab"]);
    #[cfg(feature = "view")]
    {
        // It has the model, so it serves the live view of the run.
        let url = home.dimos("view").with(0).out;
        assert!(shown.out.contains(&url), "{}", shown.out);
        let scene = crate::view::Page::of(url.trim()).scene();
        assert_eq!((&scene["name"], &scene["robots"][0]["joints"]["arm_joint1"]), (&json!("cell"), &json!("joint1")));
        assert_eq!(
            (&scene["arms"][0]["dof"], &scene["robots"][0]["limits"]["arm_joint1"]["upper"]),
            (&json!(6), &json!(2.0))
        );
    }
    home.dimos("down lab").with(0);
    home.dimos("view").with(1).says(&["run cell has no live view", "hint: "]);
    eventually("it is noticed", || home.status()["planner"] == Value::Null);
}

/// A client that says what it likes.
struct Raw(BufReader<UnixStream>);

impl Raw {
    fn connect(home: &Home) -> Self {
        let stream = UnixStream::connect(home.path().join("run/dimos/cell.sock")).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
        Self(BufReader::new(stream))
    }

    fn say(&mut self, method: &str, params: Value) {
        let line = json!({"id": 1, "method": method, "params": params}).to_string() + "\n";
        self.0.get_mut().write_all(line.as_bytes()).unwrap();
    }

    fn hear(&mut self) -> Value {
        let mut line = String::new();
        assert!(self.0.read_line(&mut line).unwrap() > 0, "closed");
        serde_json::from_str(&line).unwrap()
    }

    /// The next request of the run. Replies to answers may come before it or after it.
    fn request(&mut self) -> Value {
        loop {
            let mut message = self.hear();
            if message["stream"] == "planner_requests" {
                return message["data"].take();
            }
        }
    }

    fn ask(&mut self, method: &str, params: Value) -> Value {
        self.say(method, params);
        self.hear()
    }
}

#[test]
fn what_registers_is_not_trusted() {
    let home = home();
    let _run = home.run("cell.yaml --no-record");
    let mut planner = Raw::connect(&home);
    let joints: Vec<String> = (1..=6).map(|k| format!("arm_joint{k}")).collect();
    let robots = |joints: &[String], task: &str| json!({"name": "x", "robots": [{"name": "arm", "joints": joints, "task": task}]});
    let refused = [
        (robots(&["elbow".into()], "traj_arm"), "INVALID_PARAMS"),
        (robots(&joints, "traj"), "UNKNOWN_TASK"),
        (robots(&joints, "servo_arm"), "WRONG_TASK"),
        (json!({"name": "x", "robots": []}), "INVALID_PARAMS"),
        (json!({"name": "", "robots": [{"name": "arm", "joints": joints}]}), "INVALID_PARAMS"),
    ];
    for (params, code) in refused {
        let reply = planner.ask("register_planner", params);
        assert_eq!(reply["error"]["code"], code, "{reply}");
    }
    let reply = planner.ask("planner_answer", json!({"request": 1, "result": {}}));
    assert_eq!(reply["error"]["code"], "INVALID_PARAMS");
    let reply = planner.ask("register_planner", robots(&joints, "traj_arm"));
    assert_eq!(reply["result"]["limits"]["arm_joint1"]["position"], json!([-1.99, 1.99]), "{reply}");
    // Answers to nothing, answers that are none, and to the wrong question.
    assert_eq!(planner.ask("planner_answer", json!({"request": 99, "result": {}}))["result"], json!({}));
    assert_eq!(planner.ask("planner_answer", json!({"request": 1}))["error"]["code"], "INVALID_PARAMS");
    let asked = home.start("world list");
    let request = planner.hear();
    assert_eq!((&request["stream"], &request["data"]["method"]), (&json!("planner_requests"), &json!("world")));
    planner.say("planner_answer", json!({"request": request["data"]["request"], "result": {"plan": 7}}));
    asked.wait().with(1).says(&["INTERNAL"]);
    planner.hear();
    // A trajectory from it is checked like any client's.
    let executing = home.start("execute --plan 3 --no-wait");
    for _ in 0..4 {
        let request = planner.request();
        let result = match request["method"].as_str().unwrap() {
            // For the status, which says which arms are simulated.
            "planner" => json!({"state": "IDLE", "robots": []}),
            "planning" => json!({"plan": 3, "state": "PLANNED", "elapsed": 0.1, "summary": {"joints": joints,
                "start": [], "goal": [], "waypoints": 2, "length": 1.0, "duration": 1.0, "seed": 0, "times": {}}}),
            "execute_plan" => {
                assert_eq!(request["moment"]["positions"]["arm_joint1"], 0.0, "{request}");
                let at = |t: f64, q: f64| json!({"time_from_start": t, "positions": [q, 0, 0, 0, 0, 0]});
                json!({"plan": 3, "trajectory": {"joint_names": joints, "points": [at(0.0, 0.0), at(1.0, 2.5)]}})
            }
            other => panic!("{other}"),
        };
        planner.say("planner_answer", json!({"request": request["request"], "result": result}));
        if request["method"] == "execute_plan" {
            break;
        }
    }
    executing.wait().with(1).says(&["OUT_OF_LIMITS", "arm_joint1"]);
    is_at(&home, &[0.0; 6]);
    // It goes in the middle of a request.
    let asked = home.start("world list");
    planner.request();
    drop(planner);
    asked.wait().with(1).says(&["NO_PLANNER"]);
}

#[test]
fn a_motion_of_an_attached_planner_obeys_a_world_that_changes() {
    let (home, _run, _planner) = up();
    let moving = home.start("move arm 1.4 -0.3 0.6 0 0.8 0 --speed 0.2 --replan");
    eventually("it moves", || home.positions("arm")[0] > 0.1);
    home.dimos("world add late --sphere 0.03 --at 0.17 0.215 0.36").with(0);
    moving.wait().with(0).says(&["path blocked in", "obstacle \"late\"", "continued as motion"]);
    is_at(&home, &[1.4, -0.3, 0.6, 0.0, 0.8, 0.0]);
    home.dimos("world remove late").with(0);
    let moving = home.start("move arm --named home --speed 0.2");
    eventually("it moves back", || home.positions("arm")[0] < 1.3);
    home.dimos("world add late --sphere 0.03 --at 0.17 0.215 0.36").with(0);
    moving.wait().with(1).says(&["ABORTED", "obstacle \"late\"", "the arm rests before it"]);
    assert!(home.positions("arm")[0] > 1.0);
    // No client has cancelled it.
    home.dimos("status cell").with(0).shows(&["the rest of its way is no longer known to be free"]);
}
