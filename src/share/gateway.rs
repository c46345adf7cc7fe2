//! The gateway: a client of a run's socket that gives it to other computers.
//!
//! ```text
//!  client ─ zenoh ─▶ queryable: key, role, form ─▶ Remote: a connection per client; per stop, per cancel ─▶ run
//!         ◀─ streams that everyone may read, read once ────────────────────────────────────────────────────── run
//! ```
//!
//! The run sees clients of its socket and nothing else: their leases are those of their connections, which this process
//! closes when a client is lost. It decides nothing that the run decides.

mod clients;
mod run_end;

use std::collections::{BTreeMap, VecDeque};
use std::io::{self, BufRead, BufReader, Write};
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, SyncSender, channel, sync_channel};
use std::sync::{Arc, Mutex, Weak};
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use zenoh::bytes::ZBytes;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::query::Query;
use zenoh::{Session, Wait};

use super::class::{PAGE, class_of, permit};
use super::ends::Ends;
use super::keys::{self, Who};
use super::page::Pages;
use super::remote::{Closed, Remote, Request, refuse};
use super::{certificates, ros, settings, streams};
use crate::blueprint::share::ShareConfig;
use dimos_core::sync::lock;
use dimos_rpc::api::Class;
use dimos_rpc::api::{FaceReport, MAX_ANSWER, MAX_LINE, METHODS, Method, PlannerAnswer, RegisterGateway};
use dimos_rpc::client::reach;
use dimos_rpc::error::{Code, RpcError};

/// Period of the checks of the clients.
const PERIOD: Duration = Duration::from_millis(50);
/// A client without a token is forgotten after this silence.
const FORGET_AFTER: Duration = Duration::from_secs(10);
/// Lost commanders that are remembered.
const MAX_LOST: usize = 256;
/// Time for the last answers to clients when the run has ended.
const LAST_ANSWERS: Duration = Duration::from_millis(200);
/// Time from the message that the run has ended to the end of the session.
const END_LEAD: Duration = Duration::from_millis(50);
/// Refusals that may wait to be sent.
const MAX_REFUSED: usize = 1024;
/// Length of the attachment of requests and beats [bytes].
pub(super) const PROOF: usize = 16;
/// Room for the rest of a line beside the params [bytes].
const ENVELOPE: usize = 256;

/// A running gateway.
pub struct Gateway {
    shared: Arc<Shared>,
    /// What happens: the clients have changed, or the run has ended.
    news: Receiver<News>,
    control: UnixStream,
    /// The bridge to ROS 2, or why it does not serve.
    ros: Option<Result<ros::Bridge, RpcError>>,
    /// Declarations; they end with it.
    _declared: Vec<Box<dyn Send>>,
}

/// What the gateway's loop reacts to.
enum News {
    Clients,
    Bridges,
    RunEnded,
    /// It was killed: its end is not announced.
    RunLost,
}

struct Shared {
    run: String,
    socket: PathBuf,
    config: ShareConfig,
    session: Session,
    news: Sender<News>,
    clients: Mutex<BTreeMap<Who, Arc<Remote>>>,
    /// Requests that end motion.
    ends: Ends,
    /// Set with the lock of `clients`: there are no new ones.
    run_ended: AtomicBool,
    /// Commanders whose leases ended because they were silent.
    lost: Mutex<VecDeque<Who>>,
    pages: Pages,
    refused: SyncSender<(Query, RpcError)>,
}

impl Gateway {
    /// Starts the gateway of a run; `socket` is to outlast its directory. Fails if the run has another one.
    pub fn start(run: &str, socket: PathBuf, config: ShareConfig) -> Result<Self, RpcError> {
        if let Some((what, hint)) = config.mistake() {
            return Err(RpcError::new(Code::InvalidParams, what).hint(hint));
        }
        if let Some(soon) = certificates::check_gateway(&config)? {
            tracing::warn!("share: {soon}");
        }
        let mut control = reach::wait_for(&socket).map_err(|e| failed(format!("run {run}: {}", io::Error::from(e))))?;
        let endpoints = config.listen.iter().chain(&config.connect).map(ToString::to_string).collect();
        register(&mut control, &RegisterGateway { endpoints, starting: true, ..RegisterGateway::default() })
            .map_err(|e| failed(e.to_string()))?;
        let mut replies = BufReader::new(control.try_clone().map_err(|e| failed(e.to_string()))?);
        accepted(&mut replies)?;

        let (news, received) = channel();
        let settings = settings::of_gateway(run, &config)?;
        let places: Vec<String> = config.listen.iter().map(ToString::to_string).collect();
        let session = zenoh::open(settings).wait().map_err(|error| {
            tracing::debug!("share: {error}");
            let text = format!("cannot listen at {}", places.join(", "));
            RpcError::new(Code::Unreachable, text).hint("another program may have the port, or the address is not ours")
        })?;
        let pages = Pages::start(run, &socket).map_err(|e| failed(e.to_string()))?;
        let (refused, refusing) = sync_channel::<(Query, RpcError)>(MAX_REFUSED);
        std::thread::Builder::new()
            .name("share-refuse".into())
            .spawn(move || refusing.into_iter().for_each(|(query, error)| refuse(&query, &error)))
            .map_err(|e| failed(e.to_string()))?;
        let shared = Arc::new(Shared {
            run: run.to_owned(),
            socket,
            config,
            session,
            news: news.clone(),
            clients: Mutex::default(),
            ends: Ends::default(),
            run_ended: AtomicBool::new(false),
            lost: Mutex::default(),
            pages,
            refused,
        });
        let socket = shared.socket.clone();
        std::thread::Builder::new()
            .name("run-end".into())
            .spawn(move || {
                let in_order = run_end::is_in_order(&mut replies, &socket);
                let _ = news.send(if in_order { News::RunEnded } else { News::RunLost });
            })
            .map_err(|e| failed(e.to_string()))?;
        let declared = shared.declare().map_err(|e| failed(e.to_string()))?;
        let changed = || {
            let news = shared.news.clone();
            move || drop(news.send(News::Bridges))
        };
        let ros = shared
            .config
            .ros
            .as_ref()
            .map(|config| ros::Bridge::start((&shared.run, &shared.socket), &shared.config, config, changed()));
        let mut gateway = Self { shared, news: received, control, ros, _declared: declared };
        if let Some(error) = gateway.bridge_error() {
            tracing::error!("share: {error}");
        }
        // Where that fails, the end of the connection is news of its own.
        let _ = gateway.announce();
        Ok(gateway)
    }

    /// Returns why a bridge cannot serve; `None`: all can.
    pub fn bridge_error(&self) -> Option<&RpcError> {
        self.ros.as_ref().and_then(|bridge| bridge.as_ref().err())
    }

    /// Returns which bridges do not serve at present, and why: one may wait for its router.
    pub fn not_serving(&self) -> Vec<String> {
        let down = |face: FaceReport| Some(format!("{} does not serve: {}", face.face, face.reason?));
        self.faces().into_iter().filter_map(down).collect()
    }

    fn faces(&self) -> Vec<FaceReport> {
        let why = |error: &RpcError| {
            let hint = error.hint.as_ref().map(|hint| format!(" (hint: {hint})")).unwrap_or_default();
            Some(format!("{}{hint}", error.message))
        };
        let config = &self.shared.config;
        let ros = config.ros.as_ref().zip(self.ros.as_ref()).map(|(config, bridge)| match bridge {
            Ok(bridge) => bridge.report(),
            Err(error) => ros::report(config, why(error)),
        });
        ros.into_iter().collect()
    }

    /// Reports to the run where it listens and what it serves.
    fn announce(&mut self) -> io::Result<()> {
        let (endpoints, clients) = (self.shared.endpoints(), self.shared.titles());
        let (faces, starting) = (self.faces(), false);
        register(&mut self.control, &RegisterGateway { endpoints, clients, faces, starting })
    }

    /// Serves until the run ends.
    pub fn serve(mut self) {
        loop {
            match self.news.recv_timeout(PERIOD) {
                Ok(News::RunEnded) => {
                    self.say_that_the_run_has_ended();
                    break;
                }
                Ok(News::RunLost) => break,
                Ok(News::Clients | News::Bridges) => {
                    let _ = self.announce();
                }
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => break,
            }
            self.shared.look_after_clients();
        }
        self._declared.clear();
        self.ros.take();
        let _ = self.shared.session.close().wait();
    }

    /// Sends it to all clients, and answers what they have asked.
    fn say_that_the_run_has_ended(&self) {
        let shared = &self.shared;
        let clients: Vec<Arc<Remote>> = {
            let clients = lock(&shared.clients);
            shared.run_ended.store(true, Ordering::Release);
            clients.values().cloned().collect()
        };
        clients.iter().for_each(|remote| remote.close(Closed::RunEnded));
        let end = shared.session.put(keys::end(&shared.run), "").priority(Priority::RealTime);
        let _ = end.congestion_control(CongestionControl::Block).express(true).wait();
        let began = Instant::now();
        let answers = || clients.iter().any(|remote| !remote.has_ended()) || !shared.ends.is_empty();
        while answers() && began.elapsed() < LAST_ANSWERS {
            std::thread::sleep(Duration::from_millis(1));
        }
        // The end of the declarations would overtake it, and look like a loss.
        std::thread::sleep(END_LEAD.saturating_sub(began.elapsed()));
    }
}

impl Shared {
    fn declare(self: &Arc<Self>) -> zenoh::Result<Vec<Box<dyn Send>>> {
        let mut declared: Vec<Box<dyn Send>> = Vec::new();
        let weak: Weak<Self> = Arc::downgrade(self);
        let requests = self.session.declare_queryable(keys::requests(&self.run));
        let at_request = weak.clone();
        declared.push(Box::new(
            requests
                .callback(move |query| {
                    if let Some(shared) = at_request.upgrade() {
                        shared.receive(query);
                    }
                })
                .wait()?,
        ));
        let tokens = self.session.liveliness().declare_subscriber(keys::client(&self.run, "*", "*")).history(true);
        let at_token = weak.clone();
        declared.push(Box::new(
            tokens
                .callback(move |sample| {
                    if let Some(shared) = at_token.upgrade() {
                        shared.see_token(&sample);
                    }
                })
                .wait()?,
        ));
        let beats = self.session.declare_subscriber(keys::beat(&self.run, "*", "*"));
        declared.push(Box::new(
            beats
                .callback(move |sample| {
                    if let Some(shared) = weak.upgrade() {
                        shared.see_beat(&sample);
                    }
                })
                .wait()?,
        ));
        declared.extend(streams::publish(&self.session, &self.run, &self.socket)?);
        // Last: who sees it can ask.
        declared.push(Box::new(self.session.liveliness().declare_token(keys::alive(&self.run)).wait()?));
        Ok(declared)
    }

    fn endpoints(&self) -> Vec<String> {
        self.config.listen.iter().chain(&self.config.connect).map(ToString::to_string).collect()
    }

    fn titles(&self) -> Vec<String> {
        lock(&self.clients).values().map(|remote| remote.title()).collect()
    }

    /// Takes a request, or refuses it. Never waits.
    fn receive(&self, query: Query) {
        match self.checked(&query) {
            Ok((_, _, method, params, _)) if method == PAGE => {
                if let Some((query, error)) = self.pages.queue(query, params) {
                    self.refuse(query, error);
                }
            }
            Ok((who, Class::End, method, params, _)) => {
                let name = lock(&self.clients).get(&who).map_or_else(|| who.short(), |known| lock(&known.name).clone());
                tracing::warn!("share: {method} by {}", who.title(&name));
                if let Some((query, error)) = self.end(query, (&who.user, method, params)) {
                    self.refuse(query, error);
                }
            }
            Ok((who, class, method, params, bytes)) => match self.proved_client(&who, &query) {
                Ok(remote) => {
                    remote.is_alive();
                    if let Some(query) = remote.queue(Request { query, class, method, params, bytes }) {
                        self.refuse(query, remote.over(&self.run));
                    }
                }
                Err(error) => self.refuse(query, error),
            },
            Err(error) => self.refuse(query, error),
        }
    }

    /// Refuses a request on a separate thread: this one receives and sends everything, and must not wait. Beyond what
    /// may wait there, a request gets no reply.
    fn refuse(&self, query: Query, error: RpcError) {
        let _ = self.refused.try_send((query, error));
    }

    fn checked(&self, query: &Query) -> Result<(Who, Class, String, Value, usize), RpcError> {
        let key = query.key_expr().as_str();
        let Some((who, class, method)) = Who::of_request(key, &self.run) else {
            let text = "the key names no client, class and method, or several";
            return Err(RpcError::new(Code::Malformed, text).hint("docs/many-machines.md lists the keys"));
        };
        match class_of(method) {
            None => return Err(RpcError::unknown(Code::UnknownMethod, "method", method, METHODS)),
            Some(right) if right != class => {
                let text = format!("`{method}` is of the class {}, not {}", right.name(), class.name());
                return Err(RpcError::new(Code::Malformed, text));
            }
            Some(_) => permit(&who.user, method, class, &self.config)?,
        }
        let proof = query.attachment().map_or(0, ZBytes::len);
        if ![0, PROOF].contains(&proof) || !query.parameters().is_empty() {
            let text = format!("a request has an attachment of {PROOF} bytes or none, and no parameters in its key");
            return Err(RpcError::new(Code::Malformed, text));
        }
        let bytes = query.payload().map_or(0, |payload| payload.len());
        let limit = if method == PlannerAnswer::NAME { MAX_ANSWER } else { MAX_LINE } - ENVELOPE;
        if bytes > limit {
            let error = RpcError::new(Code::TooLarge, format!("the request has {bytes} bytes (limit {limit})"));
            return Err(error.hint("send less at once"));
        }
        let payload = query.payload().map(|payload| payload.to_bytes()).unwrap_or_default();
        let params = match payload.is_empty() {
            true => Value::Null,
            false => serde_json::from_slice(&payload)
                .map_err(|e| RpcError::new(Code::Malformed, format!("not JSON: {e}")))?,
        };
        if !params.is_object() && !params.is_null() {
            return Err(RpcError::new(Code::Malformed, "the payload is not a JSON object with the parameters"));
        }
        self.still_commands(&who, method, class)?;
        Ok((who, class, method.to_owned(), params, bytes))
    }
}

fn failed(text: String) -> RpcError {
    RpcError::new(Code::Internal, text)
}

/// Sends what the gateway says of itself.
fn register(control: &mut UnixStream, gateway: &RegisterGateway) -> io::Result<()> {
    let line = json!({"id": 1, "method": RegisterGateway::NAME, "params": gateway});
    control.write_all(format!("{line}\n").as_bytes())
}

/// Reads the first reply: whether this is the run's only gateway.
fn accepted(replies: &mut impl BufRead) -> Result<(), RpcError> {
    let mut line = String::new();
    replies.read_line(&mut line).map_err(|e| failed(format!("the run does not answer: {e}")))?;
    let mut reply: Value = serde_json::from_str(&line).map_err(|e| failed(format!("reply of the run: {e}")))?;
    match serde_json::from_value(reply["error"].take()) {
        Ok(error) => Err(error),
        Err(_) => Ok(()),
    }
}
