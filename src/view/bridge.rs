//! The bridge of one page: a WebSocket on one side, a connection to the run's socket on the other. Each message of the
//! page is one line of the rpc protocol, passed on as it is; each line of the run becomes one message.
//!
//! Both directions are independent: a `stop` gets through while the page is slow to take the messages of a stream. A
//! page that takes nothing for [`SEND_TIMEOUT`] is dropped; meanwhile the run drops its oldest messages, as for every
//! client.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use futures_util::stream::{SplitSink, SplitStream};
use futures_util::{SinkExt, StreamExt};
use serde_json::Value;
use tokio::io::{AsyncBufReadExt, AsyncWriteExt, BufReader};
use tokio::net::unix::{OwnedReadHalf, OwnedWriteHalf};
use tokio::net::{TcpStream, UnixStream};
use tokio::sync::{Semaphore, watch};
use tokio::time::timeout;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::handshake::derive_accept_key;
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;
use tokio_tungstenite::tungstenite::protocol::{CloseFrame, Role, WebSocketConfig};
use tokio_tungstenite::tungstenite::{Error, Message};

use super::access::Access;
use super::http::Request;
use dimos_rpc::client::reach;

/// Maximum length of a message of the page [bytes].
const MAX_MESSAGE: usize = 64 << 10;
/// Bytes read from the page at once.
const READ_BUFFER: usize = 16 << 10;
/// Time limit for the token.
const TOKEN_TIMEOUT: Duration = Duration::from_secs(5);
/// Time limit for the page to take a message.
const SEND_TIMEOUT: Duration = Duration::from_secs(5);
/// Time limit for the page to take the reason of the end.
const CLOSE_TIMEOUT: Duration = Duration::from_millis(500);

/// Why the server closes the connection to a page, as codes of WebSocket; those from 4000 on are the program's own.
const GONE: u16 = 1001;
const UNSUPPORTED: u16 = 1003;
const TOO_LARGE: u16 = 1009;
const NO_RUN: u16 = 1011;
const WRONG_TOKEN: u16 = 4401;
const TOO_MANY: u16 = 4429;

type Socket = WebSocketStream<TcpStream>;

/// Returns the key of a request for a WebSocket; `None` if it is none.
pub fn key(request: &Request) -> Option<&str> {
    let upgrades = request.has_word("upgrade", "websocket") && request.has_word("connection", "upgrade");
    request.header("sec-websocket-key").filter(|_| upgrades && request.header("sec-websocket-version") == Some("13"))
}

/// Serves a page until it or the run ends. `pages` counts those with the token; `is_known` is set for one of them.
pub async fn serve(
    mut stream: TcpStream,
    request: Request,
    access: &Access,
    run: &Path,
    (pages, is_known): (&Arc<Semaphore>, &AtomicBool),
    ended: watch::Receiver<bool>,
) {
    let Some(key) = key(&request) else { return };
    let accept = derive_accept_key(key.as_bytes());
    let switch = format!(
        "HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\
        Sec-WebSocket-Accept: {accept}\r\n\r\n"
    );
    if stream.write_all(switch.as_bytes()).await.is_err() {
        return;
    }
    let config = WebSocketConfig::default()
        .max_message_size(Some(MAX_MESSAGE))
        .max_frame_size(Some(MAX_MESSAGE))
        .read_buffer_size(READ_BUFFER);
    let mut page = WebSocketStream::from_partially_read(stream, request.rest, Role::Server, Some(config)).await;
    let token = timeout(TOKEN_TIMEOUT, page.next()).await;
    if !token.is_ok_and(|message| matches!(message, Some(Ok(Message::Text(text))) if has_token(access, &text))) {
        return close(&mut page, WRONG_TOKEN, "wrong token: `dimos view` prints the URL").await;
    }
    is_known.store(true, Ordering::Relaxed);
    let Ok(_page) = pages.try_acquire() else {
        return close(&mut page, TOO_MANY, "too many pages are open").await;
    };
    let Ok(run) = reach::open(run).and_then(UnixStream::from_std) else {
        return close(&mut page, NO_RUN, "the run is gone").await;
    };
    if page.send(Message::text(r#"{"ok":true}"#)).await.is_err() {
        return;
    }
    let ((mut to_page, mut from_page), (from_run, to_run)) = (page.split(), run.into_split());
    let why = tokio::select! {
        why = pass_requests(&mut from_page, to_run) => why,
        why = pass_lines(from_run, &mut to_page, ended) => why,
    };
    if let (Some((code, reason)), Ok(mut page)) = (why, to_page.reunite(from_page)) {
        close(&mut page, code, reason).await;
    }
}

fn has_token(access: &Access, text: &str) -> bool {
    let token = serde_json::from_str::<Value>(text).ok();
    token.as_ref().and_then(|token| token["token"].as_str()).is_some_and(|token| access.is_token(token))
}

/// Why a bridge ends, for its page; `None`: the page no longer takes anything.
type End = Option<(u16, &'static str)>;

/// Passes messages of the page on to the run.
async fn pass_requests(from: &mut SplitStream<Socket>, mut to: OwnedWriteHalf) -> End {
    loop {
        let mut line = match from.next().await {
            Some(Ok(Message::Text(text))) => text.as_str().to_owned(),
            Some(Ok(Message::Binary(_))) => return Some((UNSUPPORTED, "messages are text")),
            Some(Ok(_)) => continue,
            Some(Err(Error::Capacity(_))) => return Some((TOO_LARGE, "the message is larger than 64 kB")),
            Some(Err(_)) | None => return None,
        };
        // A line end within JSON is white space; on the socket it would end the request.
        if line.contains(['\n', '\r']) {
            line = line.replace(['\n', '\r'], " ");
        }
        line.push('\n');
        if to.write_all(line.as_bytes()).await.is_err() {
            return Some((GONE, "the run has ended"));
        }
    }
}

/// Passes lines of the run on to the page.
async fn pass_lines(from: OwnedReadHalf, to: &mut SplitSink<Socket, Message>, mut ended: watch::Receiver<bool>) -> End {
    let mut lines = BufReader::new(from).lines();
    loop {
        let line = tokio::select! {
            line = lines.next_line() => line,
            _ = ended.wait_for(|ended| *ended) => Ok(None),
        };
        let Ok(Some(line)) = line else { return Some((GONE, "the run has ended")) };
        match timeout(SEND_TIMEOUT, to.send(Message::text(line))).await {
            Ok(Ok(())) => {}
            Ok(Err(_)) | Err(_) => return None,
        }
    }
}

async fn close(page: &mut Socket, code: u16, reason: &'static str) {
    let frame = CloseFrame { code: CloseCode::from(code), reason: reason.into() };
    let _ = timeout(CLOSE_TIMEOUT, async {
        page.send(Message::Close(Some(frame))).await.ok()?;
        // Until the page answers: closing at once could discard what it has not read.
        while page.next().await?.is_ok() {}
        Some(())
    })
    .await;
}
