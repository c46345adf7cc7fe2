//! What comes and goes at the controller's ports: requests and responses, reports, and what faults leave of them.

use std::time::Duration;

use super::controlled_arm::ControlledArm;
use super::controller::{Controller, Received, state};
use super::kinematics::to_wire;
use super::modbus;
use super::report::{Kind, Snapshot};
use super::wire::{self, Request};
use super::{SECOND, Withhold};
use dimos_core::clock::Mono;
use dimos_hardware::sim::arm::Delivery;
use dimos_hardware::sim::faults::FaultKind;
use dimos_hardware::sim::stream;
use dimos_hardware::transport::Scan;

/// What noise looks like: among it the beginning of a header.
const NOISE: &[u8] = b"\x00\xffnoise\x00\x02\x00\x00\x00\x00";

impl<A: ControlledArm> Controller<A> {
    /// What reports show now.
    pub fn snapshot(&mut self, now: Mono) -> Snapshot {
        self.advance(now);
        let (wrench, wrench_raw) = self.wrench();
        let (positions, velocities) = self.reported();
        self.counter = self.counter.wrapping_add(1);
        let scale = if self.settings.currents { 0.1 } else { 1.0 };
        let mut snapshot = Snapshot {
            time_us: self.arm.uptime().as_micros() as u64,
            state: self.reported_state(),
            mode: self.mode,
            queued: (self.queue.len() + usize::from(self.current.is_some() && self.arm.moving())) as u16,
            position: positions.map(|v| v as f32),
            velocity: velocities.map(|v| v as f32),
            torque: self.torques().map(|v| v * scale),
            pose: self.pose().as_ref().map_or([f32::NAN; 6], to_wire),
            enabled: self.motors(),
            error: self.error(),
            warning: self.warning,
            axes: self.identity.axes as u8,
            kind: self.identity.kind as u8,
            firmware: self.firmware,
            base: self.settings.base,
            offset: self.settings.offset,
            load: self.settings.load,
            sensitivity: self.settings.sensitivity,
            motion: self.settings.motion,
            reduced: self.settings.reduced,
            wrench,
            wrench_raw,
            counter: self.counter,
        };
        if self.arm.due_fault(FaultKind::Nan).is_some() {
            snapshot.position = [f32::NAN; 7];
        } else if self.arm.due_fault(FaultKind::ZeroState).is_some() {
            // A controller that has not measured yet has no pose either.
            (snapshot.position, snapshot.velocity, snapshot.pose) = ([0.0; 7], [0.0; 7], [0.0; 6]);
        }
        snapshot
    }

    /// Does what a request asks and writes the response into `out`; what becomes of it on its way.
    pub fn handle(&mut self, request: &Request<'_>, second: bool, now: Mono, out: &mut Vec<u8>) -> Delivery {
        self.advance(now);
        self.arm.client_came();
        let Some(status) = self.respond(request, out) else { return Delivery::Pending };
        let Request { protocol, register, payload, .. } = *request;
        self.trace.push(|| Received { at: now, protocol, register, payload: payload.to_vec(), status, second });
        match (self.delivery(), self.reply_time(register)) {
            (Delivery::Send, time) if !time.is_zero() => Delivery::Late(time),
            (delivery, _) => delivery,
        }
    }

    /// How long the reply to a register takes.
    fn reply_time(&self, register: u8) -> Duration {
        let slow = self.slow.iter().find(|slow| slow.register == register);
        slow.map_or(Duration::ZERO, |slow| Duration::from_secs_f64(slow.delay))
    }

    /// Faults of the wire that also strike at the slow reports.
    fn lasting(&self) -> Delivery {
        match (self.arm.lasts(FaultKind::Silent), self.arm.lasts(FaultKind::Frozen)) {
            (true, _) => Delivery::Silent,
            (_, true) => Delivery::Frozen,
            _ => Delivery::Send,
        }
    }

    /// Faults of the wire, for the next response or report.
    fn delivery(&mut self) -> Delivery {
        let delivery = self.arm.next_delivery();
        match delivery {
            Delivery::PowerLoss(_) => {
                self.halt(state::STOPPED);
                (self.mode, self.warning, self.settings) = (0, 0, self.saved);
            }
            Delivery::Send if self.arm.due_fault(FaultKind::Frozen).is_some() => return Delivery::Frozen,
            _ => {}
        }
        delivery
    }
}

impl<A: ControlledArm> stream::Controller for Controller<A> {
    fn serve(&mut self, bytes: &[u8], now: Mono, answer: &mut Vec<u8>) -> Scan<Delivery> {
        self.serve_port(0, bytes, now, answer)
    }

    fn serve_port(&mut self, port: usize, bytes: &[u8], now: Mono, answer: &mut Vec<u8>) -> Scan<Delivery> {
        match wire::scan(bytes) {
            None => Scan::Take(bytes.len(), Delivery::HangUp),
            Some(Scan::More) => Scan::More,
            Some(Scan::Skip(n)) => Scan::Skip(n),
            Some(Scan::Take(n, ())) if bytes.get(..n).is_some_and(|frame| modbus::refuse(frame, answer)) => {
                Scan::Take(n, Delivery::Send)
            }
            Some(Scan::Take(n, ())) => match bytes.get(..n).and_then(wire::parts) {
                Some(request) => Scan::Take(n, self.handle(&request, port == SECOND, now, answer)),
                None => Scan::Skip(n),
            },
        }
    }

    /// A planned move continues.
    fn client_gone(&mut self, _now: Mono) {
        self.arm.client_gone();
    }

    fn damage(&self, delivery: Delivery, packet: &mut Vec<u8>) {
        // The highest byte of the first measured joint in a full report; the state byte of a response.
        let spot = if packet.len() > 119 { 119 } else { packet.len().saturating_sub(1) };
        delivery.damage(packet, NOISE, spot);
    }

    fn report(&mut self, port: usize, now: Mono, packet: &mut Vec<u8>) -> Option<Delivery> {
        let kind = *Kind::ALL.get(port)?;
        match (kind, self.withhold) {
            (Kind::Normal | Kind::Rich, _) if self.condition_muted => return Some(Delivery::Silent),
            // Older firmware has no such report.
            (Kind::Full, Withhold::Close) => return None,
            (Kind::Full, _) if self.firmware < [2, 1, 0] => return None,
            (Kind::Full, Withhold::Silence) => return Some(Delivery::Silent),
            _ => {}
        }
        let mut snapshot = self.snapshot(now);
        // Older firmware reports there what it commands, not what the joints do.
        if kind == Kind::Real
            && self.firmware < [2, 4, 0]
            && let Some(setpoint) = self.judge.last_setpoint()
        {
            snapshot.position = setpoint.map(|v| v as f32);
        }
        kind.write(&snapshot, packet);
        // Faults of reports affect the ports with joint positions.
        Some(if matches!(kind, Kind::Full | Kind::Real) { self.delivery() } else { self.lasting() })
    }
}
