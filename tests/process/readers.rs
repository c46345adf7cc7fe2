//! Logs are read by other people's code: every message must mean the same to them.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Arc, Mutex};

use dimos::arm::{ArmCommand, ArmState, ControllerPose, Link, Pose, VelocitySource};
use dimos::blueprint::{Overrides, find, load};
use dimos::clock::{Mono, WallOffset};
use dimos::joint::{ControlMode, joints_of, make_joints};
use dimos::planning::scene::planning_scene::{PlannedRobot, PlanningScene};
use dimos::recording::display_messages::{Marker, MarkerArray};
use dimos::recording::log_writer::LogAttachment;
use dimos::recording::notes::channel;
use dimos::recording::recorder::{Note, Recorder, RecorderConfig};
use dimos::recording::replay::{LogReader, Payload};
use dimos::recording::robots::{LoggedRobot, LoggedRobots};
use dimos::recording::tcp_log::{TcpChain, TcpChains};
use dimos::robot::kinematics::pose;
use dimos::telemetry::describe::{ArmNames, Names, Severity};
use dimos::telemetry::{ArmSample, Cause, Event, Outcome, Phase, Reason, Sample, TaskState, TickSample};

use dimos::trajectory::{JointTrajectory, TrajectoryPoint};
use nalgebra::Isometry3;

use crate::support::skip::skip_tool;

const WALL: u64 = 1_795_270_590_123_456_789;

/// A log with every topic, every optional value present and absent, and texts that are not ASCII.
fn record(path: &Path) {
    let arm = |id: &str, dof| ArmNames { hardware_id: id.into(), joints: make_joints(id, dof) };
    let config = RecorderConfig {
        path: Some(path.to_owned()),
        run: "readers".into(),
        names: Names { arms: vec![arm("left", 7), arm("right", 6)], tasks: vec!["traj_left".into()] },
        frame_id: "coordinator".into(),
        attachments: vec![LogAttachment {
            name: "blueprint.yaml".into(),
            media_type: "application/yaml".into(),
            data: b"name: readers\n".to_vec(),
        }],
        metadata: BTreeMap::new(),
        tcps: tcps(),
        wall: WallOffset::of(Mono(5_000_000_000), WALL),
        storage: Default::default(),
    };
    let (mut ring, consumer) = rtrb::RingBuffer::new(4096);
    let (notes, receiver) = channel();
    let stamp = Mono(5_000_000_000);
    notes.send(Note::Request { id: 1, stamp, origin: None, json: r#"{"method":"move","arm":"left"}"#.into() }).unwrap();
    notes.send(Note::Log { severity: Severity::Warn, stamp, text: "Größe: 1 µm".into() }).unwrap();
    notes.send(Note::ArmText { arm: 1, text: "joint 2: überhitzt".into() }).unwrap();
    let robots = Arc::new(LoggedRobots::new(vec![logged_right_arm()]));
    notes.send(Note::Robots { stamp, robots, description: "<robot name=\"ä\"/>".into() }).unwrap();
    let marker = Marker { ns: "world/wall".into(), r#type: 1, text: "ö".into(), ..Marker::default() };
    notes.send(Note::Markers { stamp, markers: MarkerArray { markers: vec![marker] } }).unwrap();
    let point = |t: f64| TrajectoryPoint {
        time_from_start: t,
        positions: [t * 0.2; 6][..].into(),
        ..TrajectoryPoint::default()
    };
    let trajectory = JointTrajectory { joint_names: make_joints("right", 6), points: vec![point(0.0), point(1.25)] };
    notes
        .send(Note::Execute {
            id: 2,
            stamp,
            origin: None,
            task: 0,
            motion: 3,
            trajectory: Arc::new(trajectory),
            until: None,
        })
        .unwrap();
    for tick in 0..200 {
        sample(tick).into_iter().for_each(|s| ring.push(s).unwrap());
    }
    Recorder::start(config, consumer, receiver, |_| {}).unwrap().finish().unwrap();
}

/// The right arm is a YourArm, with a tool; of the left one there is no model.
fn right_arm() -> PlannedRobot {
    let registry = dimos::arms::registry();
    let loaded = load(&find("yourarm-planner").unwrap(), &Overrides { sim: true, ..Overrides::default() }, &registry);
    let mut config = loaded.blueprint.unwrap().planner.unwrap();
    config.robots[0].tool = Some(Isometry3::translation(0.0, 0.0, 0.1));
    PlanningScene::load(&config).unwrap().robots.remove(0)
}

fn tcps() -> TcpChains {
    let robot = right_arm();
    let chain = TcpChain {
        joints: (7..13).collect(),
        kinematics: robot.body.kinematics.clone(),
        link: robot.end_effector,
        root: robot.body.base,
        tool: robot.config.tool,
    };
    Arc::new(Mutex::new(vec![None, Some(chain)]))
}

/// The same arm as a log shows it.
fn logged_right_arm() -> LoggedRobot {
    let robot = right_arm();
    let names = make_joints("right", 6);
    LoggedRobot {
        name: "right".into(),
        root: pose(&robot.body.base),
        joints: robot.joints.iter().zip(7..13).zip(names).map(|((own, index), name)| (*own, index, name)).collect(),
        moved_by_others: Vec::new(),
        rest: robot.rest.clone(),
        gripper: None,
        end_effector: robot.end_effector,
        model: (*robot.model).clone(),
    }
}

/// Pose of a frame in `map`, by the latest transforms: parent and pose of each frame.
fn placed(frames: &BTreeMap<String, (String, Isometry3<f64>)>, name: &str) -> Isometry3<f64> {
    match frames.get(name) {
        Some((parent, at)) => placed(frames, parent) * at,
        None => {
            assert_eq!(name, "map");
            Isometry3::identity()
        }
    }
}

#[test]
fn the_transforms_of_a_log_place_the_tool_where_the_model_does() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("log.mcap");
    record(&path);
    let (robot, mut log) = (right_arm(), LogReader::open(&path).unwrap());
    let (mut frames, mut joints, mut checked, mut motion, mut paths) = (BTreeMap::new(), Vec::new(), 0, false, 0);
    while let Some(entry) = log.next_entry().unwrap() {
        match &entry.data {
            Payload::JointState(state) if entry.topic == "/joint_states" => joints.clone_from(&state.position),
            Payload::Other(data) if entry.topic == "/tf" || entry.topic == "/tf_static" => {
                for t in data["transforms"].as_array().unwrap() {
                    let number = |part: &str, axis: &str| t["transform"][part][axis].as_f64().unwrap();
                    let [x, y, z] = ["x", "y", "z"].map(|axis| number("translation", axis));
                    let [i, j, k, w] = ["x", "y", "z", "w"].map(|axis| number("rotation", axis));
                    let turn = nalgebra::UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(w, i, j, k));
                    let name = |value: &serde_json::Value| value.as_str().unwrap().to_owned();
                    let at = Isometry3::from_parts([x, y, z].into(), turn);
                    frames.insert(name(&t["child_frame_id"]), (name(&t["header"]["frame_id"]), at));
                }
                if entry.topic == "/tf" {
                    let (is, should) = (placed(&frames, "right_tcp"), pose(&robot.tcp_pose(&joints[7..13])));
                    let off = (is.translation.vector - should.translation.vector).norm();
                    assert!(off < 1e-9 && is.rotation.angle_to(&should.rotation) < 1e-6, "{is} instead of {should}");
                    checked += 1;
                }
            }
            Payload::Other(data) if entry.topic == "/joint_trajectory" => {
                assert_eq!(data["points"][1]["time_from_start"]["nanosec"], 250_000_000);
                motion = true;
            }
            Payload::Other(data) if entry.topic == "/markers" => {
                for marker in data["markers"].as_array().unwrap().iter().filter(|m| m["ns"] == "plan/traj_left") {
                    paths += 1;
                    assert_eq!(marker["points"].as_array().unwrap().len(), 26, "1.25 s at 20 Hz");
                }
            }
            _ => {}
        }
    }
    // From the 20th tick on, 25 a second.
    assert_eq!((checked, motion, paths), (45, true, 1));
}

#[test]
fn the_poses_of_a_log_are_those_of_its_joint_states() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("log.mcap");
    record(&path);
    let (robot, mut log, mut joints, mut poses) = (right_arm(), LogReader::open(&path).unwrap(), Vec::new(), 0);
    while let Some(entry) = log.next_entry().unwrap() {
        match entry.data {
            Payload::JointState(state) if entry.topic == "/joint_states" => joints = state.position,
            Payload::PoseStamped(message) => {
                assert_eq!((entry.topic.as_str(), message.header.frame_id.as_str()), ("/tcp/right", "map"));
                let (is, should) = (&message.pose, pose(&robot.tcp_pose(&joints[7..])));
                let [x, y, z] = should.translation.vector.into();
                let off = [is.position.x - x, is.position.y - y, is.position.z - z];
                assert!(off.iter().all(|off| off.abs() < 1e-12), "{is:?} for {should}");
                let turn = should.rotation.coords;
                let dot = is.orientation.x * turn.x + is.orientation.y * turn.y + is.orientation.z * turn.z;
                assert!(((dot + is.orientation.w * turn.w).abs() - 1.0).abs() < 1e-12, "{is:?} for {should}");
                poses += 1;
            }
            _ => {}
        }
    }
    // One for every state: at 100 Hz, from the 20th tick on.
    assert_eq!(poses, 180);
}

fn sample(tick: u64) -> Vec<Sample> {
    let deadline = Mono(5_000_000_000 + tick * 10_000_000);
    let x = tick as f64 * 0.013;
    let mut samples = Vec::new();
    for arm in 0..2u16 {
        let state = ArmState {
            seq: if arm == 1 && tick < 20 { 0 } else { tick + 1 },
            stamp: Mono(deadline.0 - 777_777),
            dof: 7 - usize::from(arm),
            position: joints_of(&[x.sin(), -0.0, 1e-310, x, 2.0, 3.0, 4.0]),
            velocity: joints_of(&[x.cos(), 0.1 + 0.2]),
            velocity_source: if tick < 40 { VelocitySource::Absent } else { VelocitySource::Estimated },
            effort: (arm == 0 && tick % 50 > 25).then(|| joints_of(&[x; 7])),
            gripper: (arm == 0).then_some(x * 1e-3),
            pose: tick
                .is_multiple_of(2)
                .then_some(ControllerPose::of_flange(Pose { xyz: [x, 0.2, 0.3], rpy: [0.0, -1.0, x] })),
            wrench: (arm == 1).then_some([1.0, 2.0, x, 4.0, 5.0, 6.0]),
            mode: ControlMode::ServoPosition,
            enabled: tick > 2,
            error: if arm == 1 && tick > 100 { -31 } else { 0 },
            link: if arm == 1 && tick > 100 { Link::Faulted } else { Link::Up },
            self_held: false,
            written: tick,
            ..ArmState::default()
        };
        let mode = [None, Some(ControlMode::ServoPosition), Some(ControlMode::Velocity), Some(ControlMode::Torque)];
        let mode = mode[(tick / 10 % 4) as usize];
        let command = ArmCommand { seq: tick, mode, values: joints_of(&[x; 7]), ..ArmCommand::default() };
        samples.push(Sample::Arm(ArmSample { arm, state, command, phase: Phase::Ready, cause: Cause::None }));
    }
    match tick {
        5 => samples.push(Sample::Event(tick, Event::Request(1, Outcome::Accepted))),
        30 => samples.push(Sample::Event(tick, Event::Request(2, Outcome::Accepted))),
        90 => samples.push(Sample::Event(tick, Event::Task(0, TaskState::Aborted, Reason::GoalTolerance(2, 0.03)))),
        101 => samples.push(Sample::Event(tick, Event::Arm(1, Phase::Held, Cause::Fault(-31)))),
        _ => {}
    }
    samples.push(Sample::Tick(TickSample { tick, deadline, late_ns: 20_000 + tick, ..TickSample::default() }));
    samples
}

/// Writes the log and what dimos reads from it, one JSON object a line.
fn log_and_expected(folder: &Path) -> (PathBuf, PathBuf) {
    let (log, expected) = (folder.join("log.mcap"), folder.join("expected.ndjson"));
    record(&log);
    let mut reader = LogReader::open(&log).unwrap();
    let mut lines = String::new();
    while let Some(entry) = reader.next_entry().unwrap() {
        lines.push_str(&serde_json::to_string(&entry).unwrap());
        lines.push('\n');
    }
    std::fs::write(&expected, lines).unwrap();
    (log, expected)
}

fn succeed(command: &mut Command) -> String {
    let output = command.output().unwrap();
    let out = String::from_utf8_lossy(&output.stdout).into_owned();
    let err = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{command:?}\n{out}{err}");
    out
}

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

#[test]
fn python_readers_find_the_same_messages() {
    let python = root().join(".venv/bin/python");
    if !python.exists() {
        return skip_tool("the Python readers in .venv");
    }
    let folder = tempfile::tempdir().unwrap();
    let (log, expected) = log_and_expected(folder.path());
    let said = succeed(Command::new(python).arg(root().join("tests/readers/read_log.py")).args([log, expected]));
    assert_eq!(said.lines().filter(|line| line.ends_with("are the same")).count(), 3, "{said}");
}

#[test]
fn foxgloves_readers_find_the_same_messages() {
    if !root().join("tests/readers/node_modules/@mcap/core").exists() {
        return skip_tool("Foxglove's readers in tests/readers/node_modules");
    }
    let folder = tempfile::tempdir().unwrap();
    let (log, expected) = log_and_expected(folder.path());
    let said = succeed(Command::new("node").arg(root().join("tests/readers/read_log.mjs")).args([log, expected]));
    assert!(said.contains("are the same"), "{said}");
}

/// `make test-rerun` installs rerun and asks for this one; it is too large for `make test-tools`.
#[test]
fn rerun_finds_nothing_wrong() {
    if std::env::var("DIMOS_RERUN").as_deref() != Ok("1") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let (log, _) = log_and_expected(folder.path());
    let rerun = root().join(".venv/bin/rerun");
    succeed(Command::new(&rerun).args(["mcap", "check", "--full"]).arg(&log));
    let rrd = folder.path().join("log.rrd");
    succeed(Command::new(&rerun).args(["mcap", "convert"]).arg(&log).arg("-o").arg(&rrd));
    let printed = succeed(Command::new(&rerun).args(["rrd", "print", "-vv"]).arg(&rrd));
    for entity in ["/joint_states", "/rosout", "/dimos/tick"] {
        assert!(printed.contains(entity), "{entity} is not in the recording");
    }
    assert!(printed.contains("Scalars"), "joint states have become curves");
}
