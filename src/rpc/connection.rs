//! One client's conversation: requests are answered one after the other, subscriptions run beside them, and a writer
//! sends what both have to say. Every queue is bounded: who does not read is not read from either.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use serde_json::Value;
use tokio::io::{AsyncBufRead, AsyncBufReadExt, AsyncWriteExt, BufReader};
use tokio::net::UnixStream;
use tokio::net::unix::OwnedWriteHalf;
use tokio::sync::{broadcast, mpsc};
use tokio::task::{AbortHandle, JoinSet};
use tokio::time::{Instant, timeout};

use super::api::{Backend, Done, MAX_LINE, MAX_SUBSCRIPTIONS, Method, Request, read_params};
use super::error::{Code, RpcError};
use super::server::CALL_LIMIT;
use super::streams::{Subscribe, SubscribeReply, Unsubscribe};
use super::wire;

/// Lines that wait for a client to read them.
const QUEUE: usize = 64;
/// Time for the client to take the last replies, and for the rest of an oversize line to pass.
const FAREWELL: Duration = Duration::from_secs(1);

/// Serves one client until it closes its end, or sends a line that is too long.
pub(super) async fn serve(stream: UnixStream, backend: Arc<dyn Backend>) {
    let (from_client, to_client) = stream.into_split();
    let (queue, waiting) = mpsc::channel(QUEUE);
    let mut writer = tokio::spawn(write(to_client, waiting));
    let mut from_client = BufReader::new(from_client);
    Connection { backend, queue, running: JoinSet::new(), subscriptions: BTreeMap::new(), next: 1 }
        .converse(&mut from_client)
        .await;
    if timeout(FAREWELL, &mut writer).await.is_err() {
        writer.abort();
    }
}

async fn write(mut to: OwnedWriteHalf, mut waiting: mpsc::Receiver<String>) {
    while let Some(line) = waiting.recv().await {
        if to.write_all(line.as_bytes()).await.is_err() {
            return; // The client is gone; dropping the queue tells the rest of the conversation.
        }
    }
}

struct Connection {
    backend: Arc<dyn Backend>,
    queue: mpsc::Sender<String>,
    /// The subscriptions' tasks; dropping the set ends them.
    running: JoinSet<()>,
    subscriptions: BTreeMap<u64, AbortHandle>,
    next: u64,
}

/// The client is gone.
struct Gone;

impl Connection {
    async fn converse(mut self, from: &mut (impl AsyncBufRead + Unpin)) {
        let mut line = Vec::new();
        loop {
            line.clear();
            match read_line(from, &mut line).await {
                Line::Whole => {}
                Line::End => return,
                Line::TooLong => {
                    let error = RpcError::new(Code::TooLarge, format!("the line is longer than {MAX_LINE} bytes"));
                    let error = error.hint("send less at once; the connection is closed now");
                    let _ = self.send(wire::reply::<()>(&Value::Null, Err(error))).await;
                    let _ = timeout(FAREWELL, skip_line(from)).await;
                    return;
                }
            }
            if line.trim_ascii().is_empty() {
                continue;
            }
            if self.answer(&line).await.is_err() {
                return;
            }
        }
    }

    async fn answer(&mut self, line: &[u8]) -> Result<(), Gone> {
        let wire::Envelope { id, method, params } = match wire::read(line) {
            Ok(envelope) => envelope,
            Err((id, error)) => return self.send(wire::reply::<()>(&id, Err(error))).await,
        };
        match method.as_str() {
            Subscribe::NAME => match self.subscribe(params) {
                Ok((reply, subscription)) => {
                    self.send(wire::reply(&id, Ok(reply))).await?; // before the first message
                    let handle = self.running.spawn(subscription.forward(self.queue.clone()));
                    self.subscriptions.insert(reply.subscription, handle);
                    Ok(())
                }
                Err(error) => self.send(wire::reply::<()>(&id, Err(error))).await,
            },
            Unsubscribe::NAME => {
                let reply = wire::reply(&id, self.unsubscribe(params));
                self.send(reply).await
            }
            _ => {
                let reply = wire::reply(&id, self.call(&method, params).await);
                self.send(reply).await
            }
        }
    }

    async fn call(&self, method: &str, params: Value) -> Result<super::Reply, RpcError> {
        let request = Request::read(method, params)?;
        timeout(CALL_LIMIT, self.backend.call(request)).await.unwrap_or_else(|_| {
            let waited = CALL_LIMIT.as_secs();
            Err(RpcError::new(Code::NoAnswer, format!("{method:?} was not answered within {waited} s"))
                .hint("it may still take effect; ask for `status`"))
        })
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
    async fn send(&self, line: String) -> Result<(), Gone> {
        self.queue.send(line).await.map_err(|_| Gone)
    }
}

/// A client's reading of a stream.
struct Subscription {
    number: u64,
    stream: &'static str,
    from: broadcast::Receiver<Arc<str>>,
    pace: Pace,
}

impl Subscription {
    async fn forward(mut self, queue: mpsc::Sender<String>) {
        let mut lost = 0;
        loop {
            match self.from.recv().await {
                Ok(data) if self.pace.is_due(Instant::now()) => {
                    let line = wire::message(self.stream, self.number, lost, &data);
                    if queue.send(line).await.is_err() {
                        return;
                    }
                    lost = 0;
                }
                Ok(_) => {}
                Err(broadcast::error::RecvError::Lagged(missed)) => lost += missed,
                Err(broadcast::error::RecvError::Closed) => return,
            }
        }
    }
}

/// Thins a stream out to a rate.
struct Pace {
    period: Option<Duration>,
    next: Option<Instant>,
}

impl Pace {
    fn of(rate: Option<f64>) -> Self {
        Self { period: rate.map(|hz| Duration::from_secs_f64(1.0 / hz)), next: None }
    }

    /// Whether a message that came now is to be sent. A quarter of a period early counts as on time, so that asking
    /// for a stream at its own rate loses nothing to jitter.
    fn is_due(&mut self, now: Instant) -> bool {
        let Some(period) = self.period else { return true };
        let next = self.next.unwrap_or(now);
        if now + period / 4 < next {
            return false;
        }
        let following = next + period;
        self.next = Some(if following < now { now + period } else { following });
        true
    }
}

enum Line {
    Whole,
    End,
    TooLong,
}

/// Reads a line of at most [`MAX_LINE`] bytes. What comes after the last newline is no line.
async fn read_line(from: &mut (impl AsyncBufRead + Unpin), line: &mut Vec<u8>) -> Line {
    loop {
        let chunk = match from.fill_buf().await {
            Ok([]) | Err(_) => return Line::End,
            Ok(chunk) => chunk,
        };
        let (take, whole) = match chunk.iter().position(|b| *b == b'\n') {
            Some(at) => (at + 1, true),
            None => (chunk.len(), false),
        };
        if line.len() + take > MAX_LINE {
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
