//! Poses with the real binary: `state` prints what `--pose` takes, in any frame, with and without a tool.

use dimos::pose::{from_xyz_rpy, to_xyz_rpy};
use nalgebra::Isometry3;
use serde_json::Value;

use crate::support::program::{Home, eventually};

/// The pose of an arm in `state --json`.
fn pose(home: &Home, arm: &str) -> (Isometry3<f64>, Value) {
    let state = home.dimos("state --json").with(0).json();
    let arms = state["arms"].as_array().unwrap();
    let pose = arms.iter().find(|found| found["hardware_id"] == arm).unwrap()["pose"].clone();
    let three = |key: &str| [0, 1, 2].map(|i| pose[key][i].as_f64().unwrap());
    (from_xyz_rpy(three("xyz"), three("rpy")), pose)
}

/// The numbers that `state` prints for the first pose with this label, as arguments of `move`.
fn printed(home: &Home, label: &str) -> String {
    let out = home.dimos("state").with(0).out;
    // The numbers are in the line below.
    let line = out.lines().skip_while(|line| !line.contains(label)).nth(1);
    let line = line.unwrap_or_else(|| panic!("no {label:?} in {out}"));
    let numbers: Vec<&str> = line.split_whitespace().filter(|word| word.parse::<f64>().is_ok()).collect();
    let [x, y, z, r, p, w] = numbers[..] else { panic!("{line}") };
    format!("--pose {x} {y} {z} --rpy {r} {p} {w}")
}

#[track_caller]
fn same(a: &Isometry3<f64>, b: &Isometry3<f64>) {
    let (far, turned) = ((a.translation.vector - b.translation.vector).norm(), a.rotation.angle_to(&b.rotation));
    assert!(far < 5e-4 && turned < 1.7e-3, "{far} m, {turned} rad between {a} and {b}");
}

#[track_caller]
fn stays(home: &Home, arm: &str, before: &[f64]) {
    let now = home.positions(arm);
    assert!(now.iter().zip(before).all(|(now, before)| (now - before).abs() < 5e-3), "{now:?} from {before:?}");
}

#[test]
fn what_state_prints_can_be_pasted() {
    let home = Home::new();
    let _run = home.run("xarm7-planner --sim --no-record");
    home.dimos("move arm --named home --speed 1").with(0);
    let before = home.positions("arm");
    let pasted = printed(&home, "link_tcp in map");
    home.dimos(&format!("move arm {pasted}")).with(0);
    stays(&home, "arm", &before);
    home.dimos(&format!("plan arm {pasted}")).with(0);
    let preview = home.dimos("preview").with(0).out;
    assert!(preview.contains("arm: link_tcp in map x"), "{preview}");
    let shown = home.dimos("state").with(0).out;
    assert!(shown.contains("flange in base (device)"), "{shown}");
    home.dimos("status -v").with(0).shows(&["arm: poses in map are those of link_tcp (no tool)"]);
}

#[test]
fn poses_in_frames_and_with_a_tool() {
    let home = Home::new();
    let _run = home.run("dual-yourarm-planner --no-record");
    home.dimos("move --goal left=named:home --goal right=named:home --speed 1").with(0);
    let before = home.positions("left");
    let (start, shown) = pose(&home, "left");
    assert_eq!((shown["link"].as_str(), shown["frame"].as_str()), (Some("flange"), Some("map")));
    assert!((start.translation.y - 0.3).abs() < 1e-3, "the left base is 0.3 m to the left: {start}");
    home.dimos(&format!("move left {}", printed(&home, "flange in map"))).with(0);
    stays(&home, "left", &before);

    // The same place in another frame moves nothing either.
    let (xyz, rpy) = to_xyz_rpy(&(Isometry3::translation(0.0, 0.3, 0.0).inverse() * start));
    let words = |values: [f64; 3]| values.map(|v| format!("{v:.6}")).join(" ");
    home.dimos(&format!("move left --pose {} --rpy {} --frame base", words(xyz), words(rpy))).with(0);
    stays(&home, "left", &before);
    home.dimos("move left --pose 0 0 0 --rpy 0 0 0 --frame tool").with(0);
    stays(&home, "left", &before);
    home.dimos("world add cup --sphere 0.01 --at 0.3 0.3 0.2").with(0);
    let cup = Isometry3::translation(0.3, 0.3, 0.2).inverse() * start;
    let (xyz, rpy) = to_xyz_rpy(&cup);
    home.dimos(&format!("move left --pose {} --rpy {} --frame cup", words(xyz), words(rpy))).with(0);
    stays(&home, "left", &before);
    home.dimos("move left --pose 0 0 0 --frame cpu")
        .with(2)
        .says(&["no frame or object named `cpu`", "did you mean `cup`?"]);
    home.dimos("move left --named home --frame tool").with(2);

    // Relative, along the tool's own axis, on a line.
    home.dimos("move left --by 0 0 -0.05 --frame tool --linear").with(0);
    same(&pose(&home, "left").0, &(start * Isometry3::translation(0.0, 0.0, -0.05)));
    home.dimos("move left --by 0 0 0.05 --frame tool").with(0);
    same(&pose(&home, "left").0, &start);
    home.dimos("move left --by 0 0.02 0.03 --rpy 0 0 0.2").with(0);
    let turned = from_xyz_rpy([0.0; 3], [0.0, 0.0, 0.2]).rotation * start.rotation;
    let place = start.translation.vector + nalgebra::Vector3::new(0.0, 0.02, 0.03);
    same(&pose(&home, "left").0, &Isometry3::from_parts(place.into(), turned));
    home.dimos(&format!("move left {}", before.iter().map(f64::to_string).collect::<Vec<_>>().join(" "))).with(0);

    // A tool: poses are those of its centre point.
    home.dimos("arm tool left").with(0).shows(&["left: flange (no tool)"]);
    let tool = from_xyz_rpy([0.0, 0.0, 0.12], [0.0, 0.3, 0.0]);
    home.dimos("arm tool left --xyz 0 0 0.12 --rpy 0 0.3 0")
        .with(0)
        .shows(&["the tool on flange at xyz 0.0000 0.0000 0.1200 m"]);
    let with_tool = pose(&home, "left").0;
    same(&with_tool, &(start * tool));
    stays(&home, "left", &before);
    home.dimos(&format!("move left {}", printed(&home, "the tool on flange in map"))).with(0);
    stays(&home, "left", &before);
    home.dimos("move left --by 0 0 0 --rpy 0 0 0.2 --frame tool").with(0);
    let after = pose(&home, "left").0;
    assert!((after.translation.vector - with_tool.translation.vector).norm() < 5e-4, "it turns about its tool");
    let right = pose(&home, "right").1;
    assert!(right["tool"].is_null(), "{right}");
    home.dimos("move left 0.6 -0.3 0.6 0 0.8 0 --speed 0.2 --no-wait").with(0);
    home.dimos("arm tool left --none").with(1).says(&["left moves", "hint: "]);
    home.dimos("cancel").with(0);
    eventually("it rests", || home.status()["tasks"][0]["state"] != "CANCELLING");
    home.dimos("arm tool left --none").with(0).shows(&["left: flange (no tool)"]);
}
