//! `dimos check NAME|PATH`: validates a blueprint and prints the resolved configuration. Connects to nothing.

pub(super) mod robots;

use serde_json::json;

use super::arguments::Changes;
use super::exit::{Exit, Failure, Result};
use super::output::{self, Table};
use super::{banner, fetch};
use crate::blueprint::{self, Catalog, Limit, Loaded, OnExit, Overrides, Summary};
use crate::share;

/// Arguments of `check`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The blueprint: a name that `list-blueprints` shows, or a file
    #[arg(value_name = "NAME|PATH")]
    pub blueprint: String,
    /// Changes of the blueprint
    #[command(flatten)]
    pub changes: Changes,
    /// Print JSON
    #[arg(long)]
    pub json: bool,
}

/// Runs the verb.
pub fn run(args: &Args, catalog: Catalog<'_>) -> Result {
    report(&args.blueprint, &args.changes.overrides(), catalog, args.json)
}

/// Finds and reads a blueprint; its mistakes are in the result.
pub fn load(name: &str, overrides: &Overrides, catalog: Catalog<'_>) -> Result<Loaded> {
    let found = blueprint::find(name).map_err(|e| Failure::usage(e.message).hint(e.hint))?;
    Ok(blueprint::load(&found, overrides, catalog))
}

/// Same for a run: also downloads missing assets, and then checks what depends on them.
pub fn load_to_run(name: &str, overrides: &Overrides, catalog: Catalog<'_>) -> Result<Loaded> {
    let loaded = load(name, overrides, catalog)?;
    match &loaded.blueprint {
        Some(blueprint) if fetch::missing(blueprint)? => load(name, overrides, catalog),
        _ => Ok(loaded),
    }
}

/// Returns the failure of a run whose blueprint has mistakes, after printing them.
pub fn refuse(loaded: &Loaded) -> Failure {
    Failure { what: "the blueprint has mistakes: nothing was connected".to_owned(), ..mistakes(loaded) }
}

/// Returns the failure of a blueprint with mistakes, after printing them.
pub fn mistakes(loaded: &Loaded) -> Failure {
    output::note(loaded.render(output::colour(&std::io::stderr())).trim_end());
    Failure::usage("the blueprint has mistakes").data(loaded.to_json())
}

/// Prints the warnings of a blueprint.
pub fn print_warnings(loaded: &Loaded) {
    if loaded.warnings() > 0 {
        output::note(loaded.render(output::colour(&std::io::stderr())).trim_end());
    }
}

/// Checks a blueprint and prints the result.
pub fn report(name: &str, overrides: &Overrides, catalog: Catalog<'_>, as_json: bool) -> Result {
    let loaded = load(name, overrides, catalog)?;
    let summary = loaded.blueprint.as_ref().map(Summary::of);
    let robots = loaded.blueprint.as_ref().map(robots::of).unwrap_or_else(|| Ok(Vec::new()));
    let shared = loaded.blueprint.as_ref().and_then(|blueprint| blueprint.share.as_ref());
    let certificates = shared.map_or(Ok(None), share::check_gateway);
    if as_json {
        let mut document = loaded.to_json();
        document["blueprint"] = json!(summary);
        match &robots {
            Ok(robots) => document["robots"] = json!(robots),
            Err(what) => document["valid"] = robots::refuse(&mut document["problems"], what),
        }
        match &certificates {
            Ok(soon) => document["certificates"] = json!(soon),
            Err(error) => {
                robots::refuse(&mut document["diagnostics"], &error.message);
                (document["ok"], document["errors"]) = (json!(false), json!(loaded.errors() + 1));
            }
        }
        output::json(&document);
        let valid = summary.is_some() && robots.is_ok() && certificates.is_ok();
        return Ok(if valid { Exit::Ok } else { Exit::Usage });
    }
    let Some(summary) = summary else { return Err(mistakes(&loaded)) };
    print_warnings(&loaded);
    let robots = robots.map_err(Failure::usage)?;
    let soon = certificates.map_err(|error| Failure::usage(error.message).maybe_hint(error.hint))?;
    print(&summary);
    robots.iter().for_each(robots::print);
    let awaited = loaded.blueprint.iter().flat_map(|blueprint| blueprint.awaited_assets());
    for asset in awaited {
        output::note(format_args!("{} is not downloaded yet: its contents were not checked", asset.name));
    }
    if let Some(text) = soon {
        output::note(format_args!("warning: {text}\nhint: make a new certificate: docs/many-machines.md"));
    }
    output::line("");
    output::line("no mistakes");
    Ok(Exit::Ok)
}

fn print(summary: &Summary) {
    let rate = summary.coordinator.tick_rate;
    let about = Some(&summary.description).filter(|text| !text.is_empty());
    output::wrapped(about.map_or_else(|| summary.name.clone(), |about| format!("{}: {about}", summary.name)));
    output::wrapped(format_args!("files: {}; tick: {rate} Hz", summary.files.join(", ")));
    for arm in &summary.arms {
        let standing = banner::standing(arm.simulated, &arm.address);
        output::line("");
        output::line(format_args!("arm {}: {standing}, {}", arm.hardware_id, arm.adapter));
        let motors = if arm.auto_enable { "enabled at start" } else { "not enabled at start" };
        let exit = match arm.on_exit {
            OnExit::Hold => "stay on and hold the pose",
            OnExit::Disable if arm.holds_when_disabled => "are disabled, its brakes hold it",
            OnExit::Disable => "are disabled, it FALLS unless supported",
            OnExit::Park => "move the arm to its park pose, then are disabled",
        };
        output::wrapped(format_args!("  motors: {motors}; at exit they {exit} ({})", arm.on_exit_from.name()));
        let mut table =
            Table::new(&["  JOINT", ">LOWER rad", ">UPPER rad", ">rad/s", ">rad/s²", ">rad/s³", "~WHERE FROM"]);
        for joint in &arm.joints {
            let limits = [
                joint.position_lower,
                joint.position_upper,
                joint.velocity,
                Some(joint.acceleration),
                Some(joint.jerk),
            ];
            let mut cells = vec![format!("  {}", joint.name)];
            cells.extend(limits.iter().map(|l| output::number(l.map(|l| l.value), 3)));
            cells.push(origins(&limits));
            table.row(cells);
        }
        table.print();
    }
    output::line("");
    let mut table = Table::new(&["TASK", "TYPE", ">PRIORITY", "~JOINTS"]);
    for task in &summary.tasks {
        let kind = task.kind.clone();
        table.row([task.name.clone(), kind, task.priority.to_string(), task.joints.join(" ")]);
    }
    table.print();
}

/// Returns the origins of a joint's limits, in the order of the columns; one word if they are equal.
fn origins(limits: &[Option<Limit>]) -> String {
    let mut words: Vec<&str> = limits.iter().flatten().map(|l| l.from.name()).collect();
    if words.windows(2).all(|w| w[0] == w[1]) {
        words.truncate(1);
    }
    words.join(" ")
}
