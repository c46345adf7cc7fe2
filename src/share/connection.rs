//! The client's end: a connection to a run on another computer that looks like one to a run's socket.
//!
//! ```text
//!  Client ═ socket pair ═ thread `line` ─ queries, beats ─▶ zenoh ─▶ gateway ─▶ the run's socket
//!         ◀═ thread `line-out` ◀─ replies, streams, "lost" ─┘
//! ```
//!
//! So every verb works over it unchanged, and a client that does not read delays neither the network nor the gateway.

use std::collections::BTreeMap;
use std::io::{self, BufRead, BufReader, Write};
use std::net::{Shutdown, TcpStream, ToSocketAddrs};
use std::os::unix::net::UnixStream;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, channel, sync_channel};
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use zenoh::bytes::ZBytes;
use zenoh::qos::CongestionControl;
use zenoh::query::{ConsolidationMode, Reply};
use zenoh::sample::SampleKind;
use zenoh::{Session, Wait};

use super::class::class_of;
use super::gateway::PROOF;
use super::place::Place;
use super::{certificates, keys, settings};
use dimos_core::random;
use dimos_rpc::api::{METHODS, Method};
use dimos_rpc::client::{Client, ClientError};
use dimos_rpc::error::{Code, RpcError};
use dimos_rpc::server::CALL_TIMEOUT;
use dimos_rpc::server::streams::{Stream, Subscribe, Unsubscribe};

/// Pause between two beats: a gateway takes a client for lost after 0.3 s or more without one.
const BEAT: Duration = Duration::from_millis(100);
/// Timeout for a reply: longer than the run's own, shorter than that of [`Client`].
const REPLY_TIMEOUT: Duration = CALL_TIMEOUT.saturating_add(Duration::from_secs(1));
/// Timeout for the list of the runs of a place. A gateway answers at once; a router asks all of them.
const LIST_TIMEOUT: Duration = Duration::from_millis(600);
/// Lines kept for a client that does not read.
const QUEUE: usize = 1024;
/// Numbers of the subscriptions that are served here begin with this one; a run's own are below it.
const OWN_SUBSCRIPTIONS: u64 = 1 << 32;

/// What to do after a loss.
const MAY_TAKE_EFFECT: &str = "a request that was pending may still take effect: `dimos status --at` shows it";

/// Opens a session with a place. `timeout`: maximum time until something there accepts a connection.
pub(super) fn open(place: &Place, timeout: Duration) -> Result<Session, RpcError> {
    let (name, endpoint) = (&place.name, &place.endpoint);
    let unreachable = |text: String| RpcError::new(Code::Unreachable, text);
    if let Some(identity) = &place.identity {
        certificates::check(identity, &place.user)?;
    }
    // zenoh reports a refused connection, a refused certificate and a wrong name in the same words.
    let address = format!("{}:{}", endpoint.host.trim_start_matches('[').trim_end_matches(']'), endpoint.port);
    let host = endpoint.host.trim_start_matches('[').trim_end_matches(']');
    let addresses = (host, endpoint.port).to_socket_addrs().map_err(|e| {
        unreachable(format!("{name}: the name {host} is not known: {e}"))
            .hint("check the name in `--at`, or use the IP address")
    })?;
    let reached = addresses.into_iter().any(|a| TcpStream::connect_timeout(&a, timeout).is_ok());
    if !reached {
        let hint = "start it there: `dimos share`, or `share:` in the blueprint; or check address and firewall";
        return Err(unreachable(format!("{name}: nothing listens at {address}")).hint(hint));
    }
    zenoh::open(settings::of_client(place)?).wait().map_err(|error| {
        tracing::debug!("{name}: {error}");
        if endpoint.tls {
            let text = format!("{name}: {address} answers, but one side refused the certificate of the other");
            let hint = "the name in --at must be one of the certificate there, and one CA must have signed both; \
                        or what listens there speaks no TLS";
            return unreachable(text).hint(hint);
        }
        let text = format!("{name}: what listens at {address} does not speak to us");
        unreachable(text).hint("it may want certificates: try tls/ in place of tcp/; or it is another program")
    })
}

/// Returns the names of the runs that a place shares with us.
pub(super) fn runs(session: &Session) -> Vec<String> {
    let (found, received) = channel();
    let asked = session.liveliness().get(keys::alive("*")).timeout(LIST_TIMEOUT).callback(move |reply| {
        if let Ok(sample) = reply.result() {
            let _ = found.send(keys::run_of_alive(sample.key_expr().as_str()).map(str::to_owned));
        }
    });
    if asked.wait().is_err() {
        return Vec::new();
    }
    // Ends when all have answered.
    let mut names: Vec<String> = received.into_iter().flatten().collect();
    names.sort();
    names.dedup();
    names
}

/// Connects to a run at a place.
pub(super) fn connect(session: Session, place: &Place, run: &str) -> Result<Client, ClientError> {
    let failed = |error| ClientError::Io { run: run.to_owned(), error };
    let (ours, theirs) = UnixStream::pair().map_err(failed)?;
    serve(session, place, run, theirs).map_err(failed)?;
    Client::of_stream(ours, run).map_err(failed)
}

/// Makes the other end of a socket look like that of a run at a place.
pub(super) fn serve(session: Session, place: &Place, run: &str, socket: UnixStream) -> io::Result<()> {
    Line::start(session, place, run, socket).map(drop)
}

/// Returns the error in a reply; `None`: it is not one of ours.
pub(super) fn error_of(payload: &ZBytes) -> Option<RpcError> {
    serde_json::from_slice(&payload.to_bytes()).ok()
}

/// A connection to a run.
struct Line {
    session: Session,
    place: String,
    run: String,
    user: String,
    id: String,
    /// Goes with every request and beat: another program of the same user cannot speak for this one.
    proof: [u8; PROOF],
    /// Lines to the client.
    out: SyncSender<String>,
    /// Whether the gateway is live.
    alive: AtomicBool,
}

impl Line {
    fn start(session: Session, place: &Place, run: &str, socket: UnixStream) -> io::Result<Arc<Self>> {
        let (out, lines) = sync_channel(QUEUE);
        let line = Arc::new(Self {
            id: session.zid().to_string(),
            proof: random::bytes()?,
            session,
            place: place.name.clone(),
            run: run.to_owned(),
            user: place.user.clone(),
            out,
            alive: AtomicBool::new(true),
        });
        let to = socket.try_clone()?;
        let thread = |name: &str| std::thread::Builder::new().name(name.into());
        thread("line-out").spawn(move || write(to, &lines))?;
        let serving = line.clone();
        thread("line").spawn(move || serving.serve(socket))?;
        Ok(line)
    }

    /// Passes the client's requests on until it closes its end, or the gateway is lost.
    fn serve(self: Arc<Self>, from: UnixStream) {
        let ended = match self.announce() {
            Ok(ended) => ended,
            Err(error) => return self.over(Code::Lost, format!("{}: {error}", self.place)),
        };
        let mut subscribers = BTreeMap::new();
        for line in BufReader::new(from).split(b'\n') {
            let Ok(line) = line else { break };
            self.pass_on(&line, &mut subscribers);
        }
        drop(ended);
        drop(subscribers);
        let _ = self.session.close().wait();
    }

    /// Declares this client, watches the gateway, and starts the beats. They end when the result is dropped.
    fn announce(self: &Arc<Self>) -> zenoh::Result<(SyncSender<()>, Box<dyn Send>)> {
        let token = self.session.liveliness().declare_token(keys::client(&self.run, &self.user, &self.id)).wait()?;
        let weak = Arc::downgrade(self);
        // With its history: the end of a token that was there before is not reported otherwise.
        let watching = self.session.liveliness().declare_subscriber(keys::alive(&self.run)).history(true);
        let watching = watching.callback(move |sample| {
            if let (SampleKind::Delete, Some(line)) = (sample.kind(), weak.upgrade()) {
                line.gateway_gone();
            }
        });
        let watching = watching.wait()?;
        let streams = self.subscribe_to(keys::to(&self.run, &self.user, &self.id, "*"), |out, payload| {
            // A line of the run, as it is.
            let _ = out.try_send(String::from_utf8_lossy(payload).into_owned() + "\n");
        })?;
        let weak = Arc::downgrade(self);
        let ended = self.session.declare_subscriber(keys::end(&self.run)).callback(move |_| {
            if let Some(line) = weak.upgrade() {
                line.over(Code::ShuttingDown, format!("run {} at {} has ended", line.run, line.place));
            }
        });
        let ended = ended.wait()?;
        self.beat();
        let (beats, beaten) = sync_channel::<()>(0);
        let weak = Arc::downgrade(self);
        std::thread::Builder::new().name("line-beat".into()).spawn(move || beat_until(&beaten, &weak))?;
        Ok((beats, Box::new((token, watching, ended, streams))))
    }

    fn beat(&self) {
        let name = program_and_host();
        let sent = self.session.put(keys::beat(&self.run, &self.user, &self.id), name);
        let _ = sent.attachment(self.proof).congestion_control(CongestionControl::Block).express(true).wait();
    }

    fn subscribe_to(
        &self,
        key: String,
        each: impl Fn(&SyncSender<String>, &[u8]) + Send + Sync + 'static,
    ) -> zenoh::Result<Box<dyn Send>> {
        let out = self.out.clone();
        let declared =
            self.session.declare_subscriber(key).callback(move |sample| each(&out, &sample.payload().to_bytes()));
        Ok(Box::new(declared.wait()?))
    }

    /// Passes a request on, or answers it. `subscribers`: the subscriptions that are served here, by number.
    fn pass_on(self: &Arc<Self>, line: &[u8], subscribers: &mut BTreeMap<u64, Box<dyn Send>>) {
        let Ok(request) = serde_json::from_slice::<Value>(line) else { return };
        let (id, method) = (request["id"].clone(), request["method"].as_str().unwrap_or_default().to_owned());
        let params = &request["params"];
        if method == Subscribe::NAME
            && params.get("rate").is_none_or(Value::is_null)
            && params["past"] != true
            && let Some(stream) = params["stream"].as_str().and_then(Stream::of_name)
        {
            let number = OWN_SUBSCRIPTIONS + subscribers.len() as u64;
            return self.answer(
                &id,
                self.subscribe(stream, number).map(|subscriber| {
                    subscribers.insert(number, subscriber);
                    json!({"subscription": number})
                }),
            );
        }
        if method == Unsubscribe::NAME
            && let Some(subscriber) = params["subscription"].as_u64().and_then(|number| subscribers.get_mut(&number))
        {
            // Its number is not used again.
            *subscriber = Box::new(());
            return self.answer(&id, Ok(json!({})));
        }
        let Some(class) = class_of(&method) else {
            return self.answer(&id, Err(RpcError::unknown(Code::UnknownMethod, "method", &method, METHODS)));
        };
        let pending =
            Pending { line: self.clone(), id, method, sent: Instant::now(), answered: AtomicBool::new(false) };
        let key = keys::request(&self.run, &self.user, class, &self.id, &pending.method);
        let asked = self.session.get(key).payload(params.to_string()).timeout(REPLY_TIMEOUT);
        let asked = asked.attachment(self.proof);
        let asked =
            asked.congestion_control(CongestionControl::Block).express(true).consolidation(ConsolidationMode::None);
        // If it fails, the callback is dropped, and with it what is pending.
        let _ = asked.callback(move |reply| pending.answered_with(&reply)).wait();
    }

    /// Subscribes to what the gateway publishes for all.
    fn subscribe(&self, stream: Stream, number: u64) -> Result<Box<dyn Send>, RpcError> {
        let next = AtomicU64::new(0);
        let key = keys::stream(&self.run, stream.name());
        let subscriber = self.subscribe_to(key, move |out, payload| {
            let Ok(mut message) = serde_json::from_slice::<Value>(payload) else { return };
            let seq = message["seq"].as_u64().unwrap_or_default();
            let missed = match next.load(Ordering::Relaxed) {
                0 => 0,
                expected => seq.saturating_sub(expected),
            };
            let data = message["data"].take();
            let line = json!({"stream": stream.name(), "subscription": number, "lost": missed, "data": data});
            if out.try_send(format!("{line}\n")).is_ok() {
                next.store(seq + 1, Ordering::Relaxed);
            }
        });
        subscriber.map_err(|e| RpcError::new(Code::Internal, format!("{}: {e}", self.place)))
    }

    fn answer(&self, id: &Value, result: Result<Value, RpcError>) {
        let line = match result {
            Ok(result) => json!({"id": id, "result": result}),
            Err(error) => json!({"id": id, "error": error}),
        };
        // Fails only when the connection ends.
        let _ = self.out.send(format!("{line}\n"));
    }

    /// Sends the client the reason why the connection is over, and ends it.
    fn over(&self, code: Code, text: String) {
        if self.alive.swap(false, Ordering::AcqRel) {
            self.answer(&Value::Null, Err(RpcError::new(code, text).hint(MAY_TAKE_EFFECT)));
            let _ = self.out.send(String::new());
        }
    }

    fn gateway_gone(&self) {
        let text = format!("the connection to {} is lost", self.place);
        self.over(Code::Lost, text);
    }
}

/// Beats until the connection ends.
fn beat_until(ended: &Receiver<()>, line: &Weak<Line>) {
    while ended.recv_timeout(BEAT) == Err(RecvTimeoutError::Timeout) {
        match line.upgrade() {
            Some(line) => line.beat(),
            None => return,
        }
    }
}

/// Writes lines to the client; an empty one ends the connection.
fn write(mut to: UnixStream, lines: &Receiver<String>) {
    for line in lines {
        if line.is_empty() || to.write_all(line.as_bytes()).is_err() {
            let _ = to.shutdown(Shutdown::Both);
            return;
        }
    }
}

/// A request without a reply yet. When it is dropped without one, the client gets the reason.
struct Pending {
    line: Arc<Line>,
    id: Value,
    method: String,
    sent: Instant,
    answered: AtomicBool,
}

impl Pending {
    fn answered_with(&self, reply: &Reply) {
        let value = |payload: &ZBytes| serde_json::from_slice::<Value>(&payload.to_bytes()).ok();
        let result = match reply.result() {
            Ok(sample) => value(sample.payload()).map(Ok),
            Err(error) => error_of(error.payload()).map(Err),
        };
        // What is not ours (zenoh reports its own timeout so) counts as no reply.
        if let Some(result) = result
            && !self.answered.swap(true, Ordering::AcqRel)
        {
            self.line.answer(&self.id, result);
        }
    }
}

impl Drop for Pending {
    fn drop(&mut self) {
        if self.answered.load(Ordering::Acquire) || !self.line.alive.load(Ordering::Acquire) {
            return;
        }
        let (line, method) = (&self.line, &self.method);
        let waited = self.sent.elapsed();
        let error = if waited >= REPLY_TIMEOUT.mul_f64(0.95) {
            let text = format!("{}: {method:?} was not answered within {:.0} s", line.place, waited.as_secs_f64());
            RpcError::new(Code::NoAnswer, text).hint("it may still take effect; ask for `status`")
        } else {
            let text = format!("the connection to {} is lost: no answer to {method:?}", line.place);
            RpcError::new(Code::Lost, text).hint(MAY_TAKE_EFFECT)
        };
        self.line.answer(&self.id, Err(error));
    }
}

/// Returns what this client calls itself: `dimos jog on laptop`. Shown to people, and nothing else.
fn program_and_host() -> String {
    let mut words = std::env::args();
    let program = words.next().unwrap_or_default();
    let program = program.rsplit('/').next().unwrap_or_default();
    let mut verb = words.next().unwrap_or_default();
    // `--at PLACE` may stand before the verb.
    if verb == "--at" {
        verb = words.nth(1).unwrap_or_default();
    }
    let verb = if verb.starts_with('-') || verb.is_empty() { String::new() } else { format!(" {verb}") };
    format!("{program}{verb} on {}", rustix::system::uname().nodename().to_string_lossy())
}
