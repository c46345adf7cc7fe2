//! `dimos move ARM …`: moves one arm or several together to joint positions, a pose or a named pose. With a planner in
//! the run the motion is planned and collision-free; without one it is direct.

use super::arguments::Target;
use super::exit::{Exit, Failure, Result};
use super::follow::{Signals, follow};
use super::goal::{Goal, Search, has_planner, plan, show};
use super::output;
use crate::rpc::api::{ExecutePlan, Move};
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
    #[arg(long, conflicts_with_all = ["pose", "named", "several"])]
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
    let request = args.search.plan(args.goal.of(args.arm.as_deref(), &args.search));
    let planned = plan(client, request, signals)?;
    if !args.target_run.json {
        show(&planned);
    }
    signals.check()?;
    let begun = client.call(ExecutePlan { plan: Some(planned.plan), replan: args.replan, presence: None })?;
    output::note(format_args!("motion {} on {}: planned, collision-checked", begun.motion, begun.task));
    let reply = serde_json::to_value(&begun).unwrap_or_default();
    Ok((begun.motion, begun.task, reply))
}

fn begin_direct(args: &Args, client: &mut Client, signals: &Signals) -> Result<Begun> {
    let (Some(arm), Some(target)) = (&args.arm, args.goal.joints()) else {
        let failure = Failure::new(Exit::Failed, "poses, names and --goal need a planner, and this run has none");
        return Err(failure.hint("run a planner blueprint, such as yourarm-planner, or give joint positions"));
    };
    signals.check()?;
    let begun = client.call(Move::new(arm.clone(), target.to_vec(), args.search.speed))?;
    output::note(format_args!(
        "motion {} on {}: {:.2} s, direct, not collision-checked",
        begun.motion, begun.task, begun.duration
    ));
    let reply = serde_json::to_value(&begun).unwrap_or_default();
    Ok((begun.motion, begun.task, reply))
}
