//! The requests that always get through: `stop`, `cancel`, `status`, `shutdown`. The thread that accepts connections
//! answers them, as long as a connection sends nothing else. So they never wait for another client's request, and may
//! use the reserved connections; the first `stop`, `cancel` or `shutdown` of a new connection needs none.

use std::io::{self, ErrorKind};
use std::sync::Arc;
use std::sync::mpsc::Sender;
use std::time::Duration;

use serde_json::Value;
use tokio::net::UnixStream;
use tokio::sync::oneshot;
use tokio::time::timeout;

use crate::api::{Cancel, Method, Reply, Request, Shutdown, Status, Stop};
use crate::error::RpcError;
use crate::server::connection::answer;
use crate::server::connection_limit::Permit;
use crate::server::lease::Lessee;
use crate::server::refuse;
use crate::server::stop_thread::Reception;
use crate::server::turn::Turn;
use crate::server::who::Peer;
use crate::wire;

/// Maximum length of an urgent request [bytes].
const MAX_URGENT: usize = 1024;
/// Time for a new connection to send a line before it needs a permit.
const FIRST_LINE_TIMEOUT: Duration = Duration::from_millis(250);
/// Maximum silence of a reserved connection.
const IDLE_TIMEOUT: Duration = Duration::from_secs(2);
/// Maximum time for a client to take a reply.
const WRITE_TIMEOUT: Duration = Duration::from_secs(1);
/// Maximum `status` requests of one connection that are answered here: clients that poll are served like all others.
const MAX_STATUS: u32 = 8;

/// A connection that passes from one thread to another.
pub(crate) struct Transfer {
    /// Its socket.
    pub stream: std::os::unix::net::UnixStream,
    /// Bytes that were read and not yet handled.
    pub read: Vec<u8>,
    /// Its leases.
    pub lessee: Lessee,
    /// Its permit.
    pub permit: Permit,
}

/// Serves a new connection. A stop, cancel or shutdown needs no permit: other connections do not get in its way. What
/// sends anything else, or nothing for [`FIRST_LINE_TIMEOUT`], or must make room for newer ones (`out`), needs one.
pub(crate) async fn receive(
    stream: UnixStream,
    mut out: oneshot::Receiver<()>,
    reception: Arc<Reception>,
    turn: Arc<Turn>,
) {
    let (mut read, stream) = (Vec::new(), Arc::new(stream));
    let served = turn.serves(&stream, None);
    loop {
        // What has arrived is read before it must make room.
        let filled = tokio::select! {
            biased;
            filled = timeout(FIRST_LINE_TIMEOUT, fill(&stream, &mut read)) => filled,
            _ = &mut out => break,
        };
        match filled {
            Ok(true) => {}
            Ok(false) => return,
            Err(_) => break,
        }
        let Some(line) = next_line(&mut read) else { if read.len() > MAX_URGENT { break } else { continue } };
        let ends = urgent(&line).filter(|(_, request)| !matches!(request, Request::Status(_)));
        let (Some((id, request)), Ok(_held)) = (ends, turn.unbound.try_acquire()) else {
            read.splice(..0, line);
            break;
        };
        let name = request.written().0;
        let who = Arc::new(Peer::of(&stream).at_once(name));
        let result = reception.backend.call_from(request, None, who);
        let result = answer(name, result, &reception.leases).await;
        if !send::<Reply>(&stream, &id, result).await {
            return;
        }
    }
    drop(served);
    // Else it is being closed.
    let Ok(stream) = Arc::try_unwrap(stream) else { return };
    let permit = match reception.limit.acquire() {
        Ok(permit) => permit,
        Err(error) => return refuse(&stream, error),
    };
    let lessee = Lessee::new(reception.leases.clone(), permit.number(), Peer::of(&stream));
    if let Ok(stream) = stream.into_std() {
        serve(Transfer { stream, read, lessee, permit }, reception, turn).await;
    }
}

/// Reads until a line is complete or longer than an urgent request; returns `false` if the connection ends before.
async fn fill(stream: &UnixStream, read: &mut Vec<u8>) -> bool {
    let mut chunk = [0; MAX_URGENT];
    while !read.contains(&b'\n') && read.len() <= MAX_URGENT {
        match receive_some(stream, &mut chunk).await {
            Ok(length @ 1..) => read.extend(chunk.iter().take(length)),
            _ => return false,
        }
    }
    true
}

/// Serves a connection until it ends or sends another request; then passes it on.
pub(crate) async fn serve(transfer: Transfer, reception: Arc<Reception>, turn: Arc<Turn>) {
    let Transfer { stream, mut read, lessee, permit } = transfer;
    let (backend, others) = (&reception.backend, &reception.others);
    let Ok(stream) = UnixStream::from_std(stream).map(Arc::new) else { return };
    let served = turn.serves(&stream, Some(permit.number()));
    let mut statuses = 0;
    loop {
        while let Some(line) = next_line(&mut read) {
            let urgent = urgent(&line);
            statuses += u32::from(matches!(urgent, Some((_, Request::Status(_)))));
            let Some((id, request)) = urgent.filter(|_| statuses <= MAX_STATUS || permit.is_reserved()) else {
                read.splice(..0, line);
                drop(served);
                return pass_on(stream, read, lessee, permit, others).await;
            };
            permit.set_busy();
            let name = request.written().0;
            let who = lessee.who_at_once(name);
            let result = backend.call_from(request, None, who);
            let result = answer(name, result, lessee.leases()).await;
            if !send::<Reply>(&stream, &id, result).await {
                return;
            }
            // Lets the other connections proceed before the next request.
            tokio::task::yield_now().await;
        }
        if read.len() > MAX_URGENT {
            drop(served);
            return pass_on(stream, read, lessee, permit, others).await;
        }
        permit.set_idle();
        let max_silence = if permit.is_reserved() { IDLE_TIMEOUT } else { Duration::MAX };
        let mut chunk = [0; MAX_URGENT];
        let received = tokio::select! {
            biased;
            received = timeout(max_silence, receive_some(&stream, &mut chunk)) => received,
            reason = permit.evicted() => {
                send::<Reply>(&stream, &Value::Null, Err(reason)).await;
                return;
            }
        };
        match received {
            Ok(Ok(length @ 1..)) => read.extend(chunk.iter().take(length)),
            // The connection ended, or was silent for too long.
            _ => return,
        }
    }
}

/// Removes the first line from the buffer and returns it with its newline. Skips empty lines.
fn next_line(read: &mut Vec<u8>) -> Option<Vec<u8>> {
    loop {
        let end = read.iter().position(|byte| *byte == b'\n')?;
        let line: Vec<u8> = read.drain(..=end).collect();
        if !line.trim_ascii().is_empty() {
            return Some(line);
        }
    }
}

/// Returns the request in a line, if it is one of those that always get through.
fn urgent(line: &[u8]) -> Option<(Value, Request)> {
    if line.len() > MAX_URGENT {
        return None;
    }
    let wire::Envelope { id, method, params, .. } = wire::read(line).ok()?;
    match method.as_str() {
        Stop::NAME | Cancel::NAME | Status::NAME | Shutdown::NAME => Some((id, Request::read(&method, params).ok()?)),
        _ => None,
    }
}

async fn pass_on(stream: Arc<UnixStream>, read: Vec<u8>, lessee: Lessee, permit: Permit, others: &Sender<Transfer>) {
    permit.set_busy();
    if let Err(refusal) = permit.promote() {
        send::<Reply>(&stream, &Value::Null, Err(refusal)).await;
        return;
    }
    // Else it is being closed.
    let Ok(stream) = Arc::try_unwrap(stream) else { return };
    if let Ok(stream) = stream.into_std() {
        // Fails only while the server shuts down.
        let _ = others.send(Transfer { stream, read, lessee, permit });
    }
}

/// Waits for bytes; returns how many were read.
async fn receive_some(stream: &UnixStream, to: &mut [u8]) -> io::Result<usize> {
    loop {
        stream.readable().await?;
        match stream.try_read(to) {
            Err(error) if error.kind() == ErrorKind::WouldBlock => {}
            read => return read,
        }
    }
}

/// Sends a reply; returns whether the client took it in time.
async fn send<T: serde::Serialize>(stream: &UnixStream, id: &Value, result: Result<T, RpcError>) -> bool {
    let line = wire::reply(id, result);
    matches!(timeout(WRITE_TIMEOUT, write_all(stream, line.as_bytes())).await, Ok(Ok(())))
}

async fn write_all(stream: &UnixStream, mut rest: &[u8]) -> io::Result<()> {
    while !rest.is_empty() {
        stream.writable().await?;
        match stream.try_write(rest) {
            Ok(written) => rest = rest.get(written..).unwrap_or_default(),
            Err(error) if error.kind() == ErrorKind::WouldBlock => {}
            Err(error) => return Err(error),
        }
    }
    Ok(())
}
