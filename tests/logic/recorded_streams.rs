//! Recorded arms, their targets as the stream and their measured joints as the readings, at the tick rates that they
//! allow: none is held, and no target is refused.

use std::path::Path;
use std::time::Duration;

use dimos::arm::{ArmState, Link, VelocitySource};
use dimos::clock::Mono;
use dimos::control::config::*;
use dimos::control::coordinator::{Coordinator, TickTime};
use dimos::control::request::{Envelope, Request};
use dimos::control::task_spec::TaskTable;
use dimos::joint::joints_of;
use dimos::telemetry::{Event, Outcome, Phase};

use crate::support::arm_rows::{Row, rows};
use crate::support::python::ask_python;
use crate::support::rig::task;
use crate::support::shared::shared;

/// Time over which a recording that begins in motion gets up to its speed [s].
const LEAD_IN: f64 = 0.5;

/// A recording: a period [s], targets and measured positions [rad].
struct Recording {
    period: f64,
    targets: Vec<Vec<f64>>,
    measured: Vec<Vec<f64>>,
}

impl Recording {
    /// It begins at rest: the arm with constant acceleration up to the speed of its first rows, its target from there
    /// to the first one.
    fn begun_at_rest(mut self) -> Self {
        let (q, next) = (self.measured[0].clone(), self.measured[1].clone());
        let count = (LEAD_IN / self.period).round() as usize;
        let whole = count as f64 * self.period;
        let lead = |k: usize| -> Vec<f64> {
            let t = k as f64 * self.period;
            let v = |j: usize| (next[j] - q[j]) / self.period;
            (0..q.len()).map(|j| q[j] - v(j) * whole / 2.0 + v(j) * t * t / (2.0 * whole)).collect()
        };
        let before: Vec<Vec<f64>> = (0..count).map(lead).collect();
        let ahead: Vec<f64> = self.targets[0].iter().zip(&q).map(|(to, q)| to - q).collect();
        let towards = |(k, row): (usize, &Vec<f64>)| -> Vec<f64> {
            row.iter().zip(&ahead).map(|(q, ahead)| q + ahead * k as f64 / count as f64).collect()
        };
        let targets: Vec<Vec<f64>> = before.iter().enumerate().map(towards).collect();
        self.targets.splice(0..0, targets);
        self.measured.splice(0..0, before);
        self
    }

    /// Between two rows, and constant outside of them.
    fn at(&self, rows: &[Vec<f64>], t: f64) -> Vec<f64> {
        let at = (t / self.period).clamp(0.0, rows.len() as f64 - 1.0);
        let (k, part) = (at as usize, at.fract());
        let next = &rows[(k + 1).min(rows.len() - 1)];
        rows[k].iter().zip(next).map(|(a, b)| a + part * (b - a)).collect()
    }
}

/// What held the arm or was refused, while the recording was played at a tick rate.
fn play(row: &Row, rate: f64, recording: &Recording) -> Vec<String> {
    let row = row.at(rate);
    let dof = row.arm.dof;
    let tasks = vec![task("s", TaskKind::new("servo", &ServoParams::default()), 0..dof as u16, 10)];
    let config = CoordinatorConfig { version: CONFIG_VERSION, rate, arms: vec![row.arm.clone()], tasks };
    let mut coordinator = Coordinator::new(&config, TaskTable::builtin().build(&config.tasks).unwrap());
    let period = Duration::from_secs_f64(1.0 / rate);
    let mode = row.arm.position_mode().unwrap_or_default();
    let (mut now, mut found, mut said, mut streamed) = (Mono::ZERO.after(Duration::from_secs(1)), Vec::new(), 0, 0);
    let (rest, whole) = (0.5, recording.targets.len() as f64 * recording.period);
    for tick in 0..((rest + whole + 0.2) * rate) as u64 {
        now = now.after(period);
        let t = tick as f64 / rate - rest;
        let [before, here] = [t - 1.0 / rate, t].map(|t| recording.at(&recording.measured, t));
        let velocity: Vec<f64> = before.iter().zip(&here).map(|(a, b)| (b - a) * rate).collect();
        let state = ArmState {
            seq: tick + 1,
            stamp: now.before(Duration::from_millis(1)),
            dof,
            position: joints_of(&here),
            velocity: joints_of(&velocity),
            velocity_source: VelocitySource::Measured,
            mode,
            enabled: true,
            link: Link::Up,
            written: said,
            ..ArmState::default()
        };
        let mut requests = Vec::new();
        if tick == 3 {
            requests.push(Request::Enabled { arm: 0, outside: false });
        }
        let due = (t / recording.period).floor() as i64;
        if t >= 0.0 && due >= streamed && (due as usize) < recording.targets.len() {
            streamed = due + 1;
            requests.push(Request::Servo { task: 0, target: joints_of(&recording.targets[due as usize]) });
        }
        let mut inbox = requests.into_iter().map(|request| Envelope { id: tick, origin: None, request });
        let time = TickTime { now, next: now.after(period), skipped: 0, late_ns: 0, woke_late_ns: 0 };
        let output = coordinator.tick(time, &[state], || inbox.next());
        said = output.commands[0].seq;
        for event in &output.events {
            if let Event::Request(_, outcome) = event
                && !matches!(outcome, Outcome::Accepted)
            {
                found.push(format!("{t:.3} s: {outcome:?}"));
            }
        }
        let (phase, cause) = (output.arms[0].phase, output.arms[0].cause);
        if tick > (0.4 * rate) as u64 && phase != Phase::Ready {
            found.push(format!("{t:.3} s: {phase:?}, {cause:?}, {:?}", output.tasks[0]));
            break;
        }
    }
    found
}

fn judge(name: &str, recordings: &[Recording]) {
    let row = rows().iter().find(|row| row.name == name).unwrap();
    for rate in row.rates() {
        for (k, recording) in recordings.iter().enumerate() {
            let found = play(row, rate, recording);
            assert!(found.is_empty(), "{name} at {rate} Hz, recording {k}: {found:#?}");
        }
    }
}

/// A LeRobot data set at 30 Hz: -100 and 100 are the ends of a joint's range.
#[test]
fn an_so101_is_streamed_to_as_it_was_recorded() {
    let Some(folder) = shared("recordings") else { return };
    let question = serde_json::json!({
        "file": folder.join("so101_lerobot.parquet"), "columns": ["action", "observation.state", "episode_index"],
    });
    let Some(answer) = ask_python("parquet_rows.py", "pyarrow", &question) else { return };
    let rows = |column: usize| -> Vec<Vec<f64>> { serde_json::from_value(answer[column].clone()).unwrap() };
    let episodes: Vec<u64> = serde_json::from_value(answer[2].clone()).unwrap();
    let l = &self::rows().iter().find(|row| row.name == "so101").unwrap().arm.limits;
    let angle = |j: usize, value: f64| {
        let (lower, upper) = (l.position_lower[j], l.position_upper[j]);
        0.5 * (lower + upper) + 0.005 * value * (upper - lower)
    };
    let of = |rows: &[Vec<f64>], episode: u64| -> Vec<Vec<f64>> {
        let own = rows.iter().zip(&episodes).filter(|(_, e)| **e == episode);
        own.map(|(row, _)| row[..5].iter().enumerate().map(|(j, value)| angle(j, *value)).collect()).collect()
    };
    let (targets, measured) = (rows(0), rows(1));
    // An episode begins in motion: a stream begins where the arm is near its target.
    let begin = |e: u64| -> Recording {
        let (targets, measured) = (of(&targets, e), of(&measured, e));
        let near = |(a, b): (&Vec<f64>, &Vec<f64>)| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 0.15);
        let first = targets.iter().zip(&measured).position(near).unwrap();
        Recording { period: 1.0 / 30.0, targets: targets[first..].to_vec(), measured: measured[first..].to_vec() }
    };
    let recordings: Vec<Recording> = (0..=*episodes.last().unwrap()).map(|e| begin(e).begun_at_rest()).collect();
    assert_eq!(recordings.len(), 4);
    judge("so101", &recordings);
}

#[test]
fn a_ur3e_is_streamed_to_as_it_was_recorded() {
    let Some(folder) = shared("recordings") else { return };
    judge("ur", &[ur3e(&folder).begun_at_rest()]);
}

fn ur3e(folder: &Path) -> Recording {
    let text = std::fs::read_to_string(folder.join("ur3e_rtde.csv")).unwrap();
    let mut lines = text.lines();
    let names: Vec<&str> = lines.next().unwrap().split(',').collect();
    let columns = |what: &str| -> Vec<usize> {
        (0..6).map(|j| names.iter().position(|n| *n == format!("{what}_q_{j}")).unwrap()).collect()
    };
    let (target, actual) = (columns("target"), columns("actual"));
    // Its wrist 3 turns without end; here it is two turns back.
    let row = |line: &str, columns: &[usize]| -> Vec<f64> {
        let all: Vec<f64> = line.split(',').map(|n| n.parse().unwrap_or(0.0)).collect();
        let turned = |(j, c): (usize, &usize)| all[*c] - if j == 5 { 2.0 * std::f64::consts::TAU } else { 0.0 };
        columns.iter().enumerate().map(turned).collect()
    };
    let lines: Vec<&str> = lines.collect();
    let rows = |columns: &[usize]| lines.iter().map(|line| row(line, columns)).collect();
    Recording { period: 0.04, targets: rows(&target), measured: rows(&actual) }
}
