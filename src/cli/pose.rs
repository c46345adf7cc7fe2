//! `dimos pose`: poses that are saved under a name, for `--named`.

use super::arguments::Target;
use super::exit::{Exit, Result};
use super::output::{self, Table, fixed};
use dimos_rpc::api::{PoseRemove, PoseSave, Poses, SavedPose};

/// Arguments of `pose`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// What to do
    #[command(subcommand)]
    pub command: Command,
}

/// Verbs of `pose`.
#[derive(Debug, clap::Subcommand)]
pub enum Command {
    /// Save the joint positions of the run's arms under a name, for `move ARM --named NAME`
    Save(SaveArgs),
    /// List the saved poses of the run's blueprint
    List(ListArgs),
    /// Remove a saved pose
    Remove(RemoveArgs),
}

/// Arguments of `pose save`.
#[derive(Debug, clap::Args)]
pub struct SaveArgs {
    /// Its name; a saved pose of the same name is replaced
    pub name: String,
    /// The arms (hardware_id) whose joints it has; default: all
    pub arms: Vec<String>,
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

/// Arguments of `pose list`.
#[derive(Debug, clap::Args)]
pub struct ListArgs {
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

/// Arguments of `pose remove`.
#[derive(Debug, clap::Args)]
pub struct RemoveArgs {
    /// Its name
    pub name: String,
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    match &args.command {
        Command::Save(args) => save(args),
        Command::List(args) => list(args),
        Command::Remove(args) => {
            args.target_run.connect()?.call(PoseRemove { name: args.name.clone() })?;
            let removed = serde_json::json!({"removed": args.name});
            output::done(format_args!("{} removed", args.name), removed, args.target_run.json);
            Ok(Exit::Ok)
        }
    }
}

fn save(args: &SaveArgs) -> Result {
    let mut client = args.target_run.connect()?;
    let saved = client.call(PoseSave { name: args.name.clone(), arms: args.arms.clone() })?;
    if args.target_run.json {
        output::json(&saved);
        return Ok(Exit::Ok);
    }
    let replaced = if saved.replaced { ", in place of the earlier one" } else { "" };
    output::line(format_args!("{} saved{replaced}", saved.name));
    table([(&saved.name, &saved.pose)]);
    Ok(Exit::Ok)
}

fn list(args: &ListArgs) -> Result {
    let report = args.target_run.connect()?.call(Poses {})?;
    if args.target_run.json {
        output::json(&report);
        return Ok(Exit::Ok);
    }
    if report.poses.is_empty() {
        output::note("no pose is saved\nhint: save where the arms are: dimos pose save NAME");
        return Ok(Exit::Ok);
    }
    table(&report.poses);
    output::note(format_args!("they are in {}", report.file));
    Ok(Exit::Ok)
}

fn table<'a>(poses: impl IntoIterator<Item = (&'a String, &'a SavedPose)>) {
    let mut table = Table::new(&["POSE", "ARM", "JOINTS rad"]);
    for (name, pose) in poses {
        for (arm, joints) in pose {
            let values: Vec<String> = joints.values().map(|q| fixed(*q, 4)).collect();
            table.row([name.as_str(), arm, &values.join(" ")]);
        }
    }
    table.print();
}
