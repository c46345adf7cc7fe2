//! A run without arms: a scripted backend behind a real socket.

use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use dimos::rpc::api::*;
use dimos::rpc::report::*;
use dimos::rpc::run_dir::RunDir;
use dimos::rpc::server::Server;
use dimos::rpc::server::streams::Streams;
use dimos::rpc::{Backend, BoxFuture, Code, Reply, Request, RpcError, Subject};

/// Answers like a run with one 2-joint arm named `arm`.
#[derive(Default)]
pub struct FakeBackend {
    pub streams: Streams,
    /// Everything that was asked, in order; for a `go`, the requests of its steps.
    pub asked: Mutex<Vec<Request>>,
    /// The latest `go`.
    pub going: Mutex<Option<Go>>,
    /// How often `motion` was asked.
    pub polls: AtomicU64,
    /// When set, a motion does not end until it is cancelled.
    pub endless: bool,
    /// When set, a motion ends aborted.
    pub aborts: bool,
    /// When set, stops are not confirmed.
    pub unconfirmed: bool,
    /// When set, the run has a planner, and planning does not end until it is cancelled.
    pub plans: bool,
    /// When set, the arm is real, at this address.
    pub address: Option<&'static str>,
    /// Whether it is a program on the run's computer.
    pub local: bool,
    /// While set, `planner` is not answered.
    pub holds_planner: AtomicBool,
}

/// Number of every plan.
pub const PLAN: u64 = 5;
/// Number of every `go`.
pub const GOING: u64 = 3;

impl FakeBackend {
    pub fn asked(&self) -> Vec<Request> {
        self.asked.lock().unwrap().clone()
    }

    fn motion(&self, motion: u64) -> MotionReport {
        let polls = self.polls.fetch_add(1, Ordering::Relaxed);
        let cancelled = self.asked().iter().any(|r| matches!(r, Request::Cancel(_)));
        let done = cancelled || (!self.endless && polls >= 2);
        let state = match (done, cancelled || self.aborts) {
            (false, _) => "EXECUTING",
            (true, true) => "ABORTED",
            (true, false) => "COMPLETED",
        };
        let joint = |joint: &str, target, actual| Deviation { joint: joint.into(), target, actual };
        MotionReport {
            motion,
            task: "traj_arm".into(),
            by: None,
            state: state.into(),
            done,
            progress: polls as f64 / 10.0,
            elapsed: 0.4,
            remaining: 0.1,
            speed: None,
            speed_fraction: None,
            error: (state == "ABORTED").then(|| "arm_joint1 was 0.2000 rad off the path".into()),
            replanning: false,
            next: None,
            retraces_to: None,
            collision_checked: false,
            deviation: done.then(|| vec![joint("arm_joint1", 0.3, 0.3004), joint("arm_joint2", -0.2, -0.1)]),
        }
    }

    /// Answers a request of a step at once.
    async fn begin(&self, go: Go) -> Result<GoReply, RpcError> {
        for step in &go.steps {
            let request = match step.clone() {
                GoStep::Plan(plan) => Request::Plan(*plan),
                GoStep::ExecutePlan(execute) => Request::ExecutePlan(*execute),
                GoStep::Move(direct) => Request::Move(*direct),
                GoStep::Execute(execute) => Request::Execute(*execute),
                GoStep::Gripper(gripper) => Request::Gripper(gripper.command(0.04)),
            };
            self.call(request).await?;
        }
        *self.going.lock().unwrap() = Some(go);
        Ok(GoReply { going: GOING })
    }

    fn going(&self) -> GoingReport {
        let step = self.going.lock().unwrap().as_ref().map(|go| go.steps[0].clone()).expect("a go was asked for");
        let begun = match step {
            GoStep::Move(direct) => GoBegun::Move(moves(*direct)),
            GoStep::Execute(execute) => GoBegun::Execute(executes(*execute)),
            _ => {
                let planning = self.planning(PLAN);
                let done = planning.state != "PLANNING";
                let error = done.then(|| RpcError::new(Code::NoPlan, "cancelled"));
                let step = GoStepReport { planning: Some(planning), ..GoStepReport::default() };
                return GoingReport { going: GOING, done, steps: vec![step], error, ..GoingReport::default() };
            }
        };
        let motion = self.motion(begun.motion());
        let (phase, done) = (GoPhase::Executing, motion.done);
        let step = GoStepReport { begun: Some(begun), motions: vec![motion], ..GoStepReport::default() };
        GoingReport { going: GOING, phase, done, steps: vec![step], ..GoingReport::default() }
    }

    fn planning(&self, plan: u64) -> PlanningReport {
        let ends = |r: &Request| matches!(r, Request::Cancel(c) if c.going.is_some() || c.task.is_none() && c.plan.is_none_or(|p| p == plan));
        let cancelled = self.asked().iter().any(ends);
        PlanningReport {
            plan,
            state: if cancelled { "CANCELLED" } else { "PLANNING" }.into(),
            elapsed: 0.1,
            error: None,
            hint: None,
            summary: None,
        }
    }
}

fn moves(direct: Move) -> MoveReply {
    MoveReply {
        motion: 7,
        task: "traj_arm".into(),
        duration: 0.5,
        joints: vec!["arm_joint1".into(), "arm_joint2".into()],
        start: vec![0.0, 0.0],
        target: direct.target,
        collision_checked: false,
    }
}

fn executes(execute: Execute) -> ExecuteReply {
    let task = execute.task.unwrap_or_else(|| "traj_arm".into());
    ExecuteReply { motion: 8, task, duration: execute.trajectory.points.last().map_or(0.0, |p| p.time_from_start) }
}

impl Backend for FakeBackend {
    fn call(&self, request: Request) -> BoxFuture<'_, Result<Reply, RpcError>> {
        if !matches!(request, Request::Go(_)) {
            self.asked.lock().unwrap().push(request.clone());
        }
        Box::pin(async move {
            while matches!(request, Request::Planner(_)) && self.holds_planner.load(Ordering::Relaxed) {
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
            Ok(match request {
                Request::Status(_) => {
                    let mut status = status();
                    if let Some(address) = self.address {
                        let arm = &mut status.arms[0];
                        (arm.address, arm.simulated, arm.local) = (address.to_owned(), false, self.local);
                    }
                    Reply::Status(status)
                }
                Request::State(_) => Reply::State(state()),
                Request::Move(m) if m.arm != "arm" => {
                    return Err(RpcError::unknown(Code::UnknownArm, "arm", &m.arm, &["arm"]));
                }
                Request::Move(m) => Reply::Move(moves(m)),
                Request::Execute(e) => Reply::Execute(executes(e)),
                Request::Go(go) => Reply::Go(self.begin(go).await?),
                Request::Going(_) => Reply::Going(self.going()),
                Request::Motion(m) => Reply::Motion(self.motion(m.motion)),
                Request::Cancel(_) => Reply::Cancel(CancelReply {
                    tasks: [("traj_arm".into(), "CANCELLED".into())].into(),
                    planning: false,
                }),
                Request::Stop(_) => {
                    let how = if self.unconfirmed { Confirmation::SentNotConfirmed } else { Confirmation::Confirmed };
                    Reply::Stop(StopReply { arms: [("arm".into(), how)].into() })
                }
                Request::ArmReset(a) => Reply::ArmReset(ArmReply { arm: a.arm, phase: "standby".into(), note: None }),
                Request::ArmEnable(a) => {
                    Reply::ArmEnable(ArmReply { arm: a.arm, phase: "activating".into(), note: None })
                }
                Request::ArmDisable(a) => {
                    Reply::ArmDisable(ArmReply { arm: a.arm, phase: "disabled".into(), note: None })
                }
                Request::Gripper(g) => {
                    let text = format!("{} has no gripper", g.arm);
                    return Err(RpcError::new(Code::NoGripper, text));
                }
                // Longer than any request may take.
                Request::Servo(_) => std::future::pending().await,
                Request::Velocity(_) => panic!("a defect of the backend"),
                Request::Shutdown(_) => Reply::Shutdown(Done {}),
                Request::Planner(_) if self.plans => Reply::Planner(PlannerReport::default()),
                Request::Plan(_) if self.plans => Reply::Plan(PlanReply { plan: PLAN }),
                Request::Planning(p) if self.plans => Reply::Planning(self.planning(p.plan)),
                // The rest is the planner's.
                _ => return Err(RpcError::new(Code::NoPlanner, "this run has no planner")),
            })
        })
    }

    fn arms_of(&self, subject: Subject<'_>) -> Vec<String> {
        let is_meant = match subject {
            Subject::All | Subject::Joints(_) => true,
            Subject::Arm(name) => name == "arm",
            Subject::Task(name) => name == "traj_arm" || name == "t",
        };
        is_meant.then(|| "arm".to_owned()).into_iter().collect()
    }

    fn streams(&self) -> &Streams {
        &self.streams
    }
}

/// Starts a run of that name; it ends when the server is dropped.
pub fn start(folder: &Path, run: &str, backend: FakeBackend) -> (Server, Arc<FakeBackend>) {
    let backend = Arc::new(backend);
    let claim = RunDir::closed(folder).claim(run).expect("the name is free");
    (Server::start(claim, backend.clone()).expect("the socket opens"), backend)
}

pub fn status() -> StatusReport {
    let figures = Percentiles { p50: 4.1, p99: 11.0, p99_9: 22.25, max: 103.0 };
    StatusReport {
        epoch: 0,
        share: None,
        run: "test".into(),
        pid: std::process::id(),
        version: "0.1.0".into(),
        blueprint: "coordinator-yourarm".into(),
        started: "2026-01-01T00:00:00Z".into(),
        uptime: 123.4,
        tick_rate: 100.0,
        simulated: true,
        speed: Default::default(),
        log: Some("/tmp/test.mcap".into()),
        realtime: vec![RealtimeReport {
            what: "SCHED_FIFO 80 for the tick".into(),
            granted: false,
            remedy: Some("ulimit -r 80".into()),
        }],
        ticks: TickReport {
            clock: "host".to_owned(),
            count: 12340,
            overruns: 2,
            skipped: 3,
            without_state: 0,
            lateness_us: figures,
            compute_us: figures,
        },
        recorder: Some(RecorderReport { messages: 5, dropped: 0, error: None }),
        arms: vec![ArmReport {
            hardware_id: "arm".into(),
            adapter: "yourarm".into(),
            address: "sim".into(),
            simulated: true,
            link: "up".into(),
            phase: "held".into(),
            cause: Some(CauseReport { name: "operator_stop".into(), text: "stopped by an operator".into(), by: None }),
            enabled: true,
            mode: "servo_position".into(),
            state_age_ms: Some(3.2),
            measured_rate_hz: Some(99.8),
            native_rate_hz: 100.0,
            on_exit: "hold".into(),
            counters: [("reads".into(), 12345), ("read_errors".into(), 1)].into(),
            ..Default::default()
        }],
        tasks: vec![TaskReport {
            name: "traj_arm".into(),
            kind: "trajectory".into(),
            takes: vec!["execute".into()],
            joints: (1..=6).map(|i| format!("arm_joint{i}")).collect(),
            priority: 10,
            state: "EXECUTING".into(),
            progress: Some(0.42),
            ..Default::default()
        }],
        planner: None,
        view: None,
        metrics: None,
    }
}

pub fn state() -> StateReport {
    let joint = |i: u32, position, source: &str| JointReport {
        name: format!("arm_joint{i}"),
        position: Some(position),
        velocity: Some(-0.01),
        velocity_source: source.into(),
        effort: None,
        commanded_effort: None,
        command: Some(position),
    };
    StateReport {
        tick: 12340,
        stamp: 1.7e9,
        arms: vec![ArmStateReport {
            hardware_id: "arm".into(),
            simulated: true,
            age_ms: Some(2.5),
            speed_fraction: None,
            effort_kind: None,
            joints: vec![joint(1, 1.5, "measured"), joint(2, -0.25, "estimated")],
            gripper: Some(0.04),
            gripper_unit: Some("m".into()),
            gripper_force: None,
            gripper_force_unit: Some("N".into()),
            pose: Some(PoseReport {
                link: "link_tcp".into(),
                frame: "map".into(),
                xyz: [0.1, 0.2, 0.3],
                ..PoseReport::default()
            }),
            device_pose: None,
            device_tool_pose: None,
            device_pose_missing: None,
            wrench: None,
        }],
    }
}
