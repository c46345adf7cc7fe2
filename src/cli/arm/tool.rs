//! `dimos arm tool ARM`: the tool centre point of an arm.

use super::super::arguments::{angle, finite, length};
use super::super::exit::{Exit, Result};
use super::super::output::{self, fixed};
use super::ArmArgs;
use dimos_rpc::api::{ArmTool, ArmToolSet, PoseSpec};
use dimos_rpc::report::TcpReport;

/// Arguments of `arm tool`.
#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(flatten)]
    which: ArmArgs,
    /// Set the tool centre point, in the frame of the end-effector link [m]
    #[arg(long, value_names = ["X", "Y", "Z"], num_args = 3, value_parser = length, allow_negative_numbers = true)]
    xyz: Option<Vec<f64>>,
    /// Roll, pitch, yaw of the tool in that frame, about fixed axes [rad]
    #[arg(long, value_names = ["R", "P", "Y"], num_args = 3, value_parser = angle, allow_negative_numbers = true, requires = "xyz")]
    rpy: Option<Vec<f64>>,
    /// Orientation of the tool in that frame as a quaternion x, y, z, w
    #[arg(long, value_names = ["X", "Y", "Z", "W"], num_args = 4, value_parser = finite, allow_negative_numbers = true, requires = "xyz", conflicts_with = "rpy")]
    quat: Option<Vec<f64>>,
    /// Remove the tool: the arm's pose is that of its end-effector link
    #[arg(long, conflicts_with = "xyz")]
    none: bool,
}

/// Runs `arm tool`.
pub fn run(args: &Args) -> Result {
    let (mut client, arm) = (args.which.target_run.connect()?, args.which.arm.clone());
    let tool = args.xyz.as_deref().and_then(|xyz| xyz.try_into().ok()).map(|xyz| PoseSpec {
        xyz,
        rpy: args.rpy.as_deref().and_then(|rpy| rpy.try_into().ok()),
        quat: args.quat.as_deref().and_then(|quat| quat.try_into().ok()),
    });
    let reply = match tool.is_some() || args.none {
        true => client.call(ArmToolSet { arm, tool })?,
        false => client.call(ArmTool { arm })?,
    };
    if args.which.target_run.json {
        output::json(&reply);
    } else {
        output::line(format_args!("{}: {}", reply.arm, tcp_text(&reply.tcp)));
    }
    Ok(Exit::Ok)
}

/// Returns a tool centre point as text: its name, and where it is on its link.
pub fn tcp_text(tcp: &TcpReport) -> String {
    let three = |values: [f64; 3]| values.map(|v| fixed(v, 4)).join(" ");
    match &tcp.tool {
        None => format!("{} (no tool)", tcp.link),
        Some(tool) => format!("{} at xyz {} m, rpy {} rad", tcp.name(), three(tool.xyz), three(tool.rpy)),
    }
}
