//! The latest motions of a run: their plans and their ends.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard};

use crate::runtime::client::curb::Curb;
use dimos_core::sync::lock;
use dimos_core::telemetry::{Origin, Reason, TaskState, Who};
use dimos_core::trajectory::Spline;
use dimos_rpc::api::Presence;

/// The task of a native motion: none, the arm's own controller executes it.
pub const NATIVE: u16 = u16::MAX;
/// Maximum number of motions kept.
const REMEMBERED: usize = 256;

/// A motion as it was sent to the coordinator.
#[derive(Debug, Clone, PartialEq)]
pub struct Planned {
    /// The task that executes it, or [`NATIVE`].
    pub task: u16,
    /// Its joints: indices over all arms' joints.
    pub joints: Vec<u16>,
    /// Goal positions [rad]; none for a native motion.
    pub goal: Vec<f64>,
    /// Planned duration; of a native motion, its duration once it has ended [s].
    pub duration: f64,
    /// The plan that it executes, and its trajectory, for planned motions.
    pub plan: Option<Carried>,
    /// The obstacle that blocked it, as a sentence.
    pub blocked: Option<String>,
    /// What follows if it is planned again.
    pub next: Option<Next>,
    /// If it retraces the log: time in it of the goal [s since 1970].
    pub retraces_to: Option<f64>,
    /// The tick at which its task began it, once that is known.
    pub began: Option<u64>,
    /// Who asked for it; `None`: this program.
    pub by: Option<Arc<Who>>,
}

/// What a planned motion executes.
#[derive(Debug, Clone, PartialEq)]
pub struct Carried {
    /// The plan.
    pub plan: u64,
    /// Its trajectory.
    pub spline: Arc<Spline>,
    /// If it is planned again when blocked: the connection that requested this, if any.
    pub replan: Option<Option<Presence>>,
    /// When and by whom it was requested, also if it is planned again.
    pub origin: Origin,
    /// Ends planning it again, and the `go` that it is a part of.
    pub curb: Arc<Curb>,
}

/// What follows a blocked motion.
#[derive(Debug, Clone, PartialEq)]
pub enum Next {
    /// It is being planned again.
    Planning,
    /// The motion that continues.
    Motion(u64),
    /// There is none, for this reason.
    None(String),
}

/// A planned motion that is being executed.
#[derive(Debug, Clone)]
pub struct UnderWay {
    /// Its number.
    pub number: u64,
    /// The task that executes it.
    pub task: u16,
    /// Its joints: indices over all arms' joints.
    pub joints: Vec<u16>,
    /// The plan.
    pub plan: u64,
    /// Its trajectory.
    pub spline: Arc<Spline>,
    /// As [`Carried::replan`].
    pub replan: Option<Option<Presence>>,
    /// As [`Carried::origin`].
    pub origin: Origin,
    /// As [`Carried::curb`].
    pub curb: Arc<Curb>,
    /// As [`Planned::by`].
    pub by: Option<Arc<Who>>,
}

/// How a motion ended.
#[derive(Debug, Clone, PartialEq)]
pub struct End {
    /// The task's state.
    pub state: TaskState,
    /// Reason for the state.
    pub reason: Reason,
    /// Positions of its joints [rad].
    pub actual: Vec<f64>,
    /// The tick at which it ended.
    pub tick: u64,
}

/// The motions of a run, by number.
#[derive(Debug, Default)]
pub struct Motions(Mutex<ByNumber>);

type ByNumber = BTreeMap<u64, (Planned, Option<End>)>;

impl Motions {
    fn all(&self) -> MutexGuard<'_, ByNumber> {
        lock(&self.0)
    }

    /// Adds a motion that is about to be sent.
    pub fn plan(&self, number: u64, planned: Planned) {
        let mut all = self.all();
        while all.len() >= REMEMBERED {
            all.pop_first();
        }
        all.insert(number, (planned, None));
    }

    /// Removes a motion that was refused.
    pub fn forget(&self, number: u64) {
        self.all().remove(&number);
    }

    /// Takes a change of a task's state at a tick. `positions`: present positions of all joints [rad]. Motions of a
    /// task begin and end in order.
    pub fn task_changed(&self, task: u16, (tick, state, reason): (u64, TaskState, Reason), positions: &[f64]) {
        let mut all = self.all();
        let running = all.values_mut().find(|(planned, end)| planned.task == task && end.is_none());
        let Some((planned, end)) = running else { return };
        match state {
            TaskState::Executing => planned.began = planned.began.or(Some(tick)),
            TaskState::Completed | TaskState::Aborted | TaskState::Fault => {
                let at = |j: &u16| positions.get(*j as usize).copied().unwrap_or(f64::NAN);
                *end = Some(End { state, reason, actual: planned.joints.iter().map(at).collect(), tick });
            }
            _ => {}
        }
    }

    /// Ends a native motion after `elapsed` [s]. `positions`: as in [`Motions::task_changed`]; `why`: why it did not
    /// reach its goal.
    pub fn end(
        &self,
        number: u64,
        (state, reason, why): (TaskState, Reason, Option<String>),
        elapsed: f64,
        positions: &[f64],
    ) {
        if let Some((planned, end)) = self.all().get_mut(&number) {
            (planned.duration, planned.blocked) = (elapsed, why);
            let at = |j: &u16| positions.get(*j as usize).copied().unwrap_or(f64::NAN);
            *end = Some(End { state, reason, actual: planned.joints.iter().map(at).collect(), tick: 0 });
        }
    }

    /// Returns the planned motions that are being executed.
    pub fn under_way(&self) -> Vec<UnderWay> {
        let all = self.all();
        let going = all.iter().filter(|(_, (_, end))| end.is_none());
        let planned = going.filter_map(|(number, (planned, _))| {
            let Carried { plan, spline, replan, origin, curb } = planned.plan.clone()?;
            let (number, task, joints) = (*number, planned.task, planned.joints.clone());
            let by = planned.by.clone();
            Some(UnderWay { number, task, joints, plan, spline, replan, origin, curb, by })
        });
        planned.collect()
    }

    /// Marks a motion as blocked. Returns whether it is to be planned again.
    pub fn blocked(&self, number: u64, text: String, in_time: bool) -> bool {
        let mut all = self.all();
        let Some((planned, _)) = all.get_mut(&number) else { return false };
        planned.blocked = Some(text);
        let again = in_time && planned.plan.as_ref().is_some_and(|carried| carried.replan.is_some());
        planned.next = again.then_some(Next::Planning);
        again
    }

    /// Marks a motion as one that retraces the log to this time [s since 1970].
    pub fn retraces(&self, number: u64, to: Option<f64>) {
        if let Some((planned, _)) = self.all().get_mut(&number) {
            planned.retraces_to = to;
        }
    }

    /// Sets the result of planning a motion again. If that was ended, its reason stays.
    pub fn went_on(&self, number: u64, next: Result<u64, String>) {
        if let Some((planned, _)) = self.all().get_mut(&number)
            && (next.is_ok() || !matches!(planned.next, Some(Next::None(_))))
        {
            planned.next = Some(next.map_or_else(Next::None, Next::Motion));
        }
    }

    /// Returns whether a motion is being planned again.
    pub fn is_replanning(&self, number: u64) -> bool {
        self.all().get(&number).is_some_and(|(planned, _)| planned.next == Some(Next::Planning))
    }

    /// Stops planning motions again, for this reason.
    pub fn end_replanning(&self, why: &str, is_meant: impl Fn(&Planned) -> bool) {
        for (planned, _) in self.all().values_mut().filter(|(planned, _)| is_meant(planned)) {
            if let Some(carried) = &mut planned.plan {
                carried.replan = None;
                carried.curb.end(why);
            }
            if planned.next == Some(Next::Planning) {
                planned.next = Some(Next::None(why.to_owned()));
            }
        }
    }

    /// Returns a motion, and its end if it has ended.
    pub fn get(&self, number: u64) -> Option<(Planned, Option<End>)> {
        self.all().get(&number).cloned()
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
            retraces_to: None,
            began: None,
            by: None,
        };
        let m = Motions::default();
        (1..=3).for_each(|n| m.plan(n, planned((n % 2) as u16)));
        m.task_changed(1, (7, TaskState::Executing, Reason::None), &[]);
        m.task_changed(1, (9, TaskState::Completed, Reason::None), &[0.0, 0.499]);
        let (first, end) = m.get(1).unwrap();
        assert_eq!((first.began, end.as_ref().unwrap().tick), (Some(7), 9));
        assert_eq!(end.as_ref().unwrap().actual, vec![0.499]);
        assert!(m.get(2).unwrap().1.is_none() && m.get(3).unwrap().1.is_none());
        (4..500).for_each(|n| m.plan(n, planned(0)));
        assert!(m.get(1).is_none() && m.get(499).is_some());
    }
}
