//! `make bench`: cost of a tick and of a run. Prints and judges figures; no figure fails it.
//! `cargo bench --bench control -- ticks arms tasks guard start runs` runs only the named parts.

mod bed;
mod guard;
mod live;
#[path = "../support/mod.rs"]
#[allow(dead_code, reason = "shared with the other benchmark")]
mod support;
mod tick;

use std::collections::BTreeMap;
use std::process::ExitCode;
use std::time::Duration;

use bed::Load;
use live::Cost;
use support::measure::{Goal, Measure, print, quantile};
use support::{Effort, machine};
use tick::{Pace, Plant, Ticks};

/// Two 7-joint arms, for the goal of the tick.
const TWO_ARMS: &str = include_str!("two-arms.yaml");

fn main() -> ExitCode {
    let effort = Effort::from_environment();
    println!("\ndimos: cost of a tick and of a run{}\n", effort.of(" (quick)", ""));
    machine::print();
    let before = machine::CpuTimes::now();
    // As in a run: memory locked, deep idle states disabled, if permitted.
    let (_grants, _hold) = dimos::rt::host::prepare_process(true);
    type Section = (&'static str, fn(Effort));
    let sections: [Section; 6] =
        [("ticks", ticks), ("arms", arms), ("tasks", task_types), ("guard", guarded), ("start", start), ("runs", runs)];
    let named: Vec<String> = std::env::args().collect();
    let all = sections.iter().all(|(name, _)| !named.iter().any(|n| n == name));
    for (_, section) in sections.iter().filter(|(name, _)| all || named.iter().any(|n| n == name)) {
        section(effort);
    }
    let (busy, stolen) = machine::CpuTimes::since(before);
    println!("during the measurement: {busy:.0} % of all cores busy, {stolen:.2} % stolen by the hypervisor");
    effort.end()
}

fn repeat(times: usize, mut measure: impl FnMut() -> Ticks) -> Vec<Ticks> {
    (0..times).map(|_| measure()).collect()
}

/// Returns the quantile of each repeat [µs].
fn micros(repeats: &[Ticks], q: f64) -> Vec<f64> {
    repeats.iter().map(|r| quantile(&r.times, q) * 1e-3).collect()
}

fn ticks(effort: Effort) {
    let (free, paced) = (effort.of(1_000, 100_000), effort.of(30, 1000));
    let alone = repeat(effort.of(1, 7), || tick::coordinator(2, Load::Trajectory, Pace::Free, free));
    let whole = repeat(effort.of(1, 7), || tick::whole(2, Load::Trajectory, Pace::Free, Plant::Ideal, free));
    let cold = repeat(effort.of(1, 3), || tick::coordinator(2, Load::Trajectory, Pace::Paced, paced));
    let whole_cold = repeat(effort.of(1, 3), || tick::whole(2, Load::Trajectory, Pace::Paced, Plant::Ideal, paced));
    let mock = repeat(effort.of(1, 7), || tick::whole(1, Load::Trajectory, Pace::Free, Plant::Mock, free));
    let sleeper = (0..effort.of(1, 3)).map(|_| tick::sleeper(paced)).collect();
    let sleeper = Measure::new("for comparison: a thread that only sleeps, p50", "µs", sleeper);
    let goal = Goal::AtMost(20.0);
    print(
        "Tick, two 7-joint arms on trajectories",
        &[
            Measure::new("Coordinator::tick, free-running, p50", "µs", micros(&alone, 0.5)),
            Measure::new("Coordinator::tick, free-running, p99", "µs", micros(&alone, 0.99)).goal(goal),
            Measure::new("Coordinator::tick, at 100 Hz, p50", "µs", micros(&cold, 0.5)),
            Measure::new("Coordinator::tick, at 100 Hz, p99", "µs", micros(&cold, 0.99)).goal(goal),
            Measure::new("whole tick with slots and rings, free-running, p50", "µs", micros(&whole, 0.5)),
            Measure::new("whole tick with slots and rings, free-running, p99", "µs", micros(&whole, 0.99)).goal(goal),
            Measure::new("its processor time at 100 Hz, with sleep and wake-up, p50", "µs", micros(&whole_cold, 0.5)),
            Measure::new("its processor time at 100 Hz, with sleep and wake-up, p99", "µs", micros(&whole_cold, 0.99)),
            sleeper,
        ],
    );
    let rate = mock.iter().map(|r| r.rate * 1e-3).collect();
    print(
        "Ticks per second, one 7-joint mock arm on a trajectory, everything on one thread",
        &[
            Measure::new("free-running", "kHz", rate).goal(Goal::AtLeast(100.0)),
            Measure::new("quoted, not measured here: the Python system on the same kind of machine", "kHz", vec![21.0]),
        ],
    );
}

fn arms(effort: Effort) {
    let ticks = effort.of(1_000, 50_000);
    let mut rows = Vec::new();
    for arms in [1, 2, 8, 32] {
        let alone = repeat(effort.of(1, 5), || tick::coordinator(arms, Load::Trajectory, Pace::Free, ticks / arms));
        let whole =
            repeat(effort.of(1, 5), || tick::whole(arms, Load::Trajectory, Pace::Free, Plant::Ideal, ticks / arms));
        let name = |what| format!("{arms:2} arms, {what}");
        rows.push(Measure::new(name("Coordinator::tick p50"), "µs", micros(&alone, 0.5)));
        rows.push(Measure::new(name("Coordinator::tick p99"), "µs", micros(&alone, 0.99)));
        rows.push(Measure::new(name("whole tick p50"), "µs", micros(&whole, 0.5)));
        rows.push(Measure::new(name("whole tick p99"), "µs", micros(&whole, 0.99)));
    }
    print("Tick by number of 7-joint arms on trajectories, free-running", &rows);
}

fn task_types(effort: Effort) {
    let ticks = effort.of(1_000, 50_000);
    let mut rows = Vec::new();
    for (name, arms, load) in [
        ("two held arms", 2, Load::Hold),
        ("two trajectories", 2, Load::Trajectory),
        ("two servo streams, a target each tick", 2, Load::Servo),
        ("two velocity streams, a target each tick", 2, Load::Velocity),
        ("two end effectors, a twist each tick", 2, Load::Twist),
        ("three arms: trajectory, servo, velocity", 3, Load::EveryType),
    ] {
        let alone = repeat(effort.of(1, 5), || tick::coordinator(arms, load, Pace::Free, ticks));
        rows.push(Measure::new(format!("{name}, p50"), "µs", micros(&alone, 0.5)));
        rows.push(Measure::new(format!("{name}, p99"), "µs", micros(&alone, 0.99)));
    }
    print("Coordinator::tick by type of task, free-running", &rows);
}

fn guarded(effort: Effort) {
    let ticks = effort.of(1_000, 20_000);
    let mut rows = Vec::new();
    for (name, guarded, streams) in [
        ("without a guard, random poses", false, guard::Streams::Random),
        ("random poses", true, guard::Streams::Random),
        ("pushing at each other", true, guard::Streams::Push),
    ] {
        let (alone, stops): (Vec<Ticks>, Vec<usize>) =
            (0..effort.of(1, 5)).map(|_| guard::ticks(guarded, streams, ticks)).unzip();
        for (quantile, text) in [(0.5, "p50"), (0.95, "p95"), (0.99, "p99")] {
            let row = Measure::new(format!("{name}, {text}"), "µs", micros(&alone, quantile));
            rows.push(if guarded && quantile == 0.99 { row.goal(Goal::AtMost(50.0)) } else { row });
        }
        let stops = stops.iter().map(|stops| *stops as f64).collect();
        rows.push(Measure::new(format!("{name}, stops of arms"), "", stops));
    }
    print("Coordinator::tick with the collision guard, two 7-joint arms, 10 000 points, streams, free-running", &rows);
}

fn start(effort: Effort) {
    let repeats = |blueprint| (0..effort.of(1, 15)).map(move |_| live::start_up(blueprint));
    let mut rows = Vec::new();
    for blueprint in ["coordinator-yourarm", "coordinator-mock"] {
        let (known, readable) = match repeats(blueprint).collect::<Result<Vec<_>, _>>() {
            Ok(all) => all.into_iter().map(|s| (s.known, s.readable)).unzip(),
            Err(e) => return support::skipped(&format!("start-up of {blueprint}: {e}")),
        };
        rows.push(Measure::new(format!("{blueprint}, until the tick receives it"), "ms", known));
        let goal = Goal::AtMost(50.0);
        rows.push(Measure::new(format!("{blueprint}, until it is in the log file"), "ms", readable).goal(goal));
    }
    print("From the start of the process to its first joint state", &rows);
}

/// A measured run: name, blueprint, and goals for processor time and memory.
struct Case<'a> {
    name: &'a str,
    blueprint: &'a str,
    arguments: &'a [&'a str],
    cpu: Option<f64>,
    memory: Option<f64>,
}

fn runs(effort: Effort) {
    if let Err(e) = try_runs(effort) {
        support::skipped(&format!("runs of the binary: {e}"));
    }
}

fn try_runs(effort: Effort) -> Result<(), String> {
    let folder = tempfile::tempdir().map_err(|e| e.to_string())?;
    let two = folder.path().join("two-arms.yaml");
    std::fs::write(&two, TWO_ARMS).map_err(|e| e.to_string())?;
    let case = |name, blueprint, cpu, memory| Case { name, blueprint, arguments: &[], cpu, memory };
    let cases = [
        case("coordinator-yourarm, emulator included", "coordinator-yourarm", Some(3.0), Some(20.0)),
        case("coordinator-mock", "coordinator-mock", Some(1.5), Some(20.0)),
        case("two 7-joint mock arms", two.to_str().unwrap_or_default(), None, None),
    ];
    let time = Duration::from_secs(effort.of(1, 10));
    let mut all: Vec<Vec<Cost>> = cases.iter().map(|_| Vec::new()).collect();
    // Interleaved, so that a busy minute of the machine affects all of them.
    for _ in 0..effort.of(1, 5) {
        for (case, costs) in cases.iter().zip(&mut all) {
            match live::cost(case.blueprint, case.arguments, time) {
                Ok(cost) => costs.push(cost),
                Err(e) => support::skipped(&format!("a run of {}: {e}", case.blueprint)),
            }
        }
    }
    for (case, costs) in cases.iter().zip(&all) {
        print_run(case, costs);
    }
    Ok(())
}

fn print_run(case: &Case<'_>, costs: &[Cost]) {
    let each = |f: &dyn Fn(&Cost) -> f64| costs.iter().map(f).collect::<Vec<_>>();
    let with = |measure: Measure, most: Option<f64>| match most {
        Some(most) => measure.goal(Goal::AtMost(most)),
        None => measure,
    };
    let mut threads: BTreeMap<&str, Vec<f64>> = BTreeMap::new();
    for (name, used) in costs.iter().flat_map(|c| &c.threads) {
        threads.entry(name).or_default().push(*used);
    }
    let mut rows = vec![with(Measure::new("processor, all threads", "% of a core", each(&Cost::total)), case.cpu)];
    for (name, used) in threads {
        let measure = Measure::new(format!("  thread {name}"), "% of a core", used);
        rows.push(with(measure, (name == "tick").then_some(0.5)));
    }
    rows.push(Measure::new("memory, resident", "MiB", each(&|c| c.memory.now)));
    rows.push(with(Measure::new("peak resident memory", "MiB", each(&|c| c.memory.most)), case.memory));
    let compute = |q| each(&|c| quantile(&c.compute, q));
    rows.push(Measure::new("tick, wake-up to the last command passed on, p50", "µs", compute(0.5)));
    rows.push(
        Measure::new("tick, wake-up to the last command passed on, p99", "µs", compute(0.99)).goal(Goal::AtMost(20.0)),
    );
    print(&format!("Run at 100 Hz in motion, recorded: {}", case.name), &rows);
}
