//! What comes and goes at the TCP ports: 0 the arm's, 1 the hand's. Answers are sent with the next look for them,
//! because some come long after their commands.

use std::net::IpAddr;

use super::control::{Control, Who};
use dimos_core::clock::Mono;
use dimos_hardware::sim::arm::Delivery;
use dimos_hardware::sim::stream;
use dimos_hardware::transport::Scan;

impl stream::Controller for Control {
    fn serve(&mut self, _bytes: &[u8], _now: Mono, _answer: &mut Vec<u8>) -> Scan<Delivery> {
        Scan::Skip(usize::MAX)
    }

    fn serve_client(
        &mut self,
        port: usize,
        client: u64,
        bytes: &[u8],
        _now: Mono,
        answer: &mut Vec<u8>,
    ) -> Scan<Delivery> {
        let who = (port, client);
        let scan = match port {
            0 => self.request(who, bytes),
            _ => self.hand.request(who, self.address_of(who), bytes, &mut self.answers),
        };
        if matches!(scan, Scan::Take(_, Delivery::Send | Delivery::HangUp)) {
            self.collect(who, answer);
        }
        scan
    }

    fn client_gone(&mut self, _now: Mono) {}

    fn session_from(&mut self, port: usize, client: u64, address: IpAddr) {
        self.clients_at.push(((port, client), address));
    }

    fn session_began(&mut self, port: usize, _client: u64, _now: Mono, _greeting: &mut Vec<u8>) {
        if port == 0 {
            self.arm.client_came();
        }
    }

    fn session_report(&mut self, port: usize, client: u64, _now: Mono, packet: &mut Vec<u8>) -> Option<Delivery> {
        if let Some(cut) = self.cut.take() {
            return Some(cut);
        }
        self.collect((port, client), packet);
        Some(Delivery::Send)
    }

    fn session_ended(&mut self, port: usize, client: u64, _now: Mono) {
        let who = (port, client);
        if self.client.is_some_and(|(owner, _)| owner == who) {
            self.leave();
        }
        self.hand.leave(who);
        self.clients_at.retain(|(of, _)| *of != who);
        self.answers.retain(|(to, _)| *to != who);
    }
}

impl Control {
    /// Returns from where a client has connected: its datagrams go there.
    pub(super) fn address_of(&self, who: Who) -> IpAddr {
        let found = self.clients_at.iter().find(|(of, _)| *of == who);
        found.map_or(IpAddr::from([127, 0, 0, 1]), |(_, address)| *address)
    }

    /// Moves the answers for a connection to `packet`.
    fn collect(&mut self, who: Who, packet: &mut Vec<u8>) {
        self.answers.retain(|(to, bytes)| {
            if *to == who {
                packet.extend(bytes);
            }
            *to != who
        });
    }
}
