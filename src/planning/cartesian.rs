//! Straight lines of a link: configurations along the line, close enough that the link keeps to it between them.

use glamx::{DAffine3, DQuat};

use crate::robot::kinematics::Kinematics;

use super::ik::{Ik, IkSettings};
use super::path::Path;

/// How a line is followed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LineSettings {
    /// Distance between configurations [m].
    pub step: f64,
    /// Turn between configurations [rad].
    pub turn: f64,
    /// How far the link may be off the line between configurations [m].
    pub deviation: f64,
    /// How far its orientation may be off [rad].
    pub tilt: f64,
    /// How far a joint may go between configurations [rad or m]: farther is a jump.
    pub jump: f64,
}

impl Default for LineSettings {
    fn default() -> Self {
        Self { step: 0.01, turn: 0.05, deviation: 1e-3, tilt: 0.01, jump: 0.35 }
    }
}

/// Why a line ends before its end.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Shortfall {
    /// A joint is at its limit.
    #[error("joint {1:?} is at its limit")]
    Limit(usize, String),
    /// The arm cannot go on in this direction: it is out of reach or singular.
    #[error("the arm can reach no farther in this direction, or is singular")]
    Unreachable,
    /// A joint would have to jump.
    #[error("joint {joint:?} would have to turn by {by:.2} rad at once: the arm is close to a singularity")]
    Jump {
        /// The joint.
        joint: String,
        /// How far [rad or m].
        by: f64,
    },
    /// The way is not free.
    #[error("the motion there is not free")]
    NotFree,
}

/// How far a line was followed.
#[derive(Debug, Clone, PartialEq)]
pub struct Line {
    /// The configurations, from the start.
    pub path: Path,
    /// The part of the line that was reached, 0–1.
    pub fraction: f64,
    /// Why not more.
    pub shortfall: Option<Shortfall>,
}

/// Follows the straight line from where a link (index in the model) stands at `start` to `target`, in the root's
/// frame: position in a straight line, orientation about one axis. `free` says whether the straight way between two
/// configurations is.
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
    // The line is cut finer where the arm bends away from it between configurations.
    let (whole, smallest) = (1.0 / steps, 1.0 / steps / 64.0);
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

/// The configuration at one part of the line, from that at another.
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
        let limit = ik.limit_in_the_way(&at(b), last, &tight);
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
    let tilt = crate::robot::kinematics::step::rotation_between(&is.matrix3, &should.matrix3).length();
    if is.translation.distance(should.translation) > settings.deviation || tilt > settings.tilt {
        return Err(Shortfall::Unreachable);
    }
    Ok(q)
}
