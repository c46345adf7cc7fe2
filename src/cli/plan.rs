//! `dimos plan ROBOT …`: a collision-free motion, planned and shown, not carried out.

use super::arguments::Target;
use super::exit::{Exit, Result};
use super::follow::Signals;
use super::goal::{Goal, Search, plan, show};
use super::output;

/// Arguments of `plan`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Then `dimos preview` shows the plan and `dimos execute` carries it out. `dimos move` does all in one go.
  dimos plan arm 0.3 -0.2 0.5 0 0.4 0
  dimos plan arm --pose 0.3 0.1 0.4 --rpy 0 1.57 0
  dimos plan arm --named home")]
pub struct Args {
    /// The robot's name in the planner
    pub robot: String,
    /// Where it shall go
    #[command(flatten)]
    pub goal: Goal,
    /// How to search
    #[command(flatten)]
    pub search: Search,
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let mut client = args.target_run.connect()?;
    let signals = Signals::watch();
    let request = args.search.plan(vec![args.goal.of(&args.robot, &args.search)]);
    let planned = plan(&mut client, request, &signals)?;
    if args.target_run.json {
        output::json(&serde_json::json!({
            "plan": planned.plan, "elapsed": planned.elapsed, "summary": planned.summary,
        }));
    } else {
        show(&planned);
        output::note("nothing has moved: `dimos execute` carries it out");
    }
    Ok(Exit::Ok)
}
