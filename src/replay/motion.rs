//! The motion in a log: commanded joint positions per tick, otherwise measured ones.
//!
//! Time is control time: tick index times period, as for every trajectory. Where a joint is commanded by velocity or
//! not at all, its measured positions are averaged over ±0.1 s (which increases neither velocity nor acceleration), and
//! the step between measured and commanded positions is faded out over a second.

use std::path::Path;

use super::grips::{self, RecordedGrip};
use super::recorded::{Recorded, RecordedError};
use dimos_core::trajectory::smooth_step;
use dimos_log::joints::Places;
use dimos_log::messages::JointState;
use dimos_log::replay::{LogReader, Payload, ReplayError, Selection};

/// Measured positions are averaged over this time before and after [s].
const AVERAGING_TIME: f64 = 0.1;
/// The step between two sources is faded out over this time [s].
const FADE_TIME: f64 = 1.0;

/// Measured joints, commanded joints, ticks.
const TOPICS: [&str; 3] = ["/joint_states", "/joint_commands", "/dimos/tick"];
/// Maximum gap bridged by a straight line [s].
pub const MAX_GAP: f64 = 1.0;

/// Motion of a log's joints.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordedMotion {
    /// Joints with recorded positions.
    pub joints: Vec<String>,
    /// Time between two rows [s].
    pub period: f64,
    /// Positions [rad], one row per tick, one value per joint.
    pub rows: Vec<Vec<f64>>,
    /// Time of the last row [ns since 1970].
    pub last: u64,
    /// Ticks missing in the log; bridged by straight lines.
    pub lost: u64,
    /// Gripper commands during the motion, in order of time.
    pub grips: Vec<RecordedGrip>,
}

/// Joint values of a tick.
struct Row {
    tick: u64,
    time: u64,
    measured: Vec<f64>,
    commanded: Vec<f64>,
}

impl RecordedMotion {
    /// Reads the whole motion between two Unix times [ns]. If there are position commands, it begins and ends with
    /// the first and last of them.
    pub fn read(path: &Path, from: u64, to: u64) -> Result<Self, RecordedError> {
        let recorded = Recorded::open(path)?;
        let names = recorded.joints();
        let rows = rows(path, LogReader::open(path)?, &TOPICS, &names, (from, to))?;
        let is_commanded = |row: &Row| row.commanded.iter().any(|q| q.is_finite());
        let whole = (0, rows.len().saturating_sub(1));
        let first = rows.iter().position(is_commanded).unwrap_or(whole.0);
        let last = rows.iter().rposition(is_commanded).unwrap_or(whole.1);
        let rows = rows.get(first..=last).unwrap_or_default();
        let period = 1.0 / recorded.config.rate;
        let gap = |w: &[Row]| w[1].tick.saturating_sub(w[0].tick) as f64 * period > MAX_GAP + period;
        if let Some(w) = rows.windows(2).find(|w| gap(w)) {
            let what = format!("ticks {} to {} are missing: too long a gap to bridge", w[0].tick + 1, w[1].tick - 1);
            return Err(RecordedError::Unfit { path: path.to_owned(), what });
        }
        let ticks: u64 = rows.windows(2).map(|w| w[1].tick.saturating_sub(w[0].tick).saturating_sub(1)).sum();
        let columns: Vec<Option<Vec<f64>>> = (0..names.len()).map(|j| column(rows, j, period)).collect();
        let known = |j: &usize| columns[*j].is_some();
        let joints = (0..names.len()).filter(known).map(|j| names[j].clone()).collect();
        let columns: Vec<Vec<f64>> = columns.into_iter().flatten().collect();
        let at = |k: usize| columns.iter().map(|c| c[k]).collect();
        let length = columns.first().map_or(0, Vec::len);
        let ends = rows.first().zip(rows.last()).map(|(first, last)| first.tick..=last.tick);
        let arms: Vec<String> = recorded.names.arms.iter().map(|arm| arm.hardware_id.clone()).collect();
        let grips = ends.map(|ticks| grips::read(path, &arms, ticks, period, to)).transpose()?;
        let grips = grips.unwrap_or_default();
        let last = rows.last().map_or(0, |row| row.time);
        Ok(Self { joints, period, rows: (0..length).map(at).collect(), last, lost: ticks, grips })
    }
}

impl RecordedMotion {
    /// Reads the measured motion of these joints, averaged over ±0.1 s, between two Unix times [ns]: since the last gap
    /// in the log. Without those joints it has no rows.
    pub fn measured(path: &Path, joints: &[String], from: u64, to: u64) -> Result<Self, RecordedError> {
        // The log of a live run has no index: nothing before `from` is unpacked.
        let [measured, _, tick] = TOPICS;
        let log = LogReader::open_for(path, &[measured, tick])?;
        let recorded = Recorded::of(path, log.info().clone())?;
        let names = recorded.joints();
        let index = |joint: &String| names.iter().position(|name| name == joint);
        let columns: Vec<usize> = joints.iter().map(index).collect::<Option<_>>().unwrap_or_default();
        let rows = rows(path, log, &[measured, tick], &names, (from, to))?;
        let period = 1.0 / recorded.config.rate;
        let is_known = |row: &Row| columns.iter().all(|j| row.measured[*j].is_finite());
        let is_gap = |w: &[Row]| w[1].tick.saturating_sub(w[0].tick) as f64 * period > MAX_GAP + period;
        let begin = rows.windows(2).rposition(|w| is_gap(w) || !is_known(&w[0])).map_or(0, |k| k + 1);
        let rows = rows.get(begin..).filter(|rows| rows.iter().all(is_known)).unwrap_or_default();
        let width = (AVERAGING_TIME / period).round() as usize;
        let smooth: Vec<Vec<f64>> =
            columns.iter().map(|j| averaged(&bridged(rows, |row| row.measured[*j]), width)).collect();
        let at = |k: usize| smooth.iter().map(|column| column[k]).collect();
        let length = smooth.first().map_or(0, Vec::len);
        let last = rows.last().map_or(0, |row| row.time);
        Ok(Self {
            joints: joints.to_vec(),
            period,
            rows: (0..length).map(at).collect(),
            last,
            lost: 0,
            grips: Vec::new(),
        })
    }
}

/// Reads the positions of an arm's tool centre point [m] between two Unix times [ns], with their times. Empty if the
/// run has no model of the arm.
pub fn tcp_path(path: &Path, arm: &str, from: u64, to: u64) -> Result<Vec<(u64, [f64; 3])>, RecordedError> {
    let mut log = LogReader::open(path)?;
    log.select(Selection { topics: vec![format!("/tcp/{arm}")], from, to })?;
    let mut found = Vec::new();
    loop {
        match log.next_entry() {
            Ok(Some(entry)) => {
                if let Payload::PoseStamped(at) = &entry.data {
                    let p = &at.pose.position;
                    found.push((entry.log_time, [p.x, p.y, p.z]));
                }
            }
            Ok(None) => return Ok(found),
            Err(ReplayError::Cut { .. } | ReplayError::Damaged { .. }) => {}
            Err(e) => return Err(e.into()),
        }
    }
}

/// Reads the ticks of a part that lacks nothing, by the names of the joints.
fn rows(
    path: &Path,
    mut log: LogReader,
    topics: &[&str],
    joints: &[String],
    (from, to): (u64, u64),
) -> Result<Vec<Row>, RecordedError> {
    let topics = topics.iter().map(|topic| (*topic).to_owned()).collect();
    log.select(Selection { topics, from, to })?;
    let nothing = || vec![f64::NAN; joints.len()];
    let mut places = [Places::new(joints), Places::new(joints)];
    let mut positions = |m: &JointState, of: usize| places[of].pick(&m.name, &m.position).collect::<Vec<f64>>();
    let (mut measured, mut commanded) = (nothing(), nothing());
    let mut rows: Vec<Row> = Vec::new();
    loop {
        match log.next_entry() {
            Ok(Some(entry)) => match &entry.data {
                Payload::JointState(m) if entry.topic == TOPICS[0] => measured = positions(m, 0),
                Payload::JointState(m) => commanded = positions(m, 1),
                Payload::Tick(t) if rows.last().is_none_or(|row| t.tick > row.tick) => {
                    let now =
                        (std::mem::replace(&mut measured, nothing()), std::mem::replace(&mut commanded, nothing()));
                    rows.push(Row { tick: t.tick, time: entry.log_time, measured: now.0, commanded: now.1 });
                }
                _ => {}
            },
            Ok(None) => return RecordedError::unless_whole(path, &log).map(|()| rows),
            // It is in the loss.
            Err(ReplayError::Cut { .. } | ReplayError::Damaged { .. }) => {}
            Err(e) => return Err(e.into()),
        }
    }
}

/// Returns one joint's positions per tick without gaps; `None` if a tick lacks a position.
fn column(rows: &[Row], joint: usize, period: f64) -> Option<Vec<f64>> {
    let commanded = bridged(rows, |row| row.commanded[joint]);
    let measured = averaged(&bridged(rows, |row| row.measured[joint]), (AVERAGING_TIME / period).round() as usize);
    let steps = (FADE_TIME / period).max(1.0);
    let mut out: Vec<f64> = Vec::with_capacity(commanded.len());
    let (mut offset, mut age, mut by_command) = (0.0, 0.0, None);
    for (k, (c, m)) in commanded.iter().zip(&measured).enumerate() {
        let is_commanded = c.is_finite();
        let source = if is_commanded { c } else { m };
        if let (Some(last), true) = (out.last(), by_command.is_some_and(|before| before != is_commanded)) {
            // Measured positions are known ahead of time, so a moving joint keeps moving.
            let before = if is_commanded { *c } else { measured[k - 1] };
            (offset, age) = (last - before, 0.0);
        }
        by_command = Some(is_commanded);
        age += 1.0;
        let left = 1.0 - smooth_step(age / steps);
        let value = source + offset * left;
        if !value.is_finite() {
            return None;
        }
        out.push(value);
    }
    (!out.is_empty()).then_some(out)
}

/// Returns values per tick, interpolated at missing ticks.
fn bridged(rows: &[Row], value: impl Fn(&Row) -> f64) -> Vec<f64> {
    let mut out: Vec<f64> = Vec::with_capacity(rows.len());
    for pair in rows.windows(2) {
        let (a, b) = (value(&pair[0]), value(&pair[1]));
        let steps = pair[1].tick - pair[0].tick;
        out.push(a);
        out.extend((1..steps).map(|k| a + (b - a) * k as f64 / steps as f64));
    }
    out.extend(rows.last().map(value));
    out
}

/// Returns weighted averages with a triangular window.
fn averaged(values: &[f64], width: usize) -> Vec<f64> {
    let last = values.len().saturating_sub(1) as isize;
    let box_once = |values: &[f64], ahead: usize, behind: usize| -> Vec<f64> {
        let at = |k: isize| values[k.clamp(0, last) as usize];
        let mean = |k: isize| -> f64 {
            let sum: f64 = (k - behind as isize..=k + ahead as isize).map(at).sum();
            sum / (ahead + behind + 1) as f64
        };
        (0..values.len() as isize).map(mean).collect()
    };
    let once = box_once(values, width / 2, width / 2);
    box_once(&once, width / 2, width / 2)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(tick: u64, measured: f64, commanded: f64) -> Row {
        Row { tick, time: 0, measured: vec![measured], commanded: vec![commanded] }
    }

    #[test]
    fn commanded_positions_are_used_unchanged() {
        let rows: Vec<Row> = (0..50).map(|k| row(k, 7.0, 0.01 * (k as f64).sin())).collect();
        let c = column(&rows, 0, 0.01).unwrap();
        assert!(c.iter().zip(&rows).all(|(c, row)| *c == row.commanded[0]));
    }

    #[test]
    fn the_step_to_measured_positions_is_faded_out() {
        let command = |k: u64| if k < 50 { 0.5 } else { f64::NAN };
        let rows: Vec<Row> = (0..300).map(|k| row(k, 0.49, command(k))).collect();
        let c = column(&rows, 0, 0.01).unwrap();
        let steepest = c.windows(3).map(|w| (w[2] - 2.0 * w[1] + w[0]).abs() / 1e-4).fold(0.0, f64::max);
        assert!(steepest < 6.0 * 0.01, "{steepest}");
        assert!((c[0] - 0.5).abs() < 1e-12 && (c[299] - 0.49).abs() < 1e-12);
    }

    #[test]
    fn averaging_makes_nothing_steeper_and_takes_noise_away() {
        let noise = |k: usize| if k.is_multiple_of(2) { 1e-4 } else { -1e-4 };
        let smooth = averaged(&(0..200).map(|k| 0.001 * k as f64 + noise(k)).collect::<Vec<_>>(), 10);
        let inner = &smooth[12..188];
        assert!(inner.windows(2).all(|w| (w[1] - w[0] - 0.001).abs() < 1e-5));
    }

    #[test]
    fn missing_ticks_lie_on_a_straight_line_and_missing_positions_leave_the_joint_out() {
        let rows = [row(3, 0.0, 0.1), row(6, 0.0, 0.4)];
        let c = column(&rows, 0, 0.01).unwrap();
        assert!(c.iter().zip([0.1, 0.2, 0.3, 0.4]).all(|(a, b)| (a - b).abs() < 1e-12) && c.len() == 4);
        assert!(column(&[row(0, f64::NAN, 0.1), row(1, f64::NAN, f64::NAN)], 0, 0.01).is_none());
    }
}
