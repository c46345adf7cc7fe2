//! `dimos schema`: the JSON Schema of blueprints, and of the rpc protocol.

use serde_json::Value;

use super::exit::{Exit, Result};
use super::output;
use crate::blueprint::{self, Catalog};
use crate::packed;

/// Arguments of `schema`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Print the schema of the rpc protocol instead: methods, parameters, replies, streams
    #[arg(long)]
    rpc: bool,
}

/// What [`crate::rpc::schema::json_schema`] returns, made by a test: the program is smaller without what makes it.
const RPC: &str = "rpc.schema.json";

/// Runs the verb.
pub fn run(args: &Args, catalog: Catalog<'_>) -> Result {
    let rpc = || packed::text(RPC).and_then(|text| serde_json::from_str(text).ok()).unwrap_or_default();
    let schema: Value = if args.rpc { rpc() } else { blueprint::json_schema(catalog) };
    // A value made of maps and lists always encodes.
    output::line(serde_json::to_string_pretty(&schema).unwrap_or_default());
    Ok(Exit::Ok)
}
