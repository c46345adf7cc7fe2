//! The blueprints of the arms in the box, with the real binary and `--sim`: each starts, moves, grips where it can,
//! records, and stops.

#[allow(dead_code, reason = "shared with other tests")]
#[path = "support/program.rs"]
mod program;

use program::{Home, eventually};
use rustix::process::Signal;

/// An arm of a blueprint.
struct Arm {
    /// Its name.
    id: &'static str,
    /// Where it is sent [rad].
    to: &'static [f64],
    /// How far its gripper is opened [m]; `None`: it has none.
    gripper: Option<f64>,
}

/// A blueprint, and its arms.
struct Case {
    blueprint: &'static str,
    arms: &'static [Arm],
}

const XARM6: &[f64] = &[0.2, -0.5, -0.9, 0.1, 1.3, -0.1];
const XARM7: &[f64] = &[0.2, -0.4, 0.1, 0.8, 0.0, 1.2, -0.1];
const LITE6: &[f64] = &[0.2, 0.3, 1.2, 0.1, 0.9, -0.1];

const CASES: &[Case] = &[
    Case { blueprint: "coordinator-xarm6", arms: &[Arm { id: "arm", to: XARM6, gripper: Some(0.06) }] },
    Case { blueprint: "coordinator-xarm7", arms: &[Arm { id: "arm", to: XARM7, gripper: Some(0.06) }] },
    Case { blueprint: "coordinator-lite6", arms: &[Arm { id: "arm", to: LITE6, gripper: None }] },
    Case {
        blueprint: "coordinator-dual-xarm",
        arms: &[
            Arm { id: "left_arm", to: XARM7, gripper: Some(0.06) },
            Arm { id: "right_arm", to: XARM6, gripper: Some(0.02) },
        ],
    },
];

fn gripper(home: &Home, id: &str) -> Option<f64> {
    let state = home.dimos("state --json").with(0).json();
    state["arms"].as_array().unwrap().iter().find(|a| a["hardware_id"] == id).unwrap()["gripper"].as_f64()
}

fn text(positions: &[f64]) -> String {
    positions.iter().map(f64::to_string).collect::<Vec<_>>().join(" ")
}

#[test]
fn every_blueprint_starts_simulated_moves_grips_records_and_stops() {
    for Case { blueprint, arms } in CASES {
        println!("{blueprint}");
        let home = Home::new();
        home.dimos(&format!("check {blueprint}")).with(0);
        let run = home.run(&format!("{blueprint} --sim"));
        assert!(run.err().contains("SIMULATED"), "{}", run.err());
        for Arm { id, to, gripper: opening } in *arms {
            let status = home.status();
            let arm = status["arms"].as_array().unwrap().iter().find(|a| a["hardware_id"] == *id).unwrap();
            assert_eq!(arm["phase"], "ready", "{blueprint}: {arm}");
            let moved = home.dimos(&format!("move {id} {}", text(to))).with(0);
            assert!(moved.out.contains("COMPLETED"), "{blueprint}: {}", moved.out);
            for (is, should) in home.positions(id).iter().zip(*to) {
                assert!((is - should).abs() <= 0.01, "{blueprint} {id}: {is} for {should}");
            }
            match opening {
                None => assert_eq!(gripper(&home, id), None),
                Some(opening) => {
                    home.dimos(&format!("arm gripper {id} {opening}")).with(0);
                    eventually("the gripper is there", || {
                        gripper(&home, id).is_some_and(|now| (now - opening).abs() < 1e-3)
                    });
                }
            }
        }
        let stopped = home.dimos("stop").with(0);
        assert_eq!(stopped.out.matches("confirmed").count(), arms.len(), "{blueprint}: {}", stopped.out);
        let first = &arms[0];
        assert!(home.dimos(&format!("arm reset {}", first.id)).with(0).out.contains("standby"));
        assert!(home.dimos(&format!("arm enable {}", first.id)).with(0).out.contains("ready"));
        home.dimos(&format!("move {} {}", first.id, text(first.to))).with(0);
        run.end(Signal::INT).with(130).says(&["its log: "]);
        let played = home.dimos("replay --last --json --rate 1000 --topics /joint_states").with(0);
        assert!(played.out.lines().count() > 20, "{blueprint} records");
    }
}

#[test]
fn what_is_wrong_with_an_xarm_is_one_line_and_exit_3() {
    let home = Home::new();
    home.dimos("run coordinator-xarm6 --set hardware.arm.address=127.0.0.1:9:9 --no-record")
        .with(3)
        .says(&["cannot connect to xarm at 127.0.0.1:9:9: connection refused", "hint: "]);
    // The emulator plays an xArm 6 with error 31, or a Lite 6.
    let simulated = "--set hardware.arm.address=sim --no-record";
    home.write("error.yaml", &with_faults("{kind: error_code, code: 31}"));
    home.dimos(&format!("run error.yaml {simulated}"))
        .with(3)
        .says(&["fault 31: a collision", "hint: clear the arm's"]);
    let run = home.run(&format!("error.yaml {simulated} --set hardware.arm.auto_enable=false"));
    let status = home.status();
    assert_eq!((&status["arms"][0]["enabled"], &status["arms"][0]["error"]["code"]), (&false.into(), &31.into()));
    run.end(Signal::INT).with(130);
    home.write("model.yaml", &with_faults("{kind: wrong_model}"));
    let said = ["expected the model xArm 6 with 6 joints, found a", "hint: is the address right?", "{model: lite6}"];
    home.dimos(&format!("run model.yaml {simulated}")).with(3).says(&said);
}

/// A blueprint of an xArm 6 whose emulator has these faults.
fn with_faults(faults: &str) -> String {
    format!(
        "hardware:
  - hardware_id: arm
    joints: {{prefix: arm, count: 6}}
    adapter_type: xarm
    address: sim
    options: {{sim: {{faults: [{faults}]}}}}
tasks:
  - {{name: traj_arm, type: trajectory, joint_names: {{hardware: arm}}}}
"
    )
}
