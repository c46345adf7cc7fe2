//! Assigns joints to tasks: the higher priority wins, at equal priority the first in the blueprint; one mode per arm. A
//! losing task is notified once per winner, and again only after that winner has released the joint.

use super::request::Motion;
use super::task::Task;
use super::task_body::{Claim, Demand};
use dimos_core::telemetry::Event;

/// Result of the arbitration.
#[derive(Debug)]
pub struct Arbiter {
    /// Tasks from the highest to the lowest priority.
    order: Vec<u16>,
    /// The arm of each joint.
    arm_of: Vec<u16>,
    /// By joint: the winner and its value.
    winners: Vec<Option<(u16, f64)>>,
    /// By joint: the winner of the previous tick.
    before: Vec<Option<u16>>,
    /// By arm: what its joints are commanded, and the task that determined it.
    demands: Vec<(Demand, u16)>,
    /// By loser and winner: whether the loser was notified.
    notified: Vec<bool>,
}

impl Arbiter {
    /// Creates the arbiter of tasks with these priorities and joints of these arms.
    pub fn new(priorities: &[i32], arm_of: Vec<u16>, arms: usize) -> Self {
        let mut order: Vec<u16> = (0..priorities.len() as u16).collect();
        order.sort_by_key(|&t| std::cmp::Reverse(priorities.get(t as usize).copied().unwrap_or(i32::MIN)));
        Self {
            order,
            winners: vec![None; arm_of.len()],
            before: vec![None; arm_of.len()],
            arm_of,
            demands: vec![(Demand::Nothing, 0); arms],
            notified: vec![false; priorities.len() * priorities.len()],
        }
    }

    /// Returns the winner of a joint and its value.
    pub fn winner(&self, joint: usize) -> Option<(u16, f64)> {
        self.winners.get(joint).copied().flatten()
    }

    /// Returns whether the winner of a joint changed in this tick.
    pub fn winner_changed(&self, joint: usize) -> bool {
        self.before.get(joint).copied().flatten() != self.winner(joint).map(|(task, _)| task)
    }

    /// Returns what the joints of an arm are commanded.
    pub fn demand(&self, arm: usize) -> Demand {
        self.demands.get(arm).map_or(Demand::Nothing, |(demand, _)| *demand)
    }

    /// Decides all claims. `report` gets the events, `retire` the motions that ended.
    pub fn decide(&mut self, tasks: &mut [Task], mut report: impl FnMut(Event), mut retire: impl FnMut(Box<Motion>)) {
        for (before, winner) in self.before.iter_mut().zip(&mut self.winners) {
            *before = winner.take().map(|(task, _)| task);
        }
        self.demands.fill((Demand::Nothing, 0));
        self.forget_idle_winners(tasks);
        for rank in 0..self.order.len() {
            let Some(&loser) = self.order.get(rank) else { continue };
            while let Some((winner, joint, conflict)) = self.lost(loser, tasks) {
                let priority = |t: u16| tasks.get(t as usize).map_or(0, |t| t.priority);
                let equal = priority(winner) == priority(loser);
                if self.notify_once(loser, winner, tasks.len()) {
                    report(match conflict {
                        true => Event::ModeConflict(loser, winner, self.arm(joint)),
                        false => Event::Preempted(loser, winner, joint, equal),
                    });
                }
                let Some(task) = tasks.get_mut(loser as usize) else { break };
                let (state, reason) = (task.state, task.reason);
                task.lose(winner, joint).map(&mut retire);
                if (task.state, task.reason) != (state, reason) {
                    report(Event::Task(loser, task.state, task.reason));
                }
            }
            self.grant(loser, tasks);
        }
    }

    /// Returns the first claim that a task loses: the winner, the joint, and whether their modes conflict.
    fn lost(&self, task: u16, tasks: &[Task]) -> Option<(u16, u16, bool)> {
        let t = tasks.get(task as usize)?;
        t.claims.iter().find_map(|claim| {
            if let Some((winner, _)) = self.winner(claim.joint as usize) {
                return Some((winner, claim.joint, self.demand(self.arm(claim.joint) as usize) != t.demand));
            }
            let &(demand, by) = self.demands.get(self.arm(claim.joint) as usize)?;
            (demand != Demand::Nothing && demand != t.demand).then_some((by, claim.joint, true))
        })
    }

    /// Makes a task the winner of all joints that it claims.
    fn grant(&mut self, task: u16, tasks: &[Task]) {
        let Some(t) = tasks.get(task as usize) else { return };
        for &Claim { joint, value } in &t.claims {
            let arm = self.arm(joint) as usize;
            if let (Some(winner), Some(demand)) = (self.winners.get_mut(joint as usize), self.demands.get_mut(arm)) {
                *winner = Some((task, value));
                if demand.0 == Demand::Nothing {
                    *demand = (t.demand, task);
                }
            }
        }
    }

    fn arm(&self, joint: u16) -> u16 {
        self.arm_of.get(joint as usize).copied().unwrap_or(u16::MAX)
    }

    /// Returns whether a loser is to be notified of this winner.
    fn notify_once(&mut self, loser: u16, winner: u16, tasks: usize) -> bool {
        match self.notified.get_mut(loser as usize * tasks + winner as usize) {
            Some(notified) => !std::mem::replace(notified, true),
            None => false,
        }
    }

    /// Tasks that lost to a winner which claims nothing any longer are notified again the next time.
    fn forget_idle_winners(&mut self, tasks: &[Task]) {
        let n = tasks.len();
        for (winner, _) in tasks.iter().enumerate().filter(|(_, t)| t.claims.is_empty()) {
            for notified in self.notified.iter_mut().skip(winner).step_by(n.max(1)) {
                *notified = false;
            }
        }
    }
}
