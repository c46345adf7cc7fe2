//! Repeated figures, their goals, and their table.

use super::{empty, figures};

/// Goal of a figure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Goal {
    /// This or less.
    AtMost(f64),
    /// This or more.
    AtLeast(f64),
}

/// One figure, measured several times.
#[derive(Debug, Clone)]
pub struct Measure {
    what: String,
    unit: &'static str,
    repeats: Vec<f64>,
    goal: Option<Goal>,
}

impl Measure {
    /// Creates a figure from its name, unit, and repeats.
    pub fn new(what: impl Into<String>, unit: &'static str, repeats: Vec<f64>) -> Self {
        Self { what: what.into(), unit, repeats, goal: None }
    }

    /// Adds a goal for its median.
    pub fn goal(mut self, goal: Goal) -> Self {
        self.goal = Some(goal);
        self
    }

    fn row(&self) -> [String; 8] {
        let at = |q| figure(quantile(&self.repeats, q));
        let (goal, verdict) = match self.goal {
            None => (String::new(), ""),
            Some(Goal::AtMost(most)) => (format!("≤ {}", figure(most)), verdict(self.median() <= most)),
            Some(Goal::AtLeast(least)) => (format!("≥ {}", figure(least)), verdict(self.median() >= least)),
        };
        let n = self.repeats.len().to_string();
        [self.what.clone(), at(0.5), at(0.95), at(0.99), self.unit.into(), n, goal, verdict.into()]
    }

    fn median(&self) -> f64 {
        quantile(&self.repeats, 0.5)
    }
}

/// Returns the word for a goal that is met or missed.
pub fn verdict(met: bool) -> &'static str {
    if met { "met" } else { "missed" }
}

/// Returns the value that a part `q` of the values does not exceed; NaN without values.
pub fn quantile(values: &[f64], q: f64) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let rank = ((sorted.len() as f64 * q).ceil() as usize).clamp(1, sorted.len().max(1));
    sorted.get(rank - 1).copied().unwrap_or(f64::NAN)
}

/// Prints figures with a title: median, p95 and p99 over the repeats, and the goal.
pub fn print(title: &str, measures: &[Measure]) {
    let without = |m: &&Measure| m.repeats.is_empty() || m.repeats.iter().any(|value| !value.is_finite());
    measures.iter().filter(without).for_each(|m| empty(&format!("{title}: {}", m.what)));
    let head = ["", "median", "p95", "p99", "", "n", "goal", ""].map(str::to_owned);
    let rows = std::iter::once(head).chain(measures.iter().map(Measure::row)).map(Vec::from).collect();
    print_rows(title, rows);
}

/// Prints rows with a title, aligned: the first column left, the others right.
pub fn print_rows(title: &str, rows: Vec<Vec<String>>) {
    println!("{title}");
    figures::keep(title, &rows);
    let columns = rows.iter().map(Vec::len).max().unwrap_or_default();
    let width = |c: usize| rows.iter().filter_map(|r| r.get(c)).map(|v| v.chars().count()).max().unwrap_or_default();
    let widths: Vec<usize> = (0..columns).map(width).collect();
    for row in &rows {
        let mut line = String::from(" ");
        for (c, (cell, &width)) in row.iter().zip(&widths).enumerate() {
            line += &if c == 0 { format!(" {cell:<width$}") } else { format!("  {cell:>width$}") };
        }
        println!("{}", line.trim_end());
    }
    println!();
}

/// Formats a figure with three significant digits.
pub fn figure(value: f64) -> String {
    match value.abs() {
        v if v >= 100.0 => format!("{value:.0}"),
        v if v >= 10.0 => format!("{value:.1}"),
        _ => format!("{value:.2}"),
    }
}
