//! What the arm does when setpoints are missing: for some milliseconds, for good, and when the connection is cut.

use std::time::Duration;

use super::drive::Log;
use super::{End, Tour, ways};
use dimos_core::arm::AfterGap;
use dimos_core::clock::{Clock, Mono, MonotonicClock};

/// Omissions [ms].
const OMITTED: [u64; 5] = [1, 3, 6, 12, 25];
/// Parts of the top speed at which setpoints end for good.
const SPEEDS: [f64; 3] = [0.05, 0.1, 0.2];
/// How often at each: the steps of an encoder are as large as what is measured at the lowest speed.
const REPEATED: usize = 5;
/// How long the joint moves evenly before [s].
const EVEN: f64 = 0.35;
/// An arm that continues for less than this many periods rests at its last setpoint.
const RESTS: f64 = 0.35;
/// Silence of an arm whose controller is the clock, and of others.
const SILENCE: Duration = Duration::from_millis(80);
const LONG_SILENCE: Duration = Duration::from_millis(400);
/// Steps of the search for the longest silence without an error.
const BISECTIONS: u32 = 5;
/// Shortest time over which a speed is taken [s], and readings of the even motion before a gap.
const LOOK: f64 = 0.025;
const EVEN_READINGS: usize = 30;
/// Part of the speed that readings of an even motion must show throughout.
const EVEN_SPEED: f64 = 0.8;
/// How long the arm may refuse a new connection after one was cut.
const CONNECT: Duration = Duration::from_secs(5);

/// An arm's error: code and text.
type ArmError = (i32, String);

/// Returns the time in which a late reading does not matter, nor that an evenly moving arm reports in stairs [s].
fn look(even: &[(Mono, f64)]) -> f64 {
    let (mut longest, mut since) = (0.0_f64, even.first());
    for now in even {
        if let Some((then, _)) = since.filter(|(_, was)| *was != now.1) {
            longest = longest.max(now.0.seconds_since(*then));
            since = Some(now);
        }
    }
    LOOK.max(2.0 * longest)
}

/// Returns the lowest speed in a direction over at least this time [rad/s].
fn lowest(seen: &[(Mono, f64)], direction: f64, look: f64) -> f64 {
    let mut lowest = f64::INFINITY;
    for (i, (at, value)) in seen.iter().enumerate() {
        if let Some((then, was)) = seen.iter().take(i).rev().find(|(then, _)| at.seconds_since(*then) >= look) {
            lowest = lowest.min((value - was) * direction / at.seconds_since(*then));
        }
    }
    lowest
}

impl Tour<'_> {
    /// Leaves out setpoints in motion.
    pub(super) fn gaps(&mut self) -> Result<String, End> {
        self.prepare()?;
        self.go(0.0)?;
        let mut faults = None;
        for ms in OMITTED {
            self.person.tell(&format!("setpoints left out for {ms} ms"));
            match self.omit(Duration::from_millis(ms))? {
                (Some(kept), None) => {
                    self.figure(format!("speed kept through {ms} ms without setpoints"), 100.0 * kept, "%", None);
                }
                (None, None) => self.person.tell("its readings are too coarse to show a dip of its speed"),
                (_, Some((code, text))) => {
                    self.person.tell(&format!("error {code}: {text}"));
                    faults = Some(ms);
                    break;
                }
            }
        }
        if let Some(first) = faults {
            return self.faulting(first);
        }
        let (mut overshoots, mut error) = (Vec::new(), None);
        for part in SPEEDS {
            self.person.tell(&format!("no more setpoints, from {:.0} % of the top speed", 100.0 * part));
            let mut repeats = Vec::new();
            while repeats.len() < REPEATED && error.is_none() {
                let (speed, overshoot, found) = self.silence(part)?;
                repeats.push((speed, overshoot));
                error = found;
            }
            // Without the extremes: a stall of this computer at the end of a motion spoils no figure.
            repeats.sort_by(|(v, way), (w, other)| (way / v).total_cmp(&(other / w)));
            let middle = repeats.get(1..repeats.len().saturating_sub(1)).filter(|middle| !middle.is_empty());
            let seen = middle.unwrap_or(&repeats);
            let mean = |of: fn(&(f64, f64)) -> f64| seen.iter().map(of).sum::<f64>() / seen.len() as f64;
            let (speed, overshoot) = (mean(|(speed, _)| *speed), mean(|(_, way)| *way));
            overshoots.push((speed, overshoot));
            let name = format!("motion past the last setpoint from {speed:.2} rad/s");
            self.figure(name, overshoot.to_degrees(), "°", None);
        }
        let Some((bridged, slope)) = ways(&overshoots) else {
            return Err(End::Failed("the speeds were not different".to_owned()));
        };
        let period = self.period().as_secs_f64();
        let most = overshoots.iter().map(|(_, overshoot)| *overshoot).fold(0.0, f64::max);
        let after = match error {
            Some(_) => AfterGap::Faults,
            None if bridged < RESTS * period && most < RESTS * period * self.top() * 0.2 => AfterGap::RestsAtSetpoint,
            None => AfterGap::Decelerates,
        };
        let bridged = if after == AfterGap::RestsAtSetpoint { 0.0 } else { bridged.max(0.0) };
        self.gap_figure(bridged, after);
        if after == AfterGap::Decelerates && slope > 1e-4 {
            self.figure("deceleration after a gap", 0.5 / slope, "rad/s²", None);
        }
        Ok(match after {
            AfterGap::RestsAtSetpoint => "without setpoints it goes to the last one and rests there".to_owned(),
            AfterGap::Decelerates => format!(
                "without setpoints it continues for {:.1} ms, and then decelerates along the motion",
                1e3 * bridged
            ),
            AfterGap::Faults => {
                let (code, text) = error.unwrap_or_default();
                format!("without setpoints it reports error {code}: {text}")
            }
        })
    }

    fn gap_figure(&mut self, bridged: f64, after: AfterGap) {
        let line = format!(
            "row: gap_tolerance: Duration::from_micros({:.0}), after_gap: {} (now {} ms, {})",
            1e6 * bridged,
            after.name(),
            self.row.gap_tolerance.as_millis(),
            self.row.after_gap.name(),
        );
        self.figure("gap tolerance", 1e3 * bridged, "ms", Some(line));
    }

    /// Leaves out setpoints for this time, at a tenth of the top speed. Returns the lowest speed that was seen, as a
    /// part of it, and the arm's error. `None`: the readings of an even motion vary as much.
    fn omit(&mut self, gap: Duration) -> Result<(Option<f64>, Option<ArmError>), End> {
        let speed = 0.1 * self.top();
        let mut log = self.cruise(speed, EVEN)?;
        let before = log.seen.len();
        self.quiet(&mut log, gap)?;
        if let Some(error) = self.error()? {
            self.recover()?;
            return Ok((None, Some(error)));
        }
        // As of a client that was late: its path continued.
        let missed = log.written.last().map_or(0.0, |(at, _)| MonotonicClock.now().seconds_since(*at)).min(0.1);
        let (from, direction) = (self.offset, self.direction);
        let result = self.stream(&mut log, |t| (t <= 0.2).then_some(from + direction * speed * (missed + t)));
        if let Some(error) = self.error()? {
            self.recover()?;
            return Ok((None, Some(error)));
        }
        result?;
        // Compared with the lowest speed of an even motion: positions come in steps, and not evenly.
        let (even, later) = log.seen.split_at(before.saturating_sub(1));
        let even = even.get(even.len().saturating_sub(EVEN_READINGS)..).unwrap_or_default();
        let look = look(even);
        let usual = Some(lowest(even, direction, look)).filter(|usual| *usual > EVEN_SPEED * speed);
        let kept = usual.map(|usual| (lowest(later, direction, look) / usual).clamp(0.0, 1.0));
        self.brake(speed)?;
        self.go(0.0)?;
        Ok((kept, None))
    }

    /// Writes nothing for a time. The states are read meanwhile, unless reading answers them.
    fn quiet(&mut self, log: &mut Log, time: Duration) -> Result<(), End> {
        if self.clocked() {
            std::thread::sleep(time);
            return self.check_interrupted();
        }
        let end = MonotonicClock.now().after(self.period() + time);
        while MonotonicClock.now() < end {
            let (seen, stamp) = self.at()?;
            if log.seen.last().is_none_or(|(before, _)| *before < stamp) {
                log.seen.push((stamp, seen));
            }
            let left = end.since(MonotonicClock.now());
            self.wait(left.min(Duration::from_millis(2)))?;
        }
        Ok(())
    }

    /// Ends setpoints at a part of the top speed. Returns the speed [rad/s], how far the arm went past the last
    /// setpoint [rad], and its error.
    fn silence(&mut self, part: f64) -> Result<(f64, f64, Option<ArmError>), End> {
        let droop = self.droop;
        let mut log = self.cruise(part * self.top(), EVEN)?;
        let (speed, last) = (log.pace(EVEN / 2.0).abs(), self.offset);
        self.quiet(&mut log, if self.clocked() { SILENCE } else { LONG_SILENCE })?;
        let error = self.error()?;
        self.still()?;
        let overshoot = (self.at()?.0 - droop - last) * self.direction;
        if error.is_none() {
            // It is where it is now; the way back begins there.
            self.offset = self.at()?.0;
            match self.go(0.0) {
                // A program on the controller may have ended without orders.
                Err(End::Failed(_)) => self.recover()?,
                result => result?,
            }
        } else {
            self.recover()?;
        }
        Ok((speed, overshoot, error))
    }

    /// Finds the longest silence without an error, below `first` [ms].
    fn faulting(&mut self, first: u64) -> Result<String, End> {
        let below = OMITTED.iter().take_while(|ms| **ms < first).last().copied().unwrap_or_default();
        let (mut good, mut bad) = (below as f64, first as f64);
        for _ in 0..BISECTIONS {
            let middle = 0.5 * (good + bad);
            self.person.tell(&format!("setpoints left out for {middle:.1} ms"));
            match self.omit(Duration::from_secs_f64(middle / 1e3))?.1 {
                Some(_) => bad = middle,
                None => good = middle,
            }
        }
        self.gap_figure(0.5e-3 * (good + bad), AfterGap::Faults);
        Ok(format!("it bridges {good:.1} ms without setpoints, and reports an error after {bad:.1} ms"))
    }

    /// Returns the arm's error, if it has one.
    pub(super) fn error(&mut self) -> Result<Option<ArmError>, End> {
        // The newest state may be old after a silence.
        self.read().map(drop).or_else(|end| if self.adapter.is_connected() { Ok(()) } else { Err(end) })?;
        self.wait(Duration::from_millis(4))?;
        let _ = self.read();
        Ok(Some(self.adapter.read_error()?).filter(|(code, _)| *code != 0))
    }

    /// Cuts the connection in motion.
    pub(super) fn killed(&mut self) -> Result<String, End> {
        self.prepare()?;
        self.go(0.0)?;
        let droop = self.droop;
        let log = self.cruise(0.1 * self.top(), EVEN)?;
        let (speed, last) = (log.pace(EVEN / 2.0).abs(), self.offset);
        self.adapter.discard_pending();
        self.adapter.disconnect();
        self.ready = false;
        let cut = MonotonicClock.now();
        std::thread::sleep(Duration::from_millis(500));
        let until = MonotonicClock.now().after(CONNECT);
        while let Err(error) = self.adapter.connect() {
            if MonotonicClock.now() > until {
                return Err(error.into());
            }
            self.check_interrupted()?;
            std::thread::sleep(Duration::from_millis(100));
        }
        let back = MonotonicClock.now().seconds_since(cut) - 0.5;
        self.still()?;
        let overshoot = (self.at()?.0 - droop - last) * self.direction;
        let (code, text) = self.adapter.read_error()?;
        let on = self.adapter.read_enabled()?;
        self.figure("motion past the last setpoint when the client dies", overshoot.to_degrees(), "°", None);
        self.figure("speed at that time", speed.to_degrees(), "°/s", None);
        self.figure("connecting again", 1e3 * back, "ms", None);
        self.recover()?;
        let motors = if on { "its motors stay on" } else { "its motors go off" };
        let error = if code == 0 { "no error".to_owned() } else { format!("error {code}: {text}") };
        Ok(format!("when the client dies in motion, {motors}; {error}"))
    }
}
