//! What comes and goes at the ports.

use super::SERVICES;
use super::controller::{Controller, Session};
use super::dashboard::GREETING;
use super::rtde::Rtde;
use crate::ur::address::Service;
use dimos_core::clock::Mono;
use dimos_hardware::sim::arm::Delivery;
use dimos_hardware::sim::stream;
use dimos_hardware::transport::Scan;

/// What noise looks like: among it the beginning of a packet.
const NOISE: &[u8] = b"\x00\x05U\x00\xffnoise\x02\x30U";
/// The byte of a state that is damaged: the highest one of the first joint's position.
const SPOT: usize = 12;
/// Every how many looks for messages the primary interface's state is sent: 10 times a second.
const STATE_EVERY: u64 = 10;

fn service(port: usize) -> Service {
    SERVICES.get(port).copied().unwrap_or(Service::Dashboard)
}

impl stream::Controller for Controller {
    fn serve(&mut self, _bytes: &[u8], _now: Mono, _answer: &mut Vec<u8>) -> Scan<Delivery> {
        Scan::Skip(usize::MAX)
    }

    fn serve_client(
        &mut self,
        port: usize,
        client: u64,
        bytes: &[u8],
        now: Mono,
        answer: &mut Vec<u8>,
    ) -> Scan<Delivery> {
        self.advance_to(now);
        let (who, service) = ((port, client), service(port));
        if service == Service::Rtde {
            return self.rtde_request(who, bytes, answer);
        }
        if service == Service::Tool {
            if let Some(rate) = self.tool_rate {
                self.tool.exchange(rate, bytes, answer);
            }
            return Scan::Take(bytes.len(), Delivery::Send);
        }
        if service == Service::Dashboard && self.is_polyscope_x() {
            // A connection for each request.
            return self.robot_api(bytes, answer).map(|()| Delivery::HangUp);
        }
        let Some(end) = bytes.iter().position(|byte| *byte == b'\n') else { return Scan::More };
        let line = String::from_utf8_lossy(bytes.get(..end).unwrap_or_default());
        if service != Service::Dashboard {
            self.script_line(who, &line);
            return Scan::Take(end + 1, Delivery::Send);
        }
        if self.breaks_dashboard {
            return Scan::Take(end + 1, Delivery::HangUp);
        }
        let reply = self.dashboard(line.trim());
        if self.late_answer.take_if(|late| *late == line.trim()).is_some() {
            self.sessions.entry(who).and_modify(|session| session.text = format!("{reply}\n"));
            return Scan::Take(end + 1, Delivery::Silent);
        }
        let late = self.sessions.get_mut(&who).map(|session| std::mem::take(&mut session.text)).unwrap_or_default();
        answer.extend(late.as_bytes());
        answer.extend(reply.as_bytes());
        answer.push(b'\n');
        Scan::Take(end + 1, if reply == "Disconnected" { Delivery::HangUp } else { self.lasting() })
    }

    /// The controller and its program continue.
    fn client_gone(&mut self, _now: Mono) {}

    fn damage(&self, delivery: Delivery, packet: &mut Vec<u8>) {
        delivery.damage(packet, NOISE, SPOT.min(packet.len().saturating_sub(1)));
    }

    fn session_began(&mut self, port: usize, client: u64, now: Mono, greeting: &mut Vec<u8>) {
        let next_message = self.next_message();
        let read_only = !self.remote && !self.model.is_cb3();
        let (text, rtde) = (String::new(), Rtde::default());
        let session = Session { text, read_only, closing: false, next_message, reports: 0, rtde };
        self.sessions.insert((port, client), session);
        match service(port) {
            Service::Rtde => self.arm.client_came(),
            Service::Dashboard if self.lasting() == Delivery::Send && !self.is_polyscope_x() => {
                greeting.extend(GREETING)
            }
            Service::Primary | Service::Secondary if self.lasting() == Delivery::Send => {
                greeting.extend(self.introduction());
            }
            _ => {}
        }
        self.advance_to(now);
    }

    fn session_report(&mut self, port: usize, client: u64, now: Mono, packet: &mut Vec<u8>) -> Option<Delivery> {
        self.advance_to(now);
        let (who, service) = ((port, client), service(port));
        match service {
            Service::Rtde => return self.rtde_report(who, packet),
            Service::Dashboard | Service::Tool => return Some(Delivery::Send),
            _ => {}
        }
        let session = self.sessions.get_mut(&who).filter(|session| !session.closing)?;
        let first = session.next_message;
        session.reports += 1;
        let state_is_due = session.reports % STATE_EVERY == 1;
        let next = self.next_message();
        if service == Service::Primary {
            self.messages_from(first).for_each(|message| packet.extend(message));
        }
        if state_is_due && service != Service::RealTime {
            self.primary_state(packet);
        }
        self.sessions.get_mut(&who)?.next_message = next;
        Some(if packet.is_empty() { Delivery::Send } else { self.lasting() })
    }

    fn session_ended(&mut self, port: usize, client: u64, _now: Mono) {
        self.sessions.remove(&(port, client));
    }
}
