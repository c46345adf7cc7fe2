//! A client on another computer: a connection to the run's socket, with its own thread and queue.

use std::collections::BTreeMap;
use std::io;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, OnceLock};
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use tokio::io::{AsyncBufReadExt, AsyncWriteExt, BufReader, Lines};
use tokio::net::UnixStream;
use tokio::net::unix::{OwnedReadHalf, OwnedWriteHalf};
use tokio::sync::mpsc::error::TrySendError;
use tokio::sync::mpsc::{Receiver, Sender, channel};
use tokio::sync::watch;
use zenoh::bytes::Encoding;
use zenoh::qos::Priority;
use zenoh::query::Query;
use zenoh::{Session, Wait};

use super::keys::{self, Who};
use dimos_core::sync::lock;
use dimos_rpc::api::Class;
use dimos_rpc::api::{Method, OnBehalfOf, PLANNER_REQUESTS, RegisterPlanner, Release};
use dimos_rpc::client::reach;
use dimos_rpc::error::{Code, RpcError};

/// Requests of a client that may wait for their replies; more are refused.
const MAX_PENDING: usize = 32;
/// Requests that may wait to be refused; beyond, they are dropped.
const QUEUE: usize = 1024;
/// Bytes of requests that may wait.
const MAX_QUEUED: usize = 32 << 20;
/// Id of the first request, which says for whom the connection speaks.
const BEHALF: u64 = 0;
/// Time within which a run that closes a connection turns out to have ended: on a busy computer it takes a while from
/// the end of its connections to that of its name.
const END_TIMEOUT: Duration = Duration::from_millis(500);
/// Encoding of an error.
const ERROR_SCHEMA: &str = "dimos-error";

/// A request, checked as far as its key and form go.
pub(super) struct Request {
    pub query: Query,
    pub class: Class,
    pub method: String,
    pub params: Value,
    /// Length of the payload [bytes].
    pub bytes: usize,
}

/// A client.
pub(super) struct Remote {
    pub who: Who,
    /// What it calls itself.
    pub name: Mutex<String>,
    /// Its last sign of life: a beat, a request, its token.
    pub seen: Mutex<Instant>,
    /// Whether its token was seen.
    pub has_token: AtomicBool,
    /// Whether it may hold a lease, or is the planner: then silence matters.
    pub commands: AtomicBool,
    /// Attachment of its requests and beats, set by its first request: a program with the same id and another one is
    /// not this client.
    pub proof: OnceLock<Vec<u8>>,
    queue: Queue,
    end: watch::Sender<Option<Closed>>,
}

/// Why the connections of a client were closed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Closed {
    /// It is lost, or the run has refused it.
    Lost,
    /// The run has ended.
    RunEnded,
}

/// The queue to one connection.
struct Queue {
    to: Sender<Request>,
    waiting: AtomicUsize,
}

/// What the threads of a client need.
pub(super) struct Ways<'a> {
    pub session: &'a Session,
    pub run: &'a str,
    pub socket: &'a Path,
    pub cancel_at_end: bool,
}

impl Remote {
    /// Starts the thread of a client.
    pub fn start(who: Who, ways: &Ways<'_>) -> io::Result<Arc<Self>> {
        let (to, requests) = channel(QUEUE);
        let remote = Arc::new(Self {
            name: Mutex::new(who.short()),
            who,
            seen: Mutex::new(Instant::now()),
            has_token: AtomicBool::new(false),
            commands: AtomicBool::new(false),
            proof: OnceLock::new(),
            queue: Queue { to, waiting: AtomicUsize::new(0) },
            end: watch::Sender::new(None),
        });
        let connection = Connection {
            remote: remote.clone(),
            session: ways.session.clone(),
            run: ways.run.to_owned(),
            pending: BTreeMap::new(),
            next: BEHALF + 1,
        };
        let (socket, behalf) = (ways.socket.to_owned(), ways.cancel_at_end);
        std::thread::Builder::new().name("client".into()).spawn(move || {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_io().enable_time().build();
            let served = runtime.map(|runtime| runtime.block_on(connection.serve(requests, &socket, behalf)));
            if let Err(e) = served {
                tracing::warn!("share: cannot serve a client: {e}");
            }
        })?;
        Ok(remote)
    }

    /// Returns the client as people know it: `alice (dimos jog on laptop)`.
    pub fn title(&self) -> String {
        self.who.title(&lock(&self.name))
    }

    /// Notes a sign of life.
    pub fn is_alive(&self) {
        *lock(&self.seen) = Instant::now();
    }

    /// Returns the time since its last sign of life.
    pub fn silence(&self) -> Duration {
        lock(&self.seen).elapsed()
    }

    /// Queues a request. Drops it if too much waits: nothing here waits for the client or the run. Returns a request
    /// that comes after the end of the connections.
    pub fn queue(&self, request: Request) -> Option<Query> {
        let (queue, bytes) = (&self.queue, request.bytes);
        let waiting = queue.waiting.fetch_add(bytes, Ordering::AcqRel) + bytes;
        let sent = if waiting > MAX_QUEUED { Err(TrySendError::Full(request)) } else { queue.to.try_send(request) };
        let Err(unsent) = sent else { return None };
        queue.waiting.fetch_sub(bytes, Ordering::AcqRel);
        match unsent {
            TrySendError::Full(_) => None,
            TrySendError::Closed(request) => Some(request.query),
        }
    }

    /// Returns the error of a request that comes after the end of the connections.
    pub fn over(&self, run: &str) -> RpcError {
        match *self.end.borrow() {
            Some(Closed::RunEnded) => ended(run),
            Some(Closed::Lost) | None => {
                RpcError::new(Code::Lost, "the gateway has closed the connection of this client")
            }
        }
    }

    /// Closes its connections: its leases end.
    pub fn close(&self, why: Closed) {
        // The first reason is the cause of later ones.
        self.end.send_if_modified(|closed| closed.is_none() && closed.replace(why).is_none());
    }

    /// Returns whether it was closed.
    pub fn is_closed(&self) -> bool {
        self.end.borrow().is_some()
    }

    /// Returns whether its threads have answered what was pending, and have ended.
    pub fn has_ended(&self) -> bool {
        self.end.receiver_count() == 0
    }
}

/// Returns the error of all requests to a run that has ended.
pub(super) fn ended(run: &str) -> RpcError {
    RpcError::new(Code::ShuttingDown, format!("run {run} has ended"))
}

/// Sends a refusal.
pub(super) fn refuse(query: &Query, error: &RpcError) {
    let body = serde_json::to_vec(error).unwrap_or_default();
    let _ = query.reply_err(body).encoding(Encoding::APPLICATION_JSON.with_schema(ERROR_SCHEMA)).wait();
}

/// One connection to the run.
struct Connection {
    remote: Arc<Remote>,
    session: Session,
    run: String,
    /// Requests without a reply, by number, with their methods.
    pending: BTreeMap<u64, Request>,
    next: u64,
}

impl Connection {
    /// Serves until the connection ends, and refuses what is without a reply then.
    async fn serve(mut self, mut requests: Receiver<Request>, socket: &Path, behalf: bool) {
        let mut end = self.remote.end.subscribe();
        let connected = reach::wait_for(socket).map_err(io::Error::from);
        let connected = connected.and_then(|stream| stream.set_nonblocking(true).map(|()| stream));
        let connected = connected.and_then(UnixStream::from_std);
        let refused = connected.as_ref().err().map(ToString::to_string);
        if let Ok(stream) = connected {
            self.exchange(stream, &mut requests, &mut end, Some(behalf)).await;
        }
        // A run that ends closes all connections: this one perhaps first.
        let is_closed = tokio::time::timeout(END_TIMEOUT, end.wait_for(Option::is_some)).await.is_ok();
        if let Some(why) = refused.filter(|_| !is_closed) {
            tracing::warn!("share: the run does not accept a connection: {why}");
        }
        self.remote.close(Closed::Lost);
        let error = self.remote.over(&self.run);
        for request in self.pending.values() {
            refuse(&request.query, &error.clone().hint("it may still take effect; ask for `status`"));
        }
        // The run has seen nothing of the others.
        requests.close();
        while let Ok(request) = requests.try_recv() {
            refuse(&request.query, &error);
        }
    }

    /// Passes requests and replies on until either side ends the connection. `behalf`: whether motions are cancelled
    /// with it, to be said before the first request.
    async fn exchange(
        &mut self,
        stream: UnixStream,
        requests: &mut Receiver<Request>,
        end: &mut watch::Receiver<Option<Closed>>,
        mut behalf: Option<bool>,
    ) {
        let (from, to) = stream.into_split();
        let mut from = BufReader::new(from).lines();
        let (lines, waiting) = channel(2 * MAX_PENDING);
        let writer = tokio::spawn(write(to, waiting));
        loop {
            tokio::select! {
                biased;
                _ = end.wait_for(Option::is_some) => break,
                line = next_line(&mut from) => match line {
                    Some(line) => self.take(line),
                    None => break,
                },
                Some(request) = requests.recv() => {
                    self.remote.queue.waiting.fetch_sub(request.bytes, Ordering::AcqRel);
                    // A client says its name before it asks.
                    if let Some(cancel_at_end) = behalf.take() {
                        let behalf = OnBehalfOf { client: self.remote.title(), cancel_at_end };
                        let line = json!({"id": BEHALF, "method": OnBehalfOf::NAME, "params": behalf});
                        let _ = lines.send(format!("{line}\n")).await;
                    }
                    if let Some(line) = self.ask(request)
                        && lines.send(line).await.is_err()
                    {
                        break;
                    }
                }
            }
        }
        writer.abort();
    }

    /// Returns the line of a request for the run; `None` if too many wait already.
    fn ask(&mut self, request: Request) -> Option<String> {
        if self.pending.len() >= MAX_PENDING {
            let error = RpcError::new(Code::TooManyRequests, format!("{MAX_PENDING} requests wait for their replies"));
            refuse(&request.query, &error.hint("wait for replies before you send more"));
            return None;
        }
        let number = self.next;
        self.next += 1;
        let mut request = request;
        let line = json!({"id": number, "method": request.method, "params": request.params.take()});
        self.pending.insert(number, request);
        Some(format!("{line}\n"))
    }

    /// Passes a line of the run on to the client.
    fn take(&mut self, line: String) {
        let Ok(mut incoming) = serde_json::from_str::<Value>(&line) else { return };
        if let Some(stream) = incoming["stream"].as_str() {
            let key = keys::to(&self.run, &self.remote.who.user, &self.remote.who.id, stream);
            let priority = if stream == PLANNER_REQUESTS { Priority::DataHigh } else { Priority::RealTime };
            let _ = self.session.put(key, line).priority(priority).express(true).wait();
            return;
        }
        // The run refuses the connection, and with it all that was asked.
        if incoming["id"].is_null()
            && let Ok(error) = serde_json::from_value::<RpcError>(incoming["error"].take())
        {
            std::mem::take(&mut self.pending).into_values().for_each(|request| refuse(&request.query, &error));
            return;
        }
        let Some(request) = incoming["id"].as_u64().and_then(|id| self.pending.remove(&id)) else { return };
        match serde_json::from_value::<RpcError>(incoming["error"].take()) {
            Ok(error) => refuse(&request.query, &error),
            Err(_) => {
                self.remote.note(&request);
                let result = incoming["result"].take().to_string();
                let _ = request.query.reply(request.query.key_expr().clone(), result).express(true).wait();
            }
        }
    }
}

impl Remote {
    /// Notes what an accepted request means for the lease.
    fn note(&self, request: &Request) {
        match request.method.as_str() {
            Release::NAME => {}
            RegisterPlanner::NAME => self.commands.store(true, Ordering::Release),
            _ if request.class == Class::Move => self.commands.store(true, Ordering::Release),
            _ => {}
        }
    }
}

/// Returns the next line; `None` when the run has closed the connection.
async fn next_line(from: &mut Lines<BufReader<OwnedReadHalf>>) -> Option<String> {
    from.next_line().await.ok().flatten()
}

/// Writes lines to the run. In a task of its own: a run whose replies are not read does not read requests.
async fn write(mut to: OwnedWriteHalf, mut lines: Receiver<String>) {
    while let Some(line) = lines.recv().await {
        if to.write_all(line.as_bytes()).await.is_err() {
            return;
        }
    }
}
