//! `dimos state [--watch]`: joint states, once or repeatedly.

use std::io::{self, IsTerminal, Write};
use std::thread::sleep;
use std::time::{Duration, Instant};

use super::arguments::{Target, rate};
use super::exit::{Exit, Result};
use super::output::{Table, fixed, number};
use crate::rpc::api::State;
use crate::rpc::report::{ArmStateReport, JointReport, PoseReport, StateReport};

/// Arguments of `state`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Repeat until Ctrl-C or the run's end: a live table; with --json one line per state
    #[arg(long)]
    pub watch: bool,
    /// Rate of --watch [Hz]
    #[arg(long, value_name = "HZ", default_value_t = 10.0, value_parser = rate, requires = "watch")]
    pub rate: f64,
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let mut client = args.target_run.connect()?;
    let mut screen = Screen::new(args.watch && io::stdout().is_terminal());
    let period = Duration::from_secs_f64(1.0 / args.rate);
    let mut next = Instant::now();
    loop {
        let report = client.call(State {})?;
        let lines = match args.target_run.json {
            true => vec![serde_json::to_string(&report).unwrap_or_default()],
            false => table(&report),
        };
        // The pipe is closed (`| head`).
        if screen.show(&lines).is_err() || !args.watch {
            return Ok(Exit::Ok);
        }
        next = (next + period).max(Instant::now());
        sleep(next.saturating_duration_since(Instant::now()));
    }
}

/// Output of --watch: redrawn in place on a terminal, appended elsewhere.
struct Screen {
    live: bool,
    drawn: usize,
}

impl Screen {
    fn new(live: bool) -> Self {
        Self { live, drawn: 0 }
    }

    fn show(&mut self, lines: &[String]) -> io::Result<()> {
        let mut text = match self.live && self.drawn > 0 {
            true => format!("\x1b[{}A\x1b[J", self.drawn),
            false => String::new(),
        };
        for line in lines {
            text.push_str(line);
            text.push('\n');
        }
        self.drawn = lines.len();
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
    let mut table = Table::new(&["JOINT", ">POSITION rad", ">deg", ">VELOCITY rad/s", "", ">EFFORT Nm", ">COMMAND"]);
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
    if let Some(gripper) = arm.gripper {
        let unit = arm.gripper_unit.as_deref().unwrap_or("m");
        lines.push(format!("gripper  {gripper:.4} {unit}{}", force(arm)));
    }
    let poses = [(&arm.pose, ""), (&arm.device_pose, " (device)")];
    lines.extend(poses.iter().filter_map(|(pose, whose)| Some(pose_line(pose.as_ref()?, whose))));
    if let Some([fx, fy, fz, tx, ty, tz]) = arm.wrench {
        lines.push(format!("wrench   force {fx:.2} {fy:.2} {fz:.2} N, torque {tx:.3} {ty:.3} {tz:.3} Nm"));
    }
    lines
}

/// Returns a pose with enough digits for `dimos move ARM --pose … --rpy …` to move nothing.
fn pose_line(pose: &PoseReport, whose: &str) -> String {
    let three = |values: [f64; 3]| values.map(|v| fixed(v, 6)).join(" ");
    format!("pose     {}{whose}  xyz {} m  rpy {} rad", pose.label(), three(pose.xyz), three(pose.rpy))
}

/// Returns the measured force of the gripper; empty if it measures none.
fn force(arm: &ArmStateReport) -> String {
    let unit = arm.gripper_force_unit.as_deref().unwrap_or_default();
    arm.gripper_force.map_or_else(String::new, |force| format!(", force {force:.2} {unit}"))
}

/// Returns the source of a velocity unless it is measured.
fn source(joint: &JointReport) -> &str {
    if joint.velocity_source == "estimated" { "estimated" } else { "" }
}
