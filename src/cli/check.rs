//! `dimos check NAME|PATH`: validates a blueprint and prints the resolved configuration. Connects to nothing.

pub(super) mod robots;

use std::path::PathBuf;

use serde_json::json;

use super::arguments::Changes;
use super::exit::{Exit, Failure, Result};
use super::output::{self, Table};
use super::{banner, fetch};
use crate::blueprint::{self, Catalog, Limit, Loaded, OnExit, Overrides, Summary};
use crate::runtime::arm::device_lock;
use crate::share;
use dimos_core::message::Message;
use dimos_rpc::RpcError;
use dimos_rpc::run_dir;
use dimos_yaml::Diag;

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
    let mut loaded = blueprint::load(&found, overrides, catalog);
    if let Some(planner) = loaded.blueprint.as_mut().and_then(|blueprint| blueprint.planner.as_mut()) {
        planner.proofs = proofs();
    }
    Ok(loaded)
}

/// Returns the folder of proofs that pairs of links stay apart: `$XDG_CACHE_HOME/dimos/proofs` or
/// `~/.cache/dimos/proofs`.
fn proofs() -> Option<PathBuf> {
    let absolute = |name: &str| std::env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
    let caches = absolute("XDG_CACHE_HOME").or_else(|| Some(absolute("HOME")?.join(".cache")))?;
    Some(caches.join("dimos/proofs"))
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
    let mut loaded = load(name, overrides, catalog)?;
    let (summary, mut robots, mut soon) = (loaded.blueprint.as_ref().map(Summary::of), Vec::new(), None);
    if let Some(blueprint) = loaded.blueprint.take() {
        robots::judge(&blueprint).into_iter().for_each(|diag| loaded.report(diag));
        match robots::of(&blueprint) {
            Ok(found) => robots = found,
            Err(what) => loaded.report(error(what.into())),
        }
        match blueprint.share.as_ref().map_or(Ok(None), share::check_gateway) {
            Ok(found) => soon = found,
            Err(RpcError { message: what, hint, .. }) => loaded.report(error(Message { what, hint })),
        }
        if let Some(text) = &soon {
            loaded.report(Diag::warning(text).hint("make a new certificate: docs/many-machines.md"));
        }
        loaded.blueprint = Some(blueprint);
    }
    if as_json {
        let mut document = loaded.to_json();
        document["blueprint"] = json!(summary);
        document["robots"] = json!(robots);
        document["certificates"] = json!(soon);
        output::json(&document);
        return Ok(if loaded.errors() == 0 { Exit::Ok } else { Exit::Usage });
    }
    let Some(summary) = summary.filter(|_| loaded.errors() == 0) else { return Err(mistakes(&loaded)) };
    print_warnings(&loaded);
    print(&summary);
    robots.iter().for_each(robots::print);
    let awaited = loaded.blueprint.iter().flat_map(|blueprint| blueprint.awaited_assets());
    for asset in awaited {
        output::note(format_args!("{} is not downloaded yet: its contents were not checked", asset.name));
    }
    if run_dir::RunDir::standard().is_closed() {
        let arms = summary.arms.iter().filter(|arm| !arm.simulated && !arm.address.is_empty());
        for arm in arms.filter(|arm| !device_lock::is_this_computer(&arm.address)) {
            let (id, address) = (&arm.hardware_id, &arm.address);
            let what = "is outside of DIMOS_WORLD: a run would refuse it";
            output::note(format_args!("warning: arm {id} at {address} {what}\nhint: unset DIMOS_WORLD"));
        }
    }
    output::line("");
    output::line(output::no_mistakes(loaded.warnings()));
    Ok(Exit::Ok)
}

/// Returns the error that a run would end with.
fn error(Message { what, hint }: Message) -> Diag {
    Diag::error(what).maybe_hint(hint)
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
            Table::new(&["  JOINT", ">LOWER rad", ">UPPER rad", ">rad/s", ">?rad/s²", ">?rad/s³", "~?WHERE FROM"]);
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
        for own in &arm.peripherals {
            let place = if own.simulated { "SIMULATED".to_owned() } else { format!("at {}", own.address) };
            output::wrapped(format_args!("  {}: {} {place}", own.part, own.adapter));
        }
        if let Some(Limit { value, from }) = arm.tcp_velocity {
            let kept = if arm.tcp_velocity_is_kept { from.name() } else { "not kept: no model of the arm is known" };
            output::wrapped(format_args!("  tool: at most {value:.3} m/s ({kept})"));
        }
    }
    output::line("");
    let mut table = Table::new(&["TASK", "TYPE", ">?PRIORITY", "~JOINTS"]);
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
