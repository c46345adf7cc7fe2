//! Streams of jog: the tasks it can stream to, and the next target.

use std::time::{Duration, Instant};

use super::link;
use crate::cli::exit::{Failure, Result};
use crate::cli::lasting;
use dimos_rpc::api::{Cancel, Servo, Twist, TwistFrame, Velocity};
use dimos_rpc::client::{Client, ClientError};
use dimos_rpc::report::{ArmReport, ArmStateReport, TaskReport};

/// Maximum lead of a servo target over its joint [rad], so that it does not wind up when the arm is blocked.
const MAX_LEAD: f64 = 0.15;
/// Distance of commands from a joint's limits [rad].
const MARGIN: f64 = 0.01;

/// Type of a task for jog.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// An `eef_twist` task: the end effector.
    Twist,
    /// A velocity task.
    Velocity,
    /// A servo task: jog integrates positions.
    Servo,
}

/// A task to stream to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Drive {
    /// Its type.
    pub kind: Kind,
    /// Its name.
    pub task: String,
    /// Its joints.
    pub joints: Vec<String>,
}

/// The tasks that move an arm.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Drives {
    /// For the end effector.
    pub tool: Option<Drive>,
    /// For single joints.
    pub joints: Option<Drive>,
}

impl Drives {
    /// Returns the tasks of a run that move joints of only this arm, the one with the highest priority of each type.
    /// Prefers a velocity task to a servo task, whose targets jog has to integrate.
    pub fn of(tasks: &[TaskReport], joints: &[String]) -> Self {
        let find = |method: &str, kind: Kind| {
            let ours = |task: &&TaskReport| {
                task.takes(method) && !task.joints.is_empty() && task.joints.iter().all(|joint| joints.contains(joint))
            };
            let task = tasks.iter().filter(ours).max_by_key(|task| task.priority)?;
            Some(Drive { kind, task: task.name.clone(), joints: task.joints.clone() })
        };
        let single = find("velocity", Kind::Velocity).or_else(|| find("servo", Kind::Servo));
        Self { tool: find("twist", Kind::Twist), joints: single }
    }

    /// Returns the task for a mode.
    pub fn get(&self, joint_mode: bool) -> Option<&Drive> {
        if joint_mode { self.joints.as_ref() } else { self.tool.as_ref() }
    }

    /// Returns the failure of an arm without such a task, with the lines to add.
    pub fn missing(arm: &str) -> Failure {
        let what = format!("no task of the run can be jogged on {arm}");
        let lines = format!("{}\n        {}", line(arm, true), line(arm, false));
        Failure::usage(what).hint(format!("add to `tasks` of the blueprint, and restart the run:\n        {lines}"))
    }
}

/// Returns the line to add to a blueprint's tasks, for a mode.
pub fn line(arm: &str, joint_mode: bool) -> String {
    match joint_mode {
        // Every arm takes positions.
        true => format!("- {{name: servo_{arm}, type: servo, joint_names: {{hardware: {arm}}}, priority: 20}}"),
        false => format!(
            "- {{name: twist_{arm}, type: eef_twist, joint_names: {{hardware: {arm}}}, priority: 21, params: \
             {{model_path: MODEL, end_effector_link: LINK, joint_prefix: {arm}_}}}}\n        \
             # MODEL and LINK: the arm's own description, a file or builtin:NAME, and its flange in it; `params` can be \
             left out where the blueprint has a planner for the arm"
        ),
    }
}

/// A requested motion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Demand {
    /// Of the end effector: x, y, z [m/s], about x, y, z [rad/s].
    Tool([f64; 3], [f64; 3], TwistFrame),
    /// Of the task's joint with this index [rad/s].
    Joint(usize, f64),
}

/// State and limits of the arm, for servo targets.
#[derive(Debug, Clone, Copy)]
pub struct ArmView<'a> {
    /// Joint states.
    pub state: Option<&'a ArmStateReport>,
    /// Joint limits.
    pub arm: Option<&'a ArmReport>,
}

/// A stream to one task.
#[derive(Debug)]
pub struct Stream {
    drive: Drive,
    /// Latest servo targets [rad] and their time.
    targets: Vec<f64>,
    sent: Option<Instant>,
}

impl Stream {
    /// Creates a stream that has not begun.
    pub fn new(drive: Drive) -> Self {
        Self { drive, targets: Vec::new(), sent: None }
    }

    /// Returns its task.
    pub fn drive(&self) -> &Drive {
        &self.drive
    }

    /// Sends the next target.
    pub fn send(&mut self, client: &mut Client, demand: Demand, view: ArmView<'_>, now: Instant) -> Sent {
        let task = self.drive.task.clone();
        let width = self.drive.joints.len();
        match (self.drive.kind, demand) {
            (Kind::Twist, Demand::Tool(linear, angular, frame)) => {
                client.call(Twist { task, linear, angular, frame })?;
            }
            (Kind::Velocity, Demand::Joint(index, speed)) => {
                let velocities = (0..width).map(|k| if k == index { speed } else { 0.0 }).collect();
                client.call(Velocity { task, velocities })?;
            }
            (Kind::Servo, Demand::Joint(index, speed)) => {
                let passed = self.sent.map_or(Duration::ZERO, |at| now.saturating_duration_since(at));
                if let Some(positions) = self.advance(index, speed, passed, view) {
                    client.call(Servo::new(task, positions))?;
                }
            }
            _ => {}
        }
        self.sent = Some(now);
        Ok(())
    }

    /// Sends a target at rest: zero, for a task that follows velocities. A servo task rests at its last target.
    pub fn rest(&self, client: &mut Client) -> Sent {
        let task = self.drive.task.clone();
        match self.drive.kind {
            Kind::Twist => {
                client.call(Twist { task, linear: [0.0; 3], angular: [0.0; 3], frame: TwistFrame::Base })?;
            }
            Kind::Velocity => {
                client.call(Velocity { task, velocities: vec![0.0; self.drive.joints.len()] })?;
            }
            Kind::Servo => {}
        }
        Ok(())
    }

    /// Ends the task: its joints decelerate to rest and become free for other tasks.
    pub fn end(&self, client: &mut Client) -> Sent {
        client.call(Cancel { task: Some(self.drive.task.clone()), ..Cancel::default() })?;
        Ok(())
    }

    /// Returns the next servo targets: the commanded positions, integrated over the time since the previous target.
    fn advance(&mut self, index: usize, speed: f64, passed: Duration, view: ArmView<'_>) -> Option<Vec<f64>> {
        let seen = |name: &String| view.state?.joints.iter().find(|joint| joint.name == *name);
        if self.targets.is_empty() {
            // In another mode a command is not a position.
            let positions = view.arm.is_some_and(|arm| arm.mode.ends_with("position"));
            let from = |name: &String| seen(name).and_then(|j| j.command.filter(|_| positions).or(j.position));
            self.targets = self.drive.joints.iter().map(from).collect::<Option<_>>()?;
        }
        let name = self.drive.joints.get(index)?;
        let measured = seen(name)?.position?;
        let place = view.state?.joints.iter().position(|joint| joint.name == *name)?;
        let target = self.targets.get_mut(index)?;
        let next = (*target + speed * passed.as_secs_f64()).clamp(measured - MAX_LEAD, measured + MAX_LEAD);
        // A joint that starts outside its limits may move back in.
        let limits = view
            .arm
            .and_then(|arm| arm.position_limits.get(place))
            .map_or((f64::MIN, f64::MAX), |[l, u]| ((l + MARGIN).min(*target), (u - MARGIN).max(*target)));
        *target = next.max(limits.0).min(limits.1);
        Some(self.targets.clone())
    }
}

/// Result of a request.
pub type Sent = std::result::Result<(), ClientError>;

/// Returns the text of a refusal for the screen; other errors end jog.
pub fn refusal(sent: Sent) -> Result<Option<String>> {
    match sent {
        Ok(()) => Ok(None),
        Err(error) if lasting::is_lost(&error) => Err(link::lost(error)),
        Err(ClientError::Refused(error)) => Ok(Some(match error.hint {
            Some(hint) => format!("{}; {hint}", error.message),
            None => error.message,
        })),
        Err(lost) => Err(lost.into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_rpc::report::JointReport;

    fn task(name: &str, takes: &str, joints: &[&str], priority: i32) -> TaskReport {
        let joints = joints.iter().map(|j| (*j).to_owned()).collect();
        TaskReport { name: name.into(), takes: vec![takes.into()], joints, priority, ..Default::default() }
    }

    #[test]
    fn tasks_of_this_arm_alone_are_taken_and_velocity_goes_before_servo() {
        let arm = ["a".to_owned(), "b".to_owned()];
        let both = task("both", "velocity", &["a", "b", "other"], 90);
        let servo = task("servo", "servo", &["a", "b"], 50);
        let (low, high) = (task("low", "velocity", &["a"], 10), task("high", "velocity", &["a", "b"], 20));
        let drives = Drives::of(&[both.clone(), servo.clone(), low, high, task("t", "twist", &["a"], 1)], &arm);
        assert_eq!(drives.joints.unwrap().task, "high");
        assert_eq!(drives.tool.unwrap().task, "t");
        let drives = Drives::of(&[both, servo], &arm);
        assert_eq!((drives.joints.unwrap().kind, drives.tool), (Kind::Servo, None));
        assert_eq!(Drives::of(&[task("traj", "execute", &["a", "b"], 10)], &arm), Drives::default());
    }

    fn state(positions: [f64; 2]) -> ArmStateReport {
        let joint = |(name, position): (&str, f64)| JointReport {
            name: name.into(),
            position: Some(position),
            command: Some(position + 0.02),
            ..Default::default()
        };
        ArmStateReport { joints: ["a", "b"].into_iter().zip(positions).map(joint).collect(), ..Default::default() }
    }

    #[test]
    fn servo_targets_begin_at_the_command_and_stay_near_the_arm_and_inside_its_limits() {
        let drive = Drive { kind: Kind::Servo, task: "s".into(), joints: vec!["a".into(), "b".into()] };
        let mut stream = Stream::new(drive);
        let arm = ArmReport {
            mode: "servo_position".into(),
            position_limits: vec![[-1.0, 1.0], [-0.2, 0.2]],
            ..Default::default()
        };
        let (state, tenth) = (state([0.5, 0.1]), Duration::from_millis(100));
        let view = ArmView { state: Some(&state), arm: Some(&arm) };
        let mut step = |index, speed, passed| stream.advance(index, speed, passed, view).unwrap();
        let near = |got: &[f64], want: [f64; 2]| got.iter().zip(want).all(|(a, b)| (a - b).abs() < 1e-12);
        let first = step(0, 0.5, Duration::ZERO);
        assert!(near(&first, [0.52, 0.12]), "{first:?}");
        let next = step(0, 0.5, tenth);
        assert!(near(&next, [0.57, 0.12]), "{next:?}");
        let ahead = step(0, 0.5, 10 * tenth);
        assert!(near(&ahead, [0.65, 0.12]), "no more than {MAX_LEAD} ahead: {ahead:?}");
        let limited = step(1, 0.5, 10 * tenth);
        assert!(near(&limited, [0.65, 0.19]), "{limited:?}");
        let back = step(1, -0.5, tenth);
        assert!(near(&back, [0.65, 0.14]), "{back:?}");
        let blind = ArmView { state: None, arm: Some(&arm) };
        assert_eq!(stream.advance(0, 0.5, tenth, blind), None, "without a state there is no target");
    }
}
