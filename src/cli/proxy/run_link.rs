//! The connections of the proxy to its run, and what it knows of the arm.
//!
//! ```text
//!  RunArm ──▶ commands  lease, move, targets; a thread takes the replies
//!         ──▶ ends      stop and cancel, which always get through; a thread for each kind sends them
//!  View   ◀── state     a thread reads joints, pose, gripper, the motion's progress, and the status
//! ```

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};
use std::thread::sleep;
use std::time::{Duration, Instant};

use anyhow::Context;
use nalgebra::Isometry3;

use super::ends::Ends;
use super::replies::Commands;
use crate::cli::arguments;
use crate::cli::exit::Result;
use dimos_core::joint::Joints;
use dimos_core::pose::from_xyz_rpy;
use dimos_core::sync::lock;
use dimos_rpc::api::{Cancel, Motion, State, Status};
use dimos_rpc::client::{Client, ClientError};
use dimos_rpc::report::{ArmReport, ArmStateReport, StatusReport};

/// Period of reading the joints.
const STATE_PERIOD: Duration = Duration::from_millis(10);
/// Readings of the joints for each of the status.
const PER_STATUS: u32 = 4;
/// A gripper moves until its position has not changed for this long.
const GRIPPER_REST: Duration = Duration::from_millis(300);
/// Maximum number of notes that wait to be printed.
const MAX_NOTES: usize = 64;

/// Error codes of the controller for faults of the run.
pub mod code {
    /// An E-stop input of the box.
    pub const STOP_INPUT: u8 = 2;
    /// Faster than allowed, or a jump.
    pub const SPEED: u8 = 24;
    /// No path.
    pub const PLANNING: u8 = 25;
    /// A command was refused for another reason.
    pub const REFUSED: u8 = 27;
}

/// The arm as last read.
#[derive(Debug, Clone, Copy)]
pub struct View {
    pub position: Joints,
    pub velocity: Joints,
    pub effort: Joints,
    pub pose: Option<Isometry3<f64>>,
    pub wrench: Option<[f32; 6]>,
    /// When the joints were read.
    pub read_at: Instant,
    /// Opening of the gripper [m], and when it last changed.
    pub gripper: Option<(f64, Instant)>,
    pub enabled: bool,
    pub ready: bool,
    pub held: bool,
    /// Error code for the fault that holds the arm; 0 = none.
    pub fault: u8,
    /// When the latest status was asked for. Older ones than `not_before` do not count.
    pub status_at: Instant,
    pub not_before: Instant,
    /// Number of a stop that the run has not answered: until then the arm counts as held.
    pub stopping: Option<u64>,
    /// Whether the servo or the velocity task was aborted by the run.
    pub aborted: [bool; 2],
    /// The motion to watch, and whether one has ended: its number, and whether it reached its target.
    pub motion: Option<u64>,
    pub ended: Option<(u64, bool)>,
}

impl View {
    fn new() -> Self {
        let now = Instant::now();
        let zero = Joints::default();
        Self {
            position: zero,
            velocity: zero,
            effort: zero,
            pose: None,
            wrench: None,
            read_at: now,
            gripper: None,
            enabled: false,
            ready: false,
            held: false,
            fault: 0,
            status_at: now,
            not_before: now,
            stopping: None,
            aborted: [false; 2],
            motion: None,
            ended: None,
        }
    }

    /// Returns the opening of the gripper [m], and whether it moves.
    pub fn gripper_motion(&self, ordered: Option<Instant>) -> Option<(f64, bool)> {
        let (opening, changed) = self.gripper?;
        let recent = |at: Instant| at.elapsed() < GRIPPER_REST;
        Some((opening, recent(changed) || ordered.is_some_and(recent)))
    }

    fn take_state(&mut self, arm: &ArmStateReport) {
        self.read_at = Instant::now();
        for (i, joint) in arm.joints.iter().enumerate() {
            let values = [
                (&mut self.position, joint.position),
                (&mut self.velocity, joint.velocity),
                (&mut self.effort, joint.effort),
            ];
            for (to, value) in values {
                if let Some(to) = to.get_mut(i) {
                    *to = value.unwrap_or_default();
                }
            }
        }
        // As the vendor's program expects it: of the tool that is set at the controller, in the controller's frame.
        let own = arm.device_tool_pose.as_ref().or(arm.device_pose.as_ref());
        self.pose = own.map(|pose| from_xyz_rpy(pose.xyz, pose.rpy));
        self.wrench = arm.wrench.map(|values| values.map(|value| value as f32));
        self.gripper = arm.gripper.map(|opening| match self.gripper {
            Some((before, at)) if (before - opening).abs() < 1e-4 => (before, at),
            _ => (opening, Instant::now()),
        });
    }

    fn take_status(&mut self, arm: &ArmReport) {
        (self.enabled, self.ready, self.held) = (arm.enabled, arm.phase == "ready", arm.phase == "held");
        self.fault = if self.held { fault_code(arm) } else { 0 };
    }
}

/// Returns the controller's error code for the cause of a hold. A stop by an operator is a state, not an error.
fn fault_code(arm: &ArmReport) -> u8 {
    let cause = arm.cause.as_ref().map_or("", |cause| cause.name.as_str());
    let device = arm.error.as_ref().and_then(|error| u8::try_from(error.code).ok()).filter(|code| *code != 0);
    match (cause, device) {
        ("operator_stop" | "shutdown", _) => 0,
        ("stop_input", _) => code::STOP_INPUT,
        ("jump_refused", _) => code::SPEED,
        // Another arm's codes mean something else.
        ("arm_fault", Some(code)) if arm.adapter == "xarm" => code,
        _ => code::REFUSED,
    }
}

/// What the threads share.
#[derive(Debug)]
pub struct Shared {
    pub arm: String,
    /// The servo and the velocity task.
    pub streams: [Option<String>; 2],
    view: Mutex<View>,
    lost: Mutex<Option<ClientError>>,
    notes: Mutex<Vec<String>>,
    ending: AtomicBool,
}

impl Shared {
    /// Creates what the threads of an arm share.
    pub fn new(arm: &str, streams: [Option<String>; 2]) -> Self {
        Self {
            arm: arm.to_owned(),
            streams,
            view: Mutex::new(View::new()),
            lost: Mutex::new(None),
            notes: Mutex::new(Vec::new()),
            ending: AtomicBool::new(false),
        }
    }

    pub fn view(&self) -> MutexGuard<'_, View> {
        lock(&self.view)
    }

    /// Keeps a line for stderr.
    pub fn note(&self, text: impl Into<String>) {
        let mut notes = lock(&self.notes);
        if notes.len() < MAX_NOTES {
            notes.push(text.into());
        }
    }

    pub fn take_notes(&self) -> Vec<String> {
        std::mem::take(&mut lock(&self.notes))
    }

    /// Ends the proxy: the run does not answer.
    pub fn lose(&self, error: ClientError) {
        lock(&self.lost).get_or_insert(error);
    }

    pub fn take_loss(&self) -> Option<ClientError> {
        lock(&self.lost).take()
    }

    fn is_ending(&self) -> bool {
        self.ending.load(Ordering::Relaxed)
    }

    fn keep_status(&self, status: &StatusReport, asked_at: Instant) {
        let Some(arm) = status.arms.iter().find(|arm| arm.hardware_id == self.arm) else { return };
        let aborted = |name: &Option<String>| {
            let task = status.tasks.iter().find(|task| Some(&task.name) == name.as_ref());
            task.is_some_and(|task| matches!(task.state.as_str(), "ABORTED" | "FAULT"))
        };
        let mut view = self.view();
        if asked_at >= view.not_before && view.stopping.is_none() {
            view.take_status(arm);
            view.aborted = self.streams.each_ref().map(aborted);
            view.status_at = asked_at;
        }
    }
}

/// The connections; they end with it.
pub struct RunLink {
    pub shared: Arc<Shared>,
    pub commands: Arc<Mutex<Commands>>,
    ends: Ends,
}

impl RunLink {
    /// Connects to a run, and returns once an arm's state is known.
    pub fn open(run: &str, arm: &str, streams: [Option<String>; 2]) -> Result<Self> {
        let connect = || arguments::connect(Some(run));
        let shared = Arc::new(Shared::new(arm, streams));
        let (mut state, mut replies) = (connect()?, connect()?);
        read_state(&mut state, &shared)?;
        shared.keep_status(&state.call(Status {})?, Instant::now());
        let commands = Arc::new(Mutex::new(Commands::new(replies.sender()?)));
        start("proxy-state", &shared, move |shared| watch_state(&mut state, shared))?;
        let ends = Ends::start(&shared, [connect()?, connect()?])?;
        let taker = commands.clone();
        start("proxy-replies", &shared, move |shared| {
            loop {
                if let Some((id, result)) = replies.reply()? {
                    lock(&taker).take_reply(id, result, shared);
                }
            }
        })?;
        Ok(Self { shared, commands, ends })
    }

    /// Stops the arm. Until the run answers, it counts as held.
    pub fn stop(&self) {
        self.ends.stop(&self.shared);
    }

    /// Cancels motions, also beside clients that occupy all connections of the run.
    pub fn cancel(&self, cancel: Cancel) {
        self.ends.cancel(cancel);
    }
}

impl Drop for RunLink {
    fn drop(&mut self) {
        self.shared.ending.store(true, Ordering::Relaxed);
        lock(&self.commands).close();
    }
}

/// Starts a thread that ends with its connection.
pub(super) fn start(
    name: &str,
    shared: &Arc<Shared>,
    work: impl FnOnce(&Shared) -> std::result::Result<(), ClientError> + Send + 'static,
) -> Result<()> {
    let shared = shared.clone();
    let thread = std::thread::Builder::new().name(name.into()).spawn(move || {
        if let Err(error) = work(&shared) {
            shared.lose(error);
        }
    });
    thread.context("no thread for the connection to the run")?;
    Ok(())
}

fn read_state(client: &mut Client, shared: &Shared) -> std::result::Result<(), ClientError> {
    let state = client.call(State {})?;
    if let Some(arm) = state.arms.iter().find(|arm| arm.hardware_id == shared.arm) {
        shared.view().take_state(arm);
    }
    Ok(())
}

fn watch_state(client: &mut Client, shared: &Shared) -> std::result::Result<(), ClientError> {
    let mut next = Instant::now();
    for round in 0_u32.. {
        if shared.is_ending() {
            break;
        }
        read_state(client, shared)?;
        if round.is_multiple_of(PER_STATUS) {
            let asked_at = Instant::now();
            let status = client.call(Status {})?;
            shared.keep_status(&status, asked_at);
        }
        let motion = shared.view().motion;
        if let Some(motion) = motion {
            let report = client.call(Motion { motion })?;
            let mut view = shared.view();
            match report.next.filter(|_| report.done) {
                Some(next) if view.motion == Some(motion) => view.motion = Some(next),
                _ if report.done => {
                    view.ended = Some((motion, report.state == "COMPLETED"));
                    view.motion = view.motion.filter(|watched| *watched != motion);
                    drop(view);
                    if let Some(error) = report.error {
                        shared.note(format!("motion {motion}: {error}"));
                    }
                }
                _ => {}
            }
        }
        next = (next + STATE_PERIOD).max(Instant::now());
        sleep(next.saturating_duration_since(Instant::now()));
    }
    Ok(())
}
