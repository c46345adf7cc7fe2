//! `replay --verify`: what was recorded comes out the same again, and what was changed is found.

use std::path::{Path, PathBuf};

use dimos::arm::Link;
use dimos::control::config::{
    ArmConfig, CartesianParams, FollowParams, LeaderJoint, ServoParams, TaskConfig, TaskKind, TaskKinematics,
    TrajectoryParams, VelocityParams,
};
use dimos::control::point_to_point::point_to_point;
use dimos::control::request::{Goal, Request};
use dimos::control::task_spec::TaskTable;
use dimos::joint::{JointLimits, joints_of, make_joints};
use dimos::recording::cdr::Encoder;
use dimos::recording::messages::{ArmOutput, JointState, Text, Tick};
use dimos::recording::wire::{Field, Message};
use dimos::replay::recorded::RecordedError;
use dimos::replay::verify::{Finding, Verification};
use dimos::robot::kinematics::Kinematics;
use dimos::robot::{Source, load};
use dimos::telemetry::TaskState;

use crate::support::tampered::{rewrite, tamper, without_attachments};
use crate::support::virtual_run::{VirtualRun, one_arm};

fn verify(log: &Path) -> Result<Verification, RecordedError> {
    dimos::replay::verify::verify(log, &TaskTable::builtin())
}

pub(super) fn reproducible(log: &Path) -> Verification {
    let found = verify(log).unwrap();
    assert_eq!(found.finding, Finding::Reproducible);
    found
}

/// A run of one arm with everything that can happen to it, and where its log is.
fn eventful(folder: &Path) -> (PathBuf, u64) {
    let mut config = one_arm(6);
    let task = |name: &str, kind, priority, auto_start| TaskConfig {
        name: name.into(),
        kind,
        joints: (0..6).collect(),
        priority,
        auto_start,
    };
    let by_itself = ServoParams { timeout: 0.3, default_positions: Some(vec![0.05; 6]) };
    config.tasks.push(task("servo", TaskKind::new("servo", &by_itself), 20, true));
    config.tasks.push(task("velocity", TaskKind::new("velocity", &VelocityParams::default()), 30, false));
    config.tasks.push(task("other", TaskKind::new("trajectory", &TrajectoryParams::default()), 20, false));
    let log = folder.join("eventful.mcap");
    let mut run = VirtualRun::start(&config, &log);
    let limits = JointLimits::uniform(6, 3.0, 2.0).with_defaults();
    let motion = |from: &[f64], to: f64| point_to_point(&make_joints("arm", 6), from, &[to; 6], &limits, 0.9).unwrap();
    let go = |run: &mut VirtualRun, to: f64| {
        let from = run.states[0].position[..6].to_vec();
        run.execute(0, &motion(&from, to));
    };
    let steps = |run: &mut VirtualRun, n: usize| (0..n).for_each(|_| run.step());
    run.step();
    run.ask(Request::Enabled { arm: 0, outside: false });
    steps(&mut run, 120); // the servo task starts automatically, and times out
    go(&mut run, 0.5);
    go(&mut run, 0.6); // refused: it is executing already
    steps(&mut run, 30);
    run.ask(Request::Speed { fraction: 0.1 + 0.2 });
    run.ask(Request::Pause { on: true });
    steps(&mut run, 7);
    run.ask(Request::Pause { on: false });
    steps(&mut run, 7);
    run.ask(Request::Speed { fraction: 1.0 });
    steps(&mut run, 7);
    run.ask(Request::Cancel { task: Some(0) });
    run.ask(Request::Gripper { arm: 0, opening: 0.1 + 0.2, force: Some(0.1 + 0.7), speed: None });
    steps(&mut run, 60);
    for k in 0..80 {
        // A stream at 50 Hz, then a jump in it.
        if k % 2 == 0 {
            let q = run.states[0].position[0] + 0.004 * f64::from(k).sin();
            run.ask(Request::Servo { task: 1, target: joints_of(&[q, q, q, q, q, if k == 78 { 2.0 } else { q }]) });
        }
        run.step();
    }
    for request in [Request::Reset { arm: 0 }, Request::Enabled { arm: 0, outside: false }] {
        run.ask(request);
        steps(&mut run, 40);
    }
    for _ in 0..50 {
        run.ask(Request::Velocity { task: 2, target: joints_of(&[0.3, -0.2, 1e9, 0.1, 0.0, -0.0]) });
        run.step();
    }
    go(&mut run, 0.0); // loses its joints to the stream of velocities, or waits for the change of mode
    steps(&mut run, 80);
    // The arm reports no velocities from here on.
    run.states[0].velocity_source = dimos::arm::VelocitySource::Absent;
    go(&mut run, -0.4);
    steps(&mut run, 20);
    run.overrun(1);
    run.overrun(3);
    steps(&mut run, 10);
    run.overrun(15); // more than an arm may lose: it holds
    steps(&mut run, 20);
    for request in [Request::Reset { arm: 0 }, Request::Enabled { arm: 0, outside: false }] {
        run.ask(request);
        steps(&mut run, 40);
    }
    go(&mut run, 0.3);
    steps(&mut run, 25);
    run.states[0].error = 31;
    steps(&mut run, 40);
    run.ask(Request::Reset { arm: 0 }); // refused: the fault persists
    run.states[0].error = 0;
    run.states[0].stop_input_open = true;
    steps(&mut run, 2);
    run.ask(Request::Reset { arm: 0 }); // refused: the stop input is open
    steps(&mut run, 2);
    run.states[0].stop_input_open = false;
    for request in [Request::Reset { arm: 0 }, Request::Enabled { arm: 0, outside: false }] {
        run.ask(request);
        steps(&mut run, 40);
    }
    run.states[0].stop_input_open = true;
    steps(&mut run, 10);
    run.states[0].stop_input_open = false;
    run.states[0].position[2] = f64::NAN;
    run.step();
    run.states[0].position[2] = 0.1;
    run.states[0].error = 0;
    steps(&mut run, 2);
    run.ask(Request::Stop { arm: None });
    run.ask(Request::Stop { arm: Some(9) });
    run.ask(Request::Servo { task: 1, target: [f64::NAN; 16] });
    run.ask(Request::PrepareDisable { arm: 0 });
    steps(&mut run, 5);
    run.ask(Request::Shutdown);
    steps(&mut run, 50);
    let ticks = run.tick;
    run.finish();
    (log, ticks)
}

#[test]
fn whatever_happens_to_an_arm_comes_out_the_same_again() {
    let folder = tempfile::tempdir().unwrap();
    let (log, ticks) = eventful(folder.path());
    let found = reproducible(&log);
    assert_eq!(found.ticks, ticks);
    assert!(found.requests > 100 && found.events > 130, "{found:?}");
}

/// An end effector that is taken to poses and moved with twists, past everything that can stop it.
#[test]
fn motions_of_an_end_effector_come_out_the_same_again() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = one_arm(6);
    let model = load(&Source::new("builtin:yourarm")).into_model().unwrap();
    let (kinematics, link) = (Kinematics::whole(&model).unwrap(), model.link_index("flange").unwrap());
    let robot = TaskKinematics::new(kinematics, link);
    for (name, kind, priority) in [("poses", "cartesian_ik", 20), ("twists", "eef_twist", 30)] {
        config.tasks.push(TaskConfig {
            name: name.into(),
            kind: TaskKind::new(kind, &CartesianParams::default()).of_robot(robot.clone()),
            joints: (0..6).collect(),
            priority,
            auto_start: false,
        });
    }
    let log = folder.path().join("steered.mcap");
    let mut run = VirtualRun::start(&config, &log);
    run.states[0].position = joints_of(&[0.1, -0.3, 0.6, 0.0, 0.8, 0.2]);
    run.step();
    run.ask(Request::Enabled { arm: 0, outside: false });
    (0..40).for_each(|_| run.step());
    for k in 0..400u32 {
        let (turn, t) = (0.1 * f64::from(k), f64::from(k) * 0.01);
        let pose = Goal::Pose { position: [0.3 + 0.05 * t.sin(), 0.1 * t, 0.4], orientation: [0.0, 1.0, 0.0, 0.0] };
        let linear = [0.1 * turn.cos(), 0.1 * turn.sin(), if k == 333 { f64::NAN } else { 0.02 }];
        match k % 200 {
            0..100 if k % 2 == 0 => run.ask(Request::CartesianTarget { task: 1, goal: pose }),
            120..180 => run.ask(Request::CartesianTarget {
                task: 2,
                goal: Goal::Twist { linear, angular: [0.1 + 0.2, 0.0, -0.0], tool: k > 200 },
            }),
            185 => run.ask(Request::Cancel { task: Some(2) }),
            _ => {}
        }
        run.step();
    }
    let moved = run.states[0].position;
    assert!((moved[0] - 0.1).abs() > 0.05, "nothing moved: {moved:?}");
    run.finish();
    let found = reproducible(&log);
    assert!(found.ticks > 400 && found.requests > 200, "{found:?}");
}

/// An arm that follows another one, with everything that can happen to its leader.
#[test]
fn an_arm_that_follows_another_does_the_same_again() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = one_arm(6);
    config.arms.push(ArmConfig { name: "leader".into(), ..config.arms[0].clone() });
    let led_by = |joint| LeaderJoint { joint, scale: -0.7, offset: 0.1 + 0.2, endless: false };
    config.tasks.push(TaskConfig {
        name: "follow".into(),
        kind: TaskKind::new("follow", &FollowParams { gripper: true, ..FollowParams::default() })
            .led_by((6..12).map(led_by).collect()),
        joints: (0..6).collect(),
        priority: 20,
        auto_start: false,
    });
    let log = folder.path().join("follow.mcap");
    let mut run = VirtualRun::start(&config, &log);
    (run.states[0].position, run.states[1].enabled) = (joints_of(&[0.1; 6]), false);
    run.step();
    run.ask(Request::Enabled { arm: 0, outside: false });
    (0..40).for_each(|_| run.step());
    for k in 0..2000u32 {
        let t = f64::from(k) * 0.01;
        // It is carried away while nothing is heard of it.
        run.states[1].position = joints_of(&[0.4 * t.sin() + if k > 930 { 0.5 } else { 0.0 }; 6]);
        run.states[1].gripper = Some(0.05 + 0.04 * t.cos());
        run.states[1].link = if (900..960).contains(&k) { Link::Down } else { Link::Up };
        match k {
            10 | 1500 => run.ask(Request::Start { task: 1 }),
            700 => run.ask(Request::Pause { on: true }),
            800 => run.ask(Request::Pause { on: false }),
            1400 => run.ask(Request::Cancel { task: Some(1) }),
            _ => {}
        }
        run.step();
    }
    assert_eq!(run.tasks[1].state, TaskState::Executing);
    run.finish();
    let found = reproducible(&log);
    assert!(found.ticks > 2000 && found.events > 12, "{found:?}");
}

/// The next number in the direction of infinity.
fn ulp(value: &mut f64) {
    *value = value.next_up();
}

#[track_caller]
fn first_difference(log: &Path) -> dimos::replay::compare::Difference {
    match verify(log).unwrap().finding {
        Finding::Different(d) => d,
        other => panic!("{other:?}"),
    }
}

#[test]
fn one_bit_of_a_command_is_found_at_its_tick_and_joint() {
    let folder = tempfile::tempdir().unwrap();
    let (log, _) = eventful(folder.path());
    let copy = folder.path().join("copy.mcap");
    // Commands begin with the sixth tick: the arm was enabled in the second one, and has rested for 50 ms.
    let number = 140;
    tamper(&log, &copy, "/joint_commands", number, |m: &mut JointState| ulp(&mut m.position[3]));
    let d = first_difference(&copy);
    assert_eq!((d.tick, d.what, d.joint.as_deref()), (number as u64 + 5, "position command", Some("arm_joint4")));
    assert!((d.time - 1.45).abs() < 1e-9, "{}", d.time);
    assert_ne!(d.logged, d.rerun);
}

#[test]
fn one_bit_of_a_state_is_found_where_it_first_matters() {
    let folder = tempfile::tempdir().unwrap();
    let (log, _) = eventful(folder.path());
    let copy = folder.path().join("copy.mcap");
    // The hold begins where the arm is measured once it has rested for 50 ms.
    tamper(&log, &copy, "/joint_states", 5, |m: &mut JointState| ulp(&mut m.position[4]));
    let d = first_difference(&copy);
    assert_eq!((d.tick, d.what, d.joint.as_deref()), (5, "position command", Some("arm_joint5")));
    // Where velocities are estimated, every position matters.
    let estimated = 540;
    tamper(&log, &copy, "/joint_states", estimated, |m: &mut JointState| m.position[2] += 1e-9);
    let d = first_difference(&copy);
    assert_eq!((d.tick, d.what), (estimated as u64, "estimated velocity"));
    assert_eq!(d.joint.as_deref(), Some("arm_joint3"));
}

#[test]
fn a_changed_number_of_starts_is_found() {
    let folder = tempfile::tempdir().unwrap();
    let (log, _) = eventful(folder.path());
    let copy = folder.path().join("copy.mcap");
    tamper(&log, &copy, "/dimos/outputs/arm", 0, |m: &mut ArmOutput| m.start_seq += 1);
    let d = first_difference(&copy);
    assert_eq!((d.tick, d.what, d.arm.as_deref()), (0, "number of starts", Some("arm")));
}

#[test]
fn a_changed_force_of_the_gripper_is_found() {
    let folder = tempfile::tempdir().unwrap();
    let (log, _) = eventful(folder.path());
    let copy = folder.path().join("copy.mcap");
    rewrite(&log, &copy, |topic, bytes| {
        let mut output = (topic == "/dimos/outputs/arm").then(|| ArmOutput::decode(bytes).unwrap())?;
        output.gripper_force.iter_mut().for_each(ulp);
        let mut out = Encoder::default();
        output.put(&mut out);
        Some(out.bytes().to_vec())
    });
    let d = first_difference(&copy);
    assert_eq!((d.what, d.arm.as_deref()), ("force of the gripper command", Some("arm")));
}

#[test]
fn a_changed_request_or_time_shows_in_what_came_of_it() {
    let folder = tempfile::tempdir().unwrap();
    let (log, _) = eventful(folder.path());
    let copy = folder.path().join("copy.mcap");
    tamper(&log, &copy, "/dimos/requests", 1, |m: &mut Text| m.data = m.data.replace("0.5", "0.51"));
    let found = verify(&copy).unwrap();
    assert!(matches!(found.finding, Finding::Different(_)), "{found:?}");
    tamper(&log, &copy, "/dimos/tick", 3, |m: &mut Tick| m.skipped = 1);
    let d = first_difference(&copy);
    assert_eq!((d.tick, d.what), (3, "event"));
}

#[test]
fn what_is_missing_ends_the_verification_there() {
    let folder = tempfile::tempdir().unwrap();
    let (log, ticks) = eventful(folder.path());
    let copy = folder.path().join("copy.mcap");
    let incomplete = |log: &Path| match verify(log).unwrap() {
        Verification { finding: Finding::Incomplete { tick, why }, ticks, .. } => {
            assert_eq!(tick, ticks);
            (tick, why)
        }
        other => panic!("{other:?}"),
    };
    tamper(&log, &copy, "/dimos/tick", 200, |m: &mut Tick| m.dropped = 7);
    assert_eq!(incomplete(&copy), (200, "7 samples were lost up to tick 200".into()));
    tamper(&log, &copy, "/dimos/requests", 0, |m: &mut Text| m.data = m.data.replace("\"id\":1", "\"id\":99"));
    assert_eq!(incomplete(&copy), (1, "request 1 is missing".into()));
    tamper(&log, &copy, "/dimos/requests", 0, |m: &mut Text| m.data = m.data.replace("ready", "dance"));
    assert!(incomplete(&copy).1.contains("dance"));
    let bytes = std::fs::read(&log).unwrap();
    let mut before = 0;
    for length in [bytes.len() / 4, bytes.len() / 2, bytes.len() - 1] {
        std::fs::write(&copy, &bytes[..length]).unwrap();
        let (tick, why) = incomplete(&copy);
        assert!(tick >= before && why.contains("ends"), "{tick}: {why}");
        before = tick;
    }
    assert_eq!(before, ticks - 1, "events of the last tick may have been cut off");
    without_attachments(&log, &copy);
    let error = verify(&copy).unwrap_err();
    assert!(matches!(error, RecordedError::NoCoordinator { .. }), "{error}");
    assert!(error.to_string().contains("\nhint: "));
    rewrite(&log, &copy, |_, _| None);
    reproducible(&copy);
}

/// Every file ends with a verdict, whatever is in it.
#[test]
fn damaged_messages_break_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let (log, copy) = (folder.path().join("short.mcap"), folder.path().join("copy.mcap"));
    let mut run = VirtualRun::start(&one_arm(2), &log);
    run.step();
    run.ask(Request::Enabled { arm: 0, outside: false });
    (0..30).for_each(|_| run.step());
    let limits = JointLimits::uniform(2, 3.0, 2.0).with_defaults();
    run.execute(0, &point_to_point(&make_joints("arm", 2), &[0.0; 2], &[0.05; 2], &limits, 1.0).unwrap());
    (0..60).for_each(|_| run.step());
    run.finish();
    let mut random = 0x9e37_79b9_7f4a_7c15u64;
    let mut next = move || {
        random ^= random << 13;
        random ^= random >> 7;
        random ^= random << 17;
        random
    };
    let mut found = [0; 3];
    for _ in 0..150 {
        rewrite(&log, &copy, |topic, bytes| {
            if topic.starts_with("/arm_status") || !next().is_multiple_of(40) {
                return None;
            }
            let mut bytes = bytes.to_vec();
            let at = 4 + next() as usize % (bytes.len() - 4);
            bytes[at] = next() as u8;
            Some(bytes)
        });
        found[match verify(&copy).unwrap().finding {
            Finding::Reproducible => 0,
            Finding::Different(_) => 1,
            Finding::Incomplete { .. } => 2,
        }] += 1;
        let _ = dimos::replay::motion::RecordedMotion::read(&copy, 0, u64::MAX).map(|m| dimos::replay::fit::fit(&m));
    }
    assert!(found[1] > 10 && found[2] > 10, "{found:?}");
}
