//! `dimos adapter new NAME`: the start of an adapter for a new arm.

use std::path::PathBuf;

use super::super::exit::{Exit, Failure, Result};
use crate::hardware::registry::Registry;
use crate::joint::MAX_DOF;

/// Arguments of `adapter new`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The arm's name, which becomes its `adapter_type`: acme, acme-arm
    pub name: String,
    /// Number of joints (1 to 16)
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(1..=MAX_DOF as i64))]
    pub dof: u8,
    /// How the arm is reached
    #[arg(long)]
    pub transport: Transport,
    /// The folder to write the crate's folder into; with --in-tree, the checkout of dimos
    #[arg(long, value_name = "DIR", default_value = ".")]
    pub path: PathBuf,
    /// Write into a checkout of dimos instead of a crate of its own
    #[arg(long)]
    pub in_tree: bool,
    /// The checkout of dimos that the crate is to use
    #[arg(long, value_name = "DIR", conflicts_with = "in_tree")]
    pub dimos: Option<PathBuf>,
    /// Print JSON
    #[arg(long)]
    pub json: bool,
}

/// How an arm is reached.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Transport {
    /// A TCP connection
    Tcp,
    /// A CAN bus
    Can,
    /// A serial line
    Serial,
}

/// Runs the verb.
pub fn run(_args: &Args, _registry: &Registry) -> Result {
    Err(Failure::new(Exit::Failed, "the templates are not written yet"))
}
