//! Reports of a run: status, state, motions, streams.

use std::sync::Arc;
use std::sync::atomic::Ordering::{Acquire, Relaxed};
use std::time::Instant;

use crate::runtime::motion::motions::{End, NATIVE, Next};
use crate::runtime::service::Service;
use crate::runtime::tool::tcp::TcpModel;
use dimos_control::arm_control::effective;
use dimos_core::arm::{ArmState, Pose, VelocitySource};
use dimos_core::clock::WallOffset;
use dimos_core::sync::lock;
use dimos_core::telemetry::describe::{Described, Severity};
use dimos_core::telemetry::texts::{bound_text, cause_text, outcome_text, reason_text};
use dimos_core::telemetry::{Cause, Outcome, Phase, Reason, TaskState};
use dimos_hardware::device::Connected;
use dimos_hardware::registry::Teach;
use dimos_rpc::api::{LoadReport, SpeedReport, TextLog, TextLogReport};
use dimos_rpc::report::*;
use dimos_rpc::server::streams::{EventReport, JointState, Level};
use dimos_rpc::{Code, RpcError};
use dimos_rt::histogram::Figures;

impl Service {
    /// Returns the reply to `status`.
    pub fn status(&self) -> StatusReport {
        let (parts, pulse) = (&self.parts, &self.parts.pulse);
        let started = parts.wall.wall(self.now()) as i64 - self.started.elapsed().as_nanos() as i64;
        StatusReport {
            // Added by the server, which knows its connections.
            share: None,
            run: parts.run.clone(),
            pid: std::process::id(),
            version: crate::VERSION.to_owned(),
            blueprint: parts.blueprint.name.clone(),
            started: rfc3339(started),
            uptime: self.started.elapsed().as_secs_f64(),
            epoch: pulse.epoch.load(Acquire),
            tick_rate: parts.config.rate,
            simulated: parts.blueprint.arms.iter().any(|arm| !arm.is_real()),
            log: parts.log.as_ref().map(|p| p.display().to_string()),
            realtime: parts
                .grants
                .iter()
                .map(|g| RealtimeReport {
                    what: format!("{}: {}", g.what, g.detail),
                    granted: g.granted,
                    remedy: (!g.remedy.is_empty()).then(|| g.remedy.to_owned()),
                })
                .collect(),
            ticks: TickReport {
                clock: parts.blueprint.coordinator.clock.to_string(),
                without_state: pulse.unprompted.load(Relaxed),
                count: pulse.ticks.load(Relaxed),
                overruns: pulse.overruns.load(Relaxed),
                skipped: pulse.skipped.load(Relaxed),
                lateness_us: percentiles(pulse.lateness.figures()),
                compute_us: percentiles(pulse.compute.figures()),
            },
            recorder: self.recorder.get().filter(|_| parts.log.is_some()).map(|stats| RecorderReport {
                messages: stats.messages.load(Relaxed),
                dropped: stats.dropped.load(Relaxed) + pulse.dropped.load(Relaxed),
                error: stats.failed.load(Relaxed).then(|| "a write failed: the log has ended".to_owned()),
            }),
            arms: self
                .tcp_models()
                .iter()
                .enumerate()
                .filter_map(|(i, tcp)| self.arm_report(i, tcp.as_ref()))
                .collect(),
            speed: self.speed_override(),
            tasks: (0..parts.config.tasks.len()).filter_map(|i| self.task_report(i)).collect(),
            planner: None, // filled in by the `status` method
            view: self.view.get().cloned(),
            metrics: self.metrics.get().cloned(),
        }
    }

    /// Returns the reply to `text_log`.
    pub(in crate::runtime) fn text_log(&self, request: TextLog) -> Result<TextLogReport, RpcError> {
        let none = || RpcError::new(Code::Unsupported, "this run keeps no text log: another program started it");
        self.parts.text.as_ref().map(|text| text.after(request.after)).ok_or_else(none)
    }

    /// Returns the speed override.
    pub(in crate::runtime) fn speed_override(&self) -> SpeedReport {
        let pulse = &self.parts.pulse;
        // 0 before the first tick.
        let fraction = Some(f64::from_bits(pulse.speed.load(Relaxed))).filter(|fraction| *fraction > 0.0);
        SpeedReport { fraction: fraction.unwrap_or(1.0), paused: pulse.paused.load(Relaxed) }
    }

    fn arm_report(&self, index: usize, tcp: Option<&TcpModel>) -> Option<ArmReport> {
        let (arm, device) = (self.parts.blueprint.arms.get(index)?, self.parts.devices.get(index)?);
        let (view, health, now) = (self.arm_view(index)?, device.health(), self.now());
        let Connected { info, gripper, io, reduction, .. } = self.parts.connected.get(index)?;
        let faults = health.episodes().into_iter().map(|e| FaultReport {
            since: now.seconds_since(e.since),
            over: e.until.is_some(),
            count: e.count,
            text: e.text,
        });
        let counters = [
            ("reads", &health.reads),
            ("read_errors", &health.read_errors),
            ("writes", &health.writes),
            ("write_errors", &health.write_errors),
            ("withheld", &health.withheld),
            ("reconnects", &health.reconnects),
        ];
        Some(ArmReport {
            hardware_id: arm.hardware_id.clone(),
            adapter: arm.adapter_type.clone(),
            address: arm.address.clone(),
            simulated: !arm.is_real(),
            local: self.parts.local.get(index).is_some_and(|local| *local),
            link: view.state.link.name().to_owned(),
            phase: view.phase.name().to_owned(),
            led_by: (view.phase == Phase::Led).then(|| self.led_by(index as u16).to_owned()),
            teach: match arm.adapter.teach {
                Teach::HandGuiding => Some("hand_guiding".into()),
                Teach::MotorsOff => Some("motors_off".into()),
                Teach::No(_) => None,
            },
            cause: (view.cause != Cause::None).then(|| {
                let by = (view.cause == Cause::Operator).then(|| self.parts.dispatcher.stopped_by(index as u16));
                CauseReport {
                    name: view.cause.name().to_owned(),
                    text: cause_text(view.cause),
                    by: by.flatten().map(Arc::unwrap_or_clone),
                }
            }),
            stop_pending: self.late_stops.is_waiting(index),
            enabled: view.state.enabled,
            mode: view.state.mode.name().to_owned(),
            speed_fraction: view.state.speed_fraction,
            device_state: health.codes().map(|codes| DeviceState { state: codes.state, mode: codes.mode }),
            error: (view.state.error != 0).then(|| DeviceError { code: view.state.error, text: health.error_text() }),
            state_age_ms: self.age_ms(&view.state),
            measured_rate_hz: Some(health.rate()).filter(|r| *r > 0.0),
            native_rate_hz: info.native_rate,
            faults: faults.collect(),
            commander: None, // filled in by the connection
            gripper_range: gripper.and_then(|gripper| gripper.range).map(<[f64; 2]>::from),
            gripper_unit: gripper.map(|gripper| gripper.unit.name().to_owned()),
            gripper_force_range: gripper.and_then(|gripper| gripper.force_range).map(<[f64; 2]>::from),
            gripper_has_speed: gripper.is_some_and(|gripper| gripper.has_speed),
            gripper_force_unit: gripper.map(|gripper| gripper.force_unit.name().to_owned()),
            gripper_force: view.state.gripper_force,
            io: io.zip(health.details().io).map(|(info, state)| self.io_report(index, &info, &state)),
            joints: self.joint_status(index, &health.details()),
            payload: health.details().payload.map(LoadReport::from),
            tcp: tcp.map(TcpModel::report),
            identity: self.parts.devices.get(index).and_then(|device| device.health().identity().accepted),
            model_notes: self.model_notes(index),
            limits_note: reduction.as_ref().map(|reduction| reduction.text.clone()),
            position_limits: self.position_limits(index),
            on_exit: arm.on_exit.name().to_owned(),
            holds_when_disabled: info.holds_when_disabled,
            counters: counters.into_iter().map(|(name, n)| (name.to_owned(), n.load(Relaxed))).collect(),
        })
    }

    /// Returns what is to be said of how an arm's model fits it.
    fn model_notes(&self, arm: usize) -> Vec<String> {
        let kinematics = self.parts.kinematics.get(arm).cloned().flatten();
        kinematics.into_iter().chain(self.model_note(arm)).collect()
    }

    /// Returns the lowest and highest position of an arm's joints [rad].
    fn position_limits(&self, arm: usize) -> Vec<[f64; 2]> {
        let Some(config) = self.parts.config.arms.get(arm) else { return Vec::new() };
        let limits = &config.limits;
        limits.position_lower.iter().zip(&limits.position_upper).map(|(lower, upper)| [*lower, *upper]).collect()
    }

    fn task_report(&self, index: usize) -> Option<TaskReport> {
        let (config, view) = (self.parts.config.tasks.get(index)?, self.task_view(index));
        let row = &self.parts.blueprint.tasks.get(index)?.spec;
        Some(TaskReport {
            name: config.name.clone(),
            kind: config.kind.name.clone(),
            takes: row.takes.iter().map(|kind| kind.method().to_owned()).collect(),
            joints: config.joints.iter().map(|&j| self.parts.names.joint(j)).collect(),
            priority: config.priority,
            state: view.state.name().to_owned(),
            progress: (view.motion > 0).then_some(view.progress),
            reason: self.reason(&view.reason),
            motion: (view.motion > 0).then_some(view.motion),
            distance: view.distance,
            bound: Some(bound_text(view.bound, &self.parts.names)).filter(|text| !text.is_empty()),
            stream: self.counters.get(index).and_then(|counters| counters.report()),
        })
    }

    fn reason(&self, reason: &Reason) -> Option<String> {
        (*reason != Reason::None).then(|| reason_text(reason, &self.parts.names))
    }

    /// Returns the age of a state [ms].
    fn age_ms(&self, state: &ArmState) -> Option<f64> {
        (state.seq > 0).then(|| self.now().seconds_since(state.stamp) * 1e3)
    }

    /// Returns the reply to `state`.
    pub fn state(&self) -> StateReport {
        let mut poses = self.tcp_poses();
        let arms = self.parts.blueprint.arms.iter().enumerate().filter_map(|(i, arm)| {
            let view = self.arm_view(i)?;
            let (s, known, gripper) = (&view.state, view.state.seq > 0, self.gripper_info(i));
            let joints = arm.joints.iter().enumerate().map(|(j, name)| JointReport {
                name: name.clone(),
                position: s.position.get(j).copied().filter(|_| known),
                velocity: s.velocity.get(j).copied().filter(|_| s.velocity_source != VelocitySource::Absent),
                velocity_source: s.velocity_source.name().to_owned(),
                effort: s.effort.and_then(|e| e.get(j).copied()),
                command: view.command.mode.and_then(|_| view.command.values.get(j).copied()),
            });
            Some(ArmStateReport {
                hardware_id: arm.hardware_id.clone(),
                simulated: !arm.is_real(),
                age_ms: self.age_ms(s),
                speed_fraction: s.speed_fraction,
                joints: joints.collect(),
                gripper: s.gripper,
                gripper_unit: gripper.map(|gripper| gripper.unit.name().to_owned()),
                gripper_force: s.gripper_force,
                gripper_force_unit: gripper.map(|gripper| gripper.force_unit.name().to_owned()),
                pose: poses.get_mut(i).and_then(Option::take),
                device_pose: s.pose.and_then(|pose| Some(device_pose("flange", "base", pose.flange()?))),
                device_tool_pose: s.pose.map(|pose| device_pose("tool", "controller", pose.tcp)),
                device_pose_missing: s.pose.and_then(|pose| pose.missing()).map(str::to_owned),
                wrench: s.wrench,
            })
        });
        StateReport { tick: self.last_tick(), stamp: self.wall_seconds(), arms: arms.collect() }
    }

    fn last_tick(&self) -> u64 {
        self.parts.pulse.ticks.load(Relaxed).saturating_sub(1)
    }

    pub(in crate::runtime) fn wall_seconds(&self) -> f64 {
        self.parts.wall.wall(self.now()) as f64 * 1e-9
    }

    /// Returns the reply to `motion`.
    pub fn motion(&self, number: u64) -> Result<MotionReport, RpcError> {
        let motions = lock(&self.motions);
        let Some((planned, end)) = motions.get(number) else {
            return Err(RpcError::new(Code::UnknownMotion, format!("no motion {number}, or too long ago")));
        };
        let task = if planned.task == NATIVE { "native".to_owned() } else { self.parts.names.task(planned.task) };
        let collision_checked = planned.plan.is_some();
        let retraces_to = planned.retraces_to;
        let by = planned.by.as_deref().cloned();
        let mut report =
            MotionReport { motion: number, task, by, collision_checked, retraces_to, ..Default::default() };
        let view = self.task_view(planned.task as usize);
        if view.motion == number {
            (report.progress, report.elapsed, report.remaining) = (view.progress, view.elapsed, view.remaining);
        }
        if planned.task == NATIVE {
            report.elapsed = planned.duration;
        }
        let over = !matches!(view.state, TaskState::Executing | TaskState::Cancelling);
        let end = match end {
            Some(end) => Some(end.clone()),
            // The task has ended, but the recorder has not reported the end yet; if it fell behind, it never will. The
            // arm's present position is its end.
            None if view.motion == number && over => {
                let at = self.positions();
                let actual = planned.joints.iter().map(|j| at.get(*j as usize).copied().unwrap_or(f64::NAN)).collect();
                Some(End { state: view.state, reason: view.reason, actual, tick: self.last_tick() })
            }
            None => None,
        };
        // The task counts the time on the path: less than has passed, if the motion was slowed or paused.
        if let Some(began) = planned.began {
            let ticks = end.as_ref().map_or_else(|| self.last_tick(), |end| end.tick).saturating_sub(began);
            report.elapsed = report.elapsed.max(ticks as f64 * self.period().as_secs_f64());
        }
        let Some(end) = end else {
            let speed = self.speed_override();
            report.remaining /= speed.fraction;
            report.speed_fraction = self.slowest(&planned.joints);
            report.remaining /= report.speed_fraction.filter(|fraction| *fraction > 0.0).unwrap_or(1.0);
            report.speed = Some(speed).filter(|speed| *speed != SpeedReport::default());
            let state = if view.motion == number { view.state } else { TaskState::Executing };
            report.state = state.name().to_owned();
            return Ok(report);
        };
        report.state = end.state.name().to_owned();
        report.done = true;
        // Cancelled or held is the state; the obstacle is the reason.
        let was_stopped = matches!(end.reason, Reason::Cancelled | Reason::WayBlocked | Reason::ArmHeld(..));
        let blocked = planned.blocked.clone().filter(|_| was_stopped);
        report.error = blocked.or_else(|| self.reason(&end.reason));
        match &planned.next {
            Some(Next::Planning) => (report.replanning, report.done) = (true, false),
            Some(Next::Motion(next)) => report.next = Some(*next),
            Some(Next::None(why)) => report.error = report.error.map(|error| format!("{error}; no way around: {why}")),
            None => {}
        }
        if end.state == TaskState::Completed {
            (report.progress, report.remaining) = (1.0, 0.0);
        }
        let all = planned.joints.iter().zip(&planned.goal).zip(&end.actual);
        let deviation = all.map(|((joint, target), actual)| Deviation {
            joint: self.parts.names.joint(*joint),
            target: *target,
            actual: *actual,
        });
        report.deviation = Some(deviation.collect());
        Ok(report)
    }

    /// Returns the smallest fraction of the speed at which a controller of these joints runs motions, if below 1.
    fn slowest(&self, joints: &[u16]) -> Option<f64> {
        let of = |joint: &u16| Some(effective(self.arm_view(self.locate(*joint)?.0)?.state.speed_fraction));
        joints.iter().filter_map(of).min_by(f64::total_cmp).filter(|fraction| *fraction < 1.0)
    }

    /// Returns the limits of a joint [rad].
    fn range(&self, joint: u16) -> Option<[f64; 2]> {
        let (arm, j) = self.locate(joint)?;
        let limits = &self.parts.config.arms.get(arm)?.limits;
        Some([*limits.position_lower.get(j)?, *limits.position_upper.get(j)?])
    }

    /// Returns a refusal by the tick as an error; `None`: it was accepted.
    pub(in crate::runtime) fn refusal(&self, outcome: &Outcome) -> Option<RpcError> {
        let code = Code::of(outcome)?;
        let names = &self.parts.names;
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
                .hint(match self.range(*joint) {
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
                let info = self.gripper_info((*a).into()).unwrap_or_default();
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

    /// Publishes the joint state of the last tick, unless that was done already: to subscribers, and now and then for
    /// later ones.
    pub fn publish(&self, ticked: bool) {
        let (streams, now) = (&self.parts.streams, self.now());
        let published = self.parts.blueprint.coordinator.publish_joint_state;
        let listened_to = published && streams.has_joint_state_readers();
        self.parts.pulse.streaming.store(listened_to, Relaxed);
        // The tick also wakes this thread for replies; a late wake-up publishes the newest tick.
        let ticks = self.parts.pulse.ticks.load(Relaxed);
        let wanted = (listened_to && ticked) || (published && streams.is_state_due(now));
        if wanted && ticks > 0 && self.published.swap(ticks, Relaxed) != ticks {
            streams.publish_joint_state(now, &self.joint_state());
        }
    }

    fn joint_state(&self) -> JointState {
        let mut out = JointState {
            tick: self.last_tick(),
            stamp: self.wall_seconds(),
            frame_id: self.parts.blueprint.coordinator.joint_state_frame_id.clone(),
            ..JointState::default()
        };
        for (i, arm) in self.parts.blueprint.arms.iter().enumerate() {
            let Some(view) = self.arm_view(i) else { continue };
            let s = &view.state;
            let velocities = s.velocity_source != VelocitySource::Absent;
            for (j, name) in arm.joints.iter().enumerate() {
                out.name.push(name.clone());
                out.position.push(s.position.get(j).copied().filter(|_| s.seq > 0));
                out.velocity.push(s.velocity.get(j).copied().filter(|_| velocities));
                out.effort.push(s.effort.and_then(|e| e.get(j).copied()));
            }
        }
        out
    }

    /// Records an event that no tick has made, and reports it.
    pub(in crate::runtime) fn report_now(&self, described: &Described, wall: WallOffset) {
        self.parts.dispatcher.log(described.severity, described.text.clone());
        self.report_event(self.parts.pulse.ticks.load(Relaxed), described, wall);
    }

    /// Logs an event and publishes it to subscribers.
    pub(in crate::runtime) fn report_event(&self, tick: u64, described: &Described, wall: WallOffset) {
        if let Some(line) = self.log_throttle.line(described, Instant::now()) {
            match described.severity {
                Severity::Info => tracing::debug!("{line}"),
                Severity::Warn => tracing::warn!("{line}"),
                Severity::Error => tracing::error!("{line}"),
            }
        }
        self.parts.streams.publish_event(&EventReport {
            tick,
            stamp: wall.wall(self.now()) as f64 * 1e-9,
            level: match described.severity {
                Severity::Info => Level::Info,
                Severity::Warn => Level::Warning,
                Severity::Error => Level::Error,
            },
            kind: described.kind.to_owned(),
            arm: described.arm.clone(),
            task: described.task.clone(),
            joint: described.joint.clone(),
            text: described.text.clone(),
            by: described.by.clone(),
        });
    }
}

fn percentiles(f: Figures) -> Percentiles {
    Percentiles { p50: f.p50, p99: f.p99, p99_9: f.p99_9, max: f.max }
}

fn rfc3339(wall_ns: i64) -> String {
    let time = jiff::Timestamp::from_nanosecond(i128::from(wall_ns)).unwrap_or_default();
    // Whole seconds suffice for display.
    jiff::Timestamp::from_second(time.as_second()).unwrap_or_default().to_string()
}

/// Returns a pose of the arm's own controller.
fn device_pose(link: &str, frame: &str, pose: Pose) -> PoseReport {
    PoseReport { link: link.to_owned(), tool: None, frame: frame.to_owned(), xyz: pose.xyz, rpy: pose.rpy }
}
