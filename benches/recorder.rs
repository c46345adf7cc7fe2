//! The recorder: without a tick, four arms at 1 kHz for a minute, samples as fast as it takes them, and how fast a log
//! of a million messages is decoded. Beside a tick of four arms at 1 kHz: how much later it wakes than without a
//! recorder, in interleaved pairs of runs, and what is lost in ten minutes (`--quick`: all shorter; `-- alone`: without
//! the runs).

#[path = "support/mod.rs"]
#[allow(dead_code, reason = "shared with the other benchmarks")]
mod support;

use std::collections::BTreeMap;
use std::path::Path;
use std::process::ExitCode;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use dimos::arm::{ArmCommand, ArmState, Link, VelocitySource};
use dimos::clock::{Clock, Mono, MonotonicClock, WallOffset};
use dimos::joint::{ControlMode, joints_of, make_joints};
use dimos::recording::notes::channel;
use dimos::recording::recorder::{Recorder, RecorderConfig};
use dimos::recording::replay::LogReader;
use dimos::rpc::api::Status;
use dimos::telemetry::describe::{ArmNames, Names};
use dimos::telemetry::{ArmSample, Cause, Phase, Sample, TickSample};
use support::measure::{Goal, Measure, print};
use support::run::{LiveRun, keep_moving};

const ARMS: u16 = 4;
const PERIOD: u64 = 1_000_000;
/// Messages a second, written and read.
const GOAL: f64 = 500_000.0;

fn main() -> ExitCode {
    let effort = support::Effort::from_environment();
    support::machine::print();
    let folder = tempfile::tempdir().expect("a temporary folder can be made");
    let log = folder.path().join("paced.mcap");
    let ticks = effort.of(3_000, 60_000);
    let (messages, dropped, _) = record(&log, ticks, true);
    let (size, seconds) = (std::fs::metadata(&log).map_or(0, |m| m.len()) as f64 / 1e6, ticks as f64 * 1e-3);
    let title = format!("{ARMS} arms at 1 kHz, {seconds:.0} s: {messages} messages, {size:.1} MB");
    print(&title, &[Measure::new("samples lost", "", vec![dropped as f64]).goal(Goal::AtMost(0.0))]);
    let log = folder.path().join("fast.mcap");
    let (messages, dropped, took) = record(&log, effort.of(20_000, 200_000), false);
    let written = messages as f64 / took.as_secs_f64();
    let began = Instant::now();
    let mut reader = LogReader::open(&log).expect("the log can be read");
    let read = std::iter::from_fn(|| reader.next_entry().expect("the log is whole")).map(std::hint::black_box).count();
    let decoded = read as f64 / began.elapsed().as_secs_f64();
    print(
        "as fast as possible",
        &[
            Measure::new("written", "messages/s", vec![written]).goal(Goal::AtLeast(GOAL)),
            Measure::new("lost", "", vec![dropped as f64]).goal(Goal::AtMost(0.0)),
            Measure::new("decoded", "messages/s", vec![decoded]).goal(Goal::AtLeast(GOAL)),
        ],
    );
    if !std::env::args().any(|a| a == "alone")
        && let Err(e) = beside_a_tick(effort)
    {
        support::empty(&e);
    }
    effort.end()
}

/// Compares the lateness of the tick with and without a recorder, and counts what is lost in a long run.
fn beside_a_tick(effort: support::Effort) -> Result<(), String> {
    let (pairs, seconds) = (effort.of(1, 7), effort.of(1, 20));
    let (mut with, mut without, mut ratios) = (Vec::new(), Vec::new(), Vec::new());
    for pair in 0..pairs {
        // Each is first in turn.
        let mut late = [0.0; 2];
        for k in [pair % 2, 1 - pair % 2] {
            late[k] = run(k == 1, seconds)?.0;
        }
        without.push(late[0]);
        with.push(late[1]);
        ratios.push(late[1] / late[0]);
    }
    let title = format!("lateness of a tick of {ARMS} arms at 1 kHz, p99, {pairs} pairs of {seconds} s");
    print(
        &title,
        &[
            Measure::new("recorded", "µs", with),
            Measure::new("not recorded", "µs", without),
            Measure::new("ratio", "", ratios).goal(Goal::AtMost(1.1)),
        ],
    );
    let seconds = effort.of(2, 600);
    let (_, messages, lost) = run(true, seconds)?;
    let title = format!("{ARMS} arms at 1 kHz beside the tick, {seconds} s: {messages} messages");
    print(&title, &[Measure::new("samples lost", "", vec![lost as f64]).goal(Goal::AtMost(0.0))]);
    Ok(())
}

/// Runs four arms in motion. Returns the p99 of the tick's lateness [µs], the messages written, and the samples lost.
fn run(recorded: bool, seconds: u64) -> Result<(f64, u64, u64), String> {
    let blueprint = Path::new(env!("CARGO_MANIFEST_DIR")).join("benches/support/four-arms.yaml");
    let blueprint = blueprint.to_str().ok_or("the path of the blueprint is no text")?;
    let arguments: &[&str] = if recorded { &[] } else { &["--set", "recording.fault_log=false"] };
    let start = if recorded { LiveRun::start } else { LiveRun::unrecorded };
    let mut run = start(blueprint, arguments).map_err(|e| e.to_string())?;
    let mut client = run.client()?;
    let mut left = seconds;
    while left > 0 {
        // One request holds no more; a swing may take 4 s longer than asked for.
        let part = left.min(100);
        keep_moving(&mut client, part as f64)?;
        std::thread::sleep(Duration::from_secs(part + if left > part { 5 } else { 0 }));
        left -= part;
    }
    let status = client.call(Status {}).map_err(|e| e.to_string())?;
    let (messages, lost) = status.recorder.map_or((0, 0), |recorder| (recorder.messages, recorder.dropped));
    run.end(|_| (status.ticks.lateness_us.p99, messages, lost))
}

/// Records ticks, at their time or as fast as the recorder takes them. Returns messages, lost samples, and the time
/// until the log is closed.
fn record(log: &Path, ticks: u64, paced: bool) -> (u64, u64, Duration) {
    let arm = |arm: u16| ArmNames { hardware_id: format!("arm{arm}"), joints: make_joints(&format!("arm{arm}"), 6) };
    let start = MonotonicClock.now();
    let config = RecorderConfig {
        path: Some(log.to_owned()),
        run: "bench".into(),
        names: Names { arms: (0..ARMS).map(arm).collect(), tasks: vec!["task".into()] },
        frame_id: "coordinator".into(),
        attachments: Vec::new(),
        metadata: BTreeMap::new(),
        tcps: Default::default(),
        wall: WallOffset::of(start, 1_795_270_590_000_000_000),
        storage: Default::default(),
    };
    // As in a run: 5 s.
    let (mut ring, samples) = rtrb::RingBuffer::new(5 * 1000 * usize::from(ARMS + 1));
    let (_notes, noted) = channel();
    let recorder = Recorder::start(config, samples, noted, |_| {}).expect("the log can be written");
    let began = Instant::now();
    let mut lost = 0;
    for tick in 0..ticks {
        let deadline = start.after(Duration::from_nanos(tick * PERIOD));
        if paced {
            std::thread::sleep(deadline.since(MonotonicClock.now()));
        }
        for sample in samples_of(tick, deadline) {
            while !paced && ring.is_full() {
                recorder.wake();
                std::thread::yield_now();
            }
            lost += u32::from(ring.push(sample).is_err());
        }
    }
    let stats = recorder.stats();
    recorder.finish().expect("the log is closed");
    let dropped = stats.dropped.load(Ordering::Relaxed) + u64::from(lost);
    (stats.messages.load(Ordering::Relaxed), dropped, began.elapsed())
}

fn samples_of(tick: u64, deadline: Mono) -> impl Iterator<Item = Sample> {
    let x = tick as f64 * 1e-3;
    let arms = (0..ARMS).map(move |arm| {
        let q = joints_of(&[1.0, 1.3, 1.7, 0.9, 0.4, 2.1].map(|f: f64| (x * f + f64::from(arm)).sin()));
        let state = ArmState {
            seq: tick + 1,
            stamp: deadline,
            dof: 6,
            position: q,
            velocity: joints_of(&q[..6].iter().map(|q| 0.3 * q).collect::<Vec<_>>()),
            velocity_source: VelocitySource::Measured,
            mode: ControlMode::ServoPosition,
            enabled: true,
            link: Link::Up,
            written: tick,
            ..ArmState::default()
        };
        let mode = Some(ControlMode::ServoPosition);
        let command = ArmCommand { seq: tick, mode, values: q, next_tick: deadline, ..ArmCommand::default() };
        Sample::Arm(ArmSample { arm, state, command, phase: Phase::Ready, cause: Cause::None })
    });
    let end = TickSample { tick, deadline, late_ns: 20_000, compute_ns: 9_000, ..TickSample::default() };
    arms.chain([Sample::Tick(end)])
}
