//! Blends from the motion so far into another curve: adds a quintic offset that begins with the difference in position,
//! velocity and acceleration, and fades to zero.

use dimos_core::joint::{JointBounds, Joints};
use dimos_core::trajectory::Sample;

/// Shortest time of a blend [s].
const SHORTEST: f64 = 0.1;
/// Longest time of a blend [s].
const LONGEST: f64 = 5.0;
/// Step of the search for the time.
const GROWTH: f64 = 1.15;

/// Offsets that fade over a common time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Blend {
    position: Joints,
    velocity: Joints,
    acceleration: Joints,
    duration: f64,
}

impl Default for Blend {
    fn default() -> Self {
        let zero = Joints::default();
        Self { position: zero, velocity: zero, acceleration: zero, duration: SHORTEST }
    }
}

impl Blend {
    /// Returns the time over which it fades [s].
    pub fn duration(&self) -> f64 {
        self.duration
    }

    /// Begins with these differences from the curve, joint by joint. The time is the shortest for which every joint
    /// keeps its limits. `offset_of` returns a joint's difference for a blend of that time, and its
    /// acceleration and jerk limits.
    pub fn begin(joints: usize, offset_of: impl Fn(usize, f64) -> (Sample, JointBounds)) -> Self {
        let mut duration = SHORTEST;
        while duration < LONGEST
            && (0..joints).any(|j| {
                let (offset, limits) = offset_of(j, duration);
                !keeps(&offset, &limits, duration)
            })
        {
            duration *= GROWTH;
        }
        let mut blend = Self { duration, ..Self::default() };
        let all = blend.position.iter_mut().zip(&mut blend.velocity).zip(&mut blend.acceleration);
        for (j, ((p, v), a)) in all.take(joints).enumerate() {
            let (offset, _) = offset_of(j, duration);
            (*p, *v, *a) = (offset.position, offset.velocity, offset.acceleration);
        }
        blend
    }

    /// Returns the offset of a joint, `t` [s] after the begin.
    pub fn at(&self, joint: usize, t: f64) -> Sample {
        let of = |values: &Joints| values.get(joint).copied().unwrap_or_default();
        let (h, s) = (self.duration, (t / self.duration).clamp(0.0, 1.0));
        // Hermite polynomials of degree five for the begin: value, first and second derivative.
        let (p, v, a) = (of(&self.position), of(&self.velocity) * h, of(&self.acceleration) * h * h);
        let (s2, s3, s4) = (s * s, s * s * s, s * s * s * s);
        let s5 = s4 * s;
        let position = p * (1.0 - 10.0 * s3 + 15.0 * s4 - 6.0 * s5)
            + v * (s - 6.0 * s3 + 8.0 * s4 - 3.0 * s5)
            + a * (0.5 * s2 - 1.5 * s3 + 1.5 * s4 - 0.5 * s5);
        let velocity = p * (-30.0 * s2 + 60.0 * s3 - 30.0 * s4)
            + v * (1.0 - 18.0 * s2 + 32.0 * s3 - 15.0 * s4)
            + a * (s - 4.5 * s2 + 6.0 * s3 - 2.5 * s4);
        let acceleration = p * (-60.0 * s + 180.0 * s2 - 120.0 * s3)
            + v * (-36.0 * s + 96.0 * s2 - 60.0 * s3)
            + a * (1.0 - 9.0 * s + 18.0 * s2 - 10.0 * s3);
        Sample { position, velocity: velocity / h, acceleration: acceleration / (h * h) }
    }
}

/// Returns whether an offset that fades over `h` [s] keeps the limits. It may begin with any acceleration.
fn keeps(offset: &Sample, limits: &JointBounds, h: f64) -> bool {
    let (p, v, a) = (offset.position / h.powi(3), offset.velocity / h.powi(2), offset.acceleration / h);
    // The jerk is a parabola over the share `s` of the time, so it is largest at an end or at the vertex.
    let c0 = -60.0 * p - 36.0 * v - 9.0 * a;
    let c1 = 360.0 * p + 192.0 * v + 36.0 * a;
    let c2 = -360.0 * p - 180.0 * v - 30.0 * a;
    let jerk = |s: f64| c0 + s * (c1 + s * c2);
    let inside = |s: f64| if s > 0.0 && s < 1.0 { s } else { 0.0 };
    let vertex = inside(-c1 / (2.0 * c2));
    if [0.0, vertex, 1.0].iter().any(|s| jerk(*s).abs() > limits.jerk) {
        return false;
    }
    // The acceleration is largest at the begin, or where the jerk is zero.
    let acceleration = |s: f64| h * (a + s * (c0 + s * (c1 / 2.0 + s * c2 / 3.0)));
    let q = -(c1 + (c1 * c1 - 4.0 * c0 * c2).max(0.0).sqrt().copysign(c1)) / 2.0;
    let zeros = [q / c2, c0 / q];
    let most = limits.acceleration.max(offset.acceleration.abs() * (1.0 + 1e-9));
    zeros.iter().all(|s| acceleration(inside(*s)).abs() <= most)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_offset_fades_to_zero_within_its_jerk() {
        let offset = Sample { position: 0.05, velocity: -0.3, acceleration: 0.8 };
        let limits = JointBounds { acceleration: 4.0, jerk: 20.0, ..JointBounds::NONE };
        let blend = Blend::begin(1, |_, _| (offset, limits));
        let begin = blend.at(0, 0.0);
        assert_eq!((begin.position, begin.velocity), (offset.position, offset.velocity));
        assert!((begin.acceleration - offset.acceleration).abs() < 1e-12);
        let end = blend.at(0, blend.duration());
        let left = [end.position, end.velocity, end.acceleration];
        assert!(left.iter().all(|value| value.abs() < 1e-12), "{end:?}");
        let (steps, mut before) = (10_000, offset);
        for k in 1..=steps {
            let dt = blend.duration() / f64::from(steps);
            let now = blend.at(0, f64::from(k) * dt);
            let jerk = (now.acceleration - before.acceleration) / dt;
            assert!(jerk.abs() <= 20.0 && now.acceleration.abs() <= 4.0, "{jerk} rad/s³, {now:?} at step {k}");
            assert!(((now.position - before.position) / dt - now.velocity).abs() < 1e-2);
            before = now;
        }
    }
}
