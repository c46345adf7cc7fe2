//! The streams that everyone may read: read once from the run, and published once for all.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};

use serde_json::json;
use zenoh::pubsub::Publisher;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::{Session, Wait};

use super::keys;
use dimos_rpc::client::{Client, ClientError};
use dimos_rpc::server::streams::{Stream, Subscribe};

/// Publishes the streams of a run until the result is dropped. A stream without subscribers is not read.
pub(super) fn publish(session: &Session, run: &str, socket: &Path) -> zenoh::Result<Vec<Box<dyn Send>>> {
    let mut declared: Vec<Box<dyn Send>> = Vec::new();
    for stream in Stream::ALL.iter().copied() {
        let priority = match stream {
            Stream::CoordinatorJointState => Priority::RealTime,
            Stream::Events => Priority::DataHigh,
        };
        // Dropped for a subscriber that is congested: with `Block` one frozen subscriber stops all others for 5 s.
        let publisher = session.declare_publisher(keys::stream(run, stream.name()));
        let publisher =
            publisher.congestion_control(CongestionControl::Drop).priority(priority).express(true).wait()?;
        let (changes, changed) = channel::<()>();
        let wanted = Arc::new(AtomicBool::new(false));
        let (is_wanted, wake): (Arc<AtomicBool>, Sender<()>) = (wanted.clone(), changes);
        let listener = publisher.matching_listener().callback(move |status| {
            is_wanted.store(status.matching(), Ordering::Release);
            let _ = wake.send(());
        });
        declared.push(Box::new(listener.wait()?));
        let (run, socket) = (run.to_owned(), socket.to_owned());
        let reader = Reader { publisher, stream, run, socket, wanted };
        std::thread::Builder::new().name(format!("share-{}", stream.name())).spawn(move || reader.serve(&changed))?;
    }
    Ok(declared)
}

/// Reads one stream.
struct Reader {
    publisher: Publisher<'static>,
    stream: Stream,
    run: String,
    socket: PathBuf,
    /// Whether anyone subscribes to it.
    wanted: Arc<AtomicBool>,
}

impl Reader {
    /// Publishes while there are subscribers; ends with the gateway.
    fn serve(self, changed: &Receiver<()>) {
        // Numbers the messages, so that a subscriber sees what it lost.
        let mut seq = 1;
        while changed.recv().is_ok() {
            if self.wanted.load(Ordering::Acquire)
                && let Err(error) = self.publish(&mut seq)
            {
                tracing::debug!("share: {}: {error}", self.stream.name());
            }
        }
    }

    fn publish(&self, seq: &mut u64) -> Result<(), ClientError> {
        let mut client = Client::connect(&self.run, &self.socket)?;
        client.call(Subscribe::to(self.stream))?;
        while self.wanted.load(Ordering::Acquire) {
            let message = match client.next_message() {
                Ok(message) => message,
                // Events may be rare.
                Err(error) if error.is_timeout() => continue,
                Err(error) => return Err(error),
            };
            *seq += message.lost;
            let payload = json!({"seq": seq, "data": message.data}).to_string();
            *seq += 1;
            let _ = self.publisher.put(payload).wait();
        }
        Ok(())
    }
}
