//! A goal of `FollowJointTrajectory`: its trajectory as one of the run, and its tolerances.

use crate::share::thinning::thinned;
use dimos_core::trajectory::{Cursor, JointTrajectory, Sample, Spline, TrajectoryPoint};
use dimos_log::display_messages::{Duration, JointTrajectoryPoint};
use dimos_log::messages::Time;
use dimos_log::node_messages::{FollowGoal, FollowResult, JointTolerance};
use dimos_rpc::api::{MAX_LINE, Point, Trajectory};

/// Time below which a point is at the start [s].
const AT_START: f64 = 1e-6;
/// Length in a request of a value at a point, and its part of the rest [bytes].
const VALUE_BYTES: usize = 28;

/// `error_code` of a result.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Code {
    /// It has arrived.
    Successful = 0,
    /// Refused by the run.
    InvalidGoal = -1,
    /// Not the joints of the task.
    InvalidJoints = -2,
    /// The whole trajectory is in the past.
    OldHeaderTimestamp = -3,
    /// It left the path, or ended before its end.
    PathToleranceViolated = -4,
    /// It arrived elsewhere.
    GoalToleranceViolated = -5,
}

/// How a goal ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Outcome {
    /// Its code.
    pub code: Code,
    /// The reason; empty for success.
    pub text: String,
    /// Whether it was cancelled.
    pub cancelled: bool,
}

impl Outcome {
    /// Creates one.
    pub fn new(code: Code, text: impl Into<String>) -> Self {
        Self { code, text: text.into(), cancelled: false }
    }

    /// Returns the message.
    pub fn message(&self) -> FollowResult {
        FollowResult { error_code: self.code as i32, error_string: self.text.clone() }
    }
}

/// Positions [rad] and velocities [rad/s] of joints, in their order; NaN for what is unknown.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Values {
    /// Positions.
    pub positions: Vec<f64>,
    /// Velocities.
    pub velocities: Vec<f64>,
}

/// How far a joint may deviate.
#[derive(Debug, Clone, PartialEq)]
struct Tolerance {
    /// Its index.
    joint: usize,
    /// [rad]; `None`: as far as the run allows.
    position: Option<f64>,
    /// [rad/s]
    velocity: Option<f64>,
}

/// A goal.
#[derive(Debug, Clone, PartialEq)]
pub struct Goal {
    /// Its joints.
    pub joints: Vec<String>,
    /// Its points.
    pub points: Vec<Point>,
    /// Its start [s since the Unix epoch]; 0: now.
    pub stamp: f64,
    /// Time that the joints may take to arrive after the end [s].
    pub late: f64,
    path: Vec<Tolerance>,
    end: Vec<Tolerance>,
    /// Whether its first point is not its own, but where the arm was.
    begun: bool,
}

impl Goal {
    /// Reads a goal; the error says why it is none.
    pub fn read(goal: FollowGoal) -> Result<Self, Outcome> {
        let invalid = |what: String| Outcome::new(Code::InvalidGoal, what);
        let trajectory = goal.trajectory;
        let (joints, others) = (trajectory.joint_names, goal.multi_dof_trajectory.joint_names);
        if let Some(joint) = others.first() {
            return Err(invalid(format!("{joint} has several degrees of freedom, which no joint of an arm has")));
        }
        if joints.is_empty() {
            return Err(invalid("the trajectory has no joints".into()));
        }
        let points = trajectory.points.into_iter().enumerate().map(|(at, point)| read_point(at, point, joints.len()));
        let points = points.collect::<Result<Vec<Point>, String>>().map_err(invalid)?;
        let read = |given: &[JointTolerance]| -> Result<Vec<Tolerance>, Outcome> {
            given.iter().map(|tolerance| read_tolerance(tolerance, &joints)).collect()
        };
        Ok(Self {
            points,
            stamp: seconds_at(&trajectory.header.stamp),
            late: seconds(&goal.goal_time_tolerance).max(0.0),
            path: read(&goal.path_tolerance)?,
            end: read(&goal.goal_tolerance)?,
            joints,
            begun: false,
        })
    }

    /// Returns the time of its last point [s].
    pub fn duration(&self) -> f64 {
        self.points.last().map_or(0.0, |point| point.time_from_start)
    }

    /// Returns whether its first point is later than its start: the motion then begins where the arm is.
    pub fn needs_start(&self) -> bool {
        self.points.first().is_some_and(|point| point.time_from_start > AT_START)
    }

    /// Begins at these positions, at rest.
    pub fn begin_at(&mut self, positions: Vec<f64>) {
        let Some(first) = self.points.first() else { return };
        let rest = |values: &Option<Vec<f64>>| values.as_ref().map(|values| vec![0.0; values.len()]);
        let (velocities, accelerations) = (rest(&first.velocities), rest(&first.accelerations));
        self.begun = true;
        self.points.insert(0, Point { time_from_start: 0.0, positions, velocities, accelerations });
    }

    /// Returns the trajectory for the run, with fewer points if they would not fit into a request.
    pub fn trajectory(&self) -> Trajectory {
        let mut points = self.points.clone();
        let values = |point: &Point| {
            let more = [&point.velocities, &point.accelerations];
            point.positions.len() + 1 + more.into_iter().flatten().map(Vec::len).sum::<usize>()
        };
        if points.iter().map(values).sum::<usize>() * VALUE_BYTES > MAX_LINE {
            points.iter_mut().for_each(|point| point.accelerations = None);
            points = thinned(points);
        }
        Trajectory { joint_names: self.joints.clone(), points }
    }

    /// Returns its curve, as the run executes it.
    pub fn curve(&self) -> Result<Curve, Outcome> {
        let point = |point: &Point| TrajectoryPoint {
            time_from_start: point.time_from_start,
            positions: point.positions[..].into(),
            velocities: point.velocities.as_deref().unwrap_or_default().into(),
            accelerations: point.accelerations.as_deref().unwrap_or_default().into(),
        };
        let trajectory =
            JointTrajectory { joint_names: self.joints.clone(), points: self.points.iter().map(point).collect() };
        let spline = Spline::new(&trajectory).map_err(|error| Outcome::new(Code::InvalidGoal, error.to_string()))?;
        let samples = vec![Sample::default(); spline.joints()];
        Ok(Curve { samples, spline, cursor: Cursor::default(), begun: self.begun })
    }

    /// Returns which joint is outside its tolerance on the way.
    pub fn off_path(&self, desired: &Values, actual: &Values) -> Option<String> {
        self.outside(&self.path, desired, actual)
    }

    /// Returns which joint is outside its tolerance at the end.
    pub fn off_goal(&self, desired: &Values, actual: &Values) -> Option<String> {
        self.outside(&self.end, desired, actual)
    }

    /// Returns which joint is outside its tolerance, and by how much; what is unknown is outside.
    fn outside(&self, tolerances: &[Tolerance], desired: &Values, actual: &Values) -> Option<String> {
        let exceeded = |limit: Option<f64>, a: Option<&f64>, b: Option<&f64>| {
            let error = (a? - b?).abs();
            limit.filter(|limit| error > *limit || error.is_nan()).map(|limit| (error, limit))
        };
        tolerances.iter().find_map(|Tolerance { joint, position, velocity }| {
            let name = self.joints.get(*joint)?;
            let of_position = exceeded(*position, desired.positions.get(*joint), actual.positions.get(*joint));
            let of_velocity = exceeded(*velocity, desired.velocities.get(*joint), actual.velocities.get(*joint));
            let (error, limit, unit) = match (of_position, of_velocity) {
                (Some((error, limit)), _) => (error, limit, "rad"),
                (None, Some((error, limit))) => (error, limit, "rad/s"),
                (None, None) => return None,
            };
            Some(format!("{name} was {error:.4} {unit} away (tolerance {limit})"))
        })
    }
}

/// The curve of a trajectory.
#[derive(Debug, Clone)]
pub struct Curve {
    spline: Spline,
    cursor: Cursor,
    samples: Vec<Sample>,
    begun: bool,
}

impl Curve {
    /// Returns the index in the goal of the point from which the motion comes at a time since the start [s].
    pub fn index(&self, time: f64) -> i32 {
        let passed = self.spline.times().partition_point(|point| *point <= time);
        passed.saturating_sub(1 + usize::from(self.begun)) as i32
    }

    /// Returns positions and velocities at a time since the start [s].
    pub fn at(&mut self, time: f64) -> Values {
        self.spline.sample(time, &mut self.cursor, &mut self.samples);
        let (positions, velocities) = self.samples.iter().map(|sample| (sample.position, sample.velocity)).unzip();
        Values { positions, velocities }
    }
}

fn read_point(at: usize, point: JointTrajectoryPoint, joints: usize) -> Result<Point, String> {
    if !point.effort.is_empty() {
        return Err(format!("point {at} has efforts: an arm is commanded by position"));
    }
    let all =
        [("positions", &point.positions), ("velocities", &point.velocities), ("accelerations", &point.accelerations)];
    for (name, values) in all {
        if values.len() != joints && (name == "positions" || !values.is_empty()) {
            return Err(format!("point {at}: {name} has {} values for {joints} joints", values.len()));
        }
    }
    let given = |values: Vec<f64>| Some(values).filter(|values| !values.is_empty());
    Ok(Point {
        time_from_start: seconds(&point.time_from_start),
        positions: point.positions,
        velocities: given(point.velocities),
        accelerations: given(point.accelerations),
    })
}

fn read_tolerance(given: &JointTolerance, joints: &[String]) -> Result<Tolerance, Outcome> {
    let Some(joint) = joints.iter().position(|joint| *joint == given.name) else {
        return Err(Outcome::new(Code::InvalidGoal, format!("a tolerance is for {}, which does not move", given.name)));
    };
    // 0 is the run's own, less than 0 none: the run applies its own in any case.
    let limit = |limit: f64| Some(limit).filter(|limit| *limit > 0.0);
    Ok(Tolerance { joint, position: limit(given.position), velocity: limit(given.velocity) })
}

fn seconds(duration: &Duration) -> f64 {
    f64::from(duration.sec) + f64::from(duration.nanosec) * 1e-9
}

fn seconds_at(time: &Time) -> f64 {
    f64::from(time.sec) + f64::from(time.nanosec) * 1e-9
}

#[cfg(test)]
mod tests {
    use super::*;

    fn goal(points: Vec<(f64, Vec<f64>, Vec<f64>)>) -> FollowGoal {
        let point = |(time, positions, velocities)| JointTrajectoryPoint {
            positions,
            velocities,
            time_from_start: Duration::of(time),
            ..JointTrajectoryPoint::default()
        };
        let mut goal = FollowGoal::default();
        goal.trajectory.joint_names = vec!["a".into()];
        goal.trajectory.points = points.into_iter().map(point).collect();
        goal
    }

    #[test]
    fn a_later_first_point_begins_where_the_arm_is() {
        let mut read = Goal::read(goal(vec![(2.0, vec![1.0], vec![0.0])])).unwrap();
        assert!(read.needs_start());
        read.begin_at(vec![0.5]);
        assert!(!read.needs_start());
        let mut curve = read.curve().unwrap();
        assert_eq!(curve.at(0.0).positions, [0.5]);
        assert_eq!((curve.index(0.0), curve.index(1.0), curve.index(2.0)), (0, 0, 0));
        assert!(
            (curve.at(1.0).positions[0] - 0.75).abs() < 1e-12 && (curve.at(1.0).velocities[0] - 0.375).abs() < 1e-12
        );
        assert_eq!(read.trajectory().points[0].velocities, Some(vec![0.0]));
    }

    #[test]
    fn tolerances_are_of_joints_and_zero_is_the_runs_own() {
        let mut given = goal(vec![(0.0, vec![0.0], vec![]), (1.0, vec![1.0], vec![])]);
        let tolerance = |position| JointTolerance { name: "a".into(), position, ..JointTolerance::default() };
        given.path_tolerance = vec![tolerance(0.1)];
        given.goal_tolerance = vec![tolerance(0.0)];
        let read = Goal::read(given.clone()).unwrap();
        let at = |position: f64| Values { positions: vec![position], velocities: vec![0.0] };
        assert_eq!(read.off_path(&at(1.0), &at(0.95)), None);
        assert_eq!(read.off_path(&at(1.0), &at(0.8)).unwrap(), "a was 0.2000 rad away (tolerance 0.1)");
        assert!(read.off_path(&at(1.0), &at(f64::NAN)).is_some());
        assert_eq!(read.off_goal(&at(1.0), &at(0.0)), None);
        given.path_tolerance[0].name = "b".into();
        assert!(Goal::read(given).unwrap_err().text.contains("a tolerance is for b"));
    }

    #[test]
    fn points_have_a_position_for_each_joint() {
        let wrong = |points| Goal::read(goal(points)).unwrap_err().text;
        assert_eq!(wrong(vec![(0.0, vec![], vec![])]), "point 0: positions has 0 values for 1 joints");
        assert_eq!(wrong(vec![(0.0, vec![0.0], vec![1.0, 2.0])]), "point 0: velocities has 2 values for 1 joints");
        let mut other = goal(vec![(0.0, vec![0.0], vec![])]);
        other.multi_dof_trajectory.joint_names = vec!["base".into()];
        assert!(Goal::read(other).unwrap_err().text.starts_with("base has several degrees of freedom"));
        let equal = Goal::read(goal(vec![(0.0, vec![0.0], vec![]), (0.0, vec![1.0], vec![])])).unwrap();
        assert!(equal.curve().unwrap_err().text.contains("not later"));
    }

    #[test]
    fn a_long_trajectory_fits_into_a_request() {
        let point = |index: usize| {
            let t = index as f64 * 0.01;
            (t, vec![(0.7 * t).sin()], vec![0.7 * (0.7 * t).cos()])
        };
        let read = Goal::read(goal((0..6000).map(point).collect())).unwrap();
        let fits = serde_json::to_string(&read.trajectory()).unwrap().len();
        assert!(fits < MAX_LINE, "{fits}");
    }
}
