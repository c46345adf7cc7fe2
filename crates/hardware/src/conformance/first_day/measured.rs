//! Whether positions are measured, and how far they lag behind setpoints.

use std::time::Duration;

use super::{End, Tour, skipped};
use crate::conformance::context::pause;
use crate::conformance::first_motion::{REACH, SPEED};
use crate::conformance::lag::Trace;
use crate::sim::faults::{Fault, FaultKind};
use dimos_core::clock::{Clock, MonotonicClock};

/// A planted push [rad] and its time [s].
const PUSH: (f64, f64) = (0.009, 0.8);
/// How long a person has to push.
const TIME: Duration = Duration::from_secs(15);
/// A joint that moves by less than this was not pushed [rad]: half an encoder step of the coarsest arm is 0.0008.
const YIELDS: f64 = 0.0012;
/// Largest push that is asked for [rad]; far beyond it the step ends.
const MOST: f64 = 0.0175;
/// Readings from one setpoint to the next, and attempts while other programs take the processor.
const SAMPLES: u32 = 4;
const ATTEMPTS: u32 = 3;

impl Tour<'_> {
    /// Watches the reported position of a joint that is pushed while the arm holds.
    pub(super) fn measured_or_commanded(&mut self) -> Result<String, End> {
        self.prepare()?;
        self.go(0.0)?;
        let rest = self.positions()?;
        let mut noise: f64 = 0.0;
        for _ in 0..100 {
            noise = noise.max(self.farthest_from(&rest)?);
            self.wait(Duration::from_millis(4))?;
        }
        let limit = match self.emulator {
            Some(emulator) => {
                let (amount, lasts) = PUSH;
                let push = Fault { joint: self.joint + 1, amount, ..Fault::new(FaultKind::Nudged).lasting(lasts) };
                if let Err(why) = emulator.inject(push) {
                    return skipped(why);
                }
                Duration::from_secs_f64(lasts + 0.5)
            }
            None if !self.person.is_there() => return skipped("no person is at the arm to push it"),
            None => {
                self.person.tell(&format!(
                    "push joint {} by hand, gently and by at most 1°, and let go ({} s)",
                    self.joint + 1,
                    TIME.as_secs()
                ));
                TIME
            }
        };
        let yields = YIELDS.max(3.0 * noise);
        let (until, mut most) = (MonotonicClock.now().after(limit), 0.0_f64);
        while MonotonicClock.now() < until {
            most = most.max(self.farthest_from(&rest)?);
            if most > 4.0 * MOST {
                return Err(End::Failed(format!("a joint moved by {:.1}°", most.to_degrees())));
            }
            self.wait(Duration::from_millis(4))?;
            if most > yields && self.farthest_from(&rest)? < yields {
                break;
            }
        }
        self.still()?;
        self.figure("reported motion of a pushed joint", most.to_degrees(), "°", None);
        self.figure("noise of a position at rest", noise.to_degrees(), "°", None);
        if most > yields {
            return Ok("positions are MEASURED: a pushed joint is reported where it is".to_owned());
        }
        if let Some(figure) = self.figures.first_mut() {
            figure.line = Some(
                "row: positions are commanded: no tracking error can be seen, only the arm's own guards".to_owned(),
            );
        }
        Ok("positions are COMMANDED: a pushed joint is reported where it should be".to_owned())
    }

    fn farthest_from(&mut self, rest: &[f64]) -> Result<f64, End> {
        let now = self.positions()?;
        Ok(now.iter().zip(rest).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max))
    }

    /// Measures the time from a setpoint to the motion that follows it.
    pub(super) fn lag(&mut self) -> Result<String, End> {
        self.prepare()?;
        self.go(0.0)?;
        for _ in 0..ATTEMPTS {
            let mut trace = Trace::default();
            for (from, to) in [(0.0, REACH), (REACH, 0.0), (0.0, -REACH), (-REACH, 0.0)] {
                self.wave(&mut trace, from, to)?;
            }
            // The computation may take longer than an arm waits for an answer.
            let adapter = &mut *self.adapter;
            let lag = std::thread::scope(|scope| {
                let computed = scope.spawn(|| trace.lag());
                while !computed.is_finished() {
                    pause(adapter, Duration::from_millis(2));
                }
                computed.join().ok().flatten()
            });
            if let Some(lag) = lag {
                let line = format!("hardware.arm.lag: {lag:.3} (row: {:.3})", self.row.lag);
                self.figure("lag", 1e3 * lag, "ms", Some(line));
                return Ok(format!("joint {} follows {:.0} ms behind its setpoints", self.joint + 1, 1e3 * lag));
            }
        }
        Err(End::Failed("the lag is over 500 ms, or other programs took the processor".to_owned()))
    }

    /// Moves along a half cosine wave, with readings before and after setpoints in turn: so a joint between two steps
    /// is seen early and late alike.
    fn wave(&mut self, trace: &mut Trace, from: f64, to: f64) -> Result<(), End> {
        let time = (std::f64::consts::FRAC_PI_2 * (to - from).abs() / (SPEED * self.top())).max(0.8);
        trace.begin_wave();
        let (mut passed, mut last) = (0.0, MonotonicClock.now());
        for sample in 0_u32.. {
            let now = MonotonicClock.now();
            passed += now.seconds_since(last).min(0.01);
            last = now;
            let part = (passed / time).min(1.0);
            let (due, after) = (sample % SAMPLES == 0, sample / SAMPLES % 2 == 1);
            let point = from + (to - from) * (0.5 - 0.5 * (part * std::f64::consts::PI).cos());
            if due && !after {
                let at = self.write(point)?;
                trace.wrote(at, point);
            }
            let (seen, stamp) = self.at()?;
            if due && after {
                let at = self.write(point)?;
                trace.wrote(at, point);
            }
            trace.saw(now, stamp, seen);
            if (seen - point).abs() > 0.1 {
                return Err(End::Failed(format!("joint {} does not follow its setpoints", self.joint + 1)));
            }
            if passed > time + 0.3 {
                return Ok(());
            }
            self.wait(Duration::from_micros(2500))?;
        }
        Ok(())
    }
}
