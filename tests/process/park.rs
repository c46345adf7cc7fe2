//! `on_exit: park`: what the emulated servos of an SO-101 have received at the end of a run.

use dimos::arms::so101::emulator::{Servos, start};
use dimos::hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};
use dimos::hardware::sim::arm::HasArm;
use dimos::hardware::sim::faults::{Fault, FaultKind};
use dimos::hardware::sim::serial_server::SerialServer;
use dimos::rpc::api::{Move, Shutdown, Stop};
use rustix::process::Signal;
use serde_json::json;

use crate::support::program::{Home, Started, eventually};

const PARK: [f64; 5] = [-0.4, -1.2, 1.1, 0.9, 0.3];
const START: [f64; 6] = [0.3, -0.5, 0.4, 0.2, 0.1, 0.5];

struct Rig {
    home: Home,
    servos: SerialServer<Servos>,
}

impl Rig {
    fn new() -> Self {
        let options = json!({"sim": {"initial_positions": START}});
        let config = AdapterConfig { hardware_id: "arm".into(), address: String::new(), dof: 5, options };
        let servos = start(&config, &EmulatorAddress::Pty).unwrap();
        let home = Home::new();
        let text = format!(
            "
name: parked
include: [coordinator-so101]
hardware:
  - {{hardware_id: arm, address: {}, on_exit: park, park_pose: {PARK:?}}}
",
            servos.address()
        );
        home.write("parked.yaml", &text);
        Self { home, servos }
    }

    /// Distance of the joint that is furthest from a pose [rad].
    fn off(&self, pose: &[f64]) -> f64 {
        let truth = self.servos.true_positions().unwrap();
        pose.iter().zip(&truth[..5]).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
    }

    fn motors_on(&self) -> bool {
        self.servos.with(|servos, _| (0..6).all(|joint| servos.arm().motor(joint)))
    }

    /// Waits until the arm is on its way.
    #[track_caller]
    fn leaves(&self) {
        eventually("the arm moves", || self.off(&START) > 0.1);
    }

    /// The end of a run whose arm was not parked: why, and that its motors hold it, away from the park pose.
    #[track_caller]
    fn not_parked(&self, run: Started, code: i32, why: &str) {
        let why = format!("warning: arm: not parked: {why}");
        run.wait().with(code).says(&[&why, "arm: motors stay on and hold the pose"]);
        assert!(self.motors_on() && self.off(&PARK) > 0.2, "{}", self.off(&PARK));
    }
}

#[test]
fn an_arm_is_parked_and_disabled_at_the_end() {
    let rig = Rig::new();
    let run = rig.home.run("parked.yaml");
    run.until("it moves to its park pose, then motors off");
    assert!(rig.off(&START) < 0.01 && rig.motors_on(), "nothing moves at the start");
    let ended = run.end(Signal::INT).with(130).says(&["SIGINT", "arm: parked; motors off"]);
    assert!(!ended.err.contains("warning"), "{}", ended.err);
    assert!(!rig.servos.with(|servos, _| (0..6).any(|joint| servos.arm().motor(joint))));
    // Upper arm and forearm fall from there, once their motors are off.
    let goals = rig
        .servos
        .with(|servos, _| [1, 2].map(|servo| u16::from_le_bytes([servos.byte(servo, 42), servos.byte(servo, 43)])));
    let counts = [1, 2].map(|joint: usize| (2048.0 + PARK[joint] * 4096.0 / std::f64::consts::TAU).round() as u16);
    assert_eq!(goals, counts);
    let truth = rig.servos.true_positions().unwrap();
    assert!((truth[0] - PARK[0]).abs() < 0.01 && (truth[3] - PARK[3]).abs() < 0.01, "{truth:?}");
    let log = rig.home.logs().remove(0);
    rig.home.dimos(&format!("replay {} --verify", log.display())).with(0);
}

#[test]
fn an_arm_that_was_lost_is_not_parked() {
    let rig = Rig::new();
    let run = rig.home.run("parked.yaml --no-record");
    rig.servos.inject(Fault::new(FaultKind::Silent).lasting(0.5)).unwrap();
    eventually("the arm is held, and answers again", || {
        let arm = &rig.home.status()["arms"][0];
        arm["phase"] == "held" && arm["link"] == "up" && arm["state_age_ms"].as_f64().is_some_and(|age| age < 50.0)
    });
    rig.home.dimos("down").with(0).says(&["warning: arm: not parked: the arm is held"]);
    rig.not_parked(run, 0, "the arm is held");
    assert!(rig.off(&START) < 0.01);
}

#[test]
fn no_arm_is_parked_beside_one_that_is_held() {
    let rig = Rig::new();
    let text = "
name: two
include: [parked]
hardware:
  - {hardware_id: other, adapter_type: mock, joints: {prefix: other, count: 2}}
tasks:
  - {name: traj_other, type: trajectory, joint_names: {hardware: other}}
";
    rig.home.write("two.yaml", text);
    let run = rig.home.run("two.yaml --no-record");
    rig.home.dimos("stop other").with(0);
    rig.home.dimos("down").with(0);
    rig.not_parked(run, 0, "other is held");
    assert!(rig.off(&START) < 0.01);
}

/// The arm decelerates, and has not set off to its park pose.
#[test]
fn a_stop_and_a_second_signal_before_the_way_to_the_park_pose_are_not_lost() {
    let moving = || {
        let rig = Rig::new();
        let run = rig.home.run("parked.yaml --no-record");
        rig.home.dimos("move arm 1.2 -0.5 0.4 0.2 0.1 --no-wait").with(0);
        rig.leaves();
        (rig, run)
    };
    let (rig, run) = moving();
    run.signal(Signal::TERM);
    rig.home.dimos("stop").with(0);
    rig.not_parked(run, 143, "the arm is held");

    let (rig, run) = moving();
    run.signal(Signal::TERM);
    run.until("decelerating to rest");
    run.signal(Signal::INT);
    rig.not_parked(run, 143, "it was interrupted by a second signal");

    let (cancelled, run) = moving();
    run.signal(Signal::TERM);
    cancelled.home.dimos("cancel").with(0);
    cancelled.not_parked(run, 143, "it was cancelled");

    // Its base turned towards the target of the motion; the park pose is on the other side.
    assert!(rig.servos.true_positions().unwrap()[0] > START[0], "{:?}", rig.servos.true_positions());
}

#[test]
fn a_stop_and_a_second_signal_end_the_way_to_the_park_pose() {
    let rig = Rig::new();
    let run = rig.home.run("parked.yaml --no-record");
    run.signal(Signal::TERM);
    rig.leaves();
    run.signal(Signal::INT);
    rig.not_parked(run, 143, "it was interrupted by a second signal");

    let rig = Rig::new();
    let run = rig.home.run("parked.yaml --no-record");
    // Connected before: the way takes less time than some programs to start on a busy computer.
    let mut client = rig.home.client();
    run.signal(Signal::TERM);
    rig.leaves();
    let refused = format!("{:?}", client.call(Move::new("arm", [0.0; 5], 0.5)).unwrap_err());
    assert!(refused.contains("ShuttingDown"), "{refused}");
    client.call(Shutdown {}).expect("it does shut down");
    client.call(Stop::default()).unwrap_or_else(|e| panic!("{e}: {}", run.err()));
    rig.not_parked(run, 143, "arm is held (stopped by an operator)");
}

#[test]
fn a_lost_terminal_parks_nothing() {
    let rig = Rig::new();
    let ended = rig.home.run("parked.yaml --no-record").end(Signal::HUP);
    ended.with(130).says(&["SIGHUP: decelerating to rest, then releasing", "arm: motors stay on and hold the pose"]);
    assert!(rig.motors_on() && rig.off(&START) < 0.01);
}

/// An arm that has arrived waits for another one, and is held meanwhile.
#[test]
fn an_arm_that_is_held_after_it_has_arrived_keeps_its_motors() {
    let rig = Rig::new();
    let text = "
name: two
include: [parked]
hardware:
  - {hardware_id: other, adapter_type: mock, joints: {prefix: other, count: 1}, on_exit: park, park_pose: [0]}
tasks:
  - {name: traj_other, type: trajectory, joint_names: {hardware: other}}
";
    rig.home.write("two.yaml", text);
    let run = rig.home.run("two.yaml --no-record");
    run.signal(Signal::TERM);
    eventually("the other one, which is there already, has arrived", || {
        let status = rig.home.status();
        let task = status["tasks"].as_array().unwrap().iter().find(|task| task["name"] == "traj_other").unwrap();
        rig.off(&START) > 0.05 && task["state"] == "COMPLETED"
    });
    rig.home.dimos("stop other").with(0);
    run.wait().with(143).says(&["warning: other: not parked: it was held after it had arrived"]);
}
