//! How the run of a gateway has ended.

use std::io::BufRead;
use std::path::Path;
use std::time::{Duration, Instant};

use serde_json::Value;

use dimos_rpc::client::reach;
use dimos_rpc::error::Code;

/// Maximum time for a run to release its name after its connections, and the period of the look at that.
const RELEASED_TIMEOUT: Duration = Duration::from_secs(10);
const PERIOD: Duration = Duration::from_millis(5);

/// Reads what the run says until its end. Returns whether it has ended in order: then it has said so, and its name is
/// free. A run that was killed says nothing.
pub(super) fn is_in_order(replies: &mut impl BufRead, socket: &Path) -> bool {
    let mut in_order = false;
    for line in replies.lines().map_while(Result::ok) {
        let reply: Value = serde_json::from_str(&line).unwrap_or_default();
        in_order |= reply["error"]["code"] == Code::ShuttingDown.name();
    }
    let began = Instant::now();
    while in_order && reach::is_there(socket) && began.elapsed() < RELEASED_TIMEOUT {
        std::thread::sleep(PERIOD);
    }
    in_order
}
