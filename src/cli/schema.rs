//! `dimos schema`: the JSON Schema of blueprints, of jobs, and of the rpc protocol.

use serde_json::Value;

use super::exit::{Exit, Result};
use super::output;
use crate::blueprint::{self, Catalog};

/// Arguments of `schema`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Print the schema of the rpc protocol instead: methods, parameters, replies, streams
    #[arg(long)]
    rpc: bool,
    /// Print the schema of jobs instead
    #[arg(long, conflicts_with = "rpc")]
    job: bool,
}

/// What [`dimos_rpc::api::schema::json_schema`] returns, and the schema of jobs, as tests write them.
const RPC: &str = include_str!("../../assets/rpc.schema.json");
const JOB: &str = include_str!("../../assets/job.schema.json");

/// Runs the verb.
pub fn run(args: &Args, catalog: Catalog<'_>) -> Result {
    let made = |text| serde_json::from_str(text).unwrap_or_default();
    let schema: Value = match (args.rpc, args.job) {
        (true, _) => made(RPC),
        (_, true) => made(JOB),
        _ => blueprint::json_schema(catalog),
    };
    // A value made of maps and lists always encodes.
    output::line(serde_json::to_string_pretty(&schema).unwrap_or_default());
    Ok(Exit::Ok)
}
