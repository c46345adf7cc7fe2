//! `dimos arm gripper ARM home`: homes a gripper that has its own connection, and waits for the end.

use std::thread::sleep;
use std::time::{Duration, Instant};

use super::super::exit::{Exit, Failure, Result};
use super::super::follow::Signals;
use super::super::output;
use super::GripperArgs;
use dimos_rpc::api::{GripperHome, Status};
use dimos_rpc::client::Client;
use dimos_rpc::report::PeripheralReport;
use serde_json::json;

/// Poll period, and default time for the end.
const POLL_PERIOD: Duration = Duration::from_millis(50);
const TIMEOUT: Duration = Duration::from_secs(20);

/// Runs the verb.
pub fn run(args: &GripperArgs) -> Result {
    let (signals, which) = (Signals::watch(), &args.which);
    if args.force.is_some() || args.speed.is_some() || args.attach.is_some() || args.detach {
        let failure = Failure::usage("homing has neither force nor speed, and no object");
        return Err(failure.hint(format!("dimos arm gripper {} home", which.arm)));
    }
    let mut client = which.target_run.connect()?;
    let begun = Instant::now();
    let reply = client.call(GripperHome { arm: which.arm.clone() })?;
    let limit = args.timeout.unwrap_or(TIMEOUT);
    if args.no_wait {
        if which.target_run.json {
            output::json(&reply);
        } else {
            output::line(format_args!("{}: gripper is being homed", which.arm));
        }
        return Ok(Exit::Ok);
    }
    let failed = |what: String| Failure::new(Exit::Failed, format!("{}: {what}", which.arm));
    loop {
        let gripper = gripper_of(&mut client, &which.arm)?;
        match gripper.condition.as_deref() {
            Some("homing") => {}
            Some("ready") => break,
            Some("not_homed") => {
                return Err(failed("homing was ended".to_owned()).hint("the arm was stopped meanwhile"));
            }
            _ => {
                let (what, hint) = gripper.attention(&which.arm).unwrap_or_default();
                return Err(Failure::new(Exit::Failed, format!("not homed: {what}")).hint(hint));
            }
        }
        if let Some(signal) = signals.last() {
            let what = format!("interrupted: the gripper of {} continues to be homed", which.arm);
            let hint = format!("dimos stop {} ends that", which.arm);
            return Err(Failure::new(Exit::by_signal(signal), what).hint(hint));
        }
        if begun.elapsed() > limit {
            let what = format!("its gripper is not homed after {} s", limit.as_secs_f64());
            return Err(failed(what).hint("`dimos status` shows its condition"));
        }
        sleep(POLL_PERIOD);
    }
    let elapsed = begun.elapsed().as_secs_f64();
    if which.target_run.json {
        output::json(&json!({"arm": which.arm, "condition": "ready", "elapsed": elapsed}));
    } else {
        output::line(format_args!("{}: gripper homed, after {elapsed:.2} s", which.arm));
    }
    Ok(Exit::Ok)
}

/// Returns the gripper of an arm as `status` has it.
fn gripper_of(client: &mut Client, arm: &str) -> Result<PeripheralReport> {
    let arms = client.call(Status {})?.arms;
    let own = arms.into_iter().find(|own| own.hardware_id == arm).map(|own| own.peripherals).unwrap_or_default();
    let gripper = own.into_iter().find(|own| own.part == "gripper");
    gripper.ok_or_else(|| Failure::new(Exit::Failed, format!("the gripper of {arm} is not there")))
}
