//! `dimos move ARM …`: moves one arm or several together to joint positions, a pose or a named pose. With a planner in
//! the run the motion is planned and collision-free; without one it is direct.

use super::arguments::{Target, finite};
use super::exit::{Exit, Failure, Result};
use super::follow::{Followed, Signals, end, watch};
use super::goal::{Goal, Leg, Search, checked, has_planner};
use super::grip;
use super::{full_speed, going, output, recorded_path};
use dimos_core::telemetry::texts::percent;
use dimos_rpc::Code;
use dimos_rpc::api::{
    Cancel, Go, GoBegun, GoStep, GripObjects, Move, MoveNative, MoveReply, Plan, PlanLevel, Planner, Poses, State,
    Status, Until, World,
};
use dimos_rpc::client::Client;

/// Arguments of `move`.
#[derive(Debug, clap::Args)]
#[command(
    group = clap::ArgGroup::new("goal").required(true).multiple(true),
    override_usage = "\
dimos move ARM Q… [OPTIONS]
       dimos move ARM --named NAME [OPTIONS]
       dimos move ARM --pose X Y Z [--rpy R P Y | --quat X Y Z W] [OPTIONS]
       dimos move ARM --by X Y Z [--frame FRAME] [OPTIONS]
       dimos move ARM --through WAYPOINT… [--blend DISTANCE] [OPTIONS]
       dimos move ARM --path FILE [--tolerance ANGLE] [OPTIONS]
       dimos move --goal ARM=GOAL… [OPTIONS]",
    after_help = "\
With a planner in the run the motion is planned and collision-free; without one it is direct, not collision-checked, and \
its goal is given as joint positions.

  dimos move arm 0.3 -0.2 0.5 0 0.4 0
  dimos move arm --pose 0.3 0.1 0.4 --rpy 0 1.57 0
  dimos move arm --named home
  dimos move --goal left=named:home --goal right=0.5,-0.3,0.6,0,0.8,0
  dimos move arm --by 0 0 -0.1 --frame tool --linear --until force=5
  dimos move arm --through above grasp gripper:close above place gripper:open"
)]
pub struct Args {
    /// Name of the arm (hardware_id); with several arms use --goal for each
    #[arg(required_unless_present = "several", conflicts_with = "several")]
    pub arm: Option<String>,
    /// Goal of the motion
    #[command(flatten)]
    pub goal: Goal,
    /// Settings of the search
    #[command(flatten)]
    pub search: Search,
    /// Move straight in joint space even if the run has a planner: not collision-checked
    #[arg(long, conflicts_with_all = ["several", "touch"])]
    pub direct: bool,
    /// Let the arm's own controller move to --pose: not collision-checked; with a planner in the run only with
    /// --direct. --frame controller gives the pose in the controller's own frame
    #[arg(long, requires = "pose", conflicts_with_all = ["joints", "named", "by", "several", "through", "path", "linear", "via", "tcp_speed", "touch", "replan"])]
    pub native: bool,
    /// If an obstacle blocks the motion, stop, plan again and continue
    #[arg(long, conflicts_with_all = ["direct", "no_wait", "path"])]
    pub replan: bool,
    /// End the motion before its goal: force=N, torque=NM, input=di0[:low], distance=M or time=S; repeat for more.
    /// Exit code 1 if the goal came first
    #[arg(long, value_name = "KEY=VALUE", conflicts_with_all = ["native", "replan", "no_wait", "several"])]
    pub until: Vec<String>,
    /// Print the force to expect at most, for this stiffness of what is touched [N/mm]
    #[arg(long, value_name = "N/MM", value_parser = finite, requires = "until", conflicts_with = "direct")]
    pub stiffness: Option<f64>,
    /// Execute a plan of --level fast, which is not proven free of contact
    #[arg(long, conflicts_with = "direct")]
    pub unproven: bool,
    /// Return when the motion has begun
    #[arg(long)]
    pub no_wait: bool,
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    if args.goal.has_grips() && (args.no_wait || args.direct) {
        return Err(Failure::usage("a motion with gripper actions is planned, and waits for each part")
            .hint("without --no-wait and --direct"));
    }
    if args.search.level == PlanLevel::Fast && !args.unproven {
        return Err(Failure::usage("a plan of --level fast is not proven free of contact: nothing has moved")
            .hint("leave --level out, or add --unproven"));
    }
    let until = until(args)?;
    let mut client = args.target_run.connect()?;
    let signals = Signals::watch();
    if args.native {
        return move_native(args, &mut client, &signals);
    }
    if let (Some(arm), true) = (&args.arm, args.goal.has_grips()) {
        return run_legs(args, arm, &mut client, &signals);
    }
    let planned = !args.direct && has_planner(&mut client)?;
    let json = args.target_run.json;
    let (going, begun) = if planned {
        let request = args.goal.plan(&mut client, args.arm.as_deref(), &args.search)?;
        let request = plans(args, &mut client, [Leg::Motion(request)], &signals)?;
        let going = client.call(Go { until: until.clone(), ..request })?.going;
        (going, begin_planned(&mut client, (going, 0), &signals, json)?)
    } else {
        begin_direct(args, &mut client, &until, &signals)?
    };
    if !args.no_wait {
        return match until.first() {
            Some(until) => going::finish_until(&mut client, (going, until), &begun, &signals, json),
            None => going::finish(&mut client, going, &begun, &signals, json),
        };
    }
    if json {
        output::json(&serde_json::to_value(&begun).unwrap_or_default());
    }
    Ok(Exit::Ok)
}

/// Lets the arm's own controller move it.
fn move_native(args: &Args, client: &mut Client, signals: &Signals) -> Result {
    let (Some(arm), Some(pose)) = (&args.arm, args.goal.pose()) else { return Ok(Exit::Usage) };
    let controller_frame = match args.goal.frame.as_deref() {
        None | Some("map") => false,
        Some("controller") => true,
        Some(other) => return Err(Failure::usage(format!("--native takes --frame map or controller, not {other}"))),
    };
    let speed = args.search.speed.min(full_speed::limit(client, std::slice::from_ref(arm))?);
    signals.check()?;
    let request = MoveNative { arm: arm.clone(), pose, controller_frame, speed, direct: args.direct };
    let begun = client.call(request)?;
    let (motion, speed) = (begun.motion, percent(begun.speed));
    output::note(format_args!(
        "motion {motion} by {arm}'s own controller at {speed} of its top speed: not collision-checked"
    ));
    if let Some(tool) = begun.tool.filter(|tool| *tool > 1e-3) {
        output::note(format_args!(
            "  the controller's pose is {tool:.3} m from the tool centre point: right if that is a tool, wrong if the \
             base frames differ; `dimos state` prints both"
        ));
    }
    if args.no_wait {
        if args.target_run.json {
            output::json(&begun);
        }
        return Ok(Exit::Ok);
    }
    let cancel = Cancel { arm: Some(arm.clone()), ..Cancel::default() };
    let ended = watch(client, Followed::Motion, motion, &cancel, arm, signals)?;
    end(client, ended, args.target_run.json)
}

/// Shows a motion with gripper actions part by part. The run plans each motion once the action before it has succeeded,
/// so for the fingers and the attached objects as they are then.
fn run_legs(args: &Args, arm: &str, client: &mut Client, signals: &Signals) -> Result {
    let robots = client.call(Planner {})?.robots;
    let saved = client.call(Poses {})?.poses;
    let robot = robots.iter().find(|robot| robot.name == arm);
    // A wrong name ends it before anything moves.
    let is_known = |name: &&str| saved.contains_key(*name) || robot.is_none_or(|r| r.named_poses.contains_key(*name));
    if let Some(name) = args.goal.names().find(|name| !is_known(name)) {
        return Err(Failure::usage(format!("{arm} has no named pose {name}: nothing has moved"))
            .hint("`dimos pose list` lists the poses"));
    }
    let own = grip::arm_of(client, robot, arm)?;
    let legs = args.goal.legs(arm, &own, &args.search);
    check_grips(&own, client, &legs)?;
    let go = plans(args, client, legs, signals)?;
    let are_grips: Vec<bool> = go.steps.iter().map(|step| matches!(step, GoStep::Gripper(_))).collect();
    let (going, json) = (client.call(go)?.going, args.target_run.json);
    for (step, is_grip) in are_grips.into_iter().enumerate() {
        if is_grip {
            going::grip(client, (going, step), signals, json).map_err(|failure| {
                let what = format!("{}: the motion ends here", failure.what);
                Failure { what, ..failure }
            })?;
            continue;
        }
        let begun = begin_planned(client, (going, step), signals, json)?;
        match going::finish(client, going, &begun, signals, json)? {
            Exit::Ok => {}
            exit => return Ok(exit),
        }
    }
    Ok(Exit::Ok)
}

/// Fails if one of the gripper actions cannot be done: no such gripper, position or object.
fn check_grips(arm: &str, client: &mut Client, legs: &[Leg]) -> Result<()> {
    let report = client.call(Status {})?.arms.into_iter().find(|report| report.hardware_id == arm);
    let objects = client.call(World {})?.objects;
    for leg in legs {
        let (Leg::Grip(action, _), Some(report)) = (leg, &report) else { continue };
        if let Some((what, hint)) = grip::impossible(report, action.opening, action.force) {
            return Err(Failure::usage(format!("{what}: nothing has moved")).maybe_hint(hint));
        }
        if let Some(GripObjects::Attach(name) | GripObjects::Either(name)) = &action.objects
            && !objects.iter().any(|object| object.name == *name)
        {
            let failure = grip::unknown_object(name, &objects);
            return Err(Failure { what: format!("{}: nothing has moved", failure.what), ..failure });
        }
    }
    Ok(())
}

/// Returns the request for motions that are planned, and for the gripper actions between them.
fn plans(args: &Args, client: &mut Client, legs: impl IntoIterator<Item = Leg>, signals: &Signals) -> Result<Go> {
    let mut limit = None;
    let mut steps = Vec::new();
    for leg in legs {
        steps.push(match leg {
            Leg::Motion(request) => {
                let robots: Vec<String> = request.goals.iter().map(|goal| goal.robot.clone()).collect();
                let most = limit.map_or_else(|| full_speed::limit(client, &robots), Ok)?;
                limit = Some(most);
                GoStep::Plan(Box::new(Plan { speed: request.speed.min(most), ..request }))
            }
            Leg::Grip(action, arm) => GoStep::Gripper(Box::new(action.request(client, &arm)?)),
        });
    }
    signals.check()?;
    Ok(Go { steps, replan: args.replan, unproven: args.unproven, ..Go::default() })
}

/// Waits until a planned motion begins, and prints its plan.
fn begin_planned(client: &mut Client, at: (u64, usize), signals: &Signals, json: bool) -> Result<GoBegun> {
    let going::Begun { planned, reply, peak } = going::begin(client, at, Some(signals), !json)?;
    if let Some(peak) = peak {
        output::note(format_args!("  force: {peak:.1} N at most, if what is touched is no stiffer than given"));
    }
    let checked = planned.map_or("collision-checked", |planned| checked(planned.summary.level));
    output::note(format_args!("motion {} on {}: planned, {checked}", reply.motion(), reply.task()));
    Ok(reply)
}

/// Returns the conditions of the motion: none or one.
fn until(args: &Args) -> Result<Vec<Until>> {
    if args.until.is_empty() {
        return Ok(Vec::new());
    }
    if args.goal.has_grips() {
        let failure = Failure::usage("--until is about one motion, and this has several parts");
        return Err(failure.hint("a job has `until` at each of its motions: docs/jobs.md"));
    }
    let until = Until::parse(&args.until).map(|until| Until { stiffness: args.stiffness.or(until.stiffness), ..until });
    let until = until.and_then(|until| until.valid().map(|()| until));
    Ok(vec![until.map_err(|what| Failure::usage(format!("--until: {what}")))?])
}

fn begin_direct(args: &Args, client: &mut Client, until: &[Until], signals: &Signals) -> Result<(u64, GoBegun)> {
    if let (Some(arm), Some(file)) = (&args.arm, &args.goal.path) {
        let arms = client.call(State {})?.arms.into_iter();
        let arms = arms.map(|a| (a.hardware_id, a.joints.into_iter().map(|joint| joint.name).collect()));
        let joints = recorded_path::joints_of(arm, Code::UnknownArm, arms.collect())?;
        let path = Some(recorded_path::read(file, &joints, &[], args.goal.tolerance)?);
        let speed = args.search.speed.min(full_speed::limit(client, std::slice::from_ref(arm))?);
        signals.check()?;
        let request = Move { direct: args.direct, path, ..Move::new(arm, [], speed) };
        return direct(client, request, (until, signals), "direct to its first point and along the path");
    }
    let target = match (&args.arm, args.goal.joints(), &args.goal.named) {
        (Some(arm), Some(target), _) => Some((arm, target.to_vec())),
        (Some(arm), None, Some(name)) => Some((arm, saved(client, arm, name)?)),
        _ => None,
    };
    let Some((arm, target)) = target else {
        if args.direct {
            let failure = Failure::usage("--direct takes joint positions, or --named with a saved pose");
            return Err(failure.hint("leave it out for a planned motion, or add --native to --pose"));
        }
        let failure = Failure::new(Exit::Failed, "poses, --goal and --through need a planner, and this run has none");
        return Err(failure.hint("run a planner blueprint, such as yourarm-planner, or give joint positions"));
    };
    signals.check()?;
    let speed = args.search.speed.min(full_speed::limit(client, std::slice::from_ref(arm))?);
    signals.check()?;
    let request = Move { direct: args.direct, ..Move::new(arm.clone(), target, speed) };
    direct(client, request, (until, signals), "direct")
}

/// Begins a direct motion, and prints what it does.
fn direct(
    client: &mut Client,
    request: Move,
    (until, signals): (&[Until], &Signals),
    how: &str,
) -> Result<(u64, GoBegun)> {
    let steps = vec![GoStep::Move(Box::new(request))];
    let going = client.call(Go { steps, until: until.to_vec(), ..Go::default() })?.going;
    let begun = going::begin(client, (going, 0), Some(signals), false)?.reply;
    let GoBegun::Move(MoveReply { motion, task, duration, .. }) = &begun else { return Ok((going, begun)) };
    output::note(format_args!("motion {motion} on {task}: {duration:.2} s, {how}, not collision-checked"));
    Ok((going, begun))
}

/// Returns the positions of an arm's joints in a saved pose [rad].
fn saved(client: &mut Client, arm: &str, name: &str) -> Result<Vec<f64>> {
    let poses = client.call(Poses {})?.poses;
    let Some(pose) = poses.get(name) else {
        let names: Vec<&str> = poses.keys().map(String::as_str).collect();
        let known = if names.is_empty() { "none is saved".to_owned() } else { format!("saved: {}", names.join(", ")) };
        let failure = Failure::new(Exit::Usage, format!("no saved pose {name}; {known}"));
        return Err(failure.hint("save where the arm is: dimos pose save NAME; names of a blueprint need a planner"));
    };
    let state = client.call(State {})?;
    let joints = state.arms.iter().find(|a| a.hardware_id == arm).map(|a| a.joints.as_slice()).unwrap_or_default();
    let position = |joint: &str| pose.values().find_map(|arm| arm.get(joint)).copied();
    let found: Option<Vec<f64>> = joints.iter().map(|joint| position(&joint.name)).collect();
    found.filter(|found| !found.is_empty()).ok_or_else(|| {
        Failure::new(Exit::Usage, format!("the saved pose {name} has no position of {arm}'s joints"))
            .hint(format!("save it again: dimos pose save {name} {arm}"))
    })
}
