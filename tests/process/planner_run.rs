//! Planning in a run, with the real binary: from a plan to its motion, and what is refused.

use std::time::Instant;

use dimos::rpc::Code;
use dimos::rpc::api::{ArmEnable, ArmReset, ExecutePlan, Lease, Motion, Move, Status};
use dimos::rpc::client::ClientError;
use rustix::process::Signal;
use serde_json::Value;

use crate::support::program::{Home, Started, eventually};

/// An ideal arm in memory, with YourArm's description.
pub(super) const BLUEPRINT: &str = include_str!("../support/lab.yaml");
const HOME: [f64; 6] = [0.0, -0.3, 0.6, 0.0, 0.8, 0.0];
/// Two walls that leave no way from one side of the arm to the other, as far as a search can tell in a minute.
const WALLS: [&str; 2] = ["world add front --box 2 0.02 4 --at 1.1 0 0", "world add back --box 2 0.02 4 --at -1.1 0 0"];
const LEFT: &str = "1.5 -0.3 0.6 0 0.8 0";
const RIGHT: &str = "-1.5 -0.3 0.6 0 0.8 0";

pub(super) fn up() -> (Home, Started) {
    let home = Home::new();
    home.write("lab.yaml", BLUEPRINT);
    let run = home.run("lab.yaml --no-record");
    home.dimos("move arm --named home --speed 1").with(0);
    (home, run)
}

/// On the left of the walls, with something to plan that takes as long as it may.
fn up_between_walls() -> (Home, Started) {
    let (home, run) = up();
    home.dimos(&format!("move arm {LEFT} --speed 1")).with(0);
    WALLS.iter().for_each(|wall| drop(home.dimos(wall).with(0)));
    (home, run)
}

#[track_caller]
pub(super) fn is_at(home: &Home, arm: &str, goal: &[f64]) {
    let is = home.positions(arm);
    assert!(is.iter().zip(goal).all(|(is, goal)| (is - goal).abs() < 0.01), "{is:?} for {goal:?}");
}

/// Where the planner says that an arm's end effector will be when a plan has been carried out [m].
fn end(preview: &Value) -> Vec<f64> {
    let way = preview["end_effectors"]["arm"].as_array().unwrap();
    way.last().unwrap().as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect()
}

#[test]
fn a_plan_is_shown_then_carried_out() {
    let (home, _run) = up();
    let planned = home.dimos("plan arm 0.3 -0.2 0.5 0 0.4 0").with(0).says(&["nothing has moved"]);
    assert!(planned.out.contains("clearance") && planned.out.contains("rad long"), "{}", planned.out);
    is_at(&home, "arm", &HOME);
    let shown = home.dimos("preview --out plan.json").with(0);
    assert!(shown.out.contains("arm_joint6") && shown.out.contains("arm: flange in map x"), "{}", shown.out);
    sampled(&home, &home.dimos("preview --json").with(0).json());
    home.dimos("execute").with(0).says(&["planned, collision-checked"]);
    is_at(&home, "arm", &[0.3, -0.2, 0.5, 0.0, 0.4, 0.0]);
    // The file is a trajectory like any other, from where the plan began.
    home.dimos("execute plan.json").with(1).says(&["START_STATE_MISMATCH"]);
    home.dimos("move arm --named home").with(0).says(&["planned, collision-checked"]);
    home.dimos("execute plan.json").with(0);
    is_at(&home, "arm", &[0.3, -0.2, 0.5, 0.0, 0.4, 0.0]);
    home.dimos("move arm --named home --direct").with(2);
    // Programs ask for a direct motion, too.
    let aside = Move::new("arm", [0.5, -0.3, 0.6, 0.0, 0.8, 0.0], 1.0);
    let Err(ClientError::Refused(refused)) = home.client().call(aside) else { panic!("it is not planned") };
    assert_eq!(refused.code, Code::NotPlanned);
    is_at(&home, "arm", &[0.3, -0.2, 0.5, 0.0, 0.4, 0.0]);
    home.dimos("move arm 0 -0.3 0.6 0 0.8 0 --direct").with(0).says(&["direct, not collision-checked"]);
    // Who is there already is no failure: `move --named home` may be said twice.
    home.dimos("move arm --named home").with(0);
    home.dimos("move arm --named home").with(0);
    is_at(&home, "arm", &HOME);
}

#[test]
fn a_plan_says_how_it_was_checked_and_an_unproven_one_is_executed_only_if_asked_for() {
    let (home, _run) = up();
    let goal = "arm 0.3 -0.2 0.5 0 0.4 0";
    let clearance = |level: &str| {
        let planned = home.dimos(&format!("plan {goal} --level {level} --json")).with(0).json();
        assert_eq!(planned["summary"]["level"], level);
        planned["summary"]["clearance"].as_f64()
    };
    let (certified, exact) = (clearance("certified").unwrap(), clearance("exact").unwrap());
    assert!(certified > 0.0 && certified <= exact && exact < certified + 0.01, "{certified} of {exact}");
    let planned = home.dimos(&format!("plan {goal}")).with(0).out;
    assert!(planned.contains("proven clearance") && planned.contains("least between arm/"), "{planned}");
    let preview = home.dimos("preview --json").with(0).json();
    let neighbours = preview["ignored_pairs"]["neighbours"].as_array().unwrap();
    assert!(neighbours.iter().any(|pair| pair[0] == "arm/link1" && pair[1] == "arm/link2"), "{neighbours:?}");
    assert_eq!(clearance("fast"), None);
    let fast = home.dimos("preview").with(0).out;
    assert!(fast.contains("not proven free of contact"), "{fast}");
    home.dimos("execute").with(1).says(&["PLAN_UNPROVEN", "add --unproven"]);
    home.dimos(&format!("move {goal} --level fast")).with(2).says(&["nothing has moved"]);
    home.dimos(&format!("plan {goal} --level quick")).with(2).says(&["must be fast, certified or exact"]);
    is_at(&home, "arm", &HOME);
    home.dimos("execute --unproven").with(0);
    is_at(&home, "arm", &[0.3, -0.2, 0.5, 0.0, 0.4, 0.0]);
    home.dimos("move arm --named home --level fast --unproven").with(0).says(&["planned, checked at samples only"]);
    is_at(&home, "arm", &HOME);
}

/// `preview --hz`: the plan as the arm gets it, as CSV and as JSON.
fn sampled(home: &Home, plan: &Value) {
    let text = home.dimos("preview --hz 50").with(0).out;
    let mut lines = text.lines();
    let names: Vec<&str> = lines.next().unwrap().split(',').collect();
    assert_eq!((names[0], names[1], names[7], names[13]), ("time", "arm_joint1", "arm_joint1_vel", "arm.x"));
    let rows: Vec<Vec<f64>> = lines.map(|line| line.split(',').map(|cell| cell.parse().unwrap()).collect()).collect();
    assert!(rows.iter().all(|row| row.len() == 1 + 6 + 6 + 7), "{names:?}");
    let duration = plan["summary"]["duration"].as_f64().unwrap();
    assert_eq!(rows.len(), (duration * 50.0).ceil() as usize + 1);
    // Steps are what the velocities say, and the ends are those of the plan.
    for pair in rows.windows(2).take(rows.len() - 2) {
        let (step, mean) = (pair[1][1] - pair[0][1], 0.5 * (pair[0][7] + pair[1][7]) * 0.02);
        assert!((pair[1][0] - pair[0][0] - 0.02).abs() < 2e-6 && (step - mean).abs() < 1e-4, "{pair:?}");
    }
    let last = rows.last().unwrap();
    assert!((last[1] - 0.3).abs() < 1e-5 && last[7].abs() < 1e-5 && (last[0] - duration).abs() < 1e-5, "{last:?}");
    assert!(end(plan).iter().zip(&last[13..16]).all(|(a, b)| (a - b).abs() < 1e-5), "{last:?}");
    let json = home.dimos("preview --hz 50 --json").with(0).json();
    assert_eq!(json["trajectory"]["points"].as_array().unwrap().len(), rows.len());
    let turn: Vec<f64> = serde_json::from_value(json["orientations"]["arm"][0].clone()).unwrap();
    assert!((turn.iter().map(|q| q * q).sum::<f64>() - 1.0).abs() < 1e-9, "{turn:?}");
    home.dimos("preview --hz 0").with(2).says(&["within 0.1–1000 Hz"]);
}

#[test]
fn poses_lines_and_seeds() {
    let (home, _run) = up();
    for orientation in ["--rpy 3.14 0 0", "--quat 1 0 0 0", ""] {
        home.dimos(&format!("plan arm --pose 0.35 0.1 0.3 {orientation}")).with(0);
        let preview = home.dimos("preview --json").with(0).json();
        let there = end(&preview);
        assert!(there.iter().zip([0.35, 0.1, 0.3]).all(|(is, goal)| (is - goal).abs() < 1e-4), "{there:?}");
    }
    home.dimos("move arm --pose 0.35 0 0.35 --rpy 3.14 0.2 0").with(0);
    let line = home.dimos("plan arm --pose 0.35 0.15 0.35 --rpy 3.14 0.2 0 --linear --json").with(0).json();
    assert_eq!(line["summary"]["fraction"], 1.0);
    let preview = home.dimos("preview --json").with(0).json();
    for at in preview["end_effectors"]["arm"].as_array().unwrap() {
        let [x, y, z] = [0, 1, 2].map(|axis| at[axis].as_f64().unwrap());
        assert!((x - 0.35).abs() < 2e-3 && (z - 0.35).abs() < 2e-3 && (-0.001..0.151).contains(&y), "{at}");
    }
    home.dimos("plan arm --pose 1.5 0 0.35 --rpy 3.14 0.2 0 --linear")
        .with(1)
        .says(&["% of the straight line", "hint: "]);
    // Saved poses are goals as those of the blueprint are, whose names they cannot have.
    home.dimos("pose save home").with(2).says(&["arm has a named pose home in the blueprint"]);
    home.dimos("pose save near-table").with(0).shows(&["near-table saved", "near-table  arm"]);
    let saved = home.positions("arm");
    // A detour around a post is searched, with the same result for the same seed.
    home.dimos("move arm --named home").with(0);
    home.dimos("world add post --box 0.04 0.04 0.4 --at 0.22 0.12 0.2").with(0);
    let detour = |seed| {
        let planned = home.dimos(&format!("plan arm 1.0 -0.3 0.6 0 0.8 0 --seed {seed} --json")).with(0).json();
        assert!(planned["summary"]["waypoints"].as_u64().unwrap() > 2, "{planned}");
        assert!(planned["summary"]["clearance"].as_f64().unwrap() > 0.0, "{planned}");
        home.dimos("preview --json").with(0).json()["trajectory"].take()
    };
    let (first, again, other) = (detour(1), detour(1), detour(2));
    assert!(first == again && first != other);
    home.dimos("execute").with(0);
    is_at(&home, "arm", &[1.0, -0.3, 0.6, 0.0, 0.8, 0.0]);
    home.dimos("move arm --named near-table --speed 1").with(0);
    is_at(&home, "arm", &saved);
}

#[test]
fn what_cannot_be_planned_is_refused_in_words() {
    let (home, _run) = up();
    home.dimos("world add box --box 0.1 0.1 0.2 --at 0.4 0 0.1").with(0);
    let table: &[(&str, i32, &[&str])] = &[
        ("plan arm --pose 0.4 0 0.1", 1, &["the goal collides: link \"arm/", " m deep in obstacle \"box\"", "hint: "]),
        ("plan arm 0 1.5 1.5 0 0 0", 1, &["the goal collides: link \"arm/", "deep in link \"arm/"]),
        ("plan arm --pose 5 0 0.3 --rpy 0 0 0", 1, &["arm: no IK solution after ", " m and ", "hint: "]),
        ("plan arm 9 0 0 0 0 0", 1, &["goal: arm_joint1 at 9.0000 rad is outside its limits", "hint: "]),
        ("plan arm 0 0 0", 2, &["arm has 6 joints, the goal 3 values"]),
        ("plan arm --named hme", 2, &["no pose named `hme`", "did you mean `home`?"]),
        ("plan amr --named home", 2, &["UNKNOWN_ROBOT", "did you mean `arm`?"]),
        ("plan arm --pose 0.3 0 0.3 --quat 1 1 0 0", 2, &["pose.quat has length 1.414"]),
        ("plan arm 0 0 0 0 0 0 --linear", 2, &["--pose <X> <Y> <Z>|--by <X> <Y> <Z>"]),
        ("plan arm", 2, &["required"]),
        ("preview", 1, &["NO_PLAN", "hint: `dimos plan` makes one"]),
        ("preview 4711", 2, &["UNKNOWN_PLAN"]),
        ("execute --plan 4711", 2, &["UNKNOWN_PLAN"]),
    ];
    // The way home has made plans: the ones that are asked about here are gone with a new run.
    for (arguments, code, words) in table.iter().filter(|(arguments, ..)| *arguments != "preview") {
        home.dimos(arguments).with(*code).says(words);
    }
    // The arm is inside an obstacle that was added later.
    home.dimos("world add ball --sphere 0.1 --at 0.24 0 0.36").with(0);
    let stuck = ["the start collides: link \"arm/", "obstacle \"ball\"", "hint: "];
    home.dimos("plan arm 0.5 -0.3 0.6 0 0.8 0").with(1).says(&stuck);
    home.dimos("plan arm --pose 0.3 0 0.36 --rpy 3.14 0.5 0 --linear").with(1).says(&stuck[..2]);
    is_at(&home, "arm", &HOME);
    let fresh = Home::new();
    fresh.write("lab.yaml", BLUEPRINT);
    let _run = fresh.run("lab.yaml --no-record");
    fresh.dimos("preview").with(1).says(table[10].2);
    fresh.dimos("execute").with(1).says(&["NO_PLAN"]);
}

#[test]
fn execute_takes_what_plan_made_and_no_plan_of_a_move() {
    let (home, _run) = up();
    home.dimos("execute").with(1).says(&["NO_PLAN", "the plan of a `move`", "hint: `dimos plan` makes one"]);
    home.dimos("preview").with(1).says(&["NO_PLAN"]);
    // A move that begins and is not executed: another program has the arm.
    let mut holder = home.client();
    holder.call(Lease { arm: Some("arm".into()) }).unwrap();
    home.dimos("plan arm 0.4 -0.3 0.6 0 0.8 0").with(0);
    home.dimos("move arm -0.4 -0.3 0.6 0 0.8 0").with(1).says(&["LEASE_HELD"]);
    drop(holder);
    eventually("the lease is free", || home.dimos("execute --plan 4711").err.contains("UNKNOWN_PLAN"));
    home.dimos("execute").with(0);
    is_at(&home, "arm", &[0.4, -0.3, 0.6, 0.0, 0.8, 0.0]);
    // A plan that was not found is no reason to execute the one before it.
    home.dimos("plan arm --named home").with(0);
    home.dimos("plan arm 0 1.5 1.5 0 0 0").with(1);
    home.dimos("execute").with(1).says(&["NO_PLAN", "was not found: the goal collides", "hint: "]);
    is_at(&home, "arm", &[0.4, -0.3, 0.6, 0.0, 0.8, 0.0]);
}

#[test]
fn a_plan_is_refused_when_the_arm_or_the_world_is_not_as_it_was() {
    let (home, _run) = up();
    home.dimos("plan arm 0.8 -0.3 0.6 0 0.8 0").with(0);
    home.dimos("move arm 0.3 -0.3 0.6 0 0.8 0 --direct").with(0);
    home.dimos("execute").with(1).says(&[
        "START_STATE_MISMATCH",
        "the first point or target is 0.3",
        "arm_joint1",
        "hint: ",
    ]);
    is_at(&home, "arm", &[0.3, -0.3, 0.6, 0.0, 0.8, 0.0]);
    // An obstacle that came after the plan.
    home.dimos("plan arm -0.6 -0.3 0.6 0 0.8 0").with(0);
    home.dimos("world add late --sphere 0.05 --at 0.26 -0.08 0.36").with(0);
    home.dimos("execute").with(1).says(&[
        "PLAN_OUTDATED",
        "is no longer free",
        "obstacle \"late\"",
        "hint: plan again",
    ]);
    is_at(&home, "arm", &[0.3, -0.3, 0.6, 0.0, 0.8, 0.0]);
    home.dimos("world remove late").with(0);
    home.dimos("execute").with(0);
    is_at(&home, "arm", &[-0.6, -0.3, 0.6, 0.0, 0.8, 0.0]);
    // Planning needs no motors, motion does.
    home.dimos("arm disable arm").with(0);
    home.dimos("plan arm --named home").with(0);
    home.dimos("execute").with(1).says(&["ARM_NOT_READY", "hint: "]);
    home.dimos("arm enable arm").with(0);
    home.dimos("execute").with(0);
    is_at(&home, "arm", &HOME);
}

#[test]
fn cancel_and_ctrl_c_end_planning_at_once() {
    let (home, _run) = up_between_walls();
    let began = Instant::now();
    let planning = home.start(&format!("plan arm {RIGHT} --timeout 60s"));
    let mut client = home.client();
    let planner = || home.dimos("cancel").with(0).out.contains("planning: CANCELLED");
    eventually("it plans", planner);
    planning.wait().with(1).says(&["no plan: cancelled"]);
    // The motion of another client continues.
    let moving = home.start("move arm 1.5 -0.3 0.6 0 0.8 0.8 --direct --speed 0.2");
    eventually("it moves", || home.positions("arm")[5] > 0.05);
    // That the goal is enclosed is found in a second or more.
    let planning = home.start(&format!("plan arm {RIGHT} --timeout 60s"));
    eventually("the planner is busy", || home.status()["planner"]["state"] == "PLANNING");
    home.dimos("plan arm --named home").with(1).says(&["PLANNING", "hint: "]);
    planning.end(Signal::INT).with(130).says(&["planning was cancelled: nothing has moved"]);
    moving.wait().with(0);
    assert!(began.elapsed().as_secs() < 40, "nothing waits for the 60 s");
    // A request that runs out of time says so, and the arm did not notice any of it.
    home.dimos(&format!("plan arm {RIGHT} --timeout 300ms")).with(1).says(&["in time", "--timeout"]);
    let status = client.call(Status {}).unwrap();
    assert_eq!((status.arms[0].phase.as_str(), status.tasks[0].state.as_str()), ("ready", "COMPLETED"));
    home.dimos("plan arm 1.2 -0.3 0.6 0 0.8 0").with(0);
}

#[test]
fn a_planned_motion_is_cancelled_and_stopped_like_any_other() {
    let (home, _run) = up();
    let far = "move arm 2 -0.3 0.6 0 0.8 0 --speed 0.2";
    let moving = home.start(far);
    eventually("it moves", || home.positions("arm")[0] > 0.1);
    assert!(home.dimos("cancel arm").with(0).out.contains("traj_arm: CANCELLED"));
    moving.wait().with(1).says(&["ABORTED"]);
    let moving = home.start(far);
    let before = home.positions("arm")[0];
    eventually("it moves on", || home.positions("arm")[0] > before + 0.1);
    home.dimos("stop").with(0);
    moving.wait().with(1);
    assert!(home.positions("arm")[0] < 1.9);
    home.dimos("plan arm --named home").with(0);
    home.dimos("execute").with(1).says(&["ARM_LATCHED", "hint: "]);
    let mut client = home.client();
    client.call(ArmReset { arm: "arm".into() }).unwrap();
    client.call(ArmEnable::new("arm")).unwrap();
    home.dimos("execute").with(0);
    is_at(&home, "arm", &HOME);
}

/// The first path that is found is a detour, as a rule.
#[test]
fn a_plan_is_refined_unless_that_is_turned_off() {
    let (home, _run) = up();
    home.dimos("move arm 0.9 -0.3 0.6 0 0.8 0 --speed 1").with(0);
    home.dimos("world add wall --box 2 0.02 1.1 --at 1.1 0 0").with(0);
    let duration = |options: &str| {
        let plan = home.dimos(&format!("plan arm -0.9 -0.3 0.6 0 0.8 0 --json {options}")).with(0).json();
        plan["summary"]["duration"].as_f64().unwrap()
    };
    let (mut first, mut refined) = (0.0, 0.0);
    for seed in 0..6 {
        first += duration(&format!("--seed {seed} --refine 0"));
        refined += duration(&format!("--seed {seed}"));
        assert_eq!(duration(&format!("--seed {seed}")), duration(&format!("--seed {seed} --refine 4")));
    }
    assert!(refined < 0.97 * first, "{refined:.2} s refined, {first:.2} s of the first paths");
}

#[test]
fn nothing_is_planned_again_for_a_client_that_has_gone() {
    let (home, _run) = up();
    home.dimos("plan arm 1.4 -0.3 0.6 0 0.8 0 --speed 0.2").with(0);
    let mut client = home.client();
    let execute = ExecutePlan { plan: None, replan: true, ..Default::default() };
    let begun = client.call(execute).unwrap();
    eventually("it moves", || home.positions("arm")[0] > 0.1);
    drop(client);
    eventually("its lease is free", || home.status()["arms"][0]["commander"].is_null());
    home.dimos("world add late --sphere 0.03 --at 0.17 0.215 0.36").with(0);
    let mut client = home.client();
    let mut report = client.call(Motion { motion: begun.motion }).unwrap();
    eventually("the motion ends", || {
        report = client.call(Motion { motion: begun.motion }).unwrap();
        report.done
    });
    let error = report.error.unwrap_or_default();
    assert!(report.next.is_none() && error.contains("who asked for it has gone"), "{error}");
}

#[test]
fn one_commands_the_other_may_only_plan() {
    let (home, _run) = up();
    let mut holder = home.client();
    holder.call(Lease { arm: Some("arm".into()) }).unwrap();
    home.dimos("plan arm 0.5 -0.3 0.6 0 0.8 0").with(0);
    home.dimos("execute").with(1).says(&["LEASE_HELD", "arm is commanded by ", "hint: "]);
    home.dimos("move arm --named home").with(1).says(&["LEASE_HELD"]);
    is_at(&home, "arm", &HOME);
    drop(holder);
    eventually("the lease is free", || home.dimos("execute --plan 4711").err.contains("UNKNOWN_PLAN"));
    home.dimos("move arm 0.5 -0.3 0.6 0 0.8 0").with(0);
}

#[test]
fn mistakes_of_a_blueprint_are_found_by_check_where_they_are() {
    let home = Home::new();
    let table = [
        ("end_effector_link: flange", "end_effector_link: flnge", "the model has no link `flnge`", "lab.yaml:11:26"),
        ("[joint1,", "[jont1,", "the model has no joint `jont1`", "lab.yaml:12:21"),
        ("builtin:yourarm", "builtin:yourrm", "unknown built-in robot `yourrm`", "lab.yaml:10:19"),
        ("builtin:yourarm", "none.urdf", "none.urdf: ", "lab.yaml:10:19"),
        (
            "end_effector_link",
            "base_link: bse\n      end_effector_link",
            "the model has no link `bse`",
            "lab.yaml:11:18",
        ),
        ("home: [0,", "home: [9,", "`joint1` at 9 rad is outside the model's limits", "lab.yaml:16:15"),
        ("home: [0,", "home: [", "5 positions for 6 joints", "lab.yaml:16:15"),
        ("{box: [1.2, 1.2, 0.02]}", "{box: [1.2, 0, 0.02]}", "a size of the shape is 0", "lab.yaml:18:20"),
        ("{box: [1.2, 1.2, 0.02]}", "{mesh: none.stl}", "there is no file none.stl", "lab.yaml:18:20"),
        (
            "      named_poses",
            "      collision_exclusion_pairs: [[link1, lnk3]]\n      named_poses",
            "no link `lnk3`",
            "lab.yaml:15:34",
        ),
        ("task_name: traj_arm", "task_name: traj_rm", "there is no task `traj_rm`", "lab.yaml:14:30"),
    ];
    for (right, wrong, words, place) in table {
        assert!(BLUEPRINT.contains(right));
        home.write("lab.yaml", &BLUEPRINT.replacen(right, wrong, 1));
        for verb in ["check lab.yaml", "run lab.yaml --no-record"] {
            home.dimos(verb).with(2).says(&[words, place, "the blueprint has mistakes"]);
        }
    }
}

#[test]
fn a_goal_at_a_limit_is_refused_when_it_is_planned() {
    let (home, _run) = up();
    home.dimos("down").with(0);
    home.write(
        "lab.yaml",
        &BLUEPRINT.replace("adapter_type: mock", "adapter_type: mock, limits: {position: [-1.5, 1.5]}"),
    );
    let _run = home.run("lab.yaml --no-record");
    // The model reaches to 2.967 rad, this arm to 1.5, and commands stay 0.01 rad inside.
    let words = ["goal: arm_joint1 at 1.4950 rad is outside its limits -1.4900 … 1.4900", "hint: "];
    home.dimos("plan arm 1.495 -0.3 0.6 0 0.8 0").with(1).says(&words);
    let robot = home.client().call(dimos::rpc::api::Planner {}).unwrap().robots.remove(0);
    assert_eq!(robot.limits[0], [Some(-1.49), Some(1.49)]);
    home.dimos("move arm 1.49 -0.3 0.6 0 0.8 0 --speed 1").with(0);
    is_at(&home, "arm", &[1.49, -0.3, 0.6, 0.0, 0.8, 0.0]);
    // No solution of a pose lies outside either.
    for side in ["0.1 0.35 0.3", "-0.2 0.35 0.3"] {
        let planned = home.dimos(&format!("plan arm --pose {side} --json"));
        if planned.code == Some(0) {
            let goal = planned.json()["summary"]["goal"].take();
            assert!(goal.as_array().unwrap().iter().all(|q| q.as_f64().unwrap().abs() <= 1.49 + 1e-9), "{goal}");
            home.dimos("execute").with(0);
        } else {
            planned.with(1).says(&["no IK solution after"]);
        }
    }
}
