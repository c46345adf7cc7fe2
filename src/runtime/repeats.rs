//! Keeps the text log readable: events that repeat at the rate of the tick are logged every ten seconds, with a count.

use std::collections::HashMap;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use crate::sync::lock;
use crate::telemetry::describe::Described;

/// Shortest interval between lines of one kind.
const EVERY: Duration = Duration::from_secs(10);

/// Time of the last line of each kind, and how many were suppressed since.
#[derive(Debug, Default)]
pub struct Repeats(Mutex<HashMap<Kind, (Instant, u64)>>);

/// Kind and status of a line.
type Kind = (&'static str, &'static str);

impl Repeats {
    /// Returns the line to log now, if any. Events of arms and tasks are always logged: they occur once an episode.
    pub fn line(&self, told: &Described, now: Instant) -> Option<String> {
        if matches!(told.kind, "arm" | "task") {
            return Some(told.text.clone());
        }
        let mut all = lock(&self.0);
        let entry = all.entry((told.kind, told.status));
        let known = entry.or_insert_with(|| (now.checked_sub(EVERY).unwrap_or(now), 0));
        if now.duration_since(known.0) < EVERY {
            known.1 += 1;
            return None;
        }
        let withheld = std::mem::replace(known, (now, 0)).1;
        Some(match withheld {
            0 => told.text.clone(),
            n => format!("{} (and {n} more like it before)", told.text),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::telemetry::describe::{Names, describe};
    use crate::telemetry::{Cause, Event, Phase};

    #[test]
    fn what_repeats_itself_is_told_now_and_then_with_a_count() {
        let names = Names::default();
        let (repeats, start) = (Repeats::default(), Instant::now());
        let overrun = describe(&Event::Overrun(2, 20_000_000), &names);
        let lines: Vec<String> =
            (0..250).filter_map(|tick| repeats.line(&overrun, start + Duration::from_millis(100 * tick))).collect();
        let text = "overrun: 2 periods skipped, 20.000 ms late";
        let more = format!("{text} (and 99 more like it before)");
        assert_eq!(lines, [text, &more, &more]);
        let held = describe(&Event::Arm(0, Phase::Held, Cause::Operator), &names);
        assert!((0..9).all(|_| repeats.line(&held, start).is_some()));
    }
}
