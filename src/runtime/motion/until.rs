//! Conditions that end a motion before its goal: checked before anything moves, then judged by the tick.

use std::future::Future;

use super::go_steps::Failed;
use super::on_path::Covered;
use crate::runtime::arm::arm_requests::{order, refused};
use crate::runtime::{Service, internal};
use dimos_core::until;
use dimos_hardware::peripheral::Part;
use dimos_rpc::api::{EndedBy, Reply, Request as Call, TareReply, Until};
use dimos_rpc::{Code, RpcError};

tokio::task_local! {
    static AWAITED: Option<until::Until>;
}

/// Does work whose motion ends with these conditions.
pub fn awaiting<T>(until: Option<until::Until>, work: impl Future<Output = T>) -> impl Future<Output = T> {
    AWAITED.scope(until, work)
}

/// Returns the conditions of the motion that is being requested.
pub fn awaited() -> Option<until::Until> {
    AWAITED.try_with(|until| *until).ok().flatten()
}

impl Service {
    /// Fails if a condition can never be judged. `arms`: those that are to move.
    pub(in crate::runtime) async fn check_until(&self, until: &[Until], arms: &[u16]) -> Result<(), RpcError> {
        for one in until {
            let arm = self.arm_of_until(one, arms)?;
            let name = self.facts.names.arm(arm);
            let unsupported = |what: String, hint: &str| Err(RpcError::new(Code::Unsupported, what).hint(hint));
            let feels = self.tick.arm_view(arm.into()).is_some_and(|view| view.state.wrench.is_some());
            if (one.force.is_some() || one.torque.is_some()) && !feels {
                let hint =
                    "`options.force_torque: true` reads it where there is one; others await time, distance, input";
                return unsupported(format!("{name} reports no force at present: `until` cannot be judged"), hint);
            }
            if let Some((input, _)) = one.level() {
                let io = self.facts.connected.get(usize::from(arm)).and_then(|connected| connected.io);
                let count = io.map_or(0, |io| io.digital_inputs);
                if input >= count {
                    let hint = if count == 0 { "it has no digital inputs" } else { "`dimos arm io` lists its inputs" };
                    return unsupported(format!("{name} has no digital input di{input}"), hint);
                }
                let watched = order(self.arms.device(arm)?.watch_inputs()).await;
                watched.map_err(|e| refused(&name, "did not report its inputs", &e))?;
            }
        }
        Ok(())
    }

    fn arm_of_until(&self, until: &Until, arms: &[u16]) -> Result<u16, RpcError> {
        match (&until.arm, arms) {
            (Some(arm), _) => self.facts.arm_index(arm),
            (None, [arm]) => Ok(*arm),
            (None, _) => Err(RpcError::new(Code::InvalidParams, "`until` is about one arm, and several move")
                .hint("name it: {arm: left, force: 5}")),
        }
    }

    /// Returns what the tick judges. `covered`: the way of the tool along the plan, where a distance is awaited.
    pub(in crate::runtime) fn until_of(
        &self,
        until: &Until,
        arms: &[u16],
        covered: Option<&Covered>,
    ) -> Result<until::Until, RpcError> {
        let distance = match (until.distance, covered) {
            (Some(distance), Some(covered)) => Some((distance, covered.time_of("until", distance)?)),
            (Some(_), None) => return Err(internal()),
            (None, _) => None,
        };
        Ok(until::Until {
            arm: self.arm_of_until(until, arms)?,
            force: until.force,
            torque: until.torque,
            input: until.level(),
            distance,
            time: until.time,
        })
    }

    /// Returns the force to expect at most [N], if the stiffness is given: the threshold, the way of the tool until the
    /// force is read and answered, and its way to rest.
    pub(in crate::runtime) fn peak(&self, until: &Until, arm: u16, covered: &Covered) -> Option<f64> {
        let (force, stiffness) = (until.force?, until.stiffness?);
        let (arm, connected) = (usize::from(arm), self.facts.connected.get(usize::from(arm))?);
        let own = self.facts.blueprint.arms.get(arm)?.peripherals.iter().find(|own| own.row.part == Part::ForceTorque);
        // An arm that does not send its whole state at once is asked for its force in every sixth reading.
        let readings = if connected.info.whole_state_at_once || own.is_some() { 1.0 } else { 6.0 };
        let late = own.map_or(0.0, |sensor| 1.0 / sensor.row.native_rate)
            + readings * connected.read_period.as_secs_f64()
            + connected.write_period.as_secs_f64()
            + self.facts.period().as_secs_f64()
            + self.facts.config.arms.get(arm)?.supervision.lag;
        let speed = self.tick.speed_override().fraction * covered.fastest;
        Some(force + stiffness * 1e3 * speed * (late + covered.braking / 2.0))
    }

    /// Fails if a motion has ended otherwise than awaited: the next step would begin elsewhere than it should.
    pub(in crate::runtime) fn ended_as_awaited(&self, until: Option<&Until>, by: EndedBy) -> Result<EndedBy, Failed> {
        if until.is_none_or(|until| until.is_awaited(by)) {
            return Ok(by);
        }
        let first = match by {
            EndedBy::Distance => "the distance",
            EndedBy::Time => "the time",
            _ => "the goal",
        };
        let error = RpcError::new(Code::NotMet, format!("{first} came before what was awaited"));
        Err(Failed { by, error: Some(error.hint("nothing was touched where it was expected: look at the workpiece")) })
    }

    /// Makes the present force and torque of an arm zero.
    pub(in crate::runtime) async fn tare(&self, id: &str) -> Result<Reply, RpcError> {
        let arm = self.facts.arm_index(id)?;
        self.rests(arm)?;
        let wrench = order(self.arms.device(arm)?.tare()).await;
        let wrench = wrench.map_err(|e| refused(id, "has no force to tare", &e))?;
        Ok(Reply::ArmTare(TareReply { wrench }))
    }

    /// Returns the way that the tool covers along a plan.
    pub(in crate::runtime) async fn covered_by(&self, plan: u64) -> Result<Covered, RpcError> {
        let asked = Call::Planning(dimos_rpc::api::Planning { plan });
        let Reply::Planning(report) = self.planner_call(asked).await? else { return Err(internal()) };
        self.covered(plan, report.summary.map_or(1.0, |summary| summary.duration)).await
    }
}
