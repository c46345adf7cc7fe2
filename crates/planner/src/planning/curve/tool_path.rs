//! Curves of a tool: straight lines and arcs of a circle.

use glamx::{DAffine3, DQuat, DVec3};

use dimos_robot::kinematics::step::rotation_between;

/// Turns smaller than this have no axis [rad], and lengths no direction [m].
const SMALL: f64 = 1e-9;
/// Three points are in line if one is closer than this part of their distance to the line through the others.
const IN_LINE: f64 = 1e-6;

/// Why three points are not on one circle that can be followed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum ArcError {
    /// Two of them are the same.
    #[error("two of start, via point and goal are at the same place")]
    Same,
    /// The via point is in line with the others, but not between them.
    #[error("the via point is in line with start and goal, but not between them")]
    InLine,
}

/// A curve of a tool's pose: its position on a line or an arc, turning at the same time about one axis.
#[derive(Debug, Clone, PartialEq)]
pub struct ToolPath {
    from: DAffine3,
    to: DAffine3,
    arc: Option<Arc>,
    turns: [DQuat; 2],
}

#[derive(Debug, Clone, PartialEq)]
struct Arc {
    center: DVec3,
    /// From the centre to the start [m], and at right angles to it, in the direction of motion.
    axes: [DVec3; 2],
    /// Angle of the whole arc [rad].
    angle: f64,
}

impl ToolPath {
    /// Returns the straight line between two poses.
    pub fn line(from: DAffine3, to: DAffine3) -> Self {
        let turns = [from, to].map(|pose| DQuat::from_mat3(&pose.matrix3));
        Self { from, to, arc: None, turns }
    }

    /// Returns the arc from a pose through a point [m] to another pose; a line if the point is between them.
    pub fn arc(from: DAffine3, via: DVec3, to: DAffine3) -> Result<Self, ArcError> {
        let (a, b, c) = (from.translation, via, to.translation);
        let (ab, ac) = (b - a, c - a);
        let longest = ab.length().max(ac.length());
        if [ab, ac, c - b].iter().any(|side| side.length() <= IN_LINE * longest.max(SMALL)) {
            return Err(ArcError::Same);
        }
        let normal = ab.cross(ac);
        let line = Self::line(from, to);
        if normal.length() <= IN_LINE * longest * longest {
            return if ab.dot(c - b) > 0.0 { Ok(line) } else { Err(ArcError::InLine) };
        }
        // Centre of the circle through three points.
        let offset = (normal.cross(ab) * ac.length_squared() + ac.cross(normal) * ab.length_squared())
            / (2.0 * normal.length_squared());
        let (center, out) = (a + offset, -offset);
        let axes = [out, normal.normalize().cross(out)];
        let angle_of = |p: DVec3| {
            let angle = (p - center).dot(axes[1]).atan2((p - center).dot(axes[0]));
            if angle < 0.0 { angle + std::f64::consts::TAU } else { angle }
        };
        Ok(Self { arc: Some(Arc { center, axes, angle: angle_of(c) }), ..line })
    }

    /// Returns its length [m].
    pub fn length(&self) -> f64 {
        let line = self.from.translation.distance(self.to.translation);
        self.arc.as_ref().map_or(line, |arc| arc.angle * arc.axes[0].length())
    }

    /// Returns the angle by which the tool turns [rad].
    pub fn angle(&self) -> f64 {
        self.turns[0].angle_between(self.turns[1])
    }

    /// Returns the angle of its arc [rad]; 0 for a line.
    pub fn bend(&self) -> f64 {
        self.arc.as_ref().map_or(0.0, |arc| arc.angle)
    }

    /// Returns the pose at part `t` (0–1).
    pub fn at(&self, t: f64) -> DAffine3 {
        let position = match &self.arc {
            Some(Arc { center, axes: [x, y], angle }) => {
                let (sin, cos) = (angle * t).sin_cos();
                center + x * cos + y * sin
            }
            None => self.from.translation.lerp(self.to.translation, t),
        };
        DAffine3::from_rotation_translation(self.turns[0].slerp(self.turns[1], t), position)
    }

    /// Returns how far a pose close to part `t` is from the curve: position [m], and orientation at the nearest place
    /// [rad].
    pub fn deviation(&self, pose: &DAffine3, t: f64) -> [f64; 2] {
        let p = pose.translation;
        let along = self.to.translation - self.from.translation;
        let nearest = match &self.arc {
            Some(Arc { center, axes: [x, y], angle }) => {
                let at = (p - center).dot(*y).atan2((p - center).dot(*x));
                let turn = std::f64::consts::TAU;
                (at + ((angle * t - at) / turn).round() * turn) / angle
            }
            None if along.length() > SMALL => (p - self.from.translation).dot(along) / along.length_squared(),
            None => t,
        };
        let should = self.at(nearest.clamp(0.0, 1.0));
        let turned = rotation_between(&pose.matrix3, &should.matrix3).length();
        [p.distance(should.translation), turned]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(x: f64, y: f64) -> DAffine3 {
        DAffine3::from_translation(DVec3::new(x, y, 0.5))
    }

    #[test]
    fn an_arc_passes_its_three_points_on_one_circle() {
        // The short way and the long way round.
        for (via, bend) in [((0.5_f64.sqrt(), 0.5_f64.sqrt()), 0.5), ((0.0, -1.0), 1.5)] {
            let arc = ToolPath::arc(at(1.0, 0.0), at(via.0, via.1).translation, at(0.0, 1.0)).unwrap();
            assert!((arc.bend() - bend * std::f64::consts::PI).abs() < 1e-12, "{}", arc.bend());
            assert!((arc.length() - arc.bend()).abs() < 1e-12);
            let mut nearest = f64::INFINITY;
            for k in 0..=12 {
                let t = f64::from(k) / 12.0;
                let pose = arc.at(t);
                assert!((pose.translation.truncate().length() - 1.0).abs() < 1e-12);
                assert!(arc.deviation(&pose, t)[0] < 1e-12);
                nearest = nearest.min(pose.translation.distance(at(via.0, via.1).translation));
            }
            assert!(nearest < 1e-12 && arc.at(1.0).translation.distance(at(0.0, 1.0).translation) < 1e-12);
        }
        assert_eq!(ToolPath::arc(at(0.0, 0.0), at(1.0, 0.0).translation, at(1.0, 0.0)), Err(ArcError::Same));
        assert_eq!(ToolPath::arc(at(0.0, 0.0), at(0.5, 0.0).translation, at(1.0, 0.0)).map(|arc| arc.bend()), Ok(0.0));
        let beyond = ToolPath::arc(at(0.0, 0.0), at(2.0, 0.0).translation, at(1.0, 0.0));
        assert_eq!(beyond, Err(ArcError::InLine));
    }
}
