//! Converts logged requests back to requests: the inverse of `runtime::client::dispatch`.

use serde::{Deserialize, Deserializer};

use dimos_control::request::{Goal, Motion, Request};
use dimos_control::task_robot::FramePose;
use dimos_core::clock::Mono;
use dimos_core::joint::{Joints, joints_of};
use dimos_core::telemetry::{LedBy, Origin};
use dimos_core::trajectory::{JointTrajectory, Spline};
use dimos_core::until::Until;

/// A message of `/dimos/requests`.
#[derive(Debug, Deserialize)]
struct RequestMessage {
    id: u64,
    /// Missing in logs of earlier versions, and for requests that move nothing.
    #[serde(default)]
    origin: Option<Origin>,
    request: LoggedRequest,
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "snake_case")]
enum LoggedRequest {
    Execute {
        task: u16,
        motion: u64,
        trajectory: JointTrajectory,
        #[serde(default)]
        until: Option<Until>,
    },
    Cancel {
        task: Option<u16>,
    },
    WayBlocked {
        task: u16,
        motion: u64,
        in_time: bool,
    },
    Servo {
        task: u16,
        target: Vec<Option<f64>>,
    },
    Velocity {
        task: u16,
        target: Vec<Option<f64>>,
    },
    Chunk {
        task: u16,
        start: u64,
        trajectory: JointTrajectory,
    },
    Pose {
        task: u16,
        position: [Option<f64>; 3],
        orientation: [Option<f64>; 4],
    },
    Twist {
        task: u16,
        linear: [Option<f64>; 3],
        angular: [Option<f64>; 3],
        tool: bool,
    },
    Tool {
        task: u16,
        position: [Option<f64>; 3],
        orientation: [Option<f64>; 4],
    },
    ArmTool {
        arm: u16,
        position: [Option<f64>; 3],
        orientation: [Option<f64>; 4],
    },
    Start {
        task: u16,
    },
    Stop {
        arm: Option<u16>,
    },
    Reset {
        arm: u16,
    },
    Ready {
        arm: u16,
        #[serde(default)]
        outside: bool,
    },
    Park {
        arm: u16,
    },
    EndNative {
        arm: u16,
    },
    Lead {
        arm: u16,
        by: LedBy,
    },
    Gripper {
        arm: u16,
        opening: Option<f64>,
        #[serde(default, deserialize_with = "present")]
        force: Option<f64>,
        #[serde(default, deserialize_with = "present")]
        speed: Option<f64>,
    },
    Speed {
        fraction: Option<f64>,
    },
    Pause {
        on: bool,
    },
    LeaseTaken {
        arm: u16,
        client: u64,
    },
    LeaseEnded {
        arm: u16,
        client: u64,
    },
    Shutdown {},
}

/// Reads a number that is there: null is one that was not finite.
fn present<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<f64>, D::Error> {
    Option::<f64>::deserialize(deserializer).map(|value| Some(value.unwrap_or(f64::NAN)))
}

/// The id of any request.
#[derive(Debug, Deserialize)]
struct Id {
    id: u64,
}

/// Origin and contents of a request, or why they are unreadable.
pub type Contents = Result<(Option<Origin>, Request), String>;

/// Reads a request with its id and its origin. `joints` are the names of all joints, arm by arm. The inner result fails
/// if only the contents are unreadable.
pub fn read(json: &str, joints: &[String]) -> Result<(u64, Contents), String> {
    match serde_json::from_str::<RequestMessage>(json) {
        Ok(line) => Ok((line.id, request(line.request, joints).map(|request| (line.origin, request)))),
        Err(e) => match serde_json::from_str::<Id>(json) {
            Ok(Id { id }) => Ok((id, Err(e.to_string()))),
            Err(e) => Err(e.to_string()),
        },
    }
}

fn request(logged: LoggedRequest, joints: &[String]) -> Result<Request, String> {
    Ok(match logged {
        LoggedRequest::Execute { task, motion, trajectory, until } => {
            let motion = along(motion, &trajectory, joints)?;
            Request::Execute { task, motion: Box::new(Motion { until, ..*motion }) }
        }
        LoggedRequest::Chunk { task, start, trajectory } => {
            Request::Chunk { task, start: Mono(start), motion: along(0, &trajectory, joints)? }
        }
        LoggedRequest::Cancel { task } => Request::Cancel { task },
        LoggedRequest::WayBlocked { task, motion, in_time } => Request::WayBlocked { task, motion, in_time },
        LoggedRequest::Servo { task, target } => Request::Servo { task, target: values(&target) },
        LoggedRequest::Velocity { task, target } => Request::Velocity { task, target: values(&target) },
        LoggedRequest::Pose { task, position, orientation } => {
            let goal = Goal::Pose { position: numbers(position), orientation: numbers(orientation) };
            Request::CartesianTarget { task, goal }
        }
        LoggedRequest::Twist { task, linear, angular, tool } => {
            let goal = Goal::Twist { linear: numbers(linear), angular: numbers(angular), tool };
            Request::CartesianTarget { task, goal }
        }
        LoggedRequest::Tool { task, position, orientation } => {
            let tool = FramePose { position: numbers(position), orientation: numbers(orientation) };
            Request::Tool { task, tool }
        }
        LoggedRequest::ArmTool { arm, position, orientation } => {
            let tool = FramePose { position: numbers(position), orientation: numbers(orientation) };
            Request::ArmTool { arm, tool }
        }
        LoggedRequest::Start { task } => Request::Start { task },
        LoggedRequest::Stop { arm } => Request::Stop { arm },
        LoggedRequest::Reset { arm } => Request::Reset { arm },
        LoggedRequest::Ready { arm, outside } => Request::Enabled { arm, outside },
        LoggedRequest::Park { arm } => Request::PrepareDisable { arm },
        LoggedRequest::EndNative { arm } => Request::EndNative { arm },
        LoggedRequest::Lead { arm, by } => Request::Lead { arm, by },
        LoggedRequest::Gripper { arm, opening, force, speed } => {
            Request::Gripper { arm, opening: opening.unwrap_or(f64::NAN), force, speed }
        }
        LoggedRequest::Speed { fraction } => Request::Speed { fraction: fraction.unwrap_or(f64::NAN) },
        LoggedRequest::Pause { on } => Request::Pause { on },
        LoggedRequest::LeaseTaken { arm, client } => Request::LeaseTaken { arm, client },
        LoggedRequest::LeaseEnded { arm, client } => Request::LeaseEnded { arm, client },
        LoggedRequest::Shutdown {} => Request::Shutdown,
    })
}

fn along(id: u64, trajectory: &JointTrajectory, joints: &[String]) -> Result<Box<Motion>, String> {
    let spline = Spline::new(trajectory).map_err(|e| e.to_string())?;
    let index = |name: &String| joints.iter().position(|j| j == name).map(|j| j as u16);
    let found: Option<Vec<u16>> = trajectory.joint_names.iter().map(index).collect();
    let joints = found.ok_or("the trajectory has a joint that no arm has")?;
    Ok(Box::new(Motion { id, joints, spline, until: None }))
}

/// JSON has no infinities and no NaN: values that were not finite are null. The tick rejects the request all the same.
fn values(logged: &[Option<f64>]) -> Joints {
    let values: Vec<f64> = logged.iter().map(|v| v.unwrap_or(f64::NAN)).collect();
    joints_of(&values)
}

fn numbers<const N: usize>(logged: [Option<f64>; N]) -> [f64; N] {
    logged.map(|v| v.unwrap_or(f64::NAN))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::runtime::log_of;
    use dimos_core::trajectory::TrajectoryPoint;

    /// Reading and logging a request again gives the same text.
    #[test]
    fn every_request_is_read_as_it_was_logged() {
        let target = joints_of(&[0.1 + 0.2, -0.0, f64::MIN_POSITIVE, 1e300, std::f64::consts::PI]);
        for request in [
            Request::Cancel { task: None },
            Request::Cancel { task: Some(3) },
            Request::WayBlocked { task: 3, motion: 7, in_time: true },
            Request::Servo { task: 1, target },
            Request::Velocity { task: 2, target },
            Request::Start { task: 3 },
            Request::CartesianTarget {
                task: 3,
                goal: Goal::Pose { position: [0.1 + 0.2, -0.0, 1e-300], orientation: [f64::NAN, 0.0, 0.6, 0.8] },
            },
            Request::CartesianTarget {
                task: 4,
                goal: Goal::Twist { linear: [0.1 + 0.2, -0.0, 1e300], angular: [0.0, f64::NAN, 1.0], tool: true },
            },
            Request::Tool {
                task: 5,
                tool: FramePose { position: [0.1 + 0.2, -0.0, 0.12], orientation: [0.0, f64::NAN, 0.6, 0.8] },
            },
            Request::ArmTool {
                arm: 1,
                tool: FramePose { position: [0.1 + 0.2, -0.0, 0.12], orientation: [0.0, f64::NAN, 0.6, 0.8] },
            },
            Request::Stop { arm: None },
            Request::Stop { arm: Some(1) },
            Request::Reset { arm: 1 },
            Request::Enabled { arm: 0, outside: false },
            Request::Enabled { arm: 1, outside: true },
            Request::PrepareDisable { arm: 2 },
            Request::EndNative { arm: 1 },
            Request::Lead { arm: 1, by: LedBy::HandMotorsOff },
            Request::Gripper { arm: 1, opening: 0.1 + 0.2, force: None, speed: None },
            Request::Gripper { arm: 1, opening: -0.1 - 0.2, force: Some(0.1 + 0.2), speed: None },
            Request::Gripper { arm: 0, opening: 0.04, force: Some(f64::NAN), speed: Some(0.1 + 0.2) },
            Request::Speed { fraction: 0.1 + 0.2 },
            Request::Pause { on: true },
            Request::LeaseTaken { arm: 1, client: 7 },
            Request::LeaseEnded { arm: 1, client: 7 },
            Request::Shutdown,
        ] {
            let logged = log_of(&request);
            let origin = Origin { epoch: 3, client: 5 };
            let line = json!({"id": 7, "origin": origin, "request": logged}).to_string();
            let (id, again) = read(&line, &[]).unwrap();
            let (from, again) = again.unwrap();
            assert_eq!((id, from), (7, Some(origin)));
            // Debug output shows every bit of a number, and the sign of zero.
            assert_eq!(format!("{again:?}"), format!("{request:?}"));
        }
    }

    #[test]
    fn a_trajectory_makes_the_same_curve_again() {
        let point = |t: f64, q: f64, v: f64| TrajectoryPoint {
            time_from_start: t,
            positions: vec![q, -q / 3.0].into(),
            velocities: vec![v, 0.1 + v].into(),
            accelerations: Default::default(),
        };
        let points = vec![point(0.0, 0.1, 0.0), point(1.0 / 3.0, 0.2, 0.7), point(0.7, 0.3, 0.0)];
        let trajectory = JointTrajectory { joint_names: vec!["b".into(), "a".into()], points };
        let logged = json!({"id": 9, "request": {"execute": {"task": 1, "motion": 5, "trajectory": trajectory}}});
        let names = ["a".to_owned(), "b".to_owned()];
        let (_, request) = read(&logged.to_string(), &names).unwrap();
        let Ok((None, Request::Execute { task: 1, motion })) = request else { panic!("{request:?}") };
        assert_eq!(
            *motion,
            Motion { id: 5, joints: vec![1, 0], spline: Spline::new(&trajectory).unwrap(), until: None }
        );
        let chunk = json!({"id": 9, "request": {"chunk": {"task": 1, "start": 7, "trajectory": trajectory}}});
        let (_, request) = read(&chunk.to_string(), &names).unwrap();
        let Ok((None, Request::Chunk { task: 1, start: Mono(7), motion })) = request else { panic!("{request:?}") };
        assert_eq!(
            *motion,
            Motion { id: 0, joints: vec![1, 0], spline: Spline::new(&trajectory).unwrap(), until: None }
        );
        let (_, unknown) = read(&logged.to_string(), &names[..1]).unwrap();
        assert!(unknown.unwrap_err().contains("joint"));
    }

    #[test]
    fn unreadable_requests_are_reported() {
        assert!(read("{", &[]).is_err());
        let (id, unknown) = read(r#"{"id":4,"request":{"dance":{}}}"#, &[]).unwrap();
        assert!(id == 4 && unknown.unwrap_err().contains("dance"));
    }
}
