//! Foxglove's WebSocket (`foxglove.sdk.v1`, `foxglove.websocket.v1`): what a log has for 3D viewers and panels, live.
//! To read only: what a client wants to publish, set or call is refused with a status message.
//!
//! ```text
//!  Foxglove ── subscribe, fetchAsset ─▶ session ── subscribe, transforms, world … ─▶ the run's socket
//!           ◀─ messages (CDR) ────────┘        ◀── lines of JSON ─────────────────┘
//! ```
//!
//! Each client is one more client of the run's socket. Nothing is queued here: while a client is slow to take a
//! message, no line of the run is read; the run drops the oldest messages of a stream and counts them, and the client
//! gets their number.

mod assets;
mod protocol;
mod session;
mod topics;

pub use assets::Asset;
pub use protocol::subprotocol;
pub use session::{Shared, serve};

use super::access::reading_token;

/// Path of the WebSocket.
pub const PATH: &str = "/foxglove";

/// Returns the URL for Foxglove of the run whose page has this URL. Its token only allows to read.
pub fn foxglove_url(page: &str) -> Option<String> {
    let (address, token) = page.strip_prefix("http://")?.split_once("/#")?;
    Some(format!("ws://{address}{PATH}?token={}", reading_token(token)))
}
