//! What a run does for those who talk to it: every rpc method, on top of requests to the tick and orders to the
//! device threads.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::Sender;
use std::sync::{Arc, Mutex, OnceLock};
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use super::Ending;
use super::dispatch::{Dispatcher, NotTold, lock, log_of};
use super::motions::{Motions, Planned};
use super::repeats::Repeats;
use crate::arm::{ArmState, Link};
use crate::blueprint::Blueprint;
use crate::clock::{Mono, WallOffset};
use crate::control::config::{CoordinatorConfig, TaskKind};
use crate::control::limit::Bounds;
use crate::control::point_to_point::{NoMotion, point_to_point};
use crate::control::request::{Motion, Request};
use crate::control::tick_loop::Pulse;
use crate::hardware::device::{Answer, Connected, Device};
use crate::hardware::spec::{AdapterError, AdapterResult};
use crate::joint::joints_of;
use crate::recording::recorder::{Notice, RecorderStats};
use crate::rpc::api::{self, Backend, BoxFuture, Done, Reply, Request as Call};
use crate::rpc::place::Claim;
use crate::rpc::streams::Streams;
use crate::rpc::{Code, RpcError, Subject};
use crate::rt::host::Grant;
use crate::rt::slot::SlotReader;
use crate::telemetry::describe::{ArmNames, Names};
use crate::telemetry::{ArmSample, Event, Outcome, Phase, TaskView};
use crate::trajectory::{JointTrajectory, Spline, TrajectoryPoint};

/// How long a stopped arm gets to come to rest and confirm.
const STOP_LIMIT: Duration = Duration::from_secs(3);
/// How long an order to a device may take.
const ORDER_LIMIT: Duration = Duration::from_secs(5);
/// How long an enabled arm gets to be ready.
const READY_LIMIT: Duration = Duration::from_secs(2);
/// How long a device takes to refuse an opening of its gripper.
const GRIPPER_REPLY: Duration = Duration::from_millis(20);
/// Trajectories may exceed a velocity or acceleration by this factor: rounding in files.
const SLACK: f64 = 1.001;
/// A joint slower than this stands still, for all that noise of its measurement tells [rad/s].
const STANDSTILL: f64 = 0.02;

/// What a service is made from.
pub struct ServiceParts {
    pub run: String,
    pub blueprint: Blueprint,
    pub config: CoordinatorConfig,
    pub names: Names,
    pub connected: Vec<Connected>,
    pub devices: Vec<Arc<Device>>,
    pub dispatcher: Arc<Dispatcher>,
    pub pulse: Arc<Pulse>,
    pub streams: Streams,
    pub arm_views: Mutex<Vec<SlotReader<ArmSample>>>,
    pub task_views: Mutex<Vec<SlotReader<TaskView>>>,
    pub grants: Vec<Grant>,
    pub wall: WallOffset,
    pub log: Option<PathBuf>,
    pub endings: Sender<Ending>,
}

/// The run, for those who talk to it.
pub struct Service {
    pub(super) parts: ServiceParts,
    pub(super) started: Instant,
    pub(super) motions: Mutex<Motions>,
    pub(super) recorder: OnceLock<Arc<RecorderStats>>,
    pub(super) repeats: Repeats,
    /// Ticks done when the joint state was published last.
    pub(super) published: AtomicU64,
    closed: AtomicBool,
    claim: Mutex<Option<Claim>>,
}

impl Service {
    pub fn new(parts: ServiceParts) -> Self {
        Self {
            parts,
            started: Instant::now(),
            motions: Mutex::default(),
            recorder: OnceLock::new(),
            repeats: Repeats::default(),
            published: AtomicU64::new(0),
            closed: AtomicBool::new(false),
            claim: Mutex::new(None),
        }
    }

    /// The recorder's figures, once there is one.
    pub fn set_recorder(&self, stats: Arc<RecorderStats>) {
        let _ = self.recorder.set(stats);
    }

    /// Keeps a run's name where no server does.
    pub fn keep(&self, claim: Claim) {
        *lock(&self.claim) = Some(claim);
    }

    /// From here on nothing new is taken.
    pub fn close(&self) {
        self.closed.store(true, Ordering::Release);
    }

    /// Length of a tick's period.
    pub fn period(&self) -> Duration {
        self.parts.config.period()
    }

    /// Phase of an arm after the last tick.
    pub fn phase(&self, arm: usize) -> Phase {
        self.arm_view(arm).map_or(Phase::Unknown, |s| s.phase)
    }

    /// The latest sample of an arm.
    pub(super) fn arm_view(&self, arm: usize) -> Option<ArmSample> {
        lock(&self.parts.arm_views).get_mut(arm).map(SlotReader::read)
    }

    /// Whether every arm that can be seen is measured to stand still.
    pub fn at_standstill(&self) -> bool {
        let still = |state: &ArmState| state.velocity.iter().take(state.dof).all(|v| v.abs() <= STANDSTILL);
        let mut views = lock(&self.parts.arm_views);
        views.iter_mut().map(SlotReader::read).all(|view| view.state.link != Link::Up || still(&view.state))
    }

    pub(super) fn task_view(&self, task: usize) -> TaskView {
        lock(&self.parts.task_views).get_mut(task).map(SlotReader::read).unwrap_or_default()
    }

    /// What the recorder tells, on the recorder's thread.
    pub fn notice(&self, notice: Notice<'_>, wall: WallOffset) {
        match notice {
            Notice::Event { tick, event, described } => {
                if let Event::Task(task, state, reason) = event {
                    let actual = self.positions();
                    lock(&self.motions).task_changed(*task, *state, *reason, &actual);
                }
                self.tell(tick, described, wall);
            }
            Notice::Lost(count) => tracing::warn!("the recorder fell behind: {count} samples are missing in the log"),
            Notice::Stopped(error) => tracing::error!("{error}"),
        }
    }

    /// Measured positions of all joints [rad].
    pub(super) fn positions(&self) -> Vec<f64> {
        let dofs = self.parts.config.arms.iter().map(|a| a.dof);
        let mut all = Vec::new();
        for (arm, dof) in dofs.enumerate() {
            let state = self.arm_view(arm).map(|s| s.state).unwrap_or_default();
            all.extend(state.position.iter().take(dof));
        }
        all
    }

    fn arm_index(&self, id: &str) -> Result<u16, RpcError> {
        let ids: Vec<&str> = self.parts.config.arms.iter().map(|a| a.name.as_str()).collect();
        match ids.iter().position(|a| *a == id) {
            Some(i) => Ok(i as u16),
            None => Err(RpcError::unknown(Code::UnknownArm, "arm", id, &ids)),
        }
    }

    fn task_index(&self, name: &str) -> Result<u16, RpcError> {
        match self.parts.names.tasks.iter().position(|t| t == name) {
            Some(i) => Ok(i as u16),
            None => Err(RpcError::unknown(Code::UnknownTask, "task", name, &self.parts.names.tasks)),
        }
    }

    /// Indices of an arm's joints over all arms.
    fn joints_of_arm(&self, arm: u16) -> std::ops::Range<u16> {
        let dofs = || self.parts.config.arms.iter().map(|a| a.dof as u16);
        let first = dofs().take(arm as usize).sum();
        first..first + dofs().nth(arm as usize).unwrap_or(0)
    }

    async fn ask(&self, request: Request) -> Result<Outcome, RpcError> {
        let log = log_of(&request);
        self.ask_logged(request, log).await
    }

    async fn ask_logged(&self, request: Request, log: Value) -> Result<Outcome, RpcError> {
        let outcome = self.parts.dispatcher.ask(request, log).await.map_err(|e| match e {
            NotTold::Full => RpcError::new(Code::NoAnswer, e.to_string()).hint("send fewer requests at once"),
            NotTold::NoAnswer => {
                RpcError::new(Code::NoAnswer, e.to_string()).hint("`dimos status` shows whether the run is alive")
            }
        })?;
        self.refusal(&outcome).map_or(Ok(outcome), Err)
    }

    /// A trajectory task that covers these joints.
    fn trajectory_task(&self, joints: &[u16]) -> Result<u16, RpcError> {
        let tasks = self.parts.config.tasks.iter().enumerate();
        let fitting = |(_, t): &(usize, &crate::control::config::TaskConfig)| {
            matches!(t.kind, TaskKind::Trajectory(_)) && joints.iter().all(|j| t.joints.contains(j))
        };
        match { tasks }.find(fitting) {
            Some((i, _)) => Ok(i as u16),
            None => Err(RpcError::new(Code::NoTrajectoryTask, "no trajectory task covers these joints")
                .hint("add one to the blueprint: `tasks: [{name: traj_arm, type: trajectory, …}]`")),
        }
    }

    async fn move_arm(&self, call: api::Move) -> Result<Reply, RpcError> {
        let arm = self.arm_index(&call.arm)?;
        let joints: Vec<u16> = self.joints_of_arm(arm).collect();
        let config = &self.parts.config.arms[arm as usize];
        if call.target.len() != joints.len() {
            let what = format!("{} has {} joints, the target {} values", call.arm, joints.len(), call.target.len());
            return Err(RpcError::new(Code::InvalidParams, what).hint("give one position [rad] per joint, in order"));
        }
        let task = self.trajectory_task(&joints)?;
        let Some(view) = self.arm_view(arm as usize).filter(|v| v.state.seq > 0) else {
            return self.refusal(&Outcome::StartStateUnavailable(arm)).map_or_else(|| Err(internal()), Err);
        };
        // Where positions are being commanded, the motion continues from the command, not from the sag below it.
        let from_command = view.command.mode.is_some_and(|m| m.is_position());
        let start = if from_command { view.command.values } else { view.state.position };
        let start = start.get(..config.dof).unwrap_or_default().to_vec();
        let names = self.parts.names.arms[arm as usize].joints.clone();
        let motion = point_to_point(&names, &start, &call.target, &config.limits, call.speed).map_err(|e| match e {
            NoMotion::OutOfLimits { ref joint, excess, .. } => {
                let data = json!({"joint": joint, "by": excess});
                RpcError::new(Code::OutOfLimits, e.to_string())
                    .hint("limits are the arm's own, narrowed by `limits` in the blueprint; commands stay 0.01 rad inside")
                    .data(data)
            }
            NoMotion::NotFound(_) => RpcError::new(Code::OutOfLimits, e.to_string()),
        })?;
        let duration = motion.duration();
        let number = self.begin(task, joints, &motion).await?;
        Ok(Reply::Move(api::MoveReply {
            motion: number,
            task: self.parts.names.task(task),
            duration,
            joints: names,
            start,
            target: call.target,
        }))
    }

    async fn execute(&self, call: api::Execute) -> Result<Reply, RpcError> {
        let trajectory = trajectory_of(call.trajectory);
        let all: Vec<&String> = self.parts.names.arms.iter().flat_map(|a| &a.joints).collect();
        let mut joints = Vec::new();
        for name in &trajectory.joint_names {
            match all.iter().position(|j| *j == name) {
                Some(j) => joints.push(j as u16),
                None => return Err(RpcError::unknown(Code::InvalidTrajectory, "joint", name, &all)),
            }
        }
        let task = match &call.task {
            Some(name) => self.task_index(name)?,
            None => self.trajectory_task(&joints)?,
        };
        let number = self.begin(task, joints, &trajectory).await?;
        let duration = trajectory.duration();
        Ok(Reply::Execute(api::ExecuteReply { motion: number, task: self.parts.names.task(task), duration }))
    }

    /// Hands a trajectory to its task. Everything about it is checked before anything moves.
    async fn begin(&self, task: u16, joints: Vec<u16>, trajectory: &JointTrajectory) -> Result<u64, RpcError> {
        let spline = Spline::new(trajectory).map_err(|e| RpcError::new(Code::InvalidTrajectory, e.to_string()))?;
        self.check_limits(&joints, &spline)?;
        let number = self.parts.dispatcher.number();
        let goal = (0..joints.len()).map(|k| spline.goal(k)).collect();
        let planned = Planned { task, joints: joints.clone(), goal, duration: spline.duration() };
        lock(&self.motions).plan(number, planned);
        let log = json!({"execute": {"task": task, "motion": number, "trajectory": trajectory}});
        let motion = Box::new(Motion { id: number, joints, spline });
        let result = self.ask_logged(Request::Execute { task, motion }, log).await;
        if result.is_err() {
            lock(&self.motions).forget(number);
        }
        result.map(|_| number)
    }

    /// F36: a trajectory that breaks a limit is refused before it begins, with the joint and the amount.
    fn check_limits(&self, joints: &[u16], spline: &Spline) -> Result<(), RpcError> {
        for (k, &joint) in joints.iter().enumerate() {
            let Some((arm, j)) = self.locate(joint) else { continue };
            let l = &self.parts.config.arms[arm].limits;
            let bounds =
                Bounds::inside(l.position_lower[j], l.position_upper[j], l.velocity_max[j], l.acceleration_max[j]);
            let e = spline.extremes(k);
            let name = self.parts.names.joint(joint);
            let refuse = |what: String, by: f64, hint: &str| {
                let data = json!({"joint": name.clone(), "by": by});
                Err(RpcError::new(Code::OutOfLimits, what).hint(hint.to_owned()).data(data))
            };
            let start = spline.start(k);
            let (lower, upper) = (bounds.lower.min(start), bounds.upper.max(start));
            let excess = (lower - e.lowest).max(e.highest - upper);
            if excess > 1e-6 {
                let what = format!("{name} would leave its limits {lower:.3} … {upper:.3} rad by {excess:.4} rad");
                return refuse(what, excess, "limits are the arm's own, narrowed by `limits` in the blueprint");
            }
            for (what, unit, got, most) in [
                ("as fast as", "rad/s", e.fastest, bounds.velocity),
                ("with an acceleration of", "rad/s²", e.steepest, bounds.acceleration),
            ] {
                if got > most * SLACK + 1e-9 {
                    let text = format!("{name} would move {what} {got:.3} {unit}, and may {most:.3} {unit}");
                    let slower = if unit == "rad/s" { got / most } else { (got / most).sqrt() };
                    let hint =
                        format!("make the trajectory {slower:.2} times as long, or raise the limit in the blueprint");
                    return refuse(text, got - most, &hint);
                }
            }
        }
        Ok(())
    }

    /// The arm of a joint, and its index there.
    pub(super) fn locate(&self, joint: u16) -> Option<(usize, usize)> {
        let mut left = joint as usize;
        for (i, arm) in self.parts.config.arms.iter().enumerate() {
            if left < arm.dof {
                return Some((i, left));
            }
            left -= arm.dof;
        }
        None
    }

    async fn cancel(&self, call: api::Cancel) -> Result<Reply, RpcError> {
        let arm = call.arm.as_deref().map(|a| self.arm_index(a)).transpose()?;
        let task = call.task.as_deref().map(|t| self.task_index(t)).transpose()?;
        let moves = |joints: &[u16]| arm.is_none_or(|a| joints.iter().any(|j| self.joints_of_arm(a).contains(j)));
        let mut tasks = BTreeMap::new();
        for (i, config) in self.parts.config.tasks.iter().enumerate() {
            if task.is_none_or(|t| t as usize == i) && moves(&config.joints) {
                let outcome = self.ask(Request::Cancel { task: Some(i as u16) }).await?;
                tasks.insert(config.name.clone(), outcome.name().to_owned());
            }
        }
        Ok(Reply::Cancel(api::CancelReply { tasks }))
    }

    async fn stop(&self, call: api::Stop) -> Result<Reply, RpcError> {
        let arm = call.arm.as_deref().map(|a| self.arm_index(a)).transpose()?;
        self.ask(Request::Stop { arm }).await?;
        let limit = Instant::now() + STOP_LIMIT;
        let mut arms = BTreeMap::new();
        for (i, config) in self.parts.config.arms.iter().enumerate() {
            if arm.is_some_and(|a| a as usize != i) {
                continue;
            }
            let confirmation = loop {
                match self.confirmation(i) {
                    Some(c) => break c,
                    None if Instant::now() >= limit => break api::Confirmation::SentNotConfirmed,
                    None => tokio::time::sleep(Duration::from_millis(5)).await,
                }
            };
            arms.insert(config.name.clone(), confirmation);
        }
        Ok(Reply::Stop(api::StopReply { arms }))
    }

    /// How far an arm's stop has come; `None`: not yet known.
    fn confirmation(&self, arm: usize) -> Option<api::Confirmation> {
        let (view, device) = (self.arm_view(arm)?, self.parts.devices.get(arm)?);
        if view.state.link != Link::Up {
            return Some(api::Confirmation::NotSent);
        }
        if !view.state.enabled {
            return Some(api::Confirmation::Confirmed); // Its motors are off: the arm itself says so.
        }
        let (asked, health) = (view.command.stop_seq, device.health());
        let is_asked = view.phase == Phase::Held && view.command.mode.is_none() && asked > 0;
        if !is_asked {
            return None;
        }
        if health.stop_confirmed.load(Ordering::Relaxed) == asked {
            return Some(api::Confirmation::Confirmed);
        }
        (health.stop_sent.load(Ordering::Relaxed) == asked).then_some(api::Confirmation::SentNotConfirmed)
    }

    async fn reset(&self, id: String) -> Result<Reply, RpcError> {
        let arm = self.arm_index(&id)?;
        let device = self.device(arm)?;
        let view = self.arm_view(arm as usize);
        if view.is_some_and(|v| v.phase == Phase::Held) {
            let cleared = order(device.clear_errors()).await;
            match cleared {
                Ok(()) | Err(AdapterError::NotConnected) => {}
                Err(e) => return Err(refused(&id, "did not clear its error", &e)),
            }
            // The next tick must see the state after the clearing.
            tokio::time::sleep(self.period() * 2).await;
        }
        self.ask(Request::Reset { arm }).await?;
        self.phase_reply(id, arm).await
    }

    async fn enable(&self, id: String) -> Result<Reply, RpcError> {
        let arm = self.arm_index(&id)?;
        let view = self.arm_view(arm as usize).ok_or_else(internal)?;
        match view.phase {
            Phase::Held => {
                let outcome = Outcome::ArmLatched(arm, view.cause);
                return self.refusal(&outcome).map_or_else(|| Err(internal()), Err);
            }
            Phase::Ready | Phase::Activating => {}
            _ => {
                order(self.device(arm)?.activate()).await.map_err(|e| refused(&id, "was not enabled", &e))?;
                self.ask(Request::Ready { arm }).await?;
            }
        }
        let limit = Instant::now() + READY_LIMIT;
        while self.phase(arm as usize) != Phase::Ready && Instant::now() < limit {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        self.phase_reply(id, arm).await
    }

    async fn disable(&self, id: String) -> Result<Reply, RpcError> {
        let arm = self.arm_index(&id)?;
        self.ask(Request::Park { arm }).await?;
        let limit = Instant::now() + STOP_LIMIT;
        while self.arm_view(arm as usize).is_some_and(|v| v.command.mode.is_some()) && Instant::now() < limit {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        order(self.device(arm)?.disable()).await.map_err(|e| refused(&id, "was not disabled", &e))?;
        tokio::time::sleep(self.period() * 2).await;
        self.phase_reply(id, arm).await
    }

    async fn phase_reply(&self, arm: String, index: u16) -> Result<Reply, RpcError> {
        tokio::time::sleep(self.period()).await;
        Ok(Reply::ArmReset(api::ArmReply { arm, phase: self.phase(index as usize).name().to_owned() }))
    }

    fn device(&self, arm: u16) -> Result<Arc<Device>, RpcError> {
        self.parts.devices.get(arm as usize).cloned().ok_or_else(internal)
    }

    async fn gripper(&self, call: api::Gripper) -> Result<Reply, RpcError> {
        let arm = self.arm_index(&call.arm)?;
        if self.arm_view(arm as usize).is_some_and(|v| v.state.gripper.is_none()) {
            return self.refusal(&Outcome::NoGripper(arm)).map_or_else(|| Err(internal()), Err);
        }
        let device = self.device(arm)?;
        let refusals = device.health().write_errors.load(Ordering::Relaxed);
        self.ask(Request::Gripper { arm, opening: call.position }).await?;
        // The tick hands the opening over without knowing what the gripper can do; the arm says so at once.
        tokio::time::sleep(self.period() + GRIPPER_REPLY).await;
        if device.health().write_errors.load(Ordering::Relaxed) > refusals {
            let why = device.health().episodes().pop().map_or_else(String::new, |e| e.text);
            let error = RpcError::new(Code::DeviceRefused, format!("{}: {why}", call.arm));
            return Err(error.hint("`dimos state` shows the gripper's opening now, in metres"));
        }
        Ok(Reply::Gripper(Done {}))
    }

    async fn stream(&self, task: String, values: Vec<f64>, positions: bool) -> Result<(), RpcError> {
        let index = self.task_index(&task)?;
        let width = self.parts.config.tasks[index as usize].joints.len();
        if values.len() != width {
            let what = format!("{task} has {width} joints, the target {} values", values.len());
            return Err(RpcError::new(Code::InvalidParams, what));
        }
        let target = joints_of(&values);
        self.ask(match positions {
            true => Request::Servo { task: index, target },
            false => Request::Velocity { task: index, target },
        })
        .await?;
        Ok(())
    }

    async fn answer(&self, call: Call) -> Result<Reply, RpcError> {
        let changes = !matches!(call, Call::Status(_) | Call::State(_) | Call::Motion(_));
        if changes && self.closed.load(Ordering::Acquire) {
            return self.refusal(&Outcome::ShuttingDown).map_or_else(|| Err(internal()), Err);
        }
        match call {
            Call::Status(_) => Ok(Reply::Status(self.status())),
            Call::State(_) => Ok(Reply::State(self.state())),
            Call::Motion(m) => self.motion(m.motion).map(Reply::Motion),
            Call::Move(m) => self.move_arm(m).await,
            Call::Execute(e) => self.execute(e).await,
            Call::Cancel(c) => self.cancel(c).await,
            Call::Stop(s) => self.stop(s).await,
            Call::ArmReset(a) => self.reset(a.arm).await,
            Call::ArmEnable(a) => self.enable(a.arm).await,
            Call::ArmDisable(a) => self.disable(a.arm).await,
            Call::Gripper(g) => self.gripper(g).await,
            Call::Servo(s) => self.stream(s.task, s.positions, true).await.map(|()| Reply::Servo(Done {})),
            Call::Velocity(v) => self.stream(v.task, v.velocities, false).await.map(|()| Reply::Velocity(Done {})),
            Call::Shutdown(_) => {
                let _ = self.parts.endings.send(Ending::Asked);
                Ok(Reply::Shutdown(Done {}))
            }
        }
    }

    pub(super) fn now(&self) -> Mono {
        crate::clock::Clock::now(&crate::clock::MonotonicClock)
    }
}

impl Backend for Service {
    fn call(&self, request: Call) -> BoxFuture<'_, Result<Reply, RpcError>> {
        Box::pin(self.answer(request))
    }

    fn arms_of(&self, subject: Subject<'_>) -> Vec<String> {
        let tasks = &self.parts.config.tasks;
        let is_meant = |(i, arm): &(usize, &ArmNames)| match subject {
            Subject::All => true,
            Subject::Arm(id) => arm.hardware_id == id,
            Subject::Joints(joints) => joints.iter().any(|j| arm.joints.contains(j)),
            Subject::Task(name) => {
                let range = self.joints_of_arm(*i as u16);
                tasks.iter().any(|t| t.name == name && t.joints.iter().any(|j| range.contains(j)))
            }
        };
        let arms = self.parts.names.arms.iter().enumerate().filter(is_meant);
        arms.map(|(_, arm)| arm.hardware_id.clone()).collect()
    }

    fn streams(&self) -> &Streams {
        &self.parts.streams
    }
}

/// Waits for a device without holding up the others who talk to the run.
async fn order<T: Send + 'static>(answer: Answer<T>) -> AdapterResult<T> {
    let waited = tokio::task::spawn_blocking(move || answer.wait(ORDER_LIMIT)).await;
    waited.unwrap_or_else(|e| Err(AdapterError::Io(e.to_string())))
}

fn refused(arm: &str, what: &str, error: &AdapterError) -> RpcError {
    RpcError::new(Code::DeviceRefused, format!("{arm} {what}: {error}"))
        .hint("see the arm's own panel or manual; `dimos status` shows its link and error")
}

fn internal() -> RpcError {
    RpcError::new(Code::Internal, "an arm of this run is not there: a defect of the program")
}

fn trajectory_of(given: api::Trajectory) -> JointTrajectory {
    let points = given.points.into_iter().map(|p| TrajectoryPoint {
        time_from_start: p.time_from_start,
        positions: p.positions,
        velocities: p.velocities.unwrap_or_default(),
        accelerations: p.accelerations.unwrap_or_default(),
    });
    JointTrajectory { points: points.collect(), joint_names: given.joint_names }
}
