//! `dimos model assets list|fetch|clean`: a blueprint's assets and their state.

use std::collections::BTreeSet;

use clap::Subcommand;
use serde_json::json;

use crate::assets::{Asset, Cache, without_password};
use crate::blueprint::{Blueprint, Catalog, Overrides};
use crate::cli::arguments::setting;
use crate::cli::exit::{Exit, Result};
use crate::cli::output::{self, Table, Tone, toned};
use crate::cli::{check, fetch};

/// Arguments of `model assets`.
#[derive(Debug, clap::Args)]
pub(super) struct Args {
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Debug, Subcommand)]
enum Verb {
    /// List a blueprint's assets: origin and state
    List(BlueprintArgs),
    /// Download missing assets, for a computer that will be offline
    Fetch(BlueprintArgs),
    /// Remove downloaded assets
    Clean(BlueprintArgs),
}

/// Selects a blueprint.
#[derive(Debug, clap::Args)]
struct BlueprintArgs {
    /// The blueprint: a name that `list-blueprints` shows, or a file
    #[arg(value_name = "BLUEPRINT")]
    blueprint: String,
    /// Change a field of the blueprint first: assets.panda.url=file:///mnt/panda.zip (repeatable)
    #[arg(long, value_name = "PATH=VALUE", value_parser = setting)]
    set: Vec<(String, String)>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

impl BlueprintArgs {
    fn load(&self, catalog: Catalog<'_>) -> Result<Blueprint> {
        let set = self.set.iter().map(|(path, value)| format!("{path}={value}")).collect();
        let loaded = check::load(&self.blueprint, &Overrides { set, ..Overrides::default() }, catalog)?;
        match loaded.blueprint {
            Some(blueprint) => Ok(blueprint),
            None => Err(check::mistakes(&loaded)),
        }
    }
}

/// Runs the verb.
pub(super) fn run(args: &Args, catalog: Catalog<'_>) -> Result {
    match &args.verb {
        Verb::List(of) => {
            let blueprint = of.load(catalog)?;
            show(&blueprint, of.json);
        }
        Verb::Fetch(of) => {
            let blueprint = of.load(catalog)?;
            let cache = Cache::standard();
            for asset in blueprint.assets.iter().map(|used| &used.asset).filter(|asset| !cache.has(&asset.sha256)) {
                fetch::one(asset)?;
            }
            // New files are checked now: paths into them, descriptions in them.
            show(&of.load(catalog)?, of.json);
        }
        Verb::Clean(of) => clean(of, catalog)?,
    }
    Ok(Exit::Ok)
}

/// Removes the assets. A file shared by two names is removed once; mistakes in a description inside an asset are
/// ignored.
fn clean(of: &BlueprintArgs, catalog: Catalog<'_>) -> Result<()> {
    let (blueprint, cache) = (of.load(catalog)?, Cache::standard());
    let mut seen = BTreeSet::new();
    let mut removed = Vec::new();
    for asset in blueprint.assets.iter().map(|used| &used.asset) {
        if seen.insert(&asset.sha256) && cache.remove(asset).map_err(fetch::failure)? {
            removed.push(asset.name.as_str());
        }
    }
    match of.json {
        true => output::json(&json!({"removed": removed})),
        false if removed.is_empty() => output::line("nothing to remove"),
        false => output::line(format_args!("removed {}", removed.join(", "))),
    }
    Ok(())
}

fn show(blueprint: &Blueprint, as_json: bool) {
    let cache = Cache::standard();
    let state = |asset: &Asset| match (cache.has(&asset.sha256), cache.part(&asset.sha256)) {
        (true, _) => ("here", Some(cache.size(&asset.sha256))),
        (false, Some(part)) => ("partly", Some(part)),
        (false, None) => ("not here", None),
    };
    if as_json {
        let all = blueprint.assets.iter().map(|used| {
            let (asset, (state, bytes)) = (&used.asset, state(&used.asset));
            let folder = (state == "here").then(|| cache.folder(&asset.sha256));
            json!({"name": asset.name, "url": without_password(&asset.url), "sha256": asset.sha256, "used": used.used, "state": state,
                "bytes": bytes, "folder": folder})
        });
        return output::json(&all.collect::<Vec<_>>());
    }
    if blueprint.assets.is_empty() {
        return output::line("the blueprint has no assets");
    }
    let mut table = Table::new(&["ASSET", "STATE", ">BYTES", "USED", "FROM", "FOLDER"]);
    for used in &blueprint.assets {
        let (asset, (state, bytes)) = (&used.asset, state(&used.asset));
        let tone = if state == "here" { Tone::Good } else { Tone::Warning };
        let folder = if state == "here" { cache.folder(&asset.sha256).display().to_string() } else { "-".to_owned() };
        table.row([
            asset.name.as_str().into(),
            toned(state, tone),
            bytes.map_or_else(|| "-".to_owned(), |bytes| bytes.to_string()).into(),
            if used.used { "yes" } else { "no" }.into(),
            without_password(&asset.url).into(),
            folder.into(),
        ]);
    }
    table.print();
}
