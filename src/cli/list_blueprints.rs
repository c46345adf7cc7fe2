//! `dimos list-blueprints`: the blueprints that `dimos run` finds by name.

use serde_json::json;

use super::exit::{Exit, Result};
use super::output::{self, Table};
use crate::blueprint::{self, Catalog, Source};

/// Arguments of `list-blueprints`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Print JSON
    #[arg(long)]
    pub json: bool,
}

/// Runs the verb.
pub fn run(args: &Args, catalog: Catalog<'_>) -> Result {
    let all = blueprint::list(catalog);
    if args.json {
        let rows = all.iter().map(|b| {
            json!({"name": b.name, "source": b.source.to_string(), "arms": b.arms,
                   "description": b.description, "problem": b.problem})
        });
        output::json(&rows.collect::<Vec<_>>());
        return Ok(Exit::Ok);
    }
    let mut table = Table::new(&["NAME", "?SOURCE", "~?ARMS", "~DESCRIPTION"]);
    for b in all {
        let about = match b.problem {
            Some(problem) => output::toned(format!("wrong: {problem}"), output::Tone::Bad),
            None => b.description.into(),
        };
        table.row([b.name.into(), folder(&b.source).into(), b.arms.join(", ").into(), about]);
    }
    table.print();
    Ok(Exit::Ok)
}

/// Returns where a blueprint is: the folder of its file, whose name is that of the blueprint.
fn folder(source: &Source) -> String {
    match source {
        Source::Path(path) => path.parent().unwrap_or(path).display().to_string(),
        Source::Embedded => source.to_string(),
    }
}
