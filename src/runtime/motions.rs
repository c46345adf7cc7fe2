//! Remembers the motions of a run: what was planned, and how it ended.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::rpc::api::Presence;
use crate::telemetry::{Reason, TaskState};
use crate::trajectory::Spline;

/// Maximum number of remembered motions.
const REMEMBERED: usize = 256;

/// A motion as it was sent to the coordinator.
#[derive(Debug, Clone, PartialEq)]
pub struct Planned {
    /// The task that carries it out.
    pub task: u16,
    /// Its joints, over all arms.
    pub joints: Vec<u16>,
    /// Where they should end [rad].
    pub goal: Vec<f64>,
    /// How long it should take [s].
    pub duration: f64,
    /// The plan that it carries out, and its curve; for motions that were planned.
    pub plan: Option<Carried>,
    /// What came into its way, in a sentence.
    pub blocked: Option<String>,
    /// What follows, where it is planned again.
    pub next: Option<Next>,
}

/// What a planned motion carries out.
#[derive(Debug, Clone, PartialEq)]
pub struct Carried {
    /// The plan.
    pub plan: u64,
    /// Its curve.
    pub spline: Arc<Spline>,
    /// Where it is planned again when something gets in its way: the connection that wants it, if it is one.
    pub replan: Option<Option<Presence>>,
}

/// What follows a motion that had to end before something.
#[derive(Debug, Clone, PartialEq)]
pub enum Next {
    /// It is being planned again.
    Planning,
    /// The motion that continues.
    Motion(u64),
    /// There is none: why.
    None(String),
}

/// A planned motion under way.
#[derive(Debug, Clone)]
pub struct UnderWay {
    /// Its number.
    pub number: u64,
    /// The task that carries it out.
    pub task: u16,
    /// Its joints, over all arms.
    pub joints: Vec<u16>,
    /// The plan.
    pub plan: u64,
    /// Its curve.
    pub spline: Arc<Spline>,
    /// As [`Carried::replan`].
    pub replan: Option<Option<Presence>>,
}

/// How a motion ended.
#[derive(Debug, Clone, PartialEq)]
pub struct End {
    /// The task's state.
    pub state: TaskState,
    /// Why.
    pub reason: Reason,
    /// Where its joints were [rad].
    pub actual: Vec<f64>,
}

/// The motions of a run, by number.
#[derive(Debug, Default)]
pub struct Motions(BTreeMap<u64, (Planned, Option<End>)>);

impl Motions {
    /// Notes a motion that is about to be sent.
    pub fn plan(&mut self, number: u64, planned: Planned) {
        while self.0.len() >= REMEMBERED {
            self.0.pop_first();
        }
        self.0.insert(number, (planned, None));
    }

    /// It was refused.
    pub fn forget(&mut self, number: u64) {
        self.0.remove(&number);
    }

    /// A task changed its state. `positions`: of all joints, now [rad]. Motions of a task end in their order.
    pub fn task_changed(&mut self, task: u16, state: TaskState, reason: Reason, positions: &[f64]) {
        if !matches!(state, TaskState::Completed | TaskState::Aborted | TaskState::Fault) {
            return;
        }
        let running = self.0.values_mut().find(|(planned, end)| planned.task == task && end.is_none());
        if let Some((planned, end)) = running {
            let at = |j: &u16| positions.get(*j as usize).copied().unwrap_or(f64::NAN);
            *end = Some(End { state, reason, actual: planned.joints.iter().map(at).collect() });
        }
    }

    /// The planned motions that are under way.
    pub fn under_way(&self) -> Vec<UnderWay> {
        let going = self.0.iter().filter(|(_, (_, end))| end.is_none());
        let planned = going.filter_map(|(number, (planned, _))| {
            let Carried { plan, spline, replan } = planned.plan.clone()?;
            let (number, task, joints) = (*number, planned.task, planned.joints.clone());
            Some(UnderWay { number, task, joints, plan, spline, replan })
        });
        planned.collect()
    }

    /// Something came into a motion's way. `true`: it is planned again from here on.
    pub fn blocked(&mut self, number: u64, text: String, in_time: bool) -> bool {
        let Some((planned, _)) = self.0.get_mut(&number) else { return false };
        planned.blocked = Some(text);
        let again = in_time && planned.plan.as_ref().is_some_and(|carried| carried.replan.is_some());
        planned.next = again.then_some(Next::Planning);
        again
    }

    /// What came of planning a motion again.
    pub fn went_on(&mut self, number: u64, next: Result<u64, String>) {
        if let Some((planned, _)) = self.0.get_mut(&number) {
            planned.next = Some(next.map_or_else(Next::None, Next::Motion));
        }
    }

    /// Whether a motion is being planned again.
    pub fn is_replanning(&self, number: u64) -> bool {
        self.0.get(&number).is_some_and(|(planned, _)| planned.next == Some(Next::Planning))
    }

    /// Motions of a task are not planned again.
    pub fn end_replanning(&mut self, task: u16) {
        for (planned, _) in self.0.values_mut().filter(|(planned, _)| planned.task == task) {
            if let Some(carried) = &mut planned.plan {
                carried.replan = None;
            }
            if planned.next == Some(Next::Planning) {
                planned.next = Some(Next::None("cancelled".to_owned()));
            }
        }
    }

    /// A motion, and how it ended if it did.
    pub fn get(&self, number: u64) -> Option<&(Planned, Option<End>)> {
        self.0.get(&number)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn motions_of_a_task_end_in_their_order_and_old_ones_are_forgotten() {
        let planned = |task| Planned {
            task,
            joints: vec![1],
            goal: vec![0.5],
            duration: 1.0,
            plan: None,
            blocked: None,
            next: None,
        };
        let mut m = Motions::default();
        (1..=3).for_each(|n| m.plan(n, planned((n % 2) as u16)));
        m.task_changed(1, TaskState::Executing, Reason::None, &[]);
        m.task_changed(1, TaskState::Completed, Reason::None, &[0.0, 0.499]);
        assert_eq!(m.get(1).unwrap().1.as_ref().unwrap().actual, vec![0.499]);
        assert!(m.get(2).unwrap().1.is_none() && m.get(3).unwrap().1.is_none());
        (4..500).for_each(|n| m.plan(n, planned(0)));
        assert!(m.get(1).is_none() && m.get(499).is_some());
    }
}
