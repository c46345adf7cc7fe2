//! The gripper under the keys: a tap is a small step, a held key opens or closes it until the key is up.

use std::time::{Duration, Instant};

use super::watch::ArmSnapshot;
use dimos_core::arm::GripperUnit;

/// Step of a tap, as a part of the range.
const TAP: f64 = 0.025;
/// How far a held key sends the fingers ahead of where they are, as a part of the range.
const LEAD: f64 = 0.12;
/// A key that comes again within this time is held: longer than the usual delay before repeat.
const HELD: Duration = Duration::from_millis(700);
/// Least time between two commands.
const PERIOD: Duration = Duration::from_millis(80);

/// Latest command by key.
#[derive(Debug, Default)]
pub struct Fingers {
    /// Whether it opens, when the key came, and when a command was sent.
    last: Option<(bool, Instant, Instant)>,
}

impl Fingers {
    /// Handles a key that opens or closes. Returns the position to command [m or rad], or why there is none; `Ok(None)`
    /// if the next command is not due yet.
    pub fn step(&mut self, open: bool, seen: &ArmSnapshot, now: Instant) -> Result<Option<f64>, String> {
        let unit = seen.arm.as_ref().and_then(|arm| arm.gripper_unit.as_deref());
        let on_off = unit == Some(GripperUnit::OnOff.name());
        let position = seen.state.as_ref().and_then(|state| state.gripper).or(on_off.then_some(0.0));
        let Some(position) = position else { return Err("the arm has no gripper".into()) };
        let range = seen.arm.as_ref().and_then(|arm| arm.gripper_range);
        let Some([closed, opened]) = range else { return Err("the range of the gripper is unknown".into()) };
        // One that only opens and closes goes all the way.
        let (mut part, mut sent) = (if on_off { 1.0 } else { TAP }, None);
        if let Some((before, key, command)) = self.last.filter(|(before, ..)| *before == open)
            && now.saturating_duration_since(key) < HELD
        {
            (part, sent) = (part.max(LEAD), Some(command));
            self.last = Some((before, now, command));
        }
        if sent.is_some_and(|sent| now.saturating_duration_since(sent) < PERIOD) {
            return Ok(None);
        }
        self.last = Some((open, now, now));
        let step = part * (opened - closed) * if open { 1.0 } else { -1.0 };
        Ok(Some((position + step).max(closed.min(opened)).min(closed.max(opened))))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_rpc::report::{ArmReport, ArmStateReport};

    fn at(position: f64) -> ArmSnapshot {
        ArmSnapshot {
            state: Some(ArmStateReport { gripper: Some(position), ..Default::default() }),
            arm: Some(ArmReport { gripper_range: Some([0.0, 0.08]), ..Default::default() }),
            ..ArmSnapshot::default()
        }
    }

    #[test]
    fn a_tap_is_a_small_step_and_a_held_key_leads_the_fingers_within_the_range() {
        let (mut fingers, start) = (Fingers::default(), Instant::now());
        let ms = |ms| start + Duration::from_millis(ms);
        let near = |target: Result<Option<f64>, String>, expected: f64| {
            let target = target.unwrap().unwrap();
            assert!((target - expected).abs() < 1e-12, "{target}");
        };
        near(fingers.step(true, &at(0.04), start), 0.042);
        near(fingers.step(true, &at(0.042), ms(500)), 0.0516);
        assert_eq!(fingers.step(true, &at(0.043), ms(530)), Ok(None), "at a bounded rate");
        near(fingers.step(true, &at(0.075), ms(590)), 0.08);
        near(fingers.step(false, &at(0.04), ms(600)), 0.038);
        near(fingers.step(false, &at(0.04), ms(1400)), 0.038);
        let valve = |gripper| ArmSnapshot {
            state: Some(ArmStateReport { gripper, ..Default::default() }),
            arm: Some(ArmReport {
                gripper_range: Some([0.0, 1.0]),
                gripper_unit: Some("on_off".to_owned()),
                ..Default::default()
            }),
            ..ArmSnapshot::default()
        };
        let orders = [(true, None), (false, Some(1.0)), (false, Some(0.0)), (true, Some(0.0))];
        let orders = (0..).zip(orders).map(|(k, (open, now))| fingers.step(open, &valve(now), ms(3000 + 1500 * k)));
        assert_eq!(orders.collect::<Vec<_>>(), [1.0, 0.0, 0.0, 1.0].map(|to| Ok(Some(to))), "it only opens and closes");
        assert!(fingers.step(true, &ArmSnapshot::default(), ms(11_500)).unwrap_err().contains("no gripper"));
    }
}
