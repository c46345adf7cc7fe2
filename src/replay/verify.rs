//! Replays a log: passes the inputs and requests of every tick through [`Coordinator::tick`] again, and compares the
//! outputs bit for bit.

use std::path::Path;

use mcap::parse_record;
use mcap::records::{Record, op};
use serde::Serialize;

use super::compare::{Comparison, Difference};
use super::inputs::{Assembler, LoggedTick, Topic};
use super::recorded::{Recorded, RecordedError};
use dimos_control::config::CoordinatorConfig;
use dimos_control::coordinator::{Coordinator, TickOutput};
use dimos_control::request::Envelope;
use dimos_control::task::Task;
use dimos_control::task_spec::TaskTable;
use dimos_core::arm::ArmState;
use dimos_log::chunk;
use dimos_log::records::{Damage, Kept, RawRecord, RecordReader};
use dimos_log::replay::ReplayError;
use dimos_log::source_files::{self, LogFile};

/// Result of a verification.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "result", rename_all = "snake_case")]
pub enum Finding {
    /// All outputs are identical.
    Reproducible,
    /// The first difference.
    Different(Difference),
    /// From some tick on, inputs are missing in the log. All earlier outputs are identical.
    Incomplete {
        /// The first tick that cannot be verified.
        tick: u64,
        /// The reason.
        why: String,
    },
}

/// Result and figures of a verification.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Verification {
    /// The result.
    #[serde(flatten)]
    pub finding: Finding,
    /// Ticks with identical outputs.
    pub ticks: u64,
    /// Their requests.
    pub requests: u64,
    /// Their events.
    pub events: u64,
    /// Time from the first to the last of these ticks [s].
    pub length: f64,
    /// Whether the run was live: what its log contained was verified, except the last tick.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub live: bool,
}

/// Replays a log and compares. Rejects a log with another config version, or with a task type that `table` lacks.
pub fn verify(path: &Path, table: &TaskTable) -> Result<Verification, RecordedError> {
    verify_with(path, table, &mut |_, _| ())
}

/// Same; `progress` gets how much of how much is read [bytes].
pub fn verify_with(
    path: &Path,
    table: &TaskTable,
    progress: &mut dyn FnMut(u64, u64),
) -> Result<Verification, RecordedError> {
    let recorded = Recorded::open(path)?;
    recorded.check_version()?;
    let tasks = table.build(&recorded.config.tasks);
    let tasks = tasks.map_err(|what| RecordedError::Unfit { path: path.to_owned(), what })?;
    let mut run = Rerun::new(&recorded, &recorded.config, tasks);
    let end = run.read(path, progress)?;
    Ok(run.finish(end))
}

/// Handler of a tick: what the log has, what it gave now, and its time after the first tick [ns].
pub(super) type See<'a> = &'a mut dyn FnMut(&LoggedTick, &TickOutput, u64);

/// A log on its way through a coordinator.
pub(super) struct Rerun<'a> {
    recorded: &'a Recorded,
    channels: Vec<Option<Topic>>,
    ticks: Assembler,
    coordinator: Coordinator,
    comparison: Comparison<'a>,
    /// Sees the ticks instead of the comparison.
    see: Option<See<'a>>,
    states: Vec<ArmState>,
    requests: Vec<Envelope>,
    /// Deadlines of the first and of the last tick [ns].
    span: Option<(u64, u64)>,
    counts: Verification,
    found: Option<Finding>,
}

impl<'a> Rerun<'a> {
    /// Prepares to run the inputs of a log with a configuration.
    pub fn new(recorded: &'a Recorded, config: &CoordinatorConfig, tasks: Vec<Task>) -> Self {
        Self {
            recorded,
            channels: Vec::new(),
            ticks: Assembler::new(recorded),
            coordinator: Coordinator::new(config, tasks),
            comparison: Comparison::new(recorded),
            see: None,
            states: vec![ArmState::default(); recorded.config.arms.len()],
            requests: Vec::new(),
            span: None,
            counts: Verification {
                finding: Finding::Reproducible,
                ticks: 0,
                requests: 0,
                events: 0,
                length: 0.0,
                live: false,
            },
            found: None,
        }
    }

    /// Lets `see` have the ticks, which are then not compared.
    pub fn seen_by(mut self, see: See<'a>) -> Self {
        self.see = Some(see);
        self
    }

    /// Reads all files of the log; `progress` gets how much of how much is read [bytes]. Returns where it is cut.
    pub fn read(
        &mut self,
        path: &Path,
        progress: &mut dyn FnMut(u64, u64),
    ) -> Result<Option<ReplayError>, RecordedError> {
        let (files, mut before) = (source_files::of(path)?, 0);
        let length = files.iter().filter_map(|file| Some(file.path.metadata().ok()?.len())).sum();
        for LogFile { path, wrong } in files {
            if let Some(reason) = wrong {
                let damage = Damage { path, at: 0, span: None, reason, kept: Kept::None };
                return Ok(Some(ReplayError::Damaged { damage }));
            }
            let mut records = RecordReader::open(&path)?;
            self.counts.live = records.is_live();
            loop {
                progress(before + records.position().0, length);
                match records.next_record() {
                    Ok(Some(record)) => {
                        if let Err(damage) = self.record(&record) {
                            return Ok(Some(records.cut(record.at, damage)));
                        }
                    }
                    Ok(None) => break,
                    Err(cut @ ReplayError::Cut { .. }) => return Ok(Some(cut)),
                    Err(e) => return Err(e.into()),
                }
                if self.found.is_some() {
                    return Ok(None);
                }
            }
            before += records.position().1;
        }
        Ok(None)
    }

    fn record(&mut self, record: &RawRecord) -> Result<(), String> {
        match record.opcode {
            op::CHUNK => chunk::each_checked(&record.body, |opcode, body| self.contents(opcode, body)),
            opcode => {
                self.contents(opcode, &record.body);
                Ok(())
            }
        }
    }

    /// Handles a record of a chunk, or one outside of chunks.
    fn contents(&mut self, opcode: u8, body: &[u8]) {
        match opcode {
            _ if self.found.is_some() => {}
            op::CHANNEL => {
                if let Ok(Record::Channel(channel)) = parse_record(opcode, body) {
                    let id = usize::from(channel.id);
                    self.channels.resize(self.channels.len().max(id + 1), None);
                    self.channels[id] = Topic::of(&channel.topic, self.recorded);
                }
            }
            op::MESSAGE => {
                // Channel, sequence and two times precede the message.
                let Some((header, bytes)) = body.split_at_checked(22) else { return };
                let channel = usize::from(u16::from_le_bytes([header[0], header[1]]));
                if let Some(topic) = self.channels.get(channel).copied().flatten() {
                    self.message(topic, bytes);
                }
            }
            _ => {}
        }
    }

    fn message(&mut self, topic: Topic, bytes: &[u8]) {
        if self.ticks.completes(topic) {
            self.run_tick();
        }
        if self.found.is_some() {
            return;
        }
        if let Err(why) = self.ticks.take(topic, bytes) {
            self.stop_at(self.counts.ticks, why);
        }
    }

    fn stop_at(&mut self, tick: u64, why: String) {
        self.found = Some(Finding::Incomplete { tick, why });
    }

    /// Runs the complete tick.
    fn run_tick(&mut self) {
        let (index, dropped) = (self.ticks.logged.tick.tick, self.ticks.logged.tick.dropped);
        let expected = self.counts.ticks;
        if index != expected || dropped > 0 {
            return self.stop_at(expected, format!("{dropped} samples were lost up to tick {index}"));
        }
        if let Err(why) = self.ticks.requests(&mut self.requests) {
            return self.stop_at(index, why);
        }
        let logged = &self.ticks.logged;
        for (state, arm) in self.states.iter_mut().zip(&logged.arms) {
            *state = arm.state;
        }
        self.counts.requests += self.requests.len() as u64;
        for (arm, verdict) in logged.guard_verdicts(&self.recorded.names) {
            self.coordinator.replay_guard(arm, verdict);
        }
        let mut requests = self.requests.drain(..);
        let output = self.coordinator.tick(logged.time(), &self.states, || requests.next());
        drop(requests);
        let deadline = logged.tick.deadline_ns;
        let (first, _) = *self.span.get_or_insert((deadline, deadline));
        let time = deadline.saturating_sub(first);
        if let Some(see) = &mut self.see {
            see(logged, output, time);
        } else if let Some(difference) = self.comparison.compare(logged, output, time) {
            self.found = Some(Finding::Different(difference));
            return;
        }
        self.span = Some((first, deadline));
        self.counts.events += logged.events.len() as u64;
        self.counts.ticks += 1;
        self.ticks.next();
    }

    /// Runs the last tick, unless the log is cut.
    pub fn finish(mut self, cut: Option<ReplayError>) -> Verification {
        match cut {
            // The last tick's requests and events may be lost in the cut.
            Some(cut) if self.found.is_none() => self.stop_at(self.counts.ticks, first_line(&cut.to_string())),
            // Those of a live run's last tick may not be written yet.
            None if self.found.is_none() && self.ticks.is_closed() && !self.counts.live => self.run_tick(),
            _ => {}
        }
        let (first, last) = self.span.unwrap_or_default();
        Verification {
            finding: self.found.unwrap_or(Finding::Reproducible),
            length: last.saturating_sub(first) as f64 * 1e-9,
            ..self.counts
        }
    }
}

fn first_line(text: &str) -> String {
    text.lines().next().unwrap_or_default().to_owned()
}
