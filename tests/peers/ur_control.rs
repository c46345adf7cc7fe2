//! The text of the program that runs on a controller of Universal Robots, carried out by Python.

use dimos::arms::ur::Options;
use dimos::arms::ur::model::Model;
use dimos::arms::ur::program::control;
use serde_json::{Value, json};

use crate::support::python::ask_python;

/// Period of an e-Series controller [s].
const STEP: f64 = 0.002;
const START: f64 = -1.0;

/// The registers of a step: count, order, position or velocity of joint 1.
fn registers(count: i64, order: i64, value: f64) -> Value {
    json!({ "int": [count, order], "double": [value, 0, 0, 0, 0, 0] })
}

/// What the program does with these registers; `None` without Python.
fn carried_out(steps: &[Value]) -> Option<Value> {
    let text = control(7, &Options::default(), &Model::Ur5e.limits());
    let target = [START, 0.0, 0.0, 0.0, 0.0, 0.0];
    ask_python("ur_control.py", "json", &json!({ "text": text, "step": STEP, "steps": steps, "target": target }))
}

/// Positions of joint 1 that servoj got.
fn servoj(answer: &Value) -> Vec<f64> {
    let ordered = answer["ordered"].as_array().unwrap();
    ordered.iter().filter(|one| one[0] == "servoj").map(|one| one[1][0][0].as_f64().unwrap()).collect()
}

/// A setpoint every second step at `speed` [rad/s], but none from step 200 for `gap` steps.
fn stream(speed: f64, gap: i64) -> Vec<Value> {
    let (mut steps, mut last) = (vec![registers(5, 0, 0.0); 3], (5, START));
    for k in 0..900 {
        if k % 2 == 0 && !(200..200 + gap).contains(&k) {
            last = (last.0 + 1, START + speed * STEP * (k.min(500)) as f64);
        }
        steps.push(registers(last.0, 1, last.1));
    }
    steps
}

#[test]
fn the_text_catches_up_within_the_limits_of_speed_and_acceleration() {
    for (speed, gap) in [(0.5, 0), (0.5, 10), (0.5, 26), (1.5, 10), (1.5, 80)] {
        let Some(answer) = carried_out(&stream(speed, gap)) else { return };
        let points = servoj(&answer);
        let top = Model::Ur5e.limits().velocity_max[0];
        let velocities: Vec<f64> = points.windows(2).map(|pair| (pair[1] - pair[0]) / STEP).collect();
        let largest = velocities.iter().fold(0.0, |largest: f64, v| largest.max(v.abs()));
        assert!(largest <= top + 1e-6, "{gap} steps at {speed} rad/s: {largest:.2} rad/s, limit {top:.2}");
        let change = velocities.windows(2).map(|pair| (pair[1] - pair[0]).abs() / STEP).fold(0.0, f64::max);
        let most = 1.1 * Options::default().stop_deceleration;
        assert!(change <= most, "{gap} steps at {speed} rad/s: {change:.2} rad/s², limit {most:.2}");
        let end = START + speed * STEP * 500.0;
        assert!((points.last().unwrap() - end).abs() < 1e-3, "{:?} is not {end}", points.last());
    }
}

#[test]
fn the_text_takes_registers_as_a_set() {
    // The fourth step reads the count and the order before they change, the values after that.
    let mut torn = registers(6, 1, START);
    (torn["after"], torn["then"]) = (json!(2), registers(7, 1, START + 0.01));
    let whole = vec![registers(7, 1, START + 0.01); 8];
    let steps = [vec![registers(5, 0, 0.0); 3], vec![torn], whole].concat();
    let Some(answer) = carried_out(&steps) else { return };
    let ordered = answer["ordered"].as_array().unwrap();
    assert_eq!((&ordered[3][0], &ordered[3][3]), (&json!("sync"), &json!(5)), "not taken: {ordered:?}");
    assert_eq!((&ordered[4][0], &ordered[4][3]), (&json!("servoj"), &json!(7)));
    let points = servoj(&answer);
    assert!(points.windows(2).all(|pair| pair[1] > pair[0]) && points[points.len() - 1] < START + 0.01, "{points:?}");
}

#[test]
fn the_text_ends_by_order_by_silence_and_at_a_setpoint_far_away() {
    let rest = vec![registers(5, 0, 0.0); 2];
    for (order, value, state, then) in [(3, 0.0, 10, "stopj"), (1, START + 1.0, 12, "sync"), (9, 0.0, 1, "sync")] {
        let servo = vec![registers(6, 2, 0.3); 2];
        let steps = [&rest[..], if order == 3 { &servo } else { &[] }, &vec![registers(8, order, value); 9]].concat();
        let Some(answer) = carried_out(&steps) else { return };
        assert_eq!(answer["out"]["25"], state, "{answer}");
        let ordered = answer["ordered"].as_array().unwrap();
        assert!(ordered.iter().any(|one| one[0] == then && one[2] == state), "{answer}");
    }
    // A velocity ends after 20 ms, the program after 1 s.
    let silent = [&rest[..], &vec![registers(6, 2, 0.3); 700]].concat();
    let Some(answer) = carried_out(&silent) else { return };
    let points = servoj(&answer);
    let moving = points.windows(2).filter(|pair| pair[1] > pair[0]).count();
    assert!((20..24).contains(&moving), "as many steps slower as faster: {moving}");
    let ordered = answer["ordered"].as_array().unwrap();
    assert!((500..503).contains(&points.len()) && ordered[ordered.len() - 1][0] == "stopj", "{} points", points.len());
    assert_eq!((&answer["out"]["25"], &answer["out"]["26"]), (&json!(11), &json!(7)));
}
