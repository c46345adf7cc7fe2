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
use tokio_tungstenite::tungstenite::{Error, Message};

use super::access::Access;
use super::socket::{
    self, End, GONE, NO_RUN, SEND_TIMEOUT, Socket, TOO_LARGE, TOO_MANY, UNSUPPORTED, WRONG_TOKEN, close,
};
use crate::http::Request;
use dimos_rpc::client::reach;

/// Time limit for the token.
const TOKEN_TIMEOUT: Duration = Duration::from_secs(5);

/// Serves a page until it or the run ends. `pages` counts those with the token; `is_known` is set for one of them.
pub async fn serve(
    stream: TcpStream,
    request: Request,
    access: &Access,
    run: &Path,
    (pages, is_known): (&Arc<Semaphore>, &AtomicBool),
    ended: watch::Receiver<bool>,
) {
    let Some(mut page) = socket::open(stream, request, None).await else { return };
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
