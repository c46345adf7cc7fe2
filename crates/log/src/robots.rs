//! Robots in a log: their description, and the transforms of their links at the measured positions.
//!
//! Frames are named after links, joints of an arm as in the run. With several robots every link, and every joint that
//! is not an arm's, has the robot's name as a prefix: `left_link1`. All of them are in the frame `map`.

use nalgebra::{Isometry3, Vector3};

use super::display_messages::{TFMessage, Transform, TransformStamped};
use super::messages::{self, Header, Quaternion};
use dimos_core::arm::ArmState;
use dimos_robot::model::{Joint, JointKind, Limits, Link, Mimic, RobotModel};

/// The frame of all robots.
const MAP: &str = "map";

/// Limits of joints that have none. URDF has no infinities, and does not use these.
const UNLIMITED: Limits = Limits { lower: 0.0, upper: 0.0, velocity: 0.0, effort: 0.0, acceleration: None, jerk: None };

/// A robot of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct LoggedRobot {
    /// Its name.
    pub name: String,
    /// Its model.
    pub model: RobotModel,
    /// Pose of the model's root in `map`.
    pub root: Isometry3<f64>,
    /// Its joints in the run: index in the model, index over all arms' joints, and name in the run.
    pub joints: Vec<(usize, usize, String)>,
    /// Joints that other arms of the run move, in the same form.
    pub moved_by_others: Vec<(usize, usize, String)>,
    /// Positions of all joints of the model; those that are measured change [rad or m].
    pub rest: Vec<f64>,
    /// The joint that an arm's gripper drives.
    pub gripper: Option<LoggedGripper>,
    /// Index of the end-effector link.
    pub end_effector: usize,
}

/// The joint that a gripper drives.
#[derive(Debug, Clone, PartialEq)]
pub struct LoggedGripper {
    /// Index of the arm.
    pub arm: usize,
    /// Index of the joint in the model.
    pub joint: usize,
    /// Positions of the gripper when closed and when open, and those of the joint [m or rad].
    pub range: [(f64, f64); 2],
}

impl LoggedGripper {
    /// Returns the position of the joint at a position of the gripper.
    fn position(&self, gripper: f64) -> f64 {
        let [(closed, open), (from, to)] = self.range;
        let part = if open == closed { 1.0 } else { ((gripper - closed) / (open - closed)).clamp(0.0, 1.0) };
        from + (to - from) * part
    }
}

/// All robots of a run, with the names of a log.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct LoggedRobots {
    robots: Vec<LoggedRobot>,
}

impl LoggedRobots {
    /// Names links and joints. Leaves out a robot that shares a joint with an earlier one.
    pub fn new(robots: Vec<LoggedRobot>) -> Self {
        let mut all: Vec<LoggedRobot> = Vec::new();
        for robot in robots {
            let shared = |other: &LoggedRobot| other.joints.iter().any(|(_, a, _)| robot.has(*a));
            if !all.iter().any(shared) {
                all.push(robot);
            }
        }
        let prefixed = all.len() > 1 || all.iter().any(|robot| robot.model.link_index(MAP).is_some());
        for LoggedRobot { name, model, joints, .. } in &mut all {
            let links = model.links.iter_mut().map(|link| &mut link.name);
            for own in links.chain(model.joints.iter_mut().map(|joint| &mut joint.name)).filter(|_| prefixed) {
                *own = format!("{name}_{own}");
            }
            rename(model, joints.iter());
        }
        // One of them has the name; the others follow it in `combined`.
        let mut named: Vec<usize> = all.iter().flat_map(|robot| robot.joints.iter().map(|(_, own, _)| *own)).collect();
        for LoggedRobot { model, moved_by_others, .. } in &mut all {
            let first = moved_by_others.iter().filter(|(_, in_run, _)| !named.contains(in_run));
            rename(model, first);
            named.extend(moved_by_others.iter().map(|(_, in_run, _)| *in_run));
        }
        Self { robots: all }
    }

    /// Returns whether there are none.
    pub fn is_empty(&self) -> bool {
        self.robots.is_empty()
    }

    /// Returns all robots as one, with the root link `map`.
    pub fn combined(&self) -> RobotModel {
        let name = self.robots.first().map_or("", |robot| &robot.model.name).to_owned();
        let links = vec![Link { name: MAP.to_owned(), ..Link::default() }];
        let mut all = RobotModel { name, links, joints: Vec::new() };
        let mut moved_by_others = Vec::new();
        for robot in &self.robots {
            let (links, joints) = (all.links.len(), all.joints.len() + 1);
            moved_by_others.extend(robot.moved_by_others.iter().map(|(index, _, name)| (joints + index, name)));
            all.joints.push(Joint {
                name: format!("{MAP}_to_{}", robot.name),
                kind: JointKind::Fixed,
                parent: 0,
                child: links,
                origin: robot.root,
                axis: Vector3::z_axis(),
                limits: UNLIMITED,
                mimic: None,
            });
            all.links.extend(robot.model.links.iter().cloned());
            all.joints.extend(robot.model.joints.iter().cloned().map(|mut joint| {
                joint.parent += links;
                joint.child += links;
                joint.mimic.iter_mut().for_each(|mimic| mimic.leader += joints);
                if !joint.limits.lower.is_finite() || !joint.limits.upper.is_finite() {
                    (joint.limits.lower, joint.limits.upper) = (0.0, 0.0);
                }
                joint
            }));
        }
        // Several robots on one lift: a joint has one name, and one place.
        for (follower, name) in moved_by_others {
            let Some(leader) = all.joint_index(name).filter(|leader| *leader != follower) else { continue };
            for (index, joint) in all.joints.iter_mut().enumerate() {
                match &mut joint.mimic {
                    Some(mimic) if mimic.leader == follower => mimic.leader = leader,
                    mimic if index == follower => *mimic = Some(Mimic { leader, multiplier: 1.0, offset: 0.0 }),
                    _ => {}
                }
            }
        }
        all
    }

    /// Returns the frame of a robot's link.
    pub fn frame(&self, robot: &str, link: &str) -> Option<String> {
        let robot = self.robots.iter().find(|r| r.name == robot)?;
        let prefixed = format!("{}_{link}", robot.name);
        let mut names = robot.model.links.iter().map(|own| &own.name);
        names.find(|own| **own == link || **own == prefixed).cloned()
    }

    /// Returns the transforms that do not change.
    pub fn fixed(&self, stamp: &Header) -> TFMessage {
        let transform = |joint: &Joint, model: &RobotModel| transform(stamp, model, joint, joint.origin);
        let all = self.combined();
        let fixed = all.joints.iter().filter(|joint| !joint.is_movable());
        TFMessage { transforms: fixed.filter_map(|joint| transform(joint, &all)).collect() }
    }

    /// Returns the transforms at these positions of all arms' joints [rad], and the tool centre points; `tool` finds
    /// the tool of the robot with a joint. Robots with a joint whose position is unknown are left out.
    pub fn moved<'a>(
        &self,
        stamp: &Header,
        positions: &[f64],
        grippers: impl Fn(usize) -> Option<&'a ArmState>,
        tool: impl Fn(usize) -> Isometry3<f64>,
    ) -> TFMessage {
        let mut transforms = Vec::new();
        for robot in &self.robots {
            let mut q = robot.rest.clone();
            q.resize(robot.model.joints.len(), 0.0);
            let measured = robot.joints.iter().chain(&robot.moved_by_others);
            let measured = measured.map(|(joint, index, _)| (*joint, positions.get(*index).copied()));
            let known = measured.clone().all(|(_, position)| position.is_some_and(f64::is_finite));
            let Some((_, first, _)) = robot.joints.first().filter(|_| known) else { continue };
            let driven = robot.gripper.as_ref().and_then(|g| Some((g.joint, g.position(grippers(g.arm)?.gripper?))));
            for (joint, position) in measured.filter_map(|(joint, q)| Some((joint, q?))).chain(driven) {
                q.get_mut(joint).into_iter().for_each(|q| *q = position);
            }
            for (index, joint) in robot.model.joints.iter().enumerate().filter(|(_, joint)| joint.is_movable()) {
                let own = |index: usize| q.get(index).copied().unwrap_or(0.0);
                let at = joint.mimic.map_or_else(|| own(index), |m| m.multiplier * own(m.leader) + m.offset);
                transforms.extend(transform(stamp, &robot.model, joint, joint.transform(at)));
            }
            if let Some(link) = robot.model.links.get(robot.end_effector) {
                let tcp = format!("{}_tcp", robot.name);
                transforms.push(stamped(stamp, &link.name, tcp, tool(*first)));
            }
        }
        TFMessage { transforms }
    }

    /// Returns the joint that an arm's gripper drives: its name in the description, and its position at a position of
    /// the gripper.
    pub(super) fn driven(&self, arm: usize, gripper: f64) -> Option<(&str, f64)> {
        self.robots.iter().find_map(|robot| {
            let driven = robot.gripper.as_ref().filter(|driven| driven.arm == arm)?;
            Some((robot.model.joints.get(driven.joint)?.name.as_str(), driven.position(gripper)))
        })
    }
}

/// Gives joints the names that they have in the run.
fn rename<'a>(model: &mut RobotModel, joints: impl Iterator<Item = &'a (usize, usize, String)>) {
    for (index, _, in_run) in joints {
        model.joints.get_mut(*index).into_iter().for_each(|joint| joint.name.clone_from(in_run));
    }
}

impl LoggedRobot {
    fn has(&self, index: usize) -> bool {
        self.joints.iter().any(|(_, own, _)| *own == index)
    }
}

fn transform(stamp: &Header, model: &RobotModel, joint: &Joint, at: Isometry3<f64>) -> Option<TransformStamped> {
    let (parent, child) = (model.links.get(joint.parent)?, model.links.get(joint.child)?);
    Some(stamped(stamp, &parent.name, child.name.clone(), at))
}

fn stamped(stamp: &Header, parent: &str, child: String, at: Isometry3<f64>) -> TransformStamped {
    let ([x, y, z], turn) = (at.translation.vector.into(), at.rotation.coords);
    let rotation = Quaternion { x: turn.x, y: turn.y, z: turn.z, w: turn.w };
    let transform = Transform { translation: messages::Vector3 { x, y, z }, rotation };
    TransformStamped {
        header: Header { frame_id: parent.to_owned(), ..stamp.clone() },
        child_frame_id: child,
        transform,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn joint(name: &str, kind: JointKind, parent: usize, child: usize, mimic: Option<Mimic>) -> Joint {
        let axis = if kind == JointKind::Prismatic { Vector3::y_axis() } else { Vector3::z_axis() };
        Joint { name: name.into(), kind, parent, child, origin: Isometry3::identity(), axis, limits: UNLIMITED, mimic }
    }

    /// A beam that turns, and two fingers at its end, of which the right one follows the left one.
    fn tongs(name: &str, arm: usize) -> LoggedRobot {
        let link = |name: &str| Link { name: name.into(), ..Link::default() };
        let follows = Mimic { leader: 1, multiplier: -1.0, offset: 0.0 };
        let joints = vec![
            joint("turn", JointKind::Revolute, 0, 1, None),
            joint("finger", JointKind::Prismatic, 1, 2, None),
            joint("other", JointKind::Prismatic, 1, 3, Some(follows)),
        ];
        let links = ["base", "beam", "left", "right"].map(link).into();
        LoggedRobot {
            name: name.into(),
            model: RobotModel { name: "tongs".into(), links, joints },
            root: Isometry3::translation(0.0, arm as f64, 0.0),
            joints: vec![(0, arm, format!("{name}_joint1"))],
            moved_by_others: Vec::new(),
            rest: vec![0.0, 0.04, -0.04],
            gripper: Some(LoggedGripper { arm, joint: 1, range: [(0.0, 0.08), (0.0, 0.04)] }),
            end_effector: 1,
        }
    }

    /// The frames of a message: parent, child, and position.
    fn frames(message: &TFMessage) -> Vec<(&str, &str, [f64; 3])> {
        let transforms = message.transforms.iter();
        let at = |t: &Transform| [t.translation.x, t.translation.y, t.translation.z];
        transforms.map(|t| (&*t.header.frame_id, &*t.child_frame_id, at(&t.transform))).collect()
    }

    #[test]
    fn fingers_are_where_the_gripper_is_measured() {
        let robots = LoggedRobots::new(vec![tongs("arm", 0)]);
        let state = ArmState { gripper: Some(0.02), ..ArmState::default() };
        let message = robots.moved(&Header::default(), &[0.5], |_| Some(&state), |_| Isometry3::identity());
        let expected = [
            ("base", "beam", [0.0; 3]),
            ("beam", "left", [0.0, 0.01, 0.0]),
            ("beam", "right", [0.0, -0.01, 0.0]),
            ("beam", "arm_tcp", [0.0; 3]),
        ];
        assert_eq!(frames(&message), expected);
        assert_eq!(robots.driven(0, 0.08), Some(("finger", 0.04)));
        let unknown = robots.moved(&Header::default(), &[f64::NAN], |_| None, |_| Isometry3::identity());
        assert!(unknown.transforms.is_empty(), "its joint is not measured yet");
    }

    #[test]
    fn robots_on_one_lift_have_one_joint_for_it() {
        let on_a_lift = |name: &str, arm| {
            let mut robot = tongs(name, arm);
            robot.model.joints.push(joint("lift", JointKind::Prismatic, 3, 4, None));
            robot.model.links.push(Link { name: "top".into(), ..Link::default() });
            robot.moved_by_others = vec![(3, 2, "height".to_owned())];
            robot
        };
        let robots = LoggedRobots::new(vec![on_a_lift("left", 0), on_a_lift("right", 1)]);
        let all = robots.combined();
        let leader = all.joint_index("height").unwrap();
        let other = &all.joints[all.joint_index("right_lift").unwrap()];
        assert_eq!(other.mimic, Some(Mimic { leader, multiplier: 1.0, offset: 0.0 }));
        let moved =
            |height: f64| robots.moved(&Header::default(), &[0.0, 0.0, height], |_| None, |_| Isometry3::identity());
        let message = moved(0.3);
        let tops = frames(&message).into_iter().filter(|(_, child, _)| child.ends_with("top"));
        assert_eq!(tops.map(|(_, _, at)| at[1]).collect::<Vec<_>>(), [0.3, 0.3]);
        assert!(moved(f64::NAN).transforms.is_empty(), "the lift is not measured yet");
    }

    #[test]
    fn several_robots_have_frames_and_joints_of_their_own_in_one_description() {
        let shared = LoggedRobot { name: "same_joint".into(), ..tongs("left", 0) };
        let robots = LoggedRobots::new(vec![tongs("left", 0), tongs("right", 1), shared]);
        let all = robots.combined();
        let links: Vec<&str> = all.links.iter().map(|link| link.name.as_str()).collect();
        assert_eq!(links[..3], ["map", "left_base", "left_beam"]);
        assert_eq!((links.len(), links[5]), (9, "right_base"));
        let joints: Vec<&str> = all.joints.iter().map(|joint| joint.name.as_str()).collect();
        assert_eq!(joints[..4], ["map_to_left", "left_joint1", "left_finger", "left_other"]);
        assert_eq!(all.joints[7].mimic.map(|mimic| mimic.leader), Some(6), "right_other follows right_finger");
        assert!(all.joints.iter().enumerate().all(|(index, joint)| joint.child == index + 1));
        let fixed = robots.fixed(&Header::default());
        assert_eq!(frames(&fixed), [("map", "left_base", [0.0; 3]), ("map", "right_base", [0.0, 1.0, 0.0])]);
        assert_eq!(robots.frame("right", "beam").as_deref(), Some("right_beam"));
    }
}
