//! Requests: round trips, stops alone and beside a flood, memory of the gateway.

use std::time::{Duration, Instant};

use dimos::rpc::api::{State, Stop};
use dimos::rpc::client::Client;
use serde_json::json;

use crate::judge::Judge;
use crate::support::Effort;
use crate::support::measure::{Goal, Measure, print, quantile};
use crate::support::process;
use crate::{Shared, text};

/// Round trips of a request [ms].
fn times(client: &mut Client, count: usize, ask: fn(&mut Client) -> Result<(), String>) -> Result<Vec<f64>, String> {
    (0..count)
        .map(|_| {
            let began = Instant::now();
            ask(client).map(|()| began.elapsed().as_secs_f64() * 1e3)
        })
        .collect()
}

fn state(client: &mut Client) -> Result<(), String> {
    client.call(State {}).map(drop).map_err(text)
}

fn stop(client: &mut Client) -> Result<(), String> {
    client.call(Stop { arm: None }).map(drop).map_err(text)
}

/// Measures request and reply of `state`, from our client and from eclipse-zenoh.
pub fn round_trips(effort: Effort) -> Result<(), String> {
    let (mut ours, mut theirs) = ([Vec::new(), Vec::new()], [Vec::new(), Vec::new()]);
    let mut why_not = None;
    for _ in 0..effort.of(1, 5) {
        let shared = Shared::start("coordinator-mock", 1000)?;
        let mut client = shared.connect()?;
        times(&mut client, 100, state)?;
        let took = times(&mut client, effort.of(200, 5000), state)?;
        ours[0].push(quantile(&took, 0.5));
        ours[1].push(quantile(&took, 0.99));
        match Judge::open(&shared.at) {
            Ok(mut judge) => {
                let count = effort.of(100, 2000);
                let took = judge.does("rounds", json!({"method": "state", "cls": "read", "count": count}))?;
                let took: Vec<f64> = took.as_array().into_iter().flatten().filter_map(|ms| ms.as_f64()).collect();
                theirs[0].push(quantile(&took, 0.5));
                theirs[1].push(quantile(&took, 0.99));
            }
            Err(why) => why_not = Some(why),
        }
    }
    let [p50, p99] = ours;
    let mut measures = vec![
        Measure::new("our client, p50", "ms", p50).goal(Goal::AtMost(0.35)),
        Measure::new("our client, p99", "ms", p99).goal(Goal::AtMost(1.5)),
    ];
    if why_not.is_none() {
        let [p50, p99] = theirs;
        measures.push(Measure::new("eclipse-zenoh, p50", "ms", p50).goal(Goal::AtMost(0.6)));
        measures.push(Measure::new("eclipse-zenoh, p99", "ms", p99).goal(Goal::AtMost(3.0)));
    }
    print("round trip of `state`, coordinator-mock at 1 kHz", &measures);
    why_not.map_or(Ok(()), |why| Err(format!("eclipse-zenoh: {why}")))
}

/// Measures `stop` here, from another computer, and from there beside a flood of another client.
pub fn stops(effort: Effort) -> Result<(), String> {
    let mut shared = Shared::start("coordinator-mock", 1000)?;
    let count = effort.of(20, 500);
    let here = times(&mut shared.run.client()?, count, stop)?;
    let mut client = shared.connect()?;
    let there = times(&mut client, count, stop)?;
    let more = quantile(&there, 0.99) - quantile(&here, 0.99);
    let mut measures = vec![
        Measure::new("here", "ms", here),
        Measure::new("from another computer", "ms", there),
        Measure::new("p99 there less p99 here", "ms", vec![more]).goal(Goal::AtMost(2.0)),
    ];
    let mut flooded = Vec::new();
    for _ in 0..effort.of(1, 10) {
        let mut judge = Judge::open(&shared.at)?;
        let flood =
            std::thread::spawn(move || judge.does("flood", json!({"method": "state", "cls": "read", "count": 2000})));
        std::thread::sleep(Duration::from_millis(50));
        flooded.extend(times(&mut client, 10, stop)?);
        flood.join().map_err(|_| "the flood has failed")??;
    }
    let most = quantile(&flooded, 1.0);
    measures.push(Measure::new("beside 2000 queries at once", "ms", flooded));
    measures.push(Measure::new("the slowest of these", "ms", vec![most]).goal(Goal::AtMost(100.0)));
    print("`stop` of all arms, confirmed", &measures);
    Ok(())
}

/// Measures the gateway's memory: at the start, with 32 clients, and after a message of 200 MiB.
pub fn memory(effort: Effort) -> Result<(), String> {
    let (mut start, mut clients, mut huge) = (Vec::new(), Vec::new(), Vec::new());
    for _ in 0..effort.of(1, 3) {
        let mut shared = Shared::start("coordinator-mock", 100)?;
        let gateway = shared.gateway()?;
        start.push(process::memory(gateway).now);
        let mut open: Vec<Client> = (0..32).map(|_| shared.connect()).collect::<Result<_, _>>()?;
        open.iter_mut().try_for_each(state)?;
        clients.push(process::memory(gateway).now);
        drop(open);
        std::thread::sleep(Duration::from_millis(1500));
        let before = process::memory(gateway).now;
        let mut judge = Judge::open(&shared.at)?;
        judge.does("ask", json!({"cls": "read", "method": "state", "size": 200 << 20, "timeout": 3.0}))?;
        huge.push(process::memory(gateway).most - before);
        state(&mut shared.connect()?)?;
    }
    print(
        "memory of the gateway",
        &[
            Measure::new("at the start", "MiB", start).goal(Goal::AtMost(30.0)),
            Measure::new("with 32 clients", "MiB", clients).goal(Goal::AtMost(80.0)),
            Measure::new("more at most, during and after a message of 200 MiB", "MiB", huge).goal(Goal::AtMost(32.0)),
        ],
    );
    Ok(())
}
