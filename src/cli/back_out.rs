//! `dimos back-out [ARM]`: an arm retraces the path that the run logged, back to where it was at rest before its last
//! motion. With a planner the whole way is checked for collisions before anything moves.

use std::path::Path;
use std::time::Duration;

use super::arguments::{self, Target};
use super::banner;
use super::exit::{Exit, Failure, Result};
use super::follow::Signals;
use super::goal::{has_planner, plan, show};
use super::going;
use super::output::{self, Table, fixed, signed, span};
use crate::offline::{TimingSettings, length, thin, time};
use crate::replay::motion::{RecordedMotion, tcp_path};
use crate::replay::recorded::Recorded;
use crate::replay::recorded::RecordedError;
use crate::replay::retrace::{Back, ON_PATH, Retrace, RetraceError, retrace};
use dimos_core::joint::JointBounds;
use dimos_core::trajectory::JointTrajectory;
use dimos_log::replay::LogReader;
use dimos_rpc::api::{
    Execute, ExecutePlan, ExecuteReply, GoBegun, GoStep, MAX_LINE, Motion, Plan, PlanGoal, Planner, Point, State,
    Status, Trajectory,
};
use dimos_rpc::client::Client;
use dimos_rpc::report::{ArmReport, StatusReport};

/// Deviation from the logged path at its corners [rad]: between two corners it is straight.
const DEVIATION: f64 = 1e-3;
/// Largest distance from the logged path of a direct way back [rad]: a long, curved one has too many points otherwise.
const FARTHEST: f64 = 0.02;
/// Bytes of a request besides its trajectory, at most.
const ENVELOPE: usize = 256;
/// Parts of the log that are searched, from its end [s]; at last, all of it.
const WINDOWS: [f64; 3] = [60.0, 1200.0, 1e9];
/// Longest delay of the log behind the run.
const LOG_DELAY: Duration = Duration::from_millis(300);

/// Arguments of `back-out`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Retraces the path that the run's log has, slowly, to where the arm was at rest before its last motion; again, to where \
it was at rest before that one. With a planner, the whole way is checked for collisions first. A held arm stays held: \
reset and enable it yourself.

  dimos back-out arm --check                    show the way; nothing moves
  dimos arm reset arm && dimos arm enable arm   after a stop
  dimos back-out arm")]
pub struct Args {
    /// Name of the arm (hardware_id); may be omitted if the run has one
    pub arm: Option<String>,
    /// Go back by this much time of logged motion; rests do not count
    #[arg(long, value_name = "TIME", value_parser = arguments::duration)]
    pub time: Option<Duration>,
    /// Go back by this length of the tool centre point's path [m]
    #[arg(long, value_name = "METRES", value_parser = arguments::finite, conflicts_with_all = ["time", "motions"])]
    pub distance: Option<f64>,
    /// Go back by this many motions
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..), conflicts_with = "time")]
    pub motions: u32,
    /// Fraction of the highest speed
    #[arg(long, default_value_t = 0.2, value_parser = arguments::speed)]
    pub speed: f64,
    /// Show the way and check it; move nothing
    #[arg(long)]
    pub check: bool,
    /// Not collision-checked; required if the run has no planner
    #[arg(long)]
    pub direct: bool,
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let mut client = args.target_run.connect()?;
    let signals = Signals::watch();
    let status = client.call(Status {})?;
    let arm = arm_of(&status, args.arm.as_deref())?;
    let planned = !args.direct && has_planner(&mut client)?;
    if !planned && !args.direct {
        let failure =
            Failure::new(Exit::Failed, "this run has no planner: the way back cannot be checked for collisions");
        return Err(failure.hint("run a planner beside this run; or look at the way yourself, and add --direct"));
    }
    let log = status.log.as_ref().map(Path::new).ok_or_else(|| {
        Failure::new(Exit::Failed, "this run writes no log: there is no path to retrace")
            .hint("run it without --no-record")
    })?;
    let name = &arm.hardware_id;
    let (joints, way, ago) = way_back(&mut client, &status, name, log, args)?;
    let json = args.target_run.json;
    if !json {
        describe(name, &joints, &way, ago);
    }
    let held = (arm.phase != "ready").then(|| not_ready(arm));
    let to = Some(way.time as f64 * 1e-9);
    let (going, begun) = if planned {
        let request = request(&mut client, name, &joints, &way, args.speed)?;
        let found = plan(&mut client, request, &signals)?;
        if !json {
            show(&found);
        }
        if let Some(end) = end_here(args, &way, held, Some(found.summary.duration)) {
            return end;
        }
        signals.check()?;
        let execute = ExecutePlan { plan: Some(found.plan), retraces_to: to, ..ExecutePlan::default() };
        let going = going::go(&mut client, GoStep::ExecutePlan(Box::new(execute)))?;
        let begun = going::begin(&mut client, (going, 0), Some(&signals), false)?.reply;
        output::note(format_args!("motion {} on {}: planned, collision-checked", begun.motion(), begun.task()));
        (going, begun)
    } else {
        let trajectory = timed(&mut client, log, name, &way, args.speed)?;
        let duration = trajectory.points.last().map(|point| point.time_from_start);
        if let Some(end) = end_here(args, &way, held, duration) {
            return end;
        }
        signals.check()?;
        let execute = Execute { trajectory, task: None, retraces_to: to };
        let going = going::go(&mut client, GoStep::Execute(Box::new(execute)))?;
        let begun = going::begin(&mut client, (going, 0), Some(&signals), false)?.reply;
        if let GoBegun::Execute(ExecuteReply { motion, task, duration }) = &begun {
            output::note(format_args!("motion {motion} on {task}: {duration:.2} s, direct, not collision-checked"));
        }
        (going, begun)
    };
    going::finish(&mut client, going, &begun, &signals, json)
}

/// Returns the result if nothing is to move: the arm is held, or `--check`.
fn end_here(args: &Args, way: &Retrace, held: Option<Failure>, duration: Option<f64>) -> Option<Result> {
    match held {
        Some(failure) if !args.check => return Some(Err(failure)),
        None if !args.check => return None,
        _ => {}
    }
    if args.target_run.json {
        let goal = way.path.last();
        let (length, time) = (length(&way.path), way.time as f64 * 1e-9);
        output::json(&serde_json::json!({"duration": duration, "length": length, "goal": goal, "time": time,
            "ready": held.is_none()}));
    } else {
        output::note("nothing has moved");
    }
    Some(Ok(Exit::Ok))
}

fn arm_of<'s>(status: &'s StatusReport, name: Option<&str>) -> Result<&'s ArmReport> {
    let names = status.arms.iter().map(|arm| arm.hardware_id.as_str());
    match (name, status.arms.as_slice()) {
        (None, [only]) => Ok(only),
        (None, _) => {
            let names: Vec<&str> = names.collect();
            Err(Failure::usage(format!("the run has several arms: {}", names.join(", ")))
                .hint("name one: dimos back-out ARM"))
        }
        (Some(name), arms) => arms.iter().find(|arm| arm.hardware_id == name).ok_or_else(|| {
            Failure::usage(format!("no arm is named {name}")).maybe_hint(dimos_yaml::did_you_mean(name, names, "arms"))
        }),
    }
}

fn not_ready(arm: &ArmReport) -> Failure {
    let (name, cause) = (&arm.hardware_id, banner::cause(arm));
    let cause = cause.map_or_else(String::new, |cause| format!(": {cause}"));
    let reset = if arm.phase == "held" { format!("dimos arm reset {name}, then ") } else { String::new() };
    Failure::new(Exit::Failed, format!("{name} is {}{cause}; nothing has moved", arm.phase))
        .hint(format!("when it may move again: {reset}dimos arm enable {name}, then dimos back-out {name}"))
}

/// Returns the state of an arm: time [s since 1970], names and measured positions of its joints [rad].
fn present(client: &mut Client, arm: &str) -> Result<(f64, Vec<String>, Vec<f64>)> {
    let state = client.call(State {})?;
    let joints = state.arms.iter().find(|a| a.hardware_id == arm).map_or(&[][..], |arm| &arm.joints);
    let now = joints.iter().map(|j| j.position).collect::<Option<Vec<f64>>>().filter(|now| !now.is_empty());
    let now = now.ok_or_else(|| Failure::new(Exit::Failed, format!("{arm} reports no position")))?;
    Ok((state.stamp, joints.iter().map(|j| j.name.clone()).collect(), now))
}

/// Returns the joints of the arm, its way back, and the age of the goal [s].
fn way_back(
    client: &mut Client,
    status: &StatusReport,
    arm: &str,
    log: &Path,
    args: &Args,
) -> Result<(Vec<String>, Retrace, f64)> {
    if args.distance.is_some_and(|metres| metres <= 0.0) {
        return Err(Failure::usage("--distance is a length above 0 m"));
    }
    if args.distance.is_some() && !status.arms.iter().any(|a| a.hardware_id == arm && a.tcp.is_some()) {
        let failure =
            Failure::new(Exit::Failed, format!("this run has no model of {arm}: its path has no length in m"));
        return Err(failure.hint("go back by --time or --motions, or run a planner blueprint"));
    }
    let mut delays = [LOG_DELAY].into_iter();
    loop {
        let (stamp, joints, now) = present(client, arm)?;
        let from = retraced_to(client, status, &joints, &now);
        let mut result = Err(RetraceError::TooShort);
        for window in WINDOWS {
            let since = ((from.unwrap_or(stamp).min(stamp) - window).max(0.0) * 1e9) as u64;
            let motion = RecordedMotion::measured(log, &joints, since, u64::MAX);
            let exit =
                |e: &RecordedError| if matches!(e, RecordedError::Lacks { .. }) { Exit::Log } else { Exit::Failed };
            let motion = motion.map_err(|e| Failure::of(exit(&e), e))?;
            let tcp = args.distance.map(|_| tcp_path(log, arm, since, u64::MAX)).transpose();
            let tcp = tcp.map_err(|e| Failure::of(Exit::Failed, e))?.unwrap_or_default();
            let back = match (args.distance, args.time) {
                (Some(metres), _) => Back::Distance(metres, &tcp),
                (_, Some(time)) => Back::Time(time.as_secs_f64()),
                _ => Back::Motions(args.motions),
            };
            result = retrace(&motion, &now, from.map(|from| (from * 1e9) as u64), back);
            if result != Err(RetraceError::TooShort) {
                break;
            }
        }
        match result {
            Ok(way) => {
                let ago = (stamp - way.time as f64 * 1e-9).max(0.0);
                return Ok((joints, way, ago));
            }
            // What the arm did last is not in the log yet.
            Err(RetraceError::Elsewhere { .. }) if delays.next().map(std::thread::sleep).is_some() => {}
            Err(error @ RetraceError::Elsewhere { .. }) => {
                return Err(Failure::new(Exit::Failed, error.to_string()).hint("move it with `dimos move`, or by hand"));
            }
            Err(RetraceError::TooShort) => {
                let what = format!("the log has no earlier motion of {arm} that could be retraced so far");
                let hint = "ask for less with --motions, --time or --distance; `dimos replay --last` plays the log";
                return Err(Failure::new(Exit::Failed, what).hint(hint));
            }
        }
    }
}

/// Returns the time in the log to which the newest motion of these joints retraced it [s since 1970], if it did and
/// nothing has moved them since: a stream, a hand or the arm's controller, which are no motions of a task.
fn retraced_to(client: &mut Client, status: &StatusReport, joints: &[String], now: &[f64]) -> Option<f64> {
    let moves = status.tasks.iter().filter(|task| task.joints.iter().any(|joint| joints.contains(joint)));
    let newest = moves.filter_map(|task| task.motion).max()?;
    let motion = client.call(Motion { motion: newest }).ok()?;
    let ends = motion.deviation.unwrap_or_default();
    let is_there = |(joint, q): (&String, &f64)| {
        ends.iter().filter(|end| end.joint == *joint).all(|end| (end.actual - q).abs() <= ON_PATH)
    };
    motion.retraces_to.filter(|_| joints.iter().zip(now).all(is_there))
}

fn describe(arm: &str, joints: &[String], way: &Retrace, ago: f64) {
    let rest = if way.at_rest { "where it was at rest" } else { "where it was" };
    let (far, ago, took) = (fixed(length(&way.path), 3), span(ago), span(way.duration));
    output::line(format_args!("{arm}: back by {far} rad along its logged path, {rest} {ago} ago ({took} of motion)"));
    let (Some(first), Some(last)) = (way.path.first(), way.path.last()) else { return };
    let mut table = Table::new(&["JOINT", ">NOW rad", ">GOAL rad", ">BY rad"]);
    for (j, joint) in joints.iter().enumerate() {
        table.row([joint.clone(), fixed(first[j], 4), fixed(last[j], 4), signed(last[j] - first[j], 4)]);
    }
    table.print();
}

/// Returns the planning request: the way, in the order of the planning robot's joints.
fn request(client: &mut Client, arm: &str, joints: &[String], way: &Retrace, speed: f64) -> Result<Plan> {
    let robots = client.call(Planner {})?.robots;
    let order = |robot: &dimos_rpc::api::RobotReport| -> Option<Vec<usize>> {
        robot.joints.iter().map(|joint| joints.iter().position(|j| j == joint)).collect()
    };
    let fitting = robots.iter().filter_map(|robot| Some((robot, order(robot)?)));
    let (robot, order) = { fitting }.max_by_key(|(robot, _)| robot.name == arm).ok_or_else(|| {
        Failure::new(Exit::Failed, format!("the planner has no robot with the joints of {arm}"))
            .hint("look at the way yourself, and add --direct")
    })?;
    let row = |q: &Vec<f64>| order.iter().map(|j| q[*j]).collect();
    let goal = PlanGoal {
        robot: robot.name.clone(),
        retrace: Some(way.path.iter().map(row).collect()),
        ..PlanGoal::default()
    };
    Ok(Plan { goals: vec![goal], speed, by_number: true, ..Plan::default() })
}

/// Returns the way as a trajectory at `speed` times the highest speed, from where the arm is. It is as close to the
/// logged path as one request allows.
fn timed(client: &mut Client, log: &Path, arm: &str, way: &Retrace, speed: f64) -> Result<Trajectory> {
    let fail = |e: String| Failure::new(Exit::Failed, format!("no trajectory: {e}"));
    let opened = LogReader::open_for(log, &[]).map_err(|e| Failure::of(Exit::Failed, e))?;
    let recorded = Recorded::of(log, opened.info().clone()).map_err(|e| Failure::of(Exit::Failed, e))?;
    let config = recorded.config.arms.iter().find(|config| config.name == arm);
    let l = &config.ok_or_else(|| fail(format!("the log has no limits of {arm}")))?.limits;
    let (_, joints, now) = present(client, arm)?;
    let bounds: Vec<JointBounds> = (0..joints.len()).filter_map(|j| l.joint(j)).collect();
    let whole: Vec<Vec<f64>> = std::iter::once(now).chain(way.path.iter().cloned()).collect();
    // Half of the distance is for the straight lines, half for the blends between them.
    let (mut path, mut deviation) = (whole.clone(), DEVIATION);
    while deviation <= FARTHEST / 2.0 {
        let settings = TimingSettings { deviation, speed, ..TimingSettings::default() };
        let timed = time(&joints, &path, &bounds, &settings, |_, _| true);
        let trajectory = request_of(&joints, timed.map_err(|e| fail(e.to_string()))?.trajectory);
        if serde_json::to_string(&trajectory).is_ok_and(|text| text.len() + ENVELOPE <= MAX_LINE) {
            if deviation > DEVIATION {
                output::note(format_args!("a long way: within {} rad of the logged path", 2.0 * deviation));
            }
            return Ok(trajectory);
        }
        deviation *= 2.0;
        path = thin(&whole, deviation);
    }
    Err(Failure::new(Exit::Failed, "the way back is too long for one direct motion")
        .hint("go back in parts: --time 10s, --distance 0.5, or --motions"))
}

fn request_of(joints: &[String], trajectory: JointTrajectory) -> Trajectory {
    let points = trajectory.points.into_iter().map(|p| Point {
        time_from_start: p.time_from_start,
        positions: p.positions.into_vec(),
        velocities: Some(p.velocities.into_vec()),
        accelerations: Some(p.accelerations.into_vec()).filter(|a| !a.is_empty()),
    });
    Trajectory { joint_names: joints.to_vec(), points: points.collect() }
}
