//! Gripper actions as typed: `arm gripper`, and those between the waypoints of `move --through`. The run does them.

use std::thread::sleep;
use std::time::Duration;

use super::arguments::finite;
use super::exit::{Exit, Failure, Result};
use super::follow::Signals;
use super::going;
use dimos_core::arm::GripperUnit;
use dimos_rpc::api::{
    self, GoGripper, GoStep, Grip, GripObjects, GripReport, Gripper, GripperEnd, GripperReply, RobotReport, State,
    Status, WorldObject,
};
use dimos_rpc::client::{Client, ClientError};
use dimos_rpc::report::ArmReport;
use dimos_yaml::did_you_mean;

/// Poll period of the outcome.
const POLL_PERIOD: Duration = Duration::from_millis(20);
/// Positions are rounded in files; this far out of its range a position is still in it [m or rad].
const SAME_POSITION: f64 = 1e-6;

/// Requested position of a gripper.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Opening {
    /// This position [m or rad].
    Position(f64),
    /// Fully open.
    Open,
    /// Closed.
    Close,
}

/// Parses a position, `open` or `close`.
pub fn opening(text: &str) -> std::result::Result<Opening, String> {
    match text {
        "open" => Ok(Opening::Open),
        "close" => Ok(Opening::Close),
        _ => finite(text).map(Opening::Position).map_err(|e| format!("{e}; give m or rad, `open` or `close`")),
    }
}

impl From<Opening> for api::Opening {
    fn from(opening: Opening) -> Self {
        match opening {
            Opening::Position(position) => Self::Position(position),
            Opening::Open => Self::End(GripperEnd::Open),
            Opening::Close => Self::End(GripperEnd::Close),
        }
    }
}

impl Opening {
    /// Returns the position [m or rad]: the run knows the gripper's range.
    pub fn of(self, client: &mut Client, arm: &str) -> Result<f64> {
        if let Self::Position(position) = self {
            return Ok(position);
        }
        let reported = client.call(Status {})?.arms.into_iter().find(|a| a.hardware_id == arm);
        match reported {
            Some(ArmReport { gripper_range: Some([closed, open]), .. }) => {
                Ok(if self == Self::Open { open } else { closed })
            }
            // The run reports a wrong name.
            None => Ok(0.0),
            Some(_) => {
                let what = format!("{arm} has no gripper, or does not report its range");
                Err(Failure::new(Exit::Failed, what).hint(format!("give it as a number: dimos arm gripper {arm} 0.04")))
            }
        }
    }
}

/// Returns the failure for an object that the planner does not know.
pub fn unknown_object(name: &str, world: &[WorldObject]) -> Failure {
    let known = did_you_mean(name, world.iter().map(|object| object.name.as_str()), "it has");
    let hint = known.unwrap_or_else(|| "`dimos world add` adds one".to_owned());
    Failure::usage(format!("the planner's world has no object {name}")).hint(hint)
}

/// Returns why a gripper cannot do what is asked, and a hint. What this finds is found before anything moves.
pub fn impossible(arm: &ArmReport, to: Opening, force: Option<f64>) -> Option<(String, Option<String>)> {
    let name = &arm.hardware_id;
    let say = |what: String, hint: Option<String>| Some((what, hint));
    let Some(unit) = &arm.gripper_unit else { return say(format!("{name} has no gripper"), None) };
    match (to, arm.gripper_range) {
        (Opening::Open | Opening::Close, None) => {
            return say(
                format!("the gripper of {name} reports no range"),
                Some(format!("give its position in {unit}")),
            );
        }
        (Opening::Position(at), _) if GripperUnit::of_name(unit).is_some_and(|unit| !unit.has(at)) => {
            let hint = Some("closed is 0, open 1".to_owned());
            return say(format!("the gripper of {name} only closes and opens: it cannot go to {at}"), hint);
        }
        (Opening::Position(at), Some([closed, open]))
            if at < closed.min(open) - SAME_POSITION || at > closed.max(open) + SAME_POSITION =>
        {
            let hint = format!("closed is {closed} {unit}, open {open} {unit}");
            return say(format!("the gripper of {name} cannot go to {at} {unit}"), Some(hint));
        }
        _ => {}
    }
    match (force, arm.gripper_force_range) {
        (Some(_), None) => {
            let hint = Some("command its position without a force".to_owned());
            say(format!("the gripper of {name} has no force control"), hint)
        }
        (Some(force), Some([least, most])) if !(least..=most).contains(&force) => {
            let unit = arm.gripper_force_unit.as_deref().unwrap_or("N");
            let hint = format!("give {least} to {most} {unit}, or no force for the one set in the arm");
            say(format!("the gripper of {name} cannot hold with {force} {unit}"), Some(hint))
        }
        _ => None,
    }
}

/// A gripper action.
#[derive(Debug, Clone, PartialEq)]
pub struct GripAction {
    /// Where the fingers go.
    pub opening: Opening,
    /// Largest force, in the gripper's unit.
    pub force: Option<f64>,
    /// Fraction of the gripper's top speed.
    pub speed: Option<f64>,
    /// Time for the outcome.
    pub timeout: Option<Duration>,
    /// Objects to attach or detach.
    pub objects: Option<GripObjects>,
}

/// Parses an action between waypoints: `gripper:open`, `gripper:0.03`, `gripper:close:cup`.
pub fn action(text: &str) -> std::result::Result<GripAction, String> {
    let (position, object) = text.split_once(':').map_or((text, None), |(position, object)| (position, Some(object)));
    let objects = object.map(|name| GripObjects::Either(name.to_owned()));
    Ok(GripAction { opening: opening(position)?, force: None, speed: None, timeout: None, objects })
}

impl GripAction {
    /// Sends the command; returns what was commanded.
    pub fn send(&self, client: &mut Client, arm: &str) -> Result<GripperReply> {
        let position = self.opening.of(client, arm)?;
        let timeout = self.timeout.map(|timeout| timeout.as_secs_f64());
        Ok(client.call(Gripper { arm: arm.to_owned(), position, force: self.force, speed: self.speed, timeout })?)
    }

    /// Returns the request for it.
    pub fn request(&self, client: &mut Client, arm: &str) -> Result<GoGripper> {
        let to = api::Opening::Position(self.opening.of(client, arm)?);
        let (arm, force, speed, objects) = (arm.to_owned(), self.force, self.speed, self.objects.clone());
        Ok(GoGripper { arm, to, force, speed, timeout: self.timeout.map(|timeout| timeout.as_secs_f64()), objects })
    }

    /// Lets the run do it, waits for the outcome and prints it. Fails if the fingers did not get to their position and
    /// hold nothing, or if nothing is held that should be attached.
    pub fn run(&self, client: &mut Client, arm: &str, signals: &Signals, json: bool) -> Result<()> {
        let request = self.request(client, arm)?;
        signals.check()?;
        let going = going::go(client, GoStep::Gripper(Box::new(request))).map_err(|error| match error {
            ClientError::Refused(refusal) => going::grip_failure(refusal),
            other => other.into(),
        })?;
        going::grip(client, (going, 0), signals, json)
    }
}

/// Returns the names of an arm's joints; none of an unknown arm.
fn joints_of(client: &mut Client, arm: &str) -> Result<Vec<String>> {
    let own = client.call(State {})?.arms.into_iter().find(|own| own.hardware_id == arm);
    Ok(own.map(|own| own.joints.into_iter().map(|joint| joint.name).collect()).unwrap_or_default())
}

/// Returns the arm whose gripper a robot of the planner has: of that name, or one of several that it spans.
pub fn arm_of(client: &mut Client, robot: Option<&RobotReport>, name: &str) -> Result<String> {
    let arms = client.call(Status {})?.arms;
    if arms.iter().any(|arm| arm.hardware_id == name) {
        return Ok(name.to_owned());
    }
    for arm in arms.into_iter().filter(|arm| arm.gripper_unit.is_some()) {
        let joints = joints_of(client, &arm.hardware_id)?;
        if robot.is_some_and(|robot| robot.joints.iter().any(|joint| joints.contains(joint))) {
            return Ok(arm.hardware_id);
        }
    }
    Err(Failure::usage(format!("{name} has no gripper: nothing has moved")))
}

/// Waits for the outcome of a command. A signal ends the wait; the fingers continue.
pub(super) fn wait(client: &mut Client, arm: &str, order: u32, signals: &Signals) -> Result<GripReport> {
    loop {
        let report = client.call(Grip { arm: arm.to_owned(), order: Some(order) })?;
        if report.done {
            return Ok(report);
        }
        if let Some(signal) = signals.last() {
            let what = format!("interrupted: the gripper of {arm} continues to {:.4} {}", report.target, report.unit);
            return Err(Failure::new(Exit::by_signal(signal), what).hint(format!("dimos stop {arm} holds it")));
        }
        sleep(POLL_PERIOD);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn actions_between_waypoints_have_a_position_and_maybe_an_object() {
        let of = |text: &str| action(text).map(|action| (action.opening, action.objects));
        assert_eq!(of("open"), Ok((Opening::Open, None)));
        assert_eq!(of("0.03"), Ok((Opening::Position(0.03), None)));
        assert_eq!(of("close:cup"), Ok((Opening::Close, Some(GripObjects::Either("cup".into())))));
        assert!(of("ajar").unwrap_err().contains("`open` or `close`"));
    }
}
