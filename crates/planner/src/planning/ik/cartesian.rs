//! Straight lines of a link: configurations along the line, dense enough that the link stays on it in between.

use glamx::{DAffine3, DQuat};

use dimos_robot::kinematics::Kinematics;

use crate::planning::ik::Ik;
use crate::planning::ik::settings::{IkSettings, LineSettings};
use crate::planning::search::path::Path;

/// Why a line could not be followed to its end.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Shortfall {
    /// A joint reached its limit.
    #[error("joint {1:?} reached its limit")]
    Limit(usize, String),
    /// The target is out of reach in this direction, or the arm is singular.
    #[error("out of reach in this direction, or singular")]
    Unreachable,
    /// A joint would jump.
    #[error("joint {joint:?} would jump by {by:.2} rad: the arm is close to a singularity")]
    Jump {
        /// The joint.
        joint: String,
        /// Size of the jump [rad or m].
        by: f64,
    },
    /// The motion would collide.
    #[error("the motion beyond that point would collide")]
    NotFree,
}

/// The part of a line that was followed.
#[derive(Debug, Clone, PartialEq)]
pub struct Line {
    /// Configurations from the start.
    pub path: Path,
    /// Part of the line that was followed, 0–1.
    pub fraction: f64,
    /// Why it ends early.
    pub shortfall: Option<Shortfall>,
}

/// Follows the straight line of a link (index in the model) from its pose at `start` to `target`, in the root's frame:
/// position on a straight line, rotation about one axis. `free` tests the straight motion between two configurations.
pub fn straight_line(
    kinematics: &Kinematics,
    link: usize,
    start: &[f64],
    target: &DAffine3,
    settings: &LineSettings,
    mut free: impl FnMut(&[f64], &[f64]) -> bool,
) -> Line {
    let mut ik = Ik::new(kinematics, link);
    let from = ik.pose(start);
    let (turn_from, turn_to) = (DQuat::from_mat3(&from.matrix3), DQuat::from_mat3(&target.matrix3));
    let at = |t: f64| {
        let turn = turn_from.slerp(turn_to, t);
        DAffine3::from_rotation_translation(turn, from.translation.lerp(target.translation, t))
    };
    let angle = turn_from.angle_between(turn_to);
    let length = from.translation.distance(target.translation);
    let steps = (length / settings.step).max(angle / settings.turn).ceil().max(1.0);
    let mut line = Line { path: vec![start.to_vec()], fraction: 0.0, shortfall: None };
    // Refines the step where the link leaves the line between configurations.
    let (whole, smallest) = (1.0 / steps, settings.min_part / steps);
    let mut step: f64 = whole;
    while line.fraction < 1.0 && line.shortfall.is_none() {
        let to = if line.fraction + step > 1.0 - 1e-9 { 1.0 } else { line.fraction + step };
        let last = line.path.last().cloned().unwrap_or_default();
        match next(&mut ik, kinematics, &last, (line.fraction, to), &at, settings) {
            Ok(q) if !free(&last, &q) => line.shortfall = Some(Shortfall::NotFree),
            Ok(q) => {
                line.path.push(q);
                line.fraction = to;
                step = (2.0 * step).min(whole);
            }
            Err(_) if step > smallest => step *= 0.5,
            Err(why) => line.shortfall = Some(why),
        }
    }
    line
}

/// Returns the configuration at one part of the line, from that at another.
fn next(
    ik: &mut Ik,
    kinematics: &Kinematics,
    last: &[f64],
    (a, b): (f64, f64),
    at: &impl Fn(f64) -> DAffine3,
    settings: &LineSettings,
) -> Result<Vec<f64>, Shortfall> {
    let tight = IkSettings::default();
    let Some(q) = ik.follow(&at(b), last, &tight) else {
        let limit = ik.limiting_joint(&at(b), last, &tight);
        return Err(limit.map_or(Shortfall::Unreachable, |(j, name)| Shortfall::Limit(j, name)));
    };
    let jumps = q.iter().zip(last).map(|(x, y)| (x - y).abs()).enumerate();
    if let Some((j, by)) = jumps.max_by(|x, y| x.1.total_cmp(&y.1))
        && by > settings.jump
    {
        return Err(Shortfall::Jump { joint: kinematics.names()[j].clone(), by });
    }
    let middle: Vec<f64> = q.iter().zip(last).map(|(x, y)| 0.5 * (x + y)).collect();
    let (is, should) = (ik.pose(&middle), at(0.5 * (a + b)));
    let tilt = dimos_robot::kinematics::step::rotation_between(&is.matrix3, &should.matrix3).length();
    if is.translation.distance(should.translation) > settings.deviation || tilt > settings.tilt {
        return Err(Shortfall::Unreachable);
    }
    Ok(q)
}
