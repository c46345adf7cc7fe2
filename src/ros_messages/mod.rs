//! Reports of a run as messages of ROS 2, for the node of ROS and for Foxglove. The log has the same messages, made of
//! the samples of the tick.

mod diagnostics;
mod world;

use dimos_core::clock::wall_now;
use dimos_log::display_messages::{TFMessage, Transform, TransformStamped};
use dimos_log::messages::{self, Header, Quaternion, Time, Vector3};
use dimos_rpc::api::TransformReport;
use dimos_rpc::server::streams::{EventReport, JointState, Level};

pub use diagnostics::diagnostics;
pub use world::changes;

/// Levels of a line of the text log.
const INFO: u8 = 20;
const WARN: u8 = 30;
const ERROR: u8 = 40;

/// Returns a time of ROS. `seconds`: since the Unix epoch.
pub fn time(seconds: f64) -> Time {
    Time::of(nanoseconds(seconds))
}

/// Returns a time in nanoseconds. `seconds`: since the Unix epoch.
pub fn nanoseconds(seconds: f64) -> u64 {
    (seconds.max(0.0) * 1e9).round() as u64
}

/// Returns the present time [s since the Unix epoch].
pub fn now() -> f64 {
    wall_now() as f64 * 1e-9
}

/// Returns a joint state. Unknown values are NaN; a list without any known one is empty.
pub fn joint_state(state: JointState, frame_id: String) -> messages::JointState {
    let known = |values: Vec<Option<f64>>| match values.iter().all(Option::is_none) {
        true => Vec::new(),
        false => values.into_iter().map(|value| value.unwrap_or(f64::NAN)).collect(),
    };
    messages::JointState {
        header: Header { stamp: time(state.stamp), frame_id },
        name: state.name,
        position: known(state.position),
        velocity: known(state.velocity),
        effort: known(state.effort),
    }
}

/// Returns transforms at a time [s since the Unix epoch].
pub fn transforms(all: Vec<TransformReport>, stamp: f64) -> TFMessage {
    let transform = |report: TransformReport| {
        let ([x, y, z], [qx, qy, qz, qw]) = (report.xyz, report.quat);
        let rotation = Quaternion { x: qx, y: qy, z: qz, w: qw };
        TransformStamped {
            header: Header { stamp: time(stamp), frame_id: report.parent },
            child_frame_id: report.child,
            transform: Transform { translation: Vector3 { x, y, z }, rotation },
        }
    };
    TFMessage { transforms: all.into_iter().map(transform).collect() }
}

/// Returns an event. Its numbers, and the request that it answers, are in the log only.
pub fn event(report: EventReport) -> messages::Event {
    let severity = match report.level {
        Level::Info => "info",
        Level::Warning => "warn",
        Level::Error => "error",
    };
    messages::Event {
        header: Header { stamp: time(report.stamp), frame_id: String::new() },
        tick: report.tick,
        kind: report.kind,
        severity: severity.to_owned(),
        arm: report.arm.unwrap_or_default(),
        task: report.task.unwrap_or_default(),
        joint: report.joint.unwrap_or_default(),
        text: report.text,
        by: report.by.unwrap_or_default(),
        ..messages::Event::default()
    }
}

/// Returns an event of a run as a line of the text log.
pub fn log_line(run: &str, report: &EventReport) -> messages::Log {
    let level = match report.level {
        Level::Info => INFO,
        Level::Warning => WARN,
        Level::Error => ERROR,
    };
    let (stamp, name, msg) = (time(report.stamp), run.to_owned(), report.text.clone());
    messages::Log { stamp, level, name, msg, ..messages::Log::default() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_unknown_is_not_a_number_and_what_is_wholly_unknown_is_absent() {
        let state = JointState {
            stamp: 1.25,
            name: vec!["a".into(), "b".into()],
            position: vec![Some(0.5), None],
            velocity: vec![None, None],
            ..JointState::default()
        };
        let message = joint_state(state, String::new());
        assert_eq!(message.header.stamp, Time { sec: 1, nanosec: 250_000_000 });
        assert!(message.position[0] == 0.5 && message.position[1].is_nan());
        assert!(message.velocity.is_empty() && message.effort.is_empty());
    }
}
