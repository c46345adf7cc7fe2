//! `dimos move ARM …`: moves one arm or several together to joint positions, a pose or a named pose. With a planner in
//! the run the motion is planned and collision-free; without one it is direct.

use super::arguments::Target;
use super::exit::{Exit, Failure, Result};
use super::follow::{Signals, follow};
use super::goal::{Goal, Search, has_planner, plan, show};
use super::output;
use crate::rpc::api::{ExecutePlan, Move, Poses, State};
use crate::rpc::client::Client;

/// Arguments of `move`.
#[derive(Debug, clap::Args)]
#[command(
    override_usage = "\
dimos move ARM Q… [OPTIONS]
       dimos move ARM --named NAME [OPTIONS]
       dimos move ARM --pose X Y Z [--rpy R P Y | --quat X Y Z W] [OPTIONS]
       dimos move --goal ARM=GOAL… [OPTIONS]",
    after_help = "\
With a planner in the run the motion is planned and collision-free; without one it is direct, not collision-checked, and \
its goal is given as joint positions.

  dimos move arm 0.3 -0.2 0.5 0 0.4 0
  dimos move arm --pose 0.3 0.1 0.4 --rpy 0 1.57 0
  dimos move arm --named home
  dimos move --goal left=named:home --goal right=0.5,-0.3,0.6,0,0.8,0"
)]
pub struct Args {
    /// Name of the arm (hardware_id); with several arms use --goal for each
    #[arg(required_unless_present = "several", conflicts_with = "several")]
    pub arm: Option<String>,
    /// Goal of the motion
    #[command(flatten)]
    pub goal: Goal,
    /// Settings of the search
    #[command(flatten)]
    pub search: Search,
    /// Move straight in joint space even if the run has a planner: not collision-checked
    #[arg(long, conflicts_with_all = ["tcp", "several"])]
    pub direct: bool,
    /// If an obstacle blocks the motion, stop, plan again and continue
    #[arg(long, conflicts_with_all = ["direct", "no_wait"])]
    pub replan: bool,
    /// Return when the motion has begun
    #[arg(long)]
    pub no_wait: bool,
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let mut client = args.target_run.connect()?;
    let signals = Signals::watch();
    let planned = !args.direct && has_planner(&mut client)?;
    let (motion, task, reply) =
        if planned { plan_and_begin(args, &mut client, &signals)? } else { begin_direct(args, &mut client, &signals)? };
    if !args.no_wait {
        return follow(&mut client, motion, &task, &signals, args.target_run.json);
    }
    if args.target_run.json {
        output::json(&reply);
    }
    Ok(Exit::Ok)
}

type Begun = (u64, String, serde_json::Value);

fn plan_and_begin(args: &Args, client: &mut Client, signals: &Signals) -> Result<Begun> {
    let request = args.goal.plan(args.arm.as_deref(), &args.search);
    let planned = plan(client, request, signals)?;
    if !args.target_run.json {
        show(&planned);
    }
    signals.check()?;
    let begun = client.call(ExecutePlan { plan: Some(planned.plan), replan: args.replan, ..ExecutePlan::default() })?;
    output::note(format_args!("motion {} on {}: planned, collision-checked", begun.motion, begun.task));
    let reply = serde_json::to_value(&begun).unwrap_or_default();
    Ok((begun.motion, begun.task, reply))
}

fn begin_direct(args: &Args, client: &mut Client, signals: &Signals) -> Result<Begun> {
    let target = match (&args.arm, args.goal.joints(), &args.goal.named) {
        (Some(arm), Some(target), _) => Some((arm, target.to_vec())),
        (Some(arm), None, Some(name)) => Some((arm, saved(client, arm, name)?)),
        _ => None,
    };
    let Some((arm, target)) = target else {
        let failure = Failure::new(Exit::Failed, "poses, --goal and --through need a planner, and this run has none");
        return Err(failure.hint("run a planner blueprint, such as yourarm-planner, or give joint positions"));
    };
    signals.check()?;
    let request = Move { direct: args.direct, ..Move::new(arm.clone(), target, args.search.speed) };
    let begun = client.call(request)?;
    output::note(format_args!(
        "motion {} on {}: {:.2} s, direct, not collision-checked",
        begun.motion, begun.task, begun.duration
    ));
    let reply = serde_json::to_value(&begun).unwrap_or_default();
    Ok((begun.motion, begun.task, reply))
}

/// Returns the positions of an arm's joints in a saved pose [rad].
fn saved(client: &mut Client, arm: &str, name: &str) -> Result<Vec<f64>> {
    let poses = client.call(Poses {})?.poses;
    let Some(pose) = poses.get(name) else {
        let names: Vec<&str> = poses.keys().map(String::as_str).collect();
        let known = if names.is_empty() { "none is saved".to_owned() } else { format!("saved: {}", names.join(", ")) };
        let failure = Failure::new(Exit::Usage, format!("no saved pose {name}; {known}"));
        return Err(failure.hint("save where the arm is: dimos pose save NAME; names of a blueprint need a planner"));
    };
    let state = client.call(State {})?;
    let joints = state.arms.iter().find(|a| a.hardware_id == arm).map(|a| a.joints.as_slice()).unwrap_or_default();
    let position = |joint: &str| pose.values().find_map(|arm| arm.get(joint)).copied();
    let found: Option<Vec<f64>> = joints.iter().map(|joint| position(&joint.name)).collect();
    found.filter(|found| !found.is_empty()).ok_or_else(|| {
        Failure::new(Exit::Usage, format!("the saved pose {name} has no position of {arm}'s joints"))
            .hint(format!("save it again: dimos pose save {name} {arm}"))
    })
}
