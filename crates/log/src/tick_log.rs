//! Turns a tick's samples into messages: collects them until the tick is closed, then logs them with the tick's time.

use std::collections::BTreeMap;
use std::io::{Seek, Write};
use std::time::Duration;

use mcap::McapResult;

use super::arm_messages::{input, input_differs, output, output_differs, status};
use super::display_messages::DiagnosticArray;
use super::log_writer::LogWriter;
use super::messages::{
    ArmInput, ArmOutput, ArmStatus, Event, Header, JointState, Log, PoseStamped, Quaternion, Text, Tick, Time, Vector3,
    Wrench, WrenchStamped,
};
use super::scene_log::SceneLog;
use super::tcp_log::{TCP_EVERY, TcpChains};
use super::wire::Message;
use dimos_core::arm::{ArmCommand, ArmState, VelocitySource};
use dimos_core::clock::{Mono, WallOffset};
use dimos_core::joint::{ControlMode, Joints};
use dimos_core::sync::lock;
use dimos_core::telemetry::describe::{Described, Names, Severity};
use dimos_core::telemetry::{ArmSample, Cause, Origin, Phase, TickSample};

/// Maximum time between two messages on `/arm_status/<arm>`.
const STATUS_EVERY: Duration = Duration::from_millis(100);

/// The samples of the current tick, and the latest logged values of each arm.
pub struct TickLog {
    run: String,
    pub(super) names: Names,
    pub(super) frame_id: String,
    pub(super) wall: WallOffset,
    /// Messages of all arms, created once with their names and refilled for each tick. Grippers that were measured
    /// follow the joints in `states`.
    pub(super) states: JointState,
    commands: JointState,
    pub(super) arms: Vec<ArmLog>,
    /// The arms of these grippers.
    grippers: Vec<usize>,
    pub(super) scene: SceneLog,
    events: Vec<(u64, Described)>,
    /// Models of the arms' tool centre points.
    pub tcps: TcpChains,
    /// Samples dropped since the last closed tick because the end of their own tick was lost.
    given_up: u32,
}

#[derive(Default)]
pub(super) struct ArmLog {
    /// Sample of this arm since the last closed tick.
    pub(super) pending: Option<ArmSample>,
    state: Option<ArmState>,
    command: Option<ArmCommand>,
    status: Option<StatusKey>,
    status_at: Mono,
    tcp_at: Option<Mono>,
    /// Orientation of the latest tool centre point.
    tcp_turn: Option<Quaternion>,
    error_text: String,
    /// A new file begins with everything that is known of it.
    pub(super) fresh: bool,
}

impl ArmLog {
    /// Returns the state that the tick read, if any.
    pub(super) fn read(&self) -> Option<&ArmState> {
        self.pending.as_ref().map(|s| &s.state).filter(|s| s.seq > 0)
    }
}

/// Parts of an arm's status whose change is logged at once.
type StatusKey = (Phase, Cause, dimos_core::arm::Link, ControlMode, bool, i32, VelocitySource, bool, String);

impl TickLog {
    /// Creates one with nothing logged yet.
    pub fn new(run: String, names: Names, frame_id: String, wall: WallOffset) -> Self {
        let name = names.arms.iter().flat_map(|a| a.joints.clone()).collect();
        let states = JointState { name, ..JointState::default() };
        let arms = names.arms.iter().map(|_| ArmLog::default()).collect();
        let (commands, events, tcps) = (states.clone(), Vec::new(), TcpChains::default());
        let (grippers, scene) = (Vec::new(), SceneLog::default());
        Self { run, names, frame_id, wall, commands, states, arms, grippers, scene, events, tcps, given_up: 0 }
    }

    /// Returns metadata that readers need: the joints of each arm, and the offset between its monotonic times and Unix
    /// time.
    pub fn metadata(&self) -> BTreeMap<String, String> {
        let arms: serde_json::Map<_, _> =
            self.names.arms.iter().map(|a| (a.hardware_id.clone(), a.joints.clone().into())).collect();
        BTreeMap::from([
            ("run".into(), self.run.clone()),
            ("version".into(), env!("CARGO_PKG_VERSION").into()),
            ("arms".into(), serde_json::Value::Object(arms).to_string()),
            ("tasks".into(), serde_json::Value::from(self.names.tasks.clone()).to_string()),
            ("wall_offset_ns".into(), self.wall.wall(Mono::ZERO).to_string()),
        ])
    }

    /// Declares the topics that every log has.
    pub fn announce<W: Write + Seek>(&self, log: &mut LogWriter<W>) -> McapResult<()> {
        log.announce::<JointState>("/joint_states")?;
        log.announce::<JointState>("/joint_commands")?;
        for arm in &self.names.arms {
            let arm = &arm.hardware_id;
            log.announce::<ArmStatus>(&format!("/arm_status/{arm}"))?;
            log.announce::<ArmInput>(&format!("/dimos/inputs/{arm}"))?;
            log.announce::<ArmOutput>(&format!("/dimos/outputs/{arm}"))?;
        }
        log.announce::<DiagnosticArray>("/diagnostics")?;
        log.announce::<Tick>("/dimos/tick")?;
        log.announce::<Event>("/dimos/events")?;
        log.announce::<Text>("/dimos/requests")?;
        log.announce::<Log>("/rosout")
    }

    /// Takes an arm's sample.
    pub fn arm(&mut self, sample: ArmSample) {
        let older = self.arms.get_mut(usize::from(sample.arm)).and_then(|arm| arm.pending.replace(sample));
        self.given_up += u32::from(older.is_some());
    }

    /// Takes an event of the tick with this index.
    pub fn event(&mut self, tick: u64, described: Option<Described>) {
        self.events.extend(described.map(|d| (tick, d)));
    }

    /// Drops what was collected since the last closed tick: there is no log.
    pub fn clear(&mut self) {
        self.arms.iter_mut().for_each(|arm| arm.pending = None);
        self.events.clear();
        self.given_up = 0;
    }

    /// Takes an arm's text for its current error.
    pub fn arm_text(&mut self, arm: u16, text: String) {
        if let Some(arm) = self.arms.get_mut(usize::from(arm)) {
            arm.error_text = text;
        }
    }

    /// Logs a message of an arm's optional part on `/<topic>/<arm>`; `message` gets the names of its joints.
    pub fn part<M: Message, W: Write + Seek>(
        &self,
        log: &mut LogWriter<W>,
        arm: u16,
        topic: &str,
        stamp: Mono,
        message: impl FnOnce(Header, &[String]) -> M,
    ) -> McapResult<()> {
        let time = self.wall.wall(stamp);
        let header = Header { stamp: Time::of(time), frame_id: self.frame_id.clone() };
        let joints = self.names.arms.get(usize::from(arm)).map_or(&[][..], |arm| &arm.joints);
        log.publish(&format!("/{topic}/{}", self.names.arm(arm)), time, &message(header, joints))
    }

    /// Logs a request as passed to the tick.
    pub fn request<W: Write + Seek>(
        &self,
        log: &mut LogWriter<W>,
        (id, stamp, origin): (u64, Mono, Option<Origin>),
        json: &str,
    ) -> McapResult<()> {
        // A request that is not JSON is logged as text rather than lost.
        let request = serde_json::from_str(json).unwrap_or_else(|_| serde_json::Value::from(json));
        let mut message = serde_json::json!({ "id": id, "request": request });
        if let Some(origin) = origin {
            message["origin"] = serde_json::json!(origin);
        }
        log.publish("/dimos/requests", self.wall.wall(stamp), &Text { data: message.to_string() })
    }

    /// Logs a line of text.
    pub fn line<W: Write + Seek>(
        &self,
        log: &mut LogWriter<W>,
        severity: Severity,
        stamp: Mono,
        text: &str,
    ) -> McapResult<()> {
        let time = self.wall.wall(stamp);
        let level = match severity {
            Severity::Info => 20,
            Severity::Warn => 30,
            Severity::Error => 40,
        };
        let line =
            Log { stamp: Time::of(time), level, name: self.run.clone(), msg: text.to_owned(), ..Default::default() };
        log.publish("/rosout", time, &line)
    }

    /// Logs what was collected since the last closed tick. Returns the number of samples lost since then.
    pub fn close<W: Write + Seek>(&mut self, log: &mut LogWriter<W>, tick: &TickSample) -> McapResult<u32> {
        let mut tick = *tick;
        if tick.dropped > 0 {
            self.give_up_older(tick.deadline);
        }
        tick.dropped = tick.dropped.saturating_add(std::mem::take(&mut self.given_up));
        self.joint_states(log, &tick)?;
        self.joint_commands(log, &tick)?;
        self.scene(log, &tick)?;
        for index in 0..self.arms.len() {
            self.one_arm(log, &tick, index)?;
        }
        self.tick(log, &tick)?;
        if tick.dropped > 0 {
            let text = format!("{} samples are missing here: the recorder fell behind", tick.dropped);
            self.line(log, Severity::Warn, tick.deadline, &text)?;
        }
        for (index, d) in std::mem::take(&mut self.events) {
            self.line(log, d.severity, tick.deadline, &d.text)?;
            let time = self.wall.wall(tick.deadline);
            if d.severity == Severity::Error {
                log.flush_soon();
            }
            log.publish("/dimos/events", time, &self.event_message(&tick, index, d))?;
        }
        Ok(tick.dropped)
    }

    /// Drops samples of earlier ticks. A sample's own tick ended before its `next_tick`.
    fn give_up_older(&mut self, deadline: Mono) {
        for arm in &mut self.arms {
            let older = arm.pending.take_if(|s| s.command.next_tick <= deadline);
            self.given_up += u32::from(older.is_some());
        }
    }

    fn header(&self, tick: &TickSample) -> Header {
        Header { stamp: Time::of(self.wall.wall(tick.deadline)), frame_id: self.frame_id.clone() }
    }

    fn joint_states<W: Write + Seek>(&mut self, log: &mut LogWriter<W>, tick: &TickSample) -> McapResult<()> {
        if self.arms.iter().all(|arm| arm.read().is_none()) {
            return Ok(());
        }
        let velocity = |s: &ArmState| (s.velocity_source != VelocitySource::Absent).then_some(s.velocity);
        let mut message = std::mem::take(&mut self.states);
        message.header = self.header(tick);
        self.column(&mut message.position, |arm| arm.read().map(|s| s.position));
        self.column(&mut message.velocity, |arm| arm.read().and_then(velocity));
        self.column(&mut message.effort, |arm| arm.read().and_then(|s| s.effort));
        self.append_grippers(&mut message);
        self.states = message;
        log.publish("/joint_states", self.wall.wall(tick.deadline), &self.states)
    }

    /// Appends the positions of the grippers that have been measured.
    fn append_grippers(&mut self, states: &mut JointState) {
        for (index, arm) in self.arms.iter().enumerate() {
            if arm.read().is_some_and(|s| s.gripper.is_some()) && !self.grippers.contains(&index) {
                let driven = self.scene.robots.driven(index, 0.0).map(|(joint, _)| joint.to_owned());
                states.name.push(driven.unwrap_or_else(|| format!("{}_gripper", self.names.arm(index as u16))));
                self.grippers.push(index);
            }
        }
        for arm in &self.grippers {
            let state = self.arms.get(*arm).and_then(ArmLog::read);
            let position =
                state.and_then(|s| s.gripper).map(|at| self.scene.robots.driven(*arm, at).map_or(at, |d| d.1));
            let values = [position, None, state.and_then(|s| s.gripper_force)];
            for (column, value) in
                [&mut states.position, &mut states.velocity, &mut states.effort].into_iter().zip(values)
            {
                if !column.is_empty() {
                    column.push(value.unwrap_or(f64::NAN));
                }
            }
        }
    }

    fn joint_commands<W: Write + Seek>(&mut self, log: &mut LogWriter<W>, tick: &TickSample) -> McapResult<()> {
        let values = |arm: &ArmLog, wanted: fn(ControlMode) -> bool| {
            let command = &arm.pending.as_ref()?.command;
            command.mode.is_some_and(wanted).then_some(command.values)
        };
        let mut message = std::mem::take(&mut self.commands);
        message.header = self.header(tick);
        self.column(&mut message.position, |arm| values(arm, ControlMode::is_position));
        self.column(&mut message.velocity, |arm| values(arm, |mode| mode == ControlMode::Velocity));
        self.column(&mut message.effort, |arm| {
            let command = &arm.pending.as_ref()?.command;
            command.effort.filter(|_| command.mode.is_some())
        });
        self.commands = message;
        let message = &self.commands;
        if message.position.is_empty() && message.velocity.is_empty() && message.effort.is_empty() {
            return Ok(());
        }
        log.publish("/joint_commands", self.wall.wall(tick.deadline), message)
    }

    /// Returns one value per joint of all arms, NaN for arms without; empty if no arm has any.
    fn column(&self, column: &mut Vec<f64>, values: impl Fn(&ArmLog) -> Option<Joints>) {
        let mut any = false;
        column.clear();
        for (arm, names) in self.arms.iter().zip(&self.names.arms) {
            let values = values(arm);
            any |= values.is_some();
            let values = values.unwrap_or([f64::NAN; _]);
            column.extend(values.into_iter().take(names.joints.len()));
        }
        if !any {
            column.clear();
        }
    }

    fn one_arm<W: Write + Seek>(&mut self, log: &mut LogWriter<W>, tick: &TickSample, index: usize) -> McapResult<()> {
        let (time, header) = (self.wall.wall(tick.deadline), self.header(tick));
        let (Some(arm), Some(names)) = (self.arms.get_mut(index), self.names.arms.get(index)) else { return Ok(()) };
        let Some(sample) = arm.pending.take() else { return Ok(()) };
        let id = &names.hardware_id;
        let state = &sample.state;
        let is_new = arm.state.is_none_or(|last| last.seq != state.seq);
        let fresh = std::mem::take(&mut arm.fresh);
        if fresh || arm.state.is_none_or(|last| input_differs(&last, state)) {
            log.publish(&format!("/dimos/inputs/{id}"), time, &input(&header, tick.tick, state))?;
        }
        arm.state = Some(*state);
        if fresh || arm.command.is_none_or(|last| output_differs(&last, &sample.command)) {
            log.publish(
                &format!("/dimos/outputs/{id}"),
                time,
                &output(&header, tick.tick, &sample.command, names.joints.len()),
            )?;
        }
        arm.command = Some(sample.command);
        if let (true, Some(opening)) = (is_new, state.gripper) {
            let message = JointState {
                header: header.clone(),
                name: vec![format!("{id}_gripper")],
                position: vec![opening],
                effort: state.gripper_force.into_iter().collect(),
                ..Default::default()
            };
            log.publish(&format!("/gripper/{id}"), time, &message)?;
        }
        if let (true, Some([x, y, z, tx, ty, tz])) = (is_new, state.wrench) {
            let wrench = Wrench { force: Vector3 { x, y, z }, torque: Vector3 { x: tx, y: ty, z: tz } };
            log.publish(&format!("/wrench/{id}"), time, &WrenchStamped { header: header.clone(), wrench })?;
        }
        if is_new && state.seq > 0 && arm.tcp_at.is_none_or(|last| tick.deadline.since(last) >= TCP_EVERY) {
            // `states` has the values of this tick.
            let chains = lock(&self.tcps);
            let pose = chains.get(index).and_then(|chain| chain.as_ref()?.pose(&self.states.position));
            drop(chains);
            if let Some(mut pose) = pose {
                let (now, last) = (&mut pose.orientation, &arm.tcp_turn);
                // Of two quaternions of one orientation the one near the last: readers interpolate between them.
                if last.as_ref().is_some_and(|q| q.x * now.x + q.y * now.y + q.z * now.z + q.w * now.w < 0.0) {
                    *now = Quaternion { x: -now.x, y: -now.y, z: -now.z, w: -now.w };
                }
                arm.tcp_turn = Some(now.clone());
                let header = Header { frame_id: "map".to_owned(), ..header.clone() };
                log.publish(&format!("/tcp/{id}"), time, &PoseStamped { header, pose })?;
                arm.tcp_at = Some(tick.deadline);
            }
        }
        let key = status_key(&sample, arm);
        if fresh || arm.status.as_ref() != Some(&key) || tick.deadline.since(arm.status_at) >= STATUS_EVERY {
            log.publish(&format!("/arm_status/{id}"), time, &status(header, tick, &sample, &arm.error_text))?;
            arm.status = Some(key);
            arm.status_at = tick.deadline;
        }
        Ok(())
    }

    fn tick<W: Write + Seek>(&self, log: &mut LogWriter<W>, tick: &TickSample) -> McapResult<()> {
        let message = Tick {
            header: self.header(tick),
            tick: tick.tick,
            deadline_ns: tick.deadline.0,
            late_ns: tick.late_ns,
            compute_ns: tick.compute_ns,
            skipped: tick.skipped,
            overrun_ns: tick.overrun_ns,
            next_ns: tick.next.0,
            dropped: tick.dropped,
        };
        log.publish("/dimos/tick", self.wall.wall(tick.deadline), &message)
    }

    fn event_message(&self, closing: &TickSample, tick: u64, d: Described) -> Event {
        Event {
            header: self.header(closing),
            tick,
            kind: d.kind.into(),
            severity: d.severity.name().into(),
            request: d.request.into_iter().collect(),
            arm: d.arm.unwrap_or_default(),
            task: d.task.unwrap_or_default(),
            joint: d.joint.unwrap_or_default(),
            status: d.status.into(),
            values: d.values,
            text: d.text,
            by: d.by.unwrap_or_default(),
        }
    }
}

fn status_key(sample: &ArmSample, arm: &ArmLog) -> StatusKey {
    let s = &sample.state;
    let text = arm.error_text.clone();
    (sample.phase, sample.cause, s.link, s.mode, s.enabled, s.error, s.velocity_source, s.self_held, text)
}
