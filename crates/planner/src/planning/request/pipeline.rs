//! Planning pipeline: one request, from the robots' positions to a verified trajectory.

use std::collections::BTreeMap;
use std::time::Instant;

use glamx::DVec3;
use nalgebra::{Isometry3, Vector3};

use super::ahead::straight_motions;
use super::curve_timing::along_curves;
use super::joint_path::JointPath;
use super::legs::{Leg, joined, legs};
use super::start_contact::{EscapePath, passes};
use super::waypoint_times::times_at_waypoints;
use crate::collision::clearance::Clearance;
use crate::collision::report::Pair;
use crate::collision::world::{Robot, World};
use crate::collision::{CollisionChecker, Stop};
use crate::planning::scene::ignored_pairs::IgnoredPair;
use crate::planning::scene::padded::{Near, Padded, PaddingException};
use crate::planning::scene::planning_scene::{PlannedRobot, PlanningScene};
use crate::planning::scene::stage_cache::Key;
use crate::planning::search::level::Level;
use crate::planning::search::path::{Path, distance, length};
use crate::planning::search::path_planner::{PlanError, digits_outside};
use crate::planning::settings::PlannerSettings;
use crate::planning::timing::tool_timing::Tools;
use crate::planning::timing::{TimingError, bounds, time_within};
use dimos_core::joint::JointBounds;
use dimos_core::trajectory::{JointTrajectory, JointValues, Spline, TrajectoryPoint};
use dimos_core::written;
use dimos_robot::model::Limits;

/// A path shorter than this needs no motion [rad].
const GOAL_TOLERANCE: f64 = 1e-6;
/// Configurations closer than this count as the same [rad].
const SAME_CONFIGURATION: f64 = 1e-3;
/// Distance at which nothing can touch [m].
const OUT_OF_REACH: f64 = 1e5;
/// Duration of the motion of robots that are already at the goal [s].
const STATIONARY_DURATION: f64 = 0.1;

/// Goal of a robot.
#[derive(Debug, Clone, PartialEq)]
pub enum Goal {
    /// Joint positions [rad], in the order of its planned joints.
    Joints(Vec<f64>),
    /// Pose of the end effector in the frame `map`.
    Pose(Isometry3<f64>),
    /// Position of the end effector in the frame `map` [m], in any orientation.
    Position(Vector3<f64>),
    /// Pose of the end effector in the frame `map`, reached on a straight line.
    Line(Isometry3<f64>),
    /// Pose of the end effector in the frame `map`, reached on the arc of a circle through a place [m].
    Arc {
        /// The place on the way.
        via: Vector3<f64>,
        /// The pose.
        to: Isometry3<f64>,
    },
    /// A path to follow, after an approach to its first configuration.
    Path(JointPath),
    /// Joint positions [rad] to pass, straight in joint space; the last are the goal. Nothing is searched.
    Retrace(Path),
}

/// A planning request.
#[derive(Debug, Clone)]
pub struct PlanRequest {
    /// Goals of robots, by their index; the other robots stay where they are.
    pub goals: Vec<(usize, Goal)>,
    /// Current positions of all robots [rad], in the order of the scene.
    pub positions: Vec<Vec<f64>>,
    /// Part of the highest speed, above 0 and at most 1: the same motion takes 1 / `speed` times as long.
    pub speed: f64,
    /// Seed of all random numbers.
    pub seed: u64,
    /// How motions are checked. Straight lines and given paths are always proven.
    pub level: Level,
    /// Rounds of refinement of the path: see [`refine`](crate::planning::search::refine).
    pub refine: u32,
    /// Goals that the motion passes before, in order, for the same robots.
    pub through: Vec<Vec<(usize, Goal)>>,
    /// How far away an end effector may pass them [m]; 0: the motion rests at each.
    pub blend: f64,
    /// Highest speed of an end effector and its flange [m/s], beside that of the robot.
    pub tcp_speed: Option<f64>,
    /// Obstacles that the end effectors, and what they hold, may touch.
    pub touch: Vec<String>,
    /// Whether only its number selects the plan.
    pub by_number: bool,
}

impl PlanRequest {
    /// Creates a request of a robot alone in its scene: from these positions to a goal at full speed, proven.
    pub fn new(positions: Vec<f64>, goal: Goal) -> Self {
        Self {
            goals: vec![(0, goal)],
            positions: vec![positions],
            speed: 1.0,
            seed: 0,
            level: Level::default(),
            refine: 0,
            through: Vec::new(),
            blend: 0.0,
            tcp_speed: None,
            touch: Vec::new(),
            by_number: false,
        }
    }
}

/// A planned motion.
#[derive(Debug, Clone)]
pub struct PlannedMotion {
    /// The robots that move, by index.
    pub robots: Vec<usize>,
    /// The path: positions of all moving joints, robot after robot.
    pub path: Path,
    /// The trajectory, with the coordinator's joint names.
    pub trajectory: JointTrajectory,
    /// How it was checked.
    pub level: Level,
    /// The distance that the whole motion is proven to keep; at a start in contact, that of the contact. `None` if
    /// there is nothing to collide with, if nothing is proven, or if the timeout was reached before it was computed.
    pub clearance: Option<Clearance>,
    /// The escape path, if the start is in contact.
    pub escape_path: Option<EscapePath>,
    /// Padding [m].
    pub padding: f64,
    /// Obstacles that the end effectors may touch: they were not checked against those.
    pub touch: Vec<String>,
    /// Exceptions from the padding.
    pub exceptions: Vec<PaddingException>,
    /// Pairs of links that were not checked.
    pub ignored: Vec<IgnoredPair>,
    /// Joints of the goal that were moved to their limits: name, requested and used position [rad or m].
    pub clamped: Vec<(String, f64, f64)>,
    /// The part of a straight line that was followed.
    pub fraction: Option<f64>,
    /// When it passes the waypoints [s].
    pub passes: Vec<f64>,
    /// Duration of each stage [s].
    pub times: BTreeMap<String, f64>,
}

/// Why there is no motion.
#[derive(Debug, Clone, PartialEq)]
pub struct PlanFailure {
    /// A sentence without full stop.
    pub what: String,
    /// Remedy for the user.
    pub hint: Option<String>,
    /// Whether the request was cancelled.
    pub cancelled: bool,
    /// Whether samples and covers only are in the way: a proof may find that nothing is.
    pub unproven: bool,
}

impl PlanFailure {
    /// Creates a failure without a hint.
    pub fn new(what: impl Into<String>) -> Self {
        Self { what: what.into(), hint: None, cancelled: false, unproven: false }
    }

    /// Creates the failure of a cancelled request.
    pub(in crate::planning) fn cancelled() -> Self {
        Self { cancelled: true, ..Self::new("cancelled") }
    }

    pub(in crate::planning) fn hint(self, hint: impl Into<String>) -> Self {
        Self { hint: Some(hint.into()), ..self }
    }
}

/// The scene of one request: moving robots are planned, the others are fixed.
pub(in crate::planning) struct Stage<'a> {
    /// Settings of the planner.
    pub settings: &'a PlannerSettings,
    /// The robots that move.
    pub robots: Vec<&'a PlannedRobot>,
    /// Their indices in the scene.
    pub indices: Vec<usize>,
    /// Names of their joints in the coordinator, robot after robot.
    pub joints: Vec<String>,
    /// Limits of the same joints.
    pub limits: Vec<Limits>,
    /// Their positions [rad].
    pub start: Vec<f64>,
    /// Checker of all robots and obstacles.
    pub checker: Padded,
    /// One checker per moving robot, without the other moving ones; empty if only one robot moves.
    pub apart: Vec<Padded>,
}

/// Duration of each stage [s], by its name.
pub(in crate::planning) type StageTimes = BTreeMap<String, f64>;

/// Plans a motion. The same scene, world and request give the same motion unless the timeout is reached. Samples
/// may refuse what a proof accepts: if the level `fast` finds no motion, `certified` is tried.
pub fn solve(
    setup: &PlanningScene,
    world: &World,
    request: &PlanRequest,
    stop: &Stop,
) -> Result<PlannedMotion, PlanFailure> {
    match attempt(setup, world, request, stop) {
        Err(failure) if request.level == Level::Fast && failure.unproven && !stop.is_over() => {
            attempt(setup, world, &PlanRequest { level: Level::Certified, ..request.clone() }, stop)
        }
        found => found,
    }
}

fn attempt(
    setup: &PlanningScene,
    world: &World,
    request: &PlanRequest,
    stop: &Stop,
) -> Result<PlannedMotion, PlanFailure> {
    let mut times = BTreeMap::new();
    let moving: Vec<usize> = request.goals.iter().map(|(robot, _)| *robot).collect();
    let given = request.goals.iter().any(|(_, goal)| matches!(goal, Goal::Retrace(_)));
    let padding = if given { setup.settings.padding.path_ratio * setup.padding } else { setup.padding };
    let unknown = |name: &&String| !world.obstacles().iter().any(|obstacle| obstacle.name == **name);
    if let Some(name) = request.touch.iter().find(unknown) {
        let failure = PlanFailure::new(format!("{name:?} may be touched, and is not in the world"));
        return Err(failure.hint("`dimos world list` lists the obstacles"));
    }
    let padded = padding + setup.settings.padding.extra;
    let mut stage = stage(setup, world, &moving, &request.positions, padded, &request.touch)?;
    stage.checker.relax(Near::Start, &stage.start);
    let lap = |times: &mut BTreeMap<String, f64>, name: &str, since: Instant| {
        times.insert(name.to_owned(), since.elapsed().as_secs_f64());
        Instant::now()
    };
    let legs = legs(&mut stage, request, stop, &mut times)?;
    let fraction = legs.last().filter(|_| legs.len() == 1).and_then(|leg| leg.fraction);
    let (path, deviation) = joined(&stage, &legs, request.blend);
    let clamped = legs.iter().flat_map(|leg| leg.clamped.iter().cloned()).collect();
    let timing = Instant::now();
    let escape_path = EscapePath::of(&mut stage.checker, &path, &stage.settings.plan.escape);
    let trajectory = match length(&path) < GOAL_TOLERANCE {
        true => rest(&stage.joints, &path),
        false => timed(&mut stage, (&legs, &path, &deviation), escape_path.as_ref(), request, stop)?,
    };
    let passes = times_at_waypoints(&trajectory, &legs);
    let looking = lap(&mut times, "timing", timing);
    let level = request.level;
    let clearance = match escape_path {
        Some(_) => contact_at(&mut stage.checker, &stage.start),
        None if level.proves() => {
            let spline = Spline::new(&trajectory).map_err(|e| PlanFailure::new(e.to_string()))?;
            stage.checker.clearance_along(
                &straight_motions(&spline, &stage.settings.look_ahead),
                level == Level::Exact,
                stop,
            )
        }
        None => None,
    };
    lap(&mut times, "clearance", looking);
    // Only one of several goals was reached.
    let reached = |center: &[f64]| path.iter().any(|at| distance(at, center) < SAME_CONFIGURATION);
    let at_end = |exception: &&PaddingException| exception.near != Near::Goal || reached(&exception.center);
    let exceptions = stage.checker.exceptions().iter().filter(at_end).cloned().collect();
    let fixed = stage.checker.fixed_contacts();
    let robots = stage.indices;
    let mut ignored = setup.ignored_pairs(world, &robots);
    let reason = "touch, and no planned joint moves them";
    ignored.extend(fixed.into_iter().map(|links| IgnoredPair { links, reason: reason.to_owned() }));
    Ok(PlannedMotion {
        touch: request.touch.clone(),
        robots,
        path,
        trajectory,
        level,
        clearance,
        escape_path,
        padding,
        exceptions,
        ignored,
        clamped,
        fraction,
        passes,
        times,
    })
}

/// Builds the scene of one request: `moving` robots by index, all others fixed at their positions [rad], with `padding`
/// [m].
pub(in crate::planning) fn stage<'a>(
    setup: &'a PlanningScene,
    world: &World,
    moving: &[usize],
    positions: &[Vec<f64>],
    padding: f64,
    touch: &[String],
) -> Result<Stage<'a>, PlanFailure> {
    let (mut robots, mut indices, mut fixed) = (Vec::new(), Vec::new(), Vec::new());
    let (mut joints, mut limits, mut start) = (Vec::new(), Vec::new(), Vec::new());
    for (index, robot) in setup.robots.iter().enumerate() {
        let at = positions.get(index).filter(|at| at.len() == robot.joints.len());
        let at =
            at.ok_or_else(|| PlanFailure::new(format!("the joint positions of {} are unknown", robot.config.name)))?;
        if !moving.contains(&index) {
            fixed.push(at.clone());
            continue;
        }
        robots.push(robot);
        indices.push(index);
        joints.extend(robot.config.coordinator_joints.iter().cloned());
        limits.extend_from_slice(&robot.limits);
        start.extend_from_slice(at);
    }
    let key = Key {
        world: world.version(),
        robots: setup.robots.iter().map(|robot| robot.body.kinematics.clone()).collect(),
        moving: indices.clone(),
        fixed,
        padding,
        touch: touch.to_vec(),
    };
    let (checker, apart) = setup.staged.get(key, || {
        let body = |(index, robot): (usize, &PlannedRobot)| match moving.contains(&index) {
            true => Ok(robot.body.clone()),
            false => robot.fixed_at(&positions[index]).map_err(PlanFailure::new),
        };
        let bodies = setup.robots.iter().enumerate().map(body).collect::<Result<Vec<_>, _>>()?;
        let mut world = world.with_robots(bodies.clone());
        for (index, robot) in indices.iter().zip(&robots).filter(|_| !touch.is_empty()) {
            world = world.letting_touch(*index, robot.end_effector, touch);
        }
        let several = if indices.len() > 1 { indices.as_slice() } else { &[] };
        let apart = several.iter().map(|own| apart(setup, &world, &bodies, (*own, moving), positions, padding));
        let apart = apart.collect::<Result<_, _>>()?;
        Ok((Padded::new(world.snapshot(), padding, &setup.settings), apart))
    })?;
    Ok(Stage { settings: &setup.settings, robots, indices, joints, limits, start, checker, apart })
}

/// Returns the checker of one moving robot alone with everything that does not move.
fn apart(
    setup: &PlanningScene,
    world: &World,
    bodies: &[Robot],
    (own, moving): (usize, &[usize]),
    positions: &[Vec<f64>],
    padding: f64,
) -> Result<Padded, PlanFailure> {
    let mut bodies = bodies.to_vec();
    for other in moving.iter().filter(|other| **other != own) {
        let (Some(robot), Some(at), Some(body)) =
            (setup.robots.get(*other), positions.get(*other), bodies.get_mut(*other))
        else {
            continue;
        };
        *body = robot.fixed_at(at).map_err(PlanFailure::new)?;
        // Out of reach with what it holds: held objects refer to their robot by its number.
        body.base.translation += DVec3::splat(OUT_OF_REACH);
    }
    Ok(Padded::new(world.with_robots(bodies).snapshot(), padding, &setup.settings))
}

/// Converts a path planner's error to a failure with joint names.
pub(in crate::planning) fn failure_for(stage: &Stage<'_>, error: &PlanError) -> PlanFailure {
    let name_and_unit = |joint: usize| {
        let kinds = stage.robots.iter().flat_map(|robot| robot.body.kinematics.kinds());
        let unit = { kinds }.nth(joint).map_or("rad", |kind| kind.unit());
        (stage.joints.get(joint).map_or("a joint", String::as_str), unit)
    };
    let failure = match error {
        PlanError::Outside { which, joint, position, lower, upper } => {
            let (name, unit) = name_and_unit(*joint);
            let digits = digits_outside(*position, *lower, *upper);
            let limits = format!("{lower:.digits$} … {upper:.digits$} {unit}");
            let inside = "positions are in rad; the narrower limits of model and arm apply, and commands stay 0.01 rad \
                          inside those of the arm; `dimos state` shows the joint positions";
            let degrees = written::degrees(*position).filter(|_| unit == "rad");
            PlanFailure::new(format!("{which}: {name} at {position:.digits$} {unit} is outside its limits {limits}"))
                .hint(degrees.unwrap_or_else(|| inside.to_owned()))
        }
        PlanError::Collides { which: "start", .. } => PlanFailure::new(error.to_string())
            .hint("move the arm out of contact with `dimos move … --direct` or by hand, or correct the world"),
        PlanError::Collides { .. } => {
            PlanFailure::new(error.to_string()).hint("choose another goal, or correct the world")
        }
        PlanError::Enclosed { which, enclosed } => {
            let ((name, unit), [low, high]) = (name_and_unit(enclosed.joint), enclosed.reached);
            let by = if enclosed.contacts.is_empty() { String::new() } else { format!(", by {}", enclosed.pairs()) };
            PlanFailure::new(format!(
                "the {which} is enclosed: {name} does not leave {low:.2} … {high:.2} {unit} there{by}"
            ))
            .hint(if enclosed.contacts.iter().any(|contact| matches!(contact.pair, Pair::Obstacle(..))) {
                "move the obstacle, or choose another goal; a very narrow way out may have been missed"
            } else {
                "choose another goal; a very narrow way out may have been missed"
            })
        }
        PlanError::Timeout(_) => PlanFailure::new(error.to_string()).hint("increase --timeout, or try another --seed"),
        PlanError::Cancelled => PlanFailure::cancelled(),
        _ => PlanFailure::new(error.to_string()),
    };
    let unproven = matches!(error, PlanError::Covered | PlanError::Enclosed { .. } | PlanError::Exhausted(_));
    PlanFailure { unproven, ..failure }
}

/// Returns the trajectory of robots that are already at the goal: a short rest.
fn rest(joints: &[String], path: &Path) -> JointTrajectory {
    let still = JointValues::from_elem(0.0, joints.len());
    let at = |time| TrajectoryPoint {
        time_from_start: time,
        positions: path.first().map(|q| JointValues::from_slice(q)).unwrap_or_default(),
        velocities: still.clone(),
        accelerations: still.clone(),
    };
    JointTrajectory { joint_names: joints.to_vec(), points: vec![at(0.0), at(STATIONARY_DURATION)] }
}

/// Returns the deepest contact at a configuration.
fn contact_at(checker: &mut Padded, q: &[f64]) -> Option<Clearance> {
    let contact = checker.contacts(q).into_iter().next()?;
    Some(Clearance { distance: contact.distance, pair: Some([contact.link, contact.other]) })
}

/// Times a path within the joints' limits, and verifies the trajectory.
fn timed(
    stage: &mut Stage<'_>,
    (legs, path, deviation): (&[Leg], &Path, &[f64]),
    escape_path: Option<&EscapePath>,
    request: &PlanRequest,
    stop: &Stop,
) -> Result<JointTrajectory, PlanFailure> {
    let bounds = bounds_of(stage)?;
    let mut tools = tools(stage, request.tcp_speed);
    if let Some(motion) = along_curves(stage, legs, (&bounds, &mut tools), (escape_path, request), stop) {
        return Ok(if request.speed < 1.0 { motion.scaled(request.speed) } else { motion });
    }
    let checker = &mut stage.checker;
    let free = |a: &[f64], b: &[f64]| passes(checker, request.level, escape_path, (a, b), stop);
    let timed = time_within(&stage.joints, path, &bounds, deviation, &stage.settings.timing, free);
    let timed = timed.map_err(|error| {
        let unproven = matches!(error, TimingError::NotFree(..));
        late(stop).unwrap_or_else(|| PlanFailure { unproven, ..PlanFailure::new(error.to_string()) })
    })?;
    let motion = tools.slowed(&timed.trajectory, &bounds, 1.0, &stage.settings.tool).unwrap_or(timed.trajectory);
    // The same motion in a longer time, as a direct move and the speed override have it.
    Ok(if request.speed < 1.0 { motion.scaled(request.speed) } else { motion })
}

/// Returns the tools of the moving robots whose speed is limited, at most to `most` [m/s].
fn tools(stage: &Stage<'_>, most: Option<f64>) -> Tools {
    let (mut tools, mut first) = (Tools::default(), 0);
    for robot in &stage.robots {
        let joints = first..first + robot.joints.len();
        first = joints.end;
        let limit = robot.tcp_velocity.into_iter().chain(most).reduce(f64::min);
        if let Some(limit) = limit {
            tools.push(joints, robot.tool_speed(), limit);
        }
    }
    tools
}

/// Returns the bounds of the joints.
pub(in crate::planning) fn bounds_of(stage: &Stage<'_>) -> Result<Vec<JointBounds>, PlanFailure> {
    bounds(&stage.joints, &stage.limits).map_err(|e| PlanFailure::new(e.to_string()))
}

/// Returns the failure if the request was cancelled or its timeout was reached.
pub(in crate::planning) fn late(stop: &Stop) -> Option<PlanFailure> {
    match (stop.is_cancelled(), stop.is_over()) {
        (true, _) => Some(PlanFailure::cancelled()),
        (_, true) => Some(PlanFailure::new("no motion found before the timeout").hint("increase --timeout")),
        _ => None,
    }
}
