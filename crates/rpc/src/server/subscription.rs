//! A client's subscription: passes messages from the ring of a stream to the queue of the connection, at the requested
//! rate.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{broadcast, mpsc};
use tokio::time::Instant;

use crate::wire;

/// A client's subscription to a stream.
pub(crate) struct Subscription {
    /// Its number on the connection.
    pub number: u64,
    /// The stream's name.
    pub stream: &'static str,
    /// Messages that were published before, the oldest first.
    pub past: Vec<Arc<str>>,
    /// Receives the published messages.
    pub from: broadcast::Receiver<Arc<str>>,
    /// Limits the rate.
    pub limit: RateLimit,
}

impl Subscription {
    /// Sends the past, then published messages until the client has disconnected.
    pub async fn forward(mut self, queue: mpsc::Sender<String>) {
        for data in std::mem::take(&mut self.past) {
            if queue.send(wire::past_message(self.stream, self.number, &data)).await.is_err() {
                return;
            }
        }
        let mut lost = 0;
        loop {
            match self.from.recv().await {
                Ok(data) if self.limit.is_due(Instant::now()) => {
                    let line = wire::message(self.stream, self.number, lost, &data);
                    if queue.send(line).await.is_err() {
                        return;
                    }
                    lost = 0;
                }
                Ok(_) => {}
                Err(broadcast::error::RecvError::Lagged(missed)) => lost += missed,
                Err(broadcast::error::RecvError::Closed) => return,
            }
        }
    }
}

/// Reduces a stream to a maximum rate.
pub(crate) struct RateLimit {
    period: Option<Duration>,
    next: Option<Instant>,
}

impl RateLimit {
    /// Creates a limit of `rate` messages per second [Hz]; without it, all pass.
    pub fn new(rate: Option<f64>) -> Self {
        Self { period: rate.map(|hz| Duration::from_secs_f64(1.0 / hz)), next: None }
    }

    /// Returns whether to send a message published now. Up to a quarter of a period early counts as on time, so that a
    /// stream requested at its own rate loses nothing to jitter.
    fn is_due(&mut self, now: Instant) -> bool {
        let Some(period) = self.period else { return true };
        let next = self.next.unwrap_or(now);
        if now + period / 4 < next {
            return false;
        }
        let following = next + period;
        self.next = Some(if following < now { now + period } else { following });
        true
    }
}
