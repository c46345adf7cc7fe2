//! From what robots shall do to configurations that do it.

use super::cartesian::{LineSettings, straight_line};
use super::ik::{Ik, IkSettings};
use super::padded::Place;
use super::path::Path;
use super::setup::PlannedRobot;
use super::solve::{Failure, Goal, Stage, late};
use crate::collision::{CollisionChecker, Stop};
use crate::robot::kinematics::frame;
use crate::robot::model::JointKind;
use glamx::DAffine3;

/// Different solutions that are looked for when one robot goes to a pose.
const SOLUTIONS: usize = 8;
/// Attempts to find them.
const ATTEMPTS: usize = 200;
/// How closely a pose goal is reached [m, rad].
const CLOSE: f64 = 1e-5;
/// A straight line that ends so close to its end is whole.
const WHOLE: f64 = 1.0 - 1e-9;

/// Configurations of all moving robots that are goals of the search. Where a robot goes to a pose there are several. Of
/// one robot they are free, where any is; else the search says what touches.
pub(super) fn configurations(
    stage: &mut Stage<'_>,
    wanted: &[(usize, Goal)],
    seed: u64,
    stop: &Stop,
) -> Result<Path, Failure> {
    // One list of configurations per robot; a combination of one from each is a goal of all.
    let mut all: Path = vec![Vec::new()];
    let mut first = 0;
    let alone = stage.robots.len() == 1;
    for (robot, index) in stage.robots.iter().zip(&stage.indices) {
        let own = stage.start.get(first..first + robot.joints.len()).unwrap_or_default().to_vec();
        first += robot.joints.len();
        let goal = wanted.iter().find(|(wanted, _)| wanted == index).map(|(_, goal)| goal);
        let checker = &mut stage.checker;
        let mut free =
            |q: &[f64], padded: bool| !alone || if padded { checker.is_free(q) } else { checker.touches_nothing(q) };
        let several = match goal {
            Some(Goal::Joints(values)) => {
                // Where the model lets a joint turn without end, but the arm does not, whole turns are the same goal.
                let mut near = values.clone();
                robot.body.kinematics.unwind(&mut near, &own, |kind| kind == JointKind::Continuous);
                vec![near]
            }
            Some(Goal::Pose(pose)) => {
                let settings = IkSettings { seed, ..reach() };
                reached(robot, &frame(pose), &own, &settings, &mut free, stop)?
            }
            Some(Goal::Place(place)) => {
                let target = DAffine3::from_translation(glamx::DVec3::new(place.x, place.y, place.z));
                let settings = IkSettings { seed, position_only: true, ..reach() };
                reached(robot, &target, &own, &settings, &mut free, stop)?
            }
            Some(Goal::Line(_)) | None => vec![own],
        };
        all = all.iter().flat_map(|before| several.iter().map(move |own| [&before[..], own].concat())).collect();
        all.truncate(SOLUTIONS * SOLUTIONS);
    }
    Ok(all)
}

fn reach() -> IkSettings {
    IkSettings { position: CLOSE, rotation: CLOSE, attempts: ATTEMPTS, solutions: SOLUTIONS, ..IkSettings::default() }
}

fn reached(
    robot: &PlannedRobot,
    target: &DAffine3,
    near: &[f64],
    settings: &IkSettings,
    free: &mut impl FnMut(&[f64], bool) -> bool,
    stop: &Stop,
) -> Result<Path, Failure> {
    let in_root = robot.body.base.inverse() * *target;
    let mut ik = Ik::new(&robot.body.kinematics, robot.end_effector);
    // Those that keep the padding, else those that touch nothing.
    for padded in [true, false] {
        if let Ok(several) = ik.solve(&in_root, near, settings, |q| free(q, padded), stop) {
            return Ok(several);
        }
    }
    ik.solve(&in_root, near, settings, |_| true, stop).map_err(|failure| {
        if stop.is_cancelled() {
            return Failure { cancelled: true, ..Failure::new("cancelled") };
        }
        Failure::new(format!("{}: {failure}", robot.config.name))
            .hint("poses are of the link `end_effector_link`, in metres and radians, in the frame `map`")
    })
}

/// The straight line of the only moving robot's end effector, as far as it goes; the part that it is of the whole.
pub(super) fn line(stage: &mut Stage<'_>, target: &DAffine3, stop: &Stop) -> Result<(Path, f64), Failure> {
    let Some(robot) = stage.robots.first().copied() else { return Err(Failure::new("no robot moves")) };
    let in_root = robot.body.base.inverse() * *target;
    let kinematics = robot.body.kinematics.clone();
    let (checker, start) = (&mut stage.checker, stage.start.clone());
    let contacts = checker.contacts(&start);
    if let Some(contact) = contacts.first() {
        return Err(Failure::new(format!("the start collides: {contact}")));
    }
    // Where it ends is known once it has been followed.
    let settings = LineSettings::default();
    let ahead = straight_line(&kinematics, robot.end_effector, &start, &in_root, &settings, |_, _| true);
    if let Some(goal) = ahead.path.last().filter(|_| ahead.fraction >= WHOLE) {
        checker.give_up(Place::Goal, goal);
    }
    let line = straight_line(&kinematics, robot.end_effector, &start, &in_root, &settings, |a, b| {
        checker.motion_is_free(a, b, stop)
    });
    if line.fraction >= WHOLE {
        return Ok((line.path, 1.0));
    }
    if let Some(failure) = late(stop) {
        return Err(failure);
    }
    let reason = line.shortfall.map_or_else(String::new, |shortfall| format!(": {shortfall}"));
    let part = 100.0 * line.fraction;
    Err(Failure::new(format!("only {part:.1} % of the straight line can be done{reason}"))
        .hint("leave --linear out to go there any way that is free, or choose a nearer pose"))
}
