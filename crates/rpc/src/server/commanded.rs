//! The motions that a connection has begun, so that they can end with it: a commander on another computer may be lost
//! without having said so.

use std::collections::VecDeque;

use crate::api::{Backend, Cancel, Motion, Reply, Request};
use crate::server::lease::Lessee;

/// Motions kept; only the latest of each task can still be executing.
const MAX_KEPT: usize = 64;
/// Maximum number of motions that replanning chains to one.
const MAX_REPLANNED: usize = 256;

/// Motions and tasks begun by one connection, the oldest first.
#[derive(Debug, Default)]
pub(crate) struct Commanded(VecDeque<Begun>);

#[derive(Debug, PartialEq)]
enum Begun {
    /// A motion with a number, and what cancels it.
    Motion(u64, Cancel),
    /// A request `go`.
    Going(u64),
    /// A task that `start` started, and its arms.
    Task(String, Vec<String>),
}

impl Commanded {
    /// Notes what an accepted request began. `arms`: those whose leases it required.
    pub fn note(&mut self, request: &Request, reply: &Reply, arms: &[String]) {
        let of_task = |task: &str| Cancel { task: Some(task.to_owned()), ..Cancel::default() };
        let begun = match (request, reply) {
            (_, Reply::Move(reply)) => Begun::Motion(reply.motion, of_task(&reply.task)),
            (_, Reply::Execute(reply) | Reply::ExecutePlan(reply)) => Begun::Motion(reply.motion, of_task(&reply.task)),
            (Request::MoveNative(native), Reply::MoveNative(reply)) => {
                Begun::Motion(reply.motion, Cancel { arm: Some(native.arm.clone()), ..Cancel::default() })
            }
            (_, Reply::Go(reply)) => Begun::Going(reply.going),
            (Request::Start(start), _) => Begun::Task(start.task.clone(), arms.to_vec()),
            _ => return,
        };
        if self.0.len() == MAX_KEPT {
            self.0.pop_front();
        }
        self.0.push_back(begun);
    }

    /// Cancels what is still in motion. A motion that another client has begun since on the same task continues.
    pub async fn cancel(&mut self, lessee: &Lessee, backend: &dyn Backend) {
        for begun in self.0.drain(..) {
            let cancel = match begun {
                Begun::Motion(motion, cancel) if in_motion(motion, backend).await => cancel,
                // One that has ended is not cancelled.
                Begun::Going(going) => Cancel { going: Some(going), ..Cancel::default() },
                Begun::Task(task, arms) if lessee.holds_all(&arms) => Cancel { task: Some(task), ..Cancel::default() },
                _ => continue,
            };
            if let Err(error) = backend.call(Request::Cancel(cancel)).await {
                tracing::warn!("rpc: a motion whose commander is lost was not cancelled: {error}");
            }
        }
    }
}

/// Returns whether a motion, or the one that replaced it by replanning, has not ended.
async fn in_motion(motion: u64, backend: &dyn Backend) -> bool {
    let mut motion = motion;
    for _ in 0..MAX_REPLANNED {
        let Ok(Reply::Motion(report)) = backend.call(Request::Motion(Motion { motion })).await else { return false };
        match report.next {
            Some(next) => motion = next,
            None => return !report.done,
        }
    }
    false
}
