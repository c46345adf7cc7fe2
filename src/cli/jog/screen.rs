//! The screen: lines of text from the arm's state and jog's. With less space, less is shown.

use std::time::Duration;

use super::keys::AXES;
use super::terminal::{Line, Look};
use super::watch::ArmSnapshot;
use crate::cli::output::fixed;
use dimos_rpc::api::gripper_text;
use dimos_rpc::report::{ArmReport, ArmStateReport, JointReport, TaskReport};

/// Age at which a state is highlighted.
const STALE_AFTER: Duration = Duration::from_millis(200);
/// Minimum width for joint bars.
const BAR_COLUMNS: usize = 60;
/// Minimum number of joint rows.
const MIN_JOINT_ROWS: usize = 1;

/// Contents of the screen.
pub struct View<'a> {
    /// Name of the run.
    pub run: &'a str,
    /// Name of the arm.
    pub arm: &'a str,
    /// Latest data of it.
    pub seen: &'a ArmSnapshot,
    /// Time since its state was received.
    pub since: Option<Duration>,
    /// Whether in joint mode.
    pub joint_mode: bool,
    /// Whether motions are along the axes of the tool frame.
    pub tool_frame: bool,
    /// Task of the stream; none in a mode without a task.
    pub task: Option<&'a str>,
    /// Name of the selected joint.
    pub joint: Option<&'a str>,
    /// Speed as text.
    pub speed: String,
    /// Motion as text; empty at rest.
    pub moving: String,
    /// Latest message, and whether it is an error.
    pub message: Option<(&'a str, bool)>,
    /// Whether the terminal reports key-ups.
    pub releases: bool,
}

/// Returns the screen's lines for this many columns and rows.
pub fn lines(view: &View<'_>, (columns, rows): (usize, usize)) -> Vec<Line> {
    let head = vec![title(view), condition(view.seen)];
    let pose = pose(view.seen.state.as_ref());
    let motion = motion(view);
    let help = help(view, columns);
    let message = message(view, columns);
    // Dropped first if space is short: blank lines, the pose, the keys but for those that end it.
    let fixed_rows = head.len() + 1 + motion.len() + message.len();
    let joints = view.seen.state.as_ref().map_or(1, |state| state.joints.len());
    let mut spare = rows.saturating_sub(fixed_rows + joints);
    let mut fits = |lines: Vec<Line>| {
        let room = lines.len();
        if room <= spare {
            spare -= room;
            lines
        } else {
            Vec::new()
        }
    };
    let mut help = fits(help);
    if help.is_empty() {
        help = fits(vec![Line::default().with("X stop, latched   Esc leave", Look::Dim)]);
    }
    let pose = fits(pose);
    let mut gaps = [(); 3].map(|()| fits(vec![Line::default()]));
    let [after_head, after_joints, after_motion] = &mut gaps;
    let others = fixed_rows + pose.len() + help.len() + after_head.len() + after_joints.len() + after_motion.len();
    let mut all = head;
    all.append(after_head);
    all.extend(joint_table(view, columns, rows.saturating_sub(others).max(MIN_JOINT_ROWS)));
    all.extend(pose);
    all.append(after_joints);
    all.extend(motion);
    all.append(after_motion);
    all.extend(help);
    all.extend(message);
    all
}

fn title(view: &View<'_>) -> Line {
    let simulated = if view.seen.arm.as_ref().is_some_and(|arm| arm.simulated) { "  SIMULATED" } else { "" };
    let line = Line::default().with(format!("jog {}", view.arm), Look::Bold);
    let line = line.and(format!("  run {}{simulated}  ", view.run));
    match (view.since, view.seen.state.as_ref().and_then(|state| state.age_ms)) {
        (Some(since), Some(age)) => {
            let age = since + Duration::from_secs_f64(age.clamp(0.0, 1e9) / 1e3);
            let look = if age > STALE_AFTER { Look::Bad } else { Look::Plain };
            line.with(format!("state {} ms old", age.as_millis()), look)
        }
        _ => line.with("no state yet", Look::Warning),
    }
}

/// Phase of the arm, and what prevents motion.
fn condition(seen: &ArmSnapshot) -> Line {
    let Some(arm) = &seen.arm else { return Line::default() };
    let good = |well: bool| if well { Look::Good } else { Look::Bad };
    let mut line = Line::default().with(arm.phase.clone(), good(arm.phase == "ready"));
    if let Some(cause) = &arm.cause {
        line = line.with(format!(": {}", cause.text), Look::Bad);
    }
    line = line.and("  link ").with(arm.link.clone(), good(arm.link == "up")).and(format!("  {}", arm.mode));
    if let Some(error) = &arm.error {
        line = line.with(format!("  device error {}: {}", error.code, error.text), Look::Bad);
    }
    match arm.faults.iter().rfind(|fault| !fault.over) {
        Some(fault) => line.with(format!("  fault: {}", fault.text), Look::Bad),
        None => line,
    }
}

/// The joints; if space is short, those around the selected one.
fn joint_table(view: &View<'_>, columns: usize, rows: usize) -> Vec<Line> {
    let Some(state) = &view.seen.state else { return vec![Line::default().and("waiting for the arm's state")] };
    let names = state.joints.iter().map(|joint| joint.name.chars().count()).max().unwrap_or(0);
    let names = names.min(columns.saturating_sub(24)).max(5);
    let bar = if columns >= BAR_COLUMNS { columns.saturating_sub(names + 46).min(40) } else { 0 };
    let range = if bar > 0 { "  within the limits [rad]" } else { "" };
    let heading = format!("   {:<names$} {:>9} {:>8}{range}", "JOINT", "rad", "deg");
    let chosen = state.joints.iter().position(|joint| view.joint_mode && Some(joint.name.as_str()) == view.joint);
    let first = chosen.unwrap_or(0).saturating_sub(rows / 2).min(state.joints.len().saturating_sub(rows));
    let shown = state.joints.iter().enumerate().skip(first).take(rows);
    let row = |(index, joint): (usize, &JointReport)| {
        let limits = view.seen.arm.as_ref().and_then(|arm| arm.position_limits.get(index)).copied();
        joint_row(index, joint, limits, chosen == Some(index), names, bar)
    };
    [Line::default().with(heading, Look::Dim)].into_iter().chain(shown.map(row)).collect()
}

fn joint_row(
    index: usize,
    joint: &JointReport,
    limits: Option<[f64; 2]>,
    chosen: bool,
    names: usize,
    bar: usize,
) -> Line {
    let name: String = joint.name.chars().take(names).collect();
    let mark = if chosen { '>' } else { ' ' };
    let Some(position) = joint.position else {
        return Line::default().and(format!("{mark}{:>2} {name}  ?", index + 1));
    };
    let text = format!("{:<names$} {:>9} {:>8}", name, fixed(position, 4), fixed(position.to_degrees(), 1));
    let look = if chosen { Look::Bold } else { Look::Plain };
    let line = Line::default().with(format!("{mark}{:>2} {text}", (index + 1) % 100), look);
    let Some([lower, upper]) = limits.filter(|[lower, upper]| bar > 0 && lower < upper) else { return line };
    let share = (position - lower) / (upper - lower);
    // Highlights the outer twentieths of the range.
    let look = match share {
        s if !(0.0..=1.0).contains(&s) => Look::Bad,
        s if !(0.05..=0.95).contains(&s) => Look::Warning,
        _ => Look::Plain,
    };
    let at = (share.clamp(0.0, 1.0) * (bar - 1) as f64).round() as usize;
    let cells: String = (0..bar).map(|cell| if cell == at { '#' } else { '-' }).collect();
    line.and(format!("  {:>7} ", fixed(lower, 2))).with(format!("[{cells}]"), look).and(format!(" {}", fixed(upper, 2)))
}

fn pose(state: Option<&ArmStateReport>) -> Vec<Line> {
    let Some(state) = state else { return Vec::new() };
    let mut lines = Vec::new();
    if let Some(pose) = state.pose.as_ref().or(state.device_pose.as_ref()) {
        let three = |values: [f64; 3], digits| values.map(|v| fixed(v, digits)).join(" ");
        let whose = if state.pose.is_some() { "" } else { " (device)" };
        lines.push(Line::default().and(format!("pose  {}{whose}", pose.label())));
        let text = format!("      xyz {} m  rpy {} rad", three(pose.xyz, 4), three(pose.rpy, 3));
        lines.push(Line::default().and(text));
    }
    if let Some(gripper) = state.gripper {
        let unit = state.gripper_unit.as_deref().unwrap_or("m");
        let force = state.gripper_force.zip(state.gripper_force_unit.as_deref());
        let force = force.map_or_else(String::new, |(force, unit)| format!("  force {force:.2} {unit}"));
        lines.push(Line::default().and(format!("gripper {}{force}", gripper_text(gripper, unit))));
    }
    lines
}

/// Motion of jog, and its limits.
fn motion(view: &View<'_>) -> Vec<Line> {
    let mode = match (view.joint_mode, view.tool_frame) {
        (true, _) => format!("JOINT {}", view.joint.unwrap_or("?")),
        (false, false) => "CARTESIAN along the axes of the base".to_owned(),
        (false, true) => "CARTESIAN along the axes of the tool".to_owned(),
    };
    let first = Line::default().with(mode, Look::Bold).and(format!("  speed {}", view.speed));
    let Some(name) = view.task else {
        return vec![first, Line::default().with("the run has no task for this mode", Look::Warning)];
    };
    let task = view.seen.tasks.iter().find(|task| task.name == name);
    let line = Line::default().and(format!("task {name} "));
    let line = line.with(task.map_or("?", |task| task.state.as_str()), state_look(task));
    let line = match task.and_then(|task| task.reason.as_deref()) {
        Some(reason) => line.and(format!(" ({reason})")),
        None => line,
    };
    let line = match &*view.moving {
        "" => line.and("  at rest"),
        moving => line.and("  moving ").with(moving, Look::Good),
    };
    // The task's limit has priority over a joint's.
    let held_back = task.and_then(|task| task.bound.clone());
    let bound = match held_back.or_else(|| view.seen.bound.as_ref().map(|(text, _)| text.clone())) {
        Some(text) => Line::default().with(format!("limited: {text}"), Look::Warning),
        None => Line::default(),
    };
    vec![first, line, bound]
}

fn state_look(task: Option<&TaskReport>) -> Look {
    match task.map(|task| task.state.as_str()) {
        Some("FAULT") => Look::Bad,
        Some("EXECUTING") => Look::Good,
        _ => Look::Plain,
    }
}

/// The keys, in as many lines as needed.
fn help(view: &View<'_>, columns: usize) -> Vec<Line> {
    let mut keys: Vec<String> = match view.joint_mode {
        true => ["1-9,0 choose a joint", "+/- or arrows move it", "Tab end effector"].map(str::to_owned).into(),
        false => {
            let pair = |(up, down, name): (char, char, &str)| {
                format!("{}/{} +/-{name}", up.to_ascii_uppercase(), down.to_ascii_uppercase())
            };
            AXES.map(pair).into_iter().chain(["B base/tool axes".to_owned(), "Tab joints".to_owned()]).collect()
        }
    };
    if view.seen.state.as_ref().is_some_and(|state| state.gripper.is_some()) {
        keys.push("O/C open/close the gripper".to_owned());
    }
    let always = ["[ ] speed", "Space rest", "X stop, latched", "Esc leave"];
    keys.extend(always.map(str::to_owned));
    keys.push(if view.releases { "moves while a key is down".to_owned() } else { "hold a key to move".to_owned() });
    let mut lines = vec![String::new()];
    for key in keys {
        let long = lines.last().map_or(0, |line| line.chars().count() + 3 + key.chars().count());
        match lines.last_mut() {
            Some(line) if line.is_empty() => *line = key,
            Some(line) if long <= columns => line.push_str(&format!("   {key}")),
            _ => lines.push(key),
        }
    }
    lines.into_iter().map(|line| Line::default().with(line, Look::Dim)).collect()
}

/// The message, wrapped to up to three lines; always at least one, so that the layout is stable.
fn message(view: &View<'_>, columns: usize) -> Vec<Line> {
    let held = view.seen.arm.as_ref().filter(|arm| arm.phase == "held").map(how_to_reset);
    let (text, bad) = match (&held, view.message) {
        (_, Some((text, bad))) => (text, bad),
        (Some(text), None) => (text.as_str(), true),
        (None, None) => ("", false),
    };
    let mut lines = vec![String::new()];
    for word in text.split_whitespace() {
        match lines.last_mut() {
            Some(line) if line.is_empty() => line.push_str(word),
            Some(line) if line.chars().count() + 1 + word.chars().count() <= columns => {
                line.push_str(&format!(" {word}"))
            }
            _ => lines.push(word.to_owned()),
        }
    }
    lines.truncate(3);
    let look = if bad { Look::Bad } else { Look::Plain };
    lines.into_iter().map(|line| Line::default().with(line, look)).collect()
}

fn how_to_reset(arm: &ArmReport) -> String {
    let id = &arm.hardware_id;
    format!("held: in another terminal `dimos arm reset {id}`, then `dimos arm enable {id}`")
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_rpc::report::{CauseReport, PoseReport};

    fn seen(joints: usize) -> ArmSnapshot {
        let joint = |i: usize| JointReport {
            name: format!("arm_joint{}", i + 1),
            position: Some(0.5 * i as f64 - 1.0),
            ..Default::default()
        };
        let task = TaskReport { name: "twist_arm".into(), state: "EXECUTING".into(), ..Default::default() };
        ArmSnapshot {
            state: Some(ArmStateReport {
                age_ms: Some(4.0),
                joints: (0..joints).map(joint).collect(),
                pose: Some(PoseReport {
                    link: "link_tcp".into(),
                    frame: "map".into(),
                    xyz: [0.25, 0.0, 0.36],
                    rpy: [3.0, 0.47, 3.0],
                    ..Default::default()
                }),
                gripper: Some(0.04),
                ..Default::default()
            }),
            arm: Some(ArmReport {
                hardware_id: "arm".into(),
                phase: "ready".into(),
                link: "up".into(),
                mode: "servo_position".into(),
                position_limits: vec![[-2.0, 2.0]; joints],
                ..Default::default()
            }),
            tasks: vec![task],
            ..Default::default()
        }
    }

    fn view(seen: &ArmSnapshot, joint_mode: bool) -> View<'_> {
        View {
            run: "coordinator-yourarm",
            arm: "arm",
            seen,
            since: Some(Duration::from_millis(20)),
            joint_mode,
            tool_frame: false,
            task: Some("twist_arm"),
            joint: Some("arm_joint3"),
            speed: "20 %: 0.050 m/s, 0.200 rad/s".into(),
            moving: String::new(),
            message: None,
            releases: false,
        }
    }

    fn text(view: &View<'_>, size: (usize, usize)) -> Vec<String> {
        lines(view, size).iter().map(Line::text).collect()
    }

    #[test]
    fn it_fits_in_80_by_24_and_shows_everything() {
        let seen = seen(7);
        let lines = text(&view(&seen, false), (80, 24));
        assert!(lines.len() <= 24, "{lines:#?}");
        assert!(lines.iter().all(|line| line.chars().count() <= 80), "{lines:#?}");
        let all = lines.join("\n");
        for part in [
            "state 24 ms old",
            "ready",
            "arm_joint7",
            "2.0000",
            "114.6",
            "pose  link_tcp in map",
            "xyz 0.2500",
            "W/S +/-x",
            "Y/H +/-yaw",
            "Esc leave",
        ] {
            assert!(all.contains(part), "no {part:?} in\n{all}");
        }
        let bar = lines.iter().find(|line| line.contains("arm_joint3")).unwrap();
        let (before, after) = bar.split_once('#').unwrap();
        let (left, right) = (before.matches('-').count(), after.matches('-').count());
        assert!(left.abs_diff(right) <= 2, "joint 3 is in the middle: {bar}");
    }

    #[test]
    fn with_less_space_less_is_shown_within_the_screen() {
        let seen = seen(16);
        for joint_mode in [false, true] {
            for columns in [20, 40, 59, 60, 80, 200] {
                for rows in [8, 10, 16, 24, 60] {
                    let lines = text(&view(&seen, joint_mode), (columns, rows));
                    assert!(lines.len() <= rows, "{columns}x{rows}: {lines:#?}");
                    assert!(lines[0].starts_with("jog arm"));
                    let all = lines.join("\n");
                    assert!(!joint_mode || all.contains("> 3 arm_j"), "{columns}x{rows}: {all}");
                    assert!(all.contains("task twist_arm EXECUTING"), "{columns}x{rows}: {all}");
                }
            }
        }
        assert!(!text(&view(&seen, false), (40, 24)).join("\n").contains('#'));
    }

    #[test]
    fn the_keys_are_shown_before_the_pose() {
        let seen = seen(6);
        let keys = |size| text(&view(&seen, false), size).join("\n");
        let all = keys((50, 20));
        assert!(all.contains("W/S +/-x") && all.contains("Esc leave") && !all.contains("pose  link_tcp"), "{all}");
        let few = keys((50, 15));
        assert!(few.contains("X stop, latched   Esc leave") && !few.contains("W/S"), "{few}");
    }

    #[test]
    fn what_prevents_motion_is_shown() {
        let mut seen = seen(2);
        let arm = seen.arm.as_mut().unwrap();
        arm.phase = "held".into();
        arm.cause = Some(CauseReport { name: "operator_stop".into(), text: "stopped by an operator".into(), by: None });
        seen.bound = Some(("arm_joint1 is limited in velocity".into(), std::time::Instant::now()));
        let all = text(&view(&seen, false), (80, 24)).join("\n");
        for part in ["held: stopped by an operator", "dimos arm reset arm", "limited: arm_joint1 is limited"] {
            assert!(all.contains(part), "no {part:?} in\n{all}");
        }
    }
}
