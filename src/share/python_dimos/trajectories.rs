//! A trajectory of Python dimos as one of the run.

use super::names::Names;
use super::pickle_node::{Class, Id, Pickled};
use super::pickle_reader::PickleError;
use crate::rpc::api::{Execute, MAX_LINE, Point, Trajectory};
use crate::share::thinning::thinned;

/// Largest number of points: more do not fit into a request to the run.
const MAX_POINTS: usize = 20_000;
/// Length in a request of a joint's position and velocity at a point, and its part of the rest [bytes].
const VALUE_BYTES: usize = 40;
/// Values are rounded to this: a request then holds 40 % more points [rad, rad/s].
const RESOLUTION: f64 = 1e-9;

/// Returns the request for a trajectory; the inner error is that of a trajectory that is not valid.
pub fn execute(pickled: &Pickled<'_>, id: Id, names: &Names) -> Result<Result<Execute, String>, PickleError> {
    let of_class = |name| pickled.attribute(id, Class::JointTrajectory, name);
    let joints = pickled.items(of_class("joint_names")?, "joint_names")?;
    let known = names.joints().count();
    if joints.is_empty() || joints.len() > known {
        return Ok(Err(format!("the trajectory names {} joints; the coordinator has {known}", joints.len())));
    }
    let mut joint_names = Vec::with_capacity(joints.len());
    for joint in joints {
        let theirs = pickled.text(*joint, "a name in joint_names")?;
        match names.ours(theirs) {
            Some(ours) => joint_names.push(ours.to_owned()),
            None => return Ok(Err(unknown(theirs, names))),
        }
    }
    let given = pickled.items(of_class("points")?, "points")?;
    if given.len() > MAX_POINTS {
        return Ok(Err(format!("the trajectory has {} points (limit {MAX_POINTS})", given.len())));
    }
    let mut points = Vec::with_capacity(given.len());
    for (at, point) in given.iter().enumerate() {
        match read_point(pickled, *point, joint_names.len())? {
            Ok(point) => points.push(point),
            Err(what) => return Ok(Err(format!("point {at}: {what}"))),
        }
    }
    // Python dimos samples positions on straight lines and ignores velocities; its messages fill in zeros where none
    // were given. With them the arm would rest at each point.
    let moves = |point: &Point| point.velocities.as_ref().is_some_and(|all| all.iter().any(|v| *v != 0.0));
    if !points.iter().any(moves) {
        points.iter_mut().for_each(|point| point.velocities = None);
    }
    if points.len() * joint_names.len() * VALUE_BYTES > MAX_LINE {
        points = thinned(points);
    }
    Ok(Ok(Execute { trajectory: Trajectory { joint_names, points }, task: None, retraces_to: None }))
}

fn read_point(pickled: &Pickled<'_>, id: Id, joints: usize) -> Result<Result<Point, String>, PickleError> {
    let of_point = |name| pickled.attribute(id, Class::TrajectoryPoint, name);
    let time_from_start = pickled.number(of_point("time_from_start")?, "time_from_start")?;
    if !time_from_start.is_finite() {
        return Ok(Err("time_from_start is not finite".to_owned()));
    }
    let values = |name: &'static str| -> Result<Result<Vec<f64>, String>, PickleError> {
        let list = of_point(name)?;
        let count = pickled.items(list, name)?.len();
        // Before it is copied: one long list may be that of many points.
        if count != joints && !(name == "velocities" && count == 0) {
            return Ok(Err(format!("{name} has {count} values for {joints} joints")));
        }
        let numbers = pickled.numbers(list, name)?;
        if numbers.iter().any(|value| !value.is_finite()) {
            return Ok(Err(format!("{name} has a value that is not finite")));
        }
        Ok(Ok(numbers.iter().map(|value| (value / RESOLUTION).round() * RESOLUTION).map(shortest).collect()))
    };
    let positions = match values("positions")? {
        Ok(positions) => positions,
        Err(what) => return Ok(Err(what)),
    };
    let velocities = match values("velocities")? {
        Ok(velocities) => Some(velocities).filter(|velocities| !velocities.is_empty()),
        Err(what) => return Ok(Err(what)),
    };
    Ok(Ok(Point { time_from_start, positions, velocities, accelerations: None }))
}

/// Returns the number with the fewest digits that is a multiple of the resolution.
fn shortest(value: f64) -> f64 {
    format!("{value:.9}").parse().unwrap_or(value)
}

fn unknown(joint: &str, names: &Names) -> String {
    let shown: String = joint.chars().take(80).collect();
    let known: Vec<&str> = names.joints().take(16).collect();
    format!("no joint is named `{shown}`; the joints are {}", known.join(", "))
}

#[cfg(test)]
mod tests {
    use super::super::pickle_reader::read;
    use super::super::pickle_writer::{Value, texts, write};
    use super::*;

    fn numbers(values: &[f64]) -> Value {
        Value::List(values.iter().map(|value| Value::Float(*value)).collect())
    }

    fn point(time: f64, positions: &[f64], velocities: &[f64]) -> Value {
        let fields = vec![
            ("time_from_start", Value::Float(time)),
            ("positions", numbers(positions)),
            ("velocities", numbers(velocities)),
        ];
        let state = Value::Tuple(vec![Value::None, Value::Dict(fields)]);
        Value::Object("dimos.msgs.trajectory_msgs.TrajectoryPoint", "TrajectoryPoint", Box::new(state))
    }

    fn read_whole(joints: &[&str], points: Vec<Value>) -> Result<Result<Execute, String>, PickleError> {
        let fields = vec![("joint_names", texts(joints)), ("points", Value::List(points))];
        let (module, state) = ("dimos.msgs.trajectory_msgs.JointTrajectory", Value::Dict(fields));
        let pickle = write(&Value::Object(module, "JointTrajectory", Box::new(state)));
        let joint = |number| (format!("arm_joint{number}"), format!("arm/joint{number}"));
        let names = Names { joints: vec![joint(1), joint(2)], ..Names::default() };
        let pickled = read(&pickle).unwrap();
        execute(&pickled, pickled.root(), &names)
    }

    #[test]
    fn velocities_are_left_out_only_if_all_are_zero() {
        let joints = ["arm/joint2", "arm/joint1"];
        let middle = |v: f64| {
            let points = vec![
                point(0.0, &[0.0, 1.0], &[0.0; 2]),
                point(1.0, &[0.1, 1.0], &[v, 0.0]),
                point(2.0, &[0.2, 1.0], &[]),
            ];
            read_whole(&joints, points).unwrap().unwrap().trajectory
        };
        let moving = middle(0.1);
        assert_eq!(moving.joint_names, ["arm_joint2", "arm_joint1"]);
        assert_eq!(moving.points[1].velocities, Some(vec![0.1, 0.0]));
        assert_eq!((moving.points[0].velocities.clone(), &moving.points[2].velocities), (Some(vec![0.0; 2]), &None));
        assert!(middle(0.0).points.iter().all(|point| point.velocities.is_none()));
    }

    #[test]
    fn numbers_are_short_in_the_request() {
        let points = vec![point(0.0, &[1.0 / 3.0], &[0.0]), point(1.0, &[-2.0e-13], &[0.0])];
        let execute = read_whole(&["arm/joint1"], points).unwrap().unwrap();
        let text = serde_json::to_string(&execute.trajectory.points).unwrap();
        assert!(text.contains("[0.333333333]") && text.contains("[-0.0]"), "{text}");
    }

    #[test]
    fn a_trajectory_that_is_not_valid_says_where() {
        let sound = || point(0.0, &[0.0], &[0.0]);
        for (joints, points, says) in [
            (vec!["arm/joint1", "elbow"], vec![], "no joint is named `elbow`; the joints are arm/joint1, arm/joint2"),
            (vec![], vec![sound()], "names 0 joints; the coordinator has 2"),
            (vec!["arm/joint1"; 3], vec![sound()], "names 3 joints"),
            (
                vec!["arm/joint1"],
                vec![sound(), point(1.0, &[0.0; 2], &[0.0])],
                "point 1: positions has 2 values for 1 joints",
            ),
            (
                vec!["arm/joint1"],
                vec![point(0.0, &[f64::NAN], &[0.0])],
                "point 0: positions has a value that is not finite",
            ),
            (vec!["arm/joint1"], vec![point(f64::INFINITY, &[0.0], &[])], "point 0: time_from_start is not finite"),
        ] {
            let refused = read_whole(&joints, points).unwrap().unwrap_err();
            assert!(refused.contains(says), "{refused}");
        }
        // What is no number is an error of the call.
        let odd = read_whole(&["arm/joint1"], vec![Value::None]).unwrap_err();
        assert!(odd.0.contains("the None has no `time_from_start`"), "{odd}");
    }
}
