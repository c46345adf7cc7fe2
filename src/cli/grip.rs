//! Gripper actions: `arm gripper`, and those between the waypoints of `move --through`. The run judges the outcome.
//! This awaits and prints it, and attaches an object of the planner's world once it is held.

use std::thread::sleep;
use std::time::Duration;

use serde_json::json;

use super::arguments::finite;
use super::exit::{Exit, Failure, Result};
use super::follow::Signals;
use super::output;
use dimos_core::arm::GripperUnit;
use dimos_rpc::api::{
    Attach, Detach, GRASP_REACH, Grip, GripOutcome, GripReport, Gripper, GripperReply, Planner, RobotReport, State,
    Status, World, WorldObject,
};
use dimos_rpc::client::Client;
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

/// What becomes of objects in the planner's world.
#[derive(Debug, Clone, PartialEq, Default)]
pub enum Objects {
    /// Nothing.
    #[default]
    Keep,
    /// This one is attached to the arm once the gripper holds it.
    Attach(String),
    /// All that the arm holds are detached once the fingers are where they were sent.
    Detach,
    /// This one: detached if the arm holds it, else attached.
    Either(String),
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
    pub objects: Objects,
}

/// Parses an action between waypoints: `gripper:open`, `gripper:0.03`, `gripper:close:cup`.
pub fn action(text: &str) -> std::result::Result<GripAction, String> {
    let (position, object) = text.split_once(':').map_or((text, None), |(position, object)| (position, Some(object)));
    let objects = object.map_or(Objects::Keep, |name| Objects::Either(name.to_owned()));
    Ok(GripAction { opening: opening(position)?, force: None, speed: None, timeout: None, objects })
}

impl GripAction {
    /// Sends the command; returns what was commanded.
    pub fn send(&self, client: &mut Client, arm: &str) -> Result<GripperReply> {
        let position = self.opening.of(client, arm)?;
        let timeout = self.timeout.map(|timeout| timeout.as_secs_f64());
        Ok(client.call(Gripper { arm: arm.to_owned(), position, force: self.force, speed: self.speed, timeout })?)
    }

    /// Sends the command, waits for its outcome and prints it. Fails if the fingers did not get to their position and
    /// hold nothing, or if nothing is held that should be attached.
    pub fn run(&self, client: &mut Client, arm: &str, signals: &Signals, json: bool) -> Result<()> {
        let objects = self.objects(client, arm)?;
        signals.check()?;
        let order = self.send(client, arm)?.order;
        let report = wait(client, arm, order, signals)?;
        let done = |what: &str, names: &[String]| {
            let text = report.text();
            match json {
                false if names.is_empty() => output::line(format_args!("{arm}: {text}")),
                false => output::line(format_args!("{arm}: {text}; {} {what}", names.join(", "))),
                true => {
                    let mut value = json!(report);
                    if !names.is_empty() {
                        value[what] = json!(names);
                    }
                    output::json(&value);
                }
            }
        };
        let outcome = report.outcome;
        let failed = |what: String, hint: &str| Failure {
            data: Some(Box::new(json!(report))),
            ..Failure::new(Exit::Failed, what).hint(hint)
        };
        match (outcome, objects) {
            (None, _) => {
                let why = report.error.as_deref().unwrap_or("no outcome");
                return Err(failed(format!("{arm}: {}: {why}", report.text()), "`dimos state` shows the gripper now"));
            }
            (Some(GripOutcome::Blocked), _) => {
                let what = format!("{arm}: {}, on the way to {:.4} {}", report.text(), report.target, report.unit);
                return Err(failed(what, "remove what is in the way of the fingers, or command a larger --force"));
            }
            (Some(GripOutcome::Holding), Some((Some(robot), names))) => {
                for name in &names {
                    let attach = Attach {
                        name: name.clone(),
                        robot: robot.clone(),
                        within: Some(GRASP_REACH),
                        ..Attach::default()
                    };
                    client.call(attach)?;
                }
                done("attached", &names);
            }
            (Some(GripOutcome::Ordered), Some((Some(_), names))) => {
                let what = format!("{arm}: {}: {} is not attached", report.text(), names.join(", "));
                return Err(failed(what, "attach what it holds with `dimos world attach`"));
            }
            (Some(_), Some((Some(_), names))) => {
                let what = format!("{arm}: {}: it holds nothing, {} is not attached", report.text(), names.join(", "));
                return Err(failed(what, "move the fingers around the object first"));
            }
            (Some(_), Some((None, names))) => {
                for name in &names {
                    client.call(Detach { name: name.clone() })?;
                }
                done("detached", &names);
            }
            (Some(_), None) => done("", &[]),
        }
        Ok(())
    }

    /// Returns the objects to attach, with the robot of the planner, or to detach; checked before anything moves.
    fn objects(&self, client: &mut Client, arm: &str) -> Result<Option<(Option<String>, Vec<String>)>> {
        if self.objects == Objects::Keep {
            return Ok(None);
        }
        let robots = client.call(Planner {})?.robots;
        let joints = joints_of(client, arm)?;
        let is_of = |robot: &&RobotReport| robot.name == arm || robot.joints.iter().any(|joint| joints.contains(joint));
        let Some(robot) = robots.iter().find(is_of).map(|robot| robot.name.clone()) else {
            let names: Vec<&str> = robots.iter().map(|robot| robot.name.as_str()).collect();
            let what = format!("the planner has no robot {arm}, only {}", names.join(", "));
            return Err(Failure::usage(what).hint("objects are attached to the robots of `planner.robots`"));
        };
        let world = client.call(World {})?.objects;
        let ours = |object: &WorldObject| object.held_by.as_ref().is_some_and(|[by, _]| *by == robot);
        let (Objects::Attach(name) | Objects::Either(name)) = &self.objects else {
            let held: Vec<String> = world.iter().filter(|object| ours(object)).map(|o| o.name.clone()).collect();
            return match held.is_empty() {
                true => Err(Failure::new(Exit::Failed, format!("{arm} holds no object: there is none to detach"))
                    .hint("`dimos world list` shows what is held")),
                false => Ok(Some((None, held))),
            };
        };
        match world.iter().find(|object| object.name == *name) {
            Some(object) if ours(object) && matches!(self.objects, Objects::Either(_)) => {
                Ok(Some((None, vec![name.clone()])))
            }
            Some(object) => match &object.held_by {
                Some([robot, link]) => {
                    Err(Failure::new(Exit::Failed, format!("{name} is held already, by {robot} at {link}"))
                        .hint(format!("dimos world detach {name}")))
                }
                None => Ok(Some((Some(robot), vec![name.clone()]))),
            },
            None => Err(unknown_object(name, &world)),
        }
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
        assert_eq!(of("open"), Ok((Opening::Open, Objects::Keep)));
        assert_eq!(of("0.03"), Ok((Opening::Position(0.03), Objects::Keep)));
        assert_eq!(of("close:cup"), Ok((Opening::Close, Objects::Either("cup".into()))));
        assert!(of("ajar").unwrap_err().contains("`open` or `close`"));
    }
}
