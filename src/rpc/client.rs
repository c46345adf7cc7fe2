//! A blocking client of a run's socket, for the command line and for programs.

use std::collections::VecDeque;
use std::io::{self, BufRead, BufReader, Write};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::time::Duration;

use serde_json::{Value, json};

use super::api::{MAX_LINE, Method};
use super::error::{Code, RpcError};
use super::run_dir::{LiveRun, RunDir, RunDirError};
use super::server::CALL_TIMEOUT;
use super::wire::Incoming;
use crate::yaml::{did_you_mean, quote};

/// Timeout for a reply: a little longer than the run's own.
const REPLY_TIMEOUT: Duration = CALL_TIMEOUT.saturating_add(Duration::from_secs(2));
/// Stream messages buffered while waiting for a reply; older ones are dropped and counted.
const MAX_BUFFERED: usize = 1024;

/// Why a request has no result.
#[derive(Debug, thiserror::Error)]
pub enum ClientError {
    /// No run is live.
    #[error("no run is live")]
    NoRun,
    /// Several runs are live, and none was selected.
    #[error("several runs are live: {}", names(.0))]
    SeveralRuns(Vec<LiveRun>),
    /// No live run has this name.
    #[error("no live run is named {}", quote(name))]
    UnknownRun {
        /// The requested name.
        name: String,
        /// The live runs.
        live: Vec<LiveRun>,
    },
    /// The run directory cannot be read.
    #[error(transparent)]
    RunDir(#[from] RunDirError),
    /// The connection failed or broke.
    #[error("run {run:?}: {error}")]
    Io {
        /// The run's name.
        run: String,
        /// The system's error.
        error: io::Error,
    },
    /// The reply is not valid.
    #[error("run {run:?}: invalid reply: {what}")]
    Protocol {
        /// The run's name.
        run: String,
        /// What is wrong.
        what: String,
    },
    /// The run refused the request.
    #[error(transparent)]
    Refused(#[from] RpcError),
}

impl ClientError {
    /// Returns what the user can do about it.
    pub fn hint(&self) -> Option<String> {
        match self {
            Self::NoRun => Some("start one: dimos run coordinator-yourarm".into()),
            Self::SeveralRuns(_) => Some("select one with --run NAME".into()),
            Self::UnknownRun { live, .. } if live.is_empty() => Self::NoRun.hint(),
            Self::UnknownRun { name, live } => did_you_mean(name, live.iter().map(|r| r.name.as_str()), "live"),
            Self::RunDir(error) => Some(error.hint().into()),
            Self::Io { error, .. } if matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut) => {
                Some("the process is live but does not answer; its log may say why".into())
            }
            Self::Io { .. } => Some("the run is starting or has just ended; see `dimos status`".into()),
            Self::Protocol { .. } => Some("the run may be another version of dimos: `dimos status` shows it".into()),
            Self::Refused(error) => error.hint.clone(),
        }
    }
}

fn names(runs: &[LiveRun]) -> String {
    runs.iter().map(|r| r.name.as_str()).collect::<Vec<_>>().join(", ")
}

/// A message of a subscription.
#[derive(Debug, Clone, PartialEq)]
pub struct Message {
    /// Name of the stream.
    pub stream: String,
    /// Number of the subscription.
    pub subscription: u64,
    /// Messages that this client missed just before this one.
    pub lost: u64,
    /// The published value.
    pub data: Value,
}

/// A connection to a run.
#[derive(Debug)]
pub struct Client {
    run: String,
    from: BufReader<UnixStream>,
    next: u64,
    buffered: VecDeque<Message>,
}

/// Returns the live run of this name; without a name, the only live run.
pub fn find(folder: &RunDir, name: Option<&str>) -> Result<LiveRun, ClientError> {
    let mut live = folder.runs()?;
    match name {
        Some(name) => match live.iter().position(|run| run.name == name) {
            Some(at) => Ok(live.swap_remove(at)),
            None => Err(ClientError::UnknownRun { name: name.to_owned(), live }),
        },
        None if live.len() > 1 => Err(ClientError::SeveralRuns(live)),
        None => live.pop().ok_or(ClientError::NoRun),
    }
}

impl Client {
    /// Connects to the run of this name; without a name, to the only live run.
    pub fn find(folder: &RunDir, name: Option<&str>) -> Result<Self, ClientError> {
        let run = find(folder, name)?;
        Self::connect(&run.name, &run.socket)
    }

    /// Connects to a socket; `run` is the name used in errors.
    pub fn connect(run: &str, socket: &Path) -> Result<Self, ClientError> {
        let connect = || {
            let stream = UnixStream::connect(socket)?;
            stream.set_read_timeout(Some(REPLY_TIMEOUT))?;
            stream.set_write_timeout(Some(REPLY_TIMEOUT))?;
            Ok(stream)
        };
        let stream = connect().map_err(|error| ClientError::Io { run: run.to_owned(), error })?;
        Ok(Self { run: run.to_owned(), from: BufReader::new(stream), next: 1, buffered: VecDeque::new() })
    }

    /// Returns the run's name.
    pub fn run(&self) -> &str {
        &self.run
    }

    /// Sends a request and waits for its reply. Buffers stream messages that arrive meanwhile for
    /// [`next_message`](Self::next_message).
    pub fn call<M: Method>(&mut self, params: M) -> Result<M::Reply, ClientError> {
        let id = self.next;
        self.next += 1;
        let line = json!({"id": id, "method": M::NAME, "params": params}).to_string() + "\n";
        if line.len() > MAX_LINE {
            let text = format!("the request has {} bytes (limit {MAX_LINE})", line.len());
            return Err(RpcError::new(Code::TooLarge, text).hint("send fewer points at once").into());
        }
        if let Err(error) = self.from.get_mut().write_all(line.as_bytes()) {
            // A run that refuses the connection sends the reason before it closes it.
            return Err(match self.read() {
                Ok(Incoming { error: Some(refusal), .. }) => refusal.into(),
                _ => self.io(error),
            });
        }
        loop {
            let incoming = self.read()?;
            if incoming.stream.is_some() {
                if self.buffered.len() == MAX_BUFFERED
                    && let Some(lost) = self.buffered.pop_front()
                    && let Some(next) = self.buffered.front_mut()
                {
                    next.lost += lost.lost + 1;
                }
                self.buffered.push_back(message(incoming));
            } else if let Some(refusal) = incoming.error {
                return Err(refusal.into());
            } else if incoming.id == Some(id) {
                return serde_json::from_value(incoming.result).map_err(|e| self.protocol(e.to_string()));
            }
        }
    }

    /// Waits for the next message of any subscription.
    pub fn next_message(&mut self) -> Result<Message, ClientError> {
        if let Some(message) = self.buffered.pop_front() {
            return Ok(message);
        }
        loop {
            let incoming = self.read()?;
            if incoming.stream.is_some() {
                return Ok(message(incoming));
            }
        }
    }

    /// Returns the next buffered message, if any. Never blocks.
    pub fn buffered_message(&mut self) -> Option<Message> {
        self.buffered.pop_front()
    }

    fn read(&mut self) -> Result<Incoming, ClientError> {
        let mut line = String::new();
        match self.from.read_line(&mut line) {
            Ok(0) => Err(self.io(io::Error::new(io::ErrorKind::UnexpectedEof, "the run closed the connection"))),
            Ok(_) => serde_json::from_str(&line).map_err(|e| self.protocol(e.to_string())),
            Err(error) => Err(self.io(error)),
        }
    }

    fn io(&self, error: io::Error) -> ClientError {
        ClientError::Io { run: self.run.clone(), error }
    }

    fn protocol(&self, what: String) -> ClientError {
        ClientError::Protocol { run: self.run.clone(), what }
    }
}

fn message(incoming: Incoming) -> Message {
    Message {
        stream: incoming.stream.unwrap_or_default(),
        subscription: incoming.subscription,
        lost: incoming.lost,
        data: incoming.data,
    }
}
