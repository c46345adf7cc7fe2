//! Reassembles a log tick by tick: what each tick read, its requests, and its outputs.

use std::collections::BTreeMap;

use super::recorded::Recorded;
use super::requests;
use dimos_control::coordinator::TickTime;
use dimos_control::guard::Verdict;
use dimos_control::request::{Envelope, Request};
use dimos_core::arm::{ArmState, Commanded, EffortKind, Interference, JointSet, Link, VelocitySource};
use dimos_core::clock::Mono;
use dimos_core::joint::{ControlMode, Joints, MAX_DOF};
use dimos_core::telemetry::describe::Names;
use dimos_core::telemetry::{Guarded, Origin};
use dimos_log::cdr::{CdrError, Decoder, Encoder};
use dimos_log::messages::{ArmInput, ArmOutput, Event, JointState, Text, Tick};
use dimos_log::wire::{Field, Message};

/// Length of the header before every message [bytes].
const HEADER: usize = 4;
/// End of its time stamp [bytes].
const STAMP_END: usize = HEADER + 8;

/// Subject of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Topic {
    /// Joint values read.
    States,
    /// Joint values commanded.
    Commands,
    /// Messages on `/dimos/inputs/<arm>`: the rest of an arm's state.
    Input(usize),
    /// Messages on `/dimos/outputs/<arm>`: the rest of an arm's command.
    Output(usize),
    /// The end of a tick.
    Tick,
    /// An event.
    Event,
    /// A request.
    Request,
}

impl Topic {
    /// Returns the subject of a topic; `None` if it is no input or output of a tick.
    pub fn of(topic: &str, recorded: &Recorded) -> Option<Self> {
        let arm = |id: &str| recorded.names.arms.iter().position(|arm| arm.hardware_id == id);
        Some(match topic {
            "/joint_states" => Self::States,
            "/joint_commands" => Self::Commands,
            "/dimos/tick" => Self::Tick,
            "/dimos/events" => Self::Event,
            "/dimos/requests" => Self::Request,
            _ => match topic.strip_prefix("/dimos/inputs/") {
                Some(id) => Self::Input(arm(id)?),
                None => Self::Output(arm(topic.strip_prefix("/dimos/outputs/")?)?),
            },
        })
    }
}

/// One arm of a tick.
#[derive(Debug, Clone, Default)]
pub(super) struct LoggedArm {
    /// The state as the tick read it, without velocities that the tick estimated …
    pub state: ArmState,
    /// … which are here [rad/s].
    pub velocity: Joints,
    /// Command besides joint values, as of the latest message.
    pub output: ArmOutput,
    /// Whether that message belongs to this tick.
    pub output_is_new: bool,
}

/// A tick of a log.
#[derive(Debug, Default)]
pub(super) struct LoggedTick {
    /// Message on `/dimos/tick`.
    pub tick: Tick,
    /// Arms.
    pub arms: Vec<LoggedArm>,
    /// Commanded joint values.
    pub commands: JointState,
    /// Events.
    pub events: Vec<Event>,
}

impl LoggedTick {
    /// Returns the tick's times.
    pub fn time(&self) -> TickTime {
        TickTime {
            now: Mono(self.tick.deadline_ns),
            next: Mono(self.tick.next_ns),
            skipped: self.tick.skipped,
            late_ns: self.tick.overrun_ns,
            woke_late_ns: self.tick.late_ns,
        }
    }

    /// Returns the new verdicts of the collision guard: its world is not in the log, so they are inputs of the tick.
    pub fn guard_verdicts<'a>(&'a self, names: &'a Names) -> impl Iterator<Item = (u16, Verdict)> + 'a {
        let verdicts = self.events.iter().filter(|event| event.kind == "guard");
        verdicts.filter_map(|event| {
            let arm = names.arms.iter().position(|arm| arm.hardware_id == event.arm)? as u16;
            let distance = event.values.first().copied().filter(|_| event.status == "blocked");
            Some((arm, distance.map(|distance| Guarded { distance, ..Guarded::default() })))
        })
    }
}

/// Assembles ticks from messages.
#[derive(Debug)]
pub(super) struct Assembler {
    joints: Vec<String>,
    /// First joint and number of joints of each arm.
    spans: Vec<(usize, usize)>,
    /// The tick under assembly, or complete except for its events.
    pub logged: LoggedTick,
    closed: bool,
    /// Frame and joint names of messages with joint values: decoded once, then compared.
    names: Vec<u8>,
    /// Joint values read, until the tick is closed.
    states: JointState,
    waiting: BTreeMap<u64, Result<(Option<Origin>, Request), String>>,
}

impl Assembler {
    pub fn new(recorded: &Recorded) -> Self {
        let mut first = 0;
        let spans = (recorded.config.arms.iter())
            .map(|arm| {
                first += arm.dof;
                (first - arm.dof, arm.dof)
            })
            .collect();
        let arms = vec![LoggedArm::default(); recorded.config.arms.len()];
        Self {
            joints: recorded.joints(),
            spans,
            logged: LoggedTick { arms, ..LoggedTick::default() },
            closed: false,
            names: Vec::new(),
            states: JointState::default(),
            waiting: BTreeMap::new(),
        }
    }

    /// Returns whether a message on this topic belongs to a later tick, so that the current one is complete.
    pub fn completes(&self, topic: Topic) -> bool {
        self.closed && !matches!(topic, Topic::Event | Topic::Request)
    }

    /// Returns whether the tick is complete except, perhaps, for events.
    pub fn is_closed(&self) -> bool {
        self.closed
    }

    /// Prepares for the next tick.
    pub fn next(&mut self) {
        self.closed = false;
        self.logged.events.clear();
        self.logged.commands = JointState::default();
        self.logged.arms.iter_mut().for_each(|arm| arm.output_is_new = false);
        self.states = JointState::default();
    }

    /// Takes a message. The error describes what is wrong with it.
    pub fn take(&mut self, topic: Topic, bytes: &[u8]) -> Result<(), String> {
        self.decode(topic, bytes).map_err(|e| format!("{topic:?}: {e}"))
    }

    fn decode(&mut self, topic: Topic, bytes: &[u8]) -> Result<(), String> {
        match topic {
            Topic::States => self.states = self.joint_values(bytes)?,
            Topic::Commands => self.logged.commands = self.joint_values(bytes)?,
            Topic::Input(arm) => {
                let input: ArmInput = message(bytes)?;
                let arm = self.logged.arms.get_mut(arm).ok_or("unknown arm")?;
                read_input(&input, &mut arm.state)?;
            }
            Topic::Output(arm) => {
                let arm = self.logged.arms.get_mut(arm).ok_or("unknown arm")?;
                (arm.output, arm.output_is_new) = (message(bytes)?, true);
            }
            Topic::Tick => {
                self.logged.tick = message(bytes)?;
                self.fill_in_values();
                self.closed = true;
            }
            Topic::Event => self.logged.events.push(message(bytes)?),
            Topic::Request => {
                let line: Text = message(bytes)?;
                let (id, request) = requests::read(&line.data, &self.joints)?;
                self.waiting.insert(id, request);
            }
        }
        Ok(())
    }

    fn joint_values(&mut self, bytes: &[u8]) -> Result<JointState, String> {
        let known = !self.names.is_empty() && bytes.get(STAMP_END..).is_some_and(|rest| rest.starts_with(&self.names));
        let values = if known { self.lists(bytes).map_err(|e| e.to_string())? } else { self.first_values(bytes)? };
        let fits = |list: &[f64]| list.is_empty() || list.len() >= self.joints.len();
        if ![&values.position, &values.velocity, &values.effort].into_iter().all(|list| fits(list)) {
            return Err("the number of values differs from the number of joints".to_owned());
        }
        Ok(values)
    }

    /// Decodes a message whose names are new.
    fn first_values(&mut self, bytes: &[u8]) -> Result<JointState, String> {
        let values: JointState = message(bytes)?;
        // Grippers follow the joints.
        if !values.name.starts_with(&self.joints) {
            return Err("the joints differ from those of the run".to_owned());
        }
        let mut head = Encoder::default();
        values.header.put(&mut head);
        values.name.put(&mut head);
        self.names = head.bytes().get(STAMP_END..).unwrap_or_default().to_vec();
        Ok(values)
    }

    /// Decodes the lists of a message whose names are known.
    fn lists(&self, bytes: &[u8]) -> Result<JointState, CdrError> {
        let mut from = Decoder::new(bytes)?;
        from.skip(STAMP_END - HEADER + self.names.len())?;
        let mut list = || Vec::<f64>::get(&mut from);
        Ok(JointState { position: list()?, velocity: list()?, effort: list()?, ..JointState::default() })
    }

    /// The joint values of a state are in a separate message.
    fn fill_in_values(&mut self) {
        for (arm, &(first, dof)) in self.logged.arms.iter_mut().zip(&self.spans) {
            let state = &mut arm.state;
            let known = state.seq > 0;
            state.dof = if known { dof } else { 0 };
            let column = |list: &[f64]| values(list, first, dof).filter(|_| known).unwrap_or([0.0; MAX_DOF]);
            state.position = column(&self.states.position);
            arm.velocity = column(&self.states.velocity);
            state.effort = state.effort.and(values(&self.states.effort, first, dof));
            if state.velocity_source == VelocitySource::Measured {
                state.velocity = arm.velocity;
            }
        }
    }

    /// Appends the tick's requests in order. The error names a request that cannot be repeated.
    pub fn requests(&mut self, out: &mut Vec<Envelope>) -> Result<(), String> {
        out.clear();
        // The tick answers its own starts with id 0.
        for id in self.logged.events.iter().flat_map(|e| &e.request).copied().filter(|id| *id != 0) {
            let (origin, request) = match self.waiting.remove(&id) {
                Some(request) => request.map_err(|e| format!("request {id} cannot be read: {e}"))?,
                None => return Err(format!("request {id} is missing")),
            };
            out.push(Envelope { id, origin, request });
        }
        Ok(())
    }
}

fn message<M: Message>(bytes: &[u8]) -> Result<M, String> {
    M::decode(bytes).map_err(|e| e.to_string())
}

/// Returns the values of an arm's joints from those of all.
pub(super) fn values(list: &[f64], first: usize, dof: usize) -> Option<Joints> {
    list.get(first..first + dof).map(dimos_core::joint::joints_of)
}

/// Reads a state besides joint values. Skips the pose, which no tick uses.
fn read_input(input: &ArmInput, state: &mut ArmState) -> Result<(), String> {
    *state = ArmState {
        seq: input.seq,
        stamp: Mono(input.stamp_ns),
        // The tick estimates again what it estimated then.
        velocity_source: match source(&input.velocity_source)? {
            VelocitySource::Estimated => VelocitySource::Absent,
            other => other,
        },
        mode: mode(&input.mode)?,
        enabled: input.enabled,
        error: input.error,
        link: link(&input.link)?,
        self_held: input.self_held,
        written: input.written,
        interference: interference(&input.interference)?,
        own_delay_ns: input.own_delay_ns,
        stop_input_open: input.stop_input_open,
        gripper: input.gripper.first().copied(),
        commanded: (!input.commanded_position.is_empty()).then(|| Commanded {
            position: dimos_core::joint::joints_of(&input.commanded_position),
            velocity: dimos_core::joint::joints_of(&input.commanded_velocity),
        }),
        refused: input.refused,
        speed_fraction: input.speed_fraction.first().copied(),
        wrench: input.wrench.first_chunk().copied(),
        inputs: input.inputs.first().copied(),
        effort: input.has_effort.then_some([0.0; MAX_DOF]), // filled in with the joint values
        effort_kind: EffortKind::of_name(&input.effort_kind).unwrap_or_default(),
        missing: JointSet::of(input.missing.iter().map(|joint| usize::from(*joint))),
        ..ArmState::default()
    };
    Ok(())
}

fn interference(name: &str) -> Result<Interference, String> {
    Interference::of_name(name).ok_or_else(|| format!("{name:?} is not an interference"))
}

fn source(name: &str) -> Result<VelocitySource, String> {
    VelocitySource::of_name(name).ok_or_else(|| format!("{name:?} is not a source of velocities"))
}

fn link(name: &str) -> Result<Link, String> {
    Link::of_name(name).ok_or_else(|| format!("{name:?} is not a connection state"))
}

fn mode(name: &str) -> Result<ControlMode, String> {
    ControlMode::of_name(name).ok_or_else(|| format!("{name:?} is not a control mode"))
}
