//! The requests that always get through: `stop`, `cancel`, `status`, `shutdown`. The thread that takes connections
//! answers them itself as long as a connection asks nothing else; so they never wait for another client's JSON, and
//! need no place among the other connections.

use std::sync::Arc;
use std::sync::mpsc::Sender;
use std::time::Duration;

use serde_json::Value;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::UnixStream;
use tokio::time::timeout;

use super::api::{Backend, Reply, Request, Shutdown, Status, Stop};
use super::api::{Cancel, Method};
use super::connection::answer;
use super::error::RpcError;
use super::lease::Lessee;
use super::seats::Seat;
use super::wire;

/// Longest line of a request that is urgent [bytes].
const MAX_URGENT: usize = 1024;
/// How long a connection in a reserved place may be silent.
const IDLE_LIMIT: Duration = Duration::from_secs(2);
/// How long a client gets to take a reply.
const WRITE_LIMIT: Duration = Duration::from_secs(1);
/// `status` is answered here at most this many times per connection: a client that polls is served like all others.
const STATUS_LIMIT: u32 = 8;

/// A connection on its way from one thread to another.
pub(super) struct Arrival {
    /// Its socket.
    pub stream: std::os::unix::net::UnixStream,
    /// What was read of it and not yet answered.
    pub read: Vec<u8>,
    /// What it holds of the leases.
    pub lessee: Lessee,
    /// Its place.
    pub seat: Seat,
}

/// Serves a connection until it ends or asks something else; then it is handed on.
pub(super) async fn serve(arrival: Arrival, backend: Arc<dyn Backend>, others: Sender<Arrival>) {
    let Arrival { stream, mut read, lessee, seat } = arrival;
    let Ok(mut stream) = UnixStream::from_std(stream) else { return };
    let mut statuses = 0;
    loop {
        while let Some(line) = next_line(&mut read) {
            let urgent = urgent(&line);
            statuses += u32::from(matches!(urgent, Some((_, Request::Status(_)))));
            let Some((id, request)) = urgent.filter(|_| statuses <= STATUS_LIMIT || seat.is_reserved()) else {
                read.splice(..0, line);
                return hand_on(stream, read, lessee, seat, &others).await;
            };
            seat.begin();
            let (name, result) = (request.written().0, backend.call(request));
            let result = answer(name, result, lessee.leases()).await;
            if !send::<Reply>(&mut stream, &id, result).await {
                return;
            }
            // The next request waits until the others had their turn.
            tokio::task::yield_now().await;
        }
        if read.len() > MAX_URGENT {
            return hand_on(stream, read, lessee, seat, &others).await;
        }
        seat.rest();
        let silence = if seat.is_reserved() { IDLE_LIMIT } else { Duration::MAX };
        let mut chunk = [0; MAX_URGENT];
        let received = tokio::select! {
            received = timeout(silence, stream.read(&mut chunk)) => received,
            reason = seat.must_leave() => {
                send::<Reply>(&mut stream, &Value::Null, Err(reason)).await;
                return;
            }
        };
        match received {
            Ok(Ok(length @ 1..)) => read.extend(chunk.iter().take(length)),
            // The end of the connection, or of its time.
            _ => return,
        }
    }
}

/// Takes the first line out of what was read, its newline included. Empty lines are no requests.
fn next_line(read: &mut Vec<u8>) -> Option<Vec<u8>> {
    loop {
        let end = read.iter().position(|byte| *byte == b'\n')?;
        let line: Vec<u8> = read.drain(..=end).collect();
        if !line.trim_ascii().is_empty() {
            return Some(line);
        }
    }
}

/// The request of a line, if it is one of those that always get through.
fn urgent(line: &[u8]) -> Option<(Value, Request)> {
    if line.len() > MAX_URGENT {
        return None;
    }
    let wire::Envelope { id, method, params } = wire::read(line).ok()?;
    match method.as_str() {
        Stop::NAME | Cancel::NAME | Status::NAME | Shutdown::NAME => Some((id, Request::read(&method, params).ok()?)),
        _ => None,
    }
}

async fn hand_on(mut stream: UnixStream, read: Vec<u8>, lessee: Lessee, seat: Seat, others: &Sender<Arrival>) {
    seat.begin();
    if let Err(refusal) = seat.promote() {
        send::<Reply>(&mut stream, &Value::Null, Err(refusal)).await;
        return;
    }
    if let Ok(stream) = stream.into_std() {
        // Fails only when the server is ending.
        let _ = others.send(Arrival { stream, read, lessee, seat });
    }
}

/// Sends a reply; `false`: the client does not take it.
async fn send<T: serde::Serialize>(stream: &mut UnixStream, id: &Value, result: Result<T, RpcError>) -> bool {
    let line = wire::reply(id, result);
    matches!(timeout(WRITE_LIMIT, stream.write_all(line.as_bytes())).await, Ok(Ok(())))
}
