//! Requests to the tick, and why it refuses one, as errors with hints.

use super::dispatch::{SendError, log_of};
use crate::runtime::Service;
use dimos_control::request::Request;
use dimos_core::telemetry::texts::outcome_text;
use dimos_core::telemetry::{Origin, Outcome, Phase};
use dimos_rpc::report::end_of_lead;
use dimos_rpc::{Code, RpcError};

impl Service {
    /// Asks something that moves no arm.
    pub(in crate::runtime) async fn ask(&self, request: Request) -> Result<Outcome, RpcError> {
        self.ask_from(request, None).await
    }

    /// Asks something that a client requested, when and by whom.
    pub(in crate::runtime) async fn ask_from(
        &self,
        request: Request,
        origin: Option<Origin>,
    ) -> Result<Outcome, RpcError> {
        let log = log_of(&request);
        self.outcome(self.tick.dispatcher().ask(request, origin, log).await)
    }

    /// Returns the outcome of a request, or an error if there is none.
    pub(in crate::runtime) fn outcome(&self, answer: Result<Outcome, SendError>) -> Result<Outcome, RpcError> {
        let outcome = answer.map_err(|e| self.not_sent(e))?;
        self.refusal(&outcome).map_or(Ok(outcome), Err)
    }

    /// Returns why a request got no outcome as an error.
    pub(in crate::runtime) fn not_sent(&self, error: SendError) -> RpcError {
        let hint = match error {
            SendError::Full => "send fewer requests at once",
            SendError::NoAnswer => "`dimos status` shows whether the run is alive",
            SendError::Ended => return RpcError::new(Code::Superseded, error.to_string()),
        };
        RpcError::new(Code::NoAnswer, error.to_string()).hint(hint)
    }

    /// Returns a refusal by the tick as an error; `None`: it was accepted.
    pub(in crate::runtime) fn refusal(&self, outcome: &Outcome) -> Option<RpcError> {
        let code = Code::of(outcome)?;
        let names = &self.facts.names;
        let error = RpcError::new(code, outcome_text(outcome, names));
        let arm = |i: &u16| names.arm(*i);
        Some(match outcome {
            Outcome::AlreadyExecuting(_) => error.hint("wait for it, or end it with `dimos cancel`"),
            Outcome::StartStateMismatch(joint, distance) => error
                .hint("move to its first point first: `dimos move`")
                .data(serde_json::json!({"joint": names.joint(*joint), "distance": distance})),
            Outcome::StartStateUnavailable(_) => error.hint("`dimos status` shows its link and the age of its state"),
            Outcome::ArmNotReady(a, Phase::Led, _) => error.hint(end_of_lead(&arm(a), self.led_by(*a))),
            Outcome::ArmNotReady(a, ..) => error.hint(format!("make it ready: `dimos arm enable {}`", arm(a))),
            Outcome::Paused => error.hint("dimos resume"),
            Outcome::ArmMoving(_) => error.hint("again when it is at rest"),
            Outcome::ArmLatched(a, _) => {
                let a = arm(a);
                error.hint(format!("when it may move again: `dimos arm reset {a}`, then `dimos arm enable {a}`"))
            }
            Outcome::StillFaulted(a, _) => {
                error.hint(format!("remove the cause, then repeat `dimos arm reset {}`", arm(a)))
            }
            Outcome::Superseded(..) => error.hint("request it again if it is still wanted; a plan must be planned again"),
            Outcome::OutOfReach(joint, by) => {
                error.data(serde_json::json!({"joint": names.joint(*joint), "by": by}))
            }
            Outcome::OutOfLimits(joint, by) => error
                .hint(match self.facts.range(*joint) {
                    Some([lower, upper]) => format!(
                        "{} may be at {lower:.4} … {upper:.4} rad: the arm's own limits, narrowed by `limits` in the blueprint",
                        names.joint(*joint)
                    ),
                    None => "limits are the arm's own, narrowed by `limits` in the blueprint".to_owned(),
                })
                .data(serde_json::json!({"joint": names.joint(*joint), "by": by})),
            Outcome::GripperOutOfLimits(a, opening) => error
                .hint("`dimos status` shows its range")
                .data(serde_json::json!({"arm": arm(a), "opening": opening})),
            Outcome::GripperForceOutOfLimits(a, force) => {
                let info = self.facts.gripper_info((*a).into()).unwrap_or_default();
                let (least, most) = info.force_range.unwrap_or_default();
                error
                    .hint(format!(
                        "give {least} to {most} {}, or no force for the one set in the arm",
                        info.force_unit.name()
                    ))
                    .data(serde_json::json!({"arm": arm(a), "force": force, "range": [least, most]}))
            }
            Outcome::NoGripperForce(_) => error.hint("command its position without a force"),
            Outcome::NoGripperSpeed(_) => error.hint("command its position without a speed"),
            Outcome::WrongTask(_) => error.hint("`dimos status` lists the tasks and their types"),
            _ => error,
        })
    }
}
