//! Braking with all joints together: the arm stops on the straight line of its velocities, as fast as the joint
//! that needs longest. The collision guard proves this way before the arm takes it.

use crate::limit::Limiter;
use dimos_core::joint::{Joints, MAX_DOF};

/// Returns the time that the joint needs which needs longest [s].
pub fn time(limiters: &[Limiter]) -> f64 {
    let time = |limiter: &Limiter| limiter.velocity().abs() / limiter.bounds().acceleration;
    limiters.iter().map(time).fold(0.0, f64::max)
}

/// Returns by how much the velocity of each joint decreases per step of `dt` [s] [rad/s].
pub fn decreases(limiters: &[Limiter], dt: f64) -> Joints {
    let mut decreases = [0.0; MAX_DOF];
    let longest = time(limiters);
    for (decrease, limiter) in decreases.iter_mut().zip(limiters) {
        *decrease = match longest > 0.0 {
            true => limiter.velocity().abs() / longest * dt,
            false => limiter.bounds().acceleration * dt,
        };
    }
    decreases
}

/// Returns where braking from the present commands ends, inside the joints' ranges [rad].
pub fn rest_point(limiters: &[Limiter], dt: f64) -> Joints {
    let mut point = [0.0; MAX_DOF];
    let decreases = decreases(limiters, dt);
    for ((q, limiter), decrease) in point.iter_mut().zip(limiters).zip(decreases) {
        let (lower, upper) = limiter.range();
        let speed = limiter.velocity().abs();
        // The k-th step has the speed less k decreases.
        let steps = if speed > 0.0 { (speed / decrease.max(1e-12)).ceil() - 1.0 } else { 0.0 };
        let way = (speed * steps - decrease * steps * (steps + 1.0) / 2.0) * dt;
        *q = (limiter.position() + way.copysign(limiter.velocity())).max(lower).min(upper);
    }
    point
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_core::joint::JointBounds;

    const DT: f64 = 0.01;

    fn moving(velocities: &[(f64, f64)]) -> Vec<Limiter> {
        let limiter = |(velocity, acceleration): &(f64, f64)| {
            let mut limiter = Limiter::new(JointBounds::inside(-3.0, 3.0, 3.0, *acceleration));
            limiter.rewind(0.5, *velocity);
            limiter
        };
        velocities.iter().map(limiter).collect()
    }

    #[test]
    fn all_joints_rest_together_within_their_accelerations_where_it_was_said() {
        let mut limiters = moving(&[(2.0, 5.0), (-0.3, 5.0), (1.0, 2.0), (0.0, 5.0)]);
        let point = rest_point(&limiters, DT);
        let mut steps = 0;
        while limiters.iter().any(|limiter| limiter.velocity().abs() > 1e-12) {
            let decreases = decreases(&limiters, DT);
            for (limiter, decrease) in limiters.iter_mut().zip(decreases) {
                assert!(decrease <= limiter.bounds().acceleration * DT * (1.0 + 1e-9));
                limiter.decelerate(decrease, DT);
            }
            let of = |j: usize| limiters[j].velocity();
            assert!((of(0) / 2.0 - of(2)).abs() < 1e-9 && (of(0) / 2.0 + of(1) / 0.3).abs() < 1e-9, "one line");
            steps += 1;
        }
        assert!((49..=51).contains(&steps), "{steps} steps: the third joint needs 0.5 s");
        for (limiter, q) in limiters.iter().zip(point) {
            assert!((limiter.position() - q).abs() < 1e-9, "{} {q}", limiter.position());
        }
    }

    #[test]
    fn the_rest_point_is_inside_the_range() {
        let mut limiters = moving(&[(3.0, 1.0)]);
        limiters.iter_mut().for_each(|limiter| limiter.rewind(2.9, 3.0));
        assert!((rest_point(&limiters, DT)[0] - 2.99).abs() < 1e-12);
    }
}
