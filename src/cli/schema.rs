//! `dimos schema`: the JSON Schema of blueprints, and of the rpc protocol.

use super::exit::{Exit, Result};
use super::output;
use crate::blueprint::{self, Catalog};
use crate::rpc;

/// Arguments of `schema`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Print the schema of the rpc protocol instead: methods, parameters, replies, streams
    #[arg(long)]
    rpc: bool,
}

/// Runs the verb.
pub fn run(args: &Args, catalog: Catalog<'_>) -> Result {
    let schema = if args.rpc { rpc::schema::json_schema() } else { blueprint::json_schema(catalog) };
    // A value made of maps and lists always encodes.
    output::line(serde_json::to_string_pretty(&schema).unwrap_or_default());
    Ok(Exit::Ok)
}
