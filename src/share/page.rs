//! The files of a run's live view on another computer: the gateway gets them from the page's server, with its token,
//! which therefore no one else needs. What the page asks the run, it asks as any client.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::time::Duration;

use serde::Deserialize;
use serde_json::{Value, json};
use zenoh::query::Query;
use zenoh::{Session, Wait};

use super::class::PAGE;
use super::place::Place;
use super::remote::refuse;
use super::settings::MAX_MESSAGE;
use super::{connection, keys};
use dimos_rpc::api::Class;
use dimos_rpc::client::{self, ClientError};
use dimos_rpc::error::{Code, RpcError};

/// Requests that may wait.
const QUEUE: usize = 16;
/// Maximum size of a file [bytes]: it is one message.
const MAX_FILE: usize = MAX_MESSAGE - (64 << 10);
/// Maximum length of a path [bytes].
const MAX_PATH: usize = 512;
/// Time limit for each step of the page's server.
const TIMEOUT: Duration = Duration::from_secs(5);
/// Time limit for a file, over the network.
const FILE_TIMEOUT: Duration = Duration::from_secs(30);

/// Parameters of `page`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Params {
    /// `scene.json`, `mesh/…`, `object/…`.
    path: String,
}

/// Answers requests for files, one after the other on a thread.
pub(super) struct Pages(SyncSender<(Query, Value)>);

impl Pages {
    /// Starts the thread; it ends when this is dropped.
    pub fn start(run: &str, socket: &Path) -> std::io::Result<Self> {
        let (queue, waiting) = sync_channel(QUEUE);
        let (run, socket) = (run.to_owned(), socket.to_owned());
        std::thread::Builder::new().name("share-page".into()).spawn(move || serve(&waiting, &run, &socket))?;
        Ok(Self(queue))
    }

    /// Queues a request; returns one that is refused. Never waits.
    pub fn queue(&self, query: Query, params: Value) -> Option<(Query, RpcError)> {
        let refused = self.0.try_send((query, params)).err()?;
        let (TrySendError::Full((query, _)) | TrySendError::Disconnected((query, _))) = refused;
        let error = RpcError::new(Code::TooManyRequests, format!("{QUEUE} requests for files wait"));
        Some((query, error.hint("wait for replies before you send more")))
    }
}

fn serve(waiting: &Receiver<(Query, Value)>, run: &str, socket: &Path) {
    for (query, params) in waiting {
        match answer(params, run, socket) {
            Ok(file) => drop(query.reply(query.key_expr().clone(), file).wait()),
            Err(error) => refuse(&query, &error),
        }
    }
}

fn answer(params: Value, run: &str, socket: &Path) -> Result<Vec<u8>, RpcError> {
    let Params { path } =
        serde_json::from_value(params).map_err(|e| RpcError::new(Code::InvalidParams, format!("params: {e}")))?;
    let served = ["scene.json", "mesh/", "object/"].iter().any(|part| path.starts_with(part));
    if !served || path.len() > MAX_PATH || !path.bytes().all(|b| b.is_ascii_graphic()) {
        return Err(RpcError::new(Code::InvalidParams, "path must be scene.json, mesh/… or object/…"));
    }
    let Some(url) = client::view_url(run, socket) else {
        let hint = "the blueprint of the run, or of a planner attached to it, needs a robot model or a section `view`";
        return Err(RpcError::new(Code::Unsupported, format!("run {run} has no live view")).hint(hint));
    };
    get(&url, &path).map_err(|why| RpcError::new(Code::Internal, format!("the page of run {run}: {why}")))
}

/// Gets a file of a page by its URL with the token.
fn get(url: &str, path: &str) -> Result<Vec<u8>, String> {
    let rest = url.strip_prefix("http://").and_then(|rest| rest.split_once("/#"));
    let (host, token) = rest.ok_or_else(|| "it has no address".to_owned())?;
    let address: SocketAddr = host.parse().map_err(|e| format!("{host}: {e}"))?;
    let mut stream = TcpStream::connect_timeout(&address, TIMEOUT).map_err(|e| e.to_string())?;
    let timeouts = stream.set_read_timeout(Some(TIMEOUT)).and_then(|()| stream.set_write_timeout(Some(TIMEOUT)));
    timeouts.map_err(|e| e.to_string())?;
    let request =
        format!("GET /{path} HTTP/1.1\r\nHost: {host}\r\nAuthorization: Bearer {token}\r\nConnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).map_err(|e| e.to_string())?;
    let mut reply = Vec::new();
    let most = MAX_FILE as u64 + (8 << 10);
    stream.take(most + 1).read_to_end(&mut reply).map_err(|e| e.to_string())?;
    if reply.len() as u64 > most {
        return Err(format!("{path} is larger than {} MB", MAX_FILE / 1_000_000));
    }
    body(reply, path)
}

/// Returns the body of a reply, if all is well.
fn body(mut reply: Vec<u8>, path: &str) -> Result<Vec<u8>, String> {
    let end = reply.windows(4).position(|four| four == b"\r\n\r\n").ok_or_else(|| "no reply".to_owned())?;
    let body = reply.split_off(end + 4);
    let head = String::from_utf8_lossy(&reply).into_owned();
    if head.split(' ').nth(1) == Some("200") { Ok(body) } else { Err(format!("{path}: {}", text_of(&body))) }
}

fn text_of(body: &[u8]) -> String {
    String::from_utf8_lossy(body).chars().filter(|c| !c.is_control()).take(200).collect()
}

/// Gets the files of a page at a place.
pub struct Page {
    place: Place,
    run: String,
    session: Session,
}

impl Page {
    pub(super) fn new(session: Session, place: &Place, run: &str) -> Self {
        Self { place: place.clone(), run: run.to_owned(), session }
    }

    /// Returns the run's name.
    pub fn run(&self) -> &str {
        &self.run
    }

    /// Returns a file; waits for it, at most 30 s.
    pub fn get(&self, path: &str) -> Result<Vec<u8>, ClientError> {
        let id = self.session.zid().to_string();
        let key = keys::request(&self.run, &self.place.user, Class::Read, &id, PAGE);
        let asked = self.session.get(key).payload(json!({"path": path}).to_string()).timeout(FILE_TIMEOUT).wait();
        let lost = || RpcError::new(Code::Lost, format!("the connection to {} is lost", self.place.name));
        let replies = asked.map_err(|_| lost())?;
        match replies.recv().map(|reply| reply.into_result()) {
            Ok(Ok(file)) => Ok(file.payload().to_bytes().into_owned()),
            Ok(Err(error)) => Err(connection::error_of(error.payload()).unwrap_or_else(lost).into()),
            Err(_) => Err(lost().into()),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;

    #[test]
    fn only_files_of_the_page_are_served() {
        let socket = PathBuf::from("/nonexistent/cell.sock");
        for wrong in ["", "/", "../x", "pose?x", "mesh/1 HTTP/1.1\r\nX: y", "mesh/ä", &format!("mesh/{:0600}", 1)] {
            let refused = answer(json!({"path": wrong}), "cell", &socket).unwrap_err();
            assert_eq!(refused.code, Code::InvalidParams, "{wrong:?}");
        }
        assert_eq!(answer(json!({}), "cell", &socket).unwrap_err().code, Code::InvalidParams);
        assert_eq!(answer(json!({"path": "mesh/0-ab"}), "cell", &socket).unwrap_err().code, Code::Unsupported);
    }

    #[test]
    fn a_reply_that_is_not_well_is_an_error_with_its_text() {
        assert_eq!(body(b"HTTP/1.1 200 OK\r\nA: b\r\n\r\nsolid".to_vec(), "mesh/0"), Ok(b"solid".to_vec()));
        let wrong = body(b"HTTP/1.1 404 Not Found\r\n\r\nthere is no such mesh".to_vec(), "mesh/9");
        assert_eq!(wrong, Err("mesh/9: there is no such mesh".to_owned()));
        assert!(body(b"nonsense".to_vec(), "mesh/9").is_err());
    }
}
