//! A client's subscription: from the ring of a stream to the queue of its connection, at the client's pace.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{broadcast, mpsc};
use tokio::time::Instant;

use super::wire;

/// A client's reading of a stream.
pub(super) struct Subscription {
    /// Its number on the connection.
    pub number: u64,
    /// The stream's name.
    pub stream: &'static str,
    /// Where its messages come from.
    pub from: broadcast::Receiver<Arc<str>>,
    /// Which of them are sent.
    pub pace: Pace,
}

impl Subscription {
    /// Sends what is published until the client is gone.
    pub async fn forward(mut self, queue: mpsc::Sender<String>) {
        let mut lost = 0;
        loop {
            match self.from.recv().await {
                Ok(data) if self.pace.is_due(Instant::now()) => {
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

/// Thins a stream out to a rate.
pub(super) struct Pace {
    period: Option<Duration>,
    next: Option<Instant>,
}

impl Pace {
    /// At most `rate` messages per second [Hz]; without it, all.
    pub fn of(rate: Option<f64>) -> Self {
        Self { period: rate.map(|hz| Duration::from_secs_f64(1.0 / hz)), next: None }
    }

    /// Whether a message that came now is to be sent. A quarter of a period early counts as on time, so that asking
    /// for a stream at its own rate loses nothing to jitter.
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
