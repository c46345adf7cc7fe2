//! One client's conversation: requests are answered in their order, subscriptions run beside them, and a writer sends
//! what both have to say. Every queue is bounded: who does not read is not read from either.
//!
//! A request is done before the next one begins, except that targets of a stream are handed on as they come: each is
//! answered by the tick that takes it, and the next ones may be on their way before that.

use std::collections::{BTreeMap, VecDeque};
use std::future::{Future, poll_fn, ready};
use std::pin::Pin;
use std::sync::Arc;
use std::task::Poll;
use std::time::Duration;

use serde::Serialize;
use serde_json::Value;
use tokio::io::{AsyncBufRead, AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::net::UnixStream;
use tokio::net::unix::OwnedWriteHalf;
use tokio::sync::mpsc;
use tokio::task::{AbortHandle, JoinSet};
use tokio::time::{sleep, timeout};

use super::api::{
    Backend, Done, Lease, LeaseReply, MAX_ANSWER, MAX_LINE, MAX_SUBSCRIPTIONS, Method, PlannerAnswer, RegisterPlanner,
    Registered, Release, Reply, Request, read_params,
};
use super::error::{Code, RpcError};
use super::lease::{Leases, Lessee, Subject};
use super::planner_line::PlannerLine;
use super::seats::Seat;
use super::server::CALL_LIMIT;
use super::streams::{Subscribe, SubscribeReply, Unsubscribe};
use super::subscription::{Pace, Subscription};
use super::urgent::Arrival;
use super::wire;

/// Lines that wait for a client to read them.
const QUEUE: usize = 64;
/// Targets of one client that may wait for the tick at once.
const IN_FLIGHT: usize = 32;
/// A connection that is silent for this long is given back.
const SILENT_FOR: Duration = Duration::from_millis(250);
/// Time for the client to take the last replies, and for the rest of an oversize line to pass.
const FAREWELL: Duration = Duration::from_secs(1);

/// Serves one client until it closes its end, sends a line that is too long, or must make room. Gives back a connection
/// that says nothing for a while: its next request may be one of those that always get through.
pub(super) async fn serve(arrival: Arrival, backend: Arc<dyn Backend>) -> Option<Arrival> {
    let Arrival { stream, read, lessee, seat } = arrival;
    let stream =
        UnixStream::from_std(stream).inspect_err(|e| tracing::warn!("rpc: a connection was not taken: {e}")).ok()?;
    let (from_client, to_client) = stream.into_split();
    let (queue, waiting) = mpsc::channel(QUEUE);
    let mut writer = tokio::spawn(write(to_client, waiting));
    let mut from_client = BufReader::new(std::io::Cursor::new(read).chain(from_client));
    let connection = Connection {
        backend,
        lessee,
        seat,
        queue,
        in_flight: VecDeque::new(),
        running: JoinSet::new(),
        subscriptions: BTreeMap::new(),
        next: 1,
        planner: None,
    };
    let Some((lessee, seat)) = connection.converse(&mut from_client).await else {
        if timeout(FAREWELL, &mut writer).await.is_err() {
            writer.abort();
        }
        return None;
    };
    let written = tokio::select! {
        // A client that does not read its last replies is not read from either.
        written = &mut writer => written.ok().flatten()?,
        _ = seat.must_leave() => {
            writer.abort();
            return None;
        }
    };
    let (_, from_client) = from_client.into_inner().into_inner();
    let stream = from_client.reunite(written).ok()?.into_std().ok()?;
    Some(Arrival { stream, read: Vec::new(), lessee, seat })
}

/// Gives its half back when nothing more is to be written.
async fn write(mut to: OwnedWriteHalf, mut waiting: mpsc::Receiver<String>) -> Option<OwnedWriteHalf> {
    while let Some(line) = waiting.recv().await {
        // The client is gone; dropping the queue ends the rest of the conversation.
        to.write_all(line.as_bytes()).await.ok()?;
    }
    Some(to)
}

struct Connection {
    backend: Arc<dyn Backend>,
    /// What it holds of the leases; they end with the conversation.
    lessee: Lessee,
    /// Its place among the connections.
    seat: Seat,
    queue: mpsc::Sender<String>,
    /// Targets that the tick has not answered yet, the oldest first.
    in_flight: VecDeque<InFlight>,
    /// The subscriptions' tasks; dropping the set ends them.
    running: JoinSet<()>,
    subscriptions: BTreeMap<u64, AbortHandle>,
    next: u64,
    /// The line to the planner that registered here.
    planner: Option<PlannerHere>,
}

/// A planner's line, closed with its connection.
struct PlannerHere(Arc<PlannerLine>);

impl Drop for PlannerHere {
    fn drop(&mut self) {
        self.0.close();
    }
}

/// The answer to a request, when it comes.
type Answer = Pin<Box<dyn Future<Output = Result<Reply, RpcError>> + Send>>;

/// A target that the tick has not answered yet.
struct InFlight {
    id: Value,
    /// The arms whose leases it needs.
    arms: Vec<String>,
    answer: Answer,
}

/// The client is gone.
struct Gone;

impl Connection {
    /// Answers requests until the connection ends (`None`), or says nothing for a while.
    async fn converse(mut self, from: &mut (impl AsyncBufRead + Unpin)) -> Option<(Lessee, Seat)> {
        let mut line = Vec::new();
        loop {
            let longest = self.longest();
            if self.in_flight.is_empty() {
                self.seat.pin(!self.subscriptions.is_empty() || self.planner.is_some());
                self.seat.rest();
            }
            let read = tokio::select! {
                biased;
                reason = self.seat.must_leave() => {
                    let _ = timeout(FAREWELL, self.reply::<Done>(&Value::Null, Err(reason))).await;
                    return None;
                }
                done = oldest(&mut self.in_flight), if !self.in_flight.is_empty() => {
                    if self.send_oldest(done).await.is_err() {
                        return None;
                    }
                    continue;
                }
                // Before the line, so that nothing is read that would be lost; a partial line belongs here.
                () = sleep(SILENT_FOR), if line.is_empty() && self.is_plain() => Line::Nothing,
                // Begins again where it was when an answer came first: what it read so far is in `line`.
                read = read_line(from, &mut line, longest), if self.in_flight.len() < IN_FLIGHT => read,
            };
            match read {
                Line::Whole => self.seat.begin(),
                Line::Nothing if line.is_empty() => return Some((self.lessee, self.seat)),
                Line::Nothing => continue,
                Line::End => {
                    let _ = self.settle().await;
                    return None;
                }
                Line::TooLong => {
                    let error = RpcError::new(Code::TooLarge, format!("the line is longer than {longest} bytes"));
                    let error = error.hint("send less at once; the connection is closed now");
                    let _ = self.reply::<Done>(&Value::Null, Err(error)).await;
                    let _ = timeout(FAREWELL, skip_line(from)).await;
                    return None;
                }
            }
            if !line.trim_ascii().is_empty() && self.answer(&line).await.is_err() {
                return None;
            }
            line.clear();
        }
    }

    /// Returns whether the connection only sends requests and receives replies.
    fn is_plain(&self) -> bool {
        self.in_flight.is_empty() && self.next == 1 && self.planner.is_none()
    }

    async fn answer(&mut self, line: &[u8]) -> Result<(), Gone> {
        let wire::Envelope { id, method, params } = match wire::read(line) {
            Ok(envelope) => envelope,
            Err((id, error)) => return self.reply::<Done>(&id, Err(error)).await,
        };
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
                let result = self.lease(params);
                self.reply(&id, result).await
            }
            Release::NAME => {
                self.settle().await?; // targets that are on their way were sent under the lease
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
            _ => match Request::read(&method, params) {
                Ok(request) => self.request(id, method, request).await,
                Err(error) => self.reply::<Done>(&id, Err(error)).await,
            },
        }
    }

    async fn request(&mut self, id: Value, method: String, request: Request) -> Result<(), Gone> {
        let (request, arms) = match self.lessee.admit(request, &*self.backend).await {
            Ok(admitted) => admitted,
            Err(refusal) => return self.reply::<Done>(&id, Err(refusal)).await,
        };
        let is_target =
            matches!(request, Request::Servo(_) | Request::Velocity(_) | Request::Twist(_) | Request::Pose(_));
        let mut answer = self.call(method, request);
        if !is_target {
            self.settle().await?;
            let result = answer.await;
            self.lessee.settle(&arms, is_taken_on(&result));
            return self.reply(&id, result).await;
        }
        // Polled once, it is on its way to the tick, whatever is read next.
        if let Poll::Ready(result) = poll_fn(|cx| Poll::Ready(answer.as_mut().poll(cx))).await {
            answer = Box::pin(ready(result));
        }
        self.in_flight.push_back(InFlight { id, arms, answer });
        Ok(())
    }

    fn call(&self, method: String, request: Request) -> Answer {
        let (backend, leases) = (self.backend.clone(), self.lessee.leases().clone());
        Box::pin(async move { answer(&method, backend.call(request), &leases).await })
    }

    /// Waits for the answers to all targets that are on their way.
    async fn settle(&mut self) -> Result<(), Gone> {
        while !self.in_flight.is_empty() {
            let done = oldest(&mut self.in_flight).await;
            self.send_oldest(done).await?;
        }
        Ok(())
    }

    async fn send_oldest(&mut self, result: Result<Reply, RpcError>) -> Result<(), Gone> {
        match self.in_flight.pop_front() {
            Some(InFlight { id, arms, .. }) => {
                let taken_on = is_taken_on(&result);
                // While more targets are on their way, the last of them decides.
                if taken_on || self.in_flight.is_empty() {
                    self.lessee.settle(&arms, taken_on);
                }
                self.send(wire::reply(&id, result)).await
            }
            None => Ok(()),
        }
    }

    /// Sends a reply, after those to all requests before.
    async fn reply<T: Serialize>(&mut self, id: &Value, result: Result<T, RpcError>) -> Result<(), Gone> {
        self.settle().await?;
        self.send(wire::reply(id, result)).await
    }

    /// Longest line that is taken.
    fn longest(&self) -> usize {
        if self.planner.is_some() { MAX_ANSWER } else { MAX_LINE }
    }

    fn register_planner(&mut self, params: Value) -> Result<Registered, RpcError> {
        let planner: RegisterPlanner = read_params(params)?;
        let line = Arc::new(PlannerLine::new(self.queue.clone(), self.lessee.pid()));
        let registered = self.backend.register_planner(planner, line.clone())?;
        self.planner = Some(PlannerHere(line));
        Ok(registered)
    }

    fn planner_answer(&self, params: Value) -> Result<Done, RpcError> {
        match &self.planner {
            Some(PlannerHere(planner)) => planner.answered(read_params(params)?),
            None => return Err(RpcError::new(Code::InvalidParams, "this connection registered no planner")),
        }
        Ok(Done {})
    }

    fn lease(&self, params: Value) -> Result<LeaseReply, RpcError> {
        let arms = self.arms(read_params::<Lease>(params)?.arm)?;
        self.lessee.take(&arms)?;
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
        let from = self.backend.streams().reader(wanted.stream);
        let subscription = Subscription { number, stream: wanted.stream.name(), from, pace: Pace::of(wanted.rate) };
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

    /// Waits for room in the queue, so a client that does not read is not read from.
    async fn send(&mut self, line: String) -> Result<(), Gone> {
        self.queue.send(line).await.map_err(|_| Gone)
    }
}

/// Whether a request takes effect, or may: what is not answered in time was not refused.
fn is_taken_on(result: &Result<Reply, RpcError>) -> bool {
    result.as_ref().map_or_else(|error| error.code == Code::NoAnswer, |_| true)
}

/// Waits for what the run answers, not for ever.
pub(super) async fn answer(
    method: &str,
    call: impl Future<Output = Result<Reply, RpcError>>,
    leases: &Leases,
) -> Result<Reply, RpcError> {
    let Ok(result) = timeout(CALL_LIMIT, call).await else {
        let waited = CALL_LIMIT.as_secs();
        let error = RpcError::new(Code::NoAnswer, format!("{method:?} was not answered within {waited} s"));
        return Err(error.hint("it may still take effect; ask for `status`"));
    };
    result.map(|reply| leases.complete(reply))
}

/// The answer to the oldest target that is on its way. Once it has come, the target must be taken out.
async fn oldest(in_flight: &mut VecDeque<InFlight>) -> Result<Reply, RpcError> {
    match in_flight.front_mut() {
        Some(InFlight { answer, .. }) => answer.await,
        None => std::future::pending().await,
    }
}

enum Line {
    Whole,
    /// Not even a part of one, for a while.
    Nothing,
    End,
    TooLong,
}

/// Reads a line of at most `longest` bytes. What comes after the last newline is no line.
async fn read_line(from: &mut (impl AsyncBufRead + Unpin), line: &mut Vec<u8>, longest: usize) -> Line {
    loop {
        let chunk = match from.fill_buf().await {
            Ok([]) | Err(_) => return Line::End,
            Ok(chunk) => chunk,
        };
        let (take, whole) = match chunk.iter().position(|b| *b == b'\n') {
            Some(at) => (at + 1, true),
            None => (chunk.len(), false),
        };
        if line.len() + take > longest {
            return Line::TooLong;
        }
        line.extend(chunk.iter().take(take));
        from.consume(take);
        if whole {
            return Line::Whole;
        }
    }
}

/// Lets the rest of a line pass, so that its sender gets to read why it was refused.
async fn skip_line(from: &mut (impl AsyncBufRead + Unpin)) {
    loop {
        let chunk = match from.fill_buf().await {
            Ok([]) | Err(_) => return,
            Ok(chunk) => chunk,
        };
        let end = chunk.iter().position(|b| *b == b'\n');
        let take = end.map_or(chunk.len(), |at| at + 1);
        from.consume(take);
        if end.is_some() {
            return;
        }
    }
}
