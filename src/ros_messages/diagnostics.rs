//! The condition of arms and tick, as ROS shows it.

use dimos_log::display_messages::{DiagnosticArray, DiagnosticStatus, KeyValue};
use dimos_log::messages::{Header, Time};
use dimos_rpc::report::{ArmReport, StatusReport, TickReport};

/// Levels of a status.
const OK: u8 = 0;
const WARN: u8 = 1;
const ERROR: u8 = 2;

/// Returns one status for each arm, and one of the tick.
pub fn diagnostics(status: &StatusReport, stamp: Time) -> DiagnosticArray {
    let arms = status.arms.iter().map(|arm| of_arm(&status.run, arm));
    let rows = arms.chain([of_tick(&status.run, &status.ticks)]);
    DiagnosticArray { header: Header { stamp, frame_id: String::new() }, status: rows.collect() }
}

fn of_arm(run: &str, arm: &ArmReport) -> DiagnosticStatus {
    let lost = matches!(arm.link.as_str(), "faulted" | "down") || arm.error.is_some();
    let level = match arm.phase.as_str() {
        _ if lost => ERROR,
        "unknown" | "held" => ERROR,
        "ready" if arm.link == "up" => OK,
        _ => WARN,
    };
    let cause = arm.cause.as_ref().map(|cause| cause.text.clone());
    let error = arm.error.as_ref().map(|error| format!("error {}: {}", error.code, error.text));
    let message: Vec<String> = [Some(arm.phase.clone()), cause, error].into_iter().flatten().collect();
    let faults: Vec<&str> = arm.faults.iter().map(|fault| fault.text.as_str()).collect();
    let values = [
        ("link", Some(arm.link.clone())),
        ("mode", Some(arm.mode.clone())),
        ("simulated", Some(arm.simulated.to_string())),
        ("age [ms]", arm.state_age_ms.map(|age| format!("{age:.1}"))),
        ("rate [Hz]", arm.measured_rate_hz.map(|rate| format!("{rate:.1}"))),
        ("commander", arm.commander.as_ref().map(|commander| commander.program.clone())),
        ("faults", (!faults.is_empty()).then(|| faults.join("; "))),
    ];
    row(format!("{run}: {}", arm.hardware_id), level, message.join(", "), arm.address.clone(), values)
}

fn of_tick(run: &str, ticks: &TickReport) -> DiagnosticStatus {
    let late = ticks.lateness_us;
    let level = if ticks.overruns > 0 || ticks.skipped > 0 { WARN } else { OK };
    let values = [
        ("ticks", Some(ticks.count.to_string())),
        ("overruns", Some(ticks.overruns.to_string())),
        ("skipped", Some(ticks.skipped.to_string())),
        ("lateness p99 [us]", Some(late.p99.to_string())),
        ("lateness max [us]", Some(late.max.to_string())),
        ("compute p99 [us]", Some(ticks.compute_us.p99.to_string())),
    ];
    row(format!("{run}: tick"), level, format!("late by {} us (p99)", late.p99), String::new(), values)
}

fn row<const N: usize>(
    name: String,
    level: u8,
    message: String,
    hardware_id: String,
    values: [(&str, Option<String>); N],
) -> DiagnosticStatus {
    let values = values.into_iter().filter_map(|(key, value)| Some(KeyValue { key: key.into(), value: value? }));
    DiagnosticStatus { level, name, message, hardware_id, values: values.collect() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_rpc::report::{CauseReport, DeviceError};

    #[test]
    fn what_needs_attention_is_a_warning_or_an_error() {
        let arm = |phase: &str, link: &str| ArmReport {
            hardware_id: "arm".into(),
            phase: phase.into(),
            link: link.into(),
            ..ArmReport::default()
        };
        for (phase, link, wanted) in [
            ("ready", "up", OK),
            ("ready", "stale", WARN),
            ("disabled", "up", WARN),
            ("held", "up", ERROR),
            ("unknown", "up", ERROR),
            ("ready", "down", ERROR),
        ] {
            assert_eq!(of_arm("cell", &arm(phase, link)).level, wanted, "{phase} {link}");
        }
        let stopped = ArmReport {
            cause: Some(CauseReport { name: "operator_stop".into(), text: "stopped by an operator".into(), by: None }),
            error: Some(DeviceError { code: 22, text: "self-collision".into() }),
            ..arm("held", "up")
        };
        let row = of_arm("cell", &stopped);
        assert_eq!(row.message, "held, stopped by an operator, error 22: self-collision");
        assert_eq!((row.name.as_str(), row.values.len()), ("cell: arm", 3));
    }
}
