//! From a request's goals to goal configurations.

use super::ahead::describe_contact;
use super::pipeline::{Goal, PlanFailure, Stage, late};
use super::settings::GoalSettings;
use super::start_contact::{EscapePath, passes};
use crate::collision::report::{Contact, Pair};
use crate::collision::{CollisionChecker, Stop};
use crate::planning::curve::joint_curve::JointCurve;
use crate::planning::curve::tool_path::{ArcError, ToolPath};
use crate::planning::ik::Ik;
use crate::planning::ik::cartesian::{Line, follow as follow_tool, smooth};
use crate::planning::ik::settings::{IkSettings, LineSettings};
use crate::planning::scene::padded::{Near, Padded};
use crate::planning::scene::planning_scene::PlannedRobot;
use crate::planning::search::level::Level;
use crate::planning::search::path::{Path, between, distance, length, unwind};
use crate::planning::search::path_planner::digits_outside;
use crate::planning::settings::PlannerSettings;
use dimos_robot::kinematics::step::rotation_between;
use dimos_robot::kinematics::{Kinematics, frame};
use dimos_robot::model::JointKind;
use glamx::DAffine3;

/// Configurations checked on the piece of a line that is not free, to find what blocks it.
const BLOCK_SAMPLES: u32 = 100;
/// Part of a straight line that counts as complete.
const COMPLETE: f64 = 1.0 - 1e-9;

/// Returns goal configurations of all moving robots, several for a pose goal. Those of one robot collide neither with
/// itself nor with anything that is fixed, if any does not; otherwise the search reports what touches. Several moving
/// robots may still collide with each other.
pub(in crate::planning) fn configurations(
    stage: &mut Stage<'_>,
    wanted: &[(usize, Goal)],
    seed: u64,
    stop: &Stop,
) -> Result<Path, PlanFailure> {
    // One list of configurations per robot; a combination of one from each is a goal of all.
    let mut all: Path = vec![Vec::new()];
    let mut first = 0;
    let settings = stage.settings;
    for (number, (robot, index)) in stage.robots.iter().zip(&stage.indices).enumerate() {
        let own = stage.start.get(first..first + robot.joints.len()).unwrap_or_default().to_vec();
        first += robot.joints.len();
        let goal = wanted.iter().find(|(wanted, _)| wanted == index).map(|(_, goal)| goal);
        let checker = stage.apart.get_mut(number).unwrap_or(&mut stage.checker);
        let mut free = |q: &[f64], padded: bool| if padded { checker.is_free(q) } else { checker.touches_nothing(q) };
        let several = match goal {
            Some(Goal::Joints(values)) => {
                // If the model's joint is continuous but the arm's range is limited, whole turns are the same goal.
                let mut near = values.clone();
                robot.body.kinematics.unwind(&mut near, &own, |kind| kind == JointKind::Continuous);
                vec![near]
            }
            Some(Goal::Pose(pose)) => reached(robot, &frame(pose), &own, (settings, false, seed), &mut free, stop)?,
            Some(Goal::Position(place)) => {
                let target = DAffine3::from_translation(glamx::DVec3::new(place.x, place.y, place.z));
                reached(robot, &target, &own, (settings, true, seed), &mut free, stop)?
            }
            Some(Goal::Line(_) | Goal::Arc { .. } | Goal::Path(_) | Goal::Retrace(_)) | None => vec![own],
        };
        all = all.iter().flat_map(|before| several.iter().map(move |own| [&before[..], own].concat())).collect();
        all.truncate(settings.goals.solutions * settings.goals.solutions);
    }
    Ok(all)
}

fn reached(
    robot: &PlannedRobot,
    target: &DAffine3,
    near: &[f64],
    (settings, position_only, seed): (&PlannerSettings, bool, u64),
    free: &mut impl FnMut(&[f64], bool) -> bool,
    stop: &Stop,
) -> Result<Path, PlanFailure> {
    let GoalSettings { tolerance, attempts, solutions, .. } = settings.goals;
    let (position, rotation) = (tolerance, tolerance);
    let ik_settings = IkSettings { position, rotation, attempts, solutions, position_only, seed, ..settings.ik };
    let in_root = robot.body.base.inverse() * *target;
    let mut ik = Ik::new(&robot.body.kinematics, robot.tcp());
    if let Some(own) = already_there(robot, &mut ik, &in_root, near, (&settings.goals, position_only)) {
        return Ok(vec![own]);
    }
    // Those that keep the padding; otherwise those that touch nothing.
    for padded in [true, false] {
        if let Ok(several) = ik.solve(&in_root, near, &ik_settings, |q| free(q, padded), stop) {
            return Ok(several);
        }
    }
    ik.solve(&in_root, near, &ik_settings, |_| true, stop).map_err(|failure| {
        if stop.is_cancelled() {
            return PlanFailure::cancelled();
        }
        PlanFailure::new(format!("{}: {failure}", robot.config.name))
            .hint(format!("the pose is that of {} in map [m, rad]", robot.config.tcp_name()))
    })
}

/// Returns the present configuration if the robot is at the pose: a goal that needs no motion. Slightly outside its
/// limits, its nearest configuration inside; another solution of the pose would be a large motion.
fn already_there(
    robot: &PlannedRobot,
    ik: &mut Ik<'_>,
    target: &DAffine3,
    own: &[f64],
    (settings, position_only): (&GoalSettings, bool),
) -> Option<Vec<f64>> {
    let inside: Vec<f64> = own.iter().zip(&robot.limits).map(|(q, l)| q.max(l.lower).min(l.upper)).collect();
    let is_inside = inside == own;
    let (far, turned) = match is_inside {
        true => (settings.tolerance, settings.tolerance),
        false => (settings.near_distance, settings.near_rotation),
    };
    let is_at = ik.pose(own);
    let turn = rotation_between(&is_at.matrix3, &target.matrix3).length();
    let there = is_at.translation.distance(target.translation) <= far && (position_only || turn <= turned);
    (there && (is_inside || distance(&inside, own) <= settings.limit_tolerance)).then_some(inside)
}

/// Follows the line or arc of the only moving robot's end effector to its end; returns the path, the part followed, and
/// the smooth curve through the path.
pub(in crate::planning) fn line(
    stage: &mut Stage<'_>,
    goal: &Goal,
    stop: &Stop,
) -> Result<(Path, f64, Option<JointCurve>), PlanFailure> {
    let Some(robot) = stage.robots.first().copied() else { return Err(PlanFailure::new("no robot moves")) };
    let (kinematics, into_root) = (robot.body.kinematics.clone(), robot.body.base.inverse());
    let (checker, start) = (&mut stage.checker, stage.start.clone());
    let contacts = checker.contacts(&start);
    if let Some(contact) = contacts.first() {
        return Err(PlanFailure::new(format!("the start collides: {contact}")));
    }
    let mut ik = Ik::new(&kinematics, robot.tcp());
    let from = ik.pose(&start);
    let (way, kind, key) = match goal {
        Goal::Arc { via, to } => {
            let via = into_root.transform_point3(glamx::DVec3::new(via.x, via.y, via.z));
            let way = ToolPath::arc(from, via, into_root * frame(to)).map_err(|error| {
                PlanFailure::new(error.to_string()).hint(match error {
                    ArcError::Same => "a circle passes three different places; make a full one of two arcs",
                    ArcError::InLine => "choose a via point beside the line",
                })
            })?;
            (way, "arc", "--via")
        }
        Goal::Line(to) => {
            (ToolPath::line(from, into_root * frame(to)), "straight line", "--linear (in a waypoint: line:)")
        }
        _ => return Err(PlanFailure::new("this goal is reached on no line")),
    };
    // The end is known only after following the line, and with it how dense its configurations must be.
    let mut settings = stage.settings.line;
    let (mut ahead, mut curve) = (Line { path: Path::new(), fraction: 0.0, shortfall: None }, None);
    for halvings in 0..=stage.settings.line.halvings {
        let part = 0.5_f64.powi(halvings.cast_signed());
        let LineSettings { step, turn, .. } = stage.settings.line;
        settings = LineSettings { step: step * part, turn: turn * part, ..settings };
        ahead = follow_tool(&kinematics, robot.tcp(), &start, &way, &settings, |_, _| true);
        if ahead.fraction < COMPLETE {
            break;
        }
        curve = smooth(&kinematics, robot.tcp(), &ahead.path, &way, &settings);
        if curve.is_some() {
            break;
        }
    }
    if let Some(goal) = ahead.path.last().filter(|_| ahead.fraction >= COMPLETE) {
        checker.relax(Near::Goal, goal);
    }
    let mut blocked = None;
    let line = follow_tool(&kinematics, robot.tcp(), &start, &way, &settings, |a, b| {
        let free = checker.motion_is_free(a, b, stop);
        if !free {
            blocked = Some([a.to_vec(), b.to_vec()]);
        }
        free
    });
    if line.fraction >= COMPLETE {
        return Ok((line.path, 1.0, curve));
    }
    if let Some(failure) = late(stop) {
        return Err(failure);
    }
    let contact = blocked.and_then(|[a, b]| describe_block(checker, &mut ik, (&a, &b), &ahead.path, &way));
    let at = if way.length() > 1e-3 { format!("after {:.3} m ", line.fraction * way.length()) } else { String::new() };
    let reason = line.shortfall.map_or_else(String::new, |shortfall| format!(": {at}{shortfall}"));
    let reason = contact.map_or(reason, |contact| format!(": {contact}"));
    let part = 100.0 * line.fraction;
    let failure = PlanFailure::new(format!("only {part:.1} % of the {kind} is possible{reason}"));
    let posture = other_posture(checker, &mut ik, (&kinematics, robot.tcp()), (&start, &way), stage.settings, stop);
    Err(match posture {
        Some(q) => {
            let q: Vec<String> = q.iter().map(|q| format!("{q:.4}")).collect();
            failure.hint(format!("from another posture at the same pose it is possible: move to {} first", q.join(" ")))
        }
        None => failure.hint(format!("omit {key} for any collision-free path, or choose a closer pose")),
    })
}

/// Returns the posture at the start's pose, nearest to the start, from which a whole line or arc is free.
fn other_posture(
    checker: &mut Padded,
    ik: &mut Ik<'_>,
    (kinematics, link): (&Kinematics, usize),
    (start, way): (&[f64], &ToolPath),
    settings: &PlannerSettings,
    stop: &Stop,
) -> Option<Vec<f64>> {
    let GoalSettings { postures, attempts, .. } = settings.goals;
    let search = IkSettings { attempts, solutions: postures, ..settings.line.ik() };
    let all = ik.solve(&way.at(0.0), start, &search, |q| checker.is_free(q), stop).ok()?;
    all.into_iter().find(|q| {
        let free = |a: &[f64], b: &[f64]| !stop.is_over() && checker.motion_is_free(a, b, stop);
        follow_tool(kinematics, link, q, way, &settings.line, free).fraction >= COMPLETE
    })
}

/// Follows given configurations straight in joint space, from the stage's start; fails where they are blocked.
pub(in crate::planning) fn follow(stage: &mut Stage<'_>, given: &Path, stop: &Stop) -> Result<Path, PlanFailure> {
    let mut path = vec![stage.start.clone()];
    path.extend(given.iter().cloned());
    let checker = &mut stage.checker;
    let turns = checker.turns().to_vec();
    for k in 1..path.len() {
        let (before, rest) = path.split_at_mut(k);
        if let (Some(before), Some(q)) = (before.last(), rest.first_mut()) {
            unwind(q, before, &turns);
        }
    }
    if let Some(goal) = path.last() {
        checker.relax(Near::Goal, goal);
    }
    let escape_path = EscapePath::of(checker, &path, &stage.settings.plan.escape);
    let mut q = stage.start.clone();
    for (k, pair) in path.windows(2).enumerate() {
        let [a, b] = pair else { continue };
        if passes(checker, Level::Certified, escape_path.as_ref(), (a, b), stop) {
            continue;
        }
        if let Some(failure) = late(stop) {
            return Err(failure);
        }
        let contact = (0..=BLOCK_SAMPLES).find_map(|k| {
            between(a, b, f64::from(k) / f64::from(BLOCK_SAMPLES), &mut q);
            checker.contacts(&q).into_iter().next()
        });
        let what = contact.map_or_else(String::new, |c| format!(": {}", describe_contact(&c, checker.padding())));
        let (free, whole) = (length(path.get(..=k).unwrap_or_default()), length(&path));
        return Err(PlanFailure::new(format!("the path is blocked after {free:.3} of {whole:.3} rad{what}"))
            .hint("correct the world, or plan a motion around it: `dimos move`"));
    }
    Ok(path)
}

/// Returns where on a line which pair blocks it, and how close or deep that pair would get on the whole line: `blocked`
/// is the piece that is not free, `whole` the line without regard to collisions.
fn describe_block(
    checker: &mut Padded,
    ik: &mut Ik<'_>,
    (a, b): (&[f64], &[f64]),
    whole: &Path,
    way: &ToolPath,
) -> Option<String> {
    let mut q = a.to_vec();
    let first = (0..=BLOCK_SAMPLES).find_map(|k| {
        between(a, b, f64::from(k) / f64::from(BLOCK_SAMPLES), &mut q);
        checker.contacts(&q).into_iter().next()
    })?;
    let start = ik.pose(whole.first()?).translation;
    let (along, length) = (ik.pose(&q).translation.distance(start), way.at(1.0).translation.distance(start));
    let of_pair = |contact: &Contact| contact.pair == first.pair;
    let mut least = first.distance;
    for q in whole {
        least = checker.contacts(q).iter().filter(|contact| of_pair(contact)).fold(least, |d, c| d.min(c.distance));
    }
    let kind = if matches!(first.pair, Pair::Links(..)) { "link" } else { "obstacle" };
    let place = if length > 1e-3 { format!("after {along:.3} of {length:.3} m ") } else { String::new() };
    let (link, other) = (&first.link, &first.other);
    let closest = match least {
        least if least > 0.0 => {
            let padding = checker.padding();
            let digits = digits_outside(least, padding, f64::INFINITY);
            format!("within {least:.digits$} m (padding {padding:.digits$} m)")
        }
        least => format!("{:.4} m deep", -least),
    };
    let note = first.note();
    Some(format!("{place}link {link:?} would come too close to {kind} {other:?}, on the whole line {closest}{note}"))
}
