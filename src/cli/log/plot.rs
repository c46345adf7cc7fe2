//! `dimos log plot`: measured and commanded positions of joints, as an SVG drawing.

use std::fmt::Write;
use std::path::Path;

use serde_json::json;

use super::export::each;
use super::{Part, ended, no_states, progress, unreadable};
use crate::cli::exit::{Exit, Failure, Result};
use crate::cli::output;
use crate::replay::recorded::Recorded;
use dimos_core::arm::GripperUnit;
use dimos_log::replay::{LogReader, Payload, Selection};

/// Width of the drawing, and of the plot in it [px].
const WIDTH: f64 = 960.0;
const PLOT: f64 = 860.0;
/// Height of a joint's panel, and of the plot in it [px].
const PANEL: f64 = 260.0;
const HEIGHT: f64 = 190.0;
/// Where the plot begins in its panel [px].
const LEFT: f64 = 80.0;
const TOP: f64 = 50.0;
/// Colours of the measured and the commanded positions, and of limits.
const COLOURS: [&str; 3] = ["#1f77b4", "#ff7f0e", "#d62728"];

/// Values of a joint over time: [s], [rad].
type Curve = Vec<(f64, f64)>;

/// Draws joints of a log.
pub fn run(path: &Path, part: &Part, joints: &[String], to: &Path, json: bool) -> Result {
    if to.extension().is_some_and(|extension| !extension.eq_ignore_ascii_case("svg")) {
        let svg = to.with_extension("svg");
        let what = format!("{}: the drawing is SVG, not another format", to.display());
        return Err(Failure::usage(what).hint(format!("-o {}; browsers open and convert it", svg.display())));
    }
    let (from, until) = part.of(path)?;
    let began = from.saturating_sub(part.from.as_nanos() as u64);
    let mut log = LogReader::open(path).map_err(unreadable)?;
    let (mut names, mut curves) = (Vec::<String>::new(), Vec::<[Curve; 2]>::new());
    let topics = vec!["/joint_states".to_owned(), "/joint_commands".to_owned()];
    let loss = each(&mut log, Selection { topics, from, to: until }, progress::bar(false), |entry| {
        let Payload::JointState(values) = entry.data else { return Ok(true) };
        let time = entry.log_time.saturating_sub(began) as f64 * 1e-9;
        let kind = usize::from(entry.topic == "/joint_commands");
        for (name, value) in values.name.into_iter().zip(values.position).filter(|(_, value)| value.is_finite()) {
            let index = names.iter().position(|known| *known == name).unwrap_or_else(|| {
                names.push(name);
                curves.push(Default::default());
                names.len() - 1
            });
            if let Some(curves) = curves.get_mut(index) {
                curves[kind].push((time, value));
            }
        }
        Ok(true)
    })?;
    if names.is_empty() && loss.is_none() {
        return Err(no_states(path, log.info()));
    }
    if let Some(unknown) = joints.iter().find(|joint| !names.contains(joint)) {
        let what = format!("the log has no position of a joint {unknown}");
        return Err(Failure::usage(what).hint(format!("joints: {}", names.join(", "))));
    }
    let recorded = Recorded::open(path).ok();
    let span = (part.from.as_secs_f64(), until.saturating_sub(began) as f64 * 1e-9);
    let drawn: Vec<_> = names.iter().zip(&curves).filter(|(n, _)| joints.is_empty() || joints.contains(n)).collect();
    let mut svg = String::new();
    let (height, name) = (TOP - 10.0 + PANEL * drawn.len() as f64, path.file_name().unwrap_or_default().display());
    let _ = writeln!(
        svg,
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{WIDTH}\" height=\"{height}\" font-family=\"sans-serif\" \
         font-size=\"12\">\n<rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n<text x=\"{LEFT}\" y=\"16\" \
         fill=\"#666\">{}</text>",
        escaped(&name.to_string())
    );
    for (row, (name, curves)) in drawn.iter().enumerate() {
        let limits = recorded.as_ref().and_then(|recorded| limits(recorded, name));
        let unit = match (limits, recorded.as_ref().and_then(|recorded| gripper_unit(recorded, name))) {
            (Some(_), _) => "rad",
            (None, Some(unit)) => unit.name(),
            (None, None) => "m or rad",
        };
        panel(&mut svg, TOP + PANEL * row as f64, (name, unit), curves, limits, span);
    }
    svg.push_str("</svg>\n");
    std::fs::write(to, svg).map_err(|e| Failure::new(Exit::Failed, format!("cannot write {}: {e}", to.display())))?;
    let count = drawn.len();
    output::done(
        format_args!("{count} {}: {}", if count == 1 { "joint" } else { "joints" }, to.display()),
        json!({"file": to, "joints": count, "loss": loss}),
        json,
    );
    Ok(ended(loss.as_deref()))
}

/// Returns the position limits of a joint [rad]; `None` for a gripper.
fn limits(recorded: &Recorded, name: &str) -> Option<[f64; 2]> {
    recorded.names.arms.iter().zip(&recorded.config.arms).find_map(|(arm, config)| {
        let joint = arm.joints.iter().position(|joint| joint == name)?;
        let (lower, upper) = (&config.limits.position_lower, &config.limits.position_upper);
        Some([*lower.get(joint)?, *upper.get(joint)?])
    })
}

/// Returns the unit of an arm's gripper by the name of its positions.
fn gripper_unit(recorded: &Recorded, name: &str) -> Option<GripperUnit> {
    let arm = name.strip_suffix("_gripper")?;
    recorded.config.arms.iter().find(|config| config.name == arm).map(|config| config.gripper_info.unit)
}

/// Draws a joint: axes, limits, curves.
fn panel(
    svg: &mut String,
    y: f64,
    (name, unit): (&str, &str),
    curves: &[Curve; 2],
    limits: Option<[f64; 2]>,
    span: (f64, f64),
) {
    let values = || curves.iter().flatten().map(|(_, value)| *value);
    let (lower, upper) = (values().fold(f64::MAX, f64::min), values().fold(f64::MIN, f64::max));
    // A joint at rest is a line, not noise.
    let margin = ((upper - lower) * 0.1).max(0.005);
    let (lower, upper) = (lower - margin, upper + margin);
    let length = (span.1 - span.0).max(1e-3);
    let at_x = |t: f64| LEFT + (t - span.0) / length * PLOT;
    let at_y = |v: f64| y + HEIGHT - (v - lower) / (upper - lower) * HEIGHT;
    let (bottom, right) = (y + HEIGHT, LEFT + PLOT);
    for value in ticks(lower, upper) {
        let (at, label) = (at_y(value), text(value, upper - lower));
        let _ = writeln!(
            svg,
            "<path d=\"M{LEFT} {at:.1}H{right}\" stroke=\"#ddd\"/><text x=\"{:.1}\" y=\"{:.1}\" \
             text-anchor=\"end\">{label}</text>",
            LEFT - 6.0,
            at + 4.0
        );
    }
    for time in ticks(span.0, span.1) {
        let (at, label) = (at_x(time), text(time, length));
        let _ = writeln!(
            svg,
            "<path d=\"M{at:.1} {y}V{bottom}\" stroke=\"#ddd\"/><text x=\"{at:.1}\" y=\"{:.1}\" \
             text-anchor=\"middle\">{label}</text>",
            bottom + 16.0
        );
    }
    let _ = writeln!(
        svg,
        "<rect x=\"{LEFT}\" y=\"{y}\" width=\"{PLOT}\" height=\"{HEIGHT}\" fill=\"none\" stroke=\"#666\"/>"
    );
    for limit in limits.into_iter().flatten().filter(|limit| (lower..=upper).contains(limit)) {
        let (at, colour) = (at_y(limit), COLOURS[2]);
        let _ = writeln!(svg, "<path d=\"M{LEFT} {at:.1}H{right}\" stroke=\"{colour}\" stroke-dasharray=\"6 3\"/>");
    }
    // The command is wider, and below: where both are the same it is still seen.
    for ((curve, colour), width) in curves.iter().zip(COLOURS).zip([1.2, 3.0]).rev() {
        let mut points = String::new();
        for (time, value) in thinned(curve, span) {
            let _ = write!(points, "{:.1},{:.1} ", at_x(time), at_y(value));
        }
        let _ =
            writeln!(svg, "<polyline points=\"{points}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"{width}\"/>");
    }
    let (name, title) = (escaped(name), if curves[1].is_empty() { "" } else { "commanded" });
    let range = limits.map_or_else(String::new, |[lower, upper]| format!("limits {lower:.3} to {upper:.3} rad"));
    let [measured, commanded, limit] = COLOURS;
    let _ = writeln!(
        svg,
        "<text x=\"{LEFT}\" y=\"{0:.1}\"><tspan font-weight=\"bold\">{name}</tspan> position [{unit}]  \
         <tspan fill=\"{measured}\">measured</tspan>  <tspan fill=\"{commanded}\">{title}</tspan>  \
         <tspan fill=\"{limit}\">{range}</tspan></text><text x=\"{right}\" y=\"{1:.1}\" text-anchor=\"end\">time [s]</text>",
        y - 4.0,
        bottom + 32.0
    );
}

/// Returns the lowest and highest value of each pixel, of a curve with more points than that.
fn thinned(curve: &Curve, (from, to): (f64, f64)) -> Curve {
    if curve.len() < 4 * PLOT as usize {
        return curve.clone();
    }
    let column = |time: f64| ((time - from) / (to - from) * PLOT) as i64;
    let mut thin = Curve::new();
    for part in curve.chunk_by(|a, b| column(a.0) == column(b.0)) {
        let by = |a: &&(f64, f64), b: &&(f64, f64)| a.1.total_cmp(&b.1);
        let (Some(low), Some(high)) = (part.iter().min_by(by), part.iter().max_by(by)) else { continue };
        let (first, second) = if low.0 <= high.0 { (low, high) } else { (high, low) };
        thin.extend([*first, *second]);
    }
    thin
}

/// Returns round values between two.
fn ticks(from: f64, to: f64) -> Vec<f64> {
    let raw = (to - from).max(1e-9) / 6.0;
    let decade = 10f64.powf(raw.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].map(|n| n * decade).into_iter().find(|step| *step >= raw).unwrap_or(raw);
    let first = (from / step).ceil() as i64;
    (first..=(to / step).floor() as i64).map(|n| n as f64 * step).collect()
}

/// Formats a value on an axis of this range.
fn text(value: f64, range: f64) -> String {
    output::fixed(value, (1.0 - range.max(1e-9).log10().floor()).clamp(0.0, 6.0) as usize)
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axes_have_round_values_inside_their_range() {
        assert_eq!(ticks(0.0, 10.0), [0.0, 2.0, 4.0, 6.0, 8.0, 10.0]);
        let fine = ticks(0.31, 0.36).into_iter().map(|v| text(v, 0.05)).collect::<Vec<_>>();
        assert_eq!(fine, ["0.310", "0.320", "0.330", "0.340", "0.350", "0.360"]);
    }

    #[test]
    fn a_spike_of_a_long_curve_is_still_drawn() {
        let mut curve: Curve = (0..100_000).map(|i| (f64::from(i) * 1e-3, 0.0)).collect();
        curve[54_321].1 = 9.0;
        let thin = thinned(&curve, (0.0, 100.0));
        assert!(thin.len() < 2000 && thin.contains(&curve[54_321]), "{}", thin.len());
    }
}
