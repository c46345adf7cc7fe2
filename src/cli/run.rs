//! `dimos run NAME|PATH`: its arguments. See [`banner`](super::banner) for what it prints.

use std::path::PathBuf;
use std::time::Duration;

use super::arguments::{duration, setting};

/// Arguments of `run`.
#[derive(Debug, Clone, PartialEq, clap::Args)]
pub struct Args {
    /// The blueprint: a name that `list-blueprints` shows, or a file
    #[arg(value_name = "NAME|PATH")]
    pub blueprint: String,
    /// Change a field of the blueprint: hardware.arm.address=192.168.1.100 (repeatable)
    #[arg(long, value_name = "PATH=VALUE", value_parser = setting)]
    pub set: Vec<(String, String)>,
    /// Let emulators stand in for all arms
    #[arg(long)]
    pub sim: bool,
    /// End by itself after this time: 10s, 2m
    #[arg(long, value_name = "TIME", value_parser = duration)]
    pub duration: Option<Duration>,
    /// Write the log to this file
    #[arg(long, value_name = "FILE", conflicts_with = "no_record")]
    pub record: Option<PathBuf>,
    /// Write no log
    #[arg(long)]
    pub no_record: bool,
    /// Name of the run; without it the blueprint's name
    #[arg(long, value_name = "RUN")]
    pub name: Option<String>,
    /// Only check the blueprint; connect to nothing
    #[arg(long)]
    pub check: bool,
    /// Print JSON
    #[arg(long)]
    pub json: bool,
}
