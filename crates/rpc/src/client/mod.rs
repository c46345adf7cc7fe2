//! A blocking client of a run's socket, for the command line and for programs.

pub mod planner_stub;
pub mod reach;
pub(crate) mod urgent;

use std::collections::VecDeque;
use std::io::{self, BufRead, BufReader, Write};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use crate::api::{MAX_LINE, Method, Status};
use crate::client::reach::Unreached;
use crate::error::{Code, RpcError};
use crate::run_dir::{self, LiveRun, RunDir, RunDirError};
use crate::server::CALL_TIMEOUT;
use crate::wire::Incoming;
use dimos_yaml::{did_you_mean, quote};

/// Timeout for a reply: a little longer than the run's own.
pub(crate) const REPLY_TIMEOUT: Duration = CALL_TIMEOUT.saturating_add(Duration::from_secs(2));
/// Minimum time for one read, so that what has arrived already is read after the deadline too.
const MIN_READ_TIMEOUT: Duration = Duration::from_millis(1);
/// Stream messages buffered while waiting for a reply; older ones are dropped and counted.
const MAX_BUFFERED: usize = 1024;

/// Why a request has no result.
#[derive(Debug, thiserror::Error)]
pub enum ClientError {
    /// No run is live.
    #[error("no run of this user is live")]
    NoRun,
    /// Another user listens at the run's socket.
    #[error("run {run:?} belongs to another user (uid {uid})")]
    NotOurs {
        /// The run's name.
        run: String,
        /// The user.
        uid: u32,
    },
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
    #[error("run {run:?}: {}", io_text(.error))]
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
    /// Returns whether nothing came in time.
    pub fn is_timeout(&self) -> bool {
        matches!(self, Self::Io { error, .. } if matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut))
    }

    /// Returns what the user can do about it.
    pub fn hint(&self) -> Option<String> {
        match self {
            Self::NoRun => Some("start one: dimos run coordinator-yourarm".into()),
            Self::SeveralRuns(_) => Some("select one with --run NAME".into()),
            Self::UnknownRun { live, .. } if live.is_empty() => Self::NoRun.hint(),
            Self::UnknownRun { name, live } => did_you_mean(name, live.iter().map(|r| r.name.as_str()), "live"),
            Self::NotOurs { .. } => Some("only that user, or root, can use it".into()),
            Self::RunDir(error) => Some(error.hint().into()),
            Self::Io { .. } if self.is_timeout() => {
                Some("the process is live but does not answer; its log may say why".into())
            }
            Self::Io { .. } => Some("the run is starting or has just ended; see `dimos status`".into()),
            Self::Protocol { .. } => Some("the run may be another version of dimos: `dimos status` shows it".into()),
            Self::Refused(error) => error.hint.clone(),
        }
    }
}

/// Describes an error of the socket: what matters is that the run is gone, not at which call that shows.
pub fn io_text(error: &io::Error) -> String {
    match error.kind() {
        io::ErrorKind::BrokenPipe | io::ErrorKind::ConnectionReset | io::ErrorKind::UnexpectedEof => {
            "the run closed the connection".into()
        }
        _ => error.to_string(),
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
    /// Whether it was published before the subscription.
    pub past: bool,
    /// The published value.
    pub data: Value,
}

/// Reply to a request of a [`Sender`]: the request's number, and the result.
pub type Answer = (u64, Result<Value, RpcError>);

/// A connection to a run.
#[derive(Debug)]
pub struct Client {
    run: String,
    from: BufReader<UnixStream>,
    /// Beginning of a line whose end has not arrived yet.
    line: Vec<u8>,
    pub(crate) timeout: Duration,
    next: u64,
    /// The epoch of the requests; `None`: that in which each arrives.
    epoch: Option<u64>,
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

/// Returns the URL of a run's live view, with its token: that of a planner attached to the run, whose page also has the
/// planner's robots, if it serves one here.
pub fn view_url(run: &str, socket: &Path) -> Option<String> {
    let path = run_dir::path_of(socket)?;
    let of_planner = || {
        let status = Client::connect(run, socket).ok()?.call(Status {}).ok()?;
        let name = status.planner?.attached?.name;
        run_dir::check_name(&name).ok()?;
        let planners = RunDir::at(path.parent()?).planners();
        run_dir::url_in(&planners.path().join(format!("{name}.view")))
    };
    of_planner().or_else(|| run_dir::url_in(&run_dir::view_file(&path)))
}

impl Client {
    /// Connects to the run of this name; without a name, to the only live run.
    pub fn find(folder: &RunDir, name: Option<&str>) -> Result<Self, ClientError> {
        let run = find(folder, name)?;
        Self::connect(&run.name, &run.socket)
    }

    /// Connects to a socket; `run` is the name used in errors.
    pub fn connect(run: &str, socket: &Path) -> Result<Self, ClientError> {
        let failed = |error| ClientError::Io { run: run.to_owned(), error };
        let stream = reach::wait_for(socket).map_err(|unreached| match unreached {
            Unreached::Io(error) => failed(error),
            Unreached::OtherUser(uid) => ClientError::NotOurs { run: run.to_owned(), uid },
        })?;
        Self::over(stream, run, REPLY_TIMEOUT).map_err(failed)
    }

    /// Talks over a stream that leads to the run's socket; `run` is the name used in errors.
    pub fn of_stream(stream: UnixStream, run: &str) -> io::Result<Self> {
        Self::over(stream, run, REPLY_TIMEOUT)
    }

    pub(crate) fn over(stream: UnixStream, run: &str, timeout: Duration) -> io::Result<Self> {
        stream.set_write_timeout(Some(timeout))?;
        let (run, from) = (run.to_owned(), BufReader::new(stream));
        Ok(Self { run, from, line: Vec::new(), timeout, next: 1, epoch: None, buffered: VecDeque::new() })
    }

    /// Requests from now on are of this epoch ([`StatusReport::epoch`](crate::report::StatusReport::epoch)): they move
    /// no arm that was stopped, held, disabled or lost since.
    pub fn since(&mut self, epoch: u64) {
        self.epoch = Some(epoch);
    }

    /// Returns the run's name.
    pub fn run(&self) -> &str {
        &self.run
    }

    /// Sends a request and waits for its reply, at most 12 s. Buffers stream messages that arrive meanwhile for
    /// [`next_message`](Self::next_message).
    pub fn call<M: Method>(&mut self, params: M) -> Result<M::Reply, ClientError> {
        let id = self.next;
        self.next += 1;
        let line = request(id, self.epoch, &params)?;
        let deadline = Instant::now() + self.timeout;
        if let Err(error) = self.from.get_mut().write_all(line.as_bytes()) {
            // A run that refuses the connection sends the reason before it closes it.
            return Err(match self.read(deadline) {
                Ok(Incoming { error: Some(refusal), .. }) => refusal.into(),
                _ => self.io(error),
            });
        }
        loop {
            let incoming = self.read(deadline)?;
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
            // A run that only streams must not extend the wait.
            if Instant::now() >= deadline {
                return Err(self.io(self.timed_out()));
            }
        }
    }

    /// Waits for the next message of any subscription, at most 12 s.
    pub fn next_message(&mut self) -> Result<Message, ClientError> {
        if let Some(message) = self.buffered.pop_front() {
            return Ok(message);
        }
        let deadline = Instant::now() + self.timeout;
        loop {
            let incoming = self.read(deadline)?;
            if incoming.stream.is_some() {
                return Ok(message(incoming));
            }
            // Not a late reply: the connection is being closed, and this is why.
            if let (None, Some(refusal)) = (incoming.id, incoming.error) {
                return Err(refusal.into());
            }
        }
    }

    /// Returns the next buffered message, if any. Never blocks.
    pub fn buffered_message(&mut self) -> Option<Message> {
        self.buffered.pop_front()
    }

    /// Returns a sender of requests on this connection that does not wait for replies: [`Client::reply`] returns them.
    /// Only one of both can then send.
    pub fn sender(&self) -> Result<Sender, ClientError> {
        let to = self.from.get_ref().try_clone().map_err(|error| self.io(error))?;
        Ok(Sender { run: self.run.clone(), to, next: self.next })
    }

    /// Waits for the next reply to a request of [`Client::sender`], at most 12 s: its number, and the result. `None`:
    /// no reply came.
    pub fn reply(&mut self) -> Result<Option<Answer>, ClientError> {
        let deadline = Instant::now() + self.timeout;
        loop {
            match self.read(deadline) {
                Ok(Incoming { stream: Some(_), .. }) => {}
                Ok(Incoming { id: Some(id), result, error, .. }) => {
                    return Ok(Some((id, error.map_or(Ok(result), Err))));
                }
                // The run refuses the connection.
                Ok(Incoming { error, .. }) => {
                    return Err(error.map_or_else(|| self.protocol("a reply without id".into()), Into::into));
                }
                Err(ClientError::Io { error, .. }) if error.kind() == io::ErrorKind::TimedOut => return Ok(None),
                Err(error) => return Err(error),
            }
        }
    }

    fn read(&mut self, deadline: Instant) -> Result<Incoming, ClientError> {
        let line = self.read_line(deadline).map_err(|error| self.io(error))?;
        serde_json::from_slice(&line).map_err(|e| self.protocol(e.to_string()))
    }

    /// Reads a line. At the deadline it fails, and the next call continues with the same line.
    fn read_line(&mut self, deadline: Instant) -> io::Result<Vec<u8>> {
        loop {
            if self.from.buffer().is_empty() {
                let left = deadline.saturating_duration_since(Instant::now());
                self.from.get_ref().set_read_timeout(Some(left.max(MIN_READ_TIMEOUT)))?;
            }
            let chunk = match self.from.fill_buf() {
                Ok([]) => {
                    return Err(io::Error::new(io::ErrorKind::UnexpectedEof, "the run closed the connection"));
                }
                Ok(chunk) => chunk,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return Err(self.timed_out()),
                Err(error) => return Err(error),
            };
            let end = chunk.iter().position(|byte| *byte == b'\n');
            let take = end.map_or(chunk.len(), |at| at + 1);
            self.line.extend(chunk.iter().take(take));
            self.from.consume(take);
            if end.is_some() {
                return Ok(std::mem::take(&mut self.line));
            }
            if Instant::now() >= deadline {
                return Err(self.timed_out());
            }
        }
    }

    fn timed_out(&self) -> io::Error {
        io::Error::new(io::ErrorKind::TimedOut, format!("no answer within {} s", self.timeout.as_secs_f64()))
    }

    fn io(&self, error: io::Error) -> ClientError {
        ClientError::Io { run: self.run.clone(), error }
    }

    fn protocol(&self, what: String) -> ClientError {
        ClientError::Protocol { run: self.run.clone(), what }
    }
}

/// Sends requests without waiting for replies: from [`Client::sender`].
#[derive(Debug)]
pub struct Sender {
    run: String,
    to: UnixStream,
    next: u64,
}

impl Sender {
    /// Sends a request; returns its number.
    pub fn send<M: Method>(&mut self, params: &M) -> Result<u64, ClientError> {
        let id = self.next;
        self.next += 1;
        let line = request(id, None, params)?;
        let sent = self.to.write_all(line.as_bytes());
        sent.map(|()| id).map_err(|error| ClientError::Io { run: self.run.clone(), error })
    }

    /// Ends the connection: [`Client::reply`] fails.
    pub fn close(&self) {
        let _ = self.to.shutdown(std::net::Shutdown::Both);
    }
}

/// Encodes a request as a line.
fn request<M: Method>(id: u64, epoch: Option<u64>, params: &M) -> Result<String, ClientError> {
    let mut line = json!({"id": id, "method": M::NAME, "params": params});
    if let Some(epoch) = epoch {
        line["epoch"] = epoch.into();
    }
    let line = line.to_string() + "\n";
    if line.len() > MAX_LINE {
        let text = format!("the request has {} bytes (limit {MAX_LINE})", line.len());
        return Err(RpcError::new(Code::TooLarge, text).hint("send fewer points at once").into());
    }
    Ok(line)
}

fn message(incoming: Incoming) -> Message {
    Message {
        stream: incoming.stream.unwrap_or_default(),
        subscription: incoming.subscription,
        lost: incoming.lost,
        past: incoming.past,
        data: incoming.data,
    }
}

#[cfg(test)]
mod tests {
    use std::thread::{sleep, spawn};

    use super::*;

    const TIMEOUT: Duration = Duration::from_millis(200);

    /// Sends `text` every 10 ms until the client closes its end, for at most 5 s; then closes this end.
    fn repeats(text: &'static str) -> Client {
        let (mut run, client) = UnixStream::pair().unwrap();
        spawn(move || {
            for _ in 0..500 {
                if run.write_all(text.as_bytes()).is_err() {
                    return;
                }
                sleep(Duration::from_millis(10));
            }
        });
        Client::over(client, "test", TIMEOUT).unwrap()
    }

    #[test]
    fn a_run_that_is_gone_closed_the_connection_wherever_that_shows() {
        for kind in [io::ErrorKind::BrokenPipe, io::ErrorKind::ConnectionReset, io::ErrorKind::UnexpectedEof] {
            let error = ClientError::Io { run: "cell".into(), error: kind.into() };
            assert_eq!(error.to_string(), "run \"cell\": the run closed the connection");
        }
    }

    #[test]
    fn a_run_that_streams_and_does_not_reply_ends_the_call_at_its_deadline() {
        // A message of a subscription; a line without end.
        for text in ["{\"stream\": \"events\", \"data\": 1}\n", "1"] {
            let mut client = repeats(text);
            let error = client.call(Status {}).unwrap_err();
            assert!(
                matches!(&error, ClientError::Io { error, .. } if error.kind() == io::ErrorKind::TimedOut),
                "{error}"
            );
            assert_eq!(error.to_string(), "run \"test\": no answer within 0.2 s");
            assert!(error.hint().unwrap().contains("does not answer"));
        }
    }

    #[test]
    fn replies_to_a_sender_have_the_number_of_their_request() {
        let (mut run, client) = UnixStream::pair().unwrap();
        let mut client = Client::over(client, "test", TIMEOUT).unwrap();
        let mut sender = client.sender().unwrap();
        assert!(client.reply().unwrap().is_none(), "nothing was asked");
        let (first, second) = (sender.send(&Status {}).unwrap(), sender.send(&Status {}).unwrap());
        let lines = format!(
            "{{\"stream\": \"events\", \"data\": 1}}\n{{\"id\": {first}, \"result\": 5}}\n\
             {{\"id\": {second}, \"error\": {{\"code\": \"LEASE_HELD\", \"message\": \"held\"}}}}\n"
        );
        run.write_all(lines.as_bytes()).unwrap();
        assert_eq!(client.reply().unwrap(), Some((first, Ok(Value::from(5)))));
        assert_eq!(client.reply().unwrap(), Some((second, Err(RpcError::new(Code::LeaseHeld, "held")))));
        sender.close();
        assert!(client.reply().is_err(), "closed");
    }

    #[test]
    fn a_message_cut_by_the_deadline_is_read_by_the_next_call() {
        let (mut run, client) = UnixStream::pair().unwrap();
        let mut client = Client::over(client, "test", TIMEOUT).unwrap();
        run.write_all(b"{\"stream\": \"events\", ").unwrap();
        client.next_message().unwrap_err();
        run.write_all(b"\"data\": 1}\n").unwrap();
        assert_eq!(client.next_message().unwrap().data, 1);
    }
}
