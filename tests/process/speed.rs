//! `--speed` has one meaning: the same motion in a longer time, planned and direct.

use crate::support::program::Home;

const START: &str = "0 -0.3 0.6 0 0.5 0";
const THERE: &str = "0.4 -0.3 0.6 0 0.5 0";

#[test]
fn half_the_speed_is_twice_the_time_planned_and_direct() {
    let home = Home::new();
    let _run = home.run("yourarm-planner --no-record");
    home.dimos(&format!("move arm {START} --speed 1")).with(0);
    let planned = |speed: f64| {
        let plan = home.dimos(&format!("plan arm {THERE} --speed {speed} --seed 3 --json")).with(0).json();
        plan["summary"]["duration"].as_f64().unwrap_or_else(|| panic!("{plan}"))
    };
    let moved = |to: &str, speed: f64| {
        let motion = home.dimos(&format!("move arm {to} --direct --speed {speed} --json")).with(0).json();
        motion["elapsed"].as_f64().unwrap_or_else(|| panic!("{motion}"))
    };
    let (full, direct) = (planned(1.0), moved(THERE, 1.0));
    moved(START, 1.0);
    for speed in [0.5, 0.25, 0.1] {
        let took = planned(speed);
        assert!((took * speed - full).abs() < 1e-9, "planned at {speed}: {took} s, at full speed {full} s");
        let took = moved(THERE, speed);
        assert!((took * speed - direct).abs() < 0.03, "direct at {speed}: {took} s, at full speed {direct} s");
        moved(START, 1.0);
    }
}
