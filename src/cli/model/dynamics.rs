//! `dimos model dynamics`: what a motion needs of the motors, by the masses of a description.

use serde_json::json;

use super::File;
use super::chain::{Chain, check_count};
use crate::cli::arguments::{finite, length};
use crate::cli::exit::{Exit, Failure, Result};
use crate::cli::output::{self, Table, fixed};
use dimos_robot::dynamics::{Dynamics, GRAVITY, massless, point_mass};
use dimos_robot::kinematics::Kinematics;
use dimos_robot::urdf::Meshes;

/// Arguments of `model dynamics`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
The joints are all independent ones of the description; mimic joints are folded into their leaders. Friction, rotors and \
springs are not part of it. The mass matrix is printed with --json.

  dimos model dynamics builtin:ur5e --q 0 -1 1 0 0 0 --payload 2 0 0 0.05")]
pub struct Args {
    #[command(flatten)]
    file: File,
    /// Joint positions [rad, or m for prismatic joints]; default: all 0
    #[arg(long, value_name = "Q", num_args = 1.., value_parser = finite, allow_negative_numbers = true)]
    q: Vec<f64>,
    /// Joint velocities [rad/s or m/s]; default: all 0
    #[arg(long, value_name = "QD", num_args = 1.., value_parser = finite, allow_negative_numbers = true)]
    qd: Vec<f64>,
    /// Joint accelerations [rad/s² or m/s²]; default: all 0
    #[arg(long, value_name = "QDD", num_args = 1.., value_parser = finite, allow_negative_numbers = true)]
    qdd: Vec<f64>,
    /// Load at a link: mass [kg], and its centre in the frame of the link [m]
    #[arg(long, value_names = ["KG", "X", "Y", "Z"], num_args = 4, value_parser = finite, allow_negative_numbers = true)]
    payload: Option<Vec<f64>>,
    /// Link that carries it; default: the end of the arm
    #[arg(long, value_name = "NAME", requires = "payload")]
    link: Option<String>,
    /// Gravity in the frame of the root link [m/s²]; default: 0 0 -9.80665
    #[arg(long, value_names = ["X", "Y", "Z"], num_args = 3, value_parser = finite, allow_negative_numbers = true)]
    gravity: Option<Vec<f64>>,
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let (robot, _) = args.file.robot(Meshes::Ignore)?;
    let kinematics = Kinematics::whole(&robot).map_err(|error| Failure::new(Exit::Failed, error.to_string()))?;
    let kinds = kinematics.kinds().to_vec();
    let mut dynamics = Dynamics::new(&robot, kinematics);
    let names: Vec<String> = dynamics.names().to_vec();
    let shown: Vec<&str> = names.iter().map(String::as_str).collect();
    let of_all = |given: &[f64]| -> Result<Vec<f64>> {
        if given.is_empty() {
            return Ok(vec![0.0; names.len()]);
        }
        check_count(&robot.name, &shown, given)?;
        Ok(given.to_vec())
    };
    let (q, qd, qdd) = (of_all(&args.q)?, of_all(&args.qd)?, of_all(&args.qdd)?);
    let gravity = args.gravity.as_deref().and_then(|given| given.try_into().ok()).unwrap_or(GRAVITY);
    dynamics.set_gravity(gravity);
    let carrier = match args.payload.as_deref() {
        Some(&[mass, x, y, z]) => {
            if mass < 0.0 {
                return Err(Failure::usage(format!("--payload: a mass of {mass} kg")));
            }
            [x, y, z].into_iter().try_for_each(|v| length(&v.to_string()).map(drop)).map_err(Failure::usage)?;
            let chain = Chain::between(&robot, None, args.link.as_deref())?;
            dynamics.set_load(chain.link, Some(&point_mass(mass, [x, y, z])));
            Some(chain.name(chain.link).to_owned())
        }
        _ => None,
    };
    let unknown = massless(&robot);
    let (mut effort, mut still) = (vec![0.0; names.len()], vec![0.0; names.len()]);
    dynamics.inverse(&q, &qd, &qdd, &mut effort);
    dynamics.gravity(&q, &mut still);
    if args.file.json {
        let mut rows = vec![0.0; names.len() * names.len()];
        dynamics.mass_matrix(&q, &mut rows);
        let rows: Vec<&[f64]> = rows.chunks(names.len().max(1)).collect();
        output::json(&json!({
            "joints": names, "effort": effort, "gravity": still, "mass_matrix": rows,
            "payload_link": carrier, "massless": unknown,
        }));
        return Ok(Exit::Ok);
    }
    if !unknown.is_empty() {
        let hint = "their weight is not known: efforts are too small";
        output::note(format_args!("warning: no mass is given for {}; {hint}", unknown.join(", ")));
    }
    let mut table = Table::new(&["JOINT", ">EFFORT", ">GRAVITY", "UNIT"]);
    for (((name, kind), effort), still) in names.iter().zip(kinds).zip(&effort).zip(&still) {
        let unit = if kind.is_angle() { "Nm" } else { "N" };
        table.row([name.clone(), fixed(*effort, 3), fixed(*still, 3), unit.to_owned()]);
    }
    table.print();
    Ok(Exit::Ok)
}
