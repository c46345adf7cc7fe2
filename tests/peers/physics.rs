//! MuJoCo behind the wires of the emulators: arms arrive, hold their weight, droop as their drives do, fall without
//! brakes, and a blocked one reports what its vendor's does.

use std::io::Write;
use std::path::Path;
use std::process::{Command, Stdio};

use dimos::robot::Source;
use dimos::robot::dynamics::GRAVITY;
use dimos::robot::mjcf::{Fixture, mjcf};
use dimos::robot::model::Geometry;
use nalgebra::Isometry3;
use serde_json::{Value, json};

use crate::support::program::{Home, Started, eventually};
use crate::support::python::python_with;
use crate::support::skip::skip_optional;

/// The cause and the error of an arm that is held.
fn held(home: &Home) -> (Value, Value) {
    let arm = home.status()["arms"][0].clone();
    (arm["cause"]["name"].clone(), arm["error"].clone())
}

fn run(home: &Home, blueprint: &str, more: &str) -> Option<Started> {
    python_with(&["mujoco"])?;
    let run = home.run(&format!("{blueprint} --sim=physics --no-record {more}"));
    home.dimos("arm enable arm").with(0);
    Some(run)
}

#[test]
fn arms_with_mass_arrive_where_they_are_sent_and_bear_their_weight() {
    for (blueprint, seed, near) in
        [("ur5e-planner", 0, 5e-3), ("ur5e-planner", 7, 5e-3), ("xarm7-planner", 3, 5e-3), ("yourarm-planner", 5, 5e-3)]
    {
        let home = Home::new();
        let set = format!("--set hardware.arm.options.sim.physics.seed={seed}");
        let Some(_run) = run(&home, blueprint, &set) else { return };
        let moved = home.dimos("move arm --named home --speed 0.5").with(0);
        assert!(moved.out.contains("COMPLETED"), "{blueprint} {seed}: {}", moved.out);
        let state = home.dimos("state --json").with(0).json();
        let joints = state["arms"][0]["joints"].as_array().unwrap().clone();
        let off =
            joints.iter().map(|joint| (joint["position"].as_f64().unwrap() - joint["command"].as_f64().unwrap()).abs());
        assert!(off.fold(0.0, f64::max) < near, "{blueprint} {seed}: {state}");
        // A UR reports no torques.
        let efforts: Vec<f64> = joints.iter().filter_map(|joint| joint["effort"].as_f64()).collect();
        let most = efforts.iter().fold(0.0, |most: f64, effort| most.max(effort.abs()));
        assert!(efforts.is_empty() || (1.0..200.0).contains(&most), "{blueprint} {seed}: {joints:?}");
    }
}

#[test]
fn an_arm_that_drives_into_something_stops_as_its_vendors_does() {
    // Nothing is planned: the wall is in the world of the body alone.
    for (blueprint, code, at, rest) in [
        ("ur5e-planner", 153, -0.45, "-1.57 1.57 -1.57 -1.57 0"),
        ("xarm7-planner", 31, 0.45, "0 0 1.0 0 1.0 0"),
        ("yourarm-planner", 2, 0.25, "-0.3 0.6 0 0.8 0"),
    ] {
        let home = Home::new();
        let wall = format!("wall: {{shape: {{box: [1.5, 0.1, 1.5]}}, pose: {{xyz: [0, {at}, 0.8]}}}}");
        home.write("walled.yaml", &format!("name: walled\ninclude: [{blueprint}]\nplanner: {{world: {{{wall}}}}}\n"));
        let Some(_run) = run(&home, "walled.yaml", "") else { return };
        home.dimos(&format!("move arm 0 {rest} --direct --speed 0.5")).with(0);
        home.dimos(&format!("move arm 1.6 {rest} --direct --speed 0.5")).with(1);
        eventually("it is held", || !held(&home).0.is_null());
        assert_eq!(held(&home).1["code"], code, "{}", home.status());
        // It is at the wall, not in it, and at rest.
        let reached = home.positions("arm")[0];
        assert!((0.2..1.5).contains(&reached), "{reached}");
        // It was pushed away from where it was commanded to be, which is acknowledged, and its brakes let it relax.
        eventually("it is ready", || {
            home.dimos("arm reset arm").with(0);
            home.dimos("arm enable arm").code == Some(0)
        });
        home.dimos(&format!("move arm 0 {rest} --direct --speed 0.2")).with(0);
    }
}

#[test]
fn an_arm_without_brakes_droops_and_falls() {
    let home = Home::new();
    let Some(_run) = run(&home, "so101-planner", "--set hardware.arm.options.sim.droop=0.1") else { return };
    home.dimos("move arm 0 0.3 -0.3 0.2 0 --direct --speed 0.5").with(0);
    let state = home.dimos("state --json").with(0).json();
    let off = |joint: usize| {
        let joint = &state["arms"][0]["joints"][joint];
        joint["position"].as_f64().unwrap() - joint["command"].as_f64().unwrap()
    };
    let droop = (1..4).map(off).fold(0.0, |most: f64, off| most.max(off.abs()));
    assert!((0.01..0.15).contains(&droop), "{droop}: {state}");
    let before = home.positions("arm");
    home.dimos("arm disable arm --now").with(0);
    eventually("it falls", || {
        let now = home.positions("arm");
        before.iter().zip(&now).any(|(before, now)| (before - now).abs() > 0.2)
    });
}

#[test]
fn without_mujoco_the_pip_line_is_said() {
    let home = Home::new();
    let bare = home.path().join("python");
    home.write("python", "#!/bin/sh\nexec python3 -S -I \"$@\"\n");
    std::fs::set_permissions(&bare, std::os::unix::fs::PermissionsExt::from_mode(0o755)).unwrap();
    let mut start = home.command("run ur5e-planner --sim=physics --no-record");
    let ended = Started::of(start.env("DIMOS_PYTHON", &bare)).wait().with(2);
    ended.says(&["arm: physics need MuJoCo", "hint: ", "-m pip install mujoco", "DIMOS_PYTHON"]);
    let mut start = home.command("run ur5e-planner --sim=physics --no-record");
    Started::of(start.env("DIMOS_PYTHON", "/nowhere/python")).wait().with(2).says(&["/nowhere/python does not start"]);
    home.dimos("adapter emulate ur --option sim.physics.seed=1")
        .with(2)
        .says(&["physics need a model", "--sim=physics"]);
}

/// What a body with this seed answers to half a second of steps: it leans against the wall.
fn answers(python: &Path, seed: u64) -> String {
    let source = Source { path: "builtin:yourarm".into(), ..Source::default() };
    let model = dimos::robot::load(&source).into_model().unwrap();
    let wall = Fixture {
        name: "wall".into(),
        geometry: Geometry::Box { size: [0.1, 1.0, 1.0].into() },
        pose: Isometry3::translation(0.3, 0.0, 0.3),
    };
    let joints: Vec<String> = (1..=6).map(|number| format!("joint{number}")).collect();
    let scene = mjcf(&model, GRAVITY, &[wall]).unwrap();
    let first = json!({
        "mjcf": scene, "joints": joints, "efforts": [60, 60, 40, 15, 15, 10], "droop": 0.0, "seed": seed,
        "position": [0.0, -0.3, 0.6, 0.0, 0.8, 0.0],
    });
    let none = [0.0; 6];
    let mut lines = vec![first.to_string()];
    for step in 0..500 {
        let reference = [0.0, -0.3 + 4e-4 * f64::from(step), 0.6, 0.0, 0.8, 0.0];
        let steps: Vec<f64> = reference.into_iter().chain([0.0, 0.4, 0.0, 0.0, 0.0, 0.0]).collect();
        let (mode, damping) = ([1; 6], none);
        let line = json!({"steps": steps, "mode": mode, "effort": none, "stiffness": none, "damping": damping});
        lines.push(line.to_string());
    }
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("crates/hardware/src/sim/physics/body.py");
    let mut child = Command::new(python).arg(script).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    let mut input = child.stdin.take().unwrap();
    let writer = std::thread::spawn(move || input.write_all((lines.join("\n") + "\n").as_bytes()).unwrap());
    let output = child.wait_with_output().unwrap();
    writer.join().unwrap();
    String::from_utf8(output.stdout).unwrap()
}

#[test]
fn a_seed_is_one_body_in_every_bit_and_links_press_on_what_is_in_their_way() {
    let Some(python) = python_with(&["mujoco"]) else { return };
    let [once, again, other] = [4, 4, 5].map(|seed| answers(&python, seed));
    assert_eq!(once.lines().count(), 501, "{once}");
    assert!(once == again && once != other);
    let last: Value = serde_json::from_str(once.lines().last().unwrap()).unwrap();
    let pressed = last["contacts"].as_array().unwrap();
    assert!(pressed.iter().any(|pair| pair[1] == "wall" && pair[2].as_f64().unwrap() > 1.0), "{last}");
}

/// Loads a YourArm, whose body differs from its model by the seed.
fn carrying(home: &Home, load: &str, seed: u64) -> Started {
    let blueprint = "name: carries\ninclude: [yourarm-planner]\nhardware:\n  - {hardware_id: arm, payload: LOAD}\n";
    home.write("carries.yaml", &blueprint.replace("LOAD", load));
    run(home, "carries.yaml", &format!("--set hardware.arm.options.sim.physics.seed={seed}")).unwrap()
}

/// Identifies the load; returns what was found.
fn identify(home: &Home, more: &str) -> Value {
    let identifying = home.start(&format!("arm payload arm --identify --json {more}"));
    (1..=10).for_each(|place| identifying.until(&format!("place {place} of 10 measured")));
    identifying.wait().with(0).json()
}

const LOAD: &str = "{mass: 1.2, center: [0.02, -0.01, 0.06]}";

/// Checks a load that was found, and prints it.
fn is_found(seed: u64, found: &Value) {
    println!("seed {seed}: {found}");
    let (mass, center) = (found["mass"].as_f64().unwrap(), found["center"].as_array().unwrap());
    assert!((mass / 1.2 - 1.0).abs() < 0.03, "seed {seed}: {found}");
    let off = center.iter().zip([0.02, -0.01, 0.06]).map(|(found, is)| (found.as_f64().unwrap() - is).abs());
    assert!(off.fold(0.0, f64::max) < 5e-3, "seed {seed}: {found}");
}

#[test]
fn the_load_of_an_arm_is_found_from_what_it_bears() {
    if python_with(&["mujoco"]).is_none() {
        return;
    }
    let home = Home::new();
    let _run = carrying(&home, LOAD, 0);
    is_found(0, &identify(&home, ""));
}

/// `DIMOS_SEEDS=20`: the number of bodies, each measured without its load and with it.
#[test]
fn the_load_of_an_arm_whose_masses_are_not_its_models_is_found_by_comparison() {
    let Some(seeds) = std::env::var("DIMOS_SEEDS").ok().and_then(|seeds| seeds.parse().ok()) else {
        return skip_optional("bodies that are not their models (DIMOS_SEEDS=20)");
    };
    for seed in 1..=seeds {
        let home = Home::new();
        let empty = carrying(&home, "{mass: 0}", seed);
        identify(&home, "--save empty.json");
        home.dimos("down").with(0);
        drop(empty);
        let _run = carrying(&home, LOAD, seed);
        is_found(seed, &identify(&home, "--unloaded empty.json"));
    }
}
