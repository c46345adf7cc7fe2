//! `dimos new [NAME]`: a blueprint for your arm, by six questions: which arm, where, gripper, model, tool, table.

mod answers;
mod choice;
mod shipped;
mod text;

use std::fs::OpenOptions;
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use serde_json::json;

use super::check;
use super::exit::{Exit, Failure, Result};
use super::output;
use crate::blueprint::{self, Catalog, Found, Loaded, Overrides, Source};
use crate::offline::PlanningScene;
use answers::Asker;
use choice::Cell;
use dimos_rpc::run_dir;
use shipped::Known;

/// Arguments of `new`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
What has no option is asked, on a terminal. The six questions: the arm, its address, its gripper, the model that motions \
are planned with, the tool on it, and the height of the table. The file passes `dimos check` and runs with --sim; its \
comments say what to look at next. Nothing is connected.

  dimos new my-cell
  dimos new my-cell --arm xarm6 --address 192.168.1.185     asks four questions
  dimos new so101 --arm so101 --address sim --model so101 --tool none --table 0
  dimos new ur5e --arm ur5e --address sim --model ur5e --tool 0 0 0.12 --table 0")]
pub struct Args {
    /// Name of the blueprint, which is written to NAME.yaml
    #[arg(default_value = "my-cell")]
    pub name: PathBuf,
    /// The arm: an adapter that `list-adapters` shows, or one of its models, as xarm6 or ur10e
    #[arg(long, value_name = "ARM")]
    pub arm: Option<String>,
    /// Its address in the form of `list-adapters`, or sim
    #[arg(long)]
    pub address: Option<String>,
    /// Its gripper, of those that the adapter knows, or none
    #[arg(long)]
    pub gripper: Option<String>,
    /// Robot description for planning: builtin:NAME, a .urdf or .xacro file, or none
    #[arg(long)]
    pub model: Option<String>,
    /// Tool centre point from the end of the model: x y z [m], or none
    #[arg(long, value_name = "X Y Z|none", num_args = 1..=3, allow_negative_numbers = true)]
    pub tool: Vec<String>,
    /// Height of the table above the base of the arm [m], or none
    #[arg(long, value_name = "Z|none", allow_negative_numbers = true)]
    pub table: Option<String>,
    /// Number of joints, where arm and model leave it open
    #[arg(long, value_name = "N")]
    pub joints: Option<String>,
    /// Overwrite the file
    #[arg(long)]
    pub force: bool,
    /// Print JSON
    #[arg(long)]
    pub json: bool,
}

/// Runs the verb.
pub fn run(args: &Args, catalog: Catalog<'_>) -> Result {
    let path = match args.name.extension().is_some_and(|ending| ending == "yaml" || ending == "yml") {
        true => args.name.clone(),
        false => PathBuf::from(format!("{}.yaml", args.name.display())),
    };
    let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    run_dir::check_name(&name).map_err(|e| Failure::usage(e.to_string()).hint(e.hint()))?;
    if path.exists() && !args.force {
        return Err(exists(&path));
    }
    let cell = Cell::ask(args, &path, &Asker::new(), catalog)?;
    let mut known = cell.robot.as_ref().map_or_else(Known::default, |robot| Known::of(robot, catalog));
    let mut text = text::of(&cell, &path, &known);
    let mut loaded = load(&path, &name, &text, catalog);
    let touching = touching(&loaded)?;
    if !touching.is_empty() {
        known.exclusions.extend(touching);
        text = text::of(&cell, &path, &known);
        loaded = load(&path, &name, &text, catalog);
    }
    if loaded.blueprint.is_none() {
        let failure = check::mistakes(&loaded);
        return Err(Failure {
            what: "these answers make no valid blueprint: nothing was written".to_owned(),
            ..failure
        });
    }
    write(&path, &text, args.force)?;
    let next = text::next(&path, &known);
    if args.json {
        let next: Vec<&String> = next.iter().map(|(command, _)| command).collect();
        output::json(&json!({"written": path, "blueprint": name, "next": next}));
        return Ok(Exit::Ok);
    }
    output::line(format_args!("wrote {}", path.display()));
    output::line("next:");
    text::in_columns(&next).for_each(output::line);
    Ok(Exit::Ok)
}

fn load(path: &Path, name: &str, text: &str, catalog: Catalog<'_>) -> Loaded {
    let source = Source::Path(path.to_owned());
    let found = Found { name: name.to_owned(), source, bytes: text.as_bytes().to_vec() };
    blueprint::load(&found, &Overrides::default(), catalog)
}

/// Returns the pairs of links that touch in every configuration: the shapes of a model may be fuller than the arm.
fn touching(loaded: &Loaded) -> Result<Vec<[String; 2]>> {
    let Some(planner) = loaded.blueprint.as_ref().and_then(|blueprint| blueprint.planner.as_ref()) else {
        return Ok(Vec::new());
    };
    let scene = PlanningScene::load(planner).map_err(|error| Failure::of(Exit::Usage, error))?;
    Ok(scene.always_touching.into_iter().map(|(_, pair)| pair).collect())
}

fn write(path: &Path, text: &str, force: bool) -> Result<()> {
    let mut options = OpenOptions::new();
    // What appeared meanwhile is not overwritten, either.
    options.write(true).create(true).truncate(true).create_new(!force);
    let written = options.open(path).and_then(|mut file| file.write_all(text.as_bytes()));
    written.map_err(|error| match error.kind() {
        ErrorKind::AlreadyExists => exists(path),
        _ => Failure::new(Exit::Failed, format!("{}: {error}", path.display())).hint("choose another folder or name"),
    })
}

fn exists(path: &Path) -> Failure {
    let failure = Failure::usage(format!("{} exists already: nothing was written", path.display()));
    failure.hint("choose another name, or overwrite it with --force")
}
