//! Setpoints that come less often than states: three moving averages over the time between two setpoints make a motion
//! of continuous acceleration from them.

use super::protocol::DOF;

/// Shortest and longest average [states]. The shortest one keeps the acceleration small when a setpoint comes a state
/// early or late.
const SHORTEST: usize = 16;
const LONGEST: usize = 64;
const STAGES: usize = 3;

/// Values that differ by less are equal [rad or rad/s].
const EQUAL: f64 = 1e-9;

/// Three moving averages in a row, of the same length. Delays by one and a half lengths.
#[derive(Debug, Clone)]
pub struct Smoothing {
    /// The last values of each stage's input; the first `length` of each are used.
    stages: [[[f64; DOF]; LONGEST]; STAGES],
    length: usize,
    next: usize,
}

impl Smoothing {
    /// Starts at rest at `value`.
    pub fn new(value: &[f64; DOF]) -> Self {
        Self { stages: [[*value; LONGEST]; STAGES], length: SHORTEST, next: 0 }
    }

    /// Starts over at rest at `value`.
    pub fn restart(&mut self, value: &[f64; DOF]) {
        self.stages.iter_mut().flatten().for_each(|entry| *entry = *value);
    }

    /// Starts over in a motion that came to `value` with a constant change per state. A motion that `ends` abruptly
    /// gets the longest averages, which slow it down as gently as they can; one that continues gets the shortest,
    /// which lag least.
    pub fn restart_moving(&mut self, value: &[f64; DOF], change: &[f64; DOF], ends: bool) {
        let length = if ends { LONGEST } else { SHORTEST };
        (self.length, self.next) = (length, 0);
        for (number, stage) in self.stages.iter_mut().enumerate() {
            let late = (number * (length - 1)) as f64 / 2.0;
            for (i, entry) in stage.iter_mut().take(length).enumerate() {
                // The first entry is the oldest one.
                let back = late + (length - 1 - i) as f64;
                *entry = std::array::from_fn(|j| at(value, j) - at(change, j) * back);
            }
        }
    }

    /// Fits the averages to the time between two setpoints [states], if nothing moves.
    pub fn fit(&mut self, interval: u64, value: &[f64; DOF]) {
        let interval = interval.clamp(1, LONGEST as u64) as usize;
        let length = (interval * SHORTEST.div_ceil(interval)).min(LONGEST);
        if length != self.length && self.rests_at(value) {
            self.restart(value);
            (self.length, self.next) = (length, 0);
        }
    }

    /// Returns whether all values are `value`.
    pub fn rests_at(&self, value: &[f64; DOF]) -> bool {
        let used = self.stages.iter().flat_map(|stage| stage.iter().take(self.length));
        used.flat_map(|entry| entry.iter().zip(value)).all(|(a, b)| (a - b).abs() < EQUAL)
    }

    /// Takes the value of one state, and returns the smoothed one.
    pub fn push(&mut self, value: &[f64; DOF]) -> [f64; DOF] {
        let mut value = *value;
        for stage in &mut self.stages {
            if let Some(entry) = stage.get_mut(self.next) {
                *entry = value;
            }
            let used = stage.iter().take(self.length);
            let sum = used.fold([0.0; DOF], |sum, entry| std::array::from_fn(|i| at(&sum, i) + at(entry, i)));
            value = sum.map(|sum| sum / self.length as f64);
        }
        self.next = (self.next + 1) % self.length;
        value
    }
}

fn at(values: &[f64; DOF], joint: usize) -> f64 {
    values.get(joint).copied().unwrap_or_default()
}

/// A difference that fades without a jump in velocity or acceleration.
#[derive(Debug, Clone, Copy, Default)]
pub struct Fade {
    offset: [f64; DOF],
    /// Its length, and how much of it has passed [states].
    length: f64,
    passed: f64,
}

/// Shortest fade [states], and the acceleration of longer ones [rad/state²]: a small part of what the joints may.
const SHORTEST_FADE: f64 = 250.0;
const FADE_ACCELERATION: f64 = 2e-6;
/// Largest acceleration of a fade over one unit, in one unit of time.
const PEAK: f64 = 5.78;

impl Fade {
    /// Returns the present difference.
    pub fn value(&self) -> [f64; DOF] {
        let t = if self.length > 0.0 { (self.passed / self.length).min(1.0) } else { 1.0 };
        let left = 1.0 - t * t * t * (10.0 + t * (6.0 * t - 15.0));
        self.offset.map(|offset| offset * left)
    }

    /// Adds a difference, and fades the sum from now on.
    pub fn add(&mut self, jump: &[f64; DOF]) {
        let now = self.value();
        self.offset = std::array::from_fn(|i| at(&now, i) + at(jump, i));
        let most = self.offset.iter().fold(0.0, |most: f64, offset| most.max(offset.abs()));
        self.length = (PEAK * most / FADE_ACCELERATION).sqrt().max(SHORTEST_FADE);
        self.passed = 0.0;
    }

    /// Passes the time of one state.
    pub fn pass(&mut self) {
        self.passed += 1.0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Largest acceleration [rad/s²] and jerk [rad/s³] of values 1 ms apart.
    fn largest(values: &[f64]) -> (f64, f64) {
        let derive = |values: &[f64]| values.windows(2).map(|pair| (pair[1] - pair[0]) * 1e3).collect::<Vec<_>>();
        let accelerations = derive(&derive(values));
        let most = |values: &[f64]| values.iter().fold(0.0, |most: f64, v| most.max(v.abs()));
        (most(&accelerations), most(&derive(&accelerations)))
    }

    #[test]
    fn a_ramp_in_steps_is_smooth_and_late_by_one_and_a_half_averages() {
        let mut smoothing = Smoothing::new(&[0.0; DOF]);
        smoothing.fit(10, &[0.0; DOF]);
        // 1 rad/s, in setpoints every 10 ms; one of them comes 1 ms late.
        let setpoint = |i: usize| (i - usize::from(i == 250)) / 10;
        let values: Vec<f64> = (0..500).map(|i| smoothing.push(&[setpoint(i) as f64 * 0.01; DOF])[3]).collect();
        let (acceleration, jerk) = largest(&values[100..]);
        assert!(acceleration < 4.0 && jerk < 4000.0, "{acceleration} rad/s², {jerk} rad/s³");
        // The average of steps is half a step below the line, and the smoothing 1.5 × 20 states late.
        assert!((values[499] - (0.499 - 0.0045 - 0.0285)).abs() < 1e-6, "{}", values[499]);
    }

    #[test]
    fn a_motion_is_taken_over() {
        let mut smoothing = Smoothing::new(&[0.0; DOF]);
        smoothing.restart_moving(&[1.0; DOF], &[0.001; DOF], true);
        let values: Vec<f64> =
            (1..=300).map(|i| smoothing.push(&[1.0 + 0.001 * f64::from(i.min(50)); DOF])[0]).collect();
        let (acceleration, _) = largest(&values);
        assert!((values[1] - values[0] - 0.001).abs() < 1e-9 && (values[299] - 1.05).abs() < 1e-9);
        assert!(acceleration < 12.5, "{acceleration} rad/s²");
    }

    #[test]
    fn it_rests_where_it_was_put() {
        let mut smoothing = Smoothing::new(&[0.5; DOF]);
        assert_eq!(smoothing.push(&[0.5; DOF]), [0.5; DOF]);
        smoothing.push(&[0.6; DOF]);
        assert!(!smoothing.rests_at(&[0.6; DOF]));
        for _ in 0..3 * SHORTEST {
            smoothing.push(&[0.6; DOF]);
        }
        assert!(smoothing.rests_at(&[0.6; DOF]));
    }

    #[test]
    fn a_difference_fades_gently() {
        let mut fade = Fade::default();
        assert_eq!(fade.value(), [0.0; DOF]);
        fade.add(&[0.05; DOF]);
        let values: Vec<f64> = (0..600).map(|_| (fade.value()[0], fade.pass()).0).collect();
        assert_eq!((values[0], values[599]), (0.05, 0.0));
        let (acceleration, jerk) = largest(&values);
        assert!(acceleration < 2.1 && jerk < 100.0, "{acceleration} rad/s², {jerk} rad/s³");
    }
}
