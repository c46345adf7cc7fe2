//! Reports of a run: status, state, motions, streams.

use std::sync::Arc;
use std::sync::atomic::Ordering::{Acquire, Relaxed};
use std::time::Duration;

use crate::runtime::Service;
use crate::runtime::motion::motions::{End, NATIVE, Next};
use crate::runtime::tool::tcp::TcpModel;
use dimos_control::arm_control::effective;
use dimos_core::arm::{ArmState, Pose, VelocitySource};
use dimos_core::telemetry::texts::{bound_text, cause_text, reason_text};
use dimos_core::telemetry::{Cause, Phase, Reason, TaskState};
use dimos_hardware::device::Connected;
use dimos_hardware::registry::Teach;
use dimos_rpc::api::{LoadReport, SpeedReport, TextLog, TextLogReport};
use dimos_rpc::report::*;
use dimos_rpc::{Code, RpcError};
use dimos_rt::histogram::Figures;

impl Service {
    /// Returns the reply to `status`.
    pub fn status(&self) -> StatusReport {
        let (facts, pulse) = (&self.facts, self.tick.pulse());
        let started = facts.wall.wall(self.now()) as i64 - self.lifecycle.uptime().as_nanos() as i64;
        StatusReport {
            // Added by the server, which knows its connections.
            share: None,
            run: facts.run.clone(),
            pid: std::process::id(),
            version: crate::VERSION.to_owned(),
            blueprint: facts.blueprint.name.clone(),
            started: rfc3339(started),
            uptime: self.lifecycle.uptime().as_secs_f64(),
            epoch: pulse.epoch.load(Acquire),
            tick_rate: facts.config.rate,
            simulated: facts.blueprint.arms.iter().any(|arm| !arm.is_real()),
            log: facts.log.as_ref().map(|p| p.display().to_string()),
            realtime: facts
                .grants
                .iter()
                .map(|g| RealtimeReport {
                    what: format!("{}: {}", g.what, g.detail),
                    granted: g.granted,
                    remedy: (!g.remedy.is_empty()).then(|| g.remedy.to_owned()),
                })
                .collect(),
            ticks: TickReport {
                clock: facts.blueprint.coordinator.clock.to_string(),
                without_state: pulse.unprompted.load(Relaxed),
                count: pulse.ticks.load(Relaxed),
                overruns: pulse.overruns.load(Relaxed),
                skipped: pulse.skipped.load(Relaxed),
                lateness_us: percentiles(pulse.lateness.figures()),
                compute_us: percentiles(pulse.compute.figures()),
            },
            recorder: self.journal.recorder.get().filter(|_| facts.log.is_some()).map(|stats| RecorderReport {
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
            speed: self.tick.speed_override(),
            tasks: (0..facts.config.tasks.len()).filter_map(|i| self.task_report(i)).collect(),
            planner: None, // filled in by the `status` method
            view: self.journal.view.get().cloned(),
            metrics: self.journal.metrics.get().cloned(),
        }
    }

    /// Returns the reply to `text_log`.
    pub(in crate::runtime) fn text_log(&self, request: TextLog) -> Result<TextLogReport, RpcError> {
        let none = || RpcError::new(Code::Unsupported, "this run keeps no text log: another program started it");
        self.facts.text.as_ref().map(|text| text.after(request.after)).ok_or_else(none)
    }

    fn arm_report(&self, index: usize, tcp: Option<&TcpModel>) -> Option<ArmReport> {
        let (arm, device) = (self.facts.blueprint.arms.get(index)?, self.arms.get(index)?);
        let (view, health, now) = (self.tick.arm_view(index)?, device.health(), self.now());
        let Connected { info, gripper, io, reduction, .. } = self.facts.connected.get(index)?;
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
            local: self.facts.local.get(index).is_some_and(|local| *local),
            link: view.state.link.name().to_owned(),
            phase: view.phase.name().to_owned(),
            led_by: (view.phase == Phase::Led).then(|| self.led_by(index as u16).to_owned()),
            teach: match arm.adapter.teach {
                Teach::HandGuiding => Some("hand_guiding".into()),
                Teach::MotorsOff => Some("motors_off".into()),
                Teach::No(_) => None,
            },
            cause: (view.cause != Cause::None).then(|| {
                let by = (view.cause == Cause::Operator).then(|| self.tick.dispatcher().stopped_by(index as u16));
                CauseReport {
                    name: view.cause.name().to_owned(),
                    text: cause_text(view.cause),
                    by: by.flatten().map(Arc::unwrap_or_clone),
                }
            }),
            stop_pending: self.arms.stop_is_pending(index),
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
            peripherals: self.peripheral_reports(index),
            io: io.zip(health.details().io).map(|(info, state)| self.io_report(index, &info, &state)),
            joints: self.joint_status(index, &health.details()),
            payload: health.details().payload.map(LoadReport::from),
            tcp: tcp.map(TcpModel::report),
            identity: self.arms.get(index).and_then(|device| device.health().identity().accepted),
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
        let kinematics = self.facts.kinematics.get(arm).cloned().flatten();
        kinematics.into_iter().chain(self.model_note(arm)).collect()
    }

    /// Returns the lowest and highest position of an arm's joints [rad].
    fn position_limits(&self, arm: usize) -> Vec<[f64; 2]> {
        let Some(config) = self.facts.config.arms.get(arm) else { return Vec::new() };
        let limits = &config.limits;
        limits.position_lower.iter().zip(&limits.position_upper).map(|(lower, upper)| [*lower, *upper]).collect()
    }

    fn task_report(&self, index: usize) -> Option<TaskReport> {
        let (config, view) = (self.facts.config.tasks.get(index)?, self.tick.task_view(index));
        let row = &self.facts.blueprint.tasks.get(index)?.spec;
        Some(TaskReport {
            name: config.name.clone(),
            kind: config.kind.name.clone(),
            takes: row.takes.iter().map(|kind| kind.method().to_owned()).collect(),
            joints: config.joints.iter().map(|&j| self.facts.names.joint(j)).collect(),
            priority: config.priority,
            state: view.state.name().to_owned(),
            progress: (view.motion > 0).then_some(view.progress),
            reason: self.reason(&view.reason),
            motion: (view.motion > 0).then_some(view.motion),
            distance: view.distance,
            bound: Some(bound_text(view.bound, &self.facts.names)).filter(|text| !text.is_empty()),
            stream: self.streams.counts(index as u16),
        })
    }

    fn reason(&self, reason: &Reason) -> Option<String> {
        (*reason != Reason::None).then(|| reason_text(reason, &self.facts.names))
    }

    /// Returns the age of a state [ms].
    fn age_ms(&self, state: &ArmState) -> Option<f64> {
        (state.seq > 0).then(|| self.now().seconds_since(state.stamp) * 1e3)
    }

    /// Returns the reply to `state`.
    pub fn state(&self) -> StateReport {
        let mut poses = self.tcp_poses();
        let arms = self.facts.blueprint.arms.iter().enumerate().filter_map(|(i, arm)| {
            let view = self.tick.arm_view(i)?;
            let (s, known, gripper) = (&view.state, view.state.seq > 0, self.facts.gripper_info(i));
            let joints = arm.joints.iter().enumerate().map(|(j, name)| JointReport {
                name: name.clone(),
                position: s.position.get(j).copied().filter(|_| known && !s.missing.contains(j)),
                velocity: s
                    .velocity
                    .get(j)
                    .copied()
                    .filter(|_| s.velocity_source != VelocitySource::Absent && !s.missing.contains(j)),
                velocity_source: s.velocity_source.name().to_owned(),
                effort: s.effort.and_then(|e| e.get(j).copied()).filter(|_| !s.missing.contains(j)),
                command: view.command.mode.and_then(|_| view.command.values.get(j).copied()),
                commanded_effort: view.command.mode.and(view.command.effort).and_then(|e| e.get(j).copied()),
            });
            Some(ArmStateReport {
                hardware_id: arm.hardware_id.clone(),
                simulated: !arm.is_real(),
                age_ms: self.age_ms(s),
                speed_fraction: s.speed_fraction,
                effort_kind: Some(s.effort_kind.name().to_owned())
                    .filter(|kind| s.effort.is_some() && !kind.is_empty()),
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
        StateReport { tick: self.tick.last_tick(), stamp: self.wall_seconds(), arms: arms.collect() }
    }

    /// Returns the joint positions of an arm at a time [s since the Unix epoch].
    pub fn joints_at(&self, arm: &str, stamp: f64) -> Result<Vec<f64>, RpcError> {
        let index = self.facts.blueprint.arms.iter().position(|own| own.hardware_id == arm);
        let found = index.and_then(|index| Some((self.arms.get(index)?, self.facts.blueprint.arms.get(index)?)));
        let Some((device, own)) = found else {
            return Err(RpcError::new(Code::UnknownArm, format!("the run has no arm {arm:?}")));
        };
        let ago = self.wall_seconds() - stamp;
        let time = (0.0..60.0).contains(&ago).then(|| self.now().before(Duration::from_secs_f64(ago)));
        let joints = time.and_then(|time| device.joints_at(time)).ok_or_else(|| {
            RpcError::new(Code::InvalidParams, format!("{arm}: nothing is known of its joints at {stamp:.3} s"))
                .hint("the states of the last 2 s are known")
        })?;
        Ok(joints.into_iter().take(own.joints.len()).collect())
    }

    pub(in crate::runtime) fn wall_seconds(&self) -> f64 {
        self.facts.wall.wall(self.now()) as f64 * 1e-9
    }

    /// Returns the reply to `motion`.
    pub fn motion(&self, number: u64) -> Result<MotionReport, RpcError> {
        let Some((planned, end)) = self.motions.get(number) else {
            return Err(RpcError::new(Code::UnknownMotion, format!("no motion {number}, or too long ago")));
        };
        let task = if planned.task == NATIVE { "native".to_owned() } else { self.facts.names.task(planned.task) };
        let collision_checked = planned.plan.is_some();
        let retraces_to = planned.retraces_to;
        let by = planned.by.as_deref().cloned();
        let mut report =
            MotionReport { motion: number, task, by, collision_checked, retraces_to, ..Default::default() };
        let view = self.tick.task_view(planned.task as usize);
        if view.motion == number {
            (report.progress, report.elapsed, report.remaining) = (view.progress, view.elapsed, view.remaining);
        }
        if planned.task == NATIVE {
            report.elapsed = planned.duration;
        }
        let over = !matches!(view.state, TaskState::Executing | TaskState::Cancelling);
        let end = match end {
            Some(end) => Some(end),
            // The task has ended, but the recorder has not reported the end yet; if it fell behind, it never will. The
            // arm's present position is its end.
            None if view.motion == number && over => {
                let at = self.positions();
                let actual = planned.joints.iter().map(|j| at.get(*j as usize).copied().unwrap_or(f64::NAN)).collect();
                Some(End { state: view.state, reason: view.reason, actual, tick: self.tick.last_tick() })
            }
            None => None,
        };
        // The task counts the time on the path: less than has passed, if the motion was slowed or paused.
        if let Some(began) = planned.began {
            let ticks = end.as_ref().map_or_else(|| self.tick.last_tick(), |end| end.tick).saturating_sub(began);
            report.elapsed = report.elapsed.max(ticks as f64 * self.facts.period().as_secs_f64());
        }
        let Some(end) = end else {
            let speed = self.tick.speed_override();
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
        report.error = blocked.or_else(|| self.shut_down(&end.reason)).or_else(|| self.reason(&end.reason));
        match &planned.next {
            Some(Next::Planning) => (report.replanning, report.done) = (true, false),
            Some(Next::Motion(next)) => report.next = Some(*next),
            Some(Next::None(why)) => report.error = report.error.map(|error| format!("{error}; no way around: {why}")),
            None => {}
        }
        if end.state == TaskState::Completed && end.reason == Reason::None {
            (report.progress, report.remaining) = (1.0, 0.0);
        }
        let all = planned.joints.iter().zip(&planned.goal).zip(&end.actual);
        let deviation = all.map(|((joint, target), actual)| Deviation {
            joint: self.facts.names.joint(*joint),
            target: *target,
            actual: *actual,
        });
        report.deviation = Some(deviation.collect());
        Ok(report)
    }

    /// Returns why a motion was cancelled, if no client asked for that: the run is ending.
    fn shut_down(&self, reason: &Reason) -> Option<String> {
        let log_ended = self.journal.recorder.get().is_some_and(|stats| stats.failed.load(Relaxed));
        let why = if log_ended { "the log has ended, and with it the run" } else { "the run is shutting down" };
        (*reason == Reason::Cancelled && self.lifecycle.is_closed()).then(|| why.to_owned())
    }

    /// Returns the smallest fraction of the speed at which a controller of these joints runs motions, if below 1.
    fn slowest(&self, joints: &[u16]) -> Option<f64> {
        let of = |joint: &u16| Some(effective(self.tick.arm_view(self.facts.locate(*joint)?.0)?.state.speed_fraction));
        joints.iter().filter_map(of).min_by(f64::total_cmp).filter(|fraction| *fraction < 1.0)
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
