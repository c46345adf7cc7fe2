//! The planner's side of the connection: connects to a run, registers, and answers its requests concurrently until the
//! connection ends.

use std::future::Future;
use std::io;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use serde_json::{Value, json};
use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::net::UnixStream;
use tokio::net::unix::{OwnedReadHalf, OwnedWriteHalf};
use tokio::sync::Semaphore;
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tokio::time::timeout;

use crate::api::{Method, PLANNER_REQUESTS, PlannerAnswer, PlannerRequest, RegisterPlanner, Registered};
use crate::client::reach::open;
use crate::error::RpcError;
use crate::wire::Incoming;

/// Maximum time for a run to answer a registration.
const REGISTER_TIMEOUT: Duration = Duration::from_secs(5);
/// Maximum length of a line from the run [bytes].
const MAX_REQUEST: u64 = 1 << 20;
/// Maximum number of requests in progress.
const MAX_CONCURRENT: usize = 32;

/// Why a planner is not registered.
#[derive(Debug, thiserror::Error)]
pub enum RegisterError {
    /// The run cannot be reached, or the connection ended.
    #[error("{0}")]
    Io(#[from] io::Error),
    /// The run refused the planner.
    #[error(transparent)]
    Refused(RpcError),
}

/// A connection to a run on which the planner is registered.
pub struct PlannerStub {
    from: BufReader<OwnedReadHalf>,
    to: OwnedWriteHalf,
    /// The run's reply.
    pub registered: Registered,
}

impl PlannerStub {
    /// Connects to a run's socket and registers.
    pub async fn register(socket: &Path, planner: &RegisterPlanner) -> Result<Self, RegisterError> {
        let late =
            |_| io::Error::new(io::ErrorKind::TimedOut, format!("no answer within {} s", REGISTER_TIMEOUT.as_secs()));
        timeout(REGISTER_TIMEOUT, Self::try_register(socket, planner)).await.map_err(late)?
    }

    async fn try_register(socket: &Path, planner: &RegisterPlanner) -> Result<Self, RegisterError> {
        let (from, mut to) = UnixStream::from_std(open(socket)?)?.into_split();
        let mut from = BufReader::new(from);
        let line = json!({"id": 1, "method": RegisterPlanner::NAME, "params": planner}).to_string() + "\n";
        to.write_all(line.as_bytes()).await?;
        let incoming = read(&mut from).await?;
        if let Some(refusal) = incoming.error {
            return Err(RegisterError::Refused(refusal));
        }
        let unlike = |e: serde_json::Error| io::Error::new(io::ErrorKind::InvalidData, e.to_string());
        let registered = serde_json::from_value(incoming.result).map_err(unlike)?;
        Ok(Self { from, to, registered })
    }

    /// Answers requests until the connection ends; returns the reason. Must run within a tokio runtime.
    pub async fn serve<F>(self, answer: impl Fn(PlannerRequest) -> F) -> io::Error
    where
        F: Future<Output = Result<Value, RpcError>> + Send + 'static,
    {
        let Self { mut from, to, .. } = self;
        let (answers, waiting) = mpsc::channel(MAX_CONCURRENT);
        let room = Arc::new(Semaphore::new(MAX_CONCURRENT));
        let mut working = JoinSet::new();
        working.spawn(write(to, waiting));
        loop {
            let incoming = match read(&mut from).await {
                Ok(incoming) => incoming,
                Err(error) => return error,
            };
            while working.try_join_next().is_some() {}
            if incoming.stream.as_deref() != Some(PLANNER_REQUESTS) {
                continue; // the reply to an answer
            }
            let Ok(asked) = serde_json::from_value::<PlannerRequest>(incoming.data) else { continue };
            let Ok(permit) = room.clone().acquire_owned().await else { continue };
            let (request, answer, answers) = (asked.request, answer(asked), answers.clone());
            working.spawn(async move {
                let (result, error) = match answer.await {
                    Ok(result) => (Some(result), None),
                    Err(error) => (None, Some(error)),
                };
                let answer = PlannerAnswer { request, result, error };
                let line = json!({"id": null, "method": PlannerAnswer::NAME, "params": answer}).to_string() + "\n";
                let _ = answers.send(line).await; // if the run is gone, the reader notices it
                drop(permit);
            });
        }
    }
}

async fn write(mut to: OwnedWriteHalf, mut waiting: mpsc::Receiver<String>) {
    while let Some(line) = waiting.recv().await {
        if to.write_all(line.as_bytes()).await.is_err() {
            return;
        }
    }
}

async fn read(from: &mut BufReader<OwnedReadHalf>) -> io::Result<Incoming> {
    let mut line = Vec::new();
    (&mut *from).take(MAX_REQUEST + 1).read_until(b'\n', &mut line).await?;
    if line.len() as u64 > MAX_REQUEST {
        let what = format!("the run sent a line of more than {MAX_REQUEST} bytes");
        return Err(io::Error::new(io::ErrorKind::InvalidData, what));
    }
    if line.last() != Some(&b'\n') {
        return Err(io::Error::new(io::ErrorKind::UnexpectedEof, "the run closed the connection"));
    }
    serde_json::from_slice(&line).map_err(|e| io::Error::new(io::ErrorKind::InvalidData, e.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Reads what a run sends before it closes the connection.
    async fn read_from(sent: String) -> io::Result<Incoming> {
        let (ours, theirs) = UnixStream::pair().unwrap();
        let (from, _to) = ours.into_split();
        let (mut from, mut theirs) = (BufReader::new(from), theirs);
        let writes = async move { theirs.write_all(sent.as_bytes()).await };
        tokio::join!(read(&mut from), writes).0
    }

    #[tokio::test]
    async fn a_line_that_is_too_long_is_not_reported_as_a_closed_connection() {
        let line = |length: u64| "{\"id\": 1}".to_owned() + &" ".repeat(length as usize - 9);
        let max = read_from(line(MAX_REQUEST - 1) + "\n").await.unwrap();
        assert_eq!(max.id, Some(1));
        let too_long = read_from(line(MAX_REQUEST) + "\n").await.unwrap_err();
        assert_eq!(too_long.to_string(), "the run sent a line of more than 1048576 bytes");
        let closed = read_from(line(20)).await.unwrap_err();
        assert_eq!(closed.to_string(), "the run closed the connection");
    }
}
