//! `dimos state [--watch]`: joint states, once or repeatedly.

use std::io::{self, IsTerminal, Write};
use std::thread::sleep;
use std::time::{Duration, Instant};

use super::arguments::{Target, hertz, place};
use super::banner;
use super::exit::{Exit, Result};
use super::lasting;
use super::output::{self, Table, fixed, number};
use super::redraw::{self, Redraw};
use dimos_rpc::api::{State, gripper_text};
use dimos_rpc::client::{self, ClientError};
use dimos_rpc::error::{Code, RpcError};
use dimos_rpc::report::{ArmStateReport, JointReport, PoseReport, StateReport};
use dimos_rpc::run_dir::RunDir;

/// Marks poses of the arm's own controller.
const DEVICE: &str = " (device)";

/// Arguments of `state`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Repeat until Ctrl-C or the run's end: a live table; with --json one line per state
    #[arg(long)]
    pub watch: bool,
    /// Rate of --watch [Hz]
    #[arg(long, value_name = "HZ", default_value_t = 10.0, value_parser = hertz, requires = "watch", alias = "rate")]
    pub hz: f64,
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let mut client = args.target_run.connect()?;
    let mut screen = Screen::new(args.watch && io::stdout().is_terminal());
    let period = Duration::from_secs_f64(1.0 / args.hz);
    let (mut next, mut shown) = (Instant::now(), false);
    loop {
        let report = match client.call(State {}) {
            Err(ClientError::Io { .. } | ClientError::Refused(RpcError { code: Code::ShuttingDown, .. }))
                if shown && place().is_none() && has_ended(client.run()) =>
            {
                output::note(format_args!("run {} has ended", client.run()));
                return Ok(Exit::Ok);
            }
            Err(error) if args.watch && lasting::is_lost(&error) => {
                client = lasting::again(client.run(), &error)?;
                screen = Screen::new(screen.live);
                continue;
            }
            report => report?,
        };
        let lines = match args.target_run.json {
            true => vec![output::encoded(&report)],
            false => table(&report),
        };
        if !output::written(screen.show(&lines)) || !args.watch {
            return Ok(Exit::Ok);
        }
        shown = true;
        next = (next + period).max(Instant::now());
        sleep(next.saturating_duration_since(Instant::now()));
    }
}

/// Returns whether a run of this computer ends within two seconds: its process outlives its connections.
fn has_ended(name: &str) -> bool {
    let is_live = || client::find(&RunDir::standard(), Some(name)).is_ok();
    (0..40).any(|attempt| {
        sleep(Duration::from_millis(if attempt == 0 { 0 } else { 50 }));
        !is_live()
    })
}

/// Output of --watch: redrawn in place on a terminal, appended elsewhere.
struct Screen {
    live: bool,
    redraw: Redraw,
}

impl Screen {
    fn new(live: bool) -> Self {
        Self { live, redraw: Redraw::default() }
    }

    fn show(&mut self, lines: &[String]) -> io::Result<()> {
        let colour = output::colour(&io::stdout());
        let text = match self.live {
            true => self.redraw.frame(lines, redraw::stdout_size(), colour),
            false => Redraw::default().frame(lines, (0, 0), colour),
        };
        let mut out = io::stdout().lock();
        out.write_all(text.as_bytes())?;
        out.flush()
    }
}

fn table(report: &StateReport) -> Vec<String> {
    let mut lines = Vec::new();
    for arm in &report.arms {
        if !lines.is_empty() {
            lines.push(String::new());
        }
        lines.extend(of_arm(arm));
    }
    lines
}

fn of_arm(arm: &ArmStateReport) -> Vec<String> {
    let simulated = if arm.simulated { "  SIMULATED" } else { "" };
    let age = arm.age_ms.map_or_else(|| "no state yet".into(), |ms| format!("state {ms:.1} ms old"));
    let mut lines = vec![format!("{}{simulated}  {age}", arm.hardware_id)];
    let mut table =
        Table::new(&["JOINT", ">POSITION rad", ">deg", ">?VELOCITY rad/s", "?", ">?EFFORT Nm", ">?COMMAND rad"]);
    for joint in &arm.joints {
        table.row([
            joint.name.clone(),
            number(joint.position, 4),
            number(joint.position.map(f64::to_degrees), 2),
            number(joint.velocity, 4),
            source(joint).to_owned(),
            number(joint.effort, 3),
            number(joint.command, 4),
        ]);
    }
    lines.extend(table.lines());
    let rest = below(arm);
    lines.extend(rest.iter().flat_map(|line| output::folded(line, output::columns(io::stdout()))));
    lines
}

/// Returns the lines below the joints.
fn below(arm: &ArmStateReport) -> Vec<String> {
    let mut lines = Vec::new();
    if let Some(gripper) = arm.gripper {
        let unit = arm.gripper_unit.as_deref().unwrap_or("m");
        lines.push(format!("gripper  {}{}", gripper_text(gripper, unit), force(arm)));
    }
    lines.extend(banner::slowed(&arm.hardware_id, arm.speed_fraction));
    let poses = [(&arm.pose, ""), (&arm.device_pose, DEVICE), (&arm.device_tool_pose, DEVICE)];
    lines.extend(poses.iter().filter_map(|(pose, whose)| Some(pose_lines(pose.as_ref()?, whose))).flatten());
    if let Some(missing) = &arm.device_pose_missing {
        lines.push(format!("pose     flange{DEVICE} not known: the controller does not report its {missing}"));
    }
    if let Some([fx, fy, fz, tx, ty, tz]) = arm.wrench {
        lines.push(format!("wrench   force {fx:.2} {fy:.2} {fz:.2} N, torque {tx:.3} {ty:.3} {tz:.3} Nm"));
    }
    lines
}

/// Returns a pose with enough digits for `dimos move ARM --pose … --rpy …` to move nothing.
fn pose_lines(pose: &PoseReport, whose: &str) -> [String; 2] {
    let three = |values: [f64; 3]| values.map(|v| fixed(v, 6)).join(" ");
    let numbers = format!("         xyz {} m  rpy {} rad", three(pose.xyz), three(pose.rpy));
    [format!("pose     {}{whose}", pose.label()), numbers]
}

/// Returns the measured force of the gripper; empty if it measures none.
fn force(arm: &ArmStateReport) -> String {
    let unit = arm.gripper_force_unit.as_deref().unwrap_or_default();
    arm.gripper_force.map_or_else(String::new, |force| format!(", force {force:.2} {unit}"))
}

/// Returns the source of a velocity unless it is measured.
fn source(joint: &JointReport) -> &str {
    if joint.velocity_source == "estimated" { "est." } else { "" }
}
