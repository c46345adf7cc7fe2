//! The text formats of metrics: OpenMetrics 1.0 and, for clients that want it, that of Prometheus. Written
//! here because a library's histogram has a sum, which the run does not measure.

use std::fmt::{Display, Write};

/// A text format.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Form {
    /// OpenMetrics 1.0.
    OpenMetrics,
    /// The text format of Prometheus, 0.0.4.
    Prometheus,
}

impl Form {
    /// Returns the format for an `Accept` header: OpenMetrics, unless only plain text is accepted.
    pub fn accepted(header: Option<&str>) -> Self {
        let takes = |kind: &str| header.is_some_and(|header| header.contains(kind));
        match takes("text/plain") && !takes("application/openmetrics-text") {
            true => Self::Prometheus,
            false => Self::OpenMetrics,
        }
    }

    /// Returns its content type.
    pub fn content_type(self) -> &'static str {
        match self {
            Self::OpenMetrics => "application/openmetrics-text; version=1.0.0; charset=utf-8",
            Self::Prometheus => "text/plain; version=0.0.4; charset=utf-8",
        }
    }
}

/// Kind of a metric.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// A number that only increases.
    Counter,
    /// A value.
    Gauge,
    /// Counts of values up to limits.
    Histogram,
    /// Text in labels; the value is 1.
    Info,
    /// One of several states; its label has the name of the metric.
    StateSet,
}

/// Units that a name may end in.
const UNITS: [&str; 4] = ["seconds", "bytes", "hertz", "ratio"];

/// A text under construction: metrics, each with its samples. A metric without samples is left out.
#[derive(Debug)]
pub struct Text {
    form: Form,
    out: String,
    /// Name and kind of the current metric.
    metric: (&'static str, Kind),
    /// Its first lines, until it has a sample.
    head: String,
}

impl Text {
    /// Begins a text.
    pub fn new(form: Form) -> Self {
        Self { form, out: String::new(), metric: ("", Kind::Gauge), head: String::new() }
    }

    /// Begins a metric. `name` is without the suffix of its kind, and ends in its unit; `help` is a sentence.
    pub fn metric(&mut self, name: &'static str, kind: Kind, help: &str) -> &mut Self {
        self.metric = (name, kind);
        let open = self.form == Form::OpenMetrics;
        let (suffix, kind) = match kind {
            Kind::Counter if open => ("", "counter"),
            Kind::Counter => ("_total", "counter"),
            Kind::Gauge => ("", "gauge"),
            Kind::Histogram => ("", "histogram"),
            Kind::Info if open => ("", "info"),
            Kind::Info => ("_info", "gauge"),
            Kind::StateSet if open => ("", "stateset"),
            Kind::StateSet => ("", "gauge"),
        };
        self.head = format!("# HELP {name}{suffix} {help}\n# TYPE {name}{suffix} {kind}\n");
        let unit = name.rsplit('_').next().filter(|unit| open && UNITS.contains(unit));
        self.head.extend(unit.map(|unit| format!("# UNIT {name} {unit}\n")));
        self
    }

    /// Adds a sample with its labels.
    pub fn sample(&mut self, labels: &[(&str, &str)], value: impl Display) -> &mut Self {
        let suffix = match self.metric.1 {
            Kind::Counter => "_total",
            Kind::Info => "_info",
            Kind::Histogram => "_bucket",
            Kind::Gauge | Kind::StateSet => "",
        };
        self.out.push_str(&std::mem::take(&mut self.head));
        let labels: Vec<String> = labels.iter().map(|(name, value)| format!("{name}=\"{}\"", escaped(value))).collect();
        let labels = if labels.is_empty() { String::new() } else { format!("{{{}}}", labels.join(",")) };
        // Writing to a String does not fail.
        let _ = writeln!(self.out, "{}{suffix}{labels} {value}", self.metric.0);
        self
    }

    /// Adds a sample if its value is known.
    pub fn known(&mut self, labels: &[(&str, &str)], value: Option<impl Display>) -> &mut Self {
        match value {
            Some(value) => self.sample(labels, value),
            None => self,
        }
    }

    /// Adds the states of a state set.
    pub fn states<'a>(&mut self, labels: &[(&str, &str)], all: impl IntoIterator<Item = &'a str>, now: &str) {
        for state in all {
            let labels: Vec<_> = labels.iter().copied().chain([(self.metric.0, state)]).collect();
            self.sample(&labels, u8::from(state == now));
        }
    }

    /// Adds the buckets of a histogram: how many durations do not exceed this one [ns], and the number of all.
    pub fn durations(&mut self, (below, all): &(Vec<(u64, u64)>, u64)) {
        for (ns, count) in below {
            self.sample(&[("le", &(*ns as f64 / 1e9).to_string())], count);
        }
        self.sample(&[("le", "+Inf")], all);
    }

    /// Returns the text.
    pub fn end(mut self) -> String {
        if self.form == Form::OpenMetrics {
            self.out.push_str("# EOF\n");
        }
        self.out
    }
}

/// Escapes the value of a label.
fn escaped(value: &str) -> String {
    value.replace('\\', "\\\\").replace('"', "\\\"").replace('\n', "\\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_has_no_sample_is_left_out_and_labels_are_escaped() {
        let mut text = Text::new(Form::OpenMetrics);
        text.metric("a_bytes", Kind::Gauge, "Size.").known(&[], None::<u64>);
        text.metric("b_seconds", Kind::Counter, "Time.").sample(&[("by", "a \\ \"b\"\nc")], 0.25);
        text.metric("c", Kind::StateSet, "State.").states(&[], ["up", "down"], "up");
        let wanted = "# HELP b_seconds Time.\n# TYPE b_seconds counter\n# UNIT b_seconds seconds\n\
            b_seconds_total{by=\"a \\\\ \\\"b\\\"\\nc\"} 0.25\n# HELP c State.\n# TYPE c stateset\nc{c=\"up\"} 1\n\
            c{c=\"down\"} 0\n# EOF\n";
        assert_eq!(text.end(), wanted);
    }

    #[test]
    fn plain_text_is_for_those_who_take_nothing_else() {
        let prometheus = "application/openmetrics-text;version=1.0.0,text/plain;version=0.0.4;q=0.5,*/*;q=0.1";
        for (header, form) in [
            (None, Form::OpenMetrics),
            (Some("*/*"), Form::OpenMetrics),
            (Some(prometheus), Form::OpenMetrics),
            (Some("text/plain"), Form::Prometheus),
        ] {
            assert_eq!(Form::accepted(header), form, "{header:?}");
        }
    }
}
