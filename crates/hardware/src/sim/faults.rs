//! Scripted faults of simulated arms: what goes wrong, when, and for how long.

use std::cell::Cell;
use std::time::Duration;

use schemars::{JsonSchema, SchemaGenerator};
use serde::{Deserialize, Deserializer, Serialize};

use super::events::{self, SimEvent};
use super::misreading::Misreading;
use crate::check::ConfigError;

/// Kinds of faults. Each simulated arm can play some of them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum FaultKind {
    /// Reads fail.
    ReadError,
    /// Writes fail.
    WriteError,
    /// The arm does not answer until `duration` is over (default 1 s), then continues normally.
    Stall,
    /// Requests are never answered.
    Silent,
    /// The connection breaks.
    Disconnect,
    /// The arm goes into error `code`: it stops and refuses motion until the error is cleared.
    ErrorCode,
    /// The E-stop line opens: the arm stops and its motors lose power. It closes after `duration`; without a duration
    /// it stays open.
    Estop,
    /// The arm loses power: the connection breaks, the motors are off, and the arm is unreachable for `duration`.
    PowerLoss,
    /// The adapter panics.
    Panic,
    /// Joint positions are reported as NaN.
    Nan,
    /// Joint positions and velocities are reported as zero.
    ZeroState,
    /// A command does not reach the arm, on a wire on which commands have no answer.
    LostCommand,
    /// Noise precedes an answer.
    Garbage,
    /// One byte of an answer is wrong.
    Corrupt,
    /// Only the first half of an answer arrives.
    Truncated,
    /// The arm reports one joint more than it has.
    WrongDof,
    /// The arm reports another model.
    WrongModel,
    /// The readings of joint number `joint` are wrong for `duration`, as `misread` says, and do not look it.
    Misread,
    /// Measurements are frozen for `duration`, time stamps included, while the arm continues to move.
    Frozen,
    /// The arm sinks by `amount` [rad] at its second joint when its motors are enabled.
    Sag,
    /// Joint number `joint` does not move for `duration`.
    Blocked,
    /// Joint number `joint` is moved by `amount` [rad], as by hand: at once, or evenly during `duration`. A joint whose
    /// motor is on does not give way, unless the arm is guided by hand.
    Pushed,
    /// A hand pushes joint number `joint` against its motor for `duration`: it yields by `amount` [rad], and springs
    /// back.
    Nudged,
    /// The motor of joint number `joint` loses its power; the other motors keep theirs.
    MotorOff,
    /// Digital input number `input` is low for `duration`; without a duration it stays low.
    InputLow,
    /// The computer's CAN controller leaves the bus after too many errors.
    BusOff,
    /// The CAN interface has no room for frames to send.
    NoBuffers,
    /// The arm is a leader: it sends commands instead of its state.
    Leader,
    /// An object of the width `amount` [m, or rad of a rotary gripper] is between the fingers for `duration`; without a
    /// duration it stays.
    Object,
    /// The gripper's fingers do not move for `duration`.
    GripperBlocked,
}

impl FaultKind {
    /// Returns all kinds, each with its description, in the order of the reference.
    pub fn all() -> Vec<(Self, String)> {
        let schema = Self::json_schema(&mut SchemaGenerator::default());
        let kinds = schema.get("oneOf").and_then(|kinds| kinds.as_array());
        let kind = |entry: &serde_json::Value| {
            let about = entry.get("description")?.as_str()?.to_owned();
            Some((serde_json::from_value(entry.get("const")?.clone()).ok()?, about))
        };
        kinds.map(|kinds| kinds.iter().filter_map(kind).collect()).unwrap_or_default()
    }

    /// Returns the name in a script.
    pub fn name(self) -> String {
        serde_json::to_value(self).ok().and_then(|value| value.as_str().map(str::to_owned)).unwrap_or_default()
    }
}

/// One fault of a script.
///
/// It begins `at` seconds after the first connection, is active for `duration` seconds, and is played at most `count`
/// times. Without either it is played once.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Fault {
    /// When it begins: time since the first connection [s].
    #[serde(default, deserialize_with = "non_negative")]
    #[schemars(range(min = 0))]
    pub at: f64,
    /// What goes wrong.
    pub kind: FaultKind,
    /// How long it stays active [s]; 0 = until it has been played `count` times.
    #[serde(default, deserialize_with = "non_negative")]
    #[schemars(range(min = 0))]
    pub duration: f64,
    /// How often it is played; 0 = without limit during `duration`.
    #[serde(default)]
    pub count: u32,
    /// The arm's error code, for `error_code`.
    #[serde(default = "default_code")]
    #[schemars(range(min = 1))]
    pub code: u16,
    /// How far the arm sinks, for `sag`, or a joint is moved, for `pushed` and `nudged` [rad]; width of an `object` [m
    /// or rad]; how wrong a `misread` is.
    #[serde(default = "default_amount", deserialize_with = "non_negative")]
    pub amount: f64,
    /// What is wrong with the readings, for `misread`.
    #[serde(default)]
    pub misread: Misreading,
    /// Number of the joint, from 1, for `blocked`, `pushed`, `nudged`, `motor_off`, `misread`, and `error_code` of an
    /// arm whose drives have an error each.
    #[serde(default = "default_joint")]
    #[schemars(range(min = 1))]
    pub joint: usize,
    /// Number of the digital input, from 0, for `input_low`.
    #[serde(default)]
    #[schemars(range(max = 31))]
    pub input: u8,
}

fn default_code() -> u16 {
    2
}

fn default_amount() -> f64 {
    0.05
}

fn default_joint() -> usize {
    1
}

/// Duration of a stall that states none.
pub const DEFAULT_STALL: Duration = Duration::from_secs(1);
/// Largest number in a script [s or rad].
const LARGEST: f64 = 1e6;

/// Reads a number that is neither negative nor too large.
fn non_negative<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    let value = f64::deserialize(deserializer)?;
    if (0.0..=LARGEST).contains(&value) {
        Ok(value)
    } else {
        Err(serde::de::Error::custom(format!("{value} is not between 0 and {LARGEST}")))
    }
}

impl Fault {
    /// Creates a fault that is played once, at once.
    pub fn new(kind: FaultKind) -> Self {
        Self {
            at: 0.0,
            kind,
            duration: 0.0,
            count: 0,
            code: default_code(),
            amount: default_amount(),
            misread: Misreading::Offset,
            joint: default_joint(),
            input: 0,
        }
    }

    /// Sets its begin: `at` seconds after the first connection or, if injected, after the injection.
    pub fn at(mut self, at: f64) -> Self {
        self.at = at;
        self
    }

    /// Sets its duration [s].
    pub fn lasting(mut self, duration: f64) -> Self {
        self.duration = duration;
        self
    }

    /// Sets how often it is played.
    pub fn times(mut self, count: u32) -> Self {
        self.count = count;
        self
    }

    /// Sets the arm's error code.
    pub fn code(mut self, code: u16) -> Self {
        self.code = code;
        self
    }

    /// Returns how long from `now` [s since the first connection] the fault still lasts, if it has a duration.
    pub fn left(&self, now: f64) -> Option<Duration> {
        let left = (self.at + self.duration - now).clamp(0.0, LARGEST);
        (self.duration > 0.0).then(|| Duration::from_secs_f64(left))
    }

    fn over(&self, now: f64) -> bool {
        self.duration > 0.0 && now >= self.at + self.duration
    }
}

/// A fault script, and how much of it has been played.
#[derive(Debug, Clone, Default)]
pub struct FaultScript {
    entries: Vec<Entry>,
}

#[derive(Debug, Clone)]
struct Entry {
    fault: Fault,
    played: u32,
    /// Whether its event was recorded.
    noted: Cell<bool>,
}

impl Entry {
    fn new(fault: Fault) -> Self {
        Self { fault, played: 0, noted: Cell::new(false) }
    }

    fn over(&self, now: f64) -> bool {
        let fault = &self.fault;
        let limit = if fault.count == 0 && fault.duration == 0.0 { 1 } else { fault.count };
        (limit > 0 && self.played >= limit) || fault.over(now)
    }

    fn is(&self, kind: FaultKind, now: f64) -> bool {
        self.fault.kind == kind && now >= self.fault.at && !self.over(now)
    }

    fn note(&self) {
        if !self.noted.replace(true) {
            events::note(SimEvent::Fault(self.fault.kind));
        }
    }
}

impl FaultScript {
    /// Creates a script.
    pub fn new(faults: &[Fault]) -> Self {
        Self { entries: faults.iter().copied().map(Entry::new).collect() }
    }

    /// Adds a fault that begins `fault.at` seconds after `now` [s since the first connection].
    pub fn inject(&mut self, mut fault: Fault, now: f64) {
        fault.at += now;
        self.entries.retain(|entry| !entry.over(now));
        self.entries.push(Entry::new(fault));
    }

    /// Returns the fault of this kind that is due at `now` [s since the first connection], and counts it as played.
    pub fn take(&mut self, kind: FaultKind, now: f64) -> Option<Fault> {
        self.take_if(kind, now, |_| true)
    }

    /// As above, for a fault that `wanted` accepts; others remain.
    pub fn take_if(&mut self, kind: FaultKind, now: f64, wanted: impl Fn(&Fault) -> bool) -> Option<Fault> {
        let entry = self.entries.iter_mut().find(|entry| entry.is(kind, now) && wanted(&entry.fault))?;
        entry.played += 1;
        entry.note();
        Some(entry.fault)
    }

    /// Returns all faults of this kind that are due at `now`, and counts them as played.
    pub fn take_all(&mut self, kind: FaultKind, now: f64) -> impl Iterator<Item = Fault> {
        self.entries.iter_mut().filter(move |entry| entry.is(kind, now)).map(|entry| {
            entry.played += 1;
            entry.note();
            entry.fault
        })
    }

    /// Returns whether a fault of this kind with a duration is active at `now`. Does not count it as played.
    pub fn lasts(&self, kind: FaultKind, now: f64) -> bool {
        let active = self.entries.iter().find(|entry| entry.fault.duration > 0.0 && entry.is(kind, now));
        active.is_some_and(|entry| {
            entry.note();
            true
        })
    }
}

/// Returns some kinds and more of them; `N` is how many all are.
#[allow(clippy::indexing_slicing, reason = "computed when compiled")]
pub const fn joined<const N: usize>(some: &[FaultKind], more: &[FaultKind]) -> [FaultKind; N] {
    let mut all = [FaultKind::Stall; N];
    let mut i = 0;
    while i < N {
        all[i] = if i < some.len() { some[i] } else { more[i - some.len()] };
        i += 1;
    }
    all
}

/// Refuses a script with kinds that the simulated arm `name` cannot play. The error names the entry of `faults`.
pub fn check_script(name: &str, faults: &[Fault], playable: &[FaultKind]) -> Result<(), ConfigError> {
    let unknown = faults.iter().enumerate().find(|(_, fault)| !playable.contains(&fault.kind));
    let Some((index, fault)) = unknown else { return Ok(()) };
    let known: Vec<String> = playable.iter().map(|kind| format!("{:?}", kind.name())).collect();
    let what = format!("{name} cannot play the fault {:?}; it can play {}", fault.kind.name(), known.join(", "));
    Err(ConfigError::new(format!("faults.{index}.kind"), what))
}

/// Refuses a fault that the simulated arm `name` cannot play.
pub fn check_kind(name: &str, fault: &Fault, playable: &[FaultKind]) -> Result<(), String> {
    check_script(name, std::slice::from_ref(fault), playable).map_err(|error| error.what)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fault_without_count_or_duration_is_played_once() {
        let mut script = FaultScript::new(&[Fault::new(FaultKind::ReadError).at(1.0)]);
        assert_eq!(script.take(FaultKind::ReadError, 0.9), None);
        assert_eq!(script.take(FaultKind::WriteError, 1.0), None);
        assert!(script.take(FaultKind::ReadError, 1.0).is_some());
        assert_eq!(script.take(FaultKind::ReadError, 1.1), None);
    }

    #[test]
    fn duration_and_count_bound_a_fault() {
        let fault = Fault::new(FaultKind::Nan).at(1.0).lasting(2.0).times(2);
        let mut script = FaultScript::new(&[fault, Fault::new(FaultKind::Silent).lasting(0.5)]);
        assert!(script.take(FaultKind::Nan, 1.0).is_some());
        assert!(!script.lasts(FaultKind::Nan, 0.9) && script.lasts(FaultKind::Nan, 1.0));
        assert!(script.take(FaultKind::Nan, 2.0).is_some());
        assert!(script.take(FaultKind::Nan, 2.5).is_none(), "played twice already");
        assert!((0..100).all(|_| script.take(FaultKind::Silent, 0.4).is_some()), "no count: any number of times");
        assert!(script.take(FaultKind::Silent, 0.5).is_none(), "its duration is over");
    }

    #[test]
    fn injected_faults_count_from_now() {
        let mut script = FaultScript::default();
        script.inject(Fault::new(FaultKind::Stall).at(0.5), 10.0);
        assert!(script.take(FaultKind::Stall, 10.4).is_none());
        assert!(script.take(FaultKind::Stall, 10.5).is_some());
    }

    #[test]
    fn every_kind_says_what_it_is() {
        let all = FaultKind::all();
        assert_eq!((all.len(), all[2].0), (FaultKind::GripperBlocked as usize + 1, FaultKind::Stall));
        assert!(all.iter().all(|(_, about)| about.ends_with('.')), "{all:?}");
    }

    #[test]
    fn the_written_form_is_strict() {
        let read = serde_json::from_str::<Fault>;
        let fault = read(r#"{"at": 2.0, "kind": "error_code", "code": 3}"#).unwrap();
        assert_eq!((fault.at, fault.kind, fault.code), (2.0, FaultKind::ErrorCode, 3));
        assert!(read(r#"{"kind": "error_code", "cod": 3}"#).is_err());
        assert!(read(r#"{"kind": "explode"}"#).is_err());
        assert!(read(r#"{"kind": "stall", "at": -1}"#).is_err());
    }

    #[test]
    fn kinds_that_cannot_be_played_are_named() {
        let wrong = check_kind("mock", &Fault::new(FaultKind::Garbage), &[FaultKind::Stall]).unwrap_err();
        assert_eq!(wrong, r#"mock cannot play the fault "garbage"; it can play "stall""#);
    }
}
