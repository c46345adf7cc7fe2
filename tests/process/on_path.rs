//! Acts at places of a path: judged by what the arm's emulator receives between which setpoints.

use dimos::arms::yourarm::emulator::wire::Request;
use dimos::arms::yourarm::emulator::{SimOptions, YourArmEmulator};
use dimos::hardware::registry::Emulator;
use dimos::planning::scene::config::{PlannerConfig, RobotConfig};
use dimos::planning::scene::planning_scene::PlanningScene;
use dimos::rpc::api::{Go, Going, Speed};
use serde_json::{Value, json};

use crate::support::program::{Home, eventually};

/// Distance of the tool between two setpoints at 0.1 m/s and 100 Hz [m].
const TICK: f64 = 1e-3;

#[test]
fn acts_on_a_path_are_done_within_a_tick_of_their_place() {
    let (home, arm) = (Home::new(), YourArmEmulator::with(&SimOptions::default()).unwrap());
    let _run = home.run(&format!("yourarm-planner --no-record --set hardware.arm.address={}", arm.address()));
    home.dimos("move arm 0.2 -0.4 0.9 0.1 0.8 0.2 --speed 1").with(0);
    let mut client = home.client();
    let go = |act: Value| -> Go {
        let plan = json!({"goals": [{"robot": "arm", "by": {"xyz": [0, 0.3, 0]}, "linear": true}],
            "speed": 1, "tcp_speed": 0.1});
        serde_json::from_value(json!({"steps": [{"plan": plan}], "on_path": act})).unwrap()
    };
    for (acts, says) in [
        (json!([{"distance": 9, "speed": 0.5}]), "0.3000 m long"),
        (json!([{"distance": 0.1}]), "needs one of gripper, output, speed"),
        (json!([{"waypoint": 1, "speed": 0.5}]), "waypoint must be 1 to 0"),
        (json!([{"step": 1, "distance": 0, "speed": 0.5}]), "its step is no `plan`"),
    ] {
        let refused = match client.call(go(acts)) {
            Err(error) => error.to_string(),
            Ok(reply) => {
                eventually("it is over", || client.call(Going { going: reply.going }).unwrap().done);
                client.call(Going { going: reply.going }).unwrap().error.unwrap().to_string()
            }
        };
        assert!(refused.contains(says), "{refused}");
    }
    arm.record();
    let acts = json!([
        {"distance": 0.2, "output": {"arm": "arm", "outputs": {"do0": 1}}},
        {"distance": 0.1, "gripper": {"arm": "arm", "to": 0.03}},
        {"distance": 0.25, "speed": 0.5},
    ]);
    let going = client.call(go(acts)).unwrap().going;
    eventually("it is over", || client.call(Going { going }).unwrap().done);
    let report = client.call(Going { going }).unwrap();
    assert_eq!(report.error, None);
    assert_eq!(report.steps[0].acts.iter().map(|act| act.on_path).collect::<Vec<_>>(), [1, 0, 2]);
    assert_eq!(client.call(Speed::default()).unwrap().fraction, 1.0, "as before the motion");

    let config = PlannerConfig { robots: vec![RobotConfig::yourarm()], ..PlannerConfig::default() };
    let scene = PlanningScene::load(&config).unwrap();
    let (mut covered, mut last, mut steps) = (0.0, None, Vec::new());
    let (mut gripper, mut output) = (None, None);
    for received in arm.trace() {
        match received.request {
            request if request.setpoint().is_some() => {
                let degrees = request.setpoint().unwrap();
                let q: Vec<f64> = degrees.iter().map(|angle| f64::from(*angle).to_radians()).collect();
                let now = scene.robots[0].tcp_pose(&q).translation;
                let step = last.map_or(0.0, |last| now.distance(last));
                (covered, last) = (covered + step, Some(now));
                steps.push((covered, step));
            }
            Request::Gripper(_) | Request::Grip(..) => gripper = gripper.or(Some(covered)),
            Request::SetDigital(0, true) => output = output.or(Some(covered)),
            _ => {}
        }
    }
    for (what, place, done) in [("gripper", 0.1, gripper), ("output", 0.2, output)] {
        let done = done.unwrap_or_else(|| panic!("no {what} came"));
        assert!((done - place).abs() <= 2.0 * TICK, "{what} at {done} m");
    }
    // Setpoints are rounded: several at a time.
    let speed = |from: f64, to: f64| {
        let part: Vec<f64> = steps.iter().filter(|(at, _)| (from..to).contains(at)).map(|(_, step)| *step).collect();
        part.iter().sum::<f64>() / part.len() as f64 / TICK
    };
    assert!((0.97..1.01).contains(&speed(0.15, 0.24)), "{}", speed(0.15, 0.24));
    assert!((0.45..0.55).contains(&speed(0.27, 0.29)), "{}", speed(0.27, 0.29));
}

#[test]
fn a_job_acts_at_its_waypoints() {
    let (home, arm) = (Home::new(), YourArmEmulator::with(&SimOptions::default()).unwrap());
    let _run = home.run(&format!("yourarm-planner --no-record --set hardware.arm.address={}", arm.address()));
    home.write(
        "job.yaml",
        "speed: 100%\nsteps:\n  - through:\n      waypoints: [home, {joints: [0.4, -0.3, 0.6, 0, 0.8, 0]}, {joints: [0.4, \
         -0.3, 0.6, 0, 0.4, 0]}]\n      blend: 0.02\n      on_path: [{waypoint: 2, gripper: {to: 0.03}}, {distance: \
         0.01, output: {do1: high}}]\n",
    );
    arm.record();
    home.dimos("do job.yaml").with(0);
    let trace = arm.trace();
    let is_turned = |degrees: [f32; 6]| degrees[4] < 0.78_f32.to_degrees();
    let turned = trace.iter().position(|received| received.request.setpoint().is_some_and(is_turned));
    let acts: Vec<usize> = trace
        .iter()
        .enumerate()
        .filter(|(_, received)| {
            matches!(received.request, Request::Gripper(_) | Request::Grip(..) | Request::SetDigital(1, true))
        })
        .map(|(index, _)| index)
        .collect();
    assert!(matches!(trace[acts[0]].request, Request::SetDigital(1, true)), "{acts:?}");
    let setpoints = |range: std::ops::Range<usize>| {
        trace[range].iter().filter(|received| received.request.setpoint().is_some()).count()
    };
    let (turned, gripper) = (turned.unwrap(), acts[1]);
    let apart = setpoints(turned.min(gripper)..turned.max(gripper));
    assert!(apart < 25, "{apart} setpoints between the waypoint and its act");
    for (key, says) in [
        ("[{waypoint: 9, speed: 50%}]", "waypoints before its goal"),
        ("[{speed: 50%}]", "needs a place"),
        ("[{waypoint: 1, distance: 0.1, speed: 50%}]", "needs a place"),
    ] {
        home.write("wrong.yaml", &format!("steps:\n  - move: {{named: home, on_path: {key}}}\n"));
        home.dimos("do wrong.yaml").with(2).says(&[says]);
    }
}
