//! Keeps the text log readable: events that repeat at the rate of the tick are logged every ten seconds, with a count.

use std::collections::HashMap;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use dimos_core::sync::lock;
use dimos_core::telemetry::describe::Described;

/// Shortest interval between lines of one kind.
const EVERY: Duration = Duration::from_secs(10);

/// Time of the last line of each kind, and how many were suppressed since.
#[derive(Debug, Default)]
pub struct LogThrottle(Mutex<HashMap<Kind, (Instant, u64)>>);

/// Kind and status of a line.
type Kind = (&'static str, &'static str);

impl LogThrottle {
    /// Returns the line to log now, if any. Events of arms and tasks are always logged: they occur once per episode.
    pub fn line(&self, described: &Described, now: Instant) -> Option<String> {
        if matches!(described.kind, "arm" | "task") {
            return Some(described.line());
        }
        let mut all = lock(&self.0);
        let entry = all.entry((described.kind, described.status));
        let known = entry.or_insert_with(|| (now.checked_sub(EVERY).unwrap_or(now), 0));
        if now.duration_since(known.0) < EVERY {
            known.1 += 1;
            return None;
        }
        let withheld = std::mem::replace(known, (now, 0)).1;
        Some(match withheld {
            0 => described.line(),
            n => format!("{} (and {n} more like it before)", described.line()),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_core::telemetry::describe::{Names, describe};
    use dimos_core::telemetry::{Cause, Event, Phase};

    #[test]
    fn repeated_events_are_logged_every_ten_seconds_with_a_count() {
        let names = Names::default();
        let (throttle, start) = (LogThrottle::default(), Instant::now());
        let overrun = describe(&Event::Overrun(2, 20_000_000), &names);
        let lines: Vec<String> =
            (0..250).filter_map(|tick| throttle.line(&overrun, start + Duration::from_millis(100 * tick))).collect();
        let text = "overrun: 2 periods skipped, 20.000 ms late";
        let more = format!("{text} (and 99 more like it before)");
        assert_eq!(lines, [text, &more, &more]);
        let held = describe(&Event::Arm(0, Phase::Held, Cause::Operator), &names);
        assert!((0..9).all(|_| throttle.line(&held, start).is_some()));
    }
}
