//! Goals of motions as typed on the command line, and planning.

use std::thread::sleep;
use std::time::Duration;

use indicatif::{ProgressBar, ProgressFinish, ProgressStyle};

use super::arguments::{finite, speed};
use super::exit::{Exit, Failure, Result};
use super::follow::Signals;
use super::output::{self, fixed};
use crate::rpc::api::{Cancel, DEFAULT_SPEED, Plan, PlanGoal, PlanSummary, Planner, Planning, PoseSpec};
use crate::rpc::client::{Client, ClientError};
use crate::rpc::{Code, RpcError};

/// Poll period while planning.
const POLL_PERIOD: Duration = Duration::from_millis(20);

/// Goal of a motion.
#[derive(Debug, Clone, clap::Args)]
#[group(id = "goal", required = true, multiple = true)]
pub struct Goal {
    /// Target positions of its joints [rad], one per joint, base first
    #[arg(value_name = "Q", value_parser = position, allow_negative_numbers = true, conflicts_with_all = ["tcp", "named"])]
    pub joints: Vec<f64>,
    /// Target position of the tool centre point: x, y, z [m]; orientation is free unless --rpy or --quat is given
    #[arg(long, value_names = ["X", "Y", "Z"], num_args = 3, value_parser = coordinate, allow_negative_numbers = true, group = "tcp")]
    pub pose: Option<Vec<f64>>,
    /// Move the tool centre point by x, y, z [m] along the axes of --frame; --rpy or --quat turns it about them
    #[arg(long, value_names = ["X", "Y", "Z"], num_args = 3, value_parser = coordinate, allow_negative_numbers = true, group = "tcp")]
    pub by: Option<Vec<f64>>,
    /// Roll, pitch, yaw about fixed axes [rad]
    #[arg(long, value_names = ["R", "P", "Y"], num_args = 3, value_parser = coordinate, allow_negative_numbers = true, requires = "tcp")]
    pub rpy: Option<Vec<f64>>,
    /// Orientation as a quaternion x, y, z, w
    #[arg(long, value_names = ["X", "Y", "Z", "W"], num_args = 4, value_parser = coordinate, allow_negative_numbers = true, requires = "tcp", conflicts_with = "rpy")]
    pub quat: Option<Vec<f64>>,
    /// Frame of --pose or --by: map (default), base, tool, or an object of the world
    #[arg(long, value_name = "FRAME", requires = "tcp")]
    pub frame: Option<String>,
    /// Named pose
    #[arg(long, value_name = "NAME", conflicts_with = "tcp")]
    pub named: Option<String>,
    /// Goal of one of several arms in a common motion (repeatable): left=0.1,-0.3,0.6,0,0.8,0 or left=named:home or
    /// left=pose:x,y,z or, with roll, pitch, yaw or a quaternion, left=pose:x,y,z,r,p,y or left=pose:x,y,z,qx,qy,qz,qw
    #[arg(long = "goal", value_name = "ARM=GOAL", value_parser = arm_goal, conflicts_with_all = ["joints", "tcp", "named"])]
    pub several: Vec<PlanGoal>,
    /// One motion through these waypoints; the last is the goal. Each is a named pose, joints as 0.1,-0.3,0.6,0,0.8,0,
    /// or pose:x,y,z,r,p,y (also with x,y,z or a quaternion); line:… is reached on a straight line
    #[arg(long, value_name = "WAYPOINT", num_args = 2.., value_parser = waypoint, allow_negative_numbers = true, conflicts_with_all = ["joints", "tcp", "named", "several"])]
    pub through: Vec<PlanGoal>,
    /// How far away the tool centre point may pass the waypoints [m]; 0: it stops at each
    #[arg(long, value_name = "DISTANCE", default_value_t = 0.0, value_parser = finite, requires = "through")]
    pub blend: f64,
}

/// Parses a joint position; a name and a list get a hint at what was probably meant.
fn position(text: &str) -> std::result::Result<f64, String> {
    let separate = text.split(',').all(|part| part.trim().parse::<f64>().is_ok());
    finite(text).map_err(|wrong| match text.chars().all(|c| c.is_ascii_alphanumeric() || matches!(c, '_' | '-')) {
        _ if text.contains(',') && separate => format!("{wrong}: separate the positions by blanks"),
        true if text.starts_with(|c: char| c.is_ascii_alphabetic()) && text.parse::<f64>().is_err() => {
            format!("{wrong}: a named pose is given with --named {text}")
        }
        _ => wrong,
    })
}

/// Parses a coordinate; a list with commas gets a hint.
fn coordinate(text: &str) -> std::result::Result<f64, String> {
    finite(text).map_err(|wrong| match text.contains(',') {
        true => format!("{wrong}: separate the numbers by blanks: {}", text.replace(',', " ")),
        false => wrong,
    })
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
        Some(("pose", list)) => planned.pose = Some(pose(list)?),
        Some(_) => return Err(form.into()),
    }
    Ok(planned)
}

/// Parses a waypoint, as in `--through`. It gets its robot later.
fn waypoint(text: &str) -> std::result::Result<PlanGoal, String> {
    let mut planned = PlanGoal::default();
    match text.split_once(':') {
        Some(("pose", list)) => planned.pose = Some(pose(list)?),
        Some(("line", list)) => (planned.pose, planned.linear) = (Some(pose(list)?), true),
        Some(("named", name)) => planned.named = Some(name.to_owned()),
        Some(_) => return Err("must be a name, joints as 0.1,-0.3,…, pose:x,y,z,… or line:x,y,z,…".into()),
        None if text.contains(',') => planned.joints = Some(numbers(text)?),
        None => planned.named = Some(text.to_owned()),
    }
    Ok(planned)
}

fn numbers(list: &str) -> std::result::Result<Vec<f64>, String> {
    list.split(',').map(|n| finite(n.trim()).map_err(|e| format!("{n:?}: {e}"))).collect()
}

fn pose(list: &str) -> std::result::Result<PoseSpec, String> {
    let (mut rpy, mut quat) = (None, None);
    let xyz = match *numbers(list)? {
        [x, y, z] => [x, y, z],
        [x, y, z, roll, pitch, yaw] => {
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

/// Settings of the search and the speed.
#[derive(Debug, Clone, clap::Args)]
pub struct Search {
    /// Fraction of the velocity and acceleration limits to use, 0.01–1
    #[arg(long, value_name = "FRACTION", default_value_t = DEFAULT_SPEED, value_parser = speed)]
    pub speed: f64,
    /// Move the tool centre point on a straight line to --pose or by --by
    #[arg(long, requires = "tcp")]
    pub linear: bool,
    /// Seed of the search: the same request with the same seed gives the same plan
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub seed: u64,
    /// Maximum planning time: 5s, or a number of seconds; default: the blueprint's planning_timeout
    #[arg(long, value_name = "TIME", value_parser = super::arguments::duration)]
    pub timeout: Option<Duration>,
}

impl Goal {
    /// Returns the joint positions, if they are the goal.
    pub fn joints(&self) -> Option<&[f64]> {
        (!self.joints.is_empty()).then_some(&self.joints)
    }

    /// Returns the goals for the planner; `robot` is the robot of positions, pose and name.
    fn of(&self, robot: Option<&str>, search: &Search) -> Vec<PlanGoal> {
        let Some(robot) = robot else { return self.several.clone() };
        if let Some(last) = self.through.last() {
            return vec![PlanGoal { robot: robot.to_owned(), ..last.clone() }];
        }
        let spec = |xyz: &Option<Vec<f64>>| {
            xyz.as_deref().and_then(|xyz| xyz.try_into().ok()).map(|xyz| PoseSpec {
                xyz,
                rpy: self.rpy.as_deref().and_then(|rpy| rpy.try_into().ok()),
                quat: self.quat.as_deref().and_then(|quat| quat.try_into().ok()),
            })
        };
        vec![PlanGoal {
            robot: robot.to_owned(),
            joints: self.joints().map(<[f64]>::to_vec),
            pose: spec(&self.pose),
            by: spec(&self.by),
            frame: self.frame.clone(),
            named: self.named.clone(),
            linear: search.linear,
            path: None,
        }]
    }
}

impl Goal {
    /// Returns a planning request.
    pub fn plan(&self, robot: Option<&str>, search: &Search) -> Plan {
        let before = self.through.split_last().map(|(_, before)| before).unwrap_or_default();
        let own = |goal: &PlanGoal| PlanGoal { robot: robot.unwrap_or_default().to_owned(), ..goal.clone() };
        Plan {
            goals: self.of(robot, search),
            speed: search.speed,
            seed: search.seed,
            timeout: search.timeout.map(|t| t.as_secs_f64()),
            through: before.iter().map(own).collect(),
            blend: self.blend,
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

/// Requests a plan and waits for it. A signal cancels planning.
pub fn plan(client: &mut Client, request: Plan, signals: &Signals) -> Result<Planned> {
    let begun = client.call(request)?;
    let bar = ProgressBar::new_spinner().with_finish(ProgressFinish::AndClear);
    if let Ok(style) = ProgressStyle::with_template("{spinner} planning {msg}") {
        bar.set_style(style);
    }
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
    match report.summary {
        Some(summary) => Ok(Planned { plan: report.plan, elapsed: report.elapsed, summary }),
        None => {
            let why = report.error.unwrap_or_else(|| report.state.to_lowercase());
            let failure = Failure::new(Exit::Failed, format!("no plan: {why}"));
            Err(report.hint.into_iter().fold(failure, |failure, hint| failure.hint(hint)))
        }
    }
}

/// Prints a plan's figures.
pub fn show(planned: &Planned) {
    let s = &planned.summary;
    output::line(format_args!(
        "plan {}: {:.2} s, {:.3} rad long, {} waypoints, found in {:.3} s (seed {})",
        planned.plan, s.duration, s.length, s.waypoints, planned.elapsed, s.seed
    ));
    if let Some(fraction) = s.fraction.filter(|fraction| *fraction < 1.0) {
        output::line(format_args!("  straight line: {} % of the way", fixed(fraction * 100.0, 1)));
    }
    match (s.clearance, &s.closest) {
        (Some(clearance), Some([a, b])) => {
            output::line(format_args!("  clearance {} m, between {a} and {b}", fixed(clearance, 4)));
        }
        (Some(clearance), None) => output::line(format_args!("  clearance {} m", fixed(clearance, 4))),
        _ => {}
    }
    for clamped in &s.goal_clamped {
        let (joint, used, requested) = (&clamped.joint, fixed(clamped.used, 6), fixed(clamped.requested, 6));
        output::line(format_args!("  goal of {joint}: {used}, its limit, instead of {requested}"));
    }
    for given_up in &s.padding_given_up {
        let where_ = match given_up.near.as_str() {
            "everywhere" => "in every configuration".to_owned(),
            near => format!("near the {near}"),
        };
        let (link, other, distance) = (&given_up.link, &given_up.other, fixed(given_up.distance, 4));
        let padding = fixed(s.padding, 4);
        output::line(format_args!("  less than {padding} m {where_}: {link} is {distance} m from {other} there"));
    }
}
