//! Gripper commands, and their outcomes. The outcome thread judges a pending one after every tick.

use std::time::{Duration, Instant};

use super::grip_judge::{GripJudge, Reading};
use crate::runtime::arm::arm_requests::ORDER_LIMIT;
use crate::runtime::client::tick_link::EachTick;
use crate::runtime::{Service, internal};
use dimos_control::request::Request;
use dimos_core::arm::{GripperUnit, Link};
use dimos_core::clock::Mono;
use dimos_core::message::Message;
use dimos_core::sync::lock;
use dimos_core::telemetry::texts::cause_text;
use dimos_core::telemetry::{ArmSample, Origin, Outcome, Phase};
use dimos_hardware::adapter::AdapterError;
use dimos_rpc::api::{self, GripReport, Reply};
use dimos_rpc::{Code, RpcError};

/// Timeout for the position of a gripper that is ready.
const POSITION_LIMIT: Duration = Duration::from_millis(300);
/// Default time for an outcome [s].
const TIMEOUT: f64 = 20.0;

/// A gripper command without an outcome yet.
struct Pending {
    judge: GripJudge,
    began: Mono,
    given_up: Mono,
    /// Every tick wakes the thread that judges.
    _each_tick: EachTick,
}

/// The latest gripper command of an arm.
#[derive(Default)]
pub struct LatestGrip {
    report: Option<GripReport>,
    pending: Option<Pending>,
}

impl Service {
    /// Commands a gripper, and waits for the arm's answer to this order.
    pub(in crate::runtime) async fn gripper(&self, call: api::Gripper, origin: Origin) -> Result<Reply, RpcError> {
        let arm = self.facts.arm_index(&call.arm)?;
        self.check_gripper(arm)?;
        if self.arms.gripper(arm.into()).is_some() {
            // The arm's next state has the position of one that has just become ready.
            let view = || self.tick.arm_view(arm as usize);
            self.tick
                .until(Instant::now() + POSITION_LIMIT, || view().filter(|view| view.state.gripper.is_some()))
                .await;
        }
        let from = self.tick.arm_view(arm as usize).map(|view| view.state.gripper);
        let info = self.facts.gripper_info(arm.into()).unwrap_or_default();
        // One that nothing measures has no position before its first order: it is taken to be at the other end.
        let other = info.range.filter(|_| info.unit == GripperUnit::OnOff);
        let other = other.map(|(closed, open)| if call.position == closed { open } else { closed });
        let Some(from) = from.unwrap_or(Some(call.position)).or(other) else {
            return self.refusal(&Outcome::NoGripper(arm)).map_or_else(|| Err(internal()), Err);
        };
        let device = self.arms.device(arm)?;
        let unit = info.unit.name();
        let _turn = self.grippers.turns.get(arm as usize).ok_or_else(internal)?.lock().await;
        let now = self.now();
        let request = Request::Gripper { arm, opening: call.position, force: call.force, speed: call.speed };
        self.ask_from(request, Some(origin)).await?;
        let order = self.tick.arm_view(arm as usize).ok_or_else(internal)?.command.gripper_seq;
        let gone = |view: &ArmSample| matches!(view.state.link, Link::Down | Link::Faulted);
        let gone = || self.tick.seen(arm, gone).map(|()| Err(AdapterError::NotConnected));
        let look = || device.health().gripper_answer(order).or_else(gone);
        match self.tick.until(Instant::now() + ORDER_LIMIT, look).await {
            Some(Ok(())) => {
                let judge = GripJudge::new(info, call.position, call.force, from, now);
                let timeout = Duration::try_from_secs_f64(call.timeout.unwrap_or(TIMEOUT)).unwrap_or_default();
                let report = GripReport {
                    arm: call.arm,
                    order,
                    target: call.position,
                    position: from,
                    unit: unit.to_owned(),
                    force_unit: info.force_unit.name().to_owned(),
                    ..GripReport::default()
                };
                self.begin_grip(arm, report, (judge, now, now.after(timeout)));
                Ok(Reply::Gripper(api::GripperReply {
                    position: call.position,
                    unit: unit.to_owned(),
                    force: call.force,
                    force_unit: call.force.map(|_| info.force_unit.name().to_owned()),
                    speed: call.speed,
                    order,
                }))
            }
            Some(Err(error)) => {
                let message = Message::of(format!("{} refused the gripper order: {error}", call.arm));
                let hint = format!("`dimos state` shows the gripper's position now [{unit}], `dimos status` its range");
                let (what, hint) = message.or_hint(hint);
                Err(RpcError::new(Code::DeviceRefused, what).hint(hint))
            }
            None => {
                let what = format!("{} did not answer the gripper order within {} s", call.arm, ORDER_LIMIT.as_secs());
                Err(RpcError::new(Code::NoAnswer, what).hint("`dimos status` shows the arm's connection"))
            }
        }
    }

    /// Returns the progress or outcome of a gripper command.
    pub(in crate::runtime) fn grip(&self, call: &api::Grip) -> Result<GripReport, RpcError> {
        let arm = self.facts.arm_index(&call.arm)?;
        let latest = lock(self.grippers.latest.get(arm as usize).ok_or_else(internal)?);
        match &latest.report {
            Some(report) if call.order.is_none_or(|order| order == report.order) => Ok(report.clone()),
            Some(report) => Ok(GripReport {
                order: call.order.unwrap_or_default(),
                done: true,
                outcome: None,
                error: Some("a newer gripper command replaced it".into()),
                ..report.clone()
            }),
            None => {
                let what = format!("no gripper command was sent to {} yet", call.arm);
                Err(RpcError::new(Code::InvalidParams, what).hint("send one with `gripper`"))
            }
        }
    }

    fn begin_grip(&self, arm: u16, report: GripReport, pending: (GripJudge, Mono, Mono)) {
        let Some(latest) = self.grippers.latest.get(arm as usize) else { return };
        let mut latest = lock(latest);
        let (judge, began, given_up) = pending;
        let pending = Pending { judge, began, given_up, _each_tick: self.tick.each_tick() };
        *latest = LatestGrip { report: Some(report), pending: Some(pending) };
    }

    /// Judges the pending gripper commands by the latest measurements.
    pub fn judge_grips(&self) {
        for (arm, latest) in self.grippers.latest.iter().enumerate() {
            let LatestGrip { report: Some(report), pending } = &mut *lock(latest) else { continue };
            let Some(Pending { judge, began, given_up, .. }) = pending else { continue };
            let (now, Some(view)) = (self.now(), self.tick.arm_view(arm)) else { continue };
            report.elapsed = now.since(*began).as_secs_f64();
            (report.position, report.force) = (view.state.gripper.unwrap_or(report.position), view.state.gripper_force);
            match self.observe(arm, report.order, judge, &view) {
                Ok(outcome) => {
                    report.outcome = outcome;
                    if outcome.is_some() {
                        self.note_grip(arm, outcome == Some(api::GripOutcome::Holding));
                    }
                }
                Err(error) => report.error = Some(error),
            }
            if report.outcome.is_some() {
                report.elapsed = judge.elapsed().as_secs_f64();
            } else if report.error.is_none() && now >= *given_up {
                let after = given_up.since(*began).as_secs_f64();
                report.error = Some(match judge.is_unmeasured() {
                    true => format!("the order is not confirmed after {after} s"),
                    false => format!("its fingers still move after {after} s"),
                });
            }
            if report.outcome.is_some() || report.error.is_some() {
                report.done = true;
                *pending = None;
            }
        }
    }

    /// Judges one command; the error is why it can have no outcome.
    fn observe(
        &self,
        arm: usize,
        order: u32,
        judge: &mut GripJudge,
        view: &ArmSample,
    ) -> Result<Option<api::GripOutcome>, String> {
        let state = &view.state;
        if view.command.gripper_seq != order {
            return Err("a newer gripper command replaced it".into());
        }
        if view.phase == Phase::Held {
            return Err(format!("the arm was held meanwhile: {}", cause_text(view.cause)));
        }
        if self.lifecycle.is_closed() {
            return Err("the run is shutting down".into());
        }
        if let Some(lost) = self.gripper_is_lost(arm) {
            return Err(lost.message);
        }
        match (state.link, state.gripper) {
            (Link::Up, Some(position)) => {
                let holds = self.arms.get(arm).and_then(|device| device.health().gripper_holds());
                Ok(judge.observe(&Reading { position, force: state.gripper_force, holds }, self.now()))
            }
            (Link::Down | Link::Faulted, _) => Err("the connection to the arm was lost".into()),
            (Link::Up, None) if judge.is_unmeasured() => Ok(None), // not confirmed yet
            (Link::Up, None) => Err("the arm no longer reports its gripper".into()),
            (Link::Stale, _) => {
                judge.miss(self.now());
                Ok(None)
            }
        }
    }
}
