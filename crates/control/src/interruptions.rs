//! What was stopped stays stopped. Every stop, hold, disable, loss and change of the lease interrupts an arm and begins
//! a new epoch. A request that moves the arm has the epoch in which its client sent it, and the tick that would start
//! the motion compares: it may be much later, because a planner was slow or a chunk waits for its start.

use dimos_core::telemetry::{Interruption, Origin};

/// Interruptions remembered per arm. What was requested before the oldest of them is superseded.
const REMEMBERED: usize = 8;

/// The latest interruptions of an arm, each with its epoch, in order.
#[derive(Debug, Clone, Copy, Default)]
pub struct Interruptions {
    latest: [Option<(u64, Interruption)>; REMEMBERED],
    /// The epoch of the newest one that is no longer remembered.
    forgotten: u64,
}

impl Interruptions {
    /// Adds one that begins an epoch.
    pub fn add(&mut self, epoch: u64, interruption: Interruption) {
        self.latest.rotate_left(1);
        if let Some(last) = self.latest.last_mut()
            && let Some((forgotten, _)) = last.replace((epoch, interruption))
        {
            self.forgotten = forgotten;
        }
    }

    /// Returns the first one that concerns a request of this origin.
    pub fn since(&self, origin: Origin) -> Option<Interruption> {
        let lost = origin.epoch < self.forgotten;
        let concerns = |interruption| match interruption {
            Interruption::LeaseTaken(client) => client != origin.client,
            Interruption::LeaseEnded(client) => client == origin.client,
            _ => true,
        };
        let mut known = self.latest.iter().flatten();
        known.find(|(epoch, what)| lost || (*epoch > origin.epoch && concerns(*what))).map(|(_, what)| *what)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_interruption_after_a_request_is_named() {
        let mut arm = Interruptions::default();
        let since = |arm: &Interruptions, epoch, client| arm.since(Origin { epoch, client });
        assert_eq!(since(&arm, 0, 1), None);
        arm.add(3, Interruption::Stopped);
        arm.add(5, Interruption::Disabled);
        assert_eq!(since(&arm, 2, 1), Some(Interruption::Stopped));
        assert_eq!(since(&arm, 3, 1), Some(Interruption::Disabled));
        assert_eq!(since(&arm, 5, 1), None);
    }

    #[test]
    fn a_lease_concerns_the_requests_of_others_until_it_ends() {
        let mut arm = Interruptions::default();
        arm.add(1, Interruption::LeaseTaken(7));
        assert_eq!(arm.since(Origin { epoch: 0, client: 7 }), None, "its own request took it");
        assert_eq!(arm.since(Origin { epoch: 0, client: 8 }), Some(Interruption::LeaseTaken(7)));
        arm.add(2, Interruption::LeaseEnded(7));
        assert_eq!(arm.since(Origin { epoch: 1, client: 7 }), Some(Interruption::LeaseEnded(7)));
        assert_eq!(arm.since(Origin { epoch: 1, client: 8 }), None, "it was requested under no other lease");
    }

    #[test]
    fn what_was_requested_before_all_that_is_remembered_is_superseded() {
        let mut arm = Interruptions::default();
        (1..=20).for_each(|epoch| arm.add(epoch, Interruption::LeaseTaken(7)));
        assert!(arm.since(Origin { epoch: 11, client: 7 }).is_some());
        assert_eq!(arm.since(Origin { epoch: 12, client: 7 }), None);
    }
}
