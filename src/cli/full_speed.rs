//! The first motions of an arm that this user has not driven yet are slow, until `dimos arm full-speed ARM`: a wrong
//! model, tool or joint order shows before it hurts. Kept by serial number, else by address, in
//! `$XDG_STATE_HOME/dimos/full-speed.json`. Simulated arms, and those behind loopback addresses and pseudo-terminals,
//! are not slowed.

use std::collections::BTreeSet;
use std::fs;
use std::path::PathBuf;

use super::arm::ArmArgs;
use super::exit::{Exit, Failure, Result};
use super::output;
use dimos_core::bounded;
use dimos_log::files::log_folder;
use dimos_rpc::api::{Planner, State, Status};
use dimos_rpc::client::{Client, ClientError};
use dimos_rpc::error::Code;
use dimos_rpc::report::ArmReport;

/// Fraction of its speed at which an arm moves that is new to this user.
const FIRST: f64 = 0.25;

/// Returns the largest speed of a motion of these arms and robots of the planner (names): a fraction of their limits.
/// Says so if it is not 1.
pub fn limit(client: &mut Client, names: &[String]) -> Result<f64> {
    limit_of(client, |client| {
        let robots = match client.call(Planner {}) {
            Ok(planner) => planner.robots.into_iter(),
            Err(ClientError::Refused(refusal)) if refusal.code == Code::NoPlanner => Vec::new().into_iter(),
            // Its robots may move an arm that is new.
            Err(error) => return Err(error.into()),
        };
        let arms = client.call(State {})?.arms.into_iter();
        let arms =
            arms.map(|arm| (arm.hardware_id, arm.joints.into_iter().map(|joint| joint.name).collect::<Vec<_>>()));
        let both = robots.map(|robot| (robot.name, robot.joints)).chain(arms);
        Ok(Some(both.filter(|(name, _)| names.contains(name)).flat_map(|(_, joints)| joints).collect()))
    })
}

/// Returns it for a motion of the joints that `joints` finds; it is asked only if an arm of the run is new. `None`: the
/// motion may be of any joint.
pub fn limit_of(client: &mut Client, joints: impl FnOnce(&mut Client) -> Result<Option<Vec<String>>>) -> Result<f64> {
    let known = known();
    let mut arms = client.call(Status {})?.arms;
    arms.retain(|arm| !is_pretended(arm) && !known.contains(&key(arm)));
    if arms.is_empty() {
        return Ok(1.0);
    }
    let (joints, state) = (joints(client)?, client.call(State {})?.arms);
    let moves = |arm: &&ArmReport| {
        let own = state.iter().filter(|own| own.hardware_id == arm.hardware_id).flat_map(|own| &own.joints);
        { own }.any(|joint| joints.as_ref().is_none_or(|joints| joints.contains(&joint.name)))
    };
    let Some(arm) = arms.iter().find(moves).map(|arm| &arm.hardware_id) else { return Ok(1.0) };
    let part = 100.0 * FIRST;
    output::note(format_args!(
        "{arm} is new to you: at most {part:.0} % of its speed until `dimos arm full-speed {arm}`"
    ));
    Ok(FIRST)
}

/// Runs `arm full-speed`.
pub fn run(args: &ArmArgs) -> Result {
    let arms = args.target_run.connect()?.call(Status {})?.arms;
    let names = arms.iter().map(|arm| arm.hardware_id.as_str());
    let Some(arm) = arms.iter().find(|arm| arm.hardware_id == args.arm) else {
        let hint = dimos_yaml::did_you_mean(&args.arm, names, "the run's arms");
        return Err(Failure::usage(format!("the run has no arm {}", args.arm)).maybe_hint(hint));
    };
    let name = &arm.hardware_id;
    if is_pretended(arm) {
        output::line(format_args!("{name}: at full speed; it is simulated, or on this computer"));
        return Ok(Exit::Ok);
    }
    let mut known = known();
    known.insert(key(arm));
    keep(&known).map_err(|why| Failure::new(Exit::Failed, format!("{name} is not kept: {why}")))?;
    output::line(format_args!("{name}: at full speed from now on, as {}", key(arm)));
    Ok(Exit::Ok)
}

/// Returns what an arm is known by: its serial number, else its address.
fn key(arm: &ArmReport) -> String {
    let serial = arm.identity.as_deref().and_then(|identity| identity.strip_prefix("serial "));
    match serial {
        Some(serial) => format!("{} with the serial number {serial}", arm.adapter),
        None => format!("{} at {}", arm.adapter, arm.address),
    }
}

/// Returns whether nothing can be hurt: an emulator, or something that a program on the run's computer speaks for. The
/// run says so: its loopback address is not that of a client elsewhere.
fn is_pretended(arm: &ArmReport) -> bool {
    arm.simulated || arm.local
}

fn file() -> Option<PathBuf> {
    Some(log_folder()?.join("full-speed.json"))
}

/// Returns the arms that have been released; none if the file cannot be read.
fn known() -> BTreeSet<String> {
    let text = file().and_then(|file| bounded::read_text(&file, bounded::SMALL).ok());
    text.and_then(|text| serde_json::from_str(&text).ok()).unwrap_or_default()
}

fn keep(known: &BTreeSet<String>) -> std::io::Result<()> {
    let file = file().ok_or_else(|| std::io::Error::other("no folder: set HOME or XDG_STATE_HOME"))?;
    file.parent().map_or(Ok(()), fs::create_dir_all)?;
    let new = file.with_extension(format!("json.{}", std::process::id()));
    fs::write(&new, serde_json::to_string_pretty(known).unwrap_or_default() + "\n")?;
    fs::rename(&new, &file)
}
