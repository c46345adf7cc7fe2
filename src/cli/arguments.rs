//! Arguments shared by several verbs, and parsers of their values.

use std::time::Duration;

use clap::Args;

use super::exit::Result;
use crate::rpc::client::{self, Client};
use crate::rpc::run_dir::{LiveRun, RunDir};

/// Arguments that select a run and the output format.
#[derive(Debug, Clone, PartialEq, Eq, Default, Args)]
pub struct Target {
    /// The run to talk to; needed only when several are live
    #[arg(long, value_name = "NAME")]
    pub run: Option<String>,
    /// Print JSON
    #[arg(long)]
    pub json: bool,
}

impl Target {
    /// Connects to the run.
    pub fn connect(&self) -> Result<Client> {
        Ok(Client::find(&RunDir::standard(), self.run.as_deref())?)
    }

    /// Returns the named run, or all live runs.
    pub fn named_or_all(&self) -> Result<Vec<LiveRun>> {
        let folder = RunDir::standard();
        Ok(match &self.run {
            Some(name) => vec![client::find(&folder, Some(name))?],
            None => folder.runs().map_err(client::ClientError::from)?,
        })
    }
}

/// Parses a finite number.
pub fn finite(text: &str) -> std::result::Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value.is_finite() => Ok(value),
        Ok(_) => Err("must be finite".into()),
        Err(_) => Err("not a number".into()),
    }
}

/// Parses a fraction of the arm's limits.
pub fn speed(text: &str) -> std::result::Result<f64, String> {
    let lowest = crate::rpc::api::MIN_SPEED;
    let value = finite(text)?;
    if (lowest..=1.0).contains(&value) { Ok(value) } else { Err(format!("must be within {lowest}–1")) }
}

/// Parses a speed override: `0.3` or `30%`.
pub fn override_of_speed(text: &str) -> std::result::Result<f64, String> {
    let lowest = crate::rpc::api::MIN_SPEED;
    let value = match text.strip_suffix('%') {
        Some(percent) => finite(percent)? / 100.0,
        None => finite(text)?,
    };
    match value {
        _ if (lowest..=1.0).contains(&value) => Ok(value),
        _ if value > 1.0 && !text.ends_with('%') => Err(format!("must be within {lowest}–1, or with a % sign")),
        _ => Err(format!("must be within {lowest}–1, or {:.0}–100%", lowest * 100.0)),
    }
}

/// Parses a rate per second.
pub fn rate(text: &str) -> std::result::Result<f64, String> {
    let value = finite(text)?;
    if (0.1..=2000.0).contains(&value) { Ok(value) } else { Err("must be within 0.1–2000 Hz".into()) }
}

/// Parses a duration with its unit: `10s`, `500ms`, `1m 30s`.
pub fn duration(text: &str) -> std::result::Result<Duration, String> {
    let hint = "give a unit: 10s, 500ms, 2m";
    let span: jiff::SignedDuration = text.parse().map_err(|_| hint.to_owned())?;
    match Duration::try_from(span) {
        Ok(duration) if !duration.is_zero() => Ok(duration),
        _ => Err("must be greater than zero".into()),
    }
}

/// Parses `path=value`, as in `--set hardware.arm.address=192.168.1.100`.
pub fn setting(text: &str) -> std::result::Result<(String, String), String> {
    match text.split_once('=') {
        Some((path, value)) if !path.trim().is_empty() => Ok((path.trim().to_owned(), value.to_owned())),
        _ => Err("must be PATH=VALUE, such as coordinator.tick_rate=250".into()),
    }
}
