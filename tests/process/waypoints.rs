//! Motions through waypoints, and along paths that were led or recorded.

use serde_json::Value;

use super::planner_run::{BLUEPRINT, is_at, up};
use crate::support::program::Home;

/// One motion through waypoints: it stops at each, or passes within `--blend` of it.
#[test]
fn one_motion_passes_several_waypoints() {
    let (home, _run) = up();
    home.dimos("move arm 0.2 0 0.4 0.2 0.7 0 --speed 1").with(0);
    home.dimos("pose save near-table").with(0);
    home.dimos("move arm --named home --speed 1").with(0);
    let through = "--through 0.5,-0.3,0.6,0,0.8,0 0.5,-0.1,0.4,0.3,0.8,0 line:0.35,0.05,0.35,3.14,0.2,0 near-table";
    let planned = |options: &str| {
        let plan = home.dimos(&format!("plan arm {through} {options} --speed 1 --json")).with(0).json();
        (plan["summary"]["duration"].as_f64().unwrap(), home.dimos("preview --json").with(0).json())
    };
    // Largest joint distance of the closest point to the waypoint [rad], and the speed there [rad/s].
    let closest = |preview: &Value, waypoint: [f64; 6]| {
        let points = preview["trajectory"]["points"].as_array().unwrap();
        let list = |point: &Value, what| -> Vec<f64> {
            point[what].as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect()
        };
        let most = |values: &[f64]| values.iter().fold(0.0_f64, |most, v| most.max(v.abs()));
        let away = |point: &Value| {
            let off: Vec<f64> = list(point, "positions").iter().zip(waypoint).map(|(q, w)| q - w).collect();
            (most(&off), most(&list(point, "velocities")))
        };
        points.iter().map(away).min_by(|a, b| a.0.total_cmp(&b.0)).unwrap()
    };
    let waypoint = [0.5, -0.1, 0.4, 0.3, 0.8, 0.0];
    let (slow, exact) = planned("");
    let (off, speed) = closest(&exact, waypoint);
    assert!(off < 1e-6 && speed < 1e-6, "{off} rad, {speed} rad/s");
    let (fast, blended) = planned("--blend 0.03");
    let (off, speed) = closest(&blended, waypoint);
    assert!(off > 1e-3 && off < 0.2 && speed > 0.05, "{off} rad, {speed} rad/s");
    assert!(fast < 0.95 * slow, "{fast} s instead of {slow} s");
    let tip =
        |preview: &Value| -> Vec<[f64; 3]> { serde_json::from_value(preview["end_effectors"]["arm"].clone()).unwrap() };
    let at = exact["trajectory"]["points"].as_array().unwrap().iter().position(|point| {
        let q: Vec<f64> = serde_json::from_value(point["positions"].clone()).unwrap();
        q.iter().zip(waypoint).all(|(q, w)| (q - w).abs() < 1e-6)
    });
    let place = tip(&exact)[at.unwrap()];
    let distance = |p: &[f64; 3]| p.iter().zip(place).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
    let nearest = tip(&blended).iter().map(distance).fold(f64::MAX, f64::min);
    assert!(nearest < 0.03 + 1e-3, "{nearest} m from the waypoint");
    let short = "--through 0.2,-0.3,0.6,0,0.8,0 0.2,-0.300000004,0.600000007,0,0.800000009,0 --blend 0.02 --json";
    let plan = home.dimos(&format!("plan arm {short}")).with(0).json();
    assert!(plan["summary"]["duration"].as_f64().unwrap() < 2.0, "a short piece takes no time: {plan}");
    home.dimos(&format!("plan arm {through} 1,2")).with(2).says(&["6 joints, the goal 2 values"]);
    home.dimos("plan arm --through home 0.1,0.2,0,0,0,9 home").with(1).says(&["waypoint 2: "]);
    home.dimos("plan arm --through home").with(2);
    home.dimos("plan arm --through home -0.2,-.3,0.6,0,0.8,0 --speed 1").with(0);
}

/// A path as a hand leads it, at 100 Hz: from aside of home, to and fro, to its end.
const FIRST: [f64; 6] = [0.2, -0.3, 0.6, 0.0, 0.8, 0.0];
const LAST: [f64; 6] = [0.2, -0.1, 0.6, 0.3, 0.8, 0.0];

fn led() -> String {
    let mut text = "time,arm_joint1,arm_joint2,arm_joint3,arm_joint4,arm_joint5,arm_joint6,camera\n".to_owned();
    for k in 0..=400 {
        let part = f64::from(k) / 400.0;
        let q =
            [FIRST[0] + 0.3 * (part * std::f64::consts::TAU).sin(), FIRST[1] + 0.2 * part, 0.6, 0.3 * part, 0.8, 0.0];
        let cells: Vec<String> = q.iter().map(f64::to_string).collect();
        text += &format!("{},{},0\n", f64::from(k) * 0.01, cells.join(","));
    }
    text
}

#[test]
fn a_led_path_is_followed_with_and_without_the_planner() {
    let (home, _run) = up();
    home.write("led.csv", &led());
    let moved = home.dimos("move arm --path led.csv --speed 1").with(0);
    let moved = moved.says(&["401 positions, followed through", "within 0.005 rad", "planned, collision-checked"]);
    assert!(moved.out.contains("COMPLETED") || moved.out.contains("arm_joint6"), "{}", moved.out);
    is_at(&home, "arm", &LAST);
    // Its turning point at 0.5 rad, and no farther: the times of the file do not count, its geometry does.
    home.dimos("plan arm --path led.csv --tolerance 0.002").with(0).says(&["nothing has moved"]);
    let preview = home.dimos("preview --json").with(0).json();
    let points = preview["trajectory"]["points"].as_array().unwrap();
    let most = points.iter().map(|point| point["positions"][0].as_f64().unwrap()).fold(0.0, f64::max);
    assert!((most - 0.5).abs() < 0.002, "{most}");
    home.dimos("execute").with(0);
    is_at(&home, "arm", &LAST);
    // Without a proof only if it is asked for.
    home.dimos("move arm --path led.csv --direct --speed 1").with(0).says(&["direct", "not collision-checked"]);
    is_at(&home, "arm", &LAST);
    // A path is followed as it is: not around what is in its way.
    home.dimos("world add post --box 0.04 0.04 0.4 --at 0.22 0.12 0.2").with(0);
    home.dimos("move arm --path led.csv").with(1).says(&["the path is not free at its waypoint", "\"post\"", "hint: "]);
    home.dimos("world remove post").with(0);
    home.write("other.csv", "time,left_joint1\n0,0\n1,1\n");
    for (arguments, words) in [
        ("move arm --path other.csv", "no joint arm_joint1; it has left_joint1"),
        ("move arm --path none.csv", "none.csv: "),
        ("move arm --path led.csv --tolerance 1", "0.0001–0.1 rad"),
        ("move arm --path led.csv --named home", "cannot be used with"),
        ("move arm --path led.csv --replan", "cannot be used with"),
        ("move amr --path led.csv", "UNKNOWN_ROBOT"),
    ] {
        home.dimos(arguments).with(2).says(&[words]);
    }
}

#[test]
fn the_motion_of_a_log_is_repeated_from_the_log_of_the_live_run() {
    let home = Home::new();
    home.write("lab.yaml", BLUEPRINT);
    let _run = home.run("lab.yaml --record led.mcap");
    for goal in ["0.2 -0.3 0.6 0 0.8 0", "0.4 -0.2 0.5 0.1 0.8 0", "0.2 -0.1 0.6 0.3 0.8 0"] {
        home.dimos(&format!("move arm {goal} --speed 1")).with(0);
    }
    let end = home.positions("arm");
    std::thread::sleep(std::time::Duration::from_millis(300));
    home.dimos("move arm --path led.mcap --speed 1").with(0).says(&["followed through", "planned, collision-checked"]);
    is_at(&home, "arm", &end);
    // The log has the pose of the tool centre point that the run reports, at rest.
    let pose = home.dimos("state --json").with(0).json()["arms"][0]["pose"].take();
    home.dimos("down").with(0);
    let log = home.dimos("replay led.mcap --rate 1000 --json --topics /tcp/arm").with(0);
    let last: Value = serde_json::from_str(log.out.lines().last().unwrap()).unwrap();
    assert_eq!(last["data"]["header"]["frame_id"], "map");
    for (axis, index) in [("x", 0), ("y", 1), ("z", 2)] {
        let (logged, reported) = (&last["data"]["pose"]["position"][axis], &pose["xyz"][index]);
        let off = logged.as_f64().unwrap() - reported.as_f64().unwrap();
        assert!(off.abs() < 1e-4, "{axis}: {logged} for {reported}");
    }
}
