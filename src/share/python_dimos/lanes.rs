//! Connections to the run's socket, each with its own thread and queue: one that reads, one that commands, one that
//! ends motion.

use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use super::calls::{Call, Lane};
use super::face::Waiting;
use super::gripper::{self, Scale};
use super::names::Names;
use super::pickle_writer::{Value, texts};
use super::python_error::{PythonError, text_of};
use super::results::{Cancellation, Execution, State, refusal, status};
use crate::clock::wall_now;
use crate::rpc::api::{Cancel, Execute, Gripper, Method, Motion, OnBehalfOf, State as GetState, Stop};
use crate::rpc::client::{Client, ClientError};
use crate::rpc::error::Code;
use crate::rpc::report::MotionReport;
use crate::sync::lock;

/// Calls that may wait in a queue; more are refused.
const QUEUE: usize = 32;
/// Pause between checks whether the motion has ended.
const PERIOD: Duration = Duration::from_millis(100);
/// The lease is kept for this time after the motion, so that the next one of a sequence finds it.
const LEASE_KEPT: Duration = Duration::from_secs(1);
/// A connection that was idle for this time is replaced by a new one: the run may have closed it in favour of others.
const IDLE: Duration = Duration::from_secs(1);

/// What the lanes know.
pub struct Lanes {
    /// The run.
    pub run: String,
    /// Its socket.
    pub socket: PathBuf,
    /// Names of joints, arms and tasks.
    pub names: Arc<Names>,
    /// What the run shows as commander, and whether its motions end with this process.
    pub behalf: OnBehalfOf,
    /// The newest motion.
    motion: Mutex<Option<u64>>,
    /// Number of cancellations and stops: what was called before the latest one begins no longer.
    ended: AtomicU64,
}

/// The queues of the lanes; dropped, the threads end, and with them their connections.
pub struct Queues {
    lanes: Arc<Lanes>,
    reads: SyncSender<(Waiting, u64)>,
    moves: SyncSender<(Waiting, u64)>,
    ends: SyncSender<(Waiting, u64)>,
}

impl Queues {
    /// Starts the threads.
    pub fn start((run, socket): (&str, PathBuf), names: Arc<Names>, behalf: OnBehalfOf) -> std::io::Result<Self> {
        let lanes = Arc::new(Lanes {
            run: run.to_owned(),
            socket,
            names,
            behalf,
            motion: Mutex::new(None),
            ended: AtomicU64::new(0),
        });
        let spawn = |name: &str, serve: fn(&Lanes, &Receiver<(Waiting, u64)>)| {
            let ((queue, calls), lanes) = (sync_channel(QUEUE), lanes.clone());
            std::thread::Builder::new().name(name.into()).spawn(move || serve(&lanes, &calls)).map(|_| queue)
        };
        Ok(Self {
            reads: spawn("dimos-reads", Lanes::serve_reads)?,
            moves: spawn("dimos-moves", Lanes::serve_moves)?,
            ends: spawn("dimos-ends", Lanes::serve_ends)?,
            lanes,
        })
    }

    /// Lets nothing begin that waits.
    pub fn end(&self) {
        self.lanes.ended.fetch_add(1, Ordering::AcqRel);
    }

    /// Queues a call. Never waits.
    pub fn queue(&self, lane: Lane, waiting: Waiting) {
        let (queue, mut number) = match lane {
            Lane::Ends => (&self.ends, 0),
            Lane::Moves => (&self.moves, 0),
            Lane::Reads | Lane::Here => (&self.reads, 0),
        };
        if lane == Lane::Ends {
            self.lanes.ended.fetch_add(1, Ordering::AcqRel);
        } else {
            number = self.lanes.ended.load(Ordering::Acquire);
        }
        if let Err(TrySendError::Full((waiting, _)) | TrySendError::Disconnected((waiting, _))) =
            queue.try_send((waiting, number))
        {
            waiting.answer(Err(PythonError::failed(format!("{QUEUE} calls wait for their answers already"))));
        }
    }
}

/// A connection that is made when it is needed.
struct Link<'l> {
    lanes: &'l Lanes,
    client: Option<Client>,
    used: Instant,
}

impl<'l> Link<'l> {
    fn new(lanes: &'l Lanes) -> Self {
        Self { lanes, client: None, used: Instant::now() }
    }

    /// Calls a method that may be called twice.
    fn call<M: Method + Clone>(&mut self, params: &M) -> Result<M::Reply, ClientError> {
        let is_new = self.client.is_none() || self.used.elapsed() > IDLE;
        match self.call_once(params) {
            Err(error) if !is_new && !matches!(error, ClientError::Refused(_)) => self.call_once(params),
            result => result,
        }
    }

    fn call_once<M: Method + Clone>(&mut self, params: &M) -> Result<M::Reply, ClientError> {
        if self.used.elapsed() > IDLE {
            self.client = None;
        }
        self.used = Instant::now();
        let mut client = match self.client.take() {
            Some(client) => client,
            None => Client::connect(&self.lanes.run, &self.lanes.socket)?,
        };
        let result = client.call(params.clone());
        if matches!(result, Ok(_) | Err(ClientError::Refused(_))) {
            self.client = Some(client);
        }
        result
    }
}

impl Lanes {
    fn serve_reads(&self, calls: &Receiver<(Waiting, u64)>) {
        let mut link = Link::new(self);
        for (waiting, _) in calls {
            let result = self.read(&mut link, &waiting.call);
            waiting.answer(result);
        }
    }

    fn read(&self, link: &mut Link<'_>, call: &Call) -> Result<Value, PythonError> {
        match call {
            Call::State => Ok(State::of(self.motion(link)?.as_ref()).member()),
            Call::Status => Ok(status(self.motion(link)?.as_ref(), wall_now() as f64 * 1e-9)),
            Call::ActiveTasks => {
                let trajectory = State::of(self.motion(link)?.as_ref()) == State::Executing;
                let tasks = self.names.tasks();
                let grippers = tasks.iter().filter(|task| self.names.gripper(task).is_some());
                let active = trajectory.then_some(super::names::TRAJECTORY_TASK).into_iter();
                // To Python dimos a gripper's task is always active.
                Ok(texts(active.chain(grippers.map(String::as_str))))
            }
            Call::GripperPosition(arm, scale) => {
                let state = link.call(&GetState {})?;
                let native = state.arms.iter().find(|a| a.hardware_id == *arm).and_then(|a| a.gripper);
                let value = gripper::position(&self.names, arm, *scale, native);
                Ok(value.map_or(Value::None, |value| Value::List(vec![Value::Float(value)])))
            }
            Call::Positions => {
                let state = link.call(&GetState {})?;
                let joints = state.arms.iter().flat_map(|arm| &arm.joints);
                let position = |joint: &crate::rpc::report::JointReport| {
                    Some((self.names.theirs(&joint.name)?.to_owned(), Value::Float(joint.position?)))
                };
                Ok(Value::Map(joints.filter_map(position).collect()))
            }
            _ => Err(PythonError::failed("this call does not read")),
        }
    }

    /// Returns the newest motion of this face; `None`: none, or forgotten by the run.
    fn motion(&self, link: &mut Link<'_>) -> Result<Option<MotionReport>, ClientError> {
        let Some(motion) = *lock(&self.motion) else { return Ok(None) };
        match link.call(&Motion { motion }) {
            Ok(report) => Ok(Some(report)),
            Err(ClientError::Refused(error)) if error.code == Code::UnknownMotion => Ok(None),
            Err(error) => Err(error),
        }
    }

    fn serve_ends(&self, calls: &Receiver<(Waiting, u64)>) {
        let mut link = Link::new(self);
        for (waiting, _) in calls {
            let result = match waiting.call {
                Call::Cancel => self.cancel(&mut link),
                _ => stop(&mut link),
            };
            waiting.answer(result);
        }
    }

    /// Cancels the motions of all trajectory tasks, of whichever client: to Python dimos they are one task.
    fn cancel(&self, link: &mut Link<'_>) -> Result<Value, PythonError> {
        if self.names.trajectory_tasks.is_empty() {
            return Ok(Cancellation::NoTrajectoryTask.result("the run has no trajectory task"));
        }
        let mut outcome = Cancellation::AlreadyStopped;
        for task in &self.names.trajectory_tasks {
            match link.call(&Cancel { task: Some(task.clone()), ..Cancel::default() }) {
                Ok(reply) if reply.tasks.values().any(|result| result == "CANCELLED") => {
                    outcome = Cancellation::Cancelled;
                }
                Ok(_) => {}
                Err(error) => return Ok(Cancellation::Uncertain.result(text_of(&error))),
            }
        }
        Ok(outcome.result(""))
    }

    fn serve_moves(&self, calls: &Receiver<(Waiting, u64)>) {
        // Its lease is that of the connection, which is closed when the lease is to be free.
        let mut client = None;
        let mut idle_since = Instant::now();
        loop {
            match calls.recv_timeout(PERIOD) {
                Ok((waiting, number)) => {
                    let result = self.command(&mut client, &waiting.call, number);
                    idle_since = Instant::now();
                    waiting.answer(result);
                }
                Err(RecvTimeoutError::Timeout) => {
                    if self.is_moving(&mut client) {
                        idle_since = Instant::now();
                    } else if idle_since.elapsed() >= LEASE_KEPT {
                        client = None;
                    }
                }
                Err(RecvTimeoutError::Disconnected) => return,
            }
        }
    }

    fn is_moving(&self, client: &mut Option<Client>) -> bool {
        let (Some(open), Some(motion)) = (client.as_mut(), *lock(&self.motion)) else { return false };
        match open.call(Motion { motion }) {
            Ok(report) => !report.done,
            Err(ClientError::Refused(_)) => false,
            Err(_) => {
                *client = None;
                false
            }
        }
    }

    /// Returns the connection that commands, a new one if there is none.
    fn commander<'c>(&self, client: &'c mut Option<Client>) -> Result<&'c mut Client, ClientError> {
        let open = match client.take() {
            Some(open) => open,
            None => {
                let mut open = Client::connect(&self.run, &self.socket)?;
                open.call(self.behalf.clone())?;
                open
            }
        };
        Ok(client.insert(open))
    }

    fn command(&self, client: &mut Option<Client>, call: &Call, number: u64) -> Result<Value, PythonError> {
        let ended = || self.ended.load(Ordering::Acquire) != number;
        let result = match call {
            Call::Execute(Ok(_)) if ended() => {
                return Ok(Execution::InvalidTrajectory.result("it was cancelled before it began"));
            }
            Call::SetGripper(..) if ended() => return Ok(Value::Bool(false)),
            Call::Execute(Ok(execute)) => self.execute(client, execute, ended),
            Call::SetGripper(arm, scale, value) => self.set_gripper(client, (arm, *scale, *value)),
            _ => return Err(PythonError::failed("this call does not command")),
        };
        result.map_err(|error| {
            if !matches!(error, ClientError::Refused(_)) {
                *client = None;
            }
            PythonError::from(error)
        })
    }

    fn execute(
        &self,
        client: &mut Option<Client>,
        execute: &Execute,
        ended: impl Fn() -> bool,
    ) -> Result<Value, ClientError> {
        let open = self.commander(client)?;
        let begun = match open.call(execute.clone()) {
            Ok(begun) => begun,
            Err(error) => return refusal(&error, text_of(&error)).ok_or(error),
        };
        *lock(&self.motion) = Some(begun.motion);
        if ended() {
            open.call(Cancel { task: Some(begun.task), ..Cancel::default() })?;
            return Ok(Execution::InvalidTrajectory.result("it was cancelled as it began"));
        }
        Ok(Execution::Accepted.result(""))
    }

    fn set_gripper(
        &self,
        client: &mut Option<Client>,
        (arm, scale, value): (&str, Scale, Option<f64>),
    ) -> Result<Value, ClientError> {
        let Some(position) = gripper::target(&self.names, arm, scale, value) else { return Ok(Value::Bool(false)) };
        let order = Gripper { arm: arm.to_owned(), position, force: None, speed: None, timeout: None };
        self.commander(client)?.call(order)?;
        Ok(Value::Bool(true))
    }
}

/// Stops all arms. Fails with the names of those that have not confirmed it.
fn stop(link: &mut Link<'_>) -> Result<Value, PythonError> {
    let reply = link.call(&Stop::default())?;
    let open: Vec<String> = reply
        .arms
        .iter()
        .filter(|(_, confirmation)| **confirmation != crate::rpc::api::Confirmation::Confirmed)
        .map(|(arm, confirmation)| format!("{arm}: {}", confirmation.text()))
        .collect();
    if open.is_empty() { Ok(Value::Bool(true)) } else { Err(PythonError::failed(open.join("; "))) }
}
