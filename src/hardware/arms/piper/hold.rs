//! Computes and sends the pose at which the arm holds.

use std::time::Duration;

use super::protocol::{self, DOF, Follow, MoveMode, Status, WireJoints, millidegrees};
use super::session::Session;
use crate::clock::{Clock, MonotonicClock};
use crate::hardware::adapter::AdapterResult;

/// Maximum distance of a hold from the measured position [rad].
const WINDOW: f64 = 0.02;
/// How long contradicting positions may take to agree: about 10 sets if every fifth is wrong.
const SETTLE_TIMEOUT: Duration = Duration::from_millis(300);
/// How long the controller may take to refuse a target outside the limits.
const REFUSAL_TIMEOUT: Duration = Duration::from_millis(100);
/// Timeout of clearing errors; drivers report every 25 ms.
pub const CLEAR_TIMEOUT: Duration = Duration::from_millis(300);
/// How long the arm may take to report the ordered mode.
const CONTROL_TIMEOUT: Duration = Duration::from_millis(300);
/// State of the arm: target beyond the limits.
pub const BEYOND: u8 = 4;

/// Minimum and maximum target of each joint [0.001°].
pub type WireRanges = [(i32, i32); DOF];

/// Returns the pose to hold [0.001°]: the last written targets, since others would move an arm at rest, but at most
/// 0.02 rad from the measured positions. It is inside the limits; for a joint outside, at most as far outside as
/// measured. `strict`: the controller refuses targets outside.
pub fn target(measured: &WireJoints, written: Option<&WireJoints>, ranges: &WireRanges, strict: bool) -> WireJoints {
    let window = (WINDOW.to_degrees() * 1000.0) as i32;
    let mut target = *measured;
    for (i, (target, range)) in target.iter_mut().zip(ranges).enumerate() {
        let here = *target;
        let wanted = written.and_then(|written| written.get(i)).copied().unwrap_or(here);
        let near = wanted.clamp(here.saturating_sub(window), here.saturating_add(window));
        let inside = within(near, here, *range, strict);
        // A joint farther outside stays where it is, even if the controller refuses that.
        if inside.saturating_sub(here).saturating_abs() <= window {
            *target = inside;
        }
    }
    target
}

/// Limits a target [0.001°] to the range, or for a joint outside to its measured position; with `strict` to the range.
pub fn within(target: i32, measured: i32, (lower, upper): (i32, i32), strict: bool) -> i32 {
    match strict {
        true => target.clamp(lower, upper.max(lower)),
        false => target.clamp(lower.min(measured), upper.max(measured)),
    }
}

/// Converts limits [rad] to ranges [0.001°].
pub fn ranges(lower: &[f64], upper: &[f64]) -> WireRanges {
    let mut ranges = [(0, 0); DOF];
    for (range, (lower, upper)) in ranges.iter_mut().zip(lower.iter().zip(upper)) {
        // Rounded inwards, to stay inside the limits.
        *range = ((lower.to_degrees() * 1000.0).ceil() as i32, (upper.to_degrees() * 1000.0).floor() as i32);
    }
    ranges
}

/// Returns whether a position is outside its range by more than the wire's resolution.
pub fn outside(measured: &WireJoints, ranges: &WireRanges) -> bool {
    measured.iter().zip(ranges).any(|(here, (lower, upper))| !(lower - 1..=upper + 1).contains(here))
}

/// Returns the joint, from 1, that is too far outside its range for any hold, and by how much [rad].
pub fn too_far_outside(measured: &WireJoints, ranges: &WireRanges) -> Option<(usize, f64)> {
    let by = |(here, (lower, upper)): (&i32, &(i32, i32))| (lower - here).max(here - upper);
    let far = measured.iter().zip(ranges).map(by).enumerate().find(|(_, by)| *by > millidegrees(WINDOW));
    far.map(|(i, by)| (i + 1, (f64::from(by) / 1000.0).to_radians()))
}

impl Session {
    /// Holds the arm at its position. If the feedback has a gap during a stream, the target is the last setpoint: older
    /// positions would pull the arm back.
    pub fn hold(&mut self, follow: Follow) -> AdapterResult<()> {
        let target = match self.written() {
            Some(written) if self.streamed && !self.feedback.is_live() => written,
            written => target(&self.feedback.joints, written.as_ref(), &self.ranges, self.strict),
        };
        self.write(100, follow, target)
    }

    /// Waits until measured positions agree with the accepted ones, unless the arm is close to the last target. Returns
    /// `false` if they do not agree.
    pub fn settle(&mut self) -> AdapterResult<bool> {
        let (believed, written) = (&self.feedback.joints, self.written());
        let near = |(here, written): (&i32, &i32)| (written - here).abs() <= millidegrees(WINDOW);
        if written.is_some_and(|written| believed.iter().zip(&written).all(near)) {
            return Ok(true);
        }
        self.watch(SETTLE_TIMEOUT, |feedback| !feedback.disputed(MonotonicClock.now()))
    }

    /// Holds before the motors come on. For an arm slightly outside its limits, the target is its position if the
    /// controller accepts that; otherwise the limit.
    pub fn take_up_hold(&mut self, follow: Follow) -> AdapterResult<()> {
        loop {
            if let (true, Some((joint, by))) = (self.strict, too_far_outside(&self.feedback.joints, &self.ranges)) {
                return Err(self.refuse(format!(
                    "joint {joint} lies {by:.3} rad outside its limits, and the controller takes no target there: not \
                     enabled\nhint: move it back by hand"
                )));
            }
            self.hold(follow)?;
            if self.strict || !outside(&self.feedback.joints, &self.ranges) {
                return Ok(());
            }
            let sent = MonotonicClock.now();
            if !self.watch(REFUSAL_TIMEOUT, |feedback| feedback.status_at > sent && feedback.status.arm == BEYOND)? {
                return Ok(());
            }
            self.strict = true;
            let asked = MonotonicClock.now();
            self.send(&[protocol::clear_errors()])?;
            self.watch(CLEAR_TIMEOUT, |feedback| feedback.status_at > asked && feedback.status.arm == 0)?;
            self.in_order()?;
        }
    }

    /// Waits until the arm reports the ordered mode: later changes are not by this run.
    pub fn take_control(&mut self) -> AdapterResult<()> {
        let sent = MonotonicClock.now();
        let ours = |status: &Status| (status.control, status.mode, status.teaching) == (1, MoveMode::Joint as u8, 0);
        self.watch(CONTROL_TIMEOUT, |feedback| feedback.status_at > sent && ours(&feedback.status))?;
        self.in_order()?;
        let status = self.feedback.status;
        self.feedback.guard.begin(&status, MonotonicClock.now());
        Ok(())
    }

    /// Records what an error reveals about the controller, before it is cleared.
    pub fn learn(&mut self) {
        let beyond = self.feedback.status.arm == BEYOND;
        self.strict |= beyond && self.written.is_some_and(|written| outside(&written, &self.ranges));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RANGES: WireRanges = [(-150_000, 150_000), (0, 180_000), (-170_000, 0), (-1, 1), (-1, 1), (-1, 1)];
    const WINDOW_MDEG: i32 = 1_145;

    #[test]
    fn what_was_written_is_held_near_the_measured_pose() {
        let hold =
            |written: i32| target(&[10_000, 1, -1, 0, 0, 0], Some(&[written, 1, -1, 0, 0, 0]), &RANGES, false)[0];
        assert_eq!((hold(10_000), hold(10_900), hold(9_100)), (10_000, 10_900, 9_100));
        assert_eq!((hold(90_000), hold(-90_000)), (10_000 + WINDOW_MDEG, 10_000 - WINDOW_MDEG));
        assert_eq!(target(&[7; 6], None, &[(0, 9); 6], false), [7; 6], "nothing written: where it is");
        let far = target(&[i32::MAX; 6], Some(&[i32::MIN; 6]), &[(i32::MIN, i32::MAX); 6], false);
        assert_eq!(far, [i32::MAX - WINDOW_MDEG; 6]);
    }

    #[test]
    fn outside_a_limit_it_goes_no_farther_out() {
        let outside = [0, -600, 700, 0, 0, 0];
        assert_eq!(target(&outside, None, &RANGES, false), outside, "where it lies");
        assert_eq!(target(&outside, None, &RANGES, true), [0; 6], "a controller that refuses that: at the limits");
        let beyond = target(&outside, Some(&[0, -1_000, 1_500, 0, 0, 0]), &RANGES, false);
        assert_eq!(beyond, outside, "no farther out than it lies");
        assert_eq!(target(&outside, Some(&[0, 100, 300, 0, 0, 0]), &RANGES, false)[1..3], [100, 300], "back is fine");
        assert_eq!(target(&[0, 500, -500, 0, 0, 0], Some(&[0, -200, 200, 0, 0, 0]), &RANGES, false), [0; 6]);
        let far = [0, -3_000, 0, 0, 0, 0];
        assert_eq!(target(&far, None, &RANGES, true), far, "0.05 rad are no hold");
        assert_eq!(too_far_outside(&far, &RANGES).map(|(joint, _)| joint), Some(2));
        assert_eq!(too_far_outside(&outside, &RANGES), None);
    }

    #[test]
    fn ranges_are_rounded_inwards() {
        assert_eq!(ranges(&[-2.6179], &[2.6179])[0], (-149_994, 149_994));
    }
}
