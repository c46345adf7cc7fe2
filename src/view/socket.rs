//! The server's end of a WebSocket: how one is opened and closed.

use std::time::Duration;

use futures_util::{SinkExt, StreamExt};
use tokio::io::AsyncWriteExt;
use tokio::net::TcpStream;
use tokio::time::timeout;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::handshake::derive_accept_key;
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;
use tokio_tungstenite::tungstenite::protocol::{CloseFrame, Role, WebSocketConfig};

use crate::http::Request;

/// Maximum length of a message of the client [bytes].
const MAX_MESSAGE: usize = 64 << 10;
/// Bytes read from the client at once.
const READ_BUFFER: usize = 16 << 10;
/// Time limit for the client to take a message.
pub const SEND_TIMEOUT: Duration = Duration::from_secs(5);
/// Time limit for the client to take the reason of the end.
const CLOSE_TIMEOUT: Duration = Duration::from_millis(500);

/// Why the server closes the connection to a client, as codes of WebSocket; those from 4000 on are the program's own.
pub const GONE: u16 = 1001;
pub const UNSUPPORTED: u16 = 1003;
pub const TOO_LARGE: u16 = 1009;
pub const NO_RUN: u16 = 1011;
pub const WRONG_TOKEN: u16 = 4401;
pub const TOO_MANY: u16 = 4429;

pub type Socket = WebSocketStream<TcpStream>;

/// Why a connection ends, for its client; `None`: the client no longer takes anything.
pub type End = Option<(u16, &'static str)>;

/// Returns the key of a request for a WebSocket; `None` if it is none.
pub fn key(request: &Request) -> Option<&str> {
    let upgrades = request.has_word("upgrade", "websocket") && request.has_word("connection", "upgrade");
    request.header("sec-websocket-key").filter(|_| upgrades && request.header("sec-websocket-version") == Some("13"))
}

/// Opens the WebSocket that was asked for, with this subprotocol if there is one.
pub async fn open(mut stream: TcpStream, request: Request, protocol: Option<&str>) -> Option<Socket> {
    let accept = derive_accept_key(key(&request)?.as_bytes());
    let protocol = protocol.map(|name| format!("Sec-WebSocket-Protocol: {name}\r\n")).unwrap_or_default();
    let switch = format!(
        "HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\
        Sec-WebSocket-Accept: {accept}\r\n{protocol}\r\n"
    );
    stream.write_all(switch.as_bytes()).await.ok()?;
    let config = WebSocketConfig::default()
        .max_message_size(Some(MAX_MESSAGE))
        .max_frame_size(Some(MAX_MESSAGE))
        .read_buffer_size(READ_BUFFER);
    Some(WebSocketStream::from_partially_read(stream, request.rest, Role::Server, Some(config)).await)
}

/// Closes a WebSocket with a reason.
pub async fn close(socket: &mut Socket, code: u16, reason: &'static str) {
    let frame = CloseFrame { code: CloseCode::from(code), reason: reason.into() };
    let _ = timeout(CLOSE_TIMEOUT, async {
        socket.send(Message::Close(Some(frame))).await.ok()?;
        // Until the client answers: closing at once could discard what it has not read.
        while socket.next().await?.is_ok() {}
        Some(())
    })
    .await;
}
