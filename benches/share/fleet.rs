//! A fleet: many runs behind one router, listed and stopped from one place.

use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use crate::judge::Judge;
use crate::support::Effort;
use crate::support::measure::{Goal, Measure, print};
use crate::support::run::LiveRun;
use crate::{eventually, free_port, text};

/// Measures the listing and the stop of all runs, by the real verbs from their start to their end.
pub fn measure(effort: Effort) -> Result<(), String> {
    let count = effort.of(2, 50);
    let at = format!("tcp/127.0.0.1:{}", free_port());
    let _router = Judge::router(&at)?;
    let connect = format!("share.connect=[{at}]");
    let mut runs = Vec::new();
    for number in 0..count {
        let name = format!("cell{number}");
        let set = ["--set", &connect, "--set", "coordinator.tick_rate=20", "--no-view"];
        runs.push(LiveRun::named("coordinator-mock", &name, &set).map_err(text)?);
        // Each is up before the next: 50 at once take longer than their limits.
        eventually("a run is up", || runs.last_mut().is_some_and(|run| run.client().is_ok()))?;
    }
    let listed = || dimos::share::runs(&at).map_or(0, |runs| runs.len());
    let began = Instant::now();
    while listed() < count && began.elapsed() < Duration::from_secs(60) {
        std::thread::sleep(Duration::from_millis(100));
    }
    let verb = |arguments: &str| -> Result<(f64, usize), String> {
        let mut command = Command::new(env!("CARGO_BIN_EXE_dimos"));
        command.args(["--at", &at]).args(arguments.split(' ')).stdin(Stdio::null());
        let began = Instant::now();
        let output = command.output().map_err(text)?;
        let took = began.elapsed().as_secs_f64();
        let printed: serde_json::Value = serde_json::from_slice(&output.stdout).map_err(text)?;
        Ok((took, printed.as_array().map_or_else(|| printed.as_object().map_or(0, |o| o.len()), Vec::len)))
    };
    let (mut names, mut listing, mut stopping) = (Vec::new(), Vec::new(), Vec::new());
    let (mut seen, mut stopped) = (Vec::new(), Vec::new());
    for _ in 0..effort.of(1, 5) {
        let began = Instant::now();
        let found = listed();
        names.push(began.elapsed().as_secs_f64());
        let (took, all) = verb("status --json")?;
        listing.push(took);
        seen.push(all.min(found) as f64);
        let (took, all) = verb("stop --json")?;
        stopping.push(took);
        stopped.push(all as f64);
    }
    print(
        &format!("{count} runs (mocks, 20 Hz) behind one router"),
        &[
            Measure::new("names of the runs", "s", names),
            Measure::new("`dimos status --at ROUTER`", "s", listing).goal(Goal::AtMost(1.0)),
            Measure::new("runs listed", "", seen).goal(Goal::AtLeast(count as f64)),
            Measure::new("`dimos stop --at ROUTER`", "s", stopping).goal(Goal::AtMost(1.0)),
            Measure::new("runs stopped", "", stopped).goal(Goal::AtLeast(count as f64)),
        ],
    );
    Ok(())
}
