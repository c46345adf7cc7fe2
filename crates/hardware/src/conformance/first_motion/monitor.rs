//! Monitoring of the arm during the first motion.

use std::time::Duration;

use super::excursion::MOVE_TIMEOUT;
use super::{DEGREE, FirstMotion, FirstMotionEnd};
use crate::adapter::{AdapterError, JointReading};
use crate::conformance::context::{farthest, pause};
use dimos_core::clock::{Clock, Mono, MonotonicClock};

/// Maximum age of a state [s].
const MAX_STATE_AGE: f64 = 0.5;
/// Time between two readings.
const PERIOD: Duration = Duration::from_micros(2500);

impl FirstMotion<'_> {
    /// Reads the arm. A stale state, an error or motors that went off are unexpected.
    pub(super) fn read(&mut self) -> Result<(Vec<f64>, JointReading, Mono), FirstMotionEnd> {
        let mut reading = JointReading::default();
        let mut result = self.adapter.read_joints(&mut reading);
        if matches!(result, Err(AdapterError::Timeout(_))) {
            result = self.adapter.read_joints(&mut reading);
        }
        result.map_err(|e| FirstMotionEnd::Unexpected(format!("no state: {e}")))?;
        let now = MonotonicClock.now();
        let at = reading.stamp.unwrap_or(now);
        let age = now.seconds_since(at);
        if age > MAX_STATE_AGE {
            return Err(FirstMotionEnd::Unexpected(format!("no state for {age:.1} s (limit {MAX_STATE_AGE} s)")));
        }
        let (code, text) = self.adapter.read_error()?;
        if code != 0 {
            return Err(FirstMotionEnd::Unexpected(format!("error {code}: {text}")));
        }
        if !self.start.is_empty() && self.motion.held.is_some() && !self.adapter.read_enabled()? {
            return Err(FirstMotionEnd::Unexpected("the motors went off".to_owned()));
        }
        let positions = reading.position.get(..self.adapter.get_dof()).unwrap_or_default();
        if !positions.iter().all(|value| value.is_finite()) {
            return Err(FirstMotionEnd::Unexpected(format!("a joint position is not a finite number: {positions:?}")));
        }
        Ok((positions.to_vec(), reading, at))
    }

    pub(super) fn pause(&mut self) -> Result<(), FirstMotionEnd> {
        pause(self.adapter, PERIOD);
        if (self.interrupted)() { Err(FirstMotionEnd::Interrupted) } else { Ok(()) }
    }

    pub(super) fn until(
        &mut self,
        limit: Duration,
        what: &str,
        mut done: impl FnMut(&mut Self) -> Result<bool, FirstMotionEnd>,
    ) -> Result<(), FirstMotionEnd> {
        let end = MonotonicClock.now().after(limit);
        while !done(self)? {
            if MonotonicClock.now() > end {
                return Err(FirstMotionEnd::Unexpected(what.to_owned()));
            }
            self.read()?;
            self.pause()?;
        }
        Ok(())
    }

    /// Waits until no joint moves for a tenth of a second.
    pub(super) fn wait_for_standstill(&mut self) -> Result<Vec<f64>, FirstMotionEnd> {
        let mut last = self.read()?.0;
        self.until(MOVE_TIMEOUT, "the arm does not stop within 15 s", |it| {
            pause(it.adapter, Duration::from_millis(100));
            let now = it.read()?.0;
            let still = farthest(&now, &last) < 0.05 * DEGREE;
            last = now;
            Ok(still)
        })?;
        Ok(last)
    }
}
