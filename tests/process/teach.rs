//! An arm that is led by hand, and one that its own controller moves: what the program prints and writes, and what the
//! emulated controllers have done.

use std::process::Stdio;

use rustix::process::Signal;
use serde_json::json;

use crate::support::program::{Home, Started, UP, eventually};

/// A hand moves the second joint by 0.3 rad, from 2 s after the first connection.
const HAND: &str = "hardware.arm.options.sim.faults=[{kind: pushed, at: 2, duration: 2, joint: 2, amount: 0.3}]";

fn start(home: &Home, blueprint: &str, set: &[&str]) -> Started {
    let mut command = home.command(&format!("run {blueprint}"));
    for set in set {
        command.args(["--set", set]);
    }
    let run = Started::of(command.stdin(Stdio::null()));
    run.until(UP);
    run
}

fn phase(home: &Home) -> String {
    home.status()["arms"][0]["phase"].as_str().unwrap_or_default().to_owned()
}

#[test]
fn a_led_motion_is_recorded_and_the_arm_is_taken_over_where_it_is() {
    let home = Home::new();
    let run = start(&home, "coordinator-xarm6", &[HAND]);
    let before = home.positions("arm");
    home.dimos("arm teach arm --record led.csv --duration 6").with(0).shows(&["led by hand, motors on", "arm: ready"]);
    let after = home.positions("arm");
    assert!((after[1] - before[1] - 0.3).abs() < 0.02, "{before:?} {after:?}");
    let text = std::fs::read_to_string(home.path().join("led.csv")).unwrap();
    let rows: Vec<Vec<f64>> =
        { text.lines().skip(1) }.map(|line| line.split(',').map(|cell| cell.parse().unwrap()).collect()).collect();
    assert!(text.starts_with("time,arm_joint1,arm_joint2,") && rows.len() > 100, "{} rows", rows.len());
    assert!(rows.windows(2).all(|pair| pair[0][0] < pair[1][0] && (pair[1][2] - pair[0][2]).abs() < 0.1));
    assert!((rows.last().unwrap()[2] - after[1]).abs() < 1e-3);
    assert_eq!(phase(&home), "ready");
    // No overwriting, and the arm is not led if the file cannot be written.
    home.dimos("arm teach arm --record led.csv --duration 1").with(2).says(&["led.csv exists already", "hint: "]);
    assert_eq!(phase(&home), "ready");
    // What another client has switched off stays off.
    let teaching = Started::of(home.command("arm teach arm --record other.csv").stdin(Stdio::null()));
    eventually("it is led", || phase(&home) == "led");
    home.dimos("arm disable arm").with(0);
    teaching.wait().with(1).says(&["no longer led"]);
    assert_eq!((phase(&home).as_str(), &home.status()["arms"][0]["enabled"]), ("disabled", &json!(false)));
    home.dimos("arm enable arm").with(0);
    // Without a file it stays led; a stop ends that.
    home.dimos("arm teach arm").with(0).says(&["dimos arm enable arm"]);
    assert_eq!(phase(&home), "led");
    home.dimos("move arm 0 0 0 0 0 0").with(1).says(&["arm is not ready: led"]);
    home.dimos("stop").with(0).shows(&["confirmed"]);
    assert_eq!(phase(&home), "held");
    run.end(Signal::TERM).with(143);
    home.dimos("replay --last --verify").with(0).shows(&["bit for bit"]);
}

#[test]
fn an_arm_without_motors_is_led_only_by_who_supports_it_and_others_say_why_not() {
    let home = Home::new();
    let run = start(&home, "coordinator-so101", &[]);
    let refused = home.dimos("arm teach arm").with(2);
    refused.says(&["motors off", "--support-the-arm"]);
    assert_eq!(phase(&home), "ready");
    // A refused request changes nothing: the motors of a held arm stay on.
    home.dimos("stop").with(0);
    home.dimos("arm teach arm --support-the-arm").with(1).says(&["reset it first"]);
    assert_eq!((phase(&home).as_str(), &home.status()["arms"][0]["enabled"]), ("held", &json!(true)));
    home.dimos("arm reset arm").with(0);
    home.dimos("arm enable arm").with(0);
    home.dimos("arm teach arm --support-the-arm").with(0).shows(&["motors off: support the arm"]);
    assert_eq!((phase(&home).as_str(), &home.status()["arms"][0]["enabled"]), ("led", &json!(false)));
    eventually("it is held still", || home.dimos("arm enable arm").code == Some(0));
    assert_eq!(phase(&home), "ready");
    run.end(Signal::TERM).with(143);
    let run = start(&home, "coordinator-yourarm", &[]);
    home.dimos("arm teach arm --record none.csv").with(1).says(&["its protocol has no hand guiding", "dimos jog arm"]);
    assert!(!home.path().join("none.csv").exists(), "nothing was recorded");
    run.end(Signal::TERM).with(143);
}

#[test]
fn the_controllers_own_motion_ends_at_the_pose_in_map_and_is_cancelled_and_stopped() {
    let home = Home::new();
    let run = start(&home, "xarm6-planner", &[]);
    let tcp = || home.dimos("state --json").json()["arms"][0]["pose"]["xyz"].clone();
    let near = |y: f64| {
        let at: Vec<f64> = serde_json::from_value(tcp()).unwrap();
        [0.3, y, 0.3].iter().zip(&at).all(|(a, b)| (a - b).abs() < 1e-3)
    };
    home.dimos("move arm --native --pose 0.3 0 0.3").with(1).says(&["not collision-checked", "direct"]);
    let moved = home.dimos("move arm --native --direct --pose 0.3 0.05 0.3").with(0);
    moved.says(&["not collision-checked", "50 %"]).shows(&["COMPLETED"]);
    assert!(near(0.05) && phase(&home) == "ready", "{}", tcp());
    home.dimos("move arm --native --direct --pose 3 0 0.3").with(1).says(&["no solution"]);
    assert_eq!(phase(&home), "ready");

    // Its client leaves at once: the run takes the arm over all the same.
    home.dimos("move arm --native --direct --pose 0.3 0.1 0.3 --no-wait").with(0);
    eventually("the arm is taken over", || phase(&home) == "ready" && near(0.1));

    let going = Started::of(&mut home.command("move arm --native --direct --pose 0.3 -0.25 0.3 --speed 0.05"));
    eventually("it moves", || phase(&home) == "led" && !near(0.1));
    going.signal(Signal::INT);
    going.wait().with(130).says(&["cancelling"]);
    assert!(!near(-0.25) && phase(&home) == "ready", "{}", tcp());

    let going = Started::of(&mut home.command("move arm --native --direct --pose 0.3 -0.25 0.3 --speed 0.05"));
    eventually("it is led", || phase(&home) == "led");
    home.dimos("stop").with(0).shows(&["confirmed"]);
    going.wait().with(1).says(&["stopped by an operator"]);
    assert_eq!(phase(&home), "held");
    home.dimos("arm reset arm").with(0);
    home.dimos("arm enable arm").with(0);
    home.dimos("move arm 0.1 -0.5 -0.7 0 1.2 0 --direct").with(0);
    run.end(Signal::TERM).with(143);
    home.dimos("replay --last --verify").with(0).shows(&["bit for bit"]);
}
