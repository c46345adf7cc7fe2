//! The controller's desired values in full precision. A state of an FR3 has them in 32 bits: half a unit of the last
//! place is 0.12 µrad, which differences over 1 ms turn into 0.12 rad/s² and up to 480 rad/s³. So commands continue
//! from the adapter's own record, and a state only shows which commands the controller used.

use super::protocol::DOF;
use super::protocol::command::Target;
use super::protocol::state::State;
use super::shaping::PERIOD;

/// How far reported values may be from recorded ones: the rounding of a state. Positions [rad], velocities [rad/s].
const ROUNDING: (f64, f64) = (6e-7, 2e-6);
/// Most cycles between two states for which the record is continued: the controller ends a motion before.
const MOST: u64 = 40;
/// Histories that are closer to each other than this are one: a command that equals the extrapolation was used.
const DISTINCT: f64 = 0.01;
/// Commands after a rounded state was adopted until its rounding no longer shows in the jerk.
const UNCERTAIN: u32 = 3;

/// Desired positions [rad], velocities [rad/s] and accelerations [rad/s²].
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Desired {
    /// Positions [rad].
    pub q: [f64; DOF],
    /// Velocities [rad/s].
    pub v: [f64; DOF],
    /// Accelerations [rad/s²].
    pub a: [f64; DOF],
}

impl Desired {
    /// Returns the values that a state reports.
    pub fn reported(state: &State) -> Self {
        Self { q: state.q_d, v: state.dq_d, a: state.ddq_d }
    }

    /// Returns the values one cycle later without a command: the controller keeps the acceleration.
    fn extrapolated(&self) -> Self {
        let v: [f64; DOF] = std::array::from_fn(|i| at(&self.v, i) + at(&self.a, i) * PERIOD);
        Self { q: std::array::from_fn(|i| at(&self.q, i) + at(&v, i) * PERIOD), v, a: self.a }
    }

    /// Returns the values one cycle later with a command: the controller takes backward differences.
    fn commanded(&self, target: &Target) -> Self {
        let (q, v): ([f64; DOF], [f64; DOF]) = match target {
            Target::Positions(q) => (*q, std::array::from_fn(|i| (at(q, i) - at(&self.q, i)) / PERIOD)),
            Target::Velocities(v) => (std::array::from_fn(|i| at(&self.q, i) + at(v, i) * PERIOD), *v),
        };
        Self { q, v, a: std::array::from_fn(|i| (at(&v, i) - at(&self.v, i)) / PERIOD) }
    }

    /// Returns whether a state may report these values: positions agree, or with `velocity` velocities.
    fn agrees(&self, state: &State, velocity: bool) -> bool {
        let (ours, theirs, most) = match velocity {
            true => (&self.v, &state.dq_d, ROUNDING.1),
            false => (&self.q, &state.q_d, ROUNDING.0),
        };
        ours.iter().zip(theirs).all(|(a, b)| (a - b).abs() <= most)
    }

    /// Returns how far these values are from those of a state, in units of their rounding. Accelerations tell most: a
    /// command that differs by 1 nrad differs by 0.001 rad/s².
    fn distance(&self, state: &State) -> f64 {
        let apart = |ours: &[f64; DOF], theirs: &[f64; DOF], unit: f64| {
            ours.iter().zip(theirs).map(|(a, b)| ((a - b) / unit).powi(2)).sum::<f64>()
        };
        apart(&self.q, &state.q_d, ROUNDING.0)
            + apart(&self.v, &state.dq_d, ROUNDING.1)
            + apart(&self.a, &state.ddq_d, 1e-5)
    }
}

/// What became of the newest command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Fate {
    /// The controller used it, or there was none.
    Used,
    /// It continued with constant acceleration instead.
    Lost,
    /// Its values are others: the record starts over with them.
    Unknown,
}

/// The record of a motion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Record {
    velocity: bool,
    /// The state that was seen last, its desired values, and the command that answered it.
    id: u64,
    now: Desired,
    sent: Option<Target>,
    uncertain: u32,
}

impl Record {
    /// Begins with the first state of a motion.
    pub fn new(state: &State, velocity: bool) -> Self {
        Self { velocity, id: state.id, now: Desired::reported(state), sent: None, uncertain: 0 }
    }

    /// Records the answer to the newest state.
    pub fn answered(&mut self, target: Target) {
        self.sent = Some(target);
        self.uncertain = self.uncertain.saturating_sub(1);
    }

    /// Whether a rounded state was adopted a moment ago.
    pub fn is_uncertain(&self) -> bool {
        self.uncertain > 0
    }

    /// Takes a new state. Returns its desired values, and what became of the last answer.
    pub fn take(&mut self, state: &State) -> (Desired, Fate) {
        let cycles = state.id.saturating_sub(self.id);
        if cycles == 0 {
            return (self.now, Fate::Used);
        }
        let sent = self.sent.take();
        let (mut best, mut nearest, mut fate) = (None, f64::INFINITY, Fate::Unknown);
        let mut consider = |candidate: Desired, of: Fate| {
            let distance = candidate.distance(state);
            if candidate.agrees(state, self.velocity) && distance + DISTINCT < nearest {
                (best, nearest, fate) = (Some(candidate), distance, of);
            }
        };
        if cycles <= MOST {
            let lost = if sent.is_some() { Fate::Lost } else { Fate::Used };
            let mut before = self.now;
            for cycle in 0..cycles {
                // Used in this cycle, and extrapolated after it.
                if let Some(target) = &sent {
                    let later = (cycle + 1..cycles).fold(before.commanded(target), |now, _| now.extrapolated());
                    consider(later, Fate::Used);
                }
                before = before.extrapolated();
            }
            consider(before, lost);
        }
        self.id = state.id;
        self.now = match best {
            // Positions do not follow from velocities alone where the controller integrates in its own way.
            Some(found) if self.velocity => Desired { q: state.q_d, ..found },
            Some(found) => found,
            None => {
                self.uncertain = UNCERTAIN;
                Desired::reported(state)
            }
        };
        (self.now, fate)
    }
}

fn at(values: &[f64; DOF], joint: usize) -> f64 {
    values.get(joint).copied().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The state of a controller, as an FR3 reports it.
    fn report(id: u64, now: &Desired) -> State {
        let rounded = |values: &[f64; DOF]| values.map(|value| f64::from(value as f32));
        State { id, q_d: rounded(&now.q), dq_d: rounded(&now.v), ddq_d: rounded(&now.a), ..State::default() }
    }

    /// 400 cycles of commands; `lost` and `unseen` are true in cycles whose command, or whose state, is lost.
    fn run(lost: impl Fn(u64) -> bool, unseen: impl Fn(u64) -> bool) -> u32 {
        let mut truth = Desired { q: [2.7, -1.5, 0.1, -1.9, 0.0, 3.3, 1.0], ..Desired::default() };
        let mut record = Record::new(&report(0, &truth), false);
        record.now = truth;
        let mut losses = 0;
        for id in 0..400_u64 {
            let mut command = None;
            if !unseen(id) {
                let (now, fate) = record.take(&report(id, &truth));
                assert_ne!(fate, Fate::Unknown, "cycle {id}");
                losses += u32::from(fate == Fate::Lost);
                for (a, b) in now.q.iter().zip(&truth.q).chain(now.a.iter().zip(&truth.a)) {
                    assert!((a - b).abs() < 1e-9, "cycle {id}: {now:?} is not {truth:?}");
                }
                let wave = 5e-6 * (id as f64 * 0.02).sin();
                let target = Target::Positions(std::array::from_fn(|i| now.q[i] + now.v[i] * PERIOD + wave));
                record.answered(target);
                command = Some(target);
            }
            truth = match command.filter(|_| !lost(id)) {
                Some(target) => truth.commanded(&target),
                None => truth.extrapolated(),
            };
        }
        losses
    }

    #[test]
    fn the_record_stays_exact_whatever_is_lost() {
        assert_eq!(run(|_| false, |_| false), 0);
        assert_eq!(run(|id| id % 7 == 3, |_| false), 57);
        assert_eq!(run(|_| false, |id| id % 10 == 4), 0);
        assert!(run(|id| id % 7 == 3, |id| id % 30 > 11) > 5);
    }

    #[test]
    fn other_values_are_adopted() {
        let mut record = Record::new(&State { id: 1, ..State::default() }, false);
        record.answered(Target::Positions([1e-6; DOF]));
        let other = State { id: 2, q_d: [0.1; DOF], ..State::default() };
        assert_eq!(record.take(&other), (Desired::reported(&other), Fate::Unknown));
        assert!(record.is_uncertain());
    }
}
