//! What goes wrong while a motion is planned or carried out, in whole runs: it costs one request, or one motion, and
//! the coordinator does not notice.

use std::sync::Arc;
use std::time::{Duration, Instant};

use dimos::arms::yourarm::emulator::{SimOptions, YourArmEmulator};
use dimos::collision::Stop;
use dimos::collision::world::World;
use dimos::hardware::registry::Emulator;
use dimos::hardware::sim::faults::{Fault, FaultKind};
use dimos::planning::request::pipeline::{self, solve};
use dimos::planning::scene::planning_scene::PlanningScene;
use dimos::rpc::Code;
use dimos::rpc::api::{ExecutePlan, Move, Plan, PlanGoal, Planner, Planning};
use dimos::rpc::report::TickReport;
use dimos::rpc::run_dir::RunDir;
use dimos::runtime::{Record, Run};

use crate::support::program::{Home, eventually};
use crate::support::wire::watch::Watch;

const BLUEPRINT: &str = include_str!("../support/lab.yaml");
/// Seeds of requests that break the solver of these tests.
const PANICS: u64 = 13;
const HANGS: u64 = 14;
/// Period of the tick.
const PERIOD: Duration = Duration::from_millis(10);

fn to(angle: f64, seed: u64) -> Plan {
    let joints = Some(vec![angle, -0.3, 0.6, 0.0, 0.8, 0.0]);
    let goal = PlanGoal { robot: "arm".into(), joints, ..PlanGoal::default() };
    Plan { goals: vec![goal], speed: 1.0, seed, timeout: Some(0.2), ..Plan::default() }
}

/// What became of a request, and how long it took.
fn planned(run: &Run, plan: Plan) -> (u64, String, String) {
    let plan = run.call(plan).unwrap().plan;
    let mut report = run.call(Planning { plan }).unwrap();
    eventually("planning ends", || {
        report = run.call(Planning { plan }).unwrap();
        report.state != "PLANNING"
    });
    (plan, report.state, report.error.unwrap_or_default())
}

/// Number of ticks since `began`, without the time in which this computer ran no program.
fn ticks_due(host: &Watch, began: Instant) -> f64 {
    began.elapsed().saturating_sub(host.lost_since(began, PERIOD)).as_secs_f64() / PERIOD.as_secs_f64()
}

#[test]
fn f23_a_planner_that_panics_or_never_ends_costs_that_request_only() {
    let folder = tempfile::tempdir().unwrap();
    let solver = |setup: &PlanningScene, world: &World, request: &pipeline::PlanRequest, stop: &Stop| {
        match request.seed {
            PANICS => panic!("a defect of the planner"),
            HANGS => loop {
                std::hint::black_box(request); // as busy as can be, and ignores the cancel flag
            },
            _ => solve(setup, world, request, stop),
        }
    };
    let run = Run::from_yaml("f23", BLUEPRINT).record(Record::Off).folder(RunDir::closed(folder.path()));
    let run = run.solver(Arc::new(solver)).start().unwrap();
    // A motion that takes as long as all of this does, and is not disturbed by any of it.
    let host = Watch::of_processors();
    let mut goal = 0.0;
    host.unless_stalled(|| {
        goal = 2.5 - goal;
        let motion = run
            .call(Move { direct: true, ..Move::new("arm", [goal, 0.0, 0.0, 0.0, 0.0, 0.0], 0.1) })
            .map_err(|e| e.to_string())?;
        let (before, began) = (run.status().ticks, Instant::now());
        let (_, state, error) = planned(&run, to(0.5, PANICS));
        assert!(state == "FAILED" && error.contains("a bug in the planner"), "{error}");
        let (_, state, error) = planned(&run, to(0.5, HANGS));
        assert!(state == "FAILED" && error.contains("did not end at its timeout"), "{error}");
        assert_eq!(run.call(Planner {}).unwrap().state, "FAULT");
        let TickReport { count, overruns, skipped, .. } = run.status().ticks;
        let (ticks, due) = (count - before.count, ticks_due(&host, began));
        println!("F23: {ticks} ticks of {due:.0} in the time, {overruns} overruns, {skipped} periods skipped");
        let ended = run.wait(motion.motion).unwrap();
        if ended.state != "COMPLETED" {
            let _ = run.reset("arm").and_then(|_| run.enable("arm"));
            return Err(format!("the motion: {ended:?}"));
        }
        if ticks as f64 > 0.9 * due { Ok(()) } else { Err(format!("{ticks} ticks of {due:.0}")) }
    });
    // The next request has a new thread, beside the one that hangs.
    let (plan, state, error) = planned(&run, Plan { timeout: Some(20.0), ..to(2.0, 0) });
    assert_eq!(state, "PLANNED", "{error}");
    let begun = run.call(ExecutePlan { plan: Some(plan), ..Default::default() }).unwrap();
    assert_eq!(run.wait(begun.motion).unwrap().state, "COMPLETED");
    // One that hangs does not keep the run from ending.
    run.call(to(0.5, HANGS)).unwrap();
    let began = Instant::now();
    let ended = run.stop();
    assert!(ended.troubles.is_empty() && began.elapsed() < Duration::from_secs(15), "{ended:?}");
}

#[test]
fn f23_a_search_without_end_in_the_real_program_disturbs_no_motion() {
    let home = Home::new();
    home.write("lab.yaml", BLUEPRINT);
    let _run = home.run("lab.yaml --no-record");
    home.dimos("move arm 1.5 -0.3 0.6 0 0.8 0 --speed 1").with(0);
    // A wall to pass over, and thousands of things to look at on a path that is refined without end.
    home.dimos("world add front --box 2 0.02 1.1 --at 1.1 0 0").with(0);
    let points: String = (0..20_000).map(|k| format!("{} {} 3\n", k % 200, k / 200)).collect();
    let head = "ply\nformat ascii 1.0\nelement vertex 20000\nproperty float x\nproperty float y\nproperty float z\nend_header\n";
    home.write("cloud.ply", &(head.to_owned() + &points));
    home.dimos("world add cloud --cloud cloud.ply --at 0 0 0").with(0);
    let planning = home.start("plan arm -1.5 -0.3 0.6 0 0.8 0 --timeout 180s --refine 1000000000");
    eventually("it plans", || home.status()["planner"]["state"] == "PLANNING");
    let host = Watch::of_processors();
    let mut goal = 1.5;
    host.unless_stalled(|| {
        goal = 2.6 - goal;
        let (before, began) = (home.status(), Instant::now());
        let moved = home.dimos(&format!("move arm {goal} -0.3 0.6 0 0.8 0 --direct --speed 0.1"));
        let after = home.status();
        assert_eq!(after["planner"]["state"], "PLANNING");
        let figure = |status: &serde_json::Value, what: &str| status["ticks"][what].as_u64().unwrap();
        let (ticks, due) = (figure(&after, "count") - figure(&before, "count"), ticks_due(&host, began));
        println!("F23: {ticks} ticks of {due:.0} during a search, {} overruns", figure(&after, "overruns"));
        if moved.code != Some(0) || after["arms"][0]["phase"] != "ready" {
            home.dimos("arm reset arm");
            home.dimos("arm enable arm");
            return Err(format!("{}{}", moved.err, after["arms"][0]));
        }
        if ticks as f64 > 0.9 * due { Ok(()) } else { Err(format!("{ticks} ticks of {due:.0}")) }
    });
    home.dimos("cancel").with(0);
    planning.wait().with(1).says(&["no plan: cancelled"]);
    // Walls that leave no way are named, without the whole timeout.
    home.dimos("world remove cloud").with(0);
    home.dimos("world add front --box 2 0.02 4 --at 1.1 0 0").with(0);
    home.dimos("world add back --box 2 0.02 4 --at -1.1 0 0").with(0);
    let enclosed =
        ["the goal is enclosed: arm_joint1 does not leave -2.", "obstacle \"front\"", "hint: move the obstacle"];
    home.dimos("plan arm -1.5 -0.3 0.6 0 0.8 0 --timeout 60s").with(1).says(&enclosed);
}

#[test]
fn a_motion_that_leaves_its_plan_is_aborted_and_reported() {
    let home = Home::new();
    // An arm that lags far behind its commands, and a task that minds.
    let lagging = BLUEPRINT
        .replace("adapter_type: mock", "adapter_type: mock, options: {lag: 0.5}")
        .replace("joint_names: {hardware: arm}", "joint_names: {hardware: arm}, params: {path_tolerance: 0.05}");
    home.write("lab.yaml", &lagging);
    let _run = home.run("lab.yaml --no-record");
    assert_eq!(home.status()["planner"]["state"], "IDLE");
    home.dimos("plan arm 1.5 -0.3 0.6 0 0.8 0 --speed 1").with(0);
    home.dimos("execute").with(1).says(&["ABORTED", "hint: "]);
    let status = home.status();
    assert_eq!(status["planner"]["state"], "FAULT", "{}", status["planner"]);
    assert!(status["planner"]["error"].as_str().unwrap().contains("rad"), "{}", status["planner"]);
    assert!(home.dimos("status").with(0).out.contains("FAULT"));
}

#[test]
fn nothing_is_planned_from_a_state_that_is_older_than_1_s() {
    let home = Home::new();
    let arm = YourArmEmulator::with(&SimOptions::default()).unwrap();
    let yourarm =
        BLUEPRINT.replace("adapter_type: mock", &format!("adapter_type: yourarm, address: \"{}\"", arm.address()));
    home.write("lab.yaml", &yourarm);
    let _run = home.run("lab.yaml --no-record");
    home.dimos("plan arm --named home").with(0);
    arm.inject(Fault::new(FaultKind::Stall).lasting(6.0)).unwrap();
    let refused = || {
        home.dimos("plan arm --named home")
            .err
            .contains("arm: no state that is younger than 1 s [START_STATE_UNAVAILABLE]")
    };
    eventually("the state is too old", refused);
    home.dimos("execute").with(1).says(&["START_STATE_UNAVAILABLE", "hint: "]);
    let mut client = home.client();
    let refusal = client.call(to(0.5, 0)).unwrap_err();
    assert!(matches!(refusal, dimos::rpc::client::ClientError::Refused(e) if e.code == Code::StartStateUnavailable));
    eventually("the arm is back", || home.dimos("plan arm --named home").code == Some(0));
}
