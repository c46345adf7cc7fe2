//! What 3D viewers and panels show of a tick: transforms, accepted motions, diagnostics.

use std::collections::BTreeMap;
use std::io::{Seek, Write};
use std::sync::Arc;
use std::time::Duration;

use mcap::McapResult;
use nalgebra::Isometry3;

use super::display_messages::{
    self, ColorRGBA, DiagnosticArray, DiagnosticStatus, JointTrajectoryPoint, KeyValue, Marker, MarkerArray,
};
use super::log_writer::LogWriter;
use super::messages::{Header, Point, Text, Time, Vector3};
use super::robots::LoggedRobots;
use super::tcp_log::{TcpChain, TcpChains};
use super::tick_log::{ArmLog, TickLog};
use dimos_core::arm::Link;
use dimos_core::clock::Mono;
use dimos_core::sync::lock;
use dimos_core::telemetry::describe::ArmNames;
use dimos_core::telemetry::texts::cause_text;
use dimos_core::telemetry::{ArmSample, Cause, Phase, TickSample};
use dimos_core::trajectory::{Cursor, JointTrajectory, Sample, Spline};

/// Minimum time between two messages on `/tf`: 25 a second at 100 Hz.
const TF_EVERY: Duration = Duration::from_micros(39_900);
/// Maximum time between two messages on `/diagnostics`.
const DIAGNOSTICS_EVERY: Duration = Duration::from_secs(1);
/// Maximum number of points of a planned path.
const PATH_POINTS: f64 = 200.0;
/// Points of a planned path per second.
const PATH_RATE: f64 = 20.0;
/// Width of a planned path [m].
const PATH_WIDTH: f64 = 0.004;

/// The robots of the log, and what was logged of them last.
#[derive(Default)]
pub(super) struct SceneLog {
    pub robots: Arc<LoggedRobots>,
    description: String,
    /// The objects of the world, by namespace and number.
    objects: BTreeMap<(String, i32), Marker>,
    tf_at: Option<Mono>,
    diagnosed_at: Option<Mono>,
    /// Phase of each arm in the latest diagnostics.
    phases: Vec<Option<Phase>>,
    /// Greatest lateness [ns], skipped periods and lost samples since the latest diagnostics.
    late_ns: u64,
    skipped: u32,
    dropped: u32,
}

impl TickLog {
    /// Takes the robots and their description.
    pub fn robots(&mut self, robots: Arc<LoggedRobots>, description: String) {
        (self.scene.robots, self.scene.description) = (robots, description);
    }

    /// Logs the description of the robots, and the transforms that do not change.
    pub fn latched<W: Write + Seek>(&self, log: &mut LogWriter<W>, stamp: Mono) -> McapResult<()> {
        if self.scene.description.is_empty() {
            return Ok(());
        }
        let time = self.wall.wall(stamp);
        let header = Header { stamp: Time::of(time), frame_id: String::new() };
        log.publish("/robot_description", time, &Text { data: self.scene.description.clone() })?;
        log.publish("/tf_static", time, &self.scene.robots.fixed(&header))
    }

    /// Logs at the beginning of a file what it needs to be understood alone: now what seldom changes, and with the next
    /// tick everything else.
    pub fn renew<W: Write + Seek>(&mut self, log: &mut LogWriter<W>, stamp: Mono) -> McapResult<()> {
        self.arms.iter_mut().for_each(|arm| arm.fresh = true);
        (self.scene.tf_at, self.scene.diagnosed_at) = (None, None);
        self.latched(log, stamp)?;
        let markers: Vec<Marker> = self.scene.objects.values().cloned().collect();
        if markers.is_empty() { Ok(()) } else { self.markers(log, stamp, MarkerArray { markers }) }
    }

    /// Takes changes of the world's objects.
    pub fn objects(&mut self, changes: &MarkerArray) {
        for marker in &changes.markers {
            let key = (marker.ns.clone(), marker.id);
            match marker.action {
                0 => drop(self.scene.objects.insert(key, marker.clone())),
                _ => drop(self.scene.objects.remove(&key)),
            }
        }
    }

    /// Logs changes of the world's objects.
    pub fn markers<W: Write + Seek>(
        &self,
        log: &mut LogWriter<W>,
        stamp: Mono,
        mut markers: MarkerArray,
    ) -> McapResult<()> {
        let time = self.wall.wall(stamp);
        markers.markers.iter_mut().for_each(|marker| marker.header.stamp = Time::of(time));
        log.publish("/markers", time, &markers)
    }

    /// Logs a motion that the tick accepted: its trajectory, and the path of the tool centre point.
    pub fn motion<W: Write + Seek>(
        &self,
        log: &mut LogWriter<W>,
        stamp: Mono,
        task: u16,
        trajectory: &JointTrajectory,
    ) -> McapResult<()> {
        let time = self.wall.wall(stamp);
        let header = Header { stamp: Time::of(time), frame_id: self.frame_id.clone() };
        let points = trajectory.points.iter().map(|point| JointTrajectoryPoint {
            positions: point.positions.to_vec(),
            velocities: point.velocities.to_vec(),
            accelerations: point.accelerations.to_vec(),
            effort: Vec::new(),
            time_from_start: display_messages::Duration::of(point.time_from_start),
        });
        let (joint_names, points) = (trajectory.joint_names.clone(), points.collect());
        let message = display_messages::JointTrajectory { header: header.clone(), joint_names, points };
        log.publish("/joint_trajectory", time, &message)?;
        let markers: Vec<Marker> = self
            .paths(trajectory)
            .into_iter()
            .zip(0..)
            .map(|(points, id)| Marker {
                header: Header { frame_id: "map".to_owned(), ..header.clone() },
                ns: format!("plan/{}", self.names.task(task)),
                id,
                r#type: 4,
                scale: Vector3 { x: PATH_WIDTH, ..Vector3::default() },
                color: ColorRGBA { r: 0.1, g: 0.5, b: 1.0, a: 0.9 },
                points,
                ..upright()
            })
            .collect();
        if markers.is_empty() { Ok(()) } else { log.publish("/markers", time, &MarkerArray { markers }) }
    }

    /// Returns the path of each tool centre point that a trajectory moves.
    fn paths(&self, trajectory: &JointTrajectory) -> Vec<Vec<Point>> {
        let Ok(spline) = Spline::new(trajectory) else { return Vec::new() };
        let all: Vec<&String> = self.names.arms.iter().flat_map(|arm| &arm.joints).collect();
        let index = |joint: &String| all.iter().position(|name| *name == joint);
        let Some(moved) = trajectory.joint_names.iter().map(index).collect::<Option<Vec<_>>>() else {
            return Vec::new();
        };
        let steps = (spline.duration() * PATH_RATE).clamp(1.0, PATH_POINTS).ceil();
        let chains = lock(&self.tcps);
        let moves = |chain: &&TcpChain| chain.joints.iter().any(|joint| moved.contains(joint));
        let path = |chain: &TcpChain| {
            let (mut cursor, mut samples) = (Cursor::default(), vec![Sample::default(); moved.len()]);
            let mut positions = self.states.position.clone();
            positions.resize(all.len(), f64::NAN);
            let at = |step: u32| {
                spline.sample(spline.duration() * f64::from(step) / steps, &mut cursor, &mut samples);
                for (joint, sample) in moved.iter().zip(&samples) {
                    positions[*joint] = sample.position;
                }
                chain.pose(&positions).map(|pose| pose.position)
            };
            (0..=steps as u32).map(at).collect::<Option<Vec<Point>>>()
        };
        chains.iter().flatten().filter(moves).filter_map(path).collect()
    }

    /// Logs transforms and diagnostics of a tick, if they are due.
    pub(super) fn scene<W: Write + Seek>(&mut self, log: &mut LogWriter<W>, tick: &TickSample) -> McapResult<()> {
        let (time, due) = (self.wall.wall(tick.deadline), |last: Option<Mono>, every| {
            last.is_none_or(|last| tick.deadline.since(last) >= every)
        });
        let header = Header { stamp: Time::of(time), frame_id: String::new() };
        if !self.scene.robots.is_empty() && due(self.scene.tf_at, TF_EVERY) {
            let state = |arm: usize| self.arms.get(arm)?.read();
            let tool = tools(&self.tcps);
            let message = self.scene.robots.moved(&header, &self.states.position, state, tool);
            if !message.transforms.is_empty() {
                log.publish("/tf", time, &message)?;
                self.scene.tf_at = Some(tick.deadline);
            }
        }
        let scene = &mut self.scene;
        scene.late_ns = scene.late_ns.max(tick.late_ns);
        scene.skipped = scene.skipped.saturating_add(tick.skipped);
        scene.dropped = scene.dropped.saturating_add(tick.dropped);
        let phases = || self.arms.iter().map(|arm| arm.pending.as_ref().map(|sample| sample.phase));
        if scene.phases.iter().copied().eq(phases()) && !due(scene.diagnosed_at, DIAGNOSTICS_EVERY) {
            return Ok(());
        }
        let arms = self.arms.iter().zip(&self.names.arms);
        let condition =
            |(arm, names): (&ArmLog, &ArmNames)| Some(condition(&names.hardware_id, tick, arm.pending.as_ref()?));
        let mut status: Vec<_> = arms.filter_map(condition).collect();
        let figures = [
            ("late_us", (scene.late_ns / 1000).to_string()),
            ("skipped", scene.skipped.to_string()),
            ("dropped", scene.dropped.to_string()),
        ];
        let (level, text) = match (scene.dropped, scene.skipped) {
            (0, 0) => (0, "on time"),
            (0, _) => (1, "periods were skipped"),
            _ => (2, "samples were lost"),
        };
        status.push(diagnostic("tick", level, text.to_owned(), figures));
        *scene = SceneLog {
            robots: scene.robots.clone(),
            description: std::mem::take(&mut scene.description),
            objects: std::mem::take(&mut scene.objects),
            tf_at: scene.tf_at,
            diagnosed_at: Some(tick.deadline),
            phases: phases().collect(),
            ..SceneLog::default()
        };
        log.publish("/diagnostics", time, &DiagnosticArray { header, status })
    }
}

/// Returns the tool of the chain with a joint.
fn tools(chains: &TcpChains) -> impl Fn(usize) -> Isometry3<f64> {
    let tools: Vec<_> = lock(chains).iter().flatten().map(|chain| (chain.joints.clone(), chain.tool)).collect();
    move |joint| {
        tools.iter().find(|(joints, _)| joints.contains(&joint)).and_then(|(_, tool)| *tool).unwrap_or_default()
    }
}

/// Returns the condition of an arm.
fn condition(arm: &str, tick: &TickSample, sample: &ArmSample) -> DiagnosticStatus {
    let (s, phase) = (&sample.state, sample.phase);
    let level = match (phase, sample.cause) {
        _ if s.seq == 0 => 3,
        (Phase::Held | Phase::Standby, Cause::Operator | Cause::Shutdown | Cause::StopInput) => 1,
        (Phase::Held, _) => 2,
        (Phase::Standby, _) => 1,
        _ if s.link != Link::Up => 1,
        _ => 0,
    };
    let cause = cause_text(sample.cause);
    let text = if cause.is_empty() { phase.name().to_owned() } else { format!("{}: {cause}", phase.name()) };
    let values = [
        ("link", s.link.name().to_owned()),
        ("mode", s.mode.name().to_owned()),
        ("error", s.error.to_string()),
        ("age_ms", format!("{:.1}", tick.deadline.seconds_since(s.stamp) * 1e3)),
    ];
    DiagnosticStatus { hardware_id: arm.to_owned(), ..diagnostic(arm, level, text, values) }
}

fn diagnostic<const N: usize>(name: &str, level: u8, message: String, values: [(&str, String); N]) -> DiagnosticStatus {
    let values = values.map(|(key, value)| KeyValue { key: key.to_owned(), value }).into();
    DiagnosticStatus { level, name: name.to_owned(), message, values, ..DiagnosticStatus::default() }
}

/// Returns a marker at the origin of its frame.
fn upright() -> Marker {
    let mut marker = Marker::default();
    marker.pose.orientation.w = 1.0;
    marker
}
