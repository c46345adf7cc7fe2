//! Motions that end before their goal: at a force, an input, a distance, a time; judged by what a UR's emulator, on
//! whose springy surface the tool presses, and yourarm's emulator received.

use dimos::arms::yourarm::emulator::wire::Request;
use dimos::arms::yourarm::emulator::{SimOptions, YourArmEmulator};
use dimos::hardware::registry::Emulator;
use serde_json::Value;

use crate::support::program::{Home, Started};

/// A UR5e above a surface of 4 N/mm.
fn above_a_surface(home: &Home, height: f64) -> Started {
    home.run(&format!(
        "ur5e-planner --sim --no-record --set hardware.arm.options.force_torque=true --set \
         hardware.arm.options.sim.surface.height={height} --set hardware.arm.options.sim.surface.stiffness=4000"
    ))
}

fn outcome(home: &Home, line: &str, code: i32) -> Value {
    serde_json::from_str(home.dimos(&format!("{line} --json")).with(code).out.trim()).unwrap()
}

/// Returns the height of the tool's centre point [m].
fn height(home: &Home) -> f64 {
    let state = outcome(home, "state", 0);
    state["arms"][0]["pose"]["xyz"][2].as_f64().unwrap_or_else(|| panic!("{state}"))
}

#[test]
fn a_tool_that_touches_ends_its_motion_at_the_force() {
    let home = Home::new();
    let top = {
        let run = above_a_surface(&home, -5.0);
        home.dimos("arm enable arm").with(0);
        home.dimos("move arm 0.2 -1.6 1.7 -1.7 -1.57 0 --speed 1").with(0);
        let top = height(&home) - 0.05;
        drop(run);
        top
    };
    let _run = above_a_surface(&home, top);
    home.dimos("arm enable arm").with(0);
    home.dimos("move arm 0.2 -1.6 1.7 -1.7 -1.57 0 --speed 1").with(0);
    assert!((height(&home) - top - 0.05).abs() < 1e-3);
    // The weight of the tool is 4 N.
    let tared = outcome(&home, "arm tare arm", 0);
    assert_eq!(tared["wrench"][2], -4.0);
    let down = "move arm --by 0 0 -0.15 --linear --tcp-speed 0.02";
    let begun = home.dimos(&format!("{down} --until force=8 --stiffness 4 --json")).with(0);
    let said = begun.err.split("force: ").nth(1).and_then(|text| text.split(' ').next()).unwrap();
    let most: f64 = said.parse().unwrap();
    let ended: Value = serde_json::from_str(begun.out.trim()).unwrap();
    assert_eq!((&ended["ended_by"], &ended["state"]), (&"force".into(), &"COMPLETED".into()), "{ended}");
    let value = ended["value"].as_f64().unwrap();
    assert!((8.0..10.0).contains(&value), "{ended}");
    assert!(ended["error"].as_str().unwrap().starts_with("ended by force: "), "{ended}");
    // 2 mm at 8 N; 20 mm/s for some periods, and to brake.
    let deep = 1e3 * (top - height(&home));
    assert!((1.9..5.0).contains(&deep), "{deep} mm");
    assert!(4.0 * deep <= most && most < 30.0, "{} N of {most}", 4.0 * deep);

    // Back, and farther than the limit of time allows.
    home.dimos("move arm --by 0 0 0.05 --linear").with(0);
    let late = outcome(&home, &format!("{down} --until force=8 --until time=0.5"), 1);
    assert_eq!(late["ended_by"], "time", "{late}");
    let way = outcome(&home, &format!("{down} --until distance=0.01"), 0);
    assert_eq!((&way["ended_by"], &way["value"]), (&"distance".into(), &0.01.into()), "{way}");
    // What is not touched is no success.
    let beside = home.dimos("move arm --by 0 0 0.02 --linear --until force=8").with(1);
    assert!(beside.out.contains("its goal came first"), "{}", beside.out);
    let text = home.dimos(&format!("{down} --until force=8 --until torque=100")).with(0).out;
    assert!(text.contains("ended by force: "), "{text}");

    for (conditions, says) in [
        ("--until force=-1", "must be above 0 N"),
        ("--until weight=1", "unknown condition"),
        ("--until input=di99", "must be a digital input"),
        ("--until force=5 --replan", "cannot be used with"),
    ] {
        let refused = home.dimos(&format!("{down} {conditions}")).with(2);
        assert!(refused.err.contains(says), "{conditions}: {}", refused.err);
    }
    home.write(
        "touch.yaml",
        "steps:\n  - move: {by: {xyz: [0, 0, 0.05]}, linear: true}\n  - move: {by: {xyz: [0, 0, -0.15]}, linear: true, \
         tcp_speed: 0.02, until: {force: 8, time: 20s}}\n  - move: {by: {xyz: [0, 0, 0.03]}, linear: true}\n",
    );
    home.dimos("do touch.yaml").with(0);
    // What the planner knows to be there is touched where that is said, by the tool alone.
    let at = outcome(&home, "state", 0)["arms"][0]["pose"]["xyz"].clone();
    home.dimos(&format!("world add table --box 0.2 0.2 0.1 --at {} {} {}", at[0], at[1], top - 0.05)).with(0);
    home.dimos("move arm --by 0 0 0.03 --linear --touch table").with(0);
    let blocked = home.dimos(&format!("{down} --until force=8")).with(1);
    assert!(blocked.err.contains("table"), "{}", blocked.err);
    let unknown = home.dimos(&format!("{down} --until force=8 --touch tabel")).with(1);
    assert!(unknown.err.contains("is not in the world"), "{}", unknown.err);
    // The forearm must not.
    let forearm = home.dimos(&format!("{down} --until force=8 --touch table")).with(1);
    assert!(forearm.err.contains("arm/link3"), "{}", forearm.err);
    home.dimos("move arm --by 0 0 -0.07 --linear --tcp-speed 0.02 --until force=8 --touch table").with(0);
    home.dimos("move arm --by 0 0 0.05 --linear --touch table").with(0);

    home.write("nothing.yaml", "steps:\n  - move: {by: {xyz: [0, 0, 0.02]}, linear: true, until: {force: 8}}\n");
    let nothing = home.dimos("do nothing.yaml").with(1);
    assert!(nothing.err.contains("the goal came first"), "{}", nothing.err);
}

#[test]
fn an_input_ends_a_motion_and_an_arm_without_a_force_is_refused() {
    let (home, arm) = (Home::new(), YourArmEmulator::with(&SimOptions::default()).unwrap());
    let _run = home.run(&format!("coordinator-yourarm --no-record --set hardware.arm.address={}", arm.address()));
    arm.set_input(1, false);
    arm.record();
    let refused = home.dimos("move arm 0.5 0 0 0 0 0 --until force=5").with(1);
    assert!(refused.err.contains("reports no force"), "{}", refused.err);
    let refused = home.dimos("move arm 0.5 0 0 0 0 0 --until input=di31").with(1);
    assert!(refused.err.contains("no digital input di31"), "{}", refused.err);
    assert!(!arm.trace().iter().any(|received| matches!(received.request, Request::ServoJoints(q) if q[0] > 0.1)));

    let ended = std::thread::scope(|scope| {
        let moving = scope.spawn(|| outcome(&home, "move arm 2.5 0 0 0 0 0 --speed 0.2 --until input=di1", 0));
        std::thread::sleep(std::time::Duration::from_millis(1500));
        arm.set_input(1, true);
        moving.join().unwrap()
    });
    assert_eq!((&ended["ended_by"], &ended["value"]), (&"input".into(), &1.0.into()), "{ended}");
    let at = ended["deviation"][0]["actual"].as_f64().unwrap();
    assert!((0.05..2.0).contains(&at), "{ended}");
    // The level is there already: it ends where it begins.
    let ended = outcome(&home, &format!("move arm {} 0 0 0 0 0 --until input=di1", at + 0.3), 0);
    assert!((ended["deviation"][0]["actual"].as_f64().unwrap() - at).abs() < 0.02, "{ended}");
    arm.set_input(1, false);
    let goal = outcome(&home, &format!("move arm {} 0 0 0 0 0 --until input=di1", at + 0.1), 1);
    assert_eq!(goal["ended_by"], "goal", "{goal}");
}
