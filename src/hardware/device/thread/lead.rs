//! Leading an arm: its controller is asked to give way to a hand, or to move to a pose. A change of mode takes several
//! cycles, in which the state is read as usual.

use std::sync::mpsc::SyncSender;
use std::time::Duration;

use super::Worker;
use crate::arm::Pose;
use crate::clock::Mono;
use crate::hardware::adapter::{AdapterError, AdapterResult, ManipulatorAdapter};
use crate::joint::ControlMode;

/// How long the controller may take to begin.
const TIMEOUT: Duration = Duration::from_secs(6);

/// How an arm is led.
#[derive(Debug, Clone, Copy)]
pub(super) enum Way {
    /// By hand.
    Hand,
    /// By its controller, to this pose at this fraction of the top speed.
    To(Pose, f64),
}

/// Whether the arm is led, or about to be.
#[derive(Default)]
pub(super) struct Lead {
    /// The order that is not carried out yet, where its answer goes, and when it is too late.
    pending: Option<(Way, SyncSender<AdapterResult<()>>, Mono)>,
    /// The controller has begun, and was neither stopped nor activated since.
    pub active: bool,
}

impl Lead {
    /// Takes an order.
    pub fn order(&mut self, way: Way, reply: SyncSender<AdapterResult<()>>, now: Mono) {
        self.end("another order came");
        self.pending = Some((way, reply, now.after(TIMEOUT)));
    }

    /// The arm is no longer led; an order that is not carried out yet is refused with the reason `why`.
    pub fn end(&mut self, why: &str) {
        self.active = false;
        if let Some((_, reply, _)) = self.pending.take() {
            let _ = reply.send(Err(AdapterError::Rejected(why.to_owned())));
        }
    }
}

impl Worker {
    /// Carries out a pending order, as far as the controller is ready for it.
    pub(super) fn begin_to_lead(&mut self, adapter: &mut dyn ManipulatorAdapter) {
        let Some((way, reply, until)) = self.lead.pending.take() else { return };
        // The mode changes by order now.
        self.expect_nothing(self.ordered_power);
        let mode = match way {
            _ if !self.connected => Err(AdapterError::NotConnected),
            Way::Hand => adapter.hand_guiding().map_or(Err(AdapterError::Unsupported), |arm| arm.begin_hand_guiding()),
            Way::To(..) if adapter.cartesian().is_none() => Err(AdapterError::Unsupported),
            Way::To(..) => adapter.set_control_mode(ControlMode::Position),
        };
        if matches!(mode, Err(AdapterError::Rejected(_))) && self.config.clock.now() < until {
            self.lead.pending = Some((way, reply, until));
            return;
        }
        let result = match (way, adapter.cartesian()) {
            (Way::To(pose, speed), Some(arm)) => mode.and_then(|()| arm.write_cartesian_position(&pose, speed)),
            _ => mode,
        };
        match result {
            Err(ref error) if !matches!(error, AdapterError::Unsupported) => self.after_error(adapter, error),
            _ => {}
        }
        self.lead.active = result.is_ok();
        let _ = reply.send(result);
    }
}
