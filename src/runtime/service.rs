//! The service of a run: answers every rpc method, each by the owner of its thing.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::client::asker::asked_by;
use super::motion::going::CANCELLED;
use super::{Ending, Service};
use dimos_control::request::Request;
use dimos_core::clock::{Clock, Mono, MonotonicClock};
use dimos_core::telemetry::describe::ArmNames;
use dimos_core::telemetry::{Origin, Outcome, Who};
use dimos_rpc::api::{self, Backend, BoxFuture, Done, FaceReport, RegisterPlanner, Registered, Reply, Request as Call};
use dimos_rpc::report::StatusReport;
use dimos_rpc::server::planner_proxy::PlannerProxy;
use dimos_rpc::server::streams::Streams;
use dimos_rpc::{Code, RpcError, Subject};
use dimos_rt::host;

impl Service {
    /// Returns the measured positions of all joints [rad].
    pub(in crate::runtime) fn positions(&self) -> Vec<f64> {
        let dofs = self.facts.config.arms.iter().map(|a| a.dof);
        let mut all = Vec::new();
        for (arm, dof) in dofs.enumerate() {
            let state = self.tick.arm_view(arm).map(|s| s.state).unwrap_or_default();
            all.extend(state.position.iter().take(dof));
        }
        all
    }

    async fn cancel(&self, call: api::Cancel) -> Result<Reply, RpcError> {
        if call.plan.is_some() {
            let planning = self.cancel_planning(call.plan).await;
            return Ok(Reply::Cancel(api::CancelReply { planning, ..Default::default() }));
        }
        if let Some(going) = call.going {
            return self.cancel_going(going).await.map(Reply::Cancel);
        }
        let arm = call.arm.as_deref().map(|a| self.facts.arm_index(a)).transpose()?;
        let task = call.task.as_deref().map(|t| self.facts.task_index(t)).transpose()?;
        let moves = |joints: &[u16]| arm.is_none_or(|a| joints.iter().any(|j| self.facts.joints_of_arm(a).contains(j)));
        // First: nothing of them begins after this.
        self.end_goings(arm, task);
        let mut tasks = BTreeMap::new();
        for (i, config) in self.facts.config.tasks.iter().enumerate() {
            if task.is_none_or(|t| t as usize == i) && moves(&config.joints) {
                self.motions.end_replanning(CANCELLED, |planned| usize::from(planned.task) == i);
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
        Ok(self.tick.speed_override())
    }

    pub(in crate::runtime) async fn answer(&self, call: Call, origin: Origin) -> Result<Reply, RpcError> {
        let reads = matches!(
            call,
            Call::Status(_) | Call::State(_) | Call::TextLog(_) | Call::Motion(_) | Call::Going(_) | Call::Grip(_)
        );
        if !reads && self.lifecycle.is_closed() {
            let stops = self.lifecycle.accepts_stops();
            match call {
                Call::Stop(_) if stops => {}
                Call::Cancel(_) if stops => self.lifecycle.cancel(),
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
            Call::Attach(attach) => {
                let (name, robot) = (attach.name.clone(), attach.robot.clone());
                let reply = self.attach(attach).await?;
                self.note_attached(name, &robot).await?;
                Ok(reply)
            }
            Call::Detach(detach) => {
                let name = detach.name.clone();
                let reply = self.detach(detach).await?;
                self.note_detached(&name);
                Ok(reply)
            }
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
            Call::GripperHome(g) => self.home_gripper(g).await,
            Call::Grip(g) => self.grip(&g).map(Reply::Grip),
            Call::ArmPayload(p) => self.payload(&p.arm).await.map(Reply::ArmPayload),
            Call::ArmPayloadFind(p) => self.find_payload(&p).map(Reply::ArmPayloadFind),
            Call::ArmPayloadSet(p) => self.set_payload(p).await,
            Call::ArmTare(t) => self.tare(&t.arm).await,
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
                self.lifecycle.end(Ending::Asked);
                Ok(Reply::Shutdown(Done {}))
            }
        }
    }

    pub(in crate::runtime) fn now(&self) -> Mono {
        MonotonicClock.now()
    }
}

impl Backend for Service {
    fn arms_of_load<'a>(&'a self, request: &'a Call) -> BoxFuture<'a, Result<Vec<String>, RpcError>> {
        Box::pin(async {
            Ok(self.arm_of_load(request).await?.map(|arm| self.facts.names.arm(arm)).into_iter().collect())
        })
    }

    fn call(&self, request: Call) -> BoxFuture<'_, Result<Reply, RpcError>> {
        Box::pin(self.answer_counted(request, Origin { epoch: self.tick.epoch(), client: 0 }))
    }

    fn call_from(
        &self,
        request: Call,
        origin: Option<Origin>,
        who: Arc<Who>,
    ) -> BoxFuture<'_, Result<Reply, RpcError>> {
        let origin = origin.unwrap_or_else(|| Origin { epoch: self.tick.epoch(), client: 0 });
        Box::pin(asked_by(who, self.answer_counted(request, origin)))
    }

    fn epoch(&self) -> u64 {
        self.tick.epoch()
    }

    fn lease_taken(&self, arm: &str, client: u64) -> Result<(), RpcError> {
        self.note_lease_taken(arm, client)
    }

    fn refused(&self, method: &'static str, error: &RpcError) {
        self.count_refusal(method, error);
    }

    fn handled(&self) -> BoxFuture<'_, ()> {
        Box::pin(self.tick.next_tick())
    }

    fn lease_ended(&self, arm: &str, client: u64) {
        self.note_lease_ended(arm, client);
    }

    fn arms_of(&self, subject: Subject<'_>) -> Vec<String> {
        let tasks = &self.facts.config.tasks;
        let is_meant = |(i, arm): &(usize, &ArmNames)| match subject {
            Subject::All => true,
            Subject::Arm(id) => arm.hardware_id == id,
            Subject::Joints(joints) => joints.iter().any(|j| arm.joints.contains(j)),
            Subject::Task(name) => {
                let range = self.facts.joints_of_arm(*i as u16);
                tasks.iter().any(|t| t.name == name && t.joints.iter().any(|j| range.contains(j)))
            }
        };
        let arms = self.facts.names.arms.iter().enumerate().filter(is_meant);
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
        self.journal.subscribers()
    }
}

pub(in crate::runtime) fn internal() -> RpcError {
    RpcError::new(Code::Internal, "an arm of this run is not there: a defect of the program")
}
