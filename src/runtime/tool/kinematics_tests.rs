//! Runs with emulated arms whose dimensions are not those of the data sheet, and with models that do not fit.

use nalgebra::{Matrix4, Vector3};
use serde_json::json;

use crate::runtime::{Record, Run};
use dimos_core::arm::Dh;
use dimos_core::arm::test_dh::{FAR_AWAY, product};
use dimos_rpc::api::{Method, Plan, RobotDescription};
use dimos_rpc::report::{ArmStateReport, PoseReport};
use dimos_rpc::run_dir::RunDir;
use dimos_rpc::{Code, RpcError};

/// Starts a run of a shipped blueprint with these settings.
fn run(blueprint: &str, settings: &[(&str, String)]) -> (tempfile::TempDir, Run) {
    let folder = tempfile::tempdir().unwrap();
    let mut builder = Run::from_name(blueprint).unwrap().record(Record::Off).folder(RunDir::closed(folder.path()));
    for (path, value) in settings {
        builder = builder.set(path, value);
    }
    (folder, builder.start().unwrap())
}

fn state(run: &Run) -> ArmStateReport {
    run.state().arms.remove(0)
}

fn far(pose: &PoseReport, from: &Matrix4<f64>) -> f64 {
    (Vector3::from(pose.xyz) - from.fixed_view::<3, 1>(0, 3)).norm()
}

/// Returns parameters of a UR5e with differences of up to 20 mm at the flange, and with joints far away.
fn arms() -> [[Dh; 6]; 2] {
    let mut large = dimos_arms::ur::model::Model::Ur5e.dh();
    (large[1].a, large[2].d, large[5].d) = (large[1].a + 0.009, 0.006, large[5].d + 0.005);
    (large[0].theta, large[2].alpha) = (0.006, 0.004);
    [large, FAR_AWAY]
}

#[test]
fn poses_of_a_run_are_those_of_the_arm_that_is_connected() {
    for own in arms() {
        let sim = json!({"kinematics": own, "tcp_offset": [0, 0, 0.12, 0, 0, 0]}).to_string();
        let (_folder, run) = run("ur5e-planner", &[("hardware.arm.options.sim", sim)]);
        let state = state(&run);
        let q: Vec<f64> = state.joints.iter().map(|joint| joint.position.unwrap()).collect();
        let flange = product(&own, &q);
        let model = far(state.pose.as_ref().unwrap(), &flange);
        let controller = far(state.device_pose.as_ref().unwrap(), &flange);
        assert!(model < 1e-4 && controller < 1e-4, "model {model} m, controller {controller} m");
        let tool = far(state.device_tool_pose.as_ref().unwrap(), &flange);
        assert!((tool - 0.12).abs() < 1e-4, "{tool} m");
        let notes = run.status().arms.remove(0).model_notes;
        assert!(notes[0].starts_with("factory kinematics of serial 20195500123"), "{notes:?}");
        assert_eq!(notes.len(), 1, "the model fits: {notes:?}");
        // The description has the same arm.
        let urdf = run.call(RobotDescription {}).unwrap().urdf.unwrap();
        let described = dimos_robot::urdf::from_text("described", &urdf).unwrap();
        let named = described.joints.iter().filter(|joint| joint.is_independent());
        let named = named.map(|joint| joint.name.clone()).zip(q).collect();
        let links = described.link_poses(&described.positions(&named));
        let off = |link: &nalgebra::Isometry3<f64>| {
            (link.translation.vector - flange.fixed_view::<3, 1>(0, 3).into_owned()).norm()
        };
        let nearest = links.iter().map(off).fold(f64::INFINITY, f64::min);
        assert!(nearest < 1e-4, "the flange of the description is {nearest} m off");
        run.stop();
    }
}

#[test]
fn a_planner_without_the_arm_uses_what_was_kept_of_it_and_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let blueprint = |address: &str| {
        let loaded = Run::from_name("ur5e-planner").unwrap().set("hardware.arm.address", address).check();
        loaded.blueprint.unwrap()
    };
    let mut own = blueprint("127.0.77.3");
    let address = super::address(&own.arms[0]);
    let kinematics = dimos_core::arm::FactoryKinematics {
        nominal: dimos_arms::ur::model::Model::Ur5e.dh().to_vec(),
        actual: Some(arms()[1].to_vec()),
        checksum: "0123456789abcdef0123".into(),
    };
    let kept = super::KeptKinematics { adapter: "ur".into(), address, serial: "42".into(), kinematics };
    super::kept_kinematics::keep(folder.path(), &kept).unwrap();
    let lines = super::use_kept_in(folder.path(), &mut own);
    assert_eq!(lines, ["arm: factory kinematics of serial 42, as it was read last (checksum 0123456789abcdef)"]);
    let places = |blueprint: &crate::blueprint::Blueprint| blueprint.planner.as_ref().unwrap().robots[0].places.len();
    assert_eq!(places(&own), 7, "six joints, and the flange on the last link");
    for other in ["127.0.77.4", "sim"] {
        let mut blueprint = blueprint(other);
        assert_eq!(super::use_kept_in(folder.path(), &mut blueprint), Vec::<String>::new());
        assert_eq!(places(&blueprint), 0, "{other}");
    }
}

#[test]
fn models_of_the_shipped_planners_fit_and_nothing_is_said() {
    for blueprint in ["ur5e-planner", "xarm6-planner", "xarm7-planner", "fr3-planner", "yourarm-planner"] {
        let (_folder, run) = run(blueprint, &[]);
        assert_eq!(run.status().arms.remove(0).model_notes, Vec::<String>::new(), "{blueprint}");
        let compared = run.handle.service().compared();
        assert_eq!(compared, [true], "{blueprint}");
        run.stop();
    }
}

/// Asks for a plan that moves the first joint by 0.2 rad.
fn plan(run: &Run) -> Result<u64, RpcError> {
    let mut goal: Vec<f64> = state(run).joints.iter().map(|joint| joint.position.unwrap()).collect();
    goal[0] += 0.2;
    let plan: Plan = serde_json::from_value(json!({"goals": [{"robot": "arm", "joints": goal}]})).unwrap();
    plan.check().unwrap();
    run.call(plan).map(|begun| begun.plan)
}

#[test]
fn a_model_that_does_not_fit_is_not_planned_with() {
    // The link before the flange: 0.1 m off.
    let wrong = ("planner.robots.arm.flange_link", "link6".to_owned());
    let (_folder, refusing) = run("yourarm-planner", std::slice::from_ref(&wrong));
    let notes = refusing.status().arms.remove(0).model_notes;
    assert_eq!(notes.len(), 1, "{notes:?}");
    assert!(notes[0].ends_with("planned motions are refused"), "{notes:?}");
    let refused = plan(&refusing).unwrap_err();
    assert_eq!(refused.code, Code::ModelMismatch, "{refused}");
    assert!(refused.message.contains("by the model and at"), "both poses: {refused}");
    refusing.stop();
    let allowed = ("planner.robots.arm.model_mismatch", "allow".to_owned());
    let (_folder, allowing) = run("yourarm-planner", &[wrong, allowed]);
    plan(&allowing).unwrap();
    let notes = allowing.status().arms.remove(0).model_notes;
    assert!(notes[0].contains("allowed by `model_mismatch`"), "{notes:?}");
    allowing.stop();
}

#[test]
fn a_small_difference_is_said_and_adds_to_the_padding() {
    // The joint reads 0.02 rad more than where the controller computes its pose.
    let fault = json!([{"kind": "misread", "joint": 1, "amount": 0.02, "duration": 600}]).to_string();
    let (_folder, run) = run("xarm6-planner", &[("hardware.arm.options.sim.faults", fault)]);
    let notes = run.status().arms.remove(0).model_notes;
    assert!(notes.iter().any(|note| note.ends_with("added to the padding")), "{notes:?}");
    let paddings = run.handle.service().paddings();
    let pad = paddings["arm_joint1"];
    assert!((0.005..0.03).contains(&pad), "{paddings:?}");
    plan(&run).unwrap();
    let planner = run.handle.service().plans.port().unwrap();
    assert!((planner.now().robots[0].body.apart - pad).abs() < 1e-3, "the planner has it");
    run.stop();
}

#[test]
fn what_cannot_be_compared_is_said() {
    let old =
        ("hardware.arm.options.sim", json!({"software": "5.4.0", "tcp_offset": [0, 0, 0.1, 0, 0, 0]}).to_string());
    let (_folder, run) = run("ur5e-planner", &[old]);
    let notes = run.status().arms.remove(0).model_notes;
    assert_eq!(notes, ["not compared with the arm: its controller does not report its tool offset"]);
    let state = state(&run);
    assert_eq!((state.device_pose, state.device_pose_missing.as_deref()), (None, Some("tool offset")));
    assert!(state.device_tool_pose.is_some());
    run.stop();
}
