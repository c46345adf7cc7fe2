//! From samples to a file and back.

mod golden;
mod hostile;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex};

use super::files;
use super::log_writer::LogAttachment;
use super::messages::{ArmInput, JointState};
use super::notes::{Notes, channel};
use super::recorder::{Note, Notice, Recorder, RecorderConfig};
use super::replay::{Entry, LogReader, Payload, ReplayError, Selection};
use dimos_core::arm::{
    ArmCommand, ArmState, Commanded, ControllerPose, EffortKind, Interference, JointSet, Link, Pose, VelocitySource,
};
use dimos_core::clock::{Mono, WallOffset};
use dimos_core::joint::{ControlMode, MAX_DOF, joints_of, make_joints};
use dimos_core::telemetry::describe::{ArmNames, Names, Severity};
use dimos_core::telemetry::{ArmSample, Cause, Event, Outcome, Phase, Sample, TickSample};

const WALL: u64 = 1_795_270_590_000_000_000;
const PERIOD: u64 = 10_000_000;

fn names() -> Names {
    let arm = |id: &str, dof| ArmNames { hardware_id: id.into(), joints: make_joints(id, dof) };
    Names { arms: vec![arm("left", 3), arm("right", 2)], tasks: vec!["traj_left".into()] }
}

fn config(path: PathBuf) -> RecorderConfig {
    RecorderConfig {
        path: Some(path),
        run: "test".into(),
        names: names(),
        frame_id: "coordinator".into(),
        attachments: vec![LogAttachment {
            name: "blueprint.yaml".into(),
            media_type: "application/yaml".into(),
            data: b"name: test\n".to_vec(),
        }],
        metadata: BTreeMap::from([("tick_rate".to_owned(), "100".to_owned())]),
        tcps: Default::default(),
        wall: WallOffset::of(Mono(1_000_000_000), WALL),
        storage: Default::default(),
    }
}

fn deadline(tick: u64) -> Mono {
    Mono(1_000_000_000 + tick * PERIOD)
}

/// A state of an arm in which all optional values appear and disappear.
fn state(arm: u16, tick: u64) -> ArmState {
    let x = tick as f64 * 0.1 + f64::from(arm);
    ArmState {
        // The right arm has a new state on every second tick only, and none at first.
        seq: if arm == 0 { tick + 1 } else { tick / 2 },
        stamp: Mono(deadline(tick).0 - 1_234_567),
        dof: if arm == 0 { 3 } else { 2 },
        position: joints_of(&[x.sin(), -0.0, f64::MIN_POSITIVE][..if arm == 0 { 3 } else { 2 }]),
        velocity: joints_of(&[x.cos(), 0.1 + 0.2][..2]),
        velocity_source: [VelocitySource::Measured, VelocitySource::Estimated, VelocitySource::Absent]
            [(tick as usize + usize::from(arm)) % 3],
        effort: (arm == 0 && tick % 4 > 1).then(|| joints_of(&[1.5, 2.5, x])),
        gripper: (arm == 0).then_some(0.04 + x * 1e-3),
        gripper_force: (arm == 0).then_some(7.0 + x),
        pose: (tick % 3 == 1).then_some(ControllerPose::of_flange(Pose { xyz: [x, 0.2, 0.3], rpy: [0.0, -1.0, x] })),
        wrench: (arm == 1 && tick > 3).then_some([1.0, 2.0, x, 4.0, 5.0, 6.0]),
        mode: if tick > 5 { ControlMode::ServoPosition } else { ControlMode::Velocity },
        enabled: tick > 2,
        error: if tick == 7 { 22 } else { 0 },
        link: if tick == 7 { Link::Faulted } else { Link::Up },
        self_held: tick == 8,
        written: tick.saturating_sub(1),
        interference: if tick == 9 { Interference::Mode } else { Interference::None },
        own_delay_ns: tick % 2,
        stop_input_open: tick % 5 == 3,
        device_ns: tick.is_multiple_of(2).then_some(tick * 1000),
        commanded: (arm == 0 && tick > 2)
            .then(|| Commanded { position: joints_of(&[x, 0.1 + 0.2, -0.0]), velocity: joints_of(&[0.0, x, 1.0]) }),
        refused: tick / 3,
        speed_fraction: (arm == 0 && tick > 4).then_some(0.25),
        inputs: (arm == 0 && tick > 5).then_some(0b101),
        effort_kind: if arm == 0 { EffortKind::FromCurrent } else { EffortKind::Unstated },
        missing: if tick == 11 { JointSet::of([1]) } else { JointSet::NONE },
    }
}

fn arm_sample(arm: u16, tick: u64) -> Sample {
    let command = ArmCommand {
        seq: tick,
        mode: [None, Some(ControlMode::ServoPosition), Some(ControlMode::Velocity)][(tick % 3) as usize],
        values: joints_of(&[tick as f64 * 0.01, f64::from(arm)]),
        next_tick: deadline(tick + 1),
        ..ArmCommand::default()
    };
    Sample::Arm(ArmSample { arm, state: state(arm, tick), command, phase: Phase::Ready, cause: Cause::None })
}

fn close(tick: u64) -> Sample {
    Sample::Tick(TickSample { tick, deadline: deadline(tick), late_ns: 21_000 + tick, ..TickSample::default() })
}

fn tick(tick: u64) -> [Sample; 3] {
    [arm_sample(0, tick), arm_sample(1, tick), close(tick)]
}

/// Notices of the recorder, as text.
type Notices = Arc<Mutex<Vec<String>>>;

fn start(path: &Path, notices: &Notices) -> (Recorder, rtrb::Producer<Sample>, Notes) {
    let (producer, consumer) = rtrb::RingBuffer::new(4096);
    let (notes, receiver) = channel();
    let notices = notices.clone();
    let on_notice = move |notice: Notice<'_>| {
        let text = match notice {
            Notice::Event { tick, described, .. } => format!("{tick}: {}", described.text),
            Notice::Lost(samples) => format!("lost {samples}"),
            Notice::Unsynced(after) => format!("not synced after {after:?}"),
            Notice::Stopped(e) => e.to_string(),
            Notice::Fault(Ok(path)) => format!("fault: {}", path.display()),
            Notice::Fault(Err(e)) => format!("no log of a fault: {e}"),
        };
        notices.lock().unwrap().push(text);
    };
    let recorder = Recorder::start(config(path.to_owned()), consumer, receiver, on_notice).unwrap();
    (recorder, producer, notes)
}

fn record(path: &Path, samples: impl IntoIterator<Item = Sample>) -> Vec<String> {
    let notices = Notices::default();
    let (recorder, mut ring, _notes) = start(path, &notices);
    samples.into_iter().for_each(|s| ring.push(s).unwrap());
    recorder.finish().unwrap();
    std::mem::take(&mut notices.lock().unwrap())
}

/// Reads all messages up to the end or the cut, and returns which of the two it was.
fn read(path: &Path) -> Result<(Vec<Entry>, Option<ReplayError>), ReplayError> {
    let mut log = LogReader::open(path)?;
    let mut entries = Vec::new();
    loop {
        match log.next_entry() {
            Ok(Some(entry)) => entries.push(entry),
            Ok(None) => return Ok((entries, None)),
            Err(e) => return Ok((entries, Some(e))),
        }
    }
}

fn folder() -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("logs/test.mcap");
    (folder, path)
}

/// Fills in an arm's values from `/joint_states`, after `skip` joints of other arms.
fn with_values(input: &ArmInput, states: Option<&JointState>, skip: usize, dof: usize) -> ArmState {
    let pick = |values: &[f64]| {
        let mut all = [0.0; MAX_DOF];
        all[..dof].copy_from_slice(&values[skip..skip + dof]);
        all
    };
    let source = [VelocitySource::Absent, VelocitySource::Measured, VelocitySource::Estimated];
    let source = source.into_iter().find(|s| s.name() == input.velocity_source).unwrap();
    let modes = [ControlMode::Velocity, ControlMode::ServoPosition];
    let links = [Link::Up, Link::Faulted];
    let known = input.seq > 0;
    ArmState {
        seq: input.seq,
        stamp: Mono(input.stamp_ns),
        dof,
        position: if known { pick(&states.unwrap().position) } else { [0.0; MAX_DOF] },
        velocity: if known && source != VelocitySource::Absent {
            pick(&states.unwrap().velocity)
        } else {
            [0.0; MAX_DOF]
        },
        velocity_source: source,
        effort: (input.has_effort && known).then(|| pick(&states.unwrap().effort)),
        gripper: input.gripper.first().copied(),
        gripper_force: input.gripper_force.first().copied(),
        pose: (!input.pose.is_empty()).then(|| {
            let (xyz, rpy) = (input.pose[..3].try_into().unwrap(), input.pose[3..].try_into().unwrap());
            ControllerPose::of_flange(Pose { xyz, rpy })
        }),
        wrench: (!input.wrench.is_empty()).then(|| input.wrench.clone().try_into().unwrap()),
        mode: modes.into_iter().find(|m| m.name() == input.mode).unwrap(),
        enabled: input.enabled,
        error: input.error,
        link: links.into_iter().find(|l| l.name() == input.link).unwrap(),
        self_held: input.self_held,
        written: input.written,
        interference: if input.interference == "mode" { Interference::Mode } else { Interference::None },
        own_delay_ns: input.own_delay_ns,
        stop_input_open: input.stop_input_open,
        device_ns: input.device_ns.first().copied(),
        commanded: (!input.commanded_position.is_empty()).then(|| Commanded {
            position: joints_of(&input.commanded_position),
            velocity: joints_of(&input.commanded_velocity),
        }),
        refused: input.refused,
        speed_fraction: input.speed_fraction.first().copied(),
        inputs: input.inputs.first().copied(),
        effort_kind: EffortKind::of_name(&input.effort_kind).unwrap(),
        missing: JointSet::of(input.missing.iter().map(|joint| usize::from(*joint))),
    }
}

#[test]
fn all_inputs_of_a_tick_are_restored_bit_by_bit() {
    let (_folder, path) = folder();
    record(&path, (0..40).flat_map(tick));
    let (entries, end) = read(&path).unwrap();
    assert!(end.is_none());
    let mut inputs: BTreeMap<String, ArmInput> = BTreeMap::new();
    let mut states: Option<JointState> = None;
    let mut ticks = 0;
    for entry in entries {
        match entry.data {
            Payload::JointState(message) if entry.topic == "/joint_states" => states = Some(message),
            Payload::ArmInput(input) => drop(inputs.insert(entry.topic, input)),
            // The tick's message is the last of its inputs.
            Payload::Tick(t) => {
                assert_eq!(t.deadline_ns, deadline(t.tick).0);
                assert_eq!(entry.log_time, WALL + t.tick * PERIOD);
                let left = with_values(&inputs["/dimos/inputs/left"], states.as_ref(), 0, 3);
                let right = with_values(&inputs["/dimos/inputs/right"], states.as_ref(), 3, 2);
                for (arm, found) in [(0, left), (1, right)] {
                    let mut expected = state(arm, t.tick);
                    if expected.velocity_source == VelocitySource::Absent || expected.seq == 0 {
                        expected.velocity = [0.0; MAX_DOF];
                    }
                    if expected.seq == 0 {
                        expected.position = [0.0; MAX_DOF];
                    }
                    assert_eq!(found, expected, "arm {arm}, tick {}", t.tick);
                    let bits = |s: &ArmState| s.position.map(f64::to_bits);
                    assert_eq!(bits(&found), bits(&expected), "arm {arm}, tick {}", t.tick);
                }
                ticks += 1;
            }
            _ => {}
        }
    }
    assert_eq!(ticks, 40);
}

#[test]
fn unknown_values_are_absent_or_nan_but_never_zero() {
    let (_folder, path) = folder();
    record(&path, (0..3).flat_map(tick));
    let (entries, _) = read(&path).unwrap();
    let states: Vec<_> = entries
        .iter()
        .filter_map(|e| match &e.data {
            Payload::JointState(s) if e.topic == "/joint_states" => Some(s),
            _ => None,
        })
        .collect();
    let joints = ["left_joint1", "left_joint2", "left_joint3", "right_joint1", "right_joint2"];
    assert_eq!(states[0].name[..5], joints);
    assert_eq!((&states[0].name[5..], &states[0].position[5..]), (&["left_gripper".to_owned()][..], &[0.04][..]));
    assert!(states[0].position[3..5].iter().all(|p| p.is_nan()), "the right arm has no state yet");
    assert!(states[0].effort.is_empty(), "no arm reports efforts on tick 0");
    assert_eq!(states[2].effort[..3], [1.5, 2.5, 0.2]);
    assert!(states[2].effort[3..5].iter().all(|e| e.is_nan()), "the right arm never reports efforts");
    assert_eq!(states[2].effort[5], 7.2, "the force of the gripper");
    let commands: Vec<_> = entries.iter().filter(|e| e.topic == "/joint_commands").collect();
    assert_eq!(commands.len(), 2, "nothing was commanded on tick 0");
    let Payload::JointState(c) = &commands[0].data else { panic!() };
    assert_eq!((c.position.len(), c.velocity.len(), c.position[0]), (5, 0, 0.01));
    let Payload::JointState(c) = &commands[1].data else { panic!() };
    assert_eq!((c.position.len(), c.velocity.len(), c.velocity[0]), (0, 5, 0.02));
}

#[test]
fn a_request_precedes_its_answer_and_events_have_text() {
    let (_folder, path) = folder();
    let notices = Notices::default();
    let (recorder, mut ring, notes) = start(&path, &notices);
    notes.send(Note::ArmText { arm: 0, text: "joint 2 is too hot".into() }).unwrap();
    notes.send(Note::Request { id: 7, stamp: deadline(7), origin: None, json: r#"{"method":"stop"}"#.into() }).unwrap();
    notes.send(Note::Log { severity: Severity::Info, stamp: deadline(7), text: "hello".into() }).unwrap();
    ring.push(arm_sample(0, 7)).unwrap();
    ring.push(arm_sample(1, 7)).unwrap();
    ring.push(Sample::Event(7, Event::Request(7, Outcome::Accepted))).unwrap();
    ring.push(close(7)).unwrap();
    ring.push(Sample::Event(8, Event::Degraded)).unwrap();
    tick(8).into_iter().for_each(|s| ring.push(s).unwrap());
    let stats = recorder.stats();
    recorder.finish().unwrap();
    let degraded = "ten consecutive ticks were late by a period or more";
    assert_eq!(*notices.lock().unwrap(), ["7: request 7: accepted".to_owned(), format!("8: {degraded}")]);
    let (entries, _) = read(&path).unwrap();
    assert_eq!(stats.messages.load(Ordering::Relaxed), entries.len() as u64);
    assert_eq!(stats.bytes.load(Ordering::Relaxed), std::fs::metadata(&path).unwrap().len());
    let at = |topic: &str| entries.iter().position(|e| e.topic == topic).unwrap();
    assert!(at("/dimos/requests") < at("/dimos/events"));
    let Payload::Text(request) = &entries[at("/dimos/requests")].data else { panic!() };
    assert_eq!(request.data, r#"{"id":7,"request":{"method":"stop"}}"#);
    let Payload::Event(event) = &entries[at("/dimos/events")].data else { panic!() };
    assert_eq!((event.tick, &event.request[..], event.status.as_str()), (7, &[7][..], "ACCEPTED"));
    let events: Vec<_> = entries.iter().filter(|e| e.topic == "/dimos/events").map(|e| e.log_time).collect();
    assert_eq!(events, [WALL + 7 * PERIOD, WALL + 8 * PERIOD]);
    let Payload::ArmStatus(status) = &entries[at("/arm_status/left")].data else { panic!() };
    assert_eq!((status.error, status.error_text.as_str()), (22, "joint 2 is too hot"));
    let lines: Vec<_> = entries
        .iter()
        .filter_map(|e| if let Payload::Log(l) = &e.data { Some((l.level, l.msg.as_str())) } else { None })
        .collect();
    assert_eq!(lines, [(20, "hello"), (20, "request 7: accepted"), (40, degraded)]);
}

#[test]
fn lost_samples_are_counted_and_never_mixed_into_another_tick() {
    let (_folder, path) = folder();
    // Of tick 1 only the left arm arrives, of tick 2 only the right one and the end.
    let lossy = TickSample { tick: 2, deadline: deadline(2), dropped: 3, ..TickSample::default() };
    let mut samples = Vec::from(tick(0));
    samples.extend([arm_sample(0, 1), arm_sample(1, 2), Sample::Tick(lossy)]);
    samples.extend(tick(3));
    assert_eq!(record(&path, samples), ["lost 4"]);
    let mut log = LogReader::open(&path).unwrap();
    let mut positions = Vec::new();
    let mut dropped = Vec::new();
    while let Some(entry) = log.next_entry().unwrap() {
        match entry.data {
            Payload::JointState(s) if entry.topic == "/joint_states" => positions.push(s.position[0]),
            Payload::Tick(t) => dropped.push(t.dropped),
            _ => {}
        }
    }
    assert_eq!((positions[0], positions[2]), (0.0f64.sin(), (3.0f64 * 0.1).sin()));
    assert!(positions[1].is_nan(), "the left arm's sample of tick 2 was lost");
    assert_eq!(dropped, [0, 4, 0]);
    assert_eq!(log.lost(), 4);
}

#[test]
fn a_log_is_never_overwritten() {
    let (_folder, path) = folder();
    record(&path, tick(0));
    let (_producer, consumer) = rtrb::RingBuffer::new(1);
    let e = Recorder::start(config(path.clone()), consumer, channel().1, |_| {}).unwrap_err();
    assert!(e.to_string().contains("hint: a log is never overwritten"), "{e}");
    assert_eq!(read(&path).unwrap().1.map(|e| e.to_string()), None);
}

#[test]
fn a_log_is_not_removed_while_it_is_recorded() {
    let (_folder, path) = folder();
    let path = path.with_file_name("test-20261121T141630Z.mcap");
    let (recorder, _ring, _notes) = start(&path, &Notices::default());
    assert!(files::retain(path.parent().unwrap(), 0).unwrap().is_empty());
    recorder.finish().unwrap();
    assert!(path.exists());
}

#[test]
fn without_a_log_events_are_still_reported() {
    let (mut producer, consumer) = rtrb::RingBuffer::new(64);
    let notices = Notices::default();
    let sink = notices.clone();
    let on_notice = move |n: Notice<'_>| {
        if let Notice::Event { described, .. } = n {
            sink.lock().unwrap().push(described.kind.to_owned());
        }
    };
    let config = RecorderConfig { path: None, ..config(PathBuf::new()) };
    let recorder = Recorder::start(config, consumer, channel().1, on_notice).unwrap();
    producer.push(Sample::Event(0, Event::Degraded)).unwrap();
    tick(0).into_iter().for_each(|s| producer.push(s).unwrap());
    recorder.finish().unwrap();
    assert_eq!(producer.slots(), 64, "the ring is empty");
    assert_eq!(*notices.lock().unwrap(), ["degraded"]);
}
