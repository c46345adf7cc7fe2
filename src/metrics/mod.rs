//! Metrics of a run, or of a planner attached to one, for Prometheus and others: `GET /metrics` at the address in the
//! blueprint. One thread of ordinary priority answers; it reads what `status` reads, and nothing of the tick.

mod figures;
mod planner;
mod text;

use std::borrow::Cow;
use std::io;
use std::net::{SocketAddr, TcpListener as StdListener};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio::task::JoinSet;

pub use figures::{Counts, Figures, LogFigures};
pub use planner::{AttachedFigures, PlannerFigures};
pub use text::Form;

use crate::http::{self, Reply, Request};

/// Maximum number of connections; further ones wait.
const MAX_CONNECTIONS: usize = 16;
/// Pause after a failed accept (no file descriptors left).
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// The address of the metrics, taken before the run starts anything.
#[derive(Debug)]
pub struct Bound(StdListener);

/// A server of metrics. Ends when dropped.
#[derive(Debug)]
pub struct Metrics {
    url: String,
    end: watch::Sender<bool>,
    thread: Option<JoinHandle<()>>,
}

impl Bound {
    /// Takes the address.
    pub fn at(address: SocketAddr) -> io::Result<Self> {
        let listener = StdListener::bind(address)?;
        listener.set_nonblocking(true)?;
        Ok(Self(listener))
    }

    /// Starts to answer with what `text` returns; `None`: the run has ended.
    pub fn serve(self, text: impl Fn(Form) -> Option<String> + Send + Sync + 'static) -> io::Result<Metrics> {
        let at = self.0.local_addr()?;
        let runtime = tokio::runtime::Builder::new_current_thread().enable_io().enable_time().build()?;
        let (end, ended) = watch::channel(false);
        let answer = Arc::new(move |request: &Request| answer(at, request, &text));
        let serving = move || {
            if let Err(error) = runtime.block_on(serve(self.0, answer, ended)) {
                tracing::warn!("the metrics have ended: {error}");
            }
        };
        let thread = std::thread::Builder::new().name("metrics".into()).spawn(serving)?;
        Ok(Metrics { url: format!("http://{at}/metrics"), end, thread: Some(thread) })
    }
}

impl Metrics {
    /// Returns its URL.
    pub fn url(&self) -> &str {
        &self.url
    }
}

impl Drop for Metrics {
    fn drop(&mut self) {
        let _ = self.end.send(true);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

type Answer = dyn Fn(&Request) -> Reply + Send + Sync;

/// Accepts connections until the end.
async fn serve(listener: StdListener, answer: Arc<Answer>, mut ended: watch::Receiver<bool>) -> io::Result<()> {
    let (listener, mut connections) = (TcpListener::from_std(listener)?, JoinSet::new());
    loop {
        tokio::select! {
            _ = ended.wait_for(|ended| *ended) => return Ok(()),
            Some(_) = connections.join_next() => {}
            accepted = listener.accept(), if connections.len() < MAX_CONNECTIONS => match accepted {
                Ok((stream, _)) => drop(connections.spawn(connection(stream, answer.clone()))),
                Err(_) => tokio::time::sleep(ACCEPT_PAUSE).await,
            },
        }
    }
}

async fn connection(mut stream: TcpStream, answer: Arc<Answer>) {
    let reply = match http::read(&mut stream).await {
        Ok(None) => return,
        Ok(Some(request)) => answer(&request),
        Err(reply) => reply,
    };
    // The client sees the error; there is no one else who could act on it.
    let _ = http::send(&mut stream, reply).await;
}

fn answer(at: SocketAddr, request: &Request, text: &impl Fn(Form) -> Option<String>) -> Reply {
    if !http::is_own(at, request.header("host"), request.header("origin")) {
        return Reply::text(403, "metrics are served to programs, by the IP address of this computer or localhost");
    }
    if request.method != "GET" {
        return Reply::text(405, "only GET");
    }
    if request.path != "/metrics" {
        return Reply::text(404, "there is no such page: metrics are at /metrics");
    }
    let form = Form::accepted(request.header("accept"));
    match text(form) {
        Some(text) => Reply {
            status: 200,
            kind: form.content_type(),
            headers: "",
            body: Cow::Owned(text.into_bytes()),
            keep: false,
        },
        None => Reply::text(503, "the run has ended"),
    }
}
