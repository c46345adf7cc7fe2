//! Requests that always get through, as their client sends them: beside clients that occupy all connections of a run,
//! and to a run whose thread for them hangs and is replaced.

use std::io;
use std::time::{Duration, Instant};

use crate::api::Method;
use crate::client::{Client, ClientError, REPLY_TIMEOUT};
use crate::error::Code;

/// Maximum time for an urgent request, and for its first attempt; one that gets no reply is followed by one of twice
/// the time: an arm may need seconds to confirm a stop.
const URGENT_TIMEOUT: Duration = Duration::from_secs(10);
const FIRST_ATTEMPT: Duration = Duration::from_secs(1);
/// Maximum time for a socket at which nothing listens: that of a run that begins to listen, or is opened again.
const ABSENT_TIMEOUT: Duration = Duration::from_secs(1);
/// Pause between two attempts.
const RETRY_PAUSE: Duration = Duration::from_millis(20);

impl ClientError {
    /// Returns whether a new connection may get a reply: this one had no place, ended, or got none in time.
    pub fn is_passing(&self) -> bool {
        use io::ErrorKind::{BrokenPipe, ConnectionRefused, ConnectionReset, UnexpectedEof};
        match self {
            Self::Refused(error) => error.code == Code::TooManyConnections,
            Self::Io { error, .. } => {
                let kinds = [BrokenPipe, ConnectionRefused, ConnectionReset, UnexpectedEof];
                self.is_timeout() || kinds.contains(&error.kind())
            }
            _ => false,
        }
    }

    /// Returns for how long an urgent request is repeated after this error.
    fn patience(&self) -> Duration {
        match self {
            Self::Io { error, .. } if error.kind() == io::ErrorKind::ConnectionRefused => ABSENT_TIMEOUT,
            _ => URGENT_TIMEOUT,
        }
    }
}

impl Client {
    /// Sends a request that always gets through, such as `stop`, over connections of `connect` until it is answered,
    /// for at most 10 s; the first attempts are short. It may so be sent several times. Begins with the connection
    /// `open`, if there is one. Returns the last connection and the reply.
    pub fn urgent<M: Method + Clone>(
        mut open: Option<Self>,
        connect: impl Fn() -> Result<Self, ClientError>,
        params: &M,
    ) -> Result<(Self, M::Reply), ClientError> {
        let began = Instant::now();
        let mut attempt = FIRST_ATTEMPT;
        loop {
            let mut call = || -> Result<_, ClientError> {
                let mut client = open.take().map_or_else(&connect, Ok)?;
                client.timeout = attempt.min(URGENT_TIMEOUT.saturating_sub(began.elapsed()));
                let reply = client.call(params.clone())?;
                client.timeout = REPLY_TIMEOUT;
                Ok((client, reply))
            };
            match call() {
                Err(error) if error.is_passing() && began.elapsed() + RETRY_PAUSE < error.patience() => {
                    if error.is_timeout() {
                        attempt *= 2;
                    }
                    std::thread::sleep(RETRY_PAUSE);
                }
                result => return result,
            }
        }
    }
}

impl Client {
    /// Sends such a request over this connection; where it gets no reply at once, over others of `connect` as
    /// [`Client::urgent`] does. This one remains open.
    pub fn call_urgently<M: Method + Clone>(
        &mut self,
        connect: impl Fn() -> Result<Self, ClientError>,
        params: &M,
    ) -> Result<M::Reply, ClientError> {
        let timeout = std::mem::replace(&mut self.timeout, FIRST_ATTEMPT);
        let reply = self.call(params.clone());
        self.timeout = timeout;
        match reply {
            Err(error) if error.is_passing() => Self::urgent(None, connect, params).map(|(_, reply)| reply),
            reply => reply,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io::{BufRead, BufReader, Write};
    use std::os::unix::net::UnixStream;
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::*;
    use crate::api::{Confirmation, Stop};

    /// What a run does with a connection.
    #[derive(Clone, Copy)]
    enum Run {
        Refuses(Code),
        Closes,
        Hangs,
        /// Confirms a stop after this time.
        Confirms(Duration),
        /// Does not listen.
        IsAbsent,
    }

    /// A connection to a run that does this.
    fn connection(run: Run) -> Result<Client, ClientError> {
        if matches!(run, Run::IsAbsent) {
            return Err(ClientError::Io { run: "cell".into(), error: io::ErrorKind::ConnectionRefused.into() });
        }
        let (mut theirs, ours) = UnixStream::pair().unwrap();
        std::thread::spawn(move || {
            let mut line = String::new();
            match run {
                Run::Refuses(code) => {
                    let refusal =
                        format!("{{\"id\": null, \"error\": {{\"code\": \"{}\", \"message\": \"\"}}}}\n", code.name());
                    theirs.write_all(refusal.as_bytes()).unwrap();
                }
                Run::Closes | Run::IsAbsent => {}
                Run::Hangs => std::thread::sleep(2 * URGENT_TIMEOUT),
                Run::Confirms(after) => {
                    BufReader::new(theirs.try_clone().unwrap()).read_line(&mut line).unwrap();
                    std::thread::sleep(after);
                    let _ = theirs.write_all(b"{\"id\": 1, \"result\": {\"arms\": {\"arm\": \"confirmed\"}}}\n");
                }
            }
        });
        Ok(Client::over(ours, "cell", REPLY_TIMEOUT).unwrap())
    }

    /// Stops a run that does this with one connection after the other, the last one repeatedly. Returns the result and
    /// the number of connections.
    fn stop(does: &[Run]) -> (Result<Confirmation, ClientError>, usize) {
        let count = AtomicUsize::new(0);
        let connect = || {
            let number = count.fetch_add(1, Ordering::Relaxed);
            connection(*does.get(number).or(does.last()).unwrap())
        };
        let result = Client::urgent(None, connect, &Stop::default()).map(|(_, reply)| reply.arms["arm"]);
        (result, count.load(Ordering::Relaxed))
    }

    const AT_ONCE: Run = Run::Confirms(Duration::ZERO);

    #[test]
    fn a_stop_connects_until_it_is_answered() {
        let began = Instant::now();
        let full = Run::Refuses(Code::TooManyConnections);
        let (result, connections) = stop(&[full, full, Run::Closes, Run::Hangs, full, AT_ONCE]);
        assert_eq!((result.unwrap(), connections), (Confirmation::Confirmed, 6));
        assert!(began.elapsed() < Duration::from_secs(3), "{:?}", began.elapsed());
    }

    #[test]
    fn an_arm_that_confirms_late_is_waited_for() {
        let (result, connections) = stop(&[Run::Confirms(Duration::from_millis(3_500))]);
        assert_eq!((result.unwrap(), connections), (Confirmation::Confirmed, 3), "1 s, 2 s, then long enough");
    }

    #[test]
    fn other_refusals_end_it_and_so_does_its_time() {
        let (result, connections) = stop(&[Run::Refuses(Code::UnknownArm)]);
        assert!(matches!(result, Err(ClientError::Refused(error)) if error.code == Code::UnknownArm));
        assert_eq!(connections, 1);
        let began = Instant::now();
        let (result, connections) = stop(&[Run::Refuses(Code::TooManyConnections)]);
        assert!(matches!(result, Err(ClientError::Refused(error)) if error.code == Code::TooManyConnections));
        assert!(connections > 50 && began.elapsed() < URGENT_TIMEOUT + Duration::from_secs(1), "{connections}");
    }

    #[test]
    fn a_socket_at_which_nothing_listens_is_not_waited_for() {
        let began = Instant::now();
        assert!(stop(&[Run::IsAbsent]).0.is_err());
        assert!(began.elapsed() < 3 * ABSENT_TIMEOUT, "{:?}", began.elapsed());
        assert!(stop(&[Run::IsAbsent, AT_ONCE]).0.is_ok(), "it has begun to listen");
    }

    #[test]
    fn it_begins_with_an_open_connection() {
        let open = connection(AT_ONCE).unwrap();
        let (_, reply) = Client::urgent(Some(open), || panic!("another connection"), &Stop::default()).unwrap();
        assert_eq!(reply.arms["arm"], Confirmation::Confirmed);
    }
}
