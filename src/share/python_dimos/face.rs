//! The face itself: its session on the bus of Python dimos, and what it answers there.

use std::path::PathBuf;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use zenoh::bytes::Encoding;
use zenoh::query::Query;
use zenoh::{Session, Wait};

use super::calls::{Call, Lane};
use super::keys;
use super::lanes::Queues;
use super::names::{Names, TRAJECTORY_TASK};
use super::pickle_writer::{Value, texts, write};
use super::python_error::{ENCODING, PythonError};
use super::results::{Cancellation, Execution, GRIPPER_COMMANDS, TRAJECTORY_COMMANDS, description};
use super::rival;
use super::states::{self, States};
use crate::blueprint::share::{OnLost, PythonDimosConfig, ShareConfig};
use crate::rpc::api::{FaceReport, OnBehalfOf, State, Status};
use crate::rpc::client::{Client, ClientError};
use crate::rpc::error::{Code, RpcError};
use crate::share::settings;
use crate::sync::lock;

/// Period of the search for another coordinator.
const RIVAL_PERIOD: Duration = Duration::from_secs(5);
/// Timeout for the first state of the run.
const FIRST_STATE: Duration = Duration::from_secs(1);
/// Name of this face in reports.
const FACE: &str = "python_dimos";
/// What the run shows as the commander of an arm.
const COMMANDER: &str = "Python dimos";
/// What to do if there is another coordinator.
const RIVAL_HINT: &str = "end that one, then start this `dimos share` or run again; or give this one another name: \
                          `share.python_dimos.name`";

/// A call that waits for its answer.
pub struct Waiting {
    /// Its query.
    query: Query,
    /// What is called.
    pub call: Call,
    /// Whether the caller wants no answer.
    silent: bool,
}

impl Waiting {
    /// Answers the call.
    pub fn answer(self, result: Result<Value, PythonError>) {
        if !self.silent {
            reply(&self.query, result);
        }
    }
}

fn reply(query: &Query, result: Result<Value, PythonError>) {
    let _ = match result {
        Ok(value) => query.reply(query.key_expr().clone(), write(&value)).express(true).wait(),
        Err(error) => query.reply_err(error.encode()).encoding(Encoding::from(ENCODING)).wait(),
    };
}

/// The face of a run to Python dimos. Ends when dropped.
pub struct Face {
    core: Arc<Core>,
    end: Option<SyncSender<()>>,
}

struct Core {
    config: PythonDimosConfig,
    /// Whether motion may be ended from there.
    may_end: bool,
    names: Arc<Names>,
    states: Arc<States>,
    /// `None` when it has stopped serving.
    open: Mutex<Option<Open>>,
    /// Why it does not serve.
    down: Mutex<Option<String>>,
}

/// What is open while it serves.
struct Open {
    session: Session,
    queues: Arc<Queues>,
    _declared: Vec<Box<dyn Send>>,
}

impl Face {
    /// Starts the face of a run: on the bus of this computer, and for clients of the gateway. Fails if there is another
    /// coordinator of this name on the bus. `changed` is called when it stops serving.
    pub fn start(
        (run, socket): (&str, PathBuf),
        gateway: &Session,
        share: &ShareConfig,
        config: &PythonDimosConfig,
        changed: impl Fn() + Send + 'static,
    ) -> Result<Self, RpcError> {
        let names = Arc::new(names(run, &socket, config)?);
        let session = zenoh::open(settings::of_python_dimos(config)?).wait().map_err(|error| {
            tracing::debug!("share: python_dimos: {error}");
            RpcError::new(
                Code::Unreachable,
                "cannot join the bus of Python dimos: multicast on the interface `lo` fails",
            )
            .hint("sudo ip link set lo multicast on; sudo ip route add 224.0.0.0/4 dev lo")
        })?;
        if let Some(arms) = rival::find(&session, &config.name) {
            let _ = session.close().wait();
            return Err(RpcError::new(Code::HasCoordinator, rival_text(config, &arms)).hint(RIVAL_HINT));
        }
        let failed = |e: String| RpcError::new(Code::Internal, format!("python_dimos: {e}"));
        let states = states::publish(&[&session, gateway], &keys::prefix(config), (run, socket.clone()), names.clone());
        let states = states.map_err(|e| failed(e.to_string()))?;
        wait_for_state(&states);
        let behalf = OnBehalfOf { client: COMMANDER.into(), cancel_at_end: share.on_lost == OnLost::Cancel };
        let queues = Queues::start((run, socket), names.clone(), behalf).map_err(|e| failed(e.to_string()))?;
        let core = Arc::new(Core {
            config: config.clone(),
            may_end: config.command || share.observers_stop,
            names,
            states,
            open: Mutex::new(Some(Open { session: session.clone(), queues: Arc::new(queues), _declared: Vec::new() })),
            down: Mutex::new(None),
        });
        let mut declared: Vec<Box<dyn Send>> = Vec::new();
        for session in [&session, gateway] {
            let at_query = Arc::downgrade(&core);
            let queryable = session.declare_queryable(keys::calls(config)).complete(true).callback(move |query| {
                if let Some(core) = at_query.upgrade() {
                    core.receive(query);
                }
            });
            declared.push(Box::new(queryable.wait().map_err(|e| failed(e.to_string()))?));
        }
        if let Some(open) = lock(&core.open).as_mut() {
            open._declared = declared;
        }
        let (end, ended) = sync_channel(0);
        let watched = core.clone();
        std::thread::Builder::new()
            .name("dimos-rival".into())
            .spawn(move || watched.watch(&session, &ended, changed))
            .map_err(|e| failed(e.to_string()))?;
        Ok(Self { core, end: Some(end) })
    }

    /// Returns its report.
    pub fn report(&self) -> FaceReport {
        report(&self.core.config, lock(&self.core.down).clone())
    }
}

impl Drop for Face {
    fn drop(&mut self) {
        self.end.take();
        self.core.close();
    }
}

/// Returns the report of a face. `down`: why it does not serve.
pub fn report(config: &PythonDimosConfig, down: Option<String>) -> FaceReport {
    FaceReport {
        face: FACE.into(),
        name: config.name.clone(),
        serves: down.is_none(),
        command: config.command,
        reason: down,
    }
}

fn rival_text(config: &PythonDimosConfig, arms: &str) -> String {
    format!("another {}{arms} is on the bus of Python dimos; both would move", config.name)
}

fn names(run: &str, socket: &std::path::Path, config: &PythonDimosConfig) -> Result<Names, RpcError> {
    let ask = || -> Result<_, ClientError> {
        let mut client = Client::connect(run, socket)?;
        Ok((client.call(Status {})?, client.call(State {})?))
    };
    let (status, state) = ask().map_err(|e| RpcError::new(Code::Internal, e.to_string()))?;
    Names::of(&status, &state, &config.joints).map_err(|what| RpcError::new(Code::InvalidParams, what))
}

/// Waits for the first state, so that the first caller gets positions.
fn wait_for_state(states: &States) {
    let deadline = Instant::now() + FIRST_STATE;
    while states.newest().is_none() && Instant::now() < deadline {
        std::thread::sleep(Duration::from_millis(5));
    }
}

impl Core {
    /// Takes a call: reads it here, so that garbage costs its sender, and answers it or queues it.
    fn receive(&self, query: Query) {
        let key = query.key_expr().clone();
        // One with wildcards is no call.
        let Some(method) = keys::method(key.as_str(), &self.config) else { return };
        let silent = query.attachment().is_some();
        let payload = query.payload().map(|payload| payload.to_bytes()).unwrap_or_default();
        let call = match Call::read(&self.config.name, method, &payload, &self.names) {
            Ok(call) => call,
            Err(error) if silent => return tracing::debug!("share: python_dimos: {method}: {}", error.text),
            Err(error) => return reply(&query, Err(error)),
        };
        drop(payload);
        let (lane, refused) = (self.lane(&call), self.refused(&call));
        let waiting = Waiting { query, call, silent };
        if let Some(refused) = refused {
            return waiting.answer(refused);
        }
        if lane == Lane::Here {
            let result = self.answer(&waiting.call);
            return waiting.answer(result);
        }
        let queues = lock(&self.open).as_ref().map(|open| open.queues.clone());
        match queues {
            Some(queues) => queues.queue(lane, waiting),
            None => waiting.answer(Err(PythonError::failed("this coordinator has stopped serving"))),
        }
    }

    fn lane(&self, call: &Call) -> Lane {
        match call {
            // The run may publish no states.
            Call::Positions if self.states.newest().is_none() => Lane::Reads,
            _ => call.lane(),
        }
    }

    /// Returns the answer to a call that the run's owner does not allow.
    fn refused(&self, call: &Call) -> Option<Result<Value, PythonError>> {
        let what = "this run takes no commands from Python dimos: set `share.python_dimos.command: true` in its \
                    blueprint, or start `dimos share --python-dimos --command`";
        let end = "the run's owner has taken cancel and stop from observers: `share.observers_stop`";
        match call {
            Call::Execute(Ok(_)) if !self.config.command => Some(Ok(Execution::InvalidTrajectory.result(what))),
            Call::SetGripper(..) if !self.config.command => Some(Err(PythonError::forbidden(what))),
            Call::Cancel if !self.may_end => Some(Ok(Cancellation::Uncertain.result(end))),
            Call::EStop(true) if !self.may_end => Some(Err(PythonError::forbidden(end))),
            _ => None,
        }
    }

    /// Answers what is known here.
    fn answer(&self, call: &Call) -> Result<Value, PythonError> {
        Ok(match call {
            Call::ListJoints => texts(self.names.joints()),
            Call::ListHardware => texts(&self.names.arms),
            Call::ListTasks => texts(self.names.tasks()),
            Call::Skills => Value::List(Vec::new()),
            Call::ResetRuntimeState => Value::Dict(Vec::new()),
            Call::TickCount => Value::Int(self.states.ticks() as i64),
            Call::Positions => {
                let state = self.states.newest().unwrap_or_default();
                let positions = state.name.iter().cloned().zip(state.position.iter().map(|p| Value::Float(*p)));
                Value::Map(positions.collect())
            }
            Call::DescribeTask(task) => match self.names.gripper(task) {
                Some(_) => description(task, &GRIPPER_COMMANDS),
                None if task == TRAJECTORY_TASK => description(task, &TRAJECTORY_COMMANDS),
                None => Value::None,
            },
            Call::Execute(Err(what)) => Execution::InvalidTrajectory.result(what.as_str()),
            Call::EStop(_) => {
                let arms = &self.names.arms;
                let reset: Vec<String> = arms.iter().map(|arm| format!("dimos arm reset {arm}")).collect();
                let enable: Vec<String> = arms.iter().map(|arm| format!("dimos arm enable {arm}")).collect();
                let text = "a stop is cleared by a person, in sight of the arm, on the run's computer";
                return Err(PythonError::failed(format!("{text}: {}; {}", reset.join("; "), enable.join("; "))));
            }
            _ => Value::None,
        })
    }

    /// Looks for another coordinator until `ended` is disconnected, and stops serving if there is one.
    fn watch(&self, session: &Session, ended: &Receiver<()>, changed: impl Fn()) {
        let pause = RIVAL_PERIOD - rival::ANSWER_TIMEOUT;
        while ended.recv_timeout(pause) == Err(RecvTimeoutError::Timeout) {
            if let Some(arms) = rival::find(session, &self.config.name) {
                let text = rival_text(&self.config, &arms);
                tracing::error!("share: python_dimos stops serving: {text}");
                *lock(&self.down) = Some(format!("{text} ({RIVAL_HINT})"));
                self.close();
                return changed();
            }
        }
    }

    /// Answers and publishes no more. Motions that were begun here end as `on_lost` says.
    fn close(&self) {
        self.states.end();
        let Some(open) = lock(&self.open).take() else { return };
        open.queues.end();
        let session = open.session.clone();
        drop(open);
        let _ = session.close().wait();
    }
}
