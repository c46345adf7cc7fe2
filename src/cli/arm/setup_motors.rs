//! `dimos arm setup-motors ADAPTER`: gives each motor of a new arm its number and the arm's rate, one after the other.

use super::super::ask;
use super::super::exit::{Exit, Failure, Result};
use super::super::follow::Signals;
use super::super::output;
use super::bus::{self, failure};
use dimos_hardware::registry::Registry;
use dimos_hardware::service::{Motor, Service};

/// Arguments of `arm setup-motors`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
New motors all have the same number, so one at a time is connected to the board: the verb asks for each, from the gripper to the base.
Several on the line are refused. Nothing moves.")]
pub struct Args {
    #[command(flatten)]
    bus: bus::BusArgs,
    /// Only this motor (repeatable)
    #[arg(long = "motor", value_name = "NAME")]
    motors: Vec<String>,
    /// Ask nothing: the motor is connected; needs exactly one --motor
    #[arg(long, requires = "motors")]
    yes: bool,
}

/// Runs the verb.
pub fn run(args: &Args, registry: &Registry) -> Result {
    if args.yes && args.motors.len() != 1 {
        return Err(Failure::usage("--yes sets one motor up: several cannot be connected at the same time"));
    }
    if !args.yes {
        ask::needs_terminal("--motor NAME --yes sets one motor up and asks nothing")?;
    }
    let signals = Signals::watch_with_hangup();
    let mut bus = args.bus.open(registry)?;
    let mut done = Vec::new();
    for motor in args.chosen(bus.service.motors())? {
        loop {
            if !args.yes {
                ask::enter(&signals, &format!("Connect only the motor of {} to the board", motor.name))?;
            }
            match set_up(&mut *bus.service, &motor, &done) {
                Ok(()) => break,
                Err(failure) if args.yes => return Err(failure),
                // The next Enter tries again: the cable can be plugged in until then.
                Err(failure) => output::failure(&failure),
            }
        }
        done.push(motor);
    }
    Ok(Exit::Ok)
}

impl Args {
    /// Returns the motors to set up, the last one of the arm first: its cable is the easiest to reach.
    fn chosen(&self, motors: &[Motor]) -> Result<Vec<Motor>> {
        let names: Vec<_> = motors.iter().map(|motor| motor.name).collect();
        if let Some(unknown) = self.motors.iter().find(|name| !names.contains(&name.as_str())) {
            return Err(Failure::usage(format!("no motor named {unknown:?}")).hint(names.join(", ")));
        }
        let chosen = |motor: &&Motor| self.motors.is_empty() || self.motors.iter().any(|name| name == motor.name);
        Ok(motors.iter().rev().filter(chosen).copied().collect())
    }
}

/// Sets the motor on the bus up as `motor`, unless it is one of those that are `done`.
fn set_up(arm: &mut dyn Service, motor: &Motor, done: &[Motor]) -> Result<()> {
    let single = arm.find_single().map_err(failure)?;
    if let Some(set_up) = done.iter().find(|other| other.id == single.id && other.id != motor.id) {
        let what = format!("the motor on the board is that of {}, number {}, set up before", set_up.name, set_up.id);
        return Err(Failure::new(Exit::Failed, what).hint(format!("connect the motor of {} instead", motor.name)));
    }
    arm.assign(&single, motor).map_err(failure)?;
    output::line(format_args!("{}: number {} (was {}, at {} bit/s)", motor.name, motor.id, single.id, single.baud));
    Ok(())
}
