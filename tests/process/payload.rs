//! The load at the flange, judged by what the arm's controller has: from the blueprint, by request, and with an object
//! that the arm holds.

use std::f64::consts::PI;

use dimos::arms::yourarm::emulator::wire::Request;
use dimos::arms::yourarm::emulator::{SimOptions, YourArmEmulator};
use dimos::hardware::registry::Emulator;
use dimos::recording::replay::{LogReader, Payload};
use dimos::rpc::api::{Lease, Move};

use crate::support::program::{Home, eventually};

const TOOL: &str = "{mass: 0.8, center: [0, 0, 0.05], inertia: [0.001, 0, 0, 0.001, 0, 0.002]}";

fn blueprint(home: &Home, arm: &YourArmEmulator, hardware: &str) -> String {
    home.write("cell.yaml", &format!("include: [yourarm-planner]\nhardware: [{{hardware_id: arm, {hardware}}}]\n"));
    format!("cell.yaml --set hardware.arm.address={}", arm.address())
}

/// Mass [kg] and centre [mm] of the controller's load.
fn load(arm: &YourArmEmulator) -> [f32; 4] {
    let [mass, x, y, z, ..] = arm.load();
    [mass, x, y, z].map(|v| (v * 100.0).round() / 100.0)
}

#[test]
fn an_attached_object_of_known_mass_is_carried_and_taken_back() {
    let (home, arm) = (Home::new(), YourArmEmulator::with(&SimOptions::default()).unwrap());
    let run = home.run(&blueprint(&home, &arm, &format!("payload: {TOOL}")));
    assert_eq!(load(&arm), [0.8, 0.0, 0.0, 50.0], "set before the motors were enabled");

    // A ball 100 mm in front of the flange, along its z axis.
    home.dimos("plan arm 0.1 -0.3 0.6 0 0.8 0 --json").with(0);
    let state = home.dimos("state --json").with(0).json();
    let pose = &state["arms"][0]["pose"];
    let number = |v: &serde_json::Value| v.as_f64().unwrap();
    let at: Vec<f64> = pose["xyz"].as_array().unwrap().iter().map(number).collect();
    let rpy: Vec<f64> = pose["rpy"].as_array().unwrap().iter().map(number).collect();
    let z = dimos::pose::from_xyz_rpy([0.0; 3], [rpy[0], rpy[1], rpy[2]]) * nalgebra::Vector3::z() * 0.1;
    let place = format!("{} {} {}", at[0] + z.x, at[1] + z.y, at[2] + z.z);
    home.dimos(&format!("world add ball --sphere 0.02 --at {place}")).with(0);
    let attached = home.dimos("world attach ball arm --mass 1.2").with(0);
    attached.shows(&["ball is held by arm", "payload 2.000 kg"]);
    let [mass, x, y, z] = load(&arm);
    let center = (0.8 * 50.0 + 1.2 * 100.0) / 2.0;
    assert_eq!(mass, 2.0);
    assert!(x.abs() < 0.5 && y.abs() < 0.5 && (f64::from(z) - center).abs() < 0.5, "{:?}, not {center} mm", load(&arm));
    // Parallel axes: both bodies about the common centre, the ball's own 2/5 m r².
    let ixx = 0.001 + 0.8 * 0.03_f64.powi(2) + 0.4 * 1.2 * 0.02_f64.powi(2) + 1.2 * 0.02_f64.powi(2);
    assert!((f64::from(arm.load()[4]) - ixx).abs() < 1e-5, "{} kg·m², not {ixx}", arm.load()[4]);
    home.dimos("arm payload arm").with(0).shows(&["payload 2.000 kg"]);
    eventually("status has it", || home.status()["arms"][0]["payload"]["mass"].as_f64() == Some(2.0));

    // Not while it moves, and what it cannot carry stays where it is.
    home.client().call(Move::direct("arm", [0.9, -0.3, 0.6, 0.0, 0.8, 0.0], 0.2)).unwrap();
    home.dimos("world detach ball").with(1).says(&["is executing", "hint: "]);
    home.dimos("arm payload arm --mass 1").with(1).says(&["is executing"]);
    assert_eq!(load(&arm)[0], 2.0);
    let mut holder = home.client();
    holder.call(Lease { arm: Some("arm".into()) }).unwrap();
    home.dimos("world detach ball").with(1).says(&["arm is commanded by"]);
    assert_eq!(load(&arm)[0], 2.0);
    drop(holder);
    eventually("it is at rest", || home.status()["tasks"][0]["state"] == "COMPLETED");
    eventually("ball is let go of", || home.dimos("world detach ball").code == Some(0));
    assert_eq!(load(&arm), [0.8, 0.0, 0.0, 50.0]);
    home.dimos("world attach ball arm --mass 9").with(2).says(&["the arm takes at most 5.0 kg, not 9.8 kg"]);
    assert!(!home.dimos("world list").with(0).out.contains("arm link"), "it is not held");
    assert_eq!(load(&arm), [0.8, 0.0, 0.0, 50.0]);

    // Before the motors come on again, the load is read, and set again if the controller has another one.
    home.dimos("arm payload arm --mass 1.5 --center 0 -0.01 0.08").with(0).shows(&["payload 1.500 kg"]);
    home.dimos("arm disable arm").with(0);
    arm.forget_load();
    arm.record();
    home.dimos("arm enable arm").with(0);
    let set = |r: &Request| matches!(r, Request::SetPayload([mass, ..]) if *mass == 1.5);
    let requests: Vec<Request> = arm.trace().into_iter().map(|r| r.request).collect();
    let [set, on] = [requests.iter().position(set), requests.iter().position(|r| *r == Request::Enable(true))];
    assert!(set.is_some() && set < on, "{set:?} {on:?}");

    home.dimos("down").with(0);
    drop(run);
    let [log] = &home.logs()[..] else { panic!("one log") };
    let (mut reader, mut masses) = (LogReader::open(log).unwrap(), Vec::new());
    while let Some(entry) = reader.next_entry().unwrap() {
        if let Payload::InertiaStamped(load) = entry.data {
            assert_eq!(entry.topic, "/payload/arm");
            masses.push((load.inertia.m * 10.0).round());
        }
    }
    masses.retain(|mass| *mass != 0.0); // forgotten for a moment
    masses.dedup();
    assert_eq!(masses, [8.0, 20.0, 8.0, 15.0], "every change is logged once");
}

#[test]
fn the_mounting_is_set_before_the_motors_and_a_refusal_ends_the_start() {
    let (home, arm) = (Home::new(), YourArmEmulator::with(&SimOptions::default()).unwrap());
    arm.record();
    let run = home.run(&format!("{} --no-record", blueprint(&home, &arm, &format!("mounting: {{rpy: [{PI}, 0, 0]}}"))));
    let gravity = arm.trace().iter().find_map(|r| if let Request::SetMounting(g) = r.request { Some(g) } else { None });
    assert!(gravity.is_some_and(|[x, y, z]| x.abs() < 1e-6 && y.abs() < 1e-6 && z == 1.0), "{gravity:?}");
    home.dimos("down").with(0);
    drop(run);
    arm.record();
    let refused = home.dimos(&format!("run {} --no-record", blueprint(&home, &arm, "payload: {mass: 6}"))).with(2);
    assert!(refused.err.contains("the arm takes at most 5.0 kg, not 6 kg"), "{}", refused.err);
    assert!(arm.trace().is_empty(), "nothing was connected");
    let wrong = home.dimos(&format!("check {}", blueprint(&home, &arm, "payload: {mass: -1}"))).with(2);
    assert!(wrong.err.contains("the mass is -1 kg") && wrong.err.contains("cell.yaml:2:"), "{}", wrong.err);
}

#[test]
fn an_arm_whose_controller_resets_is_ready_again_with_the_new_load() {
    let home = Home::new();
    let _run = home.run("coordinator-xarm6 --sim --no-record");
    eventually("it is ready", || home.status()["arms"][0]["phase"] == "ready");
    home.dimos("arm payload arm --mass 1.2 --center 0 0 0.06")
        .with(0)
        .shows(&["payload 1.200 kg, centre 0.0000 0.0000 0.0600 m"]);
    let arm = home.status()["arms"][0].clone();
    assert_eq!((&arm["phase"], &arm["cause"]), (&"ready".into(), &serde_json::Value::Null));
    assert_eq!(arm["joints"][0]["voltage"], 48.0);
    let at = home.positions("arm");
    let target: Vec<String> = at.iter().map(|q| (q + 0.05).to_string()).collect();
    home.dimos(&format!("move arm {}", target.join(" "))).with(0);
}
