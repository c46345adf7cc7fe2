//! Events of a run: what the recorder notices and what is published to subscribers.

use std::sync::atomic::Ordering::Relaxed;
use std::time::Instant;

use crate::runtime::{Ending, Service};
use dimos_core::arm::VelocitySource;
use dimos_core::clock::WallOffset;
use dimos_core::sync::lock;
use dimos_core::telemetry::Event;
use dimos_core::telemetry::describe::{Described, Severity};
use dimos_log::recorder::Notice;
use dimos_rpc::server::streams::{EventReport, JointState, Level};

impl Service {
    /// Handles a notice of the recorder, on the recorder's thread.
    pub fn notice(&self, notice: Notice<'_>, wall: WallOffset) {
        match notice {
            Notice::Event { tick, event, described } => {
                lock(&self.journal.counts).event(event);
                if let Event::Task(task, state, reason) = event {
                    let actual = self.positions();
                    self.motions.task_changed(*task, (tick, *state, *reason), &actual);
                }
                self.report_event(tick, described, wall);
            }
            Notice::Lost(count) => tracing::warn!("the recorder fell behind: {count} samples are missing in the log"),
            Notice::Unsynced(after) => tracing::warn!(
                "the log is closed, but its disk has not stored all of it after {} s; keep the power on",
                after.as_secs()
            ),
            Notice::Fault(Ok(path)) => {
                tracing::warn!("the time before and after the fault is in the log {}", path.display());
                self.journal.add_fault_log(path.to_owned());
            }
            Notice::Fault(Err(error)) => tracing::warn!("there is no log of the fault: {error}"),
            Notice::Stopped(error) => {
                tracing::error!("{error}");
                let first = error.to_string().lines().next().unwrap_or_default().to_owned();
                self.lifecycle.end(Ending::Log(first));
            }
        }
    }

    /// Publishes the joint state of the last tick, unless that was done already: to subscribers, and now and then for
    /// later ones.
    pub fn publish(&self, ticked: bool) {
        let (streams, now) = (&self.journal.subscribers, self.now());
        let published = self.facts.blueprint.coordinator.publish_joint_state;
        let listened_to = published && streams.has_joint_state_readers();
        self.tick.pulse().streaming.store(listened_to, Relaxed);
        // The tick also wakes this thread for replies; a late wake-up publishes the newest tick.
        let ticks = self.tick.pulse().ticks.load(Relaxed);
        let wanted = (listened_to && ticked) || (published && streams.is_state_due(now));
        if wanted && ticks > 0 && self.journal.published.swap(ticks, Relaxed) != ticks {
            streams.publish_joint_state(now, &self.joint_state());
        }
    }

    fn joint_state(&self) -> JointState {
        let mut out = JointState {
            tick: self.tick.last_tick(),
            stamp: self.wall_seconds(),
            frame_id: self.facts.blueprint.coordinator.joint_state_frame_id.clone(),
            ..JointState::default()
        };
        for (i, arm) in self.facts.blueprint.arms.iter().enumerate() {
            let Some(view) = self.tick.arm_view(i) else { continue };
            let s = &view.state;
            let velocities = s.velocity_source != VelocitySource::Absent;
            for (j, name) in arm.joints.iter().enumerate() {
                out.name.push(name.clone());
                let there = !s.missing.contains(j);
                out.position.push(s.position.get(j).copied().filter(|_| s.seq > 0 && there));
                out.velocity.push(s.velocity.get(j).copied().filter(|_| velocities && there));
                out.effort.push(s.effort.and_then(|e| e.get(j).copied()).filter(|_| there));
            }
        }
        out
    }

    /// Records an event that no tick has made, and reports it.
    pub(in crate::runtime) fn report_now(&self, described: &Described, wall: WallOffset) {
        self.tick.dispatcher().log(described.severity, described.text.clone());
        self.report_event(self.tick.pulse().ticks.load(Relaxed), described, wall);
    }

    /// Logs an event and publishes it to subscribers.
    pub(in crate::runtime) fn report_event(&self, tick: u64, described: &Described, wall: WallOffset) {
        if let Some(line) = self.journal.throttle.line(described, Instant::now()) {
            match described.severity {
                Severity::Info => tracing::debug!("{line}"),
                Severity::Warn => tracing::warn!("{line}"),
                Severity::Error => tracing::error!("{line}"),
            }
        }
        self.journal.subscribers.publish_event(&EventReport {
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
