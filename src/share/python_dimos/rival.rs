//! Another coordinator on the bus: both would execute every trajectory.

use std::sync::mpsc::channel;
use std::time::{Duration, Instant};

use zenoh::query::{ConsolidationMode, QueryTarget};
use zenoh::sample::Locality;
use zenoh::{Session, Wait};

use super::pickle_reader::read;
use super::pickle_writer::{Value, write};

/// Time that a coordinator has to answer.
pub const ANSWER_TIMEOUT: Duration = Duration::from_millis(300);
/// Pause before it is asked again, if there was no answer: programs may not have found each other yet.
const AGAIN: Duration = Duration::from_millis(50);
/// Largest number of arms that are named.
const MAX_NAMED: usize = 8;

/// Returns the arms of another coordinator with this name, in words; `None` if no other one answers in time.
pub fn find(session: &Session, name: &str) -> Option<String> {
    let deadline = Instant::now() + ANSWER_TIMEOUT;
    let nothing = Value::Tuple(vec![Value::Tuple(Vec::new()), Value::Dict(Vec::new())]);
    let payload = write(&nothing);
    loop {
        let left = deadline.saturating_duration_since(Instant::now());
        if left.is_zero() {
            return None;
        }
        let (found, answers) = channel();
        let asked = session.get(format!("dimos/rpc/{name}/list_hardware"));
        let asked = asked.payload(payload.clone()).timeout(left).target(QueryTarget::All);
        // This session's own coordinator is not another one.
        let asked = asked.allowed_destination(Locality::Remote).consolidation(ConsolidationMode::None);
        let sent = asked.callback(move |reply| {
            // A timeout is reported as an error without a replier.
            let arms = match reply.result() {
                Ok(sample) => Some(arms(&sample.payload().to_bytes())),
                Err(error) => error.encoding().to_string().starts_with("dimos/").then(String::new),
            };
            if let Some(arms) = arms {
                let _ = found.send(arms);
            }
        });
        if sent.wait().is_err() {
            return None;
        }
        // Ends at once where none can answer.
        if let Ok(arms) = answers.recv_timeout(left) {
            return Some(arms);
        }
        std::thread::sleep(AGAIN.min(deadline.saturating_duration_since(Instant::now())));
    }
}

/// Returns the names in a pickled list: ` with the arms left, right`.
fn arms(payload: &[u8]) -> String {
    let Ok(pickled) = read(payload) else { return String::new() };
    let items = pickled.items(pickled.root(), "the reply").unwrap_or_default();
    let names: Vec<String> = items
        .iter()
        .take(MAX_NAMED)
        .filter_map(|item| pickled.text(*item, "an arm").ok())
        .map(|name| name.chars().filter(|c| !c.is_control()).take(40).collect())
        .collect();
    if names.is_empty() { String::new() } else { format!(" with {}", names.join(", ")) }
}
