//! One request, from where the robots are to a timed motion: goals found, searched, timed, checked.

use std::collections::BTreeMap;
use std::time::Instant;

use nalgebra::{Isometry3, Vector3};

use super::goals;
use super::leaving::{Leaving, passes};
use super::padded::{GivenUp, Padded, Place};
use super::path::{Path, between, distance, length, unwind};
use super::planner::{PlanError, PlanSettings, plan};
use super::setup::{PlannedRobot, Setup};
use super::timing::{TimingSettings, bounds, time};
use crate::collision::world::World;
use crate::collision::{CollisionChecker, Stop};
use crate::robot::kinematics::frame;
use crate::robot::model::Limits;
use crate::trajectory::{JointTrajectory, TrajectoryPoint};

/// Distance between two looks for the clearance of a path [rad].
const CLEARANCE_STEP: f64 = 0.05;
/// A path shorter than this is none: the robots are there already [rad].
const THERE: f64 = 1e-6;
/// Configurations as close as this are the same [rad].
const SAME: f64 = 1e-3;
/// Searched with as much more padding [m]: between the points of its trajectory a motion is not exactly what was proved,
/// and must still keep the padding when it is looked at again.
const SPARE: f64 = 2e-4;
/// How long the motion of robots takes that are there already [s].
const MOMENT: f64 = 0.1;

/// Where a robot shall go.
#[derive(Debug, Clone, PartialEq)]
pub enum Goal {
    /// To joint positions [rad], in the order of its planned joints.
    Joints(Vec<f64>),
    /// With its end effector to a pose in the frame `map`.
    Pose(Isometry3<f64>),
    /// With its end effector to a place in the frame `map` [m], in any orientation.
    Place(Vector3<f64>),
    /// With its end effector on a straight line to a pose in the frame `map`.
    Line(Isometry3<f64>),
}

/// What is to be planned.
#[derive(Debug, Clone)]
pub struct Request {
    /// Where robots shall go, by their index; the others stay where they are.
    pub goals: Vec<(usize, Goal)>,
    /// Where all robots are [rad], in the setup's order.
    pub positions: Vec<Vec<f64>>,
    /// Part of the limits' speed and acceleration, above 0 and at most 1.
    pub speed: f64,
    /// What all randomness comes from.
    pub seed: u64,
}

/// A motion that was found.
#[derive(Debug, Clone)]
pub struct Found {
    /// The robots that move, by index.
    pub robots: Vec<usize>,
    /// The path: positions of all joints that move, robot after robot.
    pub path: Path,
    /// The motion, with the coordinator's joint names.
    pub trajectory: JointTrajectory,
    /// Smallest distance on the path [m], and between which two; none where there is nothing to be near to, or where
    /// time was up before it was known.
    pub clearance: Option<(f64, [String; 2])>,
    /// The way out of its start, where that touches something.
    pub leaving: Option<Leaving>,
    /// Distance that it keeps [m].
    pub padding: f64,
    /// Where it does not.
    pub given_up: Vec<GivenUp>,
    /// Of a straight line, the part that can be done.
    pub fraction: Option<f64>,
    /// What took how long [s].
    pub times: BTreeMap<String, f64>,
}

/// Why there is no motion.
#[derive(Debug, Clone, PartialEq)]
pub struct Failure {
    /// In a sentence without full stop.
    pub what: String,
    /// What to do about it.
    pub hint: Option<String>,
    /// Whether somebody cancelled the request.
    pub cancelled: bool,
}

impl Failure {
    /// A failure without a hint.
    pub fn new(what: impl Into<String>) -> Self {
        Self { what: what.into(), hint: None, cancelled: false }
    }

    pub(super) fn hint(self, hint: impl Into<String>) -> Self {
        Self { hint: Some(hint.into()), ..self }
    }
}

/// The part of the world that one request is about: the robots that move, planned; the others, standing.
pub(super) struct Stage<'a> {
    /// The robots that move.
    pub robots: Vec<&'a PlannedRobot>,
    /// Their indices in the setup.
    pub indices: Vec<usize>,
    /// Names of their joints in the coordinator, robot after robot.
    pub joints: Vec<String>,
    /// Limits of the same.
    pub limits: Vec<Limits>,
    /// Where they are [rad].
    pub start: Vec<f64>,
    /// Knows all robots and obstacles.
    pub checker: Padded,
}

/// Plans a motion. The same setup, world and request give the same motion, as long as time does not run out.
pub fn solve(setup: &Setup, world: &World, request: &Request, stop: &Stop) -> Result<Found, Failure> {
    let mut times = BTreeMap::new();
    let moving: Vec<usize> = request.goals.iter().map(|(robot, _)| *robot).collect();
    let mut stage = stage(setup, world, &moving, &request.positions, setup.padding + SPARE)?;
    stage.checker.give_up(Place::Start, &stage.start);
    let began = Instant::now();
    let lap = |times: &mut BTreeMap<String, f64>, name: &str, since: Instant| {
        times.insert(name.to_owned(), since.elapsed().as_secs_f64());
        Instant::now()
    };
    let (path, fraction) = match request.goals.as_slice() {
        [(_, Goal::Line(target))] => {
            let (path, fraction) = goals::line(&mut stage, &frame(target), stop)?;
            lap(&mut times, "search", began);
            (path, Some(fraction))
        }
        several if several.iter().any(|(_, goal)| matches!(goal, Goal::Line(_))) => {
            return Err(Failure::new("a straight line is planned for one robot at a time"));
        }
        wanted => {
            let goals = goals::configurations(&mut stage, wanted, request.seed, stop)?;
            for goal in &goals {
                let mut goal = goal.clone();
                unwind(&mut goal, &stage.start, stage.checker.turns());
                stage.checker.give_up(Place::Goal, &goal);
            }
            lap(&mut times, "ik", began);
            let settings = PlanSettings { seed: request.seed, ..PlanSettings::default() };
            let start = stage.start.clone();
            let found = plan(&mut stage.checker, &start, &goals, &settings, stop).map_err(|e| told(&stage, &e))?;
            times.insert("search".into(), found.search_time.as_secs_f64());
            times.insert("shorten".into(), found.shorten_time.as_secs_f64());
            (found.path, None)
        }
    };
    let timing = Instant::now();
    let trajectory = match length(&path) < THERE {
        true => rest(&stage.joints, &path),
        false => timed(&mut stage, &path, request.speed, fraction.is_some(), stop)?,
    };
    let looking = lap(&mut times, "timing", timing);
    let clearance = clearance(&mut stage.checker, &path, stop);
    lap(&mut times, "clearance", looking);
    let leaving = Leaving::of(&mut stage.checker, &path);
    // Of several goals one was reached.
    let reached = |center: &[f64]| path.last().is_some_and(|end| distance(end, center) < SAME);
    let at_end = |given_up: &&GivenUp| given_up.place != Place::Goal || reached(&given_up.center);
    let given_up = stage.checker.given_up().iter().filter(at_end).cloned().collect();
    let (robots, padding) = (stage.indices, setup.padding);
    Ok(Found { robots, path, trajectory, clearance, leaving, padding, given_up, fraction, times })
}

/// The world of one request: robots that move, by index, and all others where they are [rad]; `padding` is kept [m].
pub(super) fn stage<'a>(
    setup: &'a Setup,
    world: &World,
    moving: &[usize],
    positions: &[Vec<f64>],
    padding: f64,
) -> Result<Stage<'a>, Failure> {
    let (mut robots, mut indices, mut bodies) = (Vec::new(), Vec::new(), Vec::new());
    let (mut joints, mut limits, mut start) = (Vec::new(), Vec::new(), Vec::new());
    for (index, robot) in setup.robots.iter().enumerate() {
        let at = positions.get(index).filter(|at| at.len() == robot.joints.len());
        let at = at.ok_or_else(|| Failure::new(format!("the positions of {} are not known", robot.config.name)))?;
        if !moving.contains(&index) {
            bodies.push(robot.standing(at).map_err(Failure::new)?);
            continue;
        }
        bodies.push(robot.body.clone());
        robots.push(robot);
        indices.push(index);
        joints.extend(robot.config.coordinator_joints.iter().cloned());
        limits.extend_from_slice(&robot.limits);
        start.extend_from_slice(at);
    }
    let checker = Padded::new(world.with_robots(bodies).snapshot(), padding);
    Ok(Stage { robots, indices, joints, limits, start, checker })
}

/// A planner's error in the user's words: joints by name.
fn told(stage: &Stage<'_>, error: &PlanError) -> Failure {
    match error {
        PlanError::Outside { which, joint, position, lower, upper } => {
            let name = stage.joints.get(*joint).map_or("a joint", String::as_str);
            let kinds = stage.robots.iter().flat_map(|robot| robot.body.kinematics.kinds());
            let unit = { kinds }.nth(*joint).map_or("rad", |kind| kind.unit());
            let limits = format!("{lower:.4} … {upper:.4} {unit}");
            Failure::new(format!("{which}: {name} at {position:.4} {unit} is outside its limits {limits}"))
                .hint("limits are the model's and the arm's, the narrower counts, and commands stay 0.01 rad inside the arm's; `dimos state` shows where the joints are")
        }
        PlanError::Collides { which: "start", .. } => Failure::new(error.to_string())
            .hint("move out of it with `dimos move … --direct` or by hand, or correct the world"),
        PlanError::Collides { .. } => Failure::new(error.to_string()).hint("choose another goal, or correct the world"),
        PlanError::Timeout(_) => {
            Failure::new(error.to_string()).hint("give it more time with --timeout, or another --seed")
        }
        PlanError::Cancelled => Failure { cancelled: true, ..Failure::new("cancelled") },
        _ => Failure::new(error.to_string()),
    }
}

/// The motion of robots that are there already: they stand for a moment.
fn rest(joints: &[String], path: &Path) -> JointTrajectory {
    let still = vec![0.0; joints.len()];
    let at = |time| TrajectoryPoint {
        time_from_start: time,
        positions: path.first().cloned().unwrap_or_default(),
        velocities: still.clone(),
        accelerations: still.clone(),
    };
    JointTrajectory { joint_names: joints.to_vec(), points: vec![at(0.0), at(MOMENT)] }
}

/// Times a path within the joints' limits, and checks the timed motion.
fn timed(stage: &mut Stage<'_>, path: &Path, speed: f64, line: bool, stop: &Stop) -> Result<JointTrajectory, Failure> {
    let bounds = bounds(&stage.joints, &stage.limits).map_err(|e| Failure::new(e.to_string()))?;
    // Half the speed means half the velocity and half the acceleration, as a direct move has it.
    let bounds: Vec<_> = bounds
        .into_iter()
        .map(|mut b| {
            b.velocity *= speed;
            b.acceleration *= speed;
            b.jerk *= speed;
            b
        })
        .collect();
    // The corners of a line are so flat that cutting them keeps to it.
    let deviation = if line { 1e-3 } else { TimingSettings::default().deviation };
    let settings = TimingSettings { deviation, speed: 1.0 };
    let checker = &mut stage.checker;
    let leaving = Leaving::of(checker, path);
    let free = |a: &[f64], b: &[f64]| passes(checker, leaving.as_ref(), a, b, stop);
    let timed = time(&stage.joints, path, &bounds, &settings, free);
    timed.map(|timed| timed.trajectory).map_err(|e| late(stop).unwrap_or_else(|| Failure::new(e.to_string())))
}

/// What failed because it was cancelled, or because time was up.
pub(super) fn late(stop: &Stop) -> Option<Failure> {
    match (stop.is_cancelled(), stop.is_over()) {
        (true, _) => Some(Failure { cancelled: true, ..Failure::new("cancelled") }),
        (_, true) => Some(Failure::new("no motion was found in time").hint("give it more time with --timeout")),
        _ => None,
    }
}

/// The smallest distance on a path, and between which two. A figure for people: without it where time is up.
fn clearance(checker: &mut Padded, path: &Path, stop: &Stop) -> Option<(f64, [String; 2])> {
    let mut least: Option<(f64, [String; 2])> = None;
    let mut q = path.first()?.clone();
    for pair in path.windows(2) {
        let [a, b] = pair else { continue };
        let steps = (distance(a, b) / CLEARANCE_STEP).ceil().max(1.0) as usize;
        for step in 0..=steps {
            if stop.is_over() {
                return None;
            }
            between(a, b, step as f64 / steps as f64, &mut q);
            let contact = checker.clearance(&q)?;
            if least.as_ref().is_none_or(|(distance, _)| contact.distance < *distance) {
                least = Some((contact.distance, [contact.link, contact.other]));
            }
        }
    }
    least
}
