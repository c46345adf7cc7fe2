//! Stops that could not be sent because an arm was not connected: when the device thread delivers one later, the log
//! and the subscribers are notified.

use std::collections::BTreeMap;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};

use crate::runtime::Service;
use dimos_core::clock::WallOffset;
use dimos_core::sync::lock;
use dimos_core::telemetry::Phase;
use dimos_core::telemetry::describe::{Described, Severity};
use dimos_rpc::api::Confirmation;

/// The stops of a run that were not sent.
#[derive(Debug, Default)]
pub(in crate::runtime) struct LateStops {
    /// Whether there are any; checked after every tick.
    any: AtomicBool,
    /// By arm: the number of the last sent stop.
    sent_before: Mutex<BTreeMap<usize, u32>>,
}

impl LateStops {
    fn add(&self, arm: usize, sent: u32) {
        lock(&self.sent_before).insert(arm, sent);
        self.any.store(true, Ordering::Release);
    }

    /// Returns whether an arm's stop still waits for the connection.
    pub fn is_waiting(&self, arm: usize) -> bool {
        self.any.load(Ordering::Acquire) && lock(&self.sent_before).contains_key(&arm)
    }
}

impl Service {
    /// Records that an operator was informed of an arm's undelivered stop.
    pub(in crate::runtime) fn stop_not_sent(&self, arm: usize) {
        if let Some(device) = self.arms.devices.get(arm) {
            self.arms.late_stops.add(arm, device.health().stop_sent.load(Ordering::Acquire));
        }
    }

    /// Reports the stops that were delivered since the last call.
    pub fn report_late_stops(&self, wall: WallOffset) {
        if !self.arms.late_stops.any.load(Ordering::Acquire) {
            return;
        }
        let mut waiting = lock(&self.arms.late_stops.sent_before);
        waiting.retain(|&arm, before| {
            let Some(device) = self.arms.devices.get(arm) else { return false };
            let sent = device.health().stop_sent.load(Ordering::Acquire);
            if sent != *before {
                let confirmed = device.health().stop_confirmed.load(Ordering::Relaxed) == sent;
                self.report_late_stop(arm, confirmed, wall);
            }
            // An arm that was reset must not be stopped later.
            sent == *before && self.tick.phase(arm) == Phase::Held
        });
        self.arms.late_stops.any.store(!waiting.is_empty(), Ordering::Release);
    }

    fn report_late_stop(&self, arm: usize, confirmed: bool, wall: WallOffset) {
        let arm = self.facts.names.arm(arm as u16);
        let how = if confirmed { Confirmation::Confirmed } else { Confirmation::SentNotConfirmed };
        let described = Described {
            kind: "stop",
            severity: Severity::Warn,
            status: "delivered",
            text: format!("the stop of {arm} was delivered after the reconnect: {}", how.text()),
            arm: Some(arm),
            request: None,
            task: None,
            joint: None,
            values: Vec::new(),
            by: None,
        };
        self.report_now(&described, wall);
    }
}
