//! Texts of a run at start-up and after its end.

use std::path::Path;

use serde::Serialize;

use super::text_log::Terminal;
use crate::runtime::{Ended, effective_speed};
use dimos_core::telemetry::texts::percent;
use dimos_rpc::report::{ArmReport, RealtimeReport, StatusReport};

/// Fractions from here on are shown as full speed.
const FULL: f64 = 0.9995;

/// Last line of the banner of a run with a terminal.
pub const IN_A_TERMINAL: &str = "Press Ctrl-C for a controlled stop. In a second terminal: dimos status";

/// Prints the banner of a run that is up: to stderr, or as one line of JSON to stdout. `url` is that of the live view
/// with its token, `end` the last line.
pub(super) fn print(
    terminal: &Terminal,
    report: &StatusReport,
    socket: &Path,
    url: Option<&str>,
    end: &str,
    json: bool,
) {
    #[derive(Serialize)]
    struct Started<'a> {
        event: &'static str,
        socket: &'a Path,
        #[serde(flatten)]
        report: &'a StatusReport,
    }
    if json {
        return terminal.json(&Started { event: "started", socket, report });
    }
    for line in text(report, socket, url, end) {
        match url {
            Some(url) if line.contains(url) => terminal.private(line),
            _ => terminal.note(line),
        }
    }
}

/// Returns the banner's lines.
pub fn text(report: &StatusReport, socket: &Path, url: Option<&str>, end: &str) -> Vec<String> {
    let heading = heading(report);
    let mut lines = vec![format!("{heading}  (pid {}, dimos {})", report.pid, report.version)];
    let mut row = |what: &str, text: String| lines.push(format!("  {what:<10} {text}"));
    row("blueprint", report.blueprint.clone());
    for arm in &report.arms {
        let standing = standing(arm.simulated, &arm.address);
        row("arm", format!("{}: {standing}, {}, {}", arm.hardware_id, arm.adapter, arm.phase));
        if let Some(cause) = cause(arm) {
            row("", format!("{}: {cause}", arm.phase));
        }
        arm.notes().for_each(|(about, note)| row("", format!("{about}: {note}")));
        row("", format!("at exit: {}", at_exit(arm)));
    }
    let clock = Some(&report.ticks.clock).filter(|clock| clock.starts_with("device"));
    let clock = clock.map(|clock| format!(", clock: {clock}")).unwrap_or_default();
    row("tick", format!("{} Hz{clock}", report.tick_rate));
    for (index, text) in realtime_of(report).into_iter().enumerate() {
        row(if index == 0 { "real time" } else { "" }, text);
    }
    row("log", report.log.clone().unwrap_or_else(|| "none".into()));
    row("socket", socket.display().to_string());
    if let Some(address) = &report.view {
        row("view", url.map_or_else(|| view_without_token(address), str::to_owned));
    }
    report.metrics.iter().for_each(|url| row("metrics", url.clone()));
    lines.push(end.into());
    lines
}

/// Returns the address of a live view with the way to its token.
pub fn view_without_token(address: &str) -> String {
    format!("{address}  (`dimos view` prints the URL with its token)")
}

/// Returns the first words about a run: its name, and in capitals whether it is simulated.
pub fn heading(report: &StatusReport) -> String {
    format!("run {}  {}", report.run, report.standing()).trim_end().to_owned()
}

/// Returns what a command moves: `SIMULATED`, or `REAL ARM at 192.168.1.185`.
pub fn standing(simulated: bool, address: &str) -> String {
    match (simulated, address) {
        (true, _) => "SIMULATED".to_owned(),
        (false, "") => "REAL ARM".to_owned(),
        (false, address) => format!("REAL ARM at {address}"),
    }
}

/// Returns why an arm is held, with the text of its error; `None` if it is not held.
pub fn cause(arm: &ArmReport) -> Option<String> {
    let cause = arm.cause.as_ref()?;
    let by = cause.by.as_ref().map_or_else(String::new, |by| format!(": {by}"));
    let cause = &format!("{}{by}", cause.text);
    let error = arm.error.as_ref().filter(|error| cause.ends_with(&format!("error {}", error.code)));
    Some(error.map_or_else(|| cause.clone(), |error| format!("{cause}: {}", error.text)))
}

/// Returns that an arm's controller slows its motions, or stops them on their paths; `None` if it does not.
pub fn slowed(arm: &str, fraction: Option<f64>) -> Option<String> {
    match effective_speed(fraction) {
        0.0 => Some(format!("{arm} is stopped by its controller (0 % of the speed): motions wait on their paths")),
        fraction if fraction < FULL => {
            Some(format!("{arm} is slowed by its controller to {} of the speed", percent(fraction)))
        }
        _ => None,
    }
}

/// Describes the motors after the end of the run.
pub fn at_exit(arm: &ArmReport) -> &'static str {
    match (arm.on_exit.as_str(), arm.holds_when_disabled) {
        ("disable", true) => "motors off; it keeps its pose",
        ("disable", false) => "motors off; it FALLS unless supported",
        ("park", _) => "it moves to its park pose, then motors off",
        _ => "motors stay on and hold the pose",
    }
}

/// What follows the deceleration where arms park.
pub const PARKING: &str = "then to the park pose (Ctrl-C or `dimos stop` ends that), then releasing the arms";

/// Returns whether the arm moves to its park pose at the end.
pub fn parks(arm: &ArmReport) -> bool {
    arm.on_exit == "park"
}

/// Describes an arm's motors now that the run has ended, from the arm's last report.
pub fn after_exit(arm: &ArmReport, ended: &Ended) -> &'static str {
    let is_in = |list: &[String]| list.contains(&arm.hardware_id);
    let parked = is_in(&ended.parked);
    match (arm.link.as_str(), arm.enabled, arm.holds_when_disabled) {
        (_, true, _) if is_in(&ended.unreleased) => "its motors may be on: look at the warning",
        ("down" | "faulted", ..) => "it could not be reached: its motors are unchanged",
        (_, false, true) => "motors are off; it keeps its pose",
        (_, false, false) => "motors are off; it does not hold its pose",
        (_, true, _) if parked => "parked; motors off",
        // Not parked: as without parking.
        (_, true, true) if arm.on_exit == "park" => "motors off; it keeps its pose",
        (_, true, false) if arm.on_exit == "park" => "motors stay on and hold the pose",
        (_, true, _) => at_exit(arm),
    }
}

/// Returns the real-time measures of a run. Where nothing moves but emulators, those that are missing are one line.
fn realtime_of(report: &StatusReport) -> Vec<String> {
    let missing = report.realtime.iter().any(|measure| !measure.granted);
    match missing && is_simulated(report) {
        true => vec!["not granted; simulated arms need none (`dimos doctor`)".to_owned()],
        false => report.realtime.iter().flat_map(realtime).collect(),
    }
}

/// Returns whether no arm of a run is real.
pub fn is_simulated(report: &StatusReport) -> bool {
    report.arms.iter().all(|arm| arm.simulated)
}

/// Returns one real-time measure; if it was refused, a second line gives the fix.
pub fn realtime(measure: &RealtimeReport) -> Vec<String> {
    if measure.granted {
        return vec![format!("{}: granted", measure.what)];
    }
    let hint = measure.remedy.iter().map(|remedy| format!("hint: {remedy}"));
    [format!("{}: NOT granted", measure.what)].into_iter().chain(hint).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_rpc::report::CauseReport;

    #[test]
    fn the_banner_shows_arms_motors_real_time_and_log() {
        let arm = |on_exit: &str, holds_when_disabled| ArmReport {
            hardware_id: "arm".into(),
            adapter: "yourarm".into(),
            address: "sim".into(),
            simulated: true,
            link: "up".into(),
            enabled: true,
            phase: "ready".into(),
            on_exit: on_exit.into(),
            holds_when_disabled,
            ..Default::default()
        };
        let cause =
            CauseReport { name: "device_error".into(), text: "the arm reports error 1: E-stop".into(), by: None };
        let real = ArmReport {
            adapter: "xarm".into(),
            address: "192.168.1.185".into(),
            simulated: false,
            phase: "held".into(),
            cause: Some(cause),
            ..arm("disable", false)
        };
        let missing = RealtimeReport { what: "SCHED_FIFO".into(), granted: false, remedy: Some("ulimit -r 80".into()) };
        let report = StatusReport {
            run: "coordinator-yourarm".into(),
            pid: 42,
            version: "0.1.0".into(),
            blueprint: "coordinator-yourarm".into(),
            tick_rate: 100.0,
            simulated: true,
            realtime: vec![missing],
            arms: vec![arm("hold", false), real],
            ..Default::default()
        };
        let expected = "\
run coordinator-yourarm  PARTLY SIMULATED  (pid 42, dimos 0.1.0)
  blueprint  coordinator-yourarm
  arm        arm: SIMULATED, yourarm, ready
             at exit: motors stay on and hold the pose
  arm        arm: REAL ARM at 192.168.1.185, xarm, held
             held: the arm reports error 1: E-stop
             at exit: motors off; it FALLS unless supported
  tick       100 Hz
  real time  SCHED_FIFO: NOT granted
             hint: ulimit -r 80
  log        none
  socket     /run/dimos.sock
Press Ctrl-C for a controlled stop. In a second terminal: dimos status";
        let socket = Path::new("/run/dimos.sock");
        assert_eq!(text(&report, socket, None, IN_A_TERMINAL).join("\n"), expected);
        let simulated = StatusReport { arms: vec![arm("hold", false)], ..report.clone() };
        let lines = text(&simulated, socket, None, IN_A_TERMINAL);
        let about = lines.iter().filter(|line| line.contains("real time") || line.contains("ulimit"));
        assert_eq!(about.count(), 1, "{lines:#?}");
        let viewed = StatusReport { view: Some("http://127.0.0.1:7000/".into()), ..report };
        let line = |url| text(&viewed, socket, url, "end").into_iter().rev().nth(1).unwrap();
        assert_eq!(line(Some("http://127.0.0.1:7000/#1f")), "  view       http://127.0.0.1:7000/#1f");
        assert!(line(None).starts_with("  view       http://127.0.0.1:7000/  (`dimos view`"), "{}", line(None));

        assert_eq!(at_exit(&arm("park", false)), "it moves to its park pose, then motors off");
        let (normal, parked) = (Ended::default(), Ended { parked: vec!["arm".into()], ..Ended::default() });
        assert_eq!(after_exit(&arm("park", false), &parked), "parked; motors off");
        let unreleased = Ended { unreleased: vec!["arm".into()], ..Ended::default() };
        assert_eq!(after_exit(&arm("disable", true), &unreleased), "its motors may be on: look at the warning");
        assert_eq!(after_exit(&arm("park", false), &normal), "motors stay on and hold the pose");
        assert_eq!(after_exit(&arm("park", true), &normal), "motors off; it keeps its pose");
        assert_eq!(after_exit(&arm("hold", false), &normal), "motors stay on and hold the pose");
        let off = |holds| after_exit(&ArmReport { enabled: false, ..arm("hold", holds) }, &normal);
        assert_eq!(off(false), "motors are off; it does not hold its pose", "as after its own E-stop");
        assert_eq!(off(true), "motors are off; it keeps its pose");
        let lost = ArmReport { link: "faulted".into(), ..arm("disable", true) };
        assert_eq!(after_exit(&lost, &normal), "it could not be reached: its motors are unchanged");
    }
}
