//! `dimos arm payload ARM --identify`: finds the load at the flange from the arm's efforts at rest, at ten places, each
//! reached from both sides, so that friction is left out.

use std::fs;
use std::path::Path;
use std::thread::sleep;
use std::time::Duration;

use serde_json::json;

use super::super::exit::{Exit, Failure, Result};
use super::super::follow::{Signals, verdict};
use super::super::goal::has_planner;
use super::super::going;
use super::super::output;
use super::parts::PayloadArgs;
use dimos_rpc::api::{ArmPayloadFind, Go, GoStep, Move, Plan, PlanGoal, RestingEffort, State};
use dimos_rpc::client::Client;

/// Places that are measured, and how many are tried for them.
const PLACES: usize = 10;
const TRIED: usize = 40;
/// How far the places are from the present one: the last three joints, the others [rad].
const AROUND: (f64, f64) = (0.7, 0.15);
/// How far away each place is approached from [rad]: farther than joints are elastic.
const APPROACH: f64 = 0.06;
/// Speed of the motions.
const SPEED: f64 = 0.5;
/// Time to rest, then to measure, and between two readings.
const SETTLE: Duration = Duration::from_millis(300);
const MEASURE: Duration = Duration::from_millis(300);
const PERIOD: Duration = Duration::from_millis(10);

/// Runs it.
pub fn run(args: &PayloadArgs) -> Result {
    let (mut client, arm) = (args.which.target_run.connect()?, args.which.arm.clone());
    let unloaded = args.unloaded.as_deref().map(read).transpose()?;
    let signals = Signals::watch();
    let planned = has_planner(&mut client)?;
    let start = resting(&mut client, &arm)?.position;
    let mut loaded: Vec<RestingEffort> = Vec::new();
    let given = unloaded.as_ref().map(|list| list.iter().map(|at| at.position.clone()).collect::<Vec<_>>());
    let tried = given.clone().unwrap_or_else(|| (1..=TRIED).map(|number| place(&start, number)).collect());
    let wanted = given.map_or(PLACES, |list| list.len());
    let mut refused = None;
    for position in tried {
        if loaded.len() == wanted {
            break;
        }
        signals.check()?;
        match from_both_sides(&mut client, &arm, &position, planned, &signals) {
            Ok(at) => {
                loaded.push(at);
                output::note(format_args!("place {} of {wanted} measured", loaded.len()));
            }
            // Out of reach or in the way: another one is tried, unless the places are given.
            Err(failure) if unloaded.is_some() || failure.exit != Exit::Failed => return Err(failure),
            Err(failure) => refused = Some(failure),
        }
    }
    go_to(&mut client, &arm, &[start], planned, &signals)?;
    if loaded.len() < wanted {
        let why = refused.map_or(String::new(), |failure| format!(": {}", failure.what));
        let what = format!("only {} of {wanted} places can be reached around this one{why}", loaded.len());
        return Err(Failure::new(Exit::Failed, what).hint("begin where the wrist has room to turn"));
    }
    if let Some(file) = &args.save {
        let failed = |e| Failure::new(Exit::Failed, format!("{}: {e}", file.display()));
        fs::write(file, json!(loaded).to_string()).map_err(failed)?;
    }
    let found = client.call(ArmPayloadFind { arm: arm.clone(), loaded, unloaded: unloaded.unwrap_or_default() })?;
    if args.which.target_run.json {
        output::json(&found);
        return Ok(Exit::Ok);
    }
    let worst = found.residual.iter().copied().fold(0.0, f64::max);
    let mass = output::fixed(found.mass, 3);
    match found.center {
        None => output::line(format_args!("{arm}: no load: {mass} kg; up to {worst:.2} Nm unexplained")),
        Some(center) => {
            let center = center.map(|value| output::fixed(value, 4)).join(" ");
            output::line(format_args!("{arm}: {mass} kg, centre {center} m; up to {worst:.2} Nm unexplained"));
            output::line(format_args!("to set it: dimos arm payload {arm} --mass {mass} --center {center}"));
        }
    }
    Ok(Exit::Ok)
}

fn read(file: &Path) -> Result<Vec<RestingEffort>> {
    let failed = |what: String| {
        let failure = Failure::usage(format!("{}: {what}", file.display()));
        failure.hint("`dimos arm payload ARM --identify --save FILE` writes it, without the load")
    };
    let text = fs::read_to_string(file).map_err(|e| failed(e.to_string()))?;
    serde_json::from_str(&text).map_err(|e| failed(e.to_string()))
}

/// Returns a place around the start: joints vary independently, by the fractional parts of multiples of the roots of
/// primes (the Richtmyer sequence).
fn place(start: &[f64], number: usize) -> Vec<f64> {
    const PRIMES: [f64; 8] = [2.0, 3.0, 5.0, 7.0, 11.0, 13.0, 17.0, 19.0];
    let wrist = start.len().saturating_sub(3);
    let joint = |(joint, q): (usize, &f64)| {
        let root = PRIMES.get(joint % PRIMES.len()).copied().unwrap_or(2.0).sqrt();
        let part = (number as f64 * root).fract();
        let around = if joint >= wrist { AROUND.0 } else { AROUND.1 };
        q + around * (2.0 * part - 1.0)
    };
    start.iter().enumerate().map(joint).collect()
}

/// Measures a place that is reached from below and from above: the mean has no Coulomb friction.
fn from_both_sides(
    client: &mut Client,
    arm: &str,
    position: &[f64],
    planned: bool,
    signals: &Signals,
) -> Result<RestingEffort> {
    let mut sides = Vec::new();
    for side in [-APPROACH, APPROACH] {
        let before: Vec<f64> = position.iter().map(|q| q + side).collect();
        go_to(client, arm, &[before, position.to_vec()], planned, signals)?;
        sleep(SETTLE);
        sides.push(resting(client, arm)?);
    }
    let mean = |of: fn(&RestingEffort) -> &Vec<f64>| {
        let lists: Vec<&Vec<f64>> = sides.iter().map(of).collect();
        (0..position.len())
            .map(|joint| lists.iter().filter_map(|list| list.get(joint)).sum::<f64>() / lists.len() as f64)
            .collect()
    };
    Ok(RestingEffort { position: mean(|at| &at.position), effort: mean(|at| &at.effort) })
}

/// Moves the arm to these positions, one after the other.
fn go_to(client: &mut Client, arm: &str, positions: &[Vec<f64>], planned: bool, signals: &Signals) -> Result {
    let step = |position: &Vec<f64>| match planned {
        true => {
            let goal = PlanGoal { robot: arm.to_owned(), joints: Some(position.clone()), ..PlanGoal::default() };
            GoStep::Plan(Box::new(Plan { goals: vec![goal], speed: SPEED, by_number: true, ..Plan::default() }))
        }
        false => GoStep::Move(Box::new(Move::new(arm.to_owned(), position.clone(), SPEED))),
    };
    let steps = positions.iter().map(step).collect::<Vec<_>>();
    let count = steps.len();
    let going = client.call(Go { steps, ..Go::default() })?.going;
    for step in 0..count {
        let begun = going::begin(client, (going, step), Some(signals), false)?;
        let (report, cancelled) = going::follow(client, going, &begun.reply, arm, signals)?;
        if let Some(signal) = cancelled {
            return Err(Failure::new(Exit::by_signal(signal), "interrupted: nothing was found"));
        }
        verdict(client, &report, None)?;
    }
    Ok(Exit::Ok)
}

/// Returns where the arm is and what holds it: the mean of some readings.
fn resting(client: &mut Client, arm: &str) -> Result<RestingEffort> {
    let mut sum: Option<RestingEffort> = None;
    let readings = (MEASURE.as_millis() / PERIOD.as_millis()).max(1);
    for _ in 0..readings {
        let state = client.call(State {})?;
        let Some(own) = state.arms.iter().find(|own| own.hardware_id == arm) else {
            return Err(Failure::usage(format!("the run has no arm {arm}")).hint("`dimos status` lists them"));
        };
        let both: Option<Vec<(f64, f64)>> = own.joints.iter().map(|joint| joint.position.zip(joint.effort)).collect();
        let Some(both) = both else {
            let failure = Failure::new(Exit::Failed, format!("{arm} reports no efforts of its joints at present"));
            return Err(failure.hint("`dimos list-adapters` shows which arms do; the motors must be on"));
        };
        let at =
            sum.get_or_insert_with(|| RestingEffort { position: vec![0.0; both.len()], effort: vec![0.0; both.len()] });
        for ((q, effort), (position, measured)) in at.position.iter_mut().zip(&mut at.effort).zip(both) {
            *q += position / readings as f64;
            *effort += measured / readings as f64;
        }
        sleep(PERIOD);
    }
    Ok(sum.unwrap_or_default())
}
