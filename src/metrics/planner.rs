//! The metrics of a planner: among its run's, or its own where it is attached to a run from another process.

use super::figures::Durations;
use super::text::{Form, Kind, Text};

/// What a planner has done.
#[derive(Debug, Clone, Default)]
pub struct PlannerFigures {
    /// Ended requests by outcome.
    pub ended: [(&'static str, u64); 3],
    /// Time from a request to its end.
    pub durations: Durations,
}

/// What the metrics of an attached planner are made of.
#[derive(Debug, Clone, Default)]
pub struct AttachedFigures {
    /// Its name.
    pub planner: String,
    /// Its blueprint.
    pub blueprint: String,
    /// The run that it is attached to.
    pub run: String,
    /// When it started [s since 1970].
    pub started: f64,
    /// Whether it is connected to the run.
    pub attached: bool,
    /// How often the run was lost.
    pub lost: u64,
    /// Age of the positions that it has of the run's arms [s]; `None` before the first.
    pub age: Option<f64>,
    /// What it has done.
    pub plans: PlannerFigures,
}

impl PlannerFigures {
    pub(super) fn write(&self, text: &mut Text) {
        text.metric("dimos_plans", Kind::Counter, "Requests for a plan that ended, by outcome.");
        for (outcome, count) in self.ended {
            text.sample(&[("outcome", outcome)], count);
        }
        text.metric("dimos_planning_seconds", Kind::Histogram, "Time from the request for a plan to its end.")
            .durations(&self.durations);
    }
}

impl AttachedFigures {
    /// Returns the metrics as text.
    pub fn text(&self, form: Form) -> String {
        let mut text = Text::new(form);
        text.metric("dimos_build", Kind::Info, "The program.").sample(&[("version", crate::VERSION)], 1);
        let labels = [("planner", &*self.planner), ("blueprint", &*self.blueprint), ("run", &*self.run)];
        text.metric("dimos_planner", Kind::Info, "The planner and its run.").sample(&labels, 1);
        text.metric("dimos_planner_start_time_seconds", Kind::Gauge, "Start of the planner, in Unix time.")
            .sample(&[], self.started);
        text.metric("dimos_planner_attached", Kind::Gauge, "Whether the planner is connected to its run: 1 or 0.")
            .sample(&[], u8::from(self.attached));
        text.metric("dimos_planner_lost_runs", Kind::Counter, "How often the planner lost its run.")
            .sample(&[], self.lost);
        let help = "Age of the positions of the arms that the planner has: the run sends them with its requests.";
        text.metric("dimos_planner_state_age_seconds", Kind::Gauge, help).known(&[], self.age);
        self.plans.write(&mut text);
        text.end()
    }
}
