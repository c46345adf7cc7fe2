//! A loop clocked by the device: how soon a state is answered, and how many are not, beside the vendor's client. Both
//! answer the same emulated controller, in turn.

use std::path::Path;
use std::process::Command;
use std::time::Duration;

use dimos::arms::franka::emulator::FrankaEmulator;
use dimos::hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};

use crate::support::measure::{figure, print_rows, quantile, verdict};
use crate::support::run::{LiveRun, keep_moving};
use crate::support::{Effort, skipped};

/// Goal for the time from a state to its answer, p99 [µs].
const GOAL: f64 = 100.0;
/// The vendor's client: holds the arm for a time, with an answer to each state.
const VENDOR: &str = "
import os, sys, pylibfranka
# Its own check wants a kernel with PREEMPT_RT.
robot = pylibfranka.Robot(sys.argv[1], pylibfranka.RealtimeConfig.kIgnore)
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(81))
control = robot.start_joint_position_control(pylibfranka.ControllerMode.JointImpedance)
state, _ = control.readOnce()
q, t, end = list(state.q_d), 0.0, float(sys.argv[2])
while True:
    command = pylibfranka.JointPositions(q)
    command.motion_finished = t > end
    control.writeOnce(command)
    if command.motion_finished:
        break
    state, step = control.readOnce()
    t += step.to_sec()
";

/// How one client fared.
struct Fared {
    /// Time from a state to its answer: p50, p99, p99.9, max [µs].
    answers: [f64; 4],
    /// Cycles of a motion, those without an answer in time, and the most of them in a row.
    cycles: u64,
    lost: u64,
    longest: u32,
}

/// Measures interleaved pairs.
pub fn compare(effort: Effort) -> Result<(), String> {
    let time = Duration::from_secs(effort.of(2, 60));
    let (mut ours, mut theirs) = (Vec::new(), Vec::new());
    let python = Path::new(env!("CARGO_MANIFEST_DIR")).join(".venv/bin/python");
    for _ in 0..effort.of(1, 10) {
        match with_emulator(|address| vendor(&python, address, time)) {
            Ok(fared) => theirs.push(fared),
            Err(e) if !python.exists() => skipped(&format!("pylibfranka: {e} (make test-tools)")),
            // The controller ends its motion after 20 answers that came too late.
            Err(e) => println!("pylibfranka did not keep up: {e}"),
        }
        ours.push(with_emulator(|address| our_run(address, time))?);
    }
    let row = |who: String, fared: &Fared| {
        let times = fared.answers.iter().map(|v| figure(*v));
        let counts = [fared.lost.to_string(), fared.cycles.to_string(), fared.longest.to_string()];
        [who].into_iter().chain(times).chain(counts).collect::<Vec<_>>()
    };
    let head = ["", "p50", "p99", "p99.9", "max", "lost", "of", "longest"].map(str::to_owned).to_vec();
    let mut rows = vec![head];
    for (k, fared) in ours.iter().enumerate() {
        rows.extend(theirs.get(k).map(|fared| row(format!("pylibfranka {}", k + 1), fared)));
        rows.push(row(format!("dimos       {}", k + 1), fared));
    }
    print_rows(&format!("1000 Hz, clock: device(arm), {} pairs of {} s", ours.len(), time.as_secs()), rows);
    let p99 = quantile(&ours.iter().map(|f| f.answers[1]).collect::<Vec<_>>(), 0.5);
    println!("  median p99 of an answer {} µs, goal ≤ {GOAL} µs: {}", figure(p99), verdict(p99 <= GOAL));
    let lost = |all: &[Fared]| all.iter().map(|fared| fared.lost).sum::<u64>();
    if !theirs.is_empty() {
        let (mine, vendors) = (lost(&ours), lost(&theirs));
        println!("  lost {mine}, goal ≤ pylibfranka's {vendors}: {}\n", verdict(mine <= vendors));
    }
    Ok(())
}

/// Starts an emulated controller for one client. Returns how the client fared.
fn with_emulator(client: impl FnOnce(&str) -> Result<(), String>) -> Result<Fared, String> {
    let options = serde_json::json!({"model": "fr3"});
    let config = AdapterConfig { hardware_id: "arm".into(), address: String::new(), dof: 7, options };
    let place = EmulatorAddress::Bind([127, 0, 0, 61].into());
    let emulator = FrankaEmulator::start(&config, &place).map_err(|e| e.to_string())?;
    let address = emulator.address();
    client(&address)?;
    let (times, figures) = (emulator.answer_times(), emulator.figures());
    Ok(Fared {
        answers: [times.p50, times.p99, times.p99_9, times.max],
        cycles: figures.moved,
        lost: figures.lost,
        longest: figures.longest_loss,
    })
}

fn our_run(address: &str, time: Duration) -> Result<(), String> {
    let address = format!("hardware.arm.address={address}");
    let arguments = ["--set", &address, "--set", "coordinator.clock=device(arm)"];
    let mut run = LiveRun::start("coordinator-fr3", &arguments).map_err(|e| e.to_string())?;
    let mut client = run.client()?;
    keep_moving(&mut client, time.as_secs_f64())?;
    std::thread::sleep(time);
    run.end(|_| ())
}

fn vendor(python: &Path, address: &str, time: Duration) -> Result<(), String> {
    let ip = address.split(':').next().unwrap_or(address);
    let seconds = time.as_secs().to_string();
    let output = Command::new(python).args(["-c", VENDOR, ip, &seconds]).output().map_err(|e| e.to_string())?;
    let error = String::from_utf8_lossy(&output.stderr);
    if output.status.success() { Ok(()) } else { Err(error.lines().last().unwrap_or_default().to_owned()) }
}
