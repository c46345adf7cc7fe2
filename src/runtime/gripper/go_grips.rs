//! Steps of a request `go` that grip: command the fingers, await the outcome, attach what they hold or detach what they
//! have released.

use serde_json::json;

use super::super::motion::go_steps::Failed;
use super::super::motion::going::{Going, POLL_PERIOD};
use crate::runtime::{Service, internal};
use dimos_core::telemetry::{Origin, Outcome};
use dimos_rpc::api::{
    Attach, Detach, EndedBy, GRASP_REACH, GoGripper, GoPhase, Grip, GripObjects, GripOutcome, GripReport, GripperEnd,
    Opening, Reply, Request as Call, RobotReport, World, WorldObject,
};
use dimos_rpc::{Backend, Code, RpcError};
use dimos_yaml::did_you_mean;

/// Positions are rounded in files; this far out of its range a position is still in it [m or rad].
const SAME_POSITION: f64 = 1e-6;

/// What becomes of objects once the fingers are at rest.
enum Then {
    /// Nothing.
    Nothing,
    /// This robot of the planner holds this one.
    Attach(String, String),
    /// These are released.
    Detach(Vec<String>),
}

impl Service {
    /// Checks a step before anything moves: its gripper, position, force and object.
    pub(in crate::runtime) async fn check_grip(&self, call: &GoGripper) -> Result<(), RpcError> {
        let arm = self.facts.arm_index(&call.arm)?;
        let refused = |outcome| Err(self.refusal(&outcome).unwrap_or_else(internal));
        let Some(info) = self.facts.gripper_info(arm.into()) else { return refused(Outcome::NoGripper(arm)) };
        self.check_gripper(arm)?;
        let (to, within) = (self.position_of(call)?, |[low, high]: [f64; 2], value: f64| {
            (low - SAME_POSITION..=high + SAME_POSITION).contains(&value)
        });
        if info.range.is_some_and(|(closed, open)| !within([closed.min(open), closed.max(open)], to)) {
            return refused(Outcome::GripperOutOfLimits(arm, to));
        }
        match (call.force, info.force_range) {
            (Some(_), None) => return refused(Outcome::NoGripperForce(arm)),
            (Some(force), Some((least, most))) if !within([least, most], force) => {
                return refused(Outcome::GripperForceOutOfLimits(arm, force));
            }
            _ => {}
        }
        if let Some(GripObjects::Attach(name) | GripObjects::Either(name)) = &call.objects {
            let objects = self.objects().await?;
            objects.iter().find(|object| object.name == *name).ok_or_else(|| unknown_object(name, &objects))?;
        }
        Ok(())
    }

    /// Returns the commanded position [m or rad].
    pub(in crate::runtime) fn position_of(&self, call: &GoGripper) -> Result<f64, RpcError> {
        let end = match call.to {
            Opening::Position(position) => return Ok(position),
            Opening::End(end) => end,
        };
        let range = self.facts.gripper_info(self.facts.arm_index(&call.arm)?.into()).and_then(|info| info.range);
        let (closed, open) = range.ok_or_else(|| {
            let what = format!("the gripper of {} reports no range", call.arm);
            RpcError::new(Code::Unsupported, what).hint("give its position as a number")
        })?;
        Ok(if end == GripperEnd::Open { open } else { closed })
    }

    async fn objects(&self) -> Result<Vec<WorldObject>, RpcError> {
        match self.planner_call(Call::World(World {})).await? {
            Reply::World(world) => Ok(world.objects),
            _ => Err(internal()),
        }
    }

    /// Carries out a step. The position is commanded under the lease of the arm.
    pub(in crate::runtime) async fn grip_step(
        &self,
        going: &Going,
        call: GoGripper,
        origin: &mut Origin,
    ) -> Result<(), Failed> {
        let then = self.what_follows(&call).await?;
        let arm = [call.arm.clone()];
        let command = Call::Gripper(call.command(self.position_of(&call)?));
        let (method, answer) = (command.method(), Box::pin(self.answer_counted(command, *origin)));
        let Reply::Gripper(sent) = going.command(&arm, method, answer).await? else {
            return Err(internal().into());
        };
        let asked = Grip { arm: call.arm.clone(), order: Some(sent.order) };
        let report = loop {
            let report = self.grip(&asked)?;
            going.step(GoPhase::Gripping, |step| step.grip = Some(report.clone()));
            if report.done {
                break report;
            }
            // The fingers continue.
            going.check()?;
            tokio::time::sleep(POLL_PERIOD).await;
        };
        going.check()?;
        judge(&call.arm, &report, &then)?;
        // A load that this sets may disable the arm for a moment: that is no interruption by others.
        let undisturbed = self.tick.epoch() == origin.epoch;
        match then {
            Then::Nothing => {}
            Then::Attach(robot, name) => {
                let within = Some(GRASP_REACH);
                let attach = Attach { name: name.clone(), robot, within, ..Attach::default() };
                Box::pin(self.answer_counted(Call::Attach(attach), *origin)).await?;
                going.step(GoPhase::Gripping, |step| step.attached.push(name));
            }
            Then::Detach(names) => {
                for name in names {
                    let detach = Call::Detach(Detach { name: name.clone() });
                    let arms = self.arms_of_load(&detach).await?;
                    let (method, answer) = (detach.method(), Box::pin(self.answer_counted(detach, *origin)));
                    going.command(&arms, method, answer).await?;
                    going.step(GoPhase::Gripping, |step| step.detached.push(name));
                }
            }
        }
        if undisturbed {
            origin.epoch = self.tick.epoch();
        }
        Ok(())
    }

    /// Returns what becomes of objects after the grip; checked before the fingers move.
    async fn what_follows(&self, call: &GoGripper) -> Result<Then, Failed> {
        let Some(wanted) = &call.objects else { return Ok(Then::Nothing) };
        let (arm, robots) = (&call.arm, self.robots().await?);
        let joints = self.facts.names.arms.iter().find(|own| own.hardware_id == *arm).map(|own| &own.joints);
        let has = |joint: &String| joints.is_some_and(|joints| joints.contains(joint));
        let is_of = |robot: &&RobotReport| robot.name == *arm || robot.joints.iter().any(has);
        let Some(robot) = robots.iter().find(is_of).map(|robot| robot.name.clone()) else {
            let names: Vec<&str> = robots.iter().map(|robot| robot.name.as_str()).collect();
            let what = format!("the planner has no robot {arm}, only {}", names.join(", "));
            let error = RpcError::new(Code::UnknownRobot, what);
            return Err(error.hint("objects are attached to the robots of `planner.robots`").into());
        };
        let world = self.objects().await?;
        let is_ours = |object: &WorldObject| object.held_by.as_ref().is_some_and(|[by, _]| *by == robot);
        let failed = |what: String, hint: String| Err(grip_failed(what, None).hint(hint).into());
        let (GripObjects::Attach(name) | GripObjects::Either(name)) = wanted else {
            let held: Vec<String> = world.iter().filter(|object| is_ours(object)).map(|o| o.name.clone()).collect();
            return match held.is_empty() {
                true => failed(
                    format!("{arm} holds no object: there is none to detach"),
                    "`dimos world list` shows what is held".to_owned(),
                ),
                false => Ok(Then::Detach(held)),
            };
        };
        let object = world.iter().find(|object| object.name == *name).ok_or_else(|| unknown_object(name, &world))?;
        match &object.held_by {
            Some(_) if is_ours(object) && matches!(wanted, GripObjects::Either(_)) => {
                Ok(Then::Detach(vec![name.clone()]))
            }
            Some([by, link]) => {
                failed(format!("{name} is held already, by {by} at {link}"), format!("dimos world detach {name}"))
            }
            None => Ok(Then::Attach(robot, name.clone())),
        }
    }
}

/// Fails if the fingers did not get to their position and hold nothing, or if nothing is held that is to be attached.
fn judge(arm: &str, report: &GripReport, then: &Then) -> Result<(), Failed> {
    let text = report.text();
    let failed = |what: String, hint: &str| {
        let error = grip_failed(what, Some(report)).hint(hint);
        Err(Failed { by: EndedBy::Grip, error: Some(error) })
    };
    match (report.outcome, then) {
        (None, _) => {
            let why = report.error.as_deref().unwrap_or("no outcome");
            failed(format!("{arm}: {text}: {why}"), "`dimos state` shows the gripper now")
        }
        (Some(GripOutcome::Blocked), _) => failed(
            format!("{arm}: {text}, on the way to {:.4} {}", report.target, report.unit),
            "remove what is in the way of the fingers, or command a larger --force",
        ),
        (Some(GripOutcome::Holding), Then::Attach(..)) => Ok(()),
        (Some(GripOutcome::Ordered), Then::Attach(_, name)) => {
            failed(format!("{arm}: {text}: {name} is not attached"), "attach what it holds with `dimos world attach`")
        }
        (Some(_), Then::Attach(_, name)) => failed(
            format!("{arm}: {text}: it holds nothing, {name} is not attached"),
            "move the fingers around the object first",
        ),
        _ => Ok(()),
    }
}

fn grip_failed(what: String, report: Option<&GripReport>) -> RpcError {
    RpcError { data: report.map(|report| json!(report)), ..RpcError::new(Code::GripFailed, what) }
}

fn unknown_object(name: &str, world: &[WorldObject]) -> RpcError {
    let known = did_you_mean(name, world.iter().map(|object| object.name.as_str()), "it has");
    RpcError::new(Code::UnknownObject, format!("the planner's world has no object {name}"))
        .hint(known.unwrap_or_else(|| "`dimos world add` adds one".to_owned()))
}
