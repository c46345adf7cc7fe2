//! A frame of `dimos top`: lines for a terminal of any size, or an object.

use std::time::Instant;

use serde_json::{Value, json};

use super::board::{Reading, Seen};
use crate::cli::jog::terminal::{Line, Look};
use crate::cli::output::{fixed, folded, number, span};
use crate::cli::speed::describe;
use crate::cli::status::trouble;
use dimos_core::telemetry::texts::percent;
use dimos_rpc::api::SpeedReport;
use dimos_rpc::report::{ArmReport, MotionReport};

/// Age at which a reading is highlighted [s].
const STALE_AFTER: f64 = 1.0;
/// Age of an arm's state at which it is highlighted [ms].
const STATE_STALE_AFTER: f64 = 200.0;
/// Columns of a joint position.
const JOINT: usize = 9;

/// Returns the lines of a frame; without the joints if there are too few rows.
pub fn lines(runs: &[Seen], columns: usize, rows: usize) -> Vec<Line> {
    let all = with(runs, columns, true);
    let mut shown = if all.len() > rows { with(runs, columns, false) } else { all };
    if shown.len() > rows {
        let hidden = shown.len() - rows.saturating_sub(1);
        shown.truncate(rows.saturating_sub(1));
        shown.push(Line::default().with(format!("… {hidden} more lines"), Look::Warning));
    }
    shown
}

fn with(runs: &[Seen], columns: usize, joints: bool) -> Vec<Line> {
    let live = runs.iter().filter(|seen| seen.ended.is_none()).count();
    let count = match live {
        0 => "no live run; to start one: dimos run coordinator-yourarm".to_owned(),
        1 => "1 live run".to_owned(),
        more => format!("{more} live runs"),
    };
    let mut lines = vec![Line::default().with("dimos top", Look::Bold).and(format!("  {count}  (q ends)"))];
    for seen in runs {
        lines.push(Line::default());
        of_run(seen, columns, joints, &mut lines);
    }
    lines
}

fn of_run(seen: &Seen, columns: usize, joints: bool, lines: &mut Vec<Line>) {
    let name = Line::default().with(format!("run {}", seen.run.name), Look::Bold);
    let mut say = |text: String, look: Look| fold(&text, look, columns, lines);
    if let Some((since, how)) = &seen.ended {
        say(format!("run {}  GONE for {}: {how}", seen.run.name, span(since.elapsed().as_secs_f64())), Look::Bad);
        return;
    }
    let Some(reading) = &seen.reading else {
        match &seen.trouble {
            Some(why) => say(format!("run {}  NOT READ: {why}", seen.run.name), Look::Bad),
            None => lines.push(name.and("  waiting for its status")),
        }
        return;
    };
    let (status, age) = (&reading.status, reading.at.elapsed().as_secs_f64());
    let about = format!("  {}  pid {}, up {}, ", status.standing(), status.pid, span(status.uptime));
    let look = if age > STALE_AFTER { Look::Bad } else { Look::Plain };
    lines.push(name.and(about).with(format!("read {age:.1} s ago"), look));
    let mut say = |text: String, look: Look| fold(&text, look, columns, lines);
    if let Some(why) = &seen.trouble {
        say(format!("  ! it is not read: {why}"), Look::Bad);
    }
    let (late, ticks) = (&status.ticks.lateness_us, &status.ticks);
    let timing = format!("late p99 {:.0} µs, max {:.0} µs, {} overruns", late.p99, late.max, ticks.overruns);
    say(format!("  tick {} Hz, {timing}", status.tick_rate), Look::Plain);
    let slowed = status.speed != SpeedReport::default();
    say(format!("  {}", describe(&status.speed)), if slowed { Look::Warning } else { Look::Plain });
    say(format!("  log {}", status.log.as_deref().unwrap_or("none")), Look::Plain);
    arms(reading, columns, joints, lines);
    for motion in &reading.motions {
        fold(&describe_motion(motion), Look::Plain, columns, lines);
    }
    for text in trouble(status) {
        fold(&format!("  ! {text}"), Look::Bad, columns, lines);
    }
}

/// Adds a text in as many lines as it needs.
fn fold(text: &str, look: Look, columns: usize, lines: &mut Vec<Line>) {
    let width = u16::try_from(columns).unwrap_or(u16::MAX);
    lines.extend(folded(text, Some(width)).into_iter().map(|line| Line::default().with(line, look)));
}

fn arms(reading: &Reading, columns: usize, joints: bool, lines: &mut Vec<Line>) {
    let arms = &reading.status.arms;
    let width = |heading: &str, of: fn(&ArmReport) -> &String| {
        arms.iter().map(|arm| of(arm).chars().count()).max().unwrap_or(0).max(heading.len())
    };
    let (names, phases, links) =
        (width("ARM", |arm| &arm.hardware_id), width("PHASE", |arm| &arm.phase), width("LINK", |arm| &arm.link));
    let heading =
        format!("  {:<names$}  {:<phases$}  {:<links$}  AGE ms  RATE Hz  COMMANDED BY", "ARM", "PHASE", "LINK");
    lines.push(Line::default().with(heading, Look::Dim));
    for arm in arms {
        let good = |well: bool| if well { Look::Good } else { Look::Bad };
        let phase = match arm.phase.as_str() {
            "ready" => Look::Good,
            "held" => Look::Bad,
            _ => Look::Warning,
        };
        let fresh = arm.state_age_ms.is_some_and(|age| age <= STATE_STALE_AFTER);
        let line = Line::default().and(format!("  {:<names$}  ", arm.hardware_id));
        let line = line.with(format!("{:<phases$}  ", arm.phase), phase);
        let line = line.with(format!("{:<links$}  ", arm.link), good(arm.link == "up"));
        let age = format!("{:>6}  ", number(arm.state_age_ms, 1));
        let line = line.with(age, if fresh { Look::Plain } else { Look::Bad });
        let by = arm.commander.as_ref().map_or_else(
            || "-".to_owned(),
            |by| match by.pid {
                Some(pid) => format!("{} (pid {pid})", by.program),
                None => by.program.clone(),
            },
        );
        lines.push(line.and(format!("{:>7}  {by}", number(arm.measured_rate_hz, 1))));
        if joints {
            positions(reading, arm, columns, lines);
        }
    }
}

/// Adds the joint positions of an arm, as many in a line as it has room for.
fn positions(reading: &Reading, arm: &ArmReport, columns: usize, lines: &mut Vec<Line>) {
    let Some(state) = reading.state.arms.iter().find(|state| state.hardware_id == arm.hardware_id) else { return };
    let texts: Vec<String> =
        state.joints.iter().map(|joint| format!("{:>JOINT$}", number(joint.position, 4))).collect();
    let fitting = (columns.saturating_sub("    rad".len()) / JOINT).max(1);
    for (row, part) in texts.chunks(fitting).enumerate() {
        let label = if row == 0 { "rad" } else { "   " };
        lines.push(Line::default().and(format!("    {label}{}", part.concat())));
    }
}

fn describe_motion(motion: &MotionReport) -> String {
    let by = motion.by.as_ref().map_or_else(String::new, |by| format!(", by {by}"));
    let (task, done) = (&motion.task, percent((motion.progress * 100.0).round() / 100.0));
    format!(
        "  motion {} of {task}: {} {done}, {} s left{by}",
        motion.motion,
        motion.state,
        fixed(motion.remaining.max(0.0), 1)
    )
}

/// Returns a frame as an object. `age` is the time since the reading [s].
pub fn to_json(runs: &[Seen]) -> Value {
    let run = |seen: &Seen| {
        let reading = seen.reading.as_ref();
        let state = match (&seen.ended, &seen.trouble, reading) {
            (Some(_), ..) => "gone",
            (None, Some(_), _) | (None, None, None) => "no_reply",
            (None, None, Some(_)) => "live",
        };
        let age = |at: Instant| at.elapsed().as_secs_f64();
        json!({
            "run": seen.run.name,
            "pid": reading.map_or(seen.run.pid, |reading| reading.status.pid),
            "state": state,
            "age": reading.map(|reading| age(reading.at)),
            "error": seen.trouble,
            "end": seen.ended.as_ref().map(|(_, how)| how),
            "status": reading.map(|reading| &reading.status),
            "arms": reading.map(|reading| &reading.state.arms),
            "motions": reading.map(|reading| &reading.motions),
        })
    };
    json!({"runs": runs.iter().map(run).collect::<Vec<_>>()})
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_rpc::report::{ArmStateReport, CauseReport, JointReport, StateReport, StatusReport};
    use dimos_rpc::run_dir::LiveRun;

    fn seen(arms: usize) -> Seen {
        let cause = CauseReport { name: "operator_stop".into(), text: "stopped by an operator".into(), by: None };
        let arm = |number: usize| ArmReport {
            hardware_id: format!("a_rather_long_arm_{number}"),
            phase: "held".into(),
            link: "up".into(),
            cause: Some(cause.clone()),
            ..ArmReport::default()
        };
        let joint = JointReport { position: Some(-1.23456), ..JointReport::default() };
        let state = |arm: &ArmReport| ArmStateReport {
            hardware_id: arm.hardware_id.clone(),
            joints: vec![joint.clone(); 16],
            ..ArmStateReport::default()
        };
        let arms: Vec<ArmReport> = (0..arms).map(arm).collect();
        let state = StateReport { arms: arms.iter().map(state).collect(), ..StateReport::default() };
        let log = Some(format!("/home/user/.local/state/dimos/{}.mcap", "cell".repeat(12)));
        let status = StatusReport { run: "cell".into(), arms, log, simulated: true, ..StatusReport::default() };
        let run = LiveRun { name: "cell".into(), pid: 42, socket: "/run/cell.sock".into(), at: None };
        let reading = Reading { status, state, motions: Vec::new(), at: Instant::now() };
        Seen { run, reading: Some(reading), trouble: None, ended: None }
    }

    #[test]
    fn it_fits_in_80_columns_and_any_rows_and_shows_what_holds_an_arm() {
        let runs = [seen(2)];
        let all = lines(&runs, 80, usize::MAX);
        let is_path = |line: &str| line.trim_start().starts_with('/');
        assert!(all.iter().map(Line::text).all(|line| is_path(&line) || line.chars().count() <= 80), "{all:#?}");
        let text: String = all.iter().map(|line| line.text() + "\n").collect();
        for part in ["SIMULATED", "-1.2346", "held: stopped by an operator", "dimos arm reset a_rather_long_arm_0"] {
            assert!(text.contains(part), "no {part:?} in\n{text}");
        }
        let least = with(&runs, 80, false).len();
        assert!(least < all.len(), "without joints there are fewer");
        for rows in [1, 8, least - 1, least, all.len(), 60] {
            let shown = lines(&runs, 80, rows);
            assert!(shown.len() <= rows, "{rows}: {shown:#?}");
            assert_eq!(shown.last().unwrap().text().contains("more lines"), rows < least, "{rows}: {shown:#?}");
        }
    }
}
