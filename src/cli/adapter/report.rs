//! What `dimos adapter test` found, for people (a terminal, a Markdown file for the vendor) and for programs.

use serde::Serialize;

use super::super::output::{self, Table, Tone, fixed, toned};
use dimos_core::joint::JointLimits;
use dimos_hardware::conformance::figures::{Figures, Spread};
use dimos_hardware::conformance::first_motion::Motion;
use dimos_hardware::conformance::lag::Lag;
use dimos_hardware::conformance::{Made, Needs, Outcome};

/// The whole report.
#[derive(Debug, Serialize)]
pub struct Report {
    /// The adapter's name.
    pub adapter: String,
    /// Where the arm is; empty for an arm in memory.
    pub address: String,
    /// An emulator stood in for the arm.
    pub simulated: bool,
    /// When, in UTC.
    pub when: String,
    /// The version of this program.
    pub dimos: &'static str,
    /// What the arm says of itself.
    pub arm: Arm,
    /// How its state comes.
    pub figures: Option<Figures>,
    /// Its joint limits.
    pub limits: Limits,
    /// The checks.
    pub checks: Vec<Row>,
    /// The small slow motion.
    pub motion: Option<Motion>,
    /// The lag, where it was measured.
    pub lag: Option<Lag>,
    /// Whether nothing failed.
    pub passed: bool,
}

/// What an arm says of itself.
#[derive(Debug, Serialize)]
pub struct Arm {
    pub vendor: String,
    pub model: String,
    pub dof: usize,
    pub firmware: Option<String>,
    pub serial: Option<String>,
    pub modes: Vec<&'static str>,
    pub wire_units: &'static str,
    pub native_rate_hz: f64,
    pub holds_when_disabled: bool,
}

/// Joint limits [rad], [rad/s].
#[derive(Debug, Serialize)]
pub struct Limits {
    pub position_lower: Vec<f64>,
    pub position_upper: Vec<f64>,
    pub velocity_max: Vec<f64>,
}

/// One check.
#[derive(Debug, Serialize)]
pub struct Row {
    pub name: &'static str,
    pub about: &'static str,
    /// `passed`, `failed` or `skipped`.
    pub outcome: &'static str,
    /// What was found, what is wrong, or why it was skipped.
    pub detail: Option<String>,
    #[serde(skip)]
    only_emulated: bool,
}

impl Row {
    /// The row of a check that was made.
    pub fn of((check, outcome, found): Made) -> Self {
        let (outcome, detail) = match outcome {
            Outcome::Passed => ("passed", found),
            Outcome::Skipped(why) => ("skipped", Some(why)),
            Outcome::Failed(why) => ("failed", Some(why)),
        };
        let only_emulated = check.needs != Needs::Nothing;
        Self { name: check.name, about: check.about, outcome, detail, only_emulated }
    }
}

impl From<&JointLimits> for Limits {
    fn from(limits: &JointLimits) -> Self {
        Self {
            position_lower: limits.position_lower.clone(),
            position_upper: limits.position_upper.clone(),
            velocity_max: limits.velocity_max.clone(),
        }
    }
}

/// What an emulator cannot tell.
const BEYOND_AN_EMULATOR: &str =
    "not checked, only the real arm knows: zeros, directions, true limits, whether it falls";

/// A part of a report: a title, a table whose first column may be verdicts, and lines below it.
struct Part {
    title: &'static str,
    headings: Vec<&'static str>,
    rows: Vec<Vec<String>>,
    notes: Vec<String>,
}

impl Part {
    fn print(self) {
        output::line("");
        output::line(self.title);
        let mut table = Table::new(&self.headings);
        for row in self.rows {
            let mut cells: Vec<comfy_table::Cell> = row.iter().map(comfy_table::Cell::new).collect();
            let tone = match row.first().map(String::as_str) {
                Some("passed") => Some(Tone::Good),
                Some("failed") => Some(Tone::Bad),
                _ => None,
            };
            if let (Some(tone), Some(first)) = (tone, cells.first_mut()) {
                *first = toned(row.first().cloned().unwrap_or_default(), tone);
            }
            table.row(cells);
        }
        table.print();
        self.notes.iter().for_each(output::line);
    }
}

impl Report {
    /// How many checks ended in this way.
    pub fn count(&self, outcome: &str) -> usize {
        self.checks.iter().filter(|row| row.outcome == outcome).count()
    }

    /// One sentence.
    pub fn verdict(&self) -> String {
        let odd = self.motion.as_ref().is_some_and(|motion| motion.odd.is_some());
        let motion = match &self.motion {
            None if self.simulated || self.address.is_empty() => "",
            None => "; nothing was moved",
            Some(_) if odd => "; the motion was ODD and was stopped",
            Some(motion) if motion.interrupted => "; the motion was interrupted",
            Some(_) if self.lag.as_ref().is_some_and(|lag| !lag.complete()) => "; the lag was not measured",
            Some(_) => "; each joint moved as commanded",
        };
        let (passed, failed, skipped) = (self.count("passed"), self.count("failed"), self.count("skipped"));
        let emulated = self.checks.iter().filter(|row| self.is_for_emulators(row)).count();
        let not_run = match emulated {
            0 => String::new(),
            n => format!(", {n} not run: for emulators only"),
        };
        format!("{passed} checks passed, {failed} failed, {} do not apply{not_run}{motion}", skipped - emulated)
    }

    /// Whether a check was not made because the arm is a real one.
    fn is_for_emulators(&self, row: &Row) -> bool {
        let on_real = !self.simulated && !self.address.is_empty();
        row.only_emulated && row.outcome == "skipped" && on_real
    }

    fn title(&self) -> String {
        let place = match (self.simulated, self.address.is_empty()) {
            (true, _) => "SIMULATED".to_owned(),
            (_, true) => "in memory".to_owned(),
            _ => format!("at {}", self.address),
        };
        format!("{} {place}", self.adapter)
    }

    fn facts(&self) -> Vec<(&'static str, String)> {
        let (arm, said) =
            (&self.arm, |text: &Option<String>| text.clone().unwrap_or_else(|| "not reported".to_owned()));
        vec![
            ("arm", format!("{} {}, {} joints", arm.vendor, arm.model, arm.dof)),
            ("firmware", said(&arm.firmware)),
            ("serial", said(&arm.serial)),
            ("modes", arm.modes.join(", ")),
            ("on the wire", format!("{} (here: rad, rad/s, m, Nm)", arm.wire_units)),
            ("motors off", if arm.holds_when_disabled { "it keeps its pose" } else { "it FALLS" }.to_owned()),
            ("tested", format!("{}, dimos {}", self.when, self.dimos)),
        ]
    }

    fn parts(&self) -> Vec<Part> {
        let figures = self.figures.as_ref().map(state_part);
        [Some(self.checks_part()), figures, Some(self.limits_part())].into_iter().flatten().collect()
    }

    fn checks_part(&self) -> Part {
        // On a real arm most of the suite is for emulators: those checks in one line, not in thirty.
        let hidden = |row: &&Row| self.is_for_emulators(row);
        let mut rows: Vec<Vec<String>> = self
            .checks
            .iter()
            .filter(|row| !hidden(row))
            .map(|row| {
                let detail = row.detail.clone().unwrap_or_else(|| row.about.to_owned());
                vec![row.outcome.to_owned(), row.name.to_owned(), detail]
            })
            .collect();
        let unchecked: Vec<&str> = self.checks.iter().filter(hidden).map(|row| row.name).collect();
        let mut notes = Vec::new();
        if self.simulated {
            notes.push(BEYOND_AN_EMULATOR.to_owned());
        }
        if !unchecked.is_empty() {
            let name = format!("{} more", unchecked.len());
            rows.push(vec!["skipped".to_owned(), name, "they move the arm fast or cut its wire: --address sim".into()]);
            notes.push(format!("not checked on this arm: {}", unchecked.join(", ")));
        }
        Part { title: "checks", headings: vec!["", "CHECK", "FOUND"], rows, notes }
    }

    fn limits_part(&self) -> Part {
        let degrees = |values: &[f64], i: usize| {
            values.get(i).map_or_else(String::new, |v| format!("{} ({}°)", fixed(*v, 4), fixed(v.to_degrees(), 1)))
        };
        let row = |i: usize| {
            let (lower, upper) = (&self.limits.position_lower, &self.limits.position_upper);
            vec![(i + 1).to_string(), degrees(lower, i), degrees(upper, i), degrees(&self.limits.velocity_max, i)]
        };
        let headings = vec![">JOINT", ">LOWER rad", ">UPPER rad", ">SPEED rad/s"];
        Part { title: "limits", headings, rows: (0..self.arm.dof).map(row).collect(), notes: Vec::new() }
    }

    /// Prints to stdout what was found without motion.
    pub fn print(&self) {
        output::line(self.title());
        for (what, text) in self.facts() {
            output::line(format_args!("  {what:<12} {text}"));
        }
        self.parts().into_iter().for_each(Part::print);
    }

    /// What came of the motion.
    fn moved_parts(&self) -> impl Iterator<Item = Part> {
        self.motion.iter().map(motion_part).chain(self.lag.iter().map(lag_part))
    }

    /// Prints the rest: the motion, if there was one, and the verdict.
    pub fn conclude(&self) {
        self.moved_parts().for_each(Part::print);
        output::line("");
        output::line(self.verdict());
    }

    /// The same as Markdown.
    pub fn markdown(&self) -> String {
        let mut text = format!("# {}\n\n{}\n\n", self.title(), self.verdict());
        for (what, fact) in self.facts() {
            text += &format!("- {what}: {}\n", escaped(&fact));
        }
        for part in self.parts().into_iter().chain(self.moved_parts()) {
            text += &format!("\n## {}\n\n", part.title);
            let line = |cells: Vec<String>| format!("| {} |\n", cells.join(" | "));
            text += &line(part.headings.iter().map(|h| h.trim_start_matches('>').to_owned()).collect());
            text +=
                &line(part.headings.iter().map(|h| if h.starts_with('>') { "---:" } else { "---" }.into()).collect());
            part.rows.iter().for_each(|row| text += &line(row.iter().map(|cell| escaped(cell)).collect()));
            text += if part.notes.is_empty() { "" } else { "\n" };
            part.notes.iter().for_each(|note| text += &format!("- {note}\n"));
        }
        text
    }
}

/// What would end a cell of a Markdown table.
fn escaped(text: &str) -> String {
    text.replace('|', "\\|").replace('\n', " ")
}

fn state_part(figures: &Figures) -> Part {
    let ms = |spread: &Spread| [spread.p50, spread.p99, spread.max].map(|v| fixed(v, 3)).to_vec();
    let row = |what: &str, cells: Vec<String>| [vec![what.to_owned()], cells].concat();
    let one = |what: &str, text: String| row(what, vec![text, String::new(), String::new()]);
    let how = if figures.sends_by_itself { "it streams" } else { "it is polled" };
    let mut rows = vec![
        one("how it comes", how.to_owned()),
        one("new states per second [Hz]", fixed(figures.rate, 1)),
        one("readings, and those that failed", format!("{}, {}", figures.readings, figures.failed)),
        row("from state to state [ms]", ms(&figures.interval)),
        row("a reading takes [ms]", ms(&figures.reading)),
    ];
    rows.push(match &figures.age {
        Some(age) => row("age when read [ms]", ms(age)),
        None => one("age when read", "it gives no time".to_owned()),
    });
    Part { title: "state", headings: vec!["", ">MEDIAN", ">99 %", ">MOST"], rows, notes: Vec::new() }
}

fn lag_part(lag: &Lag) -> Part {
    let ms = |seconds: f64| format!("{:.0} ms", 1e3 * seconds);
    let rows = lag.joints.iter().enumerate().map(|(i, joint)| {
        let text = joint.map_or_else(|| "not measured".to_owned(), |lag| fixed(1e3 * lag, 1));
        vec![(i + 1).to_string(), text]
    });
    let (row, mut notes) = (ms(lag.row), Vec::new());
    if let (Some(largest), Some(median)) = (lag.largest, lag.median) {
        notes.push(format!("lag {} (row: {row}; set hardware.arm.lag: {largest:.3})", ms(largest)));
        notes.push(format!("the largest of all joints; the median is {}", ms(median)));
    }
    if !lag.complete() {
        let why = "not measured: over 500 ms, or other programs took the processor; try again without them";
        notes.push(why.to_owned());
    }
    let title = "lag: from a setpoint to the measured motion";
    Part { title, headings: vec![">JOINT", ">LAG ms"], rows: rows.collect(), notes }
}

fn motion_part(motion: &Motion) -> Part {
    let degrees = |v: f64| {
        let text = fixed(v.to_degrees(), 2);
        if text.starts_with('-') { text } else { format!("+{text}") }
    };
    let rows = motion.ways.iter().map(|way| {
        vec![
            "passed".to_owned(),
            way.joint.to_string(),
            way.mode.name().to_owned(),
            format!("±{:.2}", way.sent.to_degrees()),
            degrees(way.up),
            degrees(way.down),
            degrees(way.back),
            fixed(way.others.to_degrees(), 2),
            way.velocity.map_or_else(|| "-".to_owned(), |v| fixed(v, 2)),
            fixed(way.seconds, 1),
        ]
    });
    let mut notes = Vec::new();
    notes.extend(motion.held.map(|held| format!("motors on: it moved by {}°", fixed(held.to_degrees(), 2))));
    notes.extend(motion.stopped.map(|on| format!("a stop in motion: it moved another {}°", fixed(on.to_degrees(), 2))));
    notes.extend(motion.odd.as_ref().map(|odd| format!("ODD: {odd}; stopped there")));
    notes.extend(motion.interrupted.then(|| "interrupted; stopped there".to_owned()));
    notes.push(format!("left with {}", motion.left));
    let headings =
        vec!["", ">JOINT", "MODE", ">SENT °", ">UP °", ">DOWN °", ">BACK °", ">OTHERS °", ">SPEED/WAY", ">TIME s"];
    let title = "motion: compare the direction of each joint with the data sheet";
    Part { title, headings, rows: rows.collect(), notes }
}
