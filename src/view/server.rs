//! The server of the live view: its thread, its connections.

use std::borrow::Cow;
use std::collections::VecDeque;
use std::io;
use std::net::{SocketAddr, TcpListener as StdListener};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OnceCell, Semaphore, watch};
use tokio::task::{AbortHandle, JoinSet, spawn_blocking};

use super::access::Access;
use super::scene::{self, Scene};
use super::subject::{Live, Subject, value};
use super::{Shown, bridge, foxglove, socket, stl};
use crate::blueprint::WebOrigin;
use crate::blueprint::planner::ViewConfig;
use crate::http::{self, Reply, Request};
use dimos_core::clock::wall_now;
use dimos_rpc::run_dir::{RunFiles, UrlFile};

/// The page, compressed by the build.
static PAGE: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/page.html.gz"));
/// What the page may do: run its own script, and talk to this server.
const PAGE_HEADERS: &str = "Content-Encoding: gzip\r\nContent-Security-Policy: default-src 'none'; \
script-src 'unsafe-inline'; style-src 'unsafe-inline'; connect-src 'self'; img-src data: blob: 'self'; \
base-uri 'none'; form-action 'none'; frame-ancestors 'none'\r\n";

/// Ports that are tried, from the configured one on.
const PORTS: u16 = 100;
/// Maximum number of WebSockets: two per page, one of them for stops only.
const MAX_SOCKETS: usize = 16;
/// Maximum number of connections; a further one ends the oldest without the token.
const MAX_CONNECTIONS: usize = 64;
/// Size of the kernel's buffer to a page [bytes]: a page that takes nothing is noticed when it is full.
const SEND_BUFFER: usize = 128 << 10;
/// Pause after a failed accept (no file descriptors left).
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
/// Time limit for closing the pages at the end of the run.
const FLUSH_TIME: Duration = Duration::from_millis(100);

/// A running server. Ends, and removes the file with its URL, when dropped.
#[derive(Debug)]
pub struct View {
    address: String,
    url: String,
    end: watch::Sender<bool>,
    thread: Option<JoinHandle<()>>,
    _file: Option<UrlFile>,
}

/// What connections share.
struct Site {
    access: Access,
    subject: Arc<dyn Subject>,
    scene: OnceCell<Arc<Scene>>,
    /// The run's socket; `None`: no run is shown.
    run: Option<PathBuf>,
    pages: Arc<Semaphore>,
    /// Viewers of Foxglove, and the origins of other sites whose pages may be some.
    foxglove: foxglove::Shared,
    origins: Vec<WebOrigin>,
    /// Whether the refusal of an origin was logged.
    has_refused: AtomicBool,
}

impl View {
    /// Starts serving the page of the run with this socket. The URL is also in a file of the claimed name: of the run
    /// itself, or of the planner that serves the page.
    pub fn start(config: &ViewConfig, shown: Shown, socket: &Path, claim: &RunFiles) -> Result<Self, String> {
        let live = Live { shown, socket: socket.to_owned() };
        Self::serve(config, Arc::new(live), Some(socket.to_owned()), Some(claim))
    }

    /// Starts serving pages of something that is not live.
    pub fn open(config: &ViewConfig, subject: Arc<dyn Subject>) -> Result<Self, String> {
        Self::serve(config, subject, None, None)
    }

    /// Starts serving pages of a run whose scene comes from elsewhere; each page connects to this socket.
    pub fn through(config: &ViewConfig, subject: Arc<dyn Subject>, socket: &Path) -> Result<Self, String> {
        Self::serve(config, subject, Some(socket.to_owned()), None)
    }

    fn serve(
        config: &ViewConfig,
        subject: Arc<dyn Subject>,
        run: Option<PathBuf>,
        claim: Option<&RunFiles>,
    ) -> Result<Self, String> {
        let listener = bind(config)?;
        let failed = |what: &'static str| move |error: io::Error| format!("{what}: {error}");
        let at = listener.local_addr().map_err(failed("its port"))?;
        let access = Access::new(at).map_err(failed("no random numbers for its token"))?;
        let (address, url) = (access.address(), access.url());
        let file = claim.map(|claim| claim.write_url(&url)).transpose().map_err(failed("the file with its URL"))?;
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_io()
            .enable_time()
            .max_blocking_threads(1)
            .thread_name("view-files")
            .build()
            .map_err(failed("no runtime"))?;
        let (end, ended) = watch::channel(false);
        let pages = Arc::new(Semaphore::new(MAX_SOCKETS));
        let shared = foxglove::Shared {
            subject: subject.clone(),
            meshes: OnceCell::new(),
            session: wall_now().to_string(),
            places: pages.clone(),
        };
        let site = Site {
            access,
            subject,
            scene: OnceCell::new(),
            run,
            pages,
            foxglove: shared,
            origins: config.foxglove.origins.clone(),
            has_refused: AtomicBool::new(false),
        };
        let thread = std::thread::Builder::new().name("view".into()).spawn(move || {
            let serving = || runtime.block_on(serve(listener, Arc::new(site), ended));
            match catch_unwind(AssertUnwindSafe(serving)) {
                Ok(Ok(())) => {}
                Ok(Err(error)) => tracing::warn!("the live view has ended: {error}"),
                Err(_) => tracing::warn!("the live view has ended by a defect of the program; the run continues"),
            }
            // Does not wait for a large mesh that is still being read.
            runtime.shutdown_background();
        });
        Ok(Self { address, url, end, thread: Some(thread.map_err(failed("no thread"))?), _file: file })
    }

    /// Returns its address, without the token.
    pub fn address(&self) -> &str {
        &self.address
    }

    /// Returns its address with the token: for the user's eyes and the file only, never for a log.
    pub fn url(&self) -> &str {
        &self.url
    }
}

impl Drop for View {
    fn drop(&mut self) {
        let _ = self.end.send(true);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Listens at the first free port.
fn bind(config: &ViewConfig) -> Result<StdListener, String> {
    let last = if config.port == 0 { 0 } else { config.port.saturating_add(PORTS - 1) };
    let mut why = None;
    for port in config.port..=last {
        let at = SocketAddr::new(config.host, port);
        match StdListener::bind(at).and_then(|listener| prepare(&listener).map(|()| listener)) {
            Ok(listener) => return Ok(listener),
            Err(error) if error.kind() == io::ErrorKind::AddrInUse => why = Some(error),
            Err(error) => return Err(format!("{at}: {error}")),
        }
    }
    let why = why.map_or_else(String::new, |why| format!(": {why}"));
    Err(format!("no free port from {} to {last}{why}", config.port))
}

fn prepare(listener: &StdListener) -> io::Result<()> {
    // Connections inherit it.
    rustix::net::sockopt::set_socket_send_buffer_size(listener, SEND_BUFFER)?;
    listener.set_nonblocking(true)
}

/// A connection, and whether its page has sent the token.
type Stranger = (AbortHandle, Arc<AtomicBool>);

/// Accepts connections until the end.
async fn serve(listener: StdListener, site: Arc<Site>, mut ended: watch::Receiver<bool>) -> io::Result<()> {
    let listener = TcpListener::from_std(listener)?;
    let (mut connections, for_pages, mut strangers) = (JoinSet::new(), ended.clone(), VecDeque::<Stranger>::new());
    loop {
        tokio::select! {
            _ = ended.wait_for(|ended| *ended) => break,
            Some(_) = connections.join_next() => {}
            accepted = listener.accept() => match accepted {
                Ok((stream, _)) => {
                    strangers.retain(|(task, is_known)| !task.is_finished() && !is_known.load(Ordering::Relaxed));
                    if connections.len() >= MAX_CONNECTIONS {
                        let Some((oldest, _)) = strangers.pop_front() else { continue };
                        oldest.abort();
                    }
                    let is_known = Arc::new(AtomicBool::new(false));
                    let serving = connection(stream, site.clone(), is_known.clone(), for_pages.clone());
                    strangers.push_back((connections.spawn(serving), is_known));
                }
                Err(_) => tokio::time::sleep(ACCEPT_PAUSE).await,
            },
        }
    }
    let _ = tokio::time::timeout(FLUSH_TIME, async { while connections.join_next().await.is_some() {} }).await;
    Ok(())
}

async fn connection(mut stream: TcpStream, site: Arc<Site>, is_known: Arc<AtomicBool>, ended: watch::Receiver<bool>) {
    let _ = stream.set_nodelay(true);
    let reply = match http::read(&mut stream).await {
        Ok(None) => return,
        Ok(Some(request)) => match &site.run {
            Some(run) if request.path == "/rpc" && socket::key(&request).is_some() && is_own(&site, &request) => {
                return bridge::serve(stream, request, &site.access, run, (&site.pages, &is_known), ended).await;
            }
            Some(run) if request.path == foxglove::PATH && socket::key(&request).is_some() => {
                match viewer(&site, &request) {
                    Ok(protocol) => {
                        let Some(viewer) = socket::open(stream, request, Some(protocol)).await else { return };
                        return foxglove::serve(viewer, run, &site.foxglove, &is_known, ended).await;
                    }
                    Err(reply) => reply,
                }
            }
            _ => answer(&site, &request).await,
        },
        Err(reply) => reply,
    };
    // The browser shows an error; there is no one else who could act on it.
    let _ = http::send(&mut stream, reply).await;
}

fn is_own(site: &Site, request: &Request) -> bool {
    site.access.is_own(request.header("host"), request.header("origin"))
}

/// Returns the subprotocol of Foxglove for a viewer, or why it is refused.
fn viewer(site: &Site, request: &Request) -> Result<&'static str, Reply> {
    let (host, origin) = (request.header("host"), request.header("origin"));
    let is_listed = origin.is_some_and(|origin| site.origins.iter().any(|known| known.as_str() == origin));
    if !(is_own(site, request) || is_listed && site.access.is_own(host, None)) {
        let origin = origin.unwrap_or("none");
        let why = format!("pages of another site may not connect (Origin: {origin}); hint: view.foxglove.origins");
        // Browsers do not show it.
        if !site.has_refused.swap(true, Ordering::Relaxed) {
            tracing::warn!("the live view: {}", why.escape_debug());
        }
        return Err(Reply::text(403, why));
    }
    if !value(&request.query, "token").is_some_and(|token| site.access.is_reading_token(token)) {
        return Err(Reply::text(401, "the token is missing or wrong: `dimos view --foxglove` prints the URL"));
    }
    foxglove::subprotocol(request)
        .ok_or_else(|| Reply::text(400, "the subprotocol is foxglove.sdk.v1 or foxglove.websocket.v1"))
}

async fn answer(site: &Site, request: &Request) -> Reply {
    if !is_own(site, request) {
        return Reply::text(403, "this page is served to itself only: open the address that `dimos view` prints");
    }
    if request.method != "GET" {
        return Reply::text(405, "only GET");
    }
    let path = request.path.strip_prefix('/').unwrap_or_default();
    let (what, rest) = path.split_once('/').unwrap_or((path, ""));
    match what {
        "" if path.is_empty() => {
            let body = Cow::Borrowed(PAGE);
            return Reply { status: 200, kind: "text/html; charset=utf-8", headers: PAGE_HEADERS, body, keep: false };
        }
        "rpc" | "foxglove" if site.run.is_some() => return Reply::text(426, "this is a WebSocket"),
        "scene.json" | "mesh" | "object" | "messages" | "pose" => {}
        _ => return Reply::text(404, "there is no such page"),
    }
    if !site.access.is_bearer(request.header("authorization")) {
        return Reply::text(401, "the token is missing or wrong: `dimos view` prints the URL");
    }
    let Some(scene) = scene(site).await else { return Reply::text(500, "the scene cannot be made") };
    if what == "scene.json" {
        return content("application/json", scene.json.clone().into_bytes());
    }
    let (subject, what, rest, query) = (site.subject.clone(), what.to_owned(), rest.to_owned(), request.query.clone());
    let whole = path.to_owned();
    let reply = spawn_blocking(move || match what.as_str() {
        "mesh" | "object" if let Some(file) = subject.file(&whole) => match file {
            Ok(bytes) => Reply { keep: what == "mesh" && rest.contains('-'), ..content("model/stl", bytes) },
            Err(why) => Reply::text(404, why),
        },
        "mesh" => mesh(&scene, &rest),
        "object" => match subject.object(&rest).map(|object| stl::of_object(&object.shape)) {
            Some(Ok(bytes)) => content("application/octet-stream", bytes),
            Some(Err(why)) => Reply::text(404, why),
            None => Reply::text(404, "there is no such object"),
        },
        what => match subject.answer(what, &query) {
            Some(Ok(json)) => content("application/json", json.into_bytes()),
            Some(Err(why)) => Reply::text(400, why),
            None => Reply::text(404, "there is no such page"),
        },
    });
    reply.await.unwrap_or_else(|_| Reply::text(500, "this cannot be read"))
}

fn content(kind: &'static str, body: Vec<u8>) -> Reply {
    Reply { status: 200, kind, headers: "", body: Cow::Owned(body), keep: false }
}

/// Returns the scene, read by the first page that asks for it. `None`: reading panicked.
async fn scene(site: &Site) -> Option<Arc<Scene>> {
    let subject = site.subject.clone();
    let read = || async { spawn_blocking(move || Arc::new(subject.scene())).await };
    site.scene.get_or_try_init(read).await.ok().cloned()
}

/// Returns a mesh by the end of its address: its number and hash.
fn mesh(scene: &Scene, address: &str) -> Reply {
    let number = address.split('-').next().and_then(|number| number.parse::<usize>().ok());
    let Some((number, mesh)) = number.and_then(|number| Some((number, scene.meshes.get(number)?))) else {
        return Reply::text(404, "there is no such mesh");
    };
    match (stl::of(mesh), mesh) {
        (Ok(stl), _) => {
            // A file that was changed meanwhile has another address.
            let keep = address.contains('-') && mesh.address(number).ends_with(address);
            Reply { keep, ..content("model/stl", stl) }
        }
        (Err(why), scene::MeshFile::Missing(_)) => Reply::text(404, why),
        (Err(why), _) => Reply::text(500, why),
    }
}
