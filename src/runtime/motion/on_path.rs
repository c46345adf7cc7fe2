//! Acts at places of a path: when the path's clock passes them, to the tick.

use super::go_steps::Failed;
use super::going::Going;
use crate::runtime::{Service, internal};
use dimos_core::telemetry::{Origin, TaskView};
use dimos_rpc::api::{ActDone, OnPath, PlanSummary, Preview, Reply, Request as Call, Speed};
use dimos_rpc::{Code, RpcError};

/// Samples of a motion for distances along its path, at most, and per second.
const SAMPLES: f64 = 20_000.0;
const RATE: f64 = 1000.0;

/// Acts of a step that are still to be done, in order of time.
#[derive(Default)]
pub struct Acts {
    /// Time along the path [s], index in the request, and what is done.
    left: Vec<(f64, usize, OnPath)>,
    /// The speed before acts changed it, and what they made of it.
    speed: Option<[f64; 2]>,
}

impl Acts {
    /// Returns the time until the next act if the path's clock continues at this rate [s].
    pub fn until(&self, view: &TaskView, rate: f64) -> Option<f64> {
        self.left.first().map(|(time, ..)| (time - view.elapsed) / rate.max(1e-3))
    }
}

/// The way that a tool covers along a plan.
pub struct Covered {
    /// Times along the path [s], and the way until then [m].
    times: Vec<f64>,
    ways: Vec<f64>,
    /// Its highest speed [m/s].
    pub fastest: f64,
    /// Longest time to rest from a place of the path [s].
    pub braking: f64,
}

impl Covered {
    /// Returns the time along the path at which the tool has covered a way [m, s]; fails if it never does. `what` asks.
    pub fn time_of(&self, what: &str, distance: f64) -> Result<f64, RpcError> {
        let whole = self.ways.last().copied().unwrap_or(0.0);
        if distance > whole + 1e-6 {
            let what = format!("{what}: the tool's path is {whole:.4} m long, not {distance} m");
            let error = RpcError::new(Code::InvalidParams, what);
            return Err(error.hint("nothing has moved; `dimos plan` shows a motion"));
        }
        let at = self.ways.partition_point(|covered| *covered < distance).min(self.ways.len() - 1);
        self.times.get(at).or(self.times.last()).copied().ok_or_else(internal)
    }
}

impl Service {
    /// Returns the way that the tool covers along a plan that takes this long [s].
    pub(in crate::runtime) async fn covered(&self, plan: u64, duration: f64) -> Result<Covered, RpcError> {
        let hz = RATE.min(SAMPLES / duration.max(1.0)).floor().max(1.0);
        let asked = Call::Preview(Preview { plan: Some(plan), hz: Some(hz) });
        let Reply::Preview(preview) = self.planner_call(asked).await? else { return Err(internal()) };
        let places = preview.end_effectors.values().next().map(Vec::as_slice).unwrap_or_default();
        let times: Vec<f64> = preview.trajectory.points.iter().map(|point| point.time_from_start).collect();
        let mut ways = vec![0.0];
        for pair in places.windows(2) {
            let [a, b] = pair else { continue };
            let step = a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt();
            ways.push(ways.last().copied().unwrap_or(0.0) + step);
        }
        let speed = |(times, ways): (&[f64], &[f64])| match (times, ways) {
            ([t0, t1], [w0, w1]) if t1 > t0 => (w1 - w0) / (t1 - t0),
            _ => 0.0,
        };
        let fastest = times.windows(2).zip(ways.windows(2)).map(speed).fold(0.0, f64::max);
        let joints = self.facts.joints_named(&preview.trajectory.joint_names)?;
        let mut braking = 0.0_f64;
        for point in &preview.trajectory.points {
            for (joint, velocity) in joints.iter().zip(point.velocities.iter().flatten()) {
                let bound =
                    self.facts.locate(*joint).and_then(|(arm, j)| self.facts.config.arms.get(arm)?.limits.joint(j));
                braking = bound.map_or(braking, |bound| braking.max(velocity.abs() / bound.acceleration));
            }
        }
        Ok(Covered { times, ways, fastest, braking })
    }

    /// Returns the acts of a step with the times at which the plan's motion passes their places.
    pub(in crate::runtime) async fn acts_of(
        &self,
        acts: Vec<(usize, OnPath)>,
        plan: u64,
        summary: &PlanSummary,
    ) -> Result<Acts, RpcError> {
        if acts.is_empty() {
            return Ok(Acts::default());
        }
        let covered = self.covered(plan, summary.duration).await?;
        let time_of = |index: usize, act: &OnPath| match (act.distance, act.waypoint) {
            (Some(distance), _) => covered.time_of(&format!("on_path[{index}]"), distance),
            (None, Some(waypoint)) => summary.passes.get(waypoint - 1).copied().ok_or_else(internal),
            (None, None) => Err(internal()),
        };
        let timed = acts.into_iter().map(|(index, act)| Ok((time_of(index, &act)?, index, act)));
        let mut left = timed.collect::<Result<Vec<_>, RpcError>>()?;
        left.sort_by(|a, b| a.0.total_cmp(&b.0));
        Ok(Acts { left, speed: None })
    }

    /// Does what is to be done before the next tick; all that is left when the motion `is_over`. What was asked for
    /// now is part of the next tick, which commands a place that is one period farther.
    pub(in crate::runtime) async fn do_acts(
        &self,
        going: &Going,
        acts: &mut Acts,
        (view, is_over): (&TaskView, bool),
        origin: Origin,
    ) -> Result<(), Failed> {
        let speed = self.tick.speed_override();
        let ahead = view.elapsed + speed.fraction * self.facts.period().as_secs_f64();
        while acts.left.first().is_some_and(|(time, ..)| is_over || *time <= ahead) {
            let (_, index, act) = acts.left.remove(0);
            let call = match (&act.gripper, act.output, act.speed) {
                (Some(gripper), ..) => {
                    let arm = [gripper.arm.clone()];
                    let command = Call::Gripper(gripper.command(self.position_of(gripper)?));
                    Some((arm.to_vec(), command))
                }
                (None, Some(output), _) => Some((vec![output.arm.clone()], Call::ArmIoSet(output))),
                // After the end there is no speed to change.
                (None, None, Some(_)) if is_over => None,
                (None, None, fraction) => {
                    let now = self.tick.speed_override().fraction;
                    let [before, set] = acts.speed.unwrap_or([now; 2]);
                    // Somebody else has changed it since: that stays. Nor is it ever raised above what it was before.
                    let fraction = fraction.filter(|_| set == now).map(|fraction| fraction.min(before));
                    acts.speed = fraction.map(|fraction| [before, fraction]).or(acts.speed);
                    fraction.map(|_| (Vec::new(), Call::Speed(Speed { fraction, paused: None })))
                }
            };
            if let Some((arms, call)) = call {
                let (method, answer) = (call.method(), Box::pin(self.answer_counted(call, origin)));
                going.command(&arms, method, answer).await?;
            }
            let elapsed = view.elapsed;
            going.update(|report| {
                if let Some(step) = report.steps.last_mut() {
                    step.acts.push(ActDone { on_path: index, elapsed });
                }
            });
        }
        Ok(())
    }

    /// Sets the speed to what it was before acts changed it, unless somebody else has changed it since.
    pub(in crate::runtime) async fn restore_speed(&self, acts: &mut Acts, origin: Origin) {
        let now = self.tick.speed_override().fraction;
        if let Some([fraction, _]) = acts.speed.take().filter(|[_, set]| *set == now) {
            let call = Call::Speed(Speed { fraction: Some(fraction), paused: None });
            // The run may be at its end.
            let _ = self.answer_counted(call, origin).await;
        }
    }
}
