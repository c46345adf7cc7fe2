//! Every order has its own answer, from the arm's device thread or the tick; none is guessed from what happens beside
//! it.

use std::sync::LazyLock;
use std::time::{Duration, Instant};

use dimos::hardware::adapter::AdapterError;
use dimos::hardware::registry::AdapterSpec;
use dimos::rpc::Code;
use dimos::rpc::api::Stop;
use dimos::rpc::client::Client;
use dimos::rpc::run_dir::RunDir;
use dimos::runtime::{Record, Run};

use crate::support::program::eventually;
use crate::support::wrapped::{ROW, Wrapped};

/// Longer than a gripper was once waited for: a period and 20 ms.
const SLOW: Duration = Duration::from_millis(300);

const BLUEPRINT: &str = "
hardware: [{hardware_id: arm, adapter_type: wrapped, joints: {prefix: arm, count: 6}}]
tasks: [{name: traj_arm, type: trajectory, joint_names: {hardware: arm}}]
";

fn start(row: AdapterSpec, folder: &tempfile::TempDir) -> Run {
    let run = Run::from_yaml("orders", BLUEPRINT).adapters(&[row]).record(Record::Off);
    run.folder(RunDir::closed(folder.path())).start().unwrap()
}

#[test]
fn a_set_point_that_is_refused_beside_a_gripper_order_is_not_blamed_on_the_gripper() {
    static ARM: LazyLock<Wrapped> = LazyLock::new(Wrapped::new);
    let folder = tempfile::tempdir().unwrap();
    let run = start(AdapterSpec { create: |_| Ok(Box::new(ARM.clone())), ..ROW }, &folder);
    let refuse = |what: &str, why: &str| ARM.mock.fail(what, AdapterError::Rejected(why.to_owned()));
    let written = || run.status().arms[0].counters["writes"];
    for opening in [0.03, 0.04, 0.05, 0.06] {
        let before = written();
        refuse("write_joint_positions", "this setpoint is not for me");
        run.gripper("arm", opening).unwrap();
        // Three refusals in a row are a connection that does not work.
        eventually("setpoints are taken again", || written() >= before + 3);
    }
    refuse("write_gripper_position", "something is between the fingers");
    let refused = run.gripper("arm", 0.0).unwrap_err();
    assert_eq!(refused.code, Code::DeviceRefused);
    assert!(refused.message.contains("something is between the fingers"), "{}", refused.message);
    run.gripper("arm", 0.01).unwrap();
    assert_eq!(run.status().arms[0].phase, "ready", "a refused gripper costs the joints nothing");
}

#[test]
fn a_refusal_that_takes_its_time_is_still_the_answer_to_its_order() {
    static ARM: LazyLock<Wrapped> = LazyLock::new(|| Wrapped { gripper_takes: SLOW, ..Wrapped::new() });
    let folder = tempfile::tempdir().unwrap();
    let run = start(AdapterSpec { create: |_| Ok(Box::new(ARM.clone())), ..ROW }, &folder);
    ARM.mock.fail("write_gripper_position", AdapterError::Rejected("too far".into()));
    let began = Instant::now();
    let refused = run.gripper("arm", 0.07).unwrap_err();
    assert!(began.elapsed() >= SLOW);
    assert!(refused.code == Code::DeviceRefused && refused.message.contains("too far"), "{}", refused.message);
}

#[test]
fn the_answer_has_the_phase_that_the_order_led_to() {
    static ARM: LazyLock<Wrapped> = LazyLock::new(Wrapped::new);
    let folder = tempfile::tempdir().unwrap();
    let run = start(AdapterSpec { create: |_| Ok(Box::new(ARM.clone())), ..ROW }, &folder);
    for _ in 0..3 {
        assert_eq!(run.disable("arm").unwrap().phase, "disabled");
        assert_eq!(run.enable("arm").unwrap().phase, "ready");
        assert_eq!(run.stop_arms().unwrap().arms["arm"].text(), "confirmed");
        assert_eq!(run.reset("arm").unwrap().phase, "standby");
        assert_eq!(run.enable("arm").unwrap().phase, "ready");
    }
}

/// It was held again: its joints were said to move while it was being enabled.
#[test]
fn an_arm_that_is_enabled_while_it_still_brakes_is_ready_once_it_is_at_rest() {
    let blueprint = "
hardware: [{hardware_id: arm, adapter_type: mock, joints: {prefix: arm, count: 1}, limits: {acceleration: 0.1}}]
tasks: [{name: traj_arm, type: trajectory, joint_names: {hardware: arm}}]
";
    let folder = tempfile::tempdir().unwrap();
    let run =
        Run::from_yaml("braking", blueprint).record(Record::Off).folder(RunDir::closed(folder.path())).start().unwrap();
    let speed = || run.state().arms[0].joints[0].velocity.unwrap().abs();
    let position = || run.state().arms[0].joints[0].position.unwrap();
    run.move_arm("arm", &[2.0], 1.0).unwrap();
    eventually("the arm moves", || speed() > 0.3);
    let mut client = Client::connect("braking", run.socket().unwrap()).unwrap();
    // It is answered when the arm has stopped, 3 s later.
    let stop = std::thread::spawn(move || client.call(Stop::default()).unwrap());
    eventually("the arm is held", || run.status().arms[0].phase == "held");
    run.reset("arm").unwrap();
    let at_reset = position();
    assert_eq!(run.enable("arm").unwrap().phase, "ready");
    assert!(position() - at_reset > 0.01, "too late: it brakes for 3 s");
    assert!(speed() < 0.01);
    stop.join().unwrap();
    let arm = &run.status().arms[0];
    assert_eq!((arm.phase.as_str(), &arm.cause), ("ready", &None));
    run.move_arm("arm", &[0.0], 0.5).unwrap();
}
