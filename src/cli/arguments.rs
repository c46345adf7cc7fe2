//! Arguments shared by several verbs, and parsers of their values.

use std::sync::OnceLock;
use std::time::Duration;

use clap::Args;

use super::exit::Result;
use crate::blueprint::Overrides;
use crate::share;
use dimos_core::written;
use dimos_rpc::client::{self, Client, ClientError};
use dimos_rpc::run_dir::{LiveRun, RunDir};

/// Where the run is, if it is on another computer, and whether the command line says so.
static PLACE: OnceLock<Option<(String, bool)>> = OnceLock::new();

/// Sets the place, once: `--at`, else `DIMOS_AT`.
pub(super) fn set_place(given: Option<String>) {
    let named = || std::env::var("DIMOS_AT").ok().filter(|place| !place.is_empty());
    let _ = PLACE.set(given.map(|place| (place, true)).or_else(|| Some((named()?, false))));
}

/// Returns where the run is, if it is on another computer: an endpoint, or a name in `places.yaml`.
pub fn place() -> Option<&'static str> {
    PLACE.get()?.as_ref().map(|(place, _)| place.as_str())
}

/// Returns whether the place is given as `--at`, not as `DIMOS_AT`.
pub fn is_place_given() -> bool {
    matches!(PLACE.get(), Some(Some((_, true))))
}

/// Connects to the run of this name, here or at the place of `--at`; without a name, to the only live run there.
pub fn connect(run: Option<&str>) -> std::result::Result<Client, ClientError> {
    match place() {
        Some(place) => share::connect(place, run),
        None => Client::find(&RunDir::standard(), run),
    }
}

/// Connects to a run that was found, here or on another computer.
pub fn connect_to(run: &LiveRun) -> std::result::Result<Client, ClientError> {
    match &run.at {
        Some(place) => share::connect(place, Some(&run.name)),
        None => Client::connect(&run.name, &run.socket),
    }
}

/// Arguments that select a run and the output format.
#[derive(Debug, Clone, PartialEq, Eq, Default, Args)]
pub struct Target {
    /// The run to talk to; needed only when several are live
    #[arg(long, value_name = "RUN")]
    pub run: Option<String>,
    /// Print JSON, errors too
    #[arg(long)]
    pub json: bool,
}

/// Arguments that change a blueprint before it is used.
#[derive(Debug, Clone, PartialEq, Eq, Default, Args)]
pub struct Changes {
    /// Use the arm at this address instead of the blueprint's: arm=192.168.1.185, arm=can0, arm=sim (repeatable)
    #[arg(long, value_name = "ARM=ADDRESS", value_parser = arm_address)]
    pub address: Vec<(String, String)>,
    /// Change a field of the blueprint: coordinator.tick_rate=250, hardware.arm.limits.velocity=0.5 (repeatable)
    #[arg(long, value_name = "PATH=VALUE", value_parser = setting)]
    pub set: Vec<(String, String)>,
    /// Simulate all arms, whatever addresses the blueprint has; --sim=physics: with masses, gravity and contacts
    #[arg(long, value_name = "KIND", num_args = 0..=1, require_equals = true, default_missing_value = "wire")]
    #[arg(conflicts_with = "address")]
    pub sim: Option<Simulation>,
}

/// What `--sim` simulates.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Simulation {
    /// The controllers of the arms, and joints that obey them.
    Wire,
    /// Also the bodies of the arms, by MuJoCo.
    Physics,
}

impl Changes {
    /// Returns the changes as overrides of the blueprint.
    pub fn overrides(&self) -> Overrides {
        let set = self.set.iter().map(|(path, value)| format!("{path}={value}")).collect();
        Overrides {
            set,
            address: self.address.clone(),
            sim: self.sim.is_some(),
            physics: self.sim == Some(Simulation::Physics),
        }
    }
}

impl Target {
    /// Connects to the run.
    pub fn connect(&self) -> Result<Client> {
        Ok(connect(self.run.as_deref())?)
    }

    /// Connects to the run, if one is live or named.
    pub fn connect_if_live(&self) -> Result<Option<Client>> {
        match connect(self.run.as_deref()) {
            Err(ClientError::NoRun) => Ok(None),
            found => Ok(Some(found?)),
        }
    }

    /// Returns the named run, or all live runs, here or at the place of `--at`.
    pub fn named_or_all(&self) -> Result<Vec<LiveRun>> {
        if let Some(place) = place() {
            let mut live = share::runs(place)?;
            let Some(name) = &self.run else { return Ok(live) };
            let at = live.iter().position(|run| run.name == *name);
            return match at {
                Some(at) => Ok(vec![live.swap_remove(at)]),
                None => Err(ClientError::UnknownRun { name: name.clone(), live }.into()),
            };
        }
        let folder = RunDir::standard();
        Ok(match &self.run {
            Some(name) => vec![client::find(&folder, Some(name))?],
            None => folder.runs().map_err(ClientError::from)?,
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

/// Parses a fraction of the speed: `0.3` or `30%`.
pub fn speed(text: &str) -> std::result::Result<f64, String> {
    let lowest = dimos_rpc::api::MIN_SPEED;
    let value = match text.strip_suffix('%') {
        Some(percent) => finite(percent)? / 100.0,
        None => finite(text)?,
    };
    match value {
        _ if (lowest..=1.0).contains(&value) => Ok(value),
        _ if value > 1.0 && value <= 100.0 && !text.ends_with('%') => {
            Err(format!("must be within {lowest}–1; for percent write {text}%"))
        }
        _ => Err(format!("must be within {lowest}–1, or {:.0}–100%", lowest * 100.0)),
    }
}

/// Parses an angle [rad]; more than a turn counts as degrees.
pub fn angle(text: &str) -> std::result::Result<f64, String> {
    let value = coordinate(text)?;
    written::angle(value).map(|()| value)
}

/// Parses a length or a coordinate [m]; more than 10 counts as mm.
pub fn length(text: &str) -> std::result::Result<f64, String> {
    let value = coordinate(text)?;
    written::length(value).map(|()| value)
}

/// Parses a number of a pose; a list with commas, and a unit, get a hint.
pub fn coordinate(text: &str) -> std::result::Result<f64, String> {
    finite(text).map_err(|wrong| match text.trim_end_matches(['°', 'd', 'e', 'g', 'r', 'a', 'm']) {
        _ if text.contains(',') => format!("{wrong}: separate the numbers by blanks: {}", text.replace(',', " ")),
        number if number.len() < text.len() && finite(number).is_ok() => {
            format!("{wrong}: give it without a unit; lengths are in m, angles in rad (1° is 0.01745)")
        }
        _ => wrong,
    })
}

/// Parses a rate per second.
pub fn hertz(text: &str) -> std::result::Result<f64, String> {
    let value = finite(text)?;
    if (0.1..=2000.0).contains(&value) { Ok(value) } else { Err("must be within 0.1–2000 Hz".into()) }
}

/// Parses a duration above zero: `10s`, `500ms`, `1m 30s`, or a number of seconds.
pub fn duration(text: &str) -> std::result::Result<Duration, String> {
    match time(text)? {
        Duration::ZERO => Err("must be greater than zero".into()),
        duration => Ok(duration),
    }
}

/// Parses a time: `10s`, `500ms`, `1m 30s`, or a number of seconds; zero is allowed.
pub fn time(text: &str) -> std::result::Result<Duration, String> {
    let wrong = || "not a duration: write 10s, 500ms, 2m, or a number of seconds".to_owned();
    match text.parse::<f64>() {
        Ok(seconds) if seconds < 0.0 => Err("must not be negative".into()),
        Ok(seconds) => Duration::try_from_secs_f64(seconds).map_err(|_| wrong()),
        Err(_) => {
            let span: jiff::SignedDuration = text.parse().map_err(|_| wrong())?;
            Duration::try_from(span).map_err(|_| "must not be negative".into())
        }
    }
}

/// Parses `arm=address`, as in `--address arm=192.168.1.185`.
pub fn arm_address(text: &str) -> std::result::Result<(String, String), String> {
    match text.split_once('=') {
        Some((arm, address)) if !arm.trim().is_empty() && !address.trim().is_empty() => {
            Ok((arm.trim().to_owned(), address.trim().to_owned()))
        }
        _ => Err("must be ARM=ADDRESS, such as arm=192.168.1.185".into()),
    }
}

/// Parses `path=value`, as in `--set hardware.arm.address=192.168.1.100`.
pub fn setting(text: &str) -> std::result::Result<(String, String), String> {
    match text.split_once('=') {
        Some((path, value)) if !path.trim().is_empty() => Ok((path.trim().to_owned(), value.to_owned())),
        _ => Err("must be PATH=VALUE, such as coordinator.tick_rate=250".into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_value_in_another_unit_is_refused_with_the_right_one() {
        for (text, expected) in [
            ("180", Err("angles are in rad, at most a turn: 180° is 3.1416 rad")),
            ("-90", Err("angles are in rad, at most a turn: -90° is -1.5708 rad")),
            ("90deg", Err("not a number: give it without a unit; lengths are in m, angles in rad (1° is 0.01745)")),
            ("3.1", Ok(3.1)),
            ("-6.2", Ok(-6.2)),
        ] {
            assert_eq!(angle(text), expected.map_err(str::to_owned), "{text}");
        }
        assert_eq!(coordinate("0.3"), Ok(0.3));
        assert!(coordinate("300mm").unwrap_err().contains("lengths are in m"));
        assert!(coordinate("0.3,0.1,0.4").unwrap_err().ends_with("by blanks: 0.3 0.1 0.4"));
    }

    #[test]
    fn a_speed_is_a_fraction_or_percent() {
        for (text, fraction) in [("0.3", 0.3), ("30%", 0.3), ("1%", 0.01), ("1", 1.0), ("12.5%", 0.125)] {
            assert_eq!(speed(text), Ok(fraction), "{text}");
        }
        assert!(speed("50").unwrap_err().ends_with("for percent write 50%"));
        for wrong in ["0", "0.001", "200%", "-0.5", "500", "fast"] {
            assert!(speed(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn durations_are_seconds_or_have_a_unit() {
        for (text, milliseconds) in
            [("10s", 10_000), ("500ms", 500), ("2m", 120_000), ("1m 30s", 90_000), ("1.5", 1500), ("10", 10_000)]
        {
            assert_eq!(duration(text), Ok(Duration::from_millis(milliseconds)), "{text}");
        }
        assert_eq!(time("0"), Ok(Duration::ZERO));
        for wrong in ["", "-1", "nan", "inf", "-2s", "soon", "0", "0s"] {
            assert!(duration(wrong).is_err(), "{wrong}");
        }
    }
}
