//! The first day at a real arm: measured steps, slow to fast, each asked for, each stoppable. Each gives figures, and
//! the line of the blueprint or of the adapter's row that they belong in.
//!
//! Like the first motion it has one connection and one thread. Whatever is unexpected, and an interruption, ends a step
//! by the arm's own stop; what was measured before is kept.

mod anonymous;
mod drive;
mod errors;
mod gaps;
mod measured;
mod power;
mod readings;
pub mod replay;
pub mod report;
mod stops;

pub use anonymous::remove as remove_serial;

use std::panic::{AssertUnwindSafe, catch_unwind};

use serde::{Deserialize, Serialize};

use super::context::{CLOCKED, rest_point};
use crate::adapter::{AdapterError, ManipulatorAdapter, ManipulatorInfo};
use crate::registry::{AdapterConfig, AdapterSpec, Emulator};
use crate::transport::capture;
use dimos_core::joint::{ControlMode, JointLimits};
use dimos_core::named::named;
use dimos_rt::host;

/// A figure of a step.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Figure {
    /// What was measured.
    pub name: String,
    /// How much.
    pub value: f64,
    /// Its unit.
    pub unit: String,
    /// The line of the blueprint or of the adapter's row that it belongs in.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub line: Option<String>,
}

named! {
    /// How a step ended.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
    #[serde(rename_all = "snake_case")]
    pub enum Outcome {
        /// It was measured.
        Measured = "measured",
        /// The arm cannot do it, or a person did not want it.
        Skipped = "skipped",
        /// Something was unexpected; the arm was stopped.
        Failed = "failed",
        /// A signal came; the arm was stopped.
        Interrupted = "interrupted",
    }
}

/// A step that was made, or not.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Made {
    /// Name of the step.
    pub step: String,
    /// How it ended.
    pub outcome: Outcome,
    /// What was found in words, or why not.
    pub detail: String,
    /// What was measured.
    pub figures: Vec<Figure>,
    /// When it began and ended, on the clock of the capture [µs].
    pub time: (u64, u64),
}

/// A step of the tour.
#[derive(Debug, Clone, Copy)]
pub struct Step {
    /// Name, for `--only`.
    pub name: &'static str,
    /// What happens, for the person who is asked.
    pub about: &'static str,
    /// Whether the arm moves.
    moves: bool,
    run: fn(&mut Tour<'_>) -> Result<String, End>,
}

/// The name of the step in which things go wrong on purpose.
pub const ERRORS: &str = "errors";

/// All steps, in their order: slow to fast, errors last.
pub const STEPS: &[Step] = &[
    Step {
        name: "tool_speed",
        about: "nothing moves: the vendor's limit of the tool's speed, and the speed of joint 1 that meets it",
        moves: false,
        run: |tour| tour.tool_speed(),
    },
    Step {
        name: "seams",
        about: "nothing moves: how far each joint is from the seam of its encoder, and how many turns it counts",
        moves: false,
        run: |tour| tour.seams(),
    },
    Step {
        name: "power",
        about: "the motors come on, go off if the arm has brakes, and come on again; a stop during each",
        moves: true,
        run: |tour| tour.power(),
    },
    Step {
        name: "payload",
        about: "the motors are on, nothing moves: torques at rest against the load that the controller assumes",
        moves: true,
        run: |tour| tour.payload(),
    },
    Step {
        name: "program",
        about: "the motors are on, nothing moves: the controller compiles its program and ends it",
        moves: true,
        run: |tour| tour.program(),
    },
    Step {
        name: "measured",
        about: "the motors are on; push a joint by hand, by at most 1°, and let go: is its position measured or commanded",
        moves: true,
        run: |tour| tour.measured_or_commanded(),
    },
    Step {
        name: "lag",
        about: "one joint goes 2° to either side, slowly: its lag",
        moves: true,
        run: |tour| tour.lag(),
    },
    Step {
        name: "gaps",
        about: "one joint moves at up to 20 % of its top speed; setpoints are left out for 1, 3, 6, 12 and 25 ms, then for good",
        moves: true,
        run: |tour| tour.gaps(),
    },
    Step {
        name: "killed",
        about: "one joint moves at 10 % of its top speed, and the connection is cut in motion",
        moves: true,
        run: |tour| tour.killed(),
    },
    Step {
        name: "stops",
        about: "one joint moves by up to 60°, and is stopped from 10, 25 and 50 % of its top speed",
        moves: true,
        run: |tour| tour.stops(),
    },
    Step {
        name: "velocity",
        about: "one joint gets a velocity of 10 % of its top speed at once: acceleration and jerk",
        moves: true,
        run: |tour| tour.velocity_step(),
    },
    Step {
        name: ERRORS,
        about: "the motors are on, nothing moves: E-stop, safeguard, cable and pendant, one after the other",
        moves: true,
        run: |tour| tour.errors(),
    },
];

/// What a person answers to a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Answer {
    /// Do it.
    Yes,
    /// Not this one.
    Skip,
    /// No more steps.
    End,
}

/// The person at the arm.
pub trait Person {
    /// Asks whether to make a step.
    fn ask(&mut self, step: &Step, about: &str) -> Answer;
    /// Says what happens, or what to do.
    fn tell(&mut self, text: &str);
    /// Returns whether somebody is at the arm who can push it.
    fn is_there(&self) -> bool;
}

/// Why a step ended early.
enum End {
    Skipped(String),
    Failed(String),
    Interrupted,
}

impl From<AdapterError> for End {
    fn from(error: AdapterError) -> Self {
        Self::Failed(error.to_string())
    }
}

fn skipped<T>(why: impl Into<String>) -> Result<T, End> {
    Err(End::Skipped(why.into()))
}

/// What a tour needs of the arm.
pub struct Subject<'a> {
    /// The adapter, connected.
    pub adapter: &'a mut dyn ManipulatorAdapter,
    /// The emulator, where there is one: it plays what a person does at a real arm.
    pub emulator: Option<&'a dyn Emulator>,
    /// The adapter's row.
    pub row: &'a AdapterSpec,
    /// What the adapter was made from.
    pub config: &'a AdapterConfig,
}

/// Steps that are being made.
struct Tour<'a> {
    adapter: &'a mut dyn ManipulatorAdapter,
    emulator: Option<&'a dyn Emulator>,
    row: &'a AdapterSpec,
    config: &'a AdapterConfig,
    interrupted: &'a dyn Fn() -> bool,
    person: &'a mut dyn Person,
    info: ManipulatorInfo,
    limits: JointLimits,
    /// Where the joints are at the start [rad].
    start: Vec<f64>,
    /// The joint that moves (index from 0), and the direction in which it has room.
    joint: usize,
    direction: f64,
    /// How far it may go [rad].
    room: f64,
    /// The last setpoint of that joint [rad from the start].
    offset: f64,
    /// How far it was from a setpoint that was repeated [rad].
    droop: f64,
    /// Whether the arm holds, in servo mode.
    ready: bool,
    figures: Vec<Figure>,
}

/// Makes the steps that `chosen` accepts. Leaves the motors as they were found, if the arm does not fall.
pub fn run(
    subject: Subject<'_>,
    chosen: &dyn Fn(&Step) -> bool,
    person: &mut dyn Person,
    interrupted: &dyn Fn() -> bool,
) -> Result<Vec<Made>, AdapterError> {
    let Subject { adapter, emulator, row, config } = subject;
    let (info, limits) = (adapter.get_info(), adapter.get_limits()?);
    if info.native_rate >= CLOCKED {
        host::enter_realtime(host::DEVICE_PRIORITY);
    }
    let was_on = adapter.read_enabled().unwrap_or(true);
    let mut tour = Tour {
        adapter,
        emulator,
        row,
        config,
        interrupted,
        person,
        info,
        limits,
        start: Vec::new(),
        joint: 0,
        direction: 1.0,
        room: 0.0,
        offset: 0.0,
        droop: 0.0,
        ready: false,
        figures: Vec::new(),
    };
    let mut made = Vec::new();
    let mut ended = None;
    for step in STEPS.iter().filter(|step| chosen(step)) {
        let from = capture::now();
        let (outcome, detail) = match &ended {
            Some(why) => (Outcome::Skipped, String::clone(why)),
            None => tour.make(step, &mut ended),
        };
        let figures = std::mem::take(&mut tour.figures);
        made.push(Made { step: step.name.to_owned(), outcome, detail, figures, time: (from, capture::now()) });
    }
    let left = tour.leave(was_on);
    tour.person.tell(&left);
    Ok(made)
}

impl Tour<'_> {
    /// Makes a step; `ended` is set if it was the last one.
    fn make(&mut self, step: &Step, ended: &mut Option<String>) -> (Outcome, String) {
        let about = self.about(step);
        match self.person.ask(step, &about) {
            Answer::Yes => {}
            Answer::Skip => return (Outcome::Skipped, "not wanted".to_owned()),
            Answer::End => {
                *ended = Some("the tour was ended before it".to_owned());
                return (Outcome::Skipped, "the tour was ended here".to_owned());
            }
        }
        let result = catch_unwind(AssertUnwindSafe(|| (step.run)(self)));
        let (outcome, detail) = match result {
            Ok(Ok(found)) => return (Outcome::Measured, found),
            Ok(Err(End::Skipped(why))) => return (Outcome::Skipped, why),
            Ok(Err(End::Failed(why))) => (Outcome::Failed, why),
            Ok(Err(End::Interrupted)) => (Outcome::Interrupted, "interrupted; the arm was stopped".to_owned()),
            Err(_) => (Outcome::Failed, "the adapter panicked".to_owned()),
        };
        self.ready = false;
        let stopped = self.stop_for_sure();
        if !stopped {
            *ended = Some("the arm did not take a stop: stop it with the vendor's own tools".to_owned());
        } else if outcome == Outcome::Interrupted {
            *ended = Some("interrupted before it".to_owned());
        } else if step.moves && (self.start.is_empty() || self.recover().is_err()) {
            *ended = Some(format!("the arm is not in order since the step {}", step.name));
        }
        (outcome, detail)
    }

    /// Returns what a step does, with the joint that would move.
    fn about(&self, step: &Step) -> String {
        match self.start.is_empty() || !step.about.contains("one joint") {
            true => step.about.to_owned(),
            false => step.about.replacen("one joint", &format!("joint {}", self.joint + 1), 1),
        }
    }

    fn figure(&mut self, name: impl Into<String>, value: f64, unit: &str, line: Option<String>) {
        self.figures.push(Figure { name: name.into(), value, unit: unit.to_owned(), line });
    }

    fn has(&self, mode: ControlMode) -> bool {
        self.info.modes.contains(&mode)
    }

    /// Stops the arm: up to three attempts, as this is the one command that must not be lost.
    fn stop_for_sure(&mut self) -> bool {
        (0..3).any(|_| {
            let rest = rest_point(self.adapter);
            self.adapter.write_stop(&rest).is_ok()
        })
    }

    /// Ends commanded motion, and disables the motors if they were off before and the arm does not fall without them.
    fn leave(&mut self, was_on: bool) -> String {
        let stopped = (0..3).any(|_| {
            let rest = rest_point(self.adapter);
            self.adapter.deactivate(&rest).is_ok()
        });
        match (stopped, was_on, self.info.holds_when_disabled) {
            (false, ..) => "the arm did not take the last stop: stop it with the vendor's own tools".to_owned(),
            (_, true, _) => "motors on, as they were found".to_owned(),
            (_, _, false) => "motors on: this arm falls without them".to_owned(),
            _ => {
                std::thread::sleep(super::first_motion::HOLD_TIME);
                match self.adapter.write_enable(false) {
                    Ok(()) => "motors off, as they were found".to_owned(),
                    Err(e) => format!("motors on: {e}"),
                }
            }
        }
    }
}

/// Fits `way = t·v + s·v²` to speeds and ways, and returns t and s; `None` with fewer than two different speeds. Errors
/// of the ways are alike at all speeds: an encoder's steps.
fn ways(points: &[(f64, f64)]) -> Option<(f64, f64)> {
    let sum = |of: fn(f64, f64) -> f64| points.iter().map(|(v, way)| of(*v, *way)).sum::<f64>();
    let (a, b, c) = (sum(|v, _| v.powi(2)), sum(|v, _| v.powi(3)), sum(|v, _| v.powi(4)));
    let (d, e) = (sum(|v, way| v * way), sum(|v, way| v * v * way));
    let determinant = a * c - b * b;
    (determinant > 1e-6 * a * c).then(|| ((d * c - e * b) / determinant, (a * e - b * d) / determinant))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_and_deceleration_are_found_from_ways() {
        let way = |v: f64| (v, 0.03 * v + v * v / 8.0);
        let (time, slope) = ways(&[way(0.1), way(0.2), way(0.5)]).unwrap();
        assert!((time - 0.03).abs() < 1e-9 && (slope - 0.125).abs() < 1e-9, "{time} {slope}");
        assert_eq!(ways(&[way(0.1)]), None);
        assert_eq!(ways(&[way(0.1), way(0.1)]), None);
    }

    #[test]
    fn steps_have_names_and_errors_come_last() {
        assert_eq!(STEPS.last().map(|step| step.name), Some(ERRORS));
        let mut names: Vec<_> = STEPS.iter().map(|step| step.name).collect();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), STEPS.len());
    }
}
