//! Goals of motions as typed on the command line, and planning.

use std::path::PathBuf;
use std::thread::sleep;
use std::time::Duration;

use indicatif::{ProgressBar, ProgressFinish, ProgressStyle};

use super::arguments::{angle, coordinate, finite, length, speed};
use super::exit::{Exit, Failure, Result};
use super::follow::Signals;
use super::grip::{self, GripAction};
use super::output::{self, fixed};
use super::recorded_path;
use dimos_core::written;
use dimos_rpc::api::{
    Cancel, DEFAULT_REFINE, DEFAULT_SPEED, JointPath, MAX_TCP_SPEED, PATH_TOLERANCE, Plan, PlanGoal, PlanLevel,
    PlanSummary, Planner, Planning, PlanningReport, PoseSpec,
};
use dimos_rpc::client::{Client, ClientError};
use dimos_rpc::{Code, RpcError};

/// Poll period while planning.
const POLL_PERIOD: Duration = Duration::from_millis(20);

/// Goal of a motion.
#[derive(Debug, Clone, clap::Args)]
#[group(skip)]
pub struct Goal {
    /// Target positions of its joints [rad], one per joint, base first
    #[arg(value_name = "Q", value_parser = position, allow_negative_numbers = true, conflicts_with_all = ["tcp", "named"], group = "goal")]
    pub joints: Vec<f64>,
    /// Target position of the tool centre point: x, y, z [m]; orientation is free unless --rpy or --quat is given
    #[arg(long, value_names = ["X", "Y", "Z"], num_args = 3, value_parser = length, allow_negative_numbers = true, groups = ["tcp", "goal"])]
    pub pose: Option<Vec<f64>>,
    /// Move the tool centre point by x, y, z [m] along the axes of --frame; --rpy or --quat turns it about them
    #[arg(long, value_names = ["X", "Y", "Z"], num_args = 3, value_parser = length, allow_negative_numbers = true, groups = ["tcp", "goal"])]
    pub by: Option<Vec<f64>>,
    /// Roll, pitch, yaw about fixed axes [rad]
    #[arg(long, value_names = ["R", "P", "Y"], num_args = 3, value_parser = angle, allow_negative_numbers = true, requires = "tcp")]
    pub rpy: Option<Vec<f64>>,
    /// Orientation as a quaternion x, y, z, w
    #[arg(long, value_names = ["X", "Y", "Z", "W"], num_args = 4, value_parser = coordinate, allow_negative_numbers = true, requires = "tcp", conflicts_with = "rpy")]
    pub quat: Option<Vec<f64>>,
    /// Reach --pose or --by on the arc of a circle that passes x, y, z [m], along the same axes
    #[arg(long, value_names = ["X", "Y", "Z"], num_args = 3, value_parser = length, allow_negative_numbers = true, requires = "tcp", conflicts_with = "linear")]
    pub via: Option<Vec<f64>>,
    /// Frame of --pose or --by: map (default), base, tool, or an object of the world
    #[arg(long, value_name = "FRAME", requires = "tcp")]
    pub frame: Option<String>,
    /// Named pose
    #[arg(long, value_name = "NAME", conflicts_with = "tcp", group = "goal")]
    pub named: Option<String>,
    /// Goal of one of several arms in a common motion (repeatable): left=0.1,-0.3,0.6,0,0.8,0 or left=named:home or
    /// left=pose:x,y,z or, with roll, pitch, yaw or a quaternion, left=pose:x,y,z,r,p,y or left=pose:x,y,z,qx,qy,qz,qw;
    /// left=by:x,y,z moves by a distance; @FRAME after a pose gives its frame: left=by:0,0,0.05@tool
    #[arg(long = "goal", value_name = "ARM=GOAL", value_parser = arm_goal, conflicts_with_all = ["joints", "tcp", "named"], group = "goal")]
    pub several: Vec<PlanGoal>,
    /// One motion through these waypoints; the last is the goal. Each is a named pose (named:1 if its name is a
    /// number), joints as 0.1,-0.3,0.6,0,0.8,0, or pose:x,y,z,r,p,y (also with x,y,z or a quaternion, and @FRAME);
    /// line:… is reached on a straight line, arc:x,y,z/… on a circle through x,y,z. With `move` also gripper:open,
    /// gripper:close or gripper:0.03, where the arm waits for the outcome
    #[arg(long, value_name = "WAYPOINT", num_args = 2.., value_parser = waypoint, allow_negative_numbers = true, conflicts_with_all = ["joints", "tcp", "named", "several"], group = "goal")]
    pub through: Vec<Waypoint>,
    /// Follow the path of a motion that was led or recorded: .csv or .json as for `execute`, or a log (.mcap). Its
    /// times do not count; the way to its first point is planned
    #[arg(long, value_name = "FILE", conflicts_with_all = ["joints", "tcp", "named", "several", "through"], group = "goal")]
    pub path: Option<PathBuf>,
    /// How far the motion may pass from the recorded path, per joint [rad]
    #[arg(long, value_name = "ANGLE", default_value_t = PATH_TOLERANCE, value_parser = tolerance, requires = "path")]
    pub tolerance: f64,
    /// How far away the tool centre point may pass the waypoints [m]; 0: it stops at each
    #[arg(long, value_name = "DISTANCE", default_value_t = 0.0, value_parser = length, requires = "through")]
    pub blend: f64,
}

/// An entry of `--through`.
#[expect(clippy::large_enum_variant, reason = "a few of them, from the command line")]
#[derive(Debug, Clone, PartialEq)]
pub enum Waypoint {
    /// Where the arm goes.
    Goal(PlanGoal),
    /// What the gripper does there.
    Grip(GripAction),
}

/// A part of a motion with gripper actions.
pub enum Leg {
    /// To plan and execute.
    Motion(Plan),
    /// To do at its end, with the gripper of this arm.
    Grip(GripAction, String),
}

/// Parses a joint position; a name and a list get a hint at what was probably meant.
fn position(text: &str) -> std::result::Result<f64, String> {
    coordinate(text).map_err(|wrong| match text.chars().all(|c| c.is_ascii_alphanumeric() || matches!(c, '_' | '-')) {
        true if text.starts_with(|c: char| c.is_ascii_alphabetic()) && text.parse::<f64>().is_err() => {
            format!("{wrong}: a named pose is given with --named {text}")
        }
        _ => wrong,
    })
}

/// Parses the speed of a tool.
fn tcp_speed(text: &str) -> std::result::Result<f64, String> {
    let speed = finite(text)?;
    let allowed = speed > 0.0 && speed <= MAX_TCP_SPEED;
    if allowed { Ok(speed) } else { Err(format!("must be above 0 and at most {MAX_TCP_SPEED} m/s")) }
}

/// Parses the tolerance of a path.
fn tolerance(text: &str) -> std::result::Result<f64, String> {
    let tolerance = finite(text)?;
    if (1e-4..=0.1).contains(&tolerance) { Ok(tolerance) } else { Err("must be within 0.0001–0.1 rad".into()) }
}

/// Parses an arm and its goal, as in `--goal`.
fn arm_goal(text: &str) -> std::result::Result<PlanGoal, String> {
    let form = "must be ARM=GOAL, such as left=named:home or left=0.1,-0.3,0.6,0,0.8,0";
    let (robot, goal) =
        text.split_once('=').filter(|(robot, goal)| !robot.is_empty() && !goal.is_empty()).ok_or(form)?;
    let mut planned = PlanGoal { robot: robot.to_owned(), ..PlanGoal::default() };
    match goal.split_once(':') {
        None if goal.starts_with(|c: char| c.is_ascii_alphabetic()) && finite(goal).is_err() && !goal.contains(',') => {
            return Err(format!("{goal:?} is not a number: a named pose is {robot}=named:{goal}"));
        }
        None => planned.joints = Some(numbers(goal)?),
        Some(("named", name)) => planned.named = Some(name.to_owned()),
        Some(("pose", list)) => (planned.pose, planned.frame) = pose_in_frame(list)?,
        Some(("by", list)) => (planned.by, planned.frame) = pose_in_frame(list)?,
        Some(_) => return Err(form.into()),
    }
    Ok(planned)
}

/// Parses a waypoint, as in `--through`. It gets its robot later.
fn waypoint(text: &str) -> std::result::Result<Waypoint, String> {
    let mut planned = PlanGoal::default();
    match text.split_once(':') {
        Some((kind @ ("pose" | "line"), list)) => {
            let numbers = |e| format!("{kind}: takes x,y,z, and r,p,y or a quaternion, as numbers: {e}");
            (planned.pose, planned.frame) = pose_in_frame(list).map_err(numbers)?;
            planned.linear = kind == "line";
        }
        Some(("arc", both)) => {
            let form = "must be arc:x,y,z/x,y,z,r,p,y: a place on the circle, and the pose at its end";
            let (via, list) = both.split_once('/').ok_or(form)?;
            let via = numbers(via)?;
            via.iter().copied().try_for_each(written::length)?;
            planned.via = Some(<[f64; 3]>::try_from(via).map_err(|_| form)?);
            (planned.pose, planned.frame) = pose_in_frame(list)?;
        }
        Some(("named", name)) => planned.named = Some(name.to_owned()),
        Some(("gripper", action)) => return grip::action(action).map(Waypoint::Grip),
        Some(_) => {
            return Err(
                "must be a name, joints as 0.1,-0.3,…, pose:x,y,z,…, line:x,y,z,…, arc:… or gripper:close".into()
            );
        }
        // Of an arm with one joint.
        None if text.contains(',') || finite(text).is_ok() => planned.joints = Some(numbers(text)?),
        None => planned.named = Some(text.to_owned()),
    }
    Ok(Waypoint::Goal(planned))
}

fn numbers(list: &str) -> std::result::Result<Vec<f64>, String> {
    list.split(',').map(|n| finite(n.trim()).map_err(|e| format!("{n:?}: {e}"))).collect()
}

/// Parses a pose and its frame, as in `x,y,z@cup`.
fn pose_in_frame(list: &str) -> std::result::Result<(Option<PoseSpec>, Option<String>), String> {
    match list.split_once('@') {
        Some((_, "")) => Err("@ needs a frame: map, base, tool, or an object of the world".into()),
        Some((list, frame)) => Ok((Some(pose(list)?), Some(frame.to_owned()))),
        None => Ok((Some(pose(list)?), None)),
    }
}

fn pose(list: &str) -> std::result::Result<PoseSpec, String> {
    let (mut rpy, mut quat) = (None, None);
    let numbers = numbers(list)?;
    numbers.iter().take(3).copied().try_for_each(written::length)?;
    let xyz = match *numbers {
        [x, y, z] => [x, y, z],
        [x, y, z, roll, pitch, yaw] => {
            [roll, pitch, yaw].into_iter().try_for_each(written::angle)?;
            rpy = Some([roll, pitch, yaw]);
            [x, y, z]
        }
        [x, y, z, qx, qy, qz, qw] => {
            quat = Some([qx, qy, qz, qw]);
            [x, y, z]
        }
        _ => return Err("a pose has 3, 6 or 7 numbers: x,y,z, then roll,pitch,yaw or qx,qy,qz,qw".into()),
    };
    Ok(PoseSpec { xyz, rpy, quat })
}

/// Parses how a plan is checked.
fn level(text: &str) -> std::result::Result<PlanLevel, String> {
    let all = [PlanLevel::Fast, PlanLevel::Certified, PlanLevel::Exact];
    all.into_iter().find(|level| level.name() == text).ok_or_else(|| "must be fast, certified or exact".into())
}

/// Settings of the search and the speed.
#[derive(Debug, Clone, clap::Args)]
pub struct Search {
    /// Fraction of the highest speed: 0.01–1, or 1–100%; at 0.5 the same motion takes twice as long
    #[arg(long, value_name = "FRACTION", default_value_t = DEFAULT_SPEED, value_parser = speed)]
    pub speed: f64,
    /// Move the tool centre point on a straight line to --pose or by --by; waypoints of --through have line: for that
    #[arg(long, requires = "tcp", conflicts_with = "through")]
    pub linear: bool,
    /// Highest speed of the tool centre point and the flange in this motion [m/s], kept where no joint is slower
    #[arg(long, value_name = "M/S", value_parser = tcp_speed)]
    pub tcp_speed: Option<f64>,
    /// Let the end effector and what it holds touch this obstacle: for --until force=N; repeat for more
    #[arg(long, value_name = "OBJECT")]
    pub touch: Vec<String>,
    /// Seed of the search: the same request with the same seed gives the same plan
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub seed: u64,
    /// Look for a shorter path in N rounds: 4 take about 0.3 ms, 100 some 40 ms, 0 takes the first path; 16
    /// and more also look for the quickest motion along it
    #[arg(long, value_name = "N", default_value_t = DEFAULT_REFINE)]
    pub refine: u32,
    /// How the plan is checked: certified proves it free of contact, between samples too; exact also finds the
    /// clearance to 0.5 mm; fast checks samples only, and is executed only with --unproven
    #[arg(long, value_name = "LEVEL", default_value = PlanLevel::default().name(), value_parser = level)]
    pub level: PlanLevel,
    /// Maximum planning time: 5s, or a number of seconds; default: the blueprint's planning_timeout
    #[arg(long, value_name = "TIME", value_parser = super::arguments::duration)]
    pub timeout: Option<Duration>,
}

impl Goal {
    /// Returns the joint positions, if they are the goal.
    pub fn joints(&self) -> Option<&[f64]> {
        (!self.joints.is_empty()).then_some(&self.joints)
    }

    /// Returns the pose, if it is the goal.
    pub fn pose(&self) -> Option<PoseSpec> {
        self.spec(&self.pose)
    }

    fn spec(&self, xyz: &Option<Vec<f64>>) -> Option<PoseSpec> {
        xyz.as_deref().and_then(|xyz| xyz.try_into().ok()).map(|xyz| PoseSpec {
            xyz,
            rpy: self.rpy.as_deref().and_then(|rpy| rpy.try_into().ok()),
            quat: self.quat.as_deref().and_then(|quat| quat.try_into().ok()),
        })
    }

    /// Returns the goals for the planner; `robot` is the robot of positions, pose and name.
    fn of(&self, robot: Option<&str>, path: Option<JointPath>, search: &Search) -> Vec<PlanGoal> {
        let Some(robot) = robot else { return self.several.clone() };
        vec![PlanGoal {
            robot: robot.to_owned(),
            joints: self.joints().map(<[f64]>::to_vec),
            pose: self.spec(&self.pose),
            by: self.spec(&self.by),
            frame: self.frame.clone(),
            named: self.named.clone(),
            path,
            linear: search.linear,
            via: self.via.as_deref().and_then(|via| via.try_into().ok()),
            retrace: None,
        }]
    }
}

impl Goal {
    /// Returns whether there are gripper actions between the waypoints.
    pub fn has_grips(&self) -> bool {
        self.through.iter().any(|waypoint| matches!(waypoint, Waypoint::Grip(_)))
    }

    /// Returns the names of poses among the waypoints.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.through.iter().filter_map(|waypoint| match waypoint {
            Waypoint::Goal(goal) => goal.named.as_deref(),
            Waypoint::Grip(_) => None,
        })
    }

    /// Returns the motions and the gripper actions of a motion with both, in order.
    /// `arm` has the gripper.
    pub fn legs(&self, robot: &str, arm: &str, search: &Search) -> Vec<Leg> {
        let goes = |waypoint: &Waypoint| matches!(waypoint, Waypoint::Goal(_));
        let leg = |part: &[Waypoint]| match part {
            [Waypoint::Grip(action)] => Leg::Grip(action.clone(), arm.to_owned()),
            part => Leg::Motion(Self { through: part.to_vec(), ..self.clone() }.planned(Some(robot), None, search)),
        };
        self.through.chunk_by(|a, b| goes(a) && goes(b)).map(leg).collect()
    }

    /// Returns a planning request, without gripper actions.
    pub fn plan(&self, client: &mut Client, robot: Option<&str>, search: &Search) -> Result<Plan> {
        let path = match (&self.path, robot) {
            (Some(file), Some(name)) => {
                let robots = client.call(Planner {})?.robots;
                let limits = robots.iter().find(|robot| robot.name == name).map(|robot| robot.limits.as_slice());
                // Continuous joints have no limits.
                let turns: Vec<bool> = limits.unwrap_or_default().iter().map(|l| *l == [None, None]).collect();
                let robots = robots.into_iter().map(|robot| (robot.name, robot.joints));
                let joints = recorded_path::joints_of(name, Code::UnknownRobot, robots.collect())?;
                Some(recorded_path::read(file, &joints, &turns, self.tolerance)?)
            }
            _ => None,
        };
        Ok(self.planned(robot, path, search))
    }

    fn planned(&self, robot: Option<&str>, path: Option<JointPath>, search: &Search) -> Plan {
        let own = |waypoint: &Waypoint| match waypoint {
            Waypoint::Goal(goal) => Some(PlanGoal { robot: robot.unwrap_or_default().to_owned(), ..goal.clone() }),
            Waypoint::Grip(_) => None,
        };
        let mut through: Vec<PlanGoal> = self.through.iter().filter_map(own).collect();
        Plan {
            goals: through.pop().map_or_else(|| self.of(robot, path, search), |last| vec![last]),
            speed: search.speed,
            seed: search.seed,
            level: search.level,
            refine: search.refine,
            timeout: search.timeout.map(|t| t.as_secs_f64()),
            through,
            blend: self.blend,
            tcp_speed: search.tcp_speed,
            touch: search.touch.clone(),
            by_number: false,
        }
    }
}

/// Returns whether the run has a planner. Fails if the planner has disconnected.
pub fn has_planner(client: &mut Client) -> Result<bool> {
    match client.call(Planner {}) {
        Ok(_) => Ok(true),
        Err(ClientError::Refused(RpcError { code: Code::NoPlanner, data: None, .. })) => Ok(false),
        Err(e) => Err(e.into()),
    }
}

/// A plan and its number.
pub struct Planned {
    /// Number for `preview` and `execute_plan`.
    pub plan: u64,
    /// Planning time [s].
    pub elapsed: f64,
    /// Figures of the plan.
    pub summary: PlanSummary,
}

impl Planned {
    /// Returns the plan of a report, if there is one.
    pub fn of(report: PlanningReport) -> Option<Self> {
        Some(Self { plan: report.plan, elapsed: report.elapsed, summary: report.summary? })
    }
}

/// Requests a plan and waits for it. A signal cancels planning.
pub fn plan(client: &mut Client, request: Plan, signals: &Signals) -> Result<Planned> {
    let begun = client.call(request)?;
    let bar = planning_bar();
    let mut cancelled = false;
    let report = loop {
        let report = client.call(Planning { plan: begun.plan })?;
        if report.state != "PLANNING" {
            break report;
        }
        bar.set_message(format!("{:.1} s", report.elapsed));
        bar.tick();
        if signals.last().is_some() && !std::mem::replace(&mut cancelled, true) {
            client.call(Cancel { plan: Some(begun.plan), ..Cancel::default() })?;
        }
        sleep(POLL_PERIOD);
    };
    bar.finish_and_clear();
    if let Some(signal) = signals.last() {
        let failure = Failure::new(Exit::by_signal(signal), "planning was cancelled: nothing has moved");
        return Err(failure);
    }
    let no_plan = no_plan(&report);
    Planned::of(report).ok_or(no_plan)
}

/// Returns what shows on a terminal that a motion is planned.
pub fn planning_bar() -> ProgressBar {
    let bar = ProgressBar::new_spinner().with_finish(ProgressFinish::AndClear);
    match ProgressStyle::with_template("{spinner} planning {msg}") {
        Ok(style) => bar.with_style(style),
        Err(_) => bar,
    }
}

/// Returns why there is no plan.
pub fn no_plan(report: &PlanningReport) -> Failure {
    let why = report.error.clone().unwrap_or_else(|| report.state.to_lowercase());
    Failure::new(Exit::Failed, format!("no plan: {why}")).maybe_hint(report.hint.clone())
}

/// Describes how a plan was checked.
pub fn checked(level: PlanLevel) -> &'static str {
    if level == PlanLevel::Fast { "checked at samples only" } else { "collision-checked" }
}

/// Prints a plan's figures.
pub fn show(planned: &Planned) {
    let s = &planned.summary;
    output::wrapped(format_args!(
        "plan {}: {:.2} s, {:.3} rad long, {} waypoints, found in {:.3} s (seed {})",
        planned.plan, s.duration, s.length, s.waypoints, planned.elapsed, s.seed
    ));
    if let Some(fraction) = s.fraction.filter(|fraction| *fraction < 1.0) {
        output::wrapped(format_args!("  straight line: {} % of the way", fixed(fraction * 100.0, 1)));
    }
    match (s.clearance, &s.closest) {
        (Some(depth), Some([a, b])) if depth < 0.0 => {
            output::wrapped(format_args!("  begins in contact: {a} and {b}, {} m deep", fixed(-depth, 4)));
        }
        (Some(clearance), Some([a, b])) if clearance < 1e-6 => {
            output::wrapped(format_args!("  proven free of contact; {a} comes close to {b}"));
        }
        (Some(clearance), Some([a, b])) => {
            output::wrapped(format_args!(
                "  proven clearance {} m, least between {a} and {b}",
                fixed(clearance, if clearance < 1e-3 { 6 } else { 4 })
            ));
        }
        (Some(clearance), None) => {
            output::wrapped(format_args!("  proven clearance {} m or more", fixed(clearance, 4)));
        }
        (None, _) if s.level == PlanLevel::Fast => {
            output::wrapped("  not proven free of contact: checked at samples only");
        }
        _ => {}
    }
    for clamped in &s.goal_clamped {
        let (joint, used, requested) = (&clamped.joint, fixed(clamped.used, 6), fixed(clamped.requested, 6));
        output::wrapped(format_args!("  goal of {joint}: {used}, its limit, instead of {requested}"));
    }
    for given_up in &s.padding_given_up {
        let where_ = match given_up.near.as_str() {
            "everywhere" => "in every configuration".to_owned(),
            near => format!("near the {near}"),
        };
        let (link, other, distance) = (&given_up.link, &given_up.other, fixed(given_up.distance, 4));
        let padding = fixed(s.padding, 4);
        output::wrapped(format_args!("  less than {padding} m {where_}: {link} is {distance} m from {other} there"));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_is_the_position_of_one_joint() {
        let goal = |text: &str| match waypoint(text) {
            Ok(Waypoint::Goal(goal)) => (goal.joints, goal.named),
            other => panic!("{other:?}"),
        };
        for (text, position) in [("0.5", 0.5), ("-0.5", -0.5), ("1e-3", 1e-3), ("2", 2.0)] {
            assert_eq!(goal(text), (Some(vec![position]), None), "{text}");
        }
        for (text, name) in
            [("home", "home"), ("named:2", "2"), ("2nd", "2nd"), ("-", "-"), ("nan", "nan"), ("inf", "inf")]
        {
            assert_eq!(goal(text), (None, Some(name.to_owned())), "{text}");
        }
        assert_eq!(goal("0.5,-0.5"), (Some(vec![0.5, -0.5]), None));
    }
}
