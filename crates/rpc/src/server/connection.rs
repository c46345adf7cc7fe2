//! The connection of one client: answers its requests in order, while its subscriptions send their messages. Every
//! queue is bounded; the requests of a client that does not read its replies are not read either.
//!
//! Each request completes before the next one begins, except targets of a stream: several may be pending until the tick
//! answers them.

use std::collections::{BTreeMap, VecDeque};
use std::future::{Future, poll_fn, ready};
use std::pin::Pin;
use std::sync::Arc;
use std::task::Poll;
use std::time::Duration;

use serde::Serialize;
use serde_json::Value;
use tokio::io::{AsyncBufRead, AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::net::UnixStream;
use tokio::net::unix::OwnedWriteHalf;
use tokio::sync::{mpsc, watch};
use tokio::task::{AbortHandle, JoinSet};
use tokio::time::{sleep, timeout};

use crate::api::{
    Backend, Done, Lease, LeaseReply, MAX_ANSWER, MAX_LINE, MAX_SUBSCRIPTIONS, METHODS, Method, OnBehalfOf,
    PlannerAnswer, RegisterGateway, RegisterPlanner, Registered, Release, Reply, Request, read_params,
};
use crate::error::{Code, RpcError};
use crate::server::CALL_TIMEOUT;
use crate::server::commanded::Commanded;
use crate::server::connection_limit::Permit;
use crate::server::lease::{Leases, Lessee, Subject, may_take_effect};
use crate::server::line_reader::{Line, read_line, skip_line};
use crate::server::planner_proxy::PlannerProxy;
use crate::server::streams::{Subscribe, SubscribeReply, Unsubscribe};
use crate::server::subscription::{RateLimit, Subscription};
use crate::server::urgent::Transfer;
use crate::wire;
use dimos_core::telemetry::Origin;

/// Maximum number of lines queued for the client.
const QUEUE: usize = 64;
/// Maximum number of pending targets of one client.
const MAX_PENDING: usize = 32;
/// Silence after which a connection returns to the thread that accepts connections.
const RETURN_AFTER: Duration = Duration::from_millis(250);
/// Maximum time for the client to take the last replies, and for discarding the rest of a line that is too long.
const CLOSE_TIMEOUT: Duration = Duration::from_secs(1);

/// Serves one client until it closes its end, sends a line that is too long, or must make room for another connection.
/// Returns a connection that is silent for a while: its next request may be one of those that always get through.
pub(crate) async fn serve(
    transfer: Transfer,
    backend: Arc<dyn Backend>,
    ended: watch::Receiver<bool>,
) -> Option<Transfer> {
    let Transfer { stream, read, lessee, permit } = transfer;
    let stream =
        UnixStream::from_std(stream).inspect_err(|e| tracing::warn!("rpc: cannot serve a connection: {e}")).ok()?;
    let (from_client, to_client) = stream.into_split();
    let (queue, waiting) = mpsc::channel(QUEUE);
    let mut writer = tokio::spawn(write(to_client, waiting));
    let mut from_client = BufReader::new(std::io::Cursor::new(read).chain(from_client));
    let connection = Connection {
        epoch: backend.epoch(),
        wanted: 0,
        backend,
        lessee,
        permit,
        queue,
        pending: VecDeque::new(),
        running: JoinSet::new(),
        subscriptions: BTreeMap::new(),
        next: 1,
        planner: None,
        behalf: None,
        is_gateway: false,
        ended,
    };
    let Some((lessee, permit)) = connection.answer_requests(&mut from_client).await else {
        if timeout(CLOSE_TIMEOUT, &mut writer).await.is_err() {
            writer.abort();
        }
        return None;
    };
    let written = tokio::select! {
        // The client may be slow to read its last replies.
        written = &mut writer => written.ok().flatten()?,
        _ = permit.evicted() => {
            writer.abort();
            return None;
        }
    };
    let (_, from_client) = from_client.into_inner().into_inner();
    let stream = from_client.reunite(written).ok()?.into_std().ok()?;
    Some(Transfer { stream, read: Vec::new(), lessee, permit })
}

/// Writes the queued lines; returns its half of the socket when the queue is closed and empty.
async fn write(mut to: OwnedWriteHalf, mut waiting: mpsc::Receiver<String>) -> Option<OwnedWriteHalf> {
    while let Some(line) = waiting.recv().await {
        // If the client has disconnected, dropping the queue ends the connection.
        to.write_all(line.as_bytes()).await.ok()?;
    }
    Some(to)
}

struct Connection {
    backend: Arc<dyn Backend>,
    /// Its leases; released with the connection.
    lessee: Lessee,
    permit: Permit,
    queue: mpsc::Sender<String>,
    /// Targets that the tick has not answered yet, the oldest first.
    pending: VecDeque<PendingTarget>,
    /// The subscriptions' tasks; dropping the set ends them.
    running: JoinSet<()>,
    subscriptions: BTreeMap<u64, AbortHandle>,
    /// Number of the next subscription.
    next: u64,
    /// The planner that registered on this connection.
    planner: Option<RegisteredPlanner>,
    /// If it speaks for a client of a gateway: whether the motions that began on it are cancelled with it.
    behalf: Option<(bool, Commanded)>,
    /// Whether the run's gateway registered on it.
    is_gateway: bool,
    /// Whether the run ends.
    ended: watch::Receiver<bool>,
    /// The run's epoch when the connection last waited for a line. Lines that were there already may be as old.
    epoch: u64,
    /// The epoch of the request that is answered.
    wanted: u64,
}

/// A registered planner; closed when dropped.
struct RegisteredPlanner(Arc<PlannerProxy>);

impl Drop for RegisteredPlanner {
    fn drop(&mut self) {
        self.0.close();
    }
}

/// Future result of a request.
type Answer = Pin<Box<dyn Future<Output = Result<Reply, RpcError>> + Send>>;

/// A target that the tick has not answered yet.
struct PendingTarget {
    id: Value,
    /// Arms whose leases it needs.
    arms: Vec<String>,
    answer: Answer,
}

/// The client has disconnected.
struct Disconnected;

impl Connection {
    /// Answers requests until the connection ends (`None`) or is silent for [`RETURN_AFTER`].
    async fn answer_requests(mut self, from: &mut (impl AsyncBufRead + Unpin)) -> Option<(Lessee, Permit)> {
        if self.is_silent(from).await {
            return Some((self.lessee, self.permit));
        }
        if let Some((true, commanded)) = &mut self.behalf {
            commanded.cancel(&self.lessee, &*self.backend).await;
        }
        None
    }

    /// Answers requests. Returns whether the connection is silent, and has not ended.
    async fn is_silent(&mut self, from: &mut (impl AsyncBufRead + Unpin)) -> bool {
        let (mut line, mut ended) = (Vec::new(), self.ended.clone());
        loop {
            let (max_line, mut waited) = (self.max_line(), false);
            if self.pending.is_empty() {
                self.permit.set_pinned(!self.subscriptions.is_empty() || self.planner.is_some() || self.is_gateway);
                self.permit.set_idle();
            }
            let read = tokio::select! {
                biased;
                reason = self.permit.evicted() => {
                    let _ = timeout(CLOSE_TIMEOUT, self.reply::<Done>(&Value::Null, Err(reason))).await;
                    return false;
                }
                () = until(&mut ended), if self.is_gateway => {
                    // The end of a run that is killed is silent.
                    let reason = RpcError::new(Code::ShuttingDown, "the run has ended");
                    let _ = timeout(CLOSE_TIMEOUT, self.reply::<Done>(&Value::Null, Err(reason))).await;
                    return false;
                }
                done = oldest(&mut self.pending), if !self.pending.is_empty() => {
                    if self.send_oldest(done).await.is_err() {
                        return false;
                    }
                    continue;
                }
                // Polled before the line, so that no bytes are read that would be lost with the transfer.
                () = sleep(RETURN_AFTER), if line.is_empty() && self.is_plain() => {
                    if line.is_empty() {
                        return true;
                    }
                    continue;
                }
                read = noting_a_wait(read_line(from, &mut line, max_line), &mut waited),
                    if self.pending.len() < MAX_PENDING => read,
            };
            if waited {
                self.epoch = self.backend.epoch();
            }
            match read {
                Line::Complete => self.permit.set_busy(),
                Line::End => {
                    let _ = self.finish_pending().await;
                    return false;
                }
                Line::TooLong => {
                    let error = RpcError::new(Code::TooLarge, format!("the line is longer than {max_line} bytes"));
                    let error = error.hint("send less at once; the connection is closed now");
                    let _ = self.reply::<Done>(&Value::Null, Err(error)).await;
                    let _ = timeout(CLOSE_TIMEOUT, skip_line(from)).await;
                    return false;
                }
            }
            if !line.trim_ascii().is_empty() && self.answer(&line).await.is_err() {
                return false;
            }
            line.clear();
        }
    }

    /// Returns whether the connection only sends requests and receives replies.
    fn is_plain(&self) -> bool {
        self.pending.is_empty() && self.next == 1 && self.planner.is_none() && self.behalf.is_none() && !self.is_gateway
    }

    async fn answer(&mut self, line: &[u8]) -> Result<(), Disconnected> {
        let wire::Envelope { id, method, params, epoch } = match wire::read(line) {
            Ok(envelope) => envelope,
            Err((id, error)) => return self.reply::<Done>(&id, Err(error)).await,
        };
        // A client may want what it wanted longer ago, never later.
        self.wanted = epoch.map_or(self.epoch, |epoch| epoch.min(self.epoch));
        match method.as_str() {
            Subscribe::NAME => match self.subscribe(params) {
                Ok((reply, subscription)) => {
                    self.reply(&id, Ok(reply)).await?; // before the first message
                    let handle = self.running.spawn(subscription.forward(self.queue.clone()));
                    self.subscriptions.insert(reply.subscription, handle);
                    Ok(())
                }
                Err(error) => self.reply::<Done>(&id, Err(error)).await,
            },
            Unsubscribe::NAME => {
                let result = self.unsubscribe(params);
                self.reply(&id, result).await
            }
            Lease::NAME => {
                let result = self.lease(params).await;
                self.reply(&id, result).await
            }
            Release::NAME => {
                self.finish_pending().await?; // the pending targets were sent under the lease
                let result = self.release(params);
                self.reply(&id, result).await
            }
            RegisterPlanner::NAME => {
                let result = self.register_planner(params);
                self.reply(&id, result).await
            }
            PlannerAnswer::NAME => {
                let result = self.planner_answer(params);
                self.reply(&id, result).await
            }
            OnBehalfOf::NAME => {
                let result = self.on_behalf_of(params);
                self.reply(&id, result).await
            }
            RegisterGateway::NAME => {
                let result = read_params(params).and_then(|gateway| self.lessee.register_gateway(gateway));
                self.is_gateway |= result.is_ok();
                if let Ok(fallen) = &result {
                    fallen.iter().for_each(|face| self.backend.face_fell(face));
                }
                self.reply(&id, result.map(|_| Done {})).await
            }
            _ => match Request::read(&method, params) {
                Ok(request) => self.request(id, method, request).await,
                Err(error) => {
                    // Not under names that a client makes up.
                    if let Some(known) = METHODS.iter().find(|known| **known == method) {
                        self.backend.refused(known, &error);
                    }
                    self.reply::<Done>(&id, Err(error)).await
                }
            },
        }
    }

    async fn request(&mut self, id: Value, method: String, request: Request) -> Result<(), Disconnected> {
        let (request, arms) = match self.lessee.admit(request, &*self.backend).await {
            Ok(admitted) => admitted,
            Err(refusal) => return self.reply::<Done>(&id, Err(refusal)).await,
        };
        let is_target =
            matches!(request, Request::Servo(_) | Request::Velocity(_) | Request::Twist(_) | Request::Pose(_));
        let commands = self.behalf.is_some().then(|| request.clone());
        let mut answer = self.call(method, request);
        if !is_target {
            self.finish_pending().await?;
            let result = answer.await;
            self.lessee.settle(&arms, may_take_effect(&result));
            if let (Some((_, commanded)), Some(request), Ok(reply)) = (&mut self.behalf, commands, &result) {
                commanded.note(&request, reply, &arms);
            }
            return self.reply(&id, result).await;
        }
        // The first poll sends it to the tick.
        if let Poll::Ready(result) = poll_fn(|cx| Poll::Ready(answer.as_mut().poll(cx))).await {
            answer = Box::pin(ready(result));
        }
        self.pending.push_back(PendingTarget { id, arms, answer });
        Ok(())
    }

    fn call(&self, method: String, request: Request) -> Answer {
        let (backend, leases) = (self.backend.clone(), self.lessee.leases().clone());
        let origin = Origin { epoch: self.wanted, client: self.lessee.connection() };
        let who = self.lessee.who();
        Box::pin(async move { answer(&method, backend.call_from(request, Some(origin), who), &leases).await })
    }

    /// Waits for the answers to all pending targets and sends them.
    async fn finish_pending(&mut self) -> Result<(), Disconnected> {
        while !self.pending.is_empty() {
            let done = oldest(&mut self.pending).await;
            self.send_oldest(done).await?;
        }
        Ok(())
    }

    async fn send_oldest(&mut self, result: Result<Reply, RpcError>) -> Result<(), Disconnected> {
        match self.pending.pop_front() {
            Some(PendingTarget { id, arms, .. }) => {
                let keeps_lease = may_take_effect(&result);
                // If more targets are pending, the last of them decides.
                if keeps_lease || self.pending.is_empty() {
                    self.lessee.settle(&arms, keeps_lease);
                }
                self.send(wire::reply(&id, result)).await
            }
            None => Ok(()),
        }
    }

    /// Sends a reply, after the replies to all previous requests.
    async fn reply<T: Serialize>(&mut self, id: &Value, result: Result<T, RpcError>) -> Result<(), Disconnected> {
        self.finish_pending().await?;
        self.send(wire::reply(id, result)).await
    }

    /// Returns the maximum length of a request line [bytes].
    fn max_line(&self) -> usize {
        if self.planner.is_some() { MAX_ANSWER } else { MAX_LINE }
    }

    fn register_planner(&mut self, params: Value) -> Result<Registered, RpcError> {
        let planner: RegisterPlanner = read_params(params)?;
        let proxy =
            Arc::new(PlannerProxy::new(self.queue.clone(), self.lessee.pid().filter(|_| self.behalf.is_none())));
        let registered = self.backend.register_planner(planner, proxy.clone())?;
        self.planner = Some(RegisteredPlanner(proxy));
        Ok(registered)
    }

    fn on_behalf_of(&mut self, params: Value) -> Result<Done, RpcError> {
        let OnBehalfOf { client, cancel_at_end } = read_params(params)?;
        if self.behalf.is_some() {
            return Err(RpcError::new(Code::InvalidParams, "this connection has said already for whom it speaks"));
        }
        self.lessee.set_client(client);
        self.behalf = Some((cancel_at_end, Commanded::default()));
        Ok(Done {})
    }

    fn planner_answer(&self, params: Value) -> Result<Done, RpcError> {
        match &self.planner {
            Some(RegisteredPlanner(planner)) => planner.deliver(read_params(params)?),
            None => return Err(RpcError::new(Code::InvalidParams, "this connection registered no planner")),
        }
        Ok(Done {})
    }

    async fn lease(&mut self, params: Value) -> Result<LeaseReply, RpcError> {
        let arms = self.arms(read_params::<Lease>(params)?.arm)?;
        self.lessee.take(&arms)?;
        // What a client requests after a release of this lease is younger than it.
        self.backend.handled().await;
        Ok(LeaseReply { arms })
    }

    fn release(&self, params: Value) -> Result<LeaseReply, RpcError> {
        let arms = self.arms(read_params::<Release>(params)?.arm)?;
        Ok(LeaseReply { arms: self.lessee.release(&arms) })
    }

    fn arms(&self, wanted: Option<String>) -> Result<Vec<String>, RpcError> {
        let all = self.backend.arms_of(Subject::All);
        match wanted {
            None => Ok(all),
            Some(arm) if all.contains(&arm) => Ok(vec![arm]),
            Some(arm) => Err(RpcError::unknown(Code::UnknownArm, "arm", &arm, &all)),
        }
    }

    fn subscribe(&mut self, params: Value) -> Result<(SubscribeReply, Subscription), RpcError> {
        let wanted: Subscribe = read_params(params)?;
        if self.subscriptions.len() >= MAX_SUBSCRIPTIONS {
            let text = format!("the connection has {MAX_SUBSCRIPTIONS} subscriptions already");
            return Err(RpcError::new(Code::TooManySubscriptions, text).hint("end one with `unsubscribe`"));
        }
        let number = self.next;
        self.next += 1;
        let (mut past, from) = self.backend.streams().reader(wanted.stream);
        if !wanted.past {
            past.clear();
        }
        let limit = RateLimit::new(wanted.rate);
        let subscription = Subscription { number, stream: wanted.stream.name(), past, from, limit };
        Ok((SubscribeReply { subscription: number }, subscription))
    }

    fn unsubscribe(&mut self, params: Value) -> Result<Done, RpcError> {
        let number = read_params::<Unsubscribe>(params)?.subscription;
        match self.subscriptions.remove(&number) {
            Some(handle) => {
                handle.abort();
                while self.running.try_join_next().is_some() {}
                Ok(Done {})
            }
            None => {
                Err(RpcError::new(Code::UnknownSubscription, format!("this connection has no subscription {number}")))
            }
        }
    }

    /// Queues a line; waits while the queue is full.
    async fn send(&mut self, line: String) -> Result<(), Disconnected> {
        self.queue.send(line).await.map_err(|_| Disconnected)
    }
}

/// Waits for the end of the run.
async fn until(ended: &mut watch::Receiver<bool>) {
    let _ = ended.wait_for(|ended| *ended).await;
}

/// Waits for a future, and notes whether it was not ready at once.
async fn noting_a_wait<T>(future: impl Future<Output = T>, waited: &mut bool) -> T {
    let mut future = std::pin::pin!(future);
    poll_fn(|cx| {
        let poll = future.as_mut().poll(cx);
        *waited |= poll.is_pending();
        poll
    })
    .await
}

/// Waits for the run's answer, at most [`CALL_TIMEOUT`].
pub(crate) async fn answer(
    method: &str,
    call: impl Future<Output = Result<Reply, RpcError>>,
    leases: &Leases,
) -> Result<Reply, RpcError> {
    let Ok(result) = timeout(CALL_TIMEOUT, call).await else {
        let waited = CALL_TIMEOUT.as_secs();
        let error = RpcError::new(Code::NoAnswer, format!("{method:?} was not answered within {waited} s"));
        return Err(error.hint("it may still take effect; ask for `status`"));
    };
    result.map(|reply| leases.complete(reply))
}

/// Waits for the answer to the oldest pending target, which must then be removed.
async fn oldest(pending: &mut VecDeque<PendingTarget>) -> Result<Reply, RpcError> {
    match pending.front_mut() {
        Some(PendingTarget { answer, .. }) => answer.await,
        None => std::future::pending().await,
    }
}
