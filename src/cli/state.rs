//! `dimos state`: where the joints are.

use super::arguments::Target;
use super::exit::{Exit, Result};
use super::output::{self, Table, number};
use crate::rpc::api::State;
use crate::rpc::report::{ArmStateReport, JointReport};

/// Arguments of `state`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let report = args.target_run.connect()?.call(State {})?;
    if args.target_run.json {
        output::json(&report);
        return Ok(Exit::Ok);
    }
    for (index, arm) in report.arms.iter().enumerate() {
        if index > 0 {
            output::line("");
        }
        print(arm);
    }
    Ok(Exit::Ok)
}

fn print(arm: &ArmStateReport) {
    let simulated = if arm.simulated { "  SIMULATED" } else { "" };
    let age = arm.age_ms.map_or_else(|| "no state yet".into(), |ms| format!("state {ms:.1} ms old"));
    output::line(format_args!("{}{simulated}  {age}", arm.hardware_id));
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
    table.print();
    if let Some(gripper) = arm.gripper {
        output::line(format_args!("gripper  {gripper:.4} m"));
    }
    if let Some(pose) = arm.pose {
        let ([x, y, z], [roll, pitch, yaw]) = (pose.xyz, pose.rpy);
        output::line(format_args!("pose     xyz {x:.4} {y:.4} {z:.4} m, rpy {roll:.4} {pitch:.4} {yaw:.4} rad"));
    }
    if let Some([fx, fy, fz, tx, ty, tz]) = arm.wrench {
        output::line(format_args!("wrench   force {fx:.2} {fy:.2} {fz:.2} N, torque {tx:.3} {ty:.3} {tz:.3} Nm"));
    }
}

/// Only what is not measured is worth a word.
fn source(joint: &JointReport) -> &str {
    if joint.velocity_source == "estimated" { "estimated" } else { "" }
}
