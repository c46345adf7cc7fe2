//! The cycle-time report: how long each step and each cycle took.

use serde_json::{Value, json};

use super::step::{Act, Job, Step};
use crate::cli::output::{Table, fixed};

/// Most durations kept of a step: the latest.
const KEPT: usize = 100_000;

/// Durations of a step or of cycles [s].
#[derive(Debug, Clone, Default)]
pub struct Times {
    count: u64,
    latest: Vec<f64>,
}

impl Times {
    /// Adds a duration [s].
    pub fn add(&mut self, seconds: f64) {
        let slot = (self.count % KEPT as u64) as usize;
        self.count += 1;
        match self.latest.get_mut(slot) {
            Some(old) => *old = seconds,
            None => self.latest.push(seconds),
        }
    }

    /// Returns how many there are.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// Returns mean, minimum, maximum and 95th percentile of the latest [s]; `None` without any.
    pub fn figures(&self) -> Option<[f64; 4]> {
        let mut sorted = self.latest.clone();
        sorted.sort_by(f64::total_cmp);
        let (first, last) = (*sorted.first()?, *sorted.last()?);
        let rank = (sorted.len() * 95).div_ceil(100).max(1);
        let mean = sorted.iter().sum::<f64>() / sorted.len() as f64;
        Some([mean, first, last, *sorted.get(rank - 1)?])
    }
}

/// Returns all steps of a job, nested ones after the step that has them.
pub fn all<'j>(steps: &'j [Step], found: &mut Vec<&'j Step>) {
    for step in steps {
        found.push(step);
        if let Act::Repeat { steps, .. } = &step.act {
            all(steps, found);
        }
    }
}

/// Prints the report.
pub fn print(job: &Job, steps: &[Times], cycles: &Times) {
    let mut table = Table::new(&["~STEP", ">LINE", ">COUNT", ">MEAN s", ">?MIN s", ">?MAX s", ">?P95 s"]);
    if cycles.count() == 0 && steps.iter().all(|times| times.count() == 0) {
        return;
    }
    let mut row = |name: &str, line: String, times: &Times| {
        if let Some(figures) = times.figures() {
            let mut cells = vec![name.to_owned(), line, times.count().to_string()];
            cells.extend(figures.map(|seconds| fixed(seconds, 3)));
            table.row(cells);
        }
    };
    for (step, times) in listed(job, steps) {
        row(&step.text, step.line.to_string(), times);
    }
    row("cycle", String::new(), cycles);
    table.print();
}

/// Returns the report as JSON: `steps` and `cycle`.
pub fn to_json(job: &Job, steps: &[Times], cycles: &Times) -> Value {
    let of = |times: &Times| {
        let [mean, min, max, p95] = times.figures().map_or([None; 4], |figures| figures.map(Some));
        json!({"count": times.count(), "mean": mean, "min": min, "max": max, "p95": p95})
    };
    let named = |(step, times): (&Step, &Times)| {
        let mut row = of(times);
        (row["step"], row["line"]) = (json!(step.text), json!(step.line));
        row
    };
    json!({"steps": listed(job, steps).into_iter().map(named).collect::<Vec<_>>(), "cycle": of(cycles)})
}

fn listed<'j>(job: &'j Job, times: &'j [Times]) -> Vec<(&'j Step, &'j Times)> {
    let mut steps = Vec::new();
    all(&job.steps, &mut steps);
    all(&job.on_fault, &mut steps);
    steps.into_iter().filter_map(|step| Some((step, times.get(step.id)?))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_are_those_of_the_nearest_rank() {
        let mut times = Times::default();
        assert_eq!(times.figures(), None);
        (1..=20).rev().for_each(|k| times.add(f64::from(k)));
        assert_eq!(times.figures(), Some([10.5, 1.0, 20.0, 19.0]));
        (0..KEPT).for_each(|_| times.add(2.0));
        assert_eq!((times.figures(), times.count()), (Some([2.0; 4]), 100_020));
    }
}
