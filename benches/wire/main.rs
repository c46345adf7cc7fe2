//! `make bench`: latency of a command from the tick to the wire and of a state back, servo streams over minutes, and
//! decoding rates of packets. Prints and judges figures; no figure fails it.
//!
//! `cargo bench --bench wire -- [commands] [states] [streams] [decoding] [remote] [--quick]`

mod bed;
mod decoding;
#[path = "../../tests/support/delegate.rs"]
mod delegate;
mod relay;
mod round_trip;
#[path = "../support/mod.rs"]
#[allow(dead_code, reason = "shared with the other benchmarks")]
mod support;
mod timed;

use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use bed::{Arm, tick};
use dimos::arms::xarm;
use dimos::hardware::registry::{self, AdapterConfig, EmulatorAddress};
use dimos::joint::ControlMode;
use dimos::rt::heartbeat::Heartbeat;
use support::measure::{Goal, Measure, print, quantile};
use support::{Effort, machine};

/// The xArm's register for setpoints.
const SETPOINT: u8 = 29;

/// A part of the benchmark, by name.
type Part = (&'static str, fn(Effort) -> Result<(), String>);

const SERVO: Option<ControlMode> = Some(ControlMode::ServoPosition);

fn main() -> ExitCode {
    let effort = Effort::from_environment();
    println!("\ndimos: from the tick to the wire and back{}\n", effort.of(" (quick)", ""));
    machine::print();
    let named: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with("--")).collect();
    let parts: [Part; 5] = [
        ("commands", commands),
        ("states", states),
        ("streams", streams),
        ("decoding", decoding::measure),
        ("remote", round_trip::measure),
    ];
    for (name, part) in parts {
        // An arm that a stalled machine held measures nothing: once more.
        if (named.is_empty() || named.iter().any(|n| n == name))
            && let Err(why) = part(effort).or_else(|_| part(effort))
        {
            support::skipped(&format!("{name}: {why}"));
        }
    }
    effort.end()
}

fn config(adapter: &str, address: String, dof: usize) -> AdapterConfig {
    AdapterConfig { hardware_id: adapter.to_owned(), address, dof, options: serde_json::json!({}) }
}

/// Returns a built-in arm with its emulator.
fn arm(name: &str, dof: usize, period: Duration, beat: &Arc<Heartbeat>, room: usize) -> Result<Arm, String> {
    let text = |e: dimos::hardware::adapter::AdapterError| e.to_string();
    let emulator = dimos::arms::emulate(name, dof).map_err(text)?;
    let adapter = dimos::arms::create(name, &emulator.address(), dof).map_err(text)?;
    Arm::new(adapter, Box::new(emulator), period, beat, room)
}

/// Measures from the tick's write of a command to the end of the adapter's write: xArms, whose adapter does not wait
/// for replies.
fn commands(effort: Effort) -> Result<(), String> {
    let (rate, periods) = (100.0, effort.of(30, 1500));
    let period = Duration::from_secs_f64(1.0 / rate);
    for (count, goal) in [(1, 200.0), (2, 200.0), (8, 300.0)] {
        let (mut p50, mut p99) = (Vec::new(), Vec::new());
        for _ in 0..effort.of(1, 5) {
            let beat = Arc::new(Heartbeat::default());
            let arms: Result<Vec<Arm>, String> =
                (0..count).map(|_| arm("xarm", 7, period, &beat, 2 * periods as usize)).collect();
            let mut arms = arms?;
            tick(&mut arms, period, periods, &beat, SERVO);
            let delays: Vec<f64> = arms.iter().flat_map(|arm| arm.sent.lock().unwrap().clone()).collect();
            arms.into_iter().try_for_each(Arm::finish)?;
            p50.push(quantile(&delays, 0.5));
            p99.push(quantile(&delays, 0.99));
        }
        print(
            &format!("from the tick's write to the bytes on the socket, {count} xArm 7 at {rate} Hz"),
            &[
                Measure::new("p50", "µs", p50).goal(Goal::AtMost(100.0)),
                Measure::new("p99", "µs", p99).goal(Goal::AtMost(goal)),
            ],
        );
    }
    Ok(())
}

/// Measures from a report's first byte on its way to its state in the slot.
fn states(effort: Effort) -> Result<(), String> {
    let (period, periods) = (Duration::from_millis(10), effort.of(30, 1500));
    let (mut p50, mut p99) = (Vec::new(), Vec::new());
    for _ in 0..effort.of(1, 5) {
        let beat = Arc::new(Heartbeat::default());
        let emulator = dimos::arms::emulate("xarm", 7).map_err(|e| e.to_string())?;
        let address = relay::start(&emulator.address())?;
        let adapter = dimos::arms::create("xarm", &address, 7).map_err(|e| e.to_string())?;
        let mut arms = [Arm::new(adapter, Box::new(emulator), period, &beat, 3 * periods as usize)?];
        // Times pose as the positions of a joint, so nothing may be commanded.
        tick(&mut arms, period, periods, &beat, None);
        let delays = arms[0].arrived.lock().unwrap().clone();
        arms.into_iter().try_for_each(Arm::finish)?;
        p50.push(quantile(&delays, 0.5));
        p99.push(quantile(&delays, 0.99));
    }
    print(
        "from the wire to the state slot, xArm 7, 250 reports/s",
        &[Measure::new("p50", "µs", p50), Measure::new("p99", "µs", p99).goal(Goal::AtMost(200.0))],
    );
    Ok(())
}

/// Sends setpoints at the arm's own rate for a minute, and accounts for each.
fn streams(effort: Effort) -> Result<(), String> {
    let seconds: u64 = effort.of(1, 60);
    stream("xArm 6 at 250 Hz", 250, seconds, |period, beat, room| {
        let settings = config("xarm", "sim".into(), 6);
        let emulator = Arc::new(
            xarm::emulator::XArmEmulator::start(&settings, &EmulatorAddress::InProcess).map_err(|e| e.to_string())?,
        );
        emulator.record();
        let address = registry::Emulator::address(&*emulator);
        let adapter = dimos::arms::create("xarm", &address, 6).map_err(|e| e.to_string())?;
        let arm = Arm::new(adapter, Box::new(emulator.clone()), period, beat, room)?;
        let points = move || emulator.trace().iter().filter(|request| request.register == SETPOINT).count() as u64;
        Ok((arm, Box::new(points)))
    })?;
    stream("Piper at 200 Hz", 200, seconds, |period, beat, room| {
        use dimos::arms::piper;
        let settings = config("piper", "sim".into(), 6);
        let emulator = Arc::new(
            piper::emulator::PiperEmulator::start(&settings, &EmulatorAddress::InProcess).map_err(|e| e.to_string())?,
        );
        emulator.record();
        let address = registry::Emulator::address(&*emulator);
        let adapter = dimos::arms::create("piper", &address, 6).map_err(|e| e.to_string())?;
        let arm = Arm::new(adapter, Box::new(emulator.clone()), period, beat, room)?;
        // A setpoint is complete with its last frame.
        let points = move || emulator.trace().iter().filter(|(_, frame)| frame.id == 0x157).count() as u64;
        Ok((arm, Box::new(points)))
    })?;
    Ok(())
}

type Counted = (Arm, Box<dyn Fn() -> u64>);

fn stream(
    title: &str,
    rate: u32,
    seconds: u64,
    make: impl Fn(Duration, &Arc<Heartbeat>, usize) -> Result<Counted, String>,
) -> Result<(), String> {
    let (period, periods) = (Duration::from_secs(1) / rate, seconds * u64::from(rate));
    let beat = Arc::new(Heartbeat::default());
    let (arm, points) = make(period, &beat, 2 * periods as usize)?;
    let mut arms = [arm];
    let before = points();
    let counted = tick(&mut arms, period, periods, &beat, SERVO);
    let delivered = points() - before;
    arms.into_iter().try_for_each(Arm::finish)?;
    let unaccounted = counted.ticked.abs_diff(delivered + counted.overwritten);
    let percent = 100.0 * delivered as f64 / periods as f64;
    print(
        &format!("servo stream, {title}, {seconds} s: {periods} periods"),
        &[
            Measure::new("delivered to the emulator", "%", vec![percent]).goal(Goal::AtLeast(99.5)),
            Measure::new("skipped: the machine was stalled", "periods", vec![counted.skipped as f64]),
            Measure::new("overwritten before they were taken", "periods", vec![counted.overwritten as f64]),
            Measure::new("unaccounted", "periods", vec![unaccounted as f64]).goal(Goal::AtMost(0.0)),
            Measure::new("latest wake-up", "µs", vec![counted.latest]),
        ],
    );
    Ok(())
}
