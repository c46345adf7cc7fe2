//! Numbers in degrees, millimetres and grams are refused wherever they are typed, in the same words: in the shell,
//! blueprints, jobs, files of obstacles, requests, Python.

use std::process::Command;

use dimos::rpc::api::{ArmToolSet, Attach, PoseSpec, WorldMove};

use crate::support::program::Home;

const TURN: &str = "angles are in rad, at most a turn: 180° is 3.1416 rad";
const FAR: &str = "lengths are in m, at most 10: 350 mm is 0.35 m";
const DEGREES: &str = "positions are in rad: 90° is 1.5708 rad";

/// A blueprint with one change has this mistake.
#[track_caller]
fn refused(blueprint: &str, change: &str, part: &str) {
    let home = Home::new();
    home.write("changed.yaml", &format!("include: [{blueprint}]\n"));
    let mut command = home.command("check changed.yaml --set");
    let checked = crate::support::program::Started::of(command.arg(change)).wait().with(2);
    assert!(checked.err.contains(part), "{change}: {}", checked.err);
}

#[test]
fn blueprints() {
    let planner = |change: &str, part: &str| refused("yourarm-planner", change, part);
    for pose in ["base_pose", "tool"] {
        planner(&format!("planner.robots.arm.{pose}={{xyz: [0, 350, 0]}}"), FAR);
        planner(&format!("planner.robots.arm.{pose}={{xyz: [0, 0, 0], rpy: [0, 180, 0]}}"), TURN);
    }
    planner("planner.world={w: {shape: {box: [1, 1, 350]}}}", FAR);
    planner("planner.world={w: {shape: {cylinder: [350, 1]}}}", FAR);
    planner("planner.world={w: {shape: {sphere: 0.1}, pose: {xyz: [0, 0, -350]}}}", "-350 mm is -0.35 m");
    planner("planner.world={w: {shape: {sphere: 0.1}, pose: {xyz: [0, 0, 1], rpy: [180, 0, 0]}}}", TURN);
    planner("planner.world={w: {shape: {sphere: 0.1}, padding: 20}}", "padding is 20, must be within 0–1 m");
    planner("planner.padding=3", "padding is 3, must be within 0–1 m");
    planner("planner.robots.arm.named_poses={up: [0, 90, 0, 0, 0, 0]}", DEGREES);
    planner("planner.robots.arm.max_velocity=60", "joints have at most 20 rad/s: 60°/s is 1.0472 rad/s");
    planner("planner.robots.arm.max_acceleration=500", "500°/s² is 8.7266 rad/s²");
    planner("hardware.arm.limits={tcp_velocity: 250}", "tool speeds are in m/s, at most 10: 250 mm/s is 0.25 m/s");
    planner("hardware.arm.mounting={rpy: [180, 0, 0]}", TURN);
    for (blueprint, most) in [("yourarm", "5.0"), ("xarm6", "5.0"), ("xarm7", "3.5"), ("lite6", "0.6"), ("fr3", "3.0")]
    {
        let heavy = format!("the arm takes at most {most} kg, not 850 kg");
        refused(&format!("coordinator-{blueprint}"), "hardware.arm.payload={mass: 850}", &heavy);
    }
}

#[test]
fn shell_files_requests_and_python() {
    let home = Home::new();
    let run = home.run("yourarm-planner --no-record");
    home.dimos("move arm --pose 350 0 0.3").with(2).says(&[FAR]);
    home.dimos("plan arm --by 0 0 350").with(2).says(&[FAR]);
    home.dimos("plan arm --through pose:350,0,0.3 home").with(2).says(&[FAR]);
    home.dimos("move arm --pose 0.3 0 0.3 --rpy 180 0 0").with(2).says(&[TURN]);
    home.dimos("move arm 0 90 0 0 0 0").with(1).says(&[DEGREES]);
    home.dimos("move arm 0 90 0 0 0 0 --direct").with(1).says(&[DEGREES]);
    home.dimos("arm tool arm --xyz 0 0 350").with(2).says(&[FAR]);
    home.dimos("arm payload arm --mass 850").with(2).says(&["the arm takes at most 5.0 kg, not 850 kg"]);
    home.dimos("arm payload arm --mass 0.85 --center 0 0 350").with(2).says(&[FAR]);
    for shape in ["--box 350 1 1 --at 0.5 0 0", "--sphere 350 --at 0.5 0 0", "--sphere 0.1 --at 350 0 0"] {
        home.dimos(&format!("world add wall {shape}")).with(2).says(&[FAR]);
    }
    home.dimos("model ik builtin:yourarm --pose 350 0 0.4").with(2).says(&[FAR]);
    home.write("world.yaml", "wall: {shape: {box: [350, 1, 1]}}\n");
    home.dimos("world load world.yaml").with(2).says(&["world.yaml:1: wall: shape: ", FAR]);
    home.write("job.yaml", "steps:\n  - move: {pose: {xyz: [350, 0, 0.3]}}\n");
    home.dimos("do job.yaml --check").with(2).says(&[FAR]);
    home.write("job.yaml", "steps:\n  - move: {joints: [0, 90, 0, 0, 0, 0]}\n");
    home.dimos("do job.yaml --check").with(2).says(&["arm_joint2 at 90 rad is outside its limits", DEGREES]);

    let mut client = home.client();
    let far = PoseSpec { xyz: [0.0, 350.0, 0.0], ..PoseSpec::default() };
    let turned = PoseSpec { xyz: [0.3, 0.0, 0.3], rpy: Some([0.0, 180.0, 0.0]), quat: None };
    let moved = WorldMove { name: "w".into(), pose: far };
    assert!(client.call(moved).unwrap_err().to_string().contains(FAR));
    let held = Attach { name: "w".into(), robot: "arm".into(), within: Some(350.0), ..Attach::default() };
    assert!(client.call(held).unwrap_err().to_string().contains(FAR));
    for (tool, part) in [(far, FAR), (turned, TURN)] {
        let tool = ArmToolSet { arm: "arm".into(), tool: Some(tool) };
        assert!(client.call(tool).unwrap_err().to_string().contains(part));
    }
    let python = python(&home);
    assert!(python.contains(TURN) && python.contains(FAR), "{python}");
    let far = home.dimos("world add hall --box 1 1 1 --at 6 0 0").with(0);
    assert!(far.err.contains("warning: hall: 6 m is far for an arm's cell: is it in m?"), "{}", far.err);
    let still = home.positions("arm");
    assert!(still.iter().zip([0.0, -0.3, 0.6, 0.0, 0.8, 0.0]).all(|(is, at)| (is - at).abs() < 0.01), "{still:?}");
    run.end(rustix::process::Signal::INT).with(130);
}

/// A job is checked without a run, too: by the limits of a blueprint's arms, or of no arm.
#[test]
fn a_job_in_degrees_is_found_without_a_run() {
    let home = Home::new();
    let job = |steps: &str| home.write("job.yaml", &format!("steps:\n{steps}"));
    job("  - move: home\n  - move: {joints: [0, 90, 0, 0, 0, 0]}\n");
    home.dimos("do job.yaml --check").with(2).says(&[
        "job.yaml:3:5",
        "joint 2 at 90 rad is more than a turn",
        DEGREES,
        "--blueprint NAME",
    ]);
    let by = |blueprint: &str| home.dimos(&format!("do job.yaml --check --blueprint {blueprint}"));
    by("yourarm-planner").with(2).says(&["job.yaml:3:5", "arm_joint2 at 90 rad is outside its limits", DEGREES]);
    // Within a turn, and outside the limits of this arm; joints that another arm has.
    job("  - move: {joints: [0, 6, 0, 0, 0, 0]}\n  - through: [{joints: [0, 0]}, home]\n");
    home.dimos("do job.yaml --check").with(0).says(&["no run is live"]);
    by("yourarm-planner").with(2).says(&["arm_joint2 at 6 rad", "rad", "arm has 6 joints, the goal 2 values"]);
    job("  - move: home\n  - move: {joints: [0, 0.3, 0, 0, 0, 0]}\n  - gripper: {to: open, arm: rarm}\n");
    by("yourarm-planner").with(2).says(&["the blueprint has no arm", "did you mean `arm`?"]);
    by("coordinator-yourarm").with(2).says(&["this blueprint has no planner"]);
    job("  - move: home\n  - move: {joints: [0, 0.3, 0, 0, 0, 0]}\n  - gripper: open\n");
    let sound = by("yourarm-planner").with(0).says(&["they were not checked"]);
    assert_eq!(sound.out, "job.yaml: 3 steps, no mistakes\n");
    by("no-such").with(2);
    home.dimos("do job.yaml --blueprint yourarm-planner").with(2).says(&["--check"]);
}

/// What the Python client says of a pose in degrees and of an obstacle in millimetres.
fn python(home: &Home) -> String {
    const PROGRAM: &str = "
from dimos_client import Client, Pose, Refused
with Client.connect() as run:
    for act in (lambda: run.plan('arm', pose=Pose([0.3, 0, 0.3], rpy=[180, 0, 0])),
                lambda: run.world_add('wall', box=[350, 1, 1], xyz=[0.9, 0, 0.5])):
        try:
            act()
        except Refused as e:
            print(e)
";
    let mut command = Command::new("python3");
    home.settle(command.args(["-c", PROGRAM]));
    command.env("PYTHONPATH", concat!(env!("CARGO_MANIFEST_DIR"), "/assets/python"));
    String::from_utf8(command.output().unwrap().stdout).unwrap()
}
