//! The pose that a start takes where continuity is lost: at enabling, after an arm was led, at a change of mode, after
//! a gap. Only of an arm at rest, from what its controller commands, else from positions that have agreed with each
//! other for a while.

use std::time::Duration;

use super::written::Issued;
use crate::limit::Limiter;
use dimos_core::arm::{ArmState, Supervision};
use dimos_core::joint::{Joints, MAX_DOF};
use dimos_core::telemetry::Cause;

/// How long positions and velocities must agree.
pub const AGREEMENT: Duration = Duration::from_millis(50);
/// How long that may take.
pub const LIMIT: Duration = Duration::from_secs(2);
/// A controller's command that moves faster is not at rest [rad/s].
const COMMANDED_REST: f64 = 2e-3;
/// Time beyond its lag for which an arm may continue a motion that is no longer commanded [s], and the part of its
/// braking distance by the acceleration limit that its own braking may take.
const REACTION: f64 = 0.2;
const BRAKING: f64 = 2.0;

/// A joint that is stopped by its controller once it has settled may be this far from its setpoint [rad].
const STOPPED_SHORT: f64 = 0.01;

/// What is known of the time since the last written setpoint.
#[derive(Debug, Clone, Copy)]
pub struct Since<'a> {
    /// The last written setpoint; `None`: something else has moved the arm since (a hand, gravity, another program), or
    /// nothing was written.
    pub written: Option<&'a Issued>,
    /// How exactly that is known [rad]: in velocity mode, positions are where velocities have led to.
    pub inexact: f64,
    /// An operator has seen the difference to it.
    pub acknowledged: bool,
    /// The arm may be farther outside its limits than its row says.
    pub outside: bool,
}

/// Returns the positions to start from [rad]; otherwise why the arm cannot start. `is_turn`: whether a difference of a
/// joint is that of a lost turn count.
pub fn positions(
    state: &ArmState,
    limiters: &[Limiter],
    supervision: &Supervision,
    since: Since<'_>,
    is_turn: impl Fn(usize, f64) -> bool,
) -> Result<Joints, Cause> {
    let mut taken = [0.0; MAX_DOF];
    let droop = 2.0 * supervision.accuracy + supervision.droop;
    for (j, (taken, limiter)) in taken.iter_mut().zip(limiters).enumerate() {
        let of = |values: &Joints| values.get(j).copied().unwrap_or_default();
        let read = of(&state.position);
        let resting = state.commanded.as_ref().filter(|own| of(&own.velocity).abs() <= COMMANDED_REST);
        let here = match resting.map(|own| of(&own.position)) {
            Some(own) if (own - read).abs() <= supervision.tracking_tolerance => own,
            Some(own) => return Err(Cause::StartMismatch(j as u16, own, read)),
            None => read,
        };
        *taken = here;
        if let Some(written) = since.written {
            let (last, v) = (of(&written.position), of(&written.velocity).abs());
            let difference = here - last;
            // A joint below its setpoint droops; in velocity mode there was none.
            let near = if resting.is_some() || since.inexact > 0.0 { supervision.accuracy } else { droop };
            if difference.abs() <= near {
                *taken = last;
            } else {
                let braking = BRAKING * v * v / (2.0 * limiter.bounds().acceleration);
                // The arm's own stop may have met it on the rest of its way to the setpoint.
                let explained = droop + STOPPED_SHORT + since.inexact + v * (supervision.lag + REACTION) + braking;
                if is_turn(j, difference) {
                    return Err(Cause::TurnLost(j as u16, difference));
                }
                if difference.abs() > explained && !since.acknowledged {
                    return Err(Cause::StartMismatch(j as u16, last, here));
                }
            }
        }
        let outside = limiter.bounds().excess(*taken) - dimos_core::joint::POSITION_MARGIN;
        if outside > supervision.outside && !since.outside {
            return Err(Cause::OutsideRange(j as u16, outside));
        }
    }
    Ok(taken)
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_core::arm::Commanded;
    use dimos_core::clock::Mono;
    use dimos_core::joint::{JointBounds, joints_of};

    fn limiters() -> Vec<Limiter> {
        vec![Limiter::new(JointBounds::inside(-2.0, 2.0, 2.0, 4.0)); 2]
    }

    fn written(q: [f64; 2], v: f64) -> Issued {
        Issued { seq: 9, at: Mono(1), position: joints_of(&q), velocity: joints_of(&[v, 0.0]), ..Issued::default() }
    }

    fn take(read: [f64; 2], written: Option<&Issued>, acknowledged: bool) -> Result<[f64; 2], Cause> {
        let supervision = Supervision { accuracy: 0.01, droop: 0.05, lag: 0.1, ..Supervision::default() };
        let state = ArmState { dof: 2, position: joints_of(&read), ..ArmState::default() };
        let since = Since { written, inexact: 0.0, acknowledged, outside: false };
        let is_turn = |_, by: f64| by.abs() > 6.0;
        positions(&state, &limiters(), &supervision, since, is_turn).map(|q| [q[0], q[1]])
    }

    #[test]
    fn an_arm_that_droops_keeps_its_last_setpoint_and_one_that_was_moved_is_where_it_is_read() {
        let last = written([0.5, -0.3], 0.0);
        assert_eq!(take([0.44, -0.36], Some(&last), false), Ok([0.5, -0.3]));
        assert_eq!(take([0.45, -0.35], None, false), Ok([0.45, -0.35]));
    }

    #[test]
    fn a_difference_that_nothing_explains_is_refused_until_an_operator_has_seen_it() {
        let last = written([0.5, -0.3], 0.0);
        assert_eq!(take([0.8, -0.3], Some(&last), false), Err(Cause::StartMismatch(0, 0.5, 0.8)));
        assert_eq!(take([0.8, -0.3], Some(&last), true), Ok([0.8, -0.3]));
        // Braking from 1 rad/s after a lag explains 0.55 rad.
        assert_eq!(take([0.8, -0.3], Some(&written([0.5, -0.3], 1.0)), false), Ok([0.8, -0.3]));
        let turned = take([0.5 + std::f64::consts::TAU, -0.3], Some(&last), true);
        assert!(matches!(turned, Err(Cause::TurnLost(0, _))), "{turned:?}");
    }

    #[test]
    fn what_the_controller_commands_counts_if_it_rests_there() {
        let supervision = Supervision { accuracy: 0.002, ..Supervision::default() };
        let own = |q: f64, v: f64| Commanded { position: joints_of(&[q, 0.0]), velocity: joints_of(&[v, 0.0]) };
        let take = |commanded| {
            let state = ArmState { dof: 2, position: joints_of(&[0.5, 0.0]), commanded, ..ArmState::default() };
            let since = Since { written: None, inexact: 0.0, acknowledged: false, outside: false };
            positions(&state, &limiters(), &supervision, since, |_, _| false).map(|q| q[0])
        };
        assert_eq!(take(Some(own(0.51, 0.0))), Ok(0.51));
        assert_eq!(take(Some(own(0.51, 0.1))), Ok(0.5), "it moves");
        assert_eq!(take(Some(own(0.9, 0.0))), Err(Cause::StartMismatch(0, 0.9, 0.5)));
    }

    #[test]
    fn an_arm_a_little_outside_its_limits_starts_where_it_rests() {
        assert_eq!(take([2.015, 0.0], None, false), Ok([2.015, 0.0]));
        let Err(Cause::OutsideRange(0, by)) = take([2.1, 0.0], None, false) else { panic!() };
        assert!((by - 0.1).abs() < 1e-9, "{by}");
    }
}
