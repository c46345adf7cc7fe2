//! Outcome of a gripper command, judged from what was measured after it: where the fingers stopped, whether the device
//! itself reports an object, the force. Never from the command alone.

use std::time::Duration;

use dimos_core::arm::{GripperInfo, GripperUnit};
use dimos_core::clock::Mono;
use dimos_rpc::api::GripOutcome;

/// Time for the fingers to begin to move, and for the device to report an object.
const STARTS: Duration = Duration::from_secs(1);
/// Time without motion after which fingers that have moved are at rest.
const SETTLES: Duration = Duration::from_millis(300);
/// Part of the range within which two positions are the same; a quarter of it is motion.
const SAME: f64 = 0.01;
/// The same where the range is unknown [m, rad].
const SAME_METERS: f64 = 0.001;
const SAME_RADIANS: f64 = 0.02;
/// Part of the commanded force, and of the largest one where none was commanded, below which fingers press on nothing.
const LEAST_PART: f64 = 0.1;
const LEAST_PART_OF_RANGE: f64 = 0.01;

/// A measurement of a gripper.
#[derive(Debug, Clone, Copy)]
pub struct Reading {
    /// Position [m or rad].
    pub position: f64,
    /// Force, if the gripper measures one.
    pub force: Option<f64>,
    /// Whether the device itself reports an object in its grip, if it can tell.
    pub holds: Option<bool>,
}

/// Judges one command.
#[derive(Debug, Clone)]
pub struct GripJudge {
    info: GripperInfo,
    target: f64,
    force: Option<f64>,
    closing: bool,
    begin: Mono,
    /// Where the fingers were when they last moved, and when.
    last: f64,
    since: Mono,
    has_moved: bool,
}

impl GripJudge {
    /// Creates the judge of a command to `target` [m or rad] with a largest force, given at `now` with the fingers at
    /// `from`.
    pub fn new(info: GripperInfo, target: f64, force: Option<f64>, from: f64, now: Mono) -> Self {
        let (closed, open) = info.range.unwrap_or((0.0, 1.0));
        let closing = (target - from) * (open - closed) < 0.0;
        Self { info, target, force, closing, begin: now, last: from, since: now, has_moved: false }
    }

    /// Returns whether nothing measures the fingers.
    pub fn is_unmeasured(&self) -> bool {
        self.info.unit == GripperUnit::OnOff
    }

    /// Takes a measurement. Returns the outcome once the fingers are at rest.
    pub fn observe(&mut self, reading: &Reading, now: Mono) -> Option<GripOutcome> {
        if (reading.position - self.last).abs() > self.same() / 4.0 {
            (self.last, self.since, self.has_moved) = (reading.position, now, true);
        }
        // A device reports an object somewhat later than its fingers stop.
        let doubtful = self.closing && reading.holds == Some(false);
        // Where nothing measures the fingers, to be there means only that the order was confirmed.
        let there = self.is_at(reading, self.target) && !(doubtful && self.is_unmeasured());
        let settles = if there || (self.has_moved && !doubtful) { SETTLES } else { STARTS };
        (now.since(self.since) >= settles).then(|| self.outcome(reading))
    }

    /// Notes that the measurements are too old to tell whether the fingers move.
    pub fn miss(&mut self, now: Mono) {
        self.since = now;
    }

    /// Returns the time from the command to the last motion of the fingers.
    pub fn elapsed(&self) -> Duration {
        self.since.since(self.begin)
    }

    fn outcome(&self, reading: &Reading) -> GripOutcome {
        let (closed, open) = self.info.range.unwrap_or((0.0, f64::INFINITY));
        let arrived = self.is_at(reading, self.target);
        match reading.holds {
            Some(true) if self.closing => GripOutcome::Holding,
            None if arrived && self.is_unmeasured() => GripOutcome::Ordered,
            _ if arrived && (self.target - closed).abs() <= self.same() => GripOutcome::Closed,
            _ if arrived && (self.target - open).abs() <= self.same() => GripOutcome::Open,
            _ if arrived => GripOutcome::Reached,
            None if self.closing && self.presses(reading) => GripOutcome::Holding,
            _ => GripOutcome::Blocked,
        }
    }

    /// Returns whether fingers that stopped early press on something, as far as the gripper measures that.
    fn presses(&self, reading: &Reading) -> bool {
        let most = self.info.force_range.map(|(_, most)| LEAST_PART_OF_RANGE * most);
        let least = self.force.map(|force| LEAST_PART * force).or(most);
        reading.force.zip(least).is_none_or(|(force, least)| force.abs() >= least)
    }

    fn is_at(&self, reading: &Reading, position: f64) -> bool {
        (reading.position - position).abs() <= self.same()
    }

    /// Returns the difference of positions that counts as none [m or rad].
    fn same(&self) -> f64 {
        match (self.info.range, self.info.unit) {
            (Some((closed, open)), _) => SAME * (open - closed).abs(),
            (None, GripperUnit::Meters) => SAME_METERS,
            (None, GripperUnit::Radians) => SAME_RADIANS,
            (None, GripperUnit::OnOff) => SAME,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD: u64 = 10;

    fn info() -> GripperInfo {
        GripperInfo { range: Some((0.0, 0.08)), ..GripperInfo::default() }
    }

    /// Plays fingers that take 0.8 s for their range and stop at `stop`. Returns the outcome and the time of the last
    /// motion [s].
    fn play(
        info: GripperInfo,
        from: f64,
        target: f64,
        stop: f64,
        end: (Option<f64>, Option<bool>),
    ) -> (GripOutcome, f64) {
        let mut judge = GripJudge::new(info, target, Some(10.0), from, Mono(0));
        let (mut position, step) = (from, info.range.map_or(0.0, |(a, b)| (a - b).abs() / 80.0));
        for tick in 1..500 {
            let now = Mono(tick * PERIOD * 1_000_000);
            position += (stop - position).clamp(-step, step);
            // Noise of a count.
            let noise = if tick % 2 == 0 { 1e-4 } else { 0.0 };
            let reading = Reading { position: position + noise, force: end.0, holds: end.1 };
            if let Some(outcome) = judge.observe(&reading, now) {
                return (outcome, judge.elapsed().as_secs_f64());
            }
        }
        panic!("never at rest");
    }

    #[test]
    fn positions_alone_tell_what_became_of_a_command() {
        for (from, target, stop, expected, elapsed) in [
            (0.04, 0.08, 0.08, GripOutcome::Open, 0.4),
            (0.04, 0.0, 0.0, GripOutcome::Closed, 0.4),
            (0.04, 0.02, 0.02, GripOutcome::Reached, 0.2),
            (0.08, 0.0, 0.03, GripOutcome::Holding, 0.5),
            (0.03, 0.0, 0.03, GripOutcome::Holding, 0.0),
            (0.02, 0.08, 0.05, GripOutcome::Blocked, 0.3),
            (0.02, 0.08, 0.02, GripOutcome::Blocked, 0.0),
            (0.08, 0.08, 0.08, GripOutcome::Open, 0.0),
        ] {
            let (outcome, after) = play(info(), from, target, stop, (None, None));
            assert_eq!(outcome, expected, "{from} to {target}, stopped at {stop}");
            assert!((after - elapsed).abs() < 0.03, "{expected:?} after {after} s");
        }
        // A rotary jaw may be closed at the larger angle.
        let rotary = GripperInfo { range: Some((1.2, 0.0)), unit: GripperUnit::Radians, ..info() };
        assert_eq!(play(rotary, 0.2, 1.2, 0.5, (None, None)).0, GripOutcome::Holding);
        assert_eq!(play(rotary, 1.2, 0.0, 0.5, (None, None)).0, GripOutcome::Blocked);
    }

    #[test]
    fn the_devices_own_report_and_the_force_decide_whether_something_is_held() {
        let closing = |stop, force, holds| play(info(), 0.08, 0.0, stop, (force, holds)).0;
        assert_eq!(closing(0.0, None, Some(true)), GripOutcome::Holding, "a sheet of paper");
        assert_eq!(closing(0.03, None, Some(false)), GripOutcome::Blocked);
        assert_eq!(closing(0.03, Some(9.0), None), GripOutcome::Holding);
        assert_eq!(closing(0.03, Some(0.2), None), GripOutcome::Blocked, "stopped, but presses on nothing");
        assert_eq!(closing(0.03, Some(0.2), Some(true)), GripOutcome::Holding);
        assert_eq!(play(info(), 0.03, 0.08, 0.05, (None, Some(true))).0, GripOutcome::Blocked, "it opens");
    }

    #[test]
    fn where_nothing_measures_the_fingers_an_order_is_no_grip() {
        let on_off = GripperInfo { unit: GripperUnit::OnOff, range: Some((0.0, 1.0)), ..info() };
        let after = |target, holds: fn(u64) -> Option<bool>| {
            let mut judge = GripJudge::new(on_off, target, None, 1.0 - target, Mono(0));
            (1..200).find_map(|tick| {
                let reading = Reading { position: target, force: None, holds: holds(tick * 10) };
                judge.observe(&reading, Mono(tick * 10_000_000)).map(|outcome| (outcome, tick * 10))
            })
        };
        assert_eq!(after(0.0, |_| None), Some((GripOutcome::Ordered, 310)));
        assert_eq!(after(1.0, |_| None), Some((GripOutcome::Ordered, 310)));
        assert_eq!(after(0.0, |ms| Some(ms > 700)), Some((GripOutcome::Holding, 710)), "suction takes its time");
        assert_eq!(after(0.0, |_| Some(false)), Some((GripOutcome::Closed, 1010)));
        assert_eq!(after(1.0, |_| Some(false)), Some((GripOutcome::Open, 310)));
    }

    #[test]
    fn a_late_report_of_the_device_is_waited_for() {
        let mut judge = GripJudge::new(info(), 0.0, None, 0.031, Mono(0));
        let mut at = |ms: u64, position, holds| {
            judge.observe(&Reading { position, force: None, holds: Some(holds) }, Mono(ms * 1_000_000))
        };
        assert_eq!((at(10, 0.03, false), at(900, 0.03, false)), (None, None));
        assert_eq!(at(950, 0.03, true), Some(GripOutcome::Holding));
    }

    #[test]
    fn fingers_whose_position_is_not_measured_are_not_at_rest() {
        let mut judge = GripJudge::new(info(), 0.0, None, 0.08, Mono(0));
        let reading = Reading { position: 0.05, force: None, holds: None };
        let at = |ms: u64| Mono(ms * 1_000_000);
        assert_eq!(judge.observe(&reading, at(100)), None);
        judge.miss(at(350));
        assert_eq!(judge.observe(&reading, at(400)), None, "the link was stale");
        assert_eq!(judge.observe(&reading, at(650)), Some(GripOutcome::Holding));
    }
}
