//! Stops and cancels of the proxy, which always get through: each kind has a thread and a connection, so that no stop
//! waits for the answer to a cancel.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::Instant;

use super::run_link::{Shared, start};
use crate::cli::arguments;
use crate::cli::exit::Result;
use dimos_rpc::api::{Cancel, Method, Stop};
use dimos_rpc::client::{Client, ClientError};

/// The way to both threads; they end with it.
pub struct Ends {
    stops: Sender<u64>,
    cancels: Sender<(u64, Cancel)>,
    /// Number of stops that were ordered.
    ordered: Arc<AtomicU64>,
}

impl Ends {
    /// Starts the threads, each with a connection to the run.
    pub fn start(shared: &Arc<Shared>, [stopping, cancelling]: [Client; 2]) -> Result<Self> {
        let ((stops, to_stop), (cancels, to_cancel)) = (channel(), channel());
        let ordered = Arc::new(AtomicU64::new(0));
        let latest = ordered.clone();
        start("proxy-stops", shared, move |shared| send_stops(&to_stop, stopping, shared))?;
        start("proxy-cancels", shared, move |shared| send_cancels(&to_cancel, &latest, cancelling, shared))?;
        Ok(Self { stops, cancels, ordered })
    }

    /// Stops the arm. Until the run answers, it counts as held.
    pub fn stop(&self, shared: &Shared) {
        let mut view = shared.view();
        let number = self.ordered.fetch_add(1, Ordering::Relaxed) + 1;
        (view.ready, view.held, view.stopping) = (false, true, Some(number));
        // Fails only once the run is lost.
        let _ = self.stops.send(number);
    }

    /// Cancels motions.
    pub fn cancel(&self, cancel: Cancel) {
        let _ = self.cancels.send((self.ordered.load(Ordering::Relaxed), cancel));
    }
}

/// Sends a stop for each that is ordered, or one for several that wait.
fn send_stops(stops: &Receiver<u64>, open: Client, shared: &Shared) -> std::result::Result<(), ClientError> {
    let mut link = UrgentLink::new(open);
    for number in stops {
        let number = stops.try_iter().last().unwrap_or(number);
        link.send(&Stop { arm: Some(shared.arm.clone()) }, shared)?;
        let mut view = shared.view();
        if view.stopping == Some(number) {
            (view.stopping, view.not_before) = (None, Instant::now());
        }
    }
    Ok(())
}

/// Sends the cancels. One that a stop has overtaken is dropped: the stop has ended the motion, and a later one is meant
/// to move.
fn send_cancels(
    cancels: &Receiver<(u64, Cancel)>,
    ordered: &AtomicU64,
    open: Client,
    shared: &Shared,
) -> std::result::Result<(), ClientError> {
    let mut link = UrgentLink::new(open);
    for (stops, cancel) in cancels {
        if stops == ordered.load(Ordering::Relaxed) {
            link.send(&cancel, shared)?;
        }
    }
    Ok(())
}

/// A connection that is opened again where the run closes it.
struct UrgentLink {
    run: String,
    open: Option<Client>,
}

impl UrgentLink {
    fn new(open: Client) -> Self {
        Self { run: open.run().to_owned(), open: Some(open) }
    }

    fn send<M: Method + Clone>(&mut self, request: &M, shared: &Shared) -> std::result::Result<(), ClientError> {
        let connect = || arguments::connect(Some(&self.run));
        match Client::urgent(self.open.take(), connect, request) {
            Ok((client, _)) => self.open = Some(client),
            Err(ClientError::Refused(refusal)) => shared.note(refusal.to_string()),
            Err(error) => return Err(error),
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::io::{BufRead, BufReader};
    use std::os::unix::net::UnixStream;

    use super::*;

    #[test]
    fn a_cancel_that_a_stop_has_overtaken_is_dropped() {
        let (theirs, ours) = UnixStream::pair().unwrap();
        let shared = Shared::new("arm", [None, None]);
        let (to, cancels) = channel();
        let cancel = |task: &str| Cancel { task: Some(task.to_owned()), ..Cancel::default() };
        to.send((0, cancel("before"))).unwrap();
        to.send((1, cancel("after"))).unwrap();
        drop(to);
        let run = std::thread::spawn(move || {
            let mut line = String::new();
            BufReader::new(theirs.try_clone().unwrap()).read_line(&mut line).unwrap();
            std::io::Write::write_all(&mut &theirs, b"{\"id\": 1, \"result\": {\"tasks\": {}}}\n").unwrap();
            line
        });
        let open = Client::of_stream(ours, "cell").unwrap();
        send_cancels(&cancels, &AtomicU64::new(1), open, &shared).unwrap();
        assert!(run.join().unwrap().contains("after"));
    }
}
