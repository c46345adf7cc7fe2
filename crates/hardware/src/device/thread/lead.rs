//! Leading an arm: its controller is asked to give way to a hand, or to move to a pose. A change of mode takes several
//! cycles, in which the state is read as usual.

use std::sync::mpsc::SyncSender;
use std::time::Duration;

use super::Worker;
use crate::adapter::{AdapterError, AdapterResult, ManipulatorAdapter};
use dimos_core::arm::Pose;
use dimos_core::clock::Mono;
use dimos_core::joint::ControlMode;

/// How long the controller may take to begin.
const TIMEOUT: Duration = Duration::from_secs(6);

/// How an arm is led.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Way {
    /// By hand.
    Hand,
    /// By its controller, to this pose at this fraction of the top speed.
    To(Pose, f64),
}

/// An order that is not carried out yet.
struct Pending {
    way: Way,
    /// [`ArmCommand::lead_seq`](dimos_core::arm::ArmCommand) of the lead that it belongs to.
    lead_seq: u32,
    reply: SyncSender<AdapterResult<()>>,
    /// When it is too late.
    until: Mono,
}

/// Whether the arm is led, or about to be.
#[derive(Default)]
pub(super) struct Lead {
    pending: Option<Pending>,
    /// The controller has begun, and was neither stopped nor activated since.
    pub active: bool,
}

impl Lead {
    /// Takes an order.
    pub fn order(&mut self, way: Way, lead_seq: u32, reply: SyncSender<AdapterResult<()>>, now: Mono) {
        self.end("another order came");
        self.pending = Some(Pending { way, lead_seq, reply, until: now.after(TIMEOUT) });
    }

    /// The arm is no longer led; an order that is not carried out yet is refused with the reason `why`.
    pub fn end(&mut self, why: &str) {
        self.active = false;
        if let Some(pending) = self.pending.take() {
            let _ = pending.reply.send(Err(AdapterError::Rejected(why.to_owned())));
        }
    }
}

impl Worker {
    /// Carries out a pending order, as far as the controller is ready for it. Only while the tick says that the arm is
    /// led, by the lead that the order belongs to: a stop in between has ended that.
    pub(super) fn begin_to_lead(&mut self, adapter: &mut dyn ManipulatorAdapter) {
        let Some(pending) = self.lead.pending.take() else { return };
        let (now, ahead) = (self.config.clock.now(), pending.lead_seq.wrapping_sub(self.last.lead_seq));
        let ended = (ahead == 0 && !self.last.led) || ahead > u32::MAX / 2;
        if ended || self.stop_pending || self.state.self_held {
            let _ = pending.reply.send(Err(AdapterError::Rejected("the arm was stopped".to_owned())));
            return;
        }
        if ahead > 0 && now < pending.until {
            self.lead.pending = Some(pending);
            return;
        }
        let Pending { way, reply, .. } = &pending;
        let mode = match way {
            _ if ahead > 0 => Err(AdapterError::Timeout("the tick did not pass the arm on".to_owned())),
            Way::Hand => adapter.hand_guiding().map_or(Err(AdapterError::Unsupported), |arm| arm.begin_hand_guiding()),
            Way::To(..) if adapter.cartesian().is_none() => Err(AdapterError::Unsupported),
            Way::To(..) => adapter.set_control_mode(ControlMode::Position),
        };
        if matches!(mode, Err(AdapterError::Rejected(_))) && now < pending.until {
            // The mode changes by order now.
            self.ordered_mode = None;
            self.lead.pending = Some(pending);
            return;
        }
        let result = match (way, adapter.cartesian()) {
            (Way::To(pose, speed), Some(arm)) => mode.and_then(|()| arm.write_cartesian_position(pose, *speed)),
            _ => mode,
        };
        if let Err(error) = &result {
            self.after_error(adapter, error);
        }
        self.lead.active = result.is_ok();
        // Another one than that is another client's.
        self.ordered_mode = result.is_ok().then(|| adapter.get_control_mode());
        let _ = reply.send(result);
    }
}
