//! Motors on and off: sag, brakes, recovery; the program of a controller that has one.

use std::time::Duration;

use super::drive::MOTORS;
use super::{End, Tour, skipped};
use crate::conformance::context::rest_point;
use dimos_core::clock::{Clock, MonotonicClock};
use dimos_core::joint::ControlMode;

/// How long the arm is watched after its motors came on or went off [s].
const WATCH: f64 = 0.5;
/// A motion beyond this ends the tour [rad].
const FALLS: f64 = 0.035;

impl Tour<'_> {
    /// Enables the arm, disables it if it has brakes, and enables it again.
    pub(super) fn power(&mut self) -> Result<String, End> {
        self.ready = false;
        let was_on = self.adapter.read_enabled()?;
        if was_on && !self.info.holds_when_disabled {
            return skipped("its motors are on, and without them it falls");
        }
        if was_on {
            self.switch_off()?;
        }
        let (time, sag) = self.switch_on()?;
        self.figure("motors on", 1e3 * time, "ms", None);
        self.figure("sag when the motors come on", sag.to_degrees(), "°", None);
        self.stop()?;
        if !self.info.holds_when_disabled {
            return Ok(format!("it sags by {:.3}°; the motors stay on: without them it falls", sag.to_degrees()));
        }
        let (time, sag_off) = self.switch_off()?;
        self.figure("motors off", 1e3 * time, "ms", None);
        self.figure("sag when the brakes close", sag_off.to_degrees(), "°", None);
        // A stop of an arm without power must not enable it.
        let rest = rest_point(self.adapter);
        let stopped = self.adapter.write_stop(&rest).is_ok();
        self.wait(Duration::from_millis(100))?;
        self.read()?;
        if self.adapter.read_enabled()? {
            return Err(End::Failed("a stop switched the motors on".to_owned()));
        }
        let began = MonotonicClock.now();
        self.switch_on()?;
        if self.has(ControlMode::ServoPosition) {
            self.set_mode(ControlMode::ServoPosition)?;
        }
        let recovery = MonotonicClock.now().seconds_since(began) - WATCH;
        self.figure("from motors off to taking setpoints", 1e3 * recovery, "ms", None);
        let stop = if stopped { "a stop without power is taken" } else { "a stop without power is refused" };
        Ok(format!("it sags by {:.3}° and {:.3}°; {stop}", sag.to_degrees(), sag_off.to_degrees()))
    }

    /// Enables the arm. Returns the time that took [s] and how far it moved [rad].
    fn switch_on(&mut self) -> Result<(f64, f64), End> {
        let before = self.positions()?;
        let began = MonotonicClock.now();
        self.motors_on()?;
        let time = MonotonicClock.now().seconds_since(began);
        Ok((time, self.watch(&before)?))
    }

    /// Disables the arm. Returns the same.
    fn switch_off(&mut self) -> Result<(f64, f64), End> {
        let before = self.positions()?;
        let began = MonotonicClock.now();
        self.adapter.write_enable(false)?;
        self.until(MOTORS, "the motors did not go off", |it| Ok(!it.adapter.read_enabled()?))?;
        let time = MonotonicClock.now().seconds_since(began);
        Ok((time, self.watch(&before)?))
    }

    fn watch(&mut self, before: &[f64]) -> Result<f64, End> {
        let (began, mut most) = (MonotonicClock.now(), 0.0_f64);
        while MonotonicClock.now().seconds_since(began) < WATCH {
            let now = self.positions()?;
            most = most.max(now.iter().zip(before).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max));
            if most > FALLS {
                return Err(End::Failed(format!("the arm moved by {:.1}°", most.to_degrees())));
            }
            self.wait(Duration::from_millis(4))?;
        }
        Ok(most)
    }

    /// Starts the program of a controller that has one, and ends it, without motion.
    pub(super) fn program(&mut self) -> Result<String, End> {
        if self.row.name != "ur" {
            return skipped("its controller runs no program of ours");
        }
        self.motors_on()?;
        self.stop()?;
        let rest = rest_point(self.adapter);
        self.adapter.deactivate(&rest)?;
        self.ready = false;
        self.wait(Duration::from_millis(200))?;
        let began = MonotonicClock.now();
        self.motors_on()?;
        let time = MonotonicClock.now().seconds_since(began);
        self.figure("compiling and starting the program", 1e3 * time, "ms", None);
        let figures = crate::conformance::figures::measure(self.adapter, Duration::from_secs(1))?;
        self.figure("states per second while it runs", figures.rate, "Hz", None);
        let rest = rest_point(self.adapter);
        self.adapter.deactivate(&rest)?;
        Ok(format!("the controller compiles and starts the program within {:.0} ms", 1e3 * time))
    }
}
