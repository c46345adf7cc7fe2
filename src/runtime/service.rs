//! The service of a run: answers every rpc method with requests to the tick and orders to the device threads.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::Sender;
use std::sync::{Arc, Mutex, OnceLock, Weak};
use std::time::{Duration, Instant};

use nalgebra::Isometry3;

use super::Ending;
use super::arm::late_stops::LateStops;
use super::arm::model_check::Checked;
use super::arm::serial_locks::SerialLocks;
use super::client::asker::asked_by;
use super::client::dispatch::{Dispatcher, SendError, log_of};
use super::client::lease_changes::UnsentEnds;
use super::client::waiting::Progress;
use super::gripper::gripper_requests::LatestGrip;
use super::gripper::gripper_targets::{Counters, GripperTargets};
use super::log::log_throttle::LogThrottle;
use super::log::logged_scene::{Described, LoggedWorld};
use super::motion::going::Goings;
use super::motion::motions::Motions;
use super::plan::guard_worlds::GuardWorlds;
use super::plan::planner_link::Attached;
use super::plan::planner_port::PlannerPort;
use super::tool::payloads::HeldLoads;
use crate::blueprint::Blueprint;
use dimos_control::config::CoordinatorConfig;
use dimos_control::request::Request;
use dimos_control::tick_loop::Pulse;
use dimos_core::arm::{ArmState, Link};
use dimos_core::clock::{Mono, WallOffset};
use dimos_core::joint::STANDSTILL;
use dimos_core::sync::lock;
use dimos_core::telemetry::describe::{ArmNames, Names};
use dimos_core::telemetry::{ArmSample, Event, Origin, Outcome, Phase, TaskView, Who};
use dimos_hardware::device::{Connected, Details, Device};
use dimos_log::recorder::{Notice, RecorderStats};
use dimos_log::tcp_log::TcpChains;
use dimos_rpc::api::{self, Backend, BoxFuture, Done, FaceReport, RegisterPlanner, Registered, Reply, Request as Call};
use dimos_rpc::report::StatusReport;
use dimos_rpc::run_dir::Claim;
use dimos_rpc::server::planner_proxy::PlannerProxy;
use dimos_rpc::server::streams::Streams;
use dimos_rpc::{Code, RpcError, Subject};
use dimos_rt::host::{self, Grant};
use dimos_rt::slot::SlotReader;

/// Parts of a service.
pub struct ServiceParts {
    pub run: String,
    pub blueprint: Blueprint,
    pub config: CoordinatorConfig,
    pub names: Names,
    pub connected: Vec<Connected>,
    /// Per arm, what is to be said of its factory kinematics.
    pub kinematics: Vec<Option<String>>,
    /// Per arm, whether only a program on this computer can be at its address.
    pub local: Vec<bool>,
    pub devices: Vec<Arc<Device>>,
    pub serials: Arc<SerialLocks>,
    pub dispatcher: Arc<Dispatcher>,
    pub pulse: Arc<Pulse>,
    pub streams: Streams,
    pub arm_views: Mutex<Vec<SlotReader<ArmSample>>>,
    pub task_views: Mutex<Vec<SlotReader<TaskView>>>,
    pub grants: Vec<Grant>,
    pub wall: WallOffset,
    pub log: Option<PathBuf>,
    pub endings: Sender<Ending>,
    pub planner: Option<PlannerPort>,
    /// The collision guard of streams.
    pub guard: Option<Arc<GuardWorlds>>,
    /// What the run prints, if it is kept.
    pub text: Option<api::TextLines>,
}

/// The run, for its clients.
pub struct Service {
    pub(in crate::runtime) parts: ServiceParts,
    pub(in crate::runtime) started: Instant,
    pub(in crate::runtime) motions: Mutex<Motions>,
    /// The requests `go`.
    pub(in crate::runtime) goings: Goings,
    pub(in crate::runtime) recorder: OnceLock<Arc<RecorderStats>>,
    /// The logs of faults, of a run that is not recorded.
    pub(in crate::runtime) fault_logs: Mutex<Vec<PathBuf>>,
    /// Address of the live view.
    pub(in crate::runtime) view: OnceLock<String>,
    /// The arms' tool centre points, for the log.
    pub(in crate::runtime) logged_tcps: TcpChains,
    /// The robots with their names in the run.
    pub(in crate::runtime) described: OnceLock<Described>,
    /// The objects of the world, as logged.
    pub(in crate::runtime) logged_world: Mutex<LoggedWorld>,
    pub(in crate::runtime) log_throttle: LogThrottle,
    pub(in crate::runtime) late_stops: LateStops,
    pub(in crate::runtime) unsent_ends: UnsentEnds,
    /// Per arm, the number of stops that clients have ordered.
    pub(in crate::runtime) stops: Vec<AtomicU64>,
    pub(in crate::runtime) progress: Progress,
    /// One gripper order per arm at a time, so that each gets its own answer.
    pub(in crate::runtime) grippers: Vec<tokio::sync::Mutex<()>>,
    /// Per arm, whether its own controller moves it.
    pub(in crate::runtime) natives: Vec<AtomicBool>,
    /// Per arm, the latest gripper command.
    pub(in crate::runtime) grips: Vec<Mutex<LatestGrip>>,
    /// Per arm, the gripper targets of streams.
    pub(in crate::runtime) gripper_targets: Vec<Mutex<GripperTargets>>,
    /// Per task, what its streams sent.
    pub(in crate::runtime) counters: Vec<Counters>,
    /// Per arm, the numbers of the slowly changing values that were logged last.
    pub(in crate::runtime) details_logged: Mutex<Vec<Details>>,
    /// Per arm, the objects that it holds and whose mass is known. Locked while a load is set.
    pub(in crate::runtime) held_loads: Vec<tokio::sync::Mutex<HeldLoads>>,
    /// Number of ticks when the joint state was last published.
    pub(in crate::runtime) published: AtomicU64,
    /// Per arm, where model and controller have the flange.
    pub(in crate::runtime) checks: Mutex<Vec<Checked>>,
    /// The attached planner, also after it disconnected.
    pub(in crate::runtime) attached: Mutex<Option<Arc<Attached>>>,
    /// The last executed plan, and its motion.
    pub(in crate::runtime) executed: Mutex<Option<(u64, u64)>>,
    /// Per task, the tool of its end effector.
    pub(in crate::runtime) task_tools: Mutex<Vec<Option<Isometry3<f64>>>>,
    /// Per task, whether a client has sent it a target since its stream was last ended for a motion.
    pub(in crate::runtime) streamed: Vec<AtomicBool>,
    /// Requests of plans, by the plans' numbers.
    pub(in crate::runtime) plan_requests: Mutex<BTreeMap<u64, (api::Plan, Origin)>>,
    pub(in crate::runtime) me: Weak<Self>,
    closed: AtomicBool,
    /// Whether the tick still runs: stops are accepted although the run is closed.
    stoppable: AtomicBool,
    /// A client cancelled motion after the run was closed.
    cancelled: AtomicBool,
    claim: Mutex<Option<Claim>>,
}

impl Service {
    pub fn new(parts: ServiceParts, me: Weak<Self>) -> Self {
        Self {
            progress: Progress::default(),
            grippers: parts.devices.iter().map(|_| tokio::sync::Mutex::default()).collect(),
            stops: parts.devices.iter().map(|_| AtomicU64::new(0)).collect(),
            natives: parts.devices.iter().map(|_| AtomicBool::default()).collect(),
            grips: parts.devices.iter().map(|_| Mutex::default()).collect(),
            gripper_targets: parts.devices.iter().map(|_| Mutex::default()).collect(),
            counters: parts.config.tasks.iter().map(|_| Counters::default()).collect(),
            details_logged: Mutex::new(vec![Details::default(); parts.devices.len()]),
            task_tools: Mutex::new(parts.blueprint.tasks.iter().map(|task| task.robot.as_ref()?.tool).collect()),
            checks: Mutex::new(vec![Checked::default(); parts.devices.len()]),
            held_loads: parts.devices.iter().map(|_| tokio::sync::Mutex::default()).collect(),
            streamed: parts.config.tasks.iter().map(|_| AtomicBool::default()).collect(),
            parts,
            started: Instant::now(),
            motions: Mutex::default(),
            goings: Goings::default(),
            recorder: OnceLock::new(),
            fault_logs: Mutex::default(),
            view: OnceLock::new(),
            logged_tcps: TcpChains::default(),
            described: OnceLock::new(),
            logged_world: Mutex::default(),
            log_throttle: LogThrottle::default(),
            late_stops: LateStops::default(),
            unsent_ends: UnsentEnds::default(),
            published: AtomicU64::new(0),
            attached: Mutex::default(),
            executed: Mutex::default(),
            plan_requests: Mutex::default(),
            me,
            closed: AtomicBool::new(false),
            stoppable: AtomicBool::new(true),
            cancelled: AtomicBool::new(false),
            claim: Mutex::new(None),
        }
    }

    /// Sets the recorder's statistics.
    pub fn set_recorder(&self, stats: Arc<RecorderStats>) {
        let _ = self.recorder.set(stats);
    }

    /// Keeps the lock on the run's name if there is no server.
    pub fn keep(&self, claim: Claim) {
        *lock(&self.claim) = Some(claim);
    }

    /// Rejects new requests from now on.
    pub fn close(&self) {
        self.closed.store(true, Ordering::Release);
    }

    /// Accepts no more stops: the tick ends.
    pub fn end_stops(&self) {
        self.stoppable.store(false, Ordering::Release);
    }

    /// Returns whether a client cancelled motion after the run was closed.
    pub fn was_cancelled(&self) -> bool {
        self.cancelled.load(Ordering::Acquire)
    }

    /// Returns whether the run is shutting down.
    pub fn is_closed(&self) -> bool {
        self.closed.load(Ordering::Acquire)
    }

    /// Returns the period of the tick.
    pub fn period(&self) -> Duration {
        self.parts.config.period()
    }

    /// Returns the phase of an arm after the last tick.
    pub fn phase(&self, arm: usize) -> Phase {
        self.arm_view(arm).map_or(Phase::Unknown, |s| s.phase)
    }

    /// Returns the latest sample of an arm.
    pub(in crate::runtime) fn arm_view(&self, arm: usize) -> Option<ArmSample> {
        lock(&self.parts.arm_views).get_mut(arm).map(SlotReader::read)
    }

    /// Returns whether every arm with known state is measured at rest.
    pub fn at_standstill(&self) -> bool {
        let still = |state: &ArmState| state.velocity.iter().take(state.dof).all(|v| v.abs() <= STANDSTILL);
        let mut views = lock(&self.parts.arm_views);
        views.iter_mut().map(SlotReader::read).all(|view| view.state.link != Link::Up || still(&view.state))
    }

    pub(in crate::runtime) fn task_view(&self, task: usize) -> TaskView {
        lock(&self.parts.task_views).get_mut(task).map(SlotReader::read).unwrap_or_default()
    }

    /// Handles a notice of the recorder, on the recorder's thread.
    pub fn notice(&self, notice: Notice<'_>, wall: WallOffset) {
        match notice {
            Notice::Event { tick, event, described } => {
                if let Event::Task(task, state, reason) = event {
                    let actual = self.positions();
                    lock(&self.motions).task_changed(*task, (tick, *state, *reason), &actual);
                }
                self.report_event(tick, described, wall);
            }
            Notice::Lost(count) => tracing::warn!("the recorder fell behind: {count} samples are missing in the log"),
            Notice::Unsynced(after) => tracing::warn!(
                "the log is closed, but its disk has not stored all of it after {} s; keep the power on",
                after.as_secs()
            ),
            Notice::Fault(Ok(path)) => {
                tracing::warn!("the time before and after the fault is in the log {}", path.display());
                lock(&self.fault_logs).push(path.to_owned());
            }
            Notice::Fault(Err(error)) => tracing::warn!("there is no log of the fault: {error}"),
            Notice::Stopped(error) => {
                tracing::error!("{error}");
                let first = error.to_string().lines().next().unwrap_or_default().to_owned();
                let _ = self.parts.endings.send(Ending::Log(first));
            }
        }
    }

    /// Returns the measured positions of all joints [rad].
    pub(in crate::runtime) fn positions(&self) -> Vec<f64> {
        let dofs = self.parts.config.arms.iter().map(|a| a.dof);
        let mut all = Vec::new();
        for (arm, dof) in dofs.enumerate() {
            let state = self.arm_view(arm).map(|s| s.state).unwrap_or_default();
            all.extend(state.position.iter().take(dof));
        }
        all
    }

    pub(in crate::runtime) fn arm_index(&self, id: &str) -> Result<u16, RpcError> {
        let ids: Vec<&str> = self.parts.config.arms.iter().map(|a| a.name.as_str()).collect();
        match ids.iter().position(|a| *a == id) {
            Some(i) => Ok(i as u16),
            None => Err(RpcError::unknown(Code::UnknownArm, "arm", id, &ids)),
        }
    }

    pub(in crate::runtime) fn task_index(&self, name: &str) -> Result<u16, RpcError> {
        match self.parts.names.tasks.iter().position(|t| t == name) {
            Some(i) => Ok(i as u16),
            None => Err(RpcError::unknown(Code::UnknownTask, "task", name, &self.parts.names.tasks)),
        }
    }

    /// Returns the indices of an arm's joints over all arms.
    pub(in crate::runtime) fn joints_of_arm(&self, arm: u16) -> std::ops::Range<u16> {
        let dofs = || self.parts.config.arms.iter().map(|a| a.dof as u16);
        let first = dofs().take(arm as usize).sum();
        first..first + dofs().nth(arm as usize).unwrap_or(0)
    }

    /// Asks something that moves no arm.
    pub(in crate::runtime) async fn ask(&self, request: Request) -> Result<Outcome, RpcError> {
        self.ask_from(request, None).await
    }

    /// Asks something that a client requested, when and by whom.
    pub(in crate::runtime) async fn ask_from(
        &self,
        request: Request,
        origin: Option<Origin>,
    ) -> Result<Outcome, RpcError> {
        let log = log_of(&request);
        self.outcome(self.parts.dispatcher.ask(request, origin, log).await)
    }

    /// Returns the outcome of a request, or an error if there is none.
    pub(in crate::runtime) fn outcome(&self, answer: Result<Outcome, SendError>) -> Result<Outcome, RpcError> {
        let outcome = answer.map_err(|e| self.not_sent(e))?;
        self.refusal(&outcome).map_or(Ok(outcome), Err)
    }

    /// Returns why a request got no outcome as an error.
    pub(in crate::runtime) fn not_sent(&self, error: SendError) -> RpcError {
        let hint = match error {
            SendError::Full => "send fewer requests at once",
            SendError::NoAnswer => "`dimos status` shows whether the run is alive",
            SendError::Ended => return RpcError::new(Code::Superseded, error.to_string()),
        };
        RpcError::new(Code::NoAnswer, error.to_string()).hint(hint)
    }

    /// Returns the arm of a joint, and the joint's index in the arm.
    pub(in crate::runtime) fn locate(&self, joint: u16) -> Option<(usize, usize)> {
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
        if call.plan.is_some() {
            let planning = self.cancel_planning(call.plan).await;
            return Ok(Reply::Cancel(api::CancelReply { planning, ..Default::default() }));
        }
        if let Some(going) = call.going {
            return self.cancel_going(going).await.map(Reply::Cancel);
        }
        let arm = call.arm.as_deref().map(|a| self.arm_index(a)).transpose()?;
        let task = call.task.as_deref().map(|t| self.task_index(t)).transpose()?;
        let moves = |joints: &[u16]| arm.is_none_or(|a| joints.iter().any(|j| self.joints_of_arm(a).contains(j)));
        // First: nothing of them begins after this.
        self.end_goings(arm, task);
        let mut tasks = BTreeMap::new();
        for (i, config) in self.parts.config.tasks.iter().enumerate() {
            if task.is_none_or(|t| t as usize == i) && moves(&config.joints) {
                lock(&self.motions).end_replanning("cancelled", |planned| usize::from(planned.task) == i);
                let outcome = self.ask(Request::Cancel { task: Some(i as u16) }).await?;
                tasks.insert(config.name.clone(), outcome.name().to_owned());
            }
        }
        if task.is_none() && self.cancel_natives(|native| arm.is_none_or(|arm| arm == native)).await? {
            tasks.insert("native".to_owned(), Outcome::Cancelled.name().to_owned());
        }
        // Last: a planner in another process may be slow.
        let planning = call.task.is_none() && self.cancel_planning(None).await;
        Ok(Reply::Cancel(api::CancelReply { tasks, planning }))
    }

    /// Sets the speed override, and returns it.
    async fn set_speed(&self, call: api::Speed) -> Result<api::SpeedReport, RpcError> {
        if let Some(fraction) = call.fraction {
            self.ask(Request::Speed { fraction }).await?;
        }
        if let Some(on) = call.paused {
            self.ask(Request::Pause { on }).await?;
        }
        Ok(self.speed_override())
    }

    pub(in crate::runtime) async fn answer(&self, call: Call, origin: Origin) -> Result<Reply, RpcError> {
        let reads = matches!(
            call,
            Call::Status(_) | Call::State(_) | Call::TextLog(_) | Call::Motion(_) | Call::Going(_) | Call::Grip(_)
        );
        if !reads && self.is_closed() {
            let stops = self.stoppable.load(Ordering::Acquire);
            match call {
                Call::Stop(_) if stops => {}
                Call::Cancel(_) if stops => self.cancelled.store(true, Ordering::Release),
                // It does.
                Call::Shutdown(_) => return Ok(Reply::Shutdown(Done {})),
                _ => return self.refusal(&Outcome::ShuttingDown).map_or_else(|| Err(internal()), Err),
            }
        }
        match call {
            Call::Status(_) => {
                let planner = self.planner_status().await;
                Ok(Reply::Status(StatusReport { planner, ..self.status() }))
            }
            Call::State(_) => Ok(Reply::State(self.state())),
            Call::Motion(m) => self.motion(m.motion).map(Reply::Motion),
            Call::Move(m) => self.move_arm(m, origin).await,
            Call::Execute(e) => self.execute(e, origin).await,
            Call::Go(go) => self.go(go, origin).await.map(Reply::Go),
            Call::Going(going) => self.going(going.going).map(Reply::Going),
            Call::Plan(_)
            | Call::Planning(_)
            | Call::Preview(_)
            | Call::ExecutePlan(_)
            | Call::Planner(_)
            | Call::Ik(_)
            | Call::World(_)
            | Call::WorldAdd(_)
            | Call::WorldMove(_)
            | Call::WorldRemove(_) => self.planner_call_from(call, origin).await,
            Call::Attach(attach) => self.attach(attach).await,
            Call::Detach(detach) => self.detach(detach).await,
            Call::Cancel(c) => self.cancel(c).await,
            Call::Speed(speed) => self.set_speed(speed).await.map(Reply::Speed),
            Call::Stop(s) => self.stop(s).await,
            Call::ArmReset(a) => self.reset(a.arm).await,
            Call::ArmEnable(a) => self.enable(a.arm, a.outside).await,
            Call::ArmTakeOver(a) => self.take_over_led(a.arm).await,
            Call::ArmTeach(a) => self.teach(a, origin).await,
            Call::MoveNative(m) => self.move_native(m, origin).await,
            Call::ArmDisable(a) => self.disable(a.arm, a.now).await,
            Call::Gripper(g) => self.gripper(g, origin).await,
            Call::Grip(g) => self.grip(&g).map(Reply::Grip),
            Call::ArmPayload(p) => self.payload(&p.arm).await.map(Reply::ArmPayload),
            Call::ArmPayloadSet(p) => self.set_payload(p).await,
            Call::ArmTool(t) => self.tool(&t.arm).map(Reply::ArmTool),
            Call::ArmToolSet(t) => self.set_tool(t).await,
            Call::ArmIo(io) => self.io(&io.arm).await.map(Reply::ArmIo),
            Call::ArmIoSet(io) => self.set_io(io).await,
            Call::RobotDescription(_) => Ok(Reply::RobotDescription(self.robot_description())),
            Call::TextLog(log) => self.text_log(log).map(Reply::TextLog),
            Call::Transforms(_) => Ok(Reply::Transforms(self.transforms())),
            Call::Poses(_) => self.poses().await.map(Reply::Poses),
            Call::PoseSave(save) => self.save_pose(save).await.map(Reply::PoseSave),
            Call::PoseRemove(remove) => self.remove_pose(remove).await.map(|()| Reply::PoseRemove(Done {})),
            Call::Servo(s) => {
                self.stream(s.task, (s.positions, true), s.gripper, origin).await.map(|()| Reply::Servo(Done {}))
            }
            Call::Velocity(v) => {
                self.stream(v.task, (v.velocities, false), None, origin).await.map(|()| Reply::Velocity(Done {}))
            }
            Call::Chunk(chunk) => self.chunk(chunk, origin).await.map(Reply::Chunk),
            Call::Twist(twist) => self.twist(&twist, origin).await.map(Reply::Twist),
            Call::Start(start) => self.start_task(&start.task, origin).await.map(Reply::Start),
            Call::Pose(pose) => self.pose(&pose, origin).await.map(Reply::Pose),
            Call::Shutdown(_) => {
                let _ = self.parts.endings.send(Ending::Asked);
                Ok(Reply::Shutdown(Done {}))
            }
        }
    }

    pub(in crate::runtime) fn now(&self) -> Mono {
        dimos_core::clock::Clock::now(&dimos_core::clock::MonotonicClock)
    }
}

impl Backend for Service {
    fn arms_of_load<'a>(&'a self, request: &'a Call) -> BoxFuture<'a, Result<Vec<String>, RpcError>> {
        Box::pin(async {
            Ok(self.arm_of_load(request).await?.map(|arm| self.parts.names.arm(arm)).into_iter().collect())
        })
    }

    fn call(&self, request: Call) -> BoxFuture<'_, Result<Reply, RpcError>> {
        Box::pin(self.answer(request, Origin { epoch: self.epoch(), client: 0 }))
    }

    fn call_from(
        &self,
        request: Call,
        origin: Option<Origin>,
        who: Arc<Who>,
    ) -> BoxFuture<'_, Result<Reply, RpcError>> {
        let origin = origin.unwrap_or_else(|| Origin { epoch: self.epoch(), client: 0 });
        Box::pin(asked_by(who, self.answer(request, origin)))
    }

    fn epoch(&self) -> u64 {
        self.parts.pulse.epoch.load(Ordering::Acquire)
    }

    fn lease_taken(&self, arm: &str, client: u64) -> Result<(), RpcError> {
        self.note_lease_taken(arm, client)
    }

    fn handled(&self) -> BoxFuture<'_, ()> {
        Box::pin(self.next_tick())
    }

    fn lease_ended(&self, arm: &str, client: u64) {
        self.note_lease_ended(arm, client);
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

    fn plan_of(&self, plan: Option<u64>) -> BoxFuture<'_, Result<(u64, Vec<String>), RpcError>> {
        Box::pin(self.plan_and_its_joints(plan))
    }

    fn register_planner(&self, planner: RegisterPlanner, line: Arc<PlannerProxy>) -> Result<Registered, RpcError> {
        self.register(planner, line)
    }

    fn face_fell(&self, face: &FaceReport) {
        self.report_face(face);
    }

    fn prepare_urgent_thread(&self) {
        // Without this right the thread has normal priority; it is mostly idle, so it is scheduled soon.
        let _ = host::set_fifo(host::STOP_PRIORITY);
    }

    fn streams(&self) -> &Streams {
        &self.parts.streams
    }
}

pub(in crate::runtime) fn internal() -> RpcError {
    RpcError::new(Code::Internal, "an arm of this run is not there: a defect of the program")
}
