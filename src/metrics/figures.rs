//! The metrics of a run. What is unknown is absent; counters count from the start of the run.

use std::collections::BTreeMap;

use super::planner::PlannerFigures;
use super::text::{Form, Kind, Text};
use dimos_core::arm::Link;
use dimos_core::telemetry::{Event, Phase, TaskState};
use dimos_rpc::Code;
use dimos_rpc::api::Class;
use dimos_rpc::report::{ArmReport, StatusReport};

/// How many durations do not exceed this one [ns], and the number of all.
pub type Durations = (Vec<(u64, u64)>, u64);

/// What the metrics are made of.
#[derive(Debug, Clone, Default)]
pub struct Figures {
    /// What `status` reports.
    pub status: StatusReport,
    /// When the run started [s since 1970].
    pub started: f64,
    /// Delay of the tick's wake-up.
    pub lateness: Durations,
    /// Time from the tick's wake-up to the last command passed on.
    pub compute: Durations,
    /// The log; `None` without one.
    pub log: Option<LogFigures>,
    /// What its own planner has done; `None` without one.
    pub planner: Option<PlannerFigures>,
    /// What has happened.
    pub counts: Counts,
}

/// The log on its disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct LogFigures {
    /// Bytes written, of all files of the log.
    pub written: u64,
    /// Free space on its disk [bytes]; `None` if the file system does not report it.
    pub free: Option<u64>,
}

/// Events of the run, counted.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Counts {
    /// Holds of an arm by cause.
    held: BTreeMap<(u16, &'static str), u64>,
    /// Ends of motions by task (`None`: by an arm's own controller) and state.
    motions: BTreeMap<(Option<u16>, &'static str), u64>,
    /// Refused commands by method and error code.
    refused: BTreeMap<(&'static str, String), u64>,
}

impl Counts {
    /// Counts an event of the tick.
    pub fn event(&mut self, event: &Event) {
        match event {
            Event::Arm(arm, Phase::Held, cause) => *self.held.entry((*arm, cause.name())).or_default() += 1,
            Event::Task(task, state, _) => self.motion(Some(*task), *state),
            _ => {}
        }
    }

    /// Counts a refused request, unless it only reads.
    pub fn refused(&mut self, method: &'static str, code: &Code) {
        if Class::of(method) != Some(Class::Read) {
            *self.refused.entry((method, code.name())).or_default() += 1;
        }
    }

    /// Counts a motion of a task, or of an arm's own controller, if this state ends it.
    pub fn motion(&mut self, task: Option<u16>, state: TaskState) {
        if matches!(state, TaskState::Completed | TaskState::Aborted | TaskState::Fault) {
            *self.motions.entry((task, state.name())).or_default() += 1;
        }
    }
}

impl Figures {
    /// Returns the metrics as text.
    pub fn text(&self, form: Form) -> String {
        let mut text = Text::new(form);
        self.run(&mut text);
        self.tick(&mut text);
        self.arms(&mut text);
        self.events(&mut text);
        self.planner.iter().for_each(|planner| planner.write(&mut text));
        self.log(&mut text);
        text.end()
    }

    fn run(&self, text: &mut Text) {
        let (status, simulated) = (&self.status, self.status.simulated.to_string());
        text.metric("dimos_build", Kind::Info, "The program.").sample(&[("version", &status.version)], 1);
        let labels = [("run", &*status.run), ("blueprint", &*status.blueprint), ("simulated", &*simulated)];
        text.metric("dimos_run", Kind::Info, "The run; simulated: whether any arm is.").sample(&labels, 1);
        text.metric("dimos_run_start_time_seconds", Kind::Gauge, "Start of the run, in Unix time.")
            .sample(&[], self.started);
        text.metric("dimos_speed_override_ratio", Kind::Gauge, "The speed override.")
            .sample(&[], status.speed.fraction);
        text.metric("dimos_paused", Kind::Gauge, "Whether all motions are paused: 1 or 0.")
            .sample(&[], u8::from(status.speed.paused));
    }

    fn tick(&self, text: &mut Text) {
        let ticks = &self.status.ticks;
        text.metric("dimos_tick_rate_hertz", Kind::Gauge, "Nominal rate of the tick.")
            .sample(&[], self.status.tick_rate);
        text.metric("dimos_ticks", Kind::Counter, "Ticks.").sample(&[], ticks.count);
        text.metric("dimos_tick_overruns", Kind::Counter, "Ticks that began at least one period late.")
            .sample(&[], ticks.overruns);
        text.metric("dimos_tick_skipped_periods", Kind::Counter, "Periods skipped after overruns.")
            .sample(&[], ticks.skipped);
        text.metric("dimos_tick_lateness_seconds", Kind::Histogram, "Delay of the wake-up after the deadline.")
            .durations(&self.lateness);
        text.metric("dimos_tick_compute_seconds", Kind::Histogram, "Time from the wake-up to the last command.")
            .durations(&self.compute);
    }

    fn arms(&self, text: &mut Text) {
        let arms = &self.status.arms;
        fn label(arm: &ArmReport) -> [(&str, &str); 1] {
            [("arm", &arm.hardware_id)]
        }
        text.metric("dimos_arm_phase", Kind::StateSet, "Phase of the arm.");
        arms.iter().for_each(|arm| text.states(&label(arm), Phase::ALL.iter().map(|phase| phase.name()), &arm.phase));
        text.metric("dimos_arm_link", Kind::StateSet, "State of the connection to the arm.");
        arms.iter().for_each(|arm| text.states(&label(arm), Link::ALL.iter().map(|link| link.name()), &arm.link));
        text.metric("dimos_arm_reading_age_seconds", Kind::Gauge, "Age of the latest reading.");
        for arm in arms {
            text.known(&label(arm), arm.state_age_ms.map(|age| age / 1e3));
        }
        text.metric("dimos_arm_reading_rate_hertz", Kind::Gauge, "Measured rate of new readings.");
        for arm in arms {
            text.known(&label(arm), arm.measured_rate_hz);
        }
        for (counter, name, help) in [
            ("reads", "dimos_arm_reads", "Reads of the arm."),
            ("read_errors", "dimos_arm_read_errors", "Reads that failed."),
            ("writes", "dimos_arm_writes", "Writes to the arm."),
            ("write_errors", "dimos_arm_write_errors", "Writes that failed."),
            ("withheld", "dimos_arm_withheld_setpoints", "Setpoints that the device thread did not send."),
            ("reconnects", "dimos_arm_reconnects", "Connections made again."),
        ] {
            text.metric(name, Kind::Counter, help);
            for arm in arms {
                text.known(&label(arm), arm.counters.get(counter));
            }
        }
    }

    fn events(&self, text: &mut Text) {
        let counts = &self.counts;
        let arm = |arm: u16| self.status.arms.get(usize::from(arm)).map_or("", |arm| &arm.hardware_id);
        text.metric("dimos_arm_holds", Kind::Counter, "Holds of the arm, by cause.");
        for ((index, cause), count) in &counts.held {
            text.sample(&[("arm", arm(*index)), ("cause", cause)], count);
        }
        let task = |task: u16| self.status.tasks.get(usize::from(task)).map_or("", |task| &task.name);
        text.metric("dimos_motions", Kind::Counter, "Motions and streams that ended, by task and outcome.");
        for ((index, outcome), count) in &counts.motions {
            text.sample(&[("task", index.map_or("native", task)), ("outcome", outcome)], count);
        }
        text.metric("dimos_commands_refused", Kind::Counter, "Commands that the run refused, by method and error.");
        for ((method, code), count) in &counts.refused {
            text.sample(&[("method", method), ("code", code)], count);
        }
    }

    fn log(&self, text: &mut Text) {
        let (recorder, log) = (self.status.recorder.as_ref(), self.log);
        text.metric("dimos_log_messages", Kind::Counter, "Messages written to the log.")
            .known(&[], recorder.map(|recorder| recorder.messages));
        text.metric("dimos_log_lost_samples", Kind::Counter, "Samples missing in the log: the recorder fell behind.")
            .known(&[], recorder.map(|recorder| recorder.dropped));
        text.metric("dimos_log_written_bytes", Kind::Counter, "Bytes written to the log.")
            .known(&[], log.map(|log| log.written));
        text.metric("dimos_log_disk_free_bytes", Kind::Gauge, "Free space on the disk of the log.")
            .known(&[], log.and_then(|log| log.free));
    }
}
