//! `on_exit: park`: at a controlled end each arm that asks for it moves to its park pose, as with `dimos move`, and its
//! motors are disabled there.
//!
//! An arm that cannot get there is left as one without `on_exit`, with a warning. A stop, a hold of any arm, a fault of
//! the run and a second signal prevent the motion, or end it.

use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use crate::blueprint::OnExit;
use crate::runtime::client::in_process;
use crate::runtime::{Ended, Ending, Run};
use dimos_control::request::Request;
use dimos_core::telemetry::{Origin, Phase};
use dimos_rpc::api::{Move, Reply};

/// Fraction of the highest speed of the motion to the park pose.
const SPEED: f64 = 0.3;
/// Longest motion to a park pose.
const LONGEST: Duration = Duration::from_secs(20);
/// Time for a motion to end after its duration: an arm lags, and settles.
const SETTLE: Duration = Duration::from_secs(3);

/// Why nothing is parked after a fault, or when the log cannot be written.
const UNCONTROLLED: &str = "the end of the run is not a controlled one";

/// An arm on its way: its index, its motion, how long that takes [s].
struct Parking {
    arm: usize,
    motion: u64,
    duration: f64,
}

impl Run {
    /// Moves the arms that park, and marks those that arrive to be disabled.
    pub(in crate::runtime) fn park(&mut self, ended: &mut Ended) {
        let arms = &self.handle.service().facts.blueprint.arms;
        let which: Vec<usize> =
            arms.iter().enumerate().filter(|(_, a)| a.on_exit == OnExit::Park).map(|(i, _)| i).collect();
        if which.is_empty() {
            return;
        }
        let mut under_way = Vec::new();
        let mut prevented = self.clear_the_way();
        for arm in which {
            prevented = prevented.or_else(|| self.interruption());
            let begun = match prevented.clone().or_else(|| self.held_beside(arm)) {
                Some(why) => Err(why),
                None => self.begin(arm),
            };
            match begun {
                Ok(parking) => under_way.push(parking),
                Err(why) => self.not_parked(ended, arm, &why),
            }
        }
        for (Parking { arm, .. }, result) in under_way.iter().zip(self.finish(&under_way, prevented)) {
            match result {
                Ok(()) if self.handle.service().tick.phase(*arm) != Phase::Ready => {
                    self.not_parked(ended, *arm, "it was held after it had arrived");
                }
                Ok(()) => {
                    self.arms.disable_at_release(*arm);
                    ended.parked.push(self.name_of(*arm));
                }
                Err(why) => self.not_parked(ended, *arm, &why),
            }
        }
    }

    fn name_of(&self, arm: usize) -> String {
        self.handle.service().facts.blueprint.arms.get(arm).map(|arm| arm.hardware_id.clone()).unwrap_or_default()
    }

    fn not_parked(&self, ended: &mut Ended, arm: usize, why: &str) {
        ended.troubles.push(format!("{}: not parked: {why}", self.name_of(arm)));
    }

    /// Ends what moves. Returns why nothing can be parked, if so.
    fn clear_the_way(&self) -> Option<String> {
        if self.faulted.load(Ordering::Acquire) {
            return Some(UNCONTROLLED.to_owned());
        }
        let cancelled = in_process::wait_for(self.handle.service().ask(Request::Cancel { task: None }));
        if !matches!(cancelled, Some(Ok(_))) {
            return Some("the coordinator accepts no requests".to_owned());
        }
        (!self.rests(|| true)).then(|| "the arms are not at rest".to_owned())
    }

    /// Returns why no further arm may move to its park pose, if so. What it takes from the endings is not seen again.
    fn interruption(&self) -> Option<String> {
        let why = |ending| match ending {
            Ending::Signal(_) => Some("it was interrupted by a second signal"),
            Ending::Fault(_) | Ending::Log(_) => Some(UNCONTROLLED),
            Ending::Duration | Ending::Asked => None,
        };
        let mut why = self.endings.1.try_iter().find_map(why);
        if self.handle.service().lifecycle.was_cancelled() {
            why = Some("it was cancelled");
        } else if !self.tick.is_alive() {
            why = Some("the tick has ended");
        }
        why.map(str::to_owned)
    }

    /// Returns which other arm is held: it may be in the way, or have touched this one.
    fn held_beside(&self, arm: usize) -> Option<String> {
        let arms = 0..self.handle.service().facts.blueprint.arms.len();
        let held =
            arms.into_iter().find(|other| *other != arm && self.handle.service().tick.phase(*other) == Phase::Held)?;
        Some(format!("{} is held", self.name_of(held)))
    }

    /// Begins the motion of an arm.
    fn begin(&self, arm: usize) -> Result<Parking, String> {
        let service = self.handle.service();
        let phase = service.tick.phase(arm);
        if phase != Phase::Ready {
            return Err(format!("the arm is {}", phase.name()));
        }
        let target = service.facts.blueprint.arms.get(arm).map(|arm| arm.park_pose.clone()).unwrap_or_default();
        let call = Move::new(self.name_of(arm), target, SPEED);
        let origin = Origin { epoch: service.tick.epoch(), client: 0 };
        match in_process::wait_for(service.move_within(call, LONGEST, origin)) {
            Some(Ok(Reply::Move(reply))) => Ok(Parking { arm, motion: reply.motion, duration: reply.duration }),
            Some(Err(error)) => Err(error.message),
            _ => Err("there was no answer".to_owned()),
        }
    }

    /// Waits until the arms have arrived, or cannot. `ended`: why they cannot, if that is known already.
    fn finish(&self, parking: &[Parking], mut ended: Option<String>) -> Vec<Result<(), String>> {
        let service = self.handle.service();
        let longest = parking.iter().map(|parking| parking.duration).fold(0.0, f64::max);
        let limit = Instant::now() + Duration::from_secs_f64(longest) + SETTLE;
        let mut results: Vec<Option<Result<(), String>>> = parking.iter().map(|_| None).collect();
        while results.iter().any(Option::is_none) && ended.is_none() {
            let late = || (Instant::now() > limit).then(|| "it did not arrive in time".to_owned());
            let held = || parking.iter().find_map(|parking| self.held_beside(parking.arm));
            ended = self.interruption().or_else(held).or_else(late);
            for (result, parking) in results.iter_mut().zip(parking).filter(|(result, _)| result.is_none()) {
                *result = match service.motion(parking.motion) {
                    Ok(report) if !report.done => None,
                    Ok(report) if report.state == "COMPLETED" => Some(Ok(())),
                    Ok(report) => Some(Err(report.error.unwrap_or(report.state))),
                    Err(error) => Some(Err(error.message)),
                };
            }
            std::thread::sleep(service.facts.period());
        }
        let why = ended.unwrap_or_else(|| "it did not arrive".to_owned());
        results.into_iter().map(|result| result.unwrap_or_else(|| Err(why.clone()))).collect()
    }
}
