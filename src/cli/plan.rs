//! `dimos plan ARM …`: plans and shows a collision-free motion of one arm or several, without executing it.

use super::arguments::Target;
use super::exit::{Exit, Failure, Result};
use super::follow::Signals;
use super::goal::{Goal, Search, plan, show};
use super::output;

/// Arguments of `plan`.
#[derive(Debug, clap::Args)]
#[command(
    group = clap::ArgGroup::new("goal").required(true).multiple(true),
    override_usage = "\
dimos plan ARM Q… [OPTIONS]
       dimos plan ARM --named NAME [OPTIONS]
       dimos plan ARM --pose X Y Z [--rpy R P Y | --quat X Y Z W] [OPTIONS]
       dimos plan ARM --by X Y Z [--frame FRAME] [OPTIONS]
       dimos plan ARM --through WAYPOINT… [--blend DISTANCE] [OPTIONS]
       dimos plan ARM --path FILE [--tolerance ANGLE] [OPTIONS]
       dimos plan --goal ARM=GOAL… [OPTIONS]",
    after_help = "\
Next: `dimos preview` shows the plan, `dimos execute` executes it. `dimos move` plans and executes in one step.

  dimos plan arm 0.3 -0.2 0.5 0 0.4 0
  dimos plan arm --pose 0.3 0.1 0.4 --rpy 0 1.57 0
  dimos plan arm --by 0 0 -0.05 --frame tool    # back by 5 cm
  dimos plan arm --named home
  dimos plan --goal left=named:home --goal right=0.5,-0.3,0.6,0,0.8,0"
)]
pub struct Args {
    /// Name of the arm in the planner; with several arms use --goal for each
    #[arg(value_name = "ARM", required_unless_present = "several", conflicts_with = "several")]
    pub robot: Option<String>,
    /// Goal of the motion
    #[command(flatten)]
    pub goal: Goal,
    /// Settings of the search
    #[command(flatten)]
    pub search: Search,
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    if args.goal.has_grips() {
        let failure = Failure::usage("a plan has no gripper actions: how they end is known only when they are done");
        return Err(failure.hint("`dimos move` plans each part when the one before it is done"));
    }
    let mut client = args.target_run.connect()?;
    let signals = Signals::watch();
    let request = args.goal.plan(&mut client, args.robot.as_deref(), &args.search)?;
    let planned = plan(&mut client, request, &signals)?;
    if args.target_run.json {
        output::json(&serde_json::json!({
            "plan": planned.plan, "elapsed": planned.elapsed, "summary": planned.summary,
        }));
    } else {
        show(&planned);
        output::note("nothing has moved: `dimos execute` executes the plan");
    }
    Ok(Exit::Ok)
}
