//! Lines and arcs of a link: configurations along them, dense enough that the link stays on its curve in between.

use dimos_robot::kinematics::Kinematics;

use crate::planning::curve::joint_curve::JointCurve;
use crate::planning::curve::tool_path::ToolPath;
use crate::planning::ik::Ik;
use crate::planning::ik::settings::LineSettings;
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

/// Follows a curve of a link (index in the model) from its pose at `start`, in the root's frame. `free` tests the
/// straight motion between two configurations.
pub fn follow(
    kinematics: &Kinematics,
    link: usize,
    start: &[f64],
    way: &ToolPath,
    settings: &LineSettings,
    mut free: impl FnMut(&[f64], &[f64]) -> bool,
) -> Line {
    let mut ik = Ik::new(kinematics, link);
    let steps = (way.length() / settings.step).max(way.angle() / settings.turn).max(way.bend() / settings.turn);
    let steps = steps.ceil().max(1.0);
    let mut line = Line { path: vec![start.to_vec()], fraction: 0.0, shortfall: None };
    // Refines the step where the link leaves the line between configurations.
    let (whole, smallest) = (1.0 / steps, settings.min_part / steps);
    let mut step: f64 = whole;
    while line.fraction < 1.0 && line.shortfall.is_none() {
        let to = if line.fraction + step > 1.0 - 1e-9 { 1.0 } else { line.fraction + step };
        let last = line.path.last().cloned().unwrap_or_default();
        match next(&mut ik, kinematics, &last, (line.fraction, to), way, settings) {
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

/// Returns the smooth curve through configurations along a tool's curve, if the tool stays within the settings'
/// deviation of it everywhere.
pub fn smooth(
    kinematics: &Kinematics,
    link: usize,
    path: &Path,
    way: &ToolPath,
    settings: &LineSettings,
) -> Option<JointCurve> {
    let curve = JointCurve::through(path)?;
    let (mut ik, mut q) = (Ik::new(kinematics, link), Vec::new());
    for pair in curve.knots().windows(2) {
        for part in [0.25, 0.5, 0.75] {
            let s = pair[0] + part * (pair[1] - pair[0]);
            curve.at(s, &mut q);
            let [far, turned] = way.deviation(&ik.pose(&q), s / curve.length());
            if far > settings.curve_deviation || turned > settings.curve_tilt {
                return None;
            }
        }
    }
    Some(curve)
}

/// Returns the configuration at one part of the line, from that at another.
fn next(
    ik: &mut Ik,
    kinematics: &Kinematics,
    last: &[f64],
    (a, b): (f64, f64),
    way: &ToolPath,
    settings: &LineSettings,
) -> Result<Vec<f64>, Shortfall> {
    let tight = settings.ik();
    let Some(q) = ik.follow(&way.at(b), last, &tight) else {
        let limit = ik.limiting_joint(&way.at(b), last, &tight);
        return Err(limit.map_or(Shortfall::Unreachable, |(j, name)| Shortfall::Limit(j, name)));
    };
    let jumps = q.iter().zip(last).map(|(x, y)| (x - y).abs()).enumerate();
    if let Some((j, by)) = jumps.max_by(|x, y| x.1.total_cmp(&y.1))
        && by > settings.jump
    {
        return Err(Shortfall::Jump { joint: kinematics.names()[j].clone(), by });
    }
    let middle: Vec<f64> = q.iter().zip(last).map(|(x, y)| 0.5 * (x + y)).collect();
    let (is, should) = (ik.pose(&middle), way.at(0.5 * (a + b)));
    let tilt = dimos_robot::kinematics::step::rotation_between(&is.matrix3, &should.matrix3).length();
    if is.translation.distance(should.translation) > settings.deviation || tilt > settings.tilt {
        return Err(Shortfall::Unreachable);
    }
    Ok(q)
}
