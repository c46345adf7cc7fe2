//! The pose at which the arm holds: after a stop the point that the caller gives, when its motors come on where it is.
//! Only then is a target made of measured positions.

use std::time::Duration;

use super::SPEC;
use super::feedback::Feedback;
use super::protocol::{self, DOF, Follow, MoveMode, Status, WireJoints, millidegrees};
use super::session::Session;
use dimos_core::arm::StopPoint;
use dimos_core::clock::{Clock, Mono, MonotonicClock};
use dimos_core::joint::Joints;
use dimos_hardware::adapter::AdapterResult;

/// How far outside its range a joint may rest and be held, and how far the arm may be from its last target when it is
/// enabled again [rad].
const WINDOW: f64 = SPEC.outside;
/// Positions agree for this long before they are believed; after they jumped, for longer.
const AGREED: Duration = Duration::from_millis(60);
const JUMPED: Duration = Duration::from_millis(250);
/// How long they may take to do so.
const AGREED_TIMEOUT: Duration = Duration::from_millis(500);
/// How far positions that agree may miss what the motors' speeds explain [0.001°]: 0.01 rad.
const MISSED: i32 = 573;
/// By how much the speeds may be wrong.
const SPEED_MARGIN: f64 = 1.5;
/// Speed of the way to a target that is not where the arm rests [%].
const SLOW: u8 = 5;
/// A target this near to the arm is no way [0.001°].
const NO_WAY: i32 = 100;
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

/// Returns the target with which the motors come on [0.001°]: where the arm is, or what it was commanded last. Inside
/// the limits; for a joint outside, at most as far outside as measured. `strict`: the controller refuses targets
/// outside.
fn target(measured: &WireJoints, written: Option<&WireJoints>, ranges: &WireRanges, strict: bool) -> WireJoints {
    let mut target = *measured;
    for (i, (target, range)) in target.iter_mut().zip(ranges).enumerate() {
        let here = *target;
        let wanted = written.and_then(|written| written.get(i)).copied().unwrap_or(here);
        let inside = within(wanted, here, *range, strict);
        // A joint farther outside stays where it is, even if the controller refuses that.
        if inside.saturating_sub(here).saturating_abs() <= millidegrees(WINDOW) {
            *target = inside;
        }
    }
    target
}

/// Limits a target [0.001°] to the range, or for a joint that rests outside of it to that place; with `strict` to the
/// range.
pub fn within(target: i32, rests: i32, (lower, upper): (i32, i32), strict: bool) -> i32 {
    match strict {
        true => target.clamp(lower, upper.max(lower)),
        false => target.clamp(lower.min(rests), upper.max(rests)),
    }
}

/// Returns the largest distance of a joint [0.001°].
fn distance(a: &WireJoints, b: &WireJoints) -> i32 {
    a.iter().zip(b).map(|(a, b)| a.saturating_sub(*b).saturating_abs()).max().unwrap_or_default()
}

/// A pose for messages [°].
fn text(pose: &WireJoints) -> String {
    let joints: Vec<String> = pose.iter().map(|joint| format!("{:.1}", f64::from(*joint) / 1000.0)).collect();
    format!("({})", joints.join(", "))
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
    /// Holds the arm at the point where it is to rest. An arm that another program commands has no such point: it is
    /// held where it is, if its positions agree.
    pub fn stop(&mut self, rest: &StopPoint, follow: Follow) -> AdapterResult<()> {
        let target = match rest.position {
            Some(position) if self.ours().is_ok() => self.reachable(position),
            None if self.ours().is_ok() => None,
            _ => Some(self.agreed()?),
        };
        target.map_or(Ok(()), |target| self.write(100, follow, target))
    }

    /// Returns positions [rad] as a target within the controller's ranges; `None` if they are no numbers.
    fn reachable(&self, position: Joints) -> Option<WireJoints> {
        let mut target = [0; DOF];
        for (i, (to, angle)) in target.iter_mut().zip(position).enumerate() {
            let wanted = millidegrees(Some(angle).filter(|angle| angle.is_finite())?);
            *to = self.limited(i, wanted);
        }
        Some(target)
    }

    /// Limits the target of joint `i` [0.001°] to its range, or to the last target of a joint that was enabled outside.
    pub fn limited(&self, i: usize, target: i32) -> i32 {
        let Some(range) = self.ranges.get(i) else { return target };
        let rests = self.written.and_then(|written| written.get(i).copied()).unwrap_or(range.0);
        within(target, rests, *range, self.strict)
    }

    /// Waits until measured positions agree for a while with each other and with the motors' speeds. Returns them.
    pub fn agreed(&mut self) -> AdapterResult<WireJoints> {
        let end = MonotonicClock.now().after(AGREED_TIMEOUT);
        let (mut since, mut first): (Option<Mono>, WireJoints) = (None, [0; DOF]);
        let (mut seen, mut way) = (Mono::ZERO, [0.0; DOF]);
        let agrees = |feedback: &Feedback| {
            if feedback.joints_at != seen {
                let dt = if seen == Mono::ZERO { 0.0 } else { feedback.joints_at.seconds_since(seen).min(0.02) };
                seen = feedback.joints_at;
                for (way, motor) in way.iter_mut().zip(&feedback.motors) {
                    *way += f64::from(motor.speed).abs() * 1e-3 * dt;
                }
                let missed = |((here, first), way): ((&i32, &i32), &f64)| {
                    (here - first).abs() > MISSED + millidegrees(SPEED_MARGIN * way)
                };
                let contradicts = feedback.joints.iter().zip(&first).zip(&way).any(missed);
                if since.is_none() || contradicts {
                    (since, first, way) = (Some(seen), feedback.joints, [0.0; DOF]);
                }
            }
            let now = MonotonicClock.now();
            let jumped = feedback.jumped_at != Mono::ZERO && now.since(feedback.jumped_at) < JUMPED;
            since.is_some_and(|since| seen.since(since) >= AGREED) && !jumped && !feedback.disputed(now)
        };
        let left = end.since(MonotonicClock.now());
        if self.watch(left, agrees)? {
            return Ok(self.feedback.joints);
        }
        Err(self.refuse(
            "its measured positions contradict each other\nhint: look for interference on the bus (shield, terminators), \
             or a second arm on it"
                .into(),
        ))
    }

    /// Checks that an arm whose motors were on all along is where it was commanded last.
    pub fn as_commanded(&self, measured: &WireJoints) -> AdapterResult<()> {
        match self.written().filter(|written| distance(measured, written) > millidegrees(WINDOW)) {
            Some(written) => Err(self.refuse(format!(
                "it reads {} deg, and was commanded {} deg last: not enabled\nhint: look at the arm. Where it is blocked, \
                 free it; otherwise support it, then switch its motors off and on (dimos arm disable, enable)",
                text(measured),
                text(&written)
            ))),
            None => Ok(()),
        }
    }

    /// Sets the target with which the motors come on. For an arm slightly outside its limits, that is its position if
    /// the controller accepts that; otherwise the limit. Returns it.
    pub fn take_up_hold(&mut self, measured: &WireJoints, follow: Follow) -> AdapterResult<WireJoints> {
        loop {
            if let (true, Some((joint, by))) = (self.strict, too_far_outside(measured, &self.ranges)) {
                return Err(self.refuse(format!(
                    "joint {joint} lies {by:.3} rad outside its limits, and the controller takes no target there: not \
                     enabled\nhint: move it back by hand"
                )));
            }
            let target = target(measured, self.written.as_ref(), &self.ranges, self.strict);
            self.hold(measured, follow, target)?;
            if self.strict || !outside(measured, &self.ranges) {
                return Ok(target);
            }
            let sent = MonotonicClock.now();
            if !self.watch(REFUSAL_TIMEOUT, |feedback| feedback.status_at > sent && feedback.status.arm == BEYOND)? {
                return Ok(target);
            }
            (self.strict, self.written) = (true, None);
            let asked = MonotonicClock.now();
            self.send(&[protocol::clear_errors()])?;
            self.watch(CLEAR_TIMEOUT, |feedback| feedback.status_at > asked && feedback.status.arm == 0)?;
            self.in_order()?;
        }
    }

    /// Repeats the target when the motors are on: a controller may forget one that came before. An arm that fell
    /// meanwhile is held where it is then.
    pub fn confirm_hold(&mut self, set: WireJoints, follow: Follow) -> AdapterResult<()> {
        let measured = self.agreed().unwrap_or(set);
        let fell = distance(&measured, &set) > millidegrees(WINDOW);
        let target = if fell { target(&measured, None, &self.ranges, self.strict) } else { set };
        self.hold(&measured, follow, target)
    }

    /// Sends a target, slowly where the arm is not there.
    fn hold(&mut self, measured: &WireJoints, follow: Follow, target: WireJoints) -> AdapterResult<()> {
        let speed = if distance(measured, &target) > NO_WAY { SLOW } else { 100 };
        self.write(speed, follow, target)
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
    #[test]
    fn motors_come_on_where_the_arm_is_or_at_its_last_target() {
        let measured = [10_000, 1, -1, 0, 0, 0];
        assert_eq!(target(&measured, None, &RANGES, false), measured);
        assert_eq!(target(&measured, Some(&[10_900, 1, -1, 0, 0, 0]), &RANGES, false)[0], 10_900);
        assert_eq!(distance(&[i32::MAX; 6], &[i32::MIN; 6]), i32::MAX);
        assert_eq!(text(&[1_500, -2_040, 0, 0, 0, 0]), "(1.5, -2.0, 0.0, 0.0, 0.0, 0.0)");
    }

    #[test]
    fn outside_a_limit_it_goes_no_farther_out() {
        let outside = [0, -600, 700, 0, 0, 0];
        assert_eq!(target(&outside, None, &RANGES, false), outside, "where it lies");
        assert_eq!(target(&outside, None, &RANGES, true), [0; 6], "a controller that refuses that: at the limits");
        let beyond = target(&outside, Some(&[0, -1_000, 1_500, 0, 0, 0]), &RANGES, false);
        assert_eq!(beyond, outside, "no farther out than it lies");
        assert_eq!(target(&outside, Some(&[0, 100, 300, 0, 0, 0]), &RANGES, false)[1..3], [100, 300], "back is fine");
        let far = [0, -4_000, 0, 0, 0, 0];
        assert_eq!(target(&far, None, &RANGES, true), far, "0.07 rad are no hold");
        assert_eq!(too_far_outside(&far, &RANGES).map(|(joint, _)| joint), Some(2));
        assert_eq!(too_far_outside(&outside, &RANGES), None);
    }

    #[test]
    fn ranges_are_rounded_inwards() {
        assert_eq!(ranges(&[-2.6179], &[2.6179])[0], (-149_994, 149_994));
    }
}
