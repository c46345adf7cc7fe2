//! `dimos schema`: the JSON Schema of blueprints.

use super::exit::{Exit, Result};
use super::output;
use crate::blueprint::{self, Catalog};

/// Arguments of `schema`.
#[derive(Debug, clap::Args)]
pub struct Args {}

/// Runs the verb.
pub fn run(_: &Args, catalog: Catalog<'_>) -> Result {
    // A value made of maps and lists always encodes.
    output::line(serde_json::to_string_pretty(&blueprint::json_schema(catalog)).unwrap_or_default());
    Ok(Exit::Ok)
}
