//! Who gets which joint: the higher priority wins, at equal priority the blueprint's order; one mode per arm. A
//! loser is notified once per winner, and again only after that winner has released the joint.

use super::request::Motion;
use super::task::Task;
use super::task_body::{Claim, Demand};
use crate::telemetry::Event;

/// What came of arbitration.
#[derive(Debug)]
pub struct Arbiter {
    /// Tasks from the strongest to the weakest.
    order: Vec<u16>,
    /// The arm of each joint.
    arm_of: Vec<u16>,
    /// By joint: the winner and its value.
    winners: Vec<Option<(u16, f64)>>,
    /// By joint: who won it in the tick before.
    before: Vec<Option<u16>>,
    /// By arm: how its joints are commanded, and the task that decided it.
    demands: Vec<(Demand, u16)>,
    /// By loser and winner: whether the loser was notified.
    told: Vec<bool>,
}

impl Arbiter {
    /// For tasks with these priorities and joints of these arms.
    pub fn new(priorities: &[i32], arm_of: Vec<u16>, arms: usize) -> Self {
        let mut order: Vec<u16> = (0..priorities.len() as u16).collect();
        order.sort_by_key(|&t| std::cmp::Reverse(priorities.get(t as usize).copied().unwrap_or(i32::MIN)));
        Self {
            order,
            winners: vec![None; arm_of.len()],
            before: vec![None; arm_of.len()],
            arm_of,
            demands: vec![(Demand::Nothing, 0); arms],
            told: vec![false; priorities.len() * priorities.len()],
        }
    }

    /// The winner of a joint and its value.
    pub fn winner(&self, joint: usize) -> Option<(u16, f64)> {
        self.winners.get(joint).copied().flatten()
    }

    /// Whether the joint's winner is another one than in the tick before.
    pub fn changed_hands(&self, joint: usize) -> bool {
        self.before.get(joint).copied().flatten() != self.winner(joint).map(|(task, _)| task)
    }

    /// How an arm's joints are commanded.
    pub fn demand(&self, arm: usize) -> Demand {
        self.demands.get(arm).map_or(Demand::Nothing, |(demand, _)| *demand)
    }

    /// Decides all claims. `tell` gets the events, `retire` the motions that ended.
    pub fn decide(&mut self, tasks: &mut [Task], mut tell: impl FnMut(Event), mut retire: impl FnMut(Box<Motion>)) {
        for (before, winner) in self.before.iter_mut().zip(&mut self.winners) {
            *before = winner.take().map(|(task, _)| task);
        }
        self.demands.fill((Demand::Nothing, 0));
        self.forget_what_idle_winners_took(tasks);
        for rank in 0..self.order.len() {
            let Some(&loser) = self.order.get(rank) else { continue };
            while let Some((winner, joint, conflict)) = self.lost(loser, tasks) {
                let priority = |t: u16| tasks.get(t as usize).map_or(0, |t| t.priority);
                let equal = priority(winner) == priority(loser);
                if self.tell_once(loser, winner, tasks.len()) {
                    tell(match conflict {
                        true => Event::ModeConflict(loser, winner, self.arm(joint)),
                        false => Event::Preempted(loser, winner, joint, equal),
                    });
                }
                let Some(task) = tasks.get_mut(loser as usize) else { break };
                let (state, reason) = (task.state, task.reason);
                task.lose(winner, joint).map(&mut retire);
                if (task.state, task.reason) != (state, reason) {
                    tell(Event::Task(loser, task.state, task.reason));
                }
            }
            self.place(loser, tasks);
        }
    }

    /// Returns the first claim that a task loses to a stronger one: that task, the joint, whether by mode.
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

    fn place(&mut self, task: u16, tasks: &[Task]) {
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

    fn tell_once(&mut self, loser: u16, winner: u16, tasks: usize) -> bool {
        match self.told.get_mut(loser as usize * tasks + winner as usize) {
            Some(told) => !std::mem::replace(told, true),
            None => false,
        }
    }

    fn forget_what_idle_winners_took(&mut self, tasks: &[Task]) {
        let n = tasks.len();
        for (winner, _) in tasks.iter().enumerate().filter(|(_, t)| t.claims.is_empty()) {
            for told in self.told.iter_mut().skip(winner).step_by(n.max(1)) {
                *told = false;
            }
        }
    }
}
