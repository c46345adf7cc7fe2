//! Commands against a judge that keeps its own history in full precision, and reports it as an FR3 does, in 32 bits.

use super::*;
use crate::franka::ceiling::toward;
use crate::franka::desired::{Desired, Fate, Record};
use crate::franka::model::Model;

/// Numbers from 0 to 1, always the same for a seed.
struct Random(u64);

impl Random {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 11) as f64 / (1_u64 << 53) as f64
    }
}

/// The largest share of each published limit that the controller saw.
#[derive(Debug, Default)]
struct Shares {
    velocity: f64,
    acceleration: f64,
    jerk: f64,
    /// Where the velocity was: cycle, joint, position, velocity, limit.
    at: (u64, usize, f64, f64, f64),
}

struct Bench {
    model: Model,
    shaping: Shaping,
    truth: Desired,
    record: Record,
    pace: Pace,
    id: u64,
    shares: Shares,
}

impl Bench {
    fn new(model: Model, start: [f64; DOF]) -> Self {
        let truth = Desired { q: start.map(|q| f64::from(q as f32)), ..Desired::default() };
        let shaping = Shaping::new(100.0, Some(model.ranges()));
        let record = Record::new(&report(model, 0, &truth), false);
        Self { model, shaping, truth, record, pace: Pace::default(), id: 0, shares: Shares::default() }
    }

    /// One cycle: its command, or none where `lost`.
    fn cycle(&mut self, wanted: &Target, lost: bool, paced: bool) {
        let mut state = report(self.model, self.id, &self.truth);
        let (now, fate) = self.record.take(&state);
        assert_ne!(fate, Fate::Unknown, "cycle {}", self.id);
        (state.q_d, state.dq_d, state.ddq_d) = (now.q, now.v, now.a);
        if let (Target::Positions(q), true) = (wanted, paced) {
            self.pace.take(q, 1);
        }
        let pace = paced.then_some(&self.pace);
        let command = self.shaping.shape(wanted, &state, self.id == 0, pace);
        self.record.answered(command);
        let before = self.truth;
        let v: [f64; DOF] = std::array::from_fn(|j| match &command {
            _ if lost => before.v[j] + before.a[j] * PERIOD,
            Target::Positions(q) => (q[j] - before.q[j]) / PERIOD,
            Target::Velocities(v) => v[j],
        });
        let a: [f64; DOF] = std::array::from_fn(|j| (v[j] - before.v[j]) / PERIOD);
        for (j, range) in self.model.ranges().iter().enumerate() {
            let (low, high) = range.velocities(before.q[j]);
            let share = if v[j] > 1e-9 {
                v[j] / high
            } else if v[j] < -1e-9 {
                v[j] / low
            } else {
                0.0
            };
            if share > self.shares.velocity {
                self.shares.velocity = share;
                self.shares.at = (self.id, j + 1, before.q[j], v[j], if v[j] > 0.0 { high } else { low });
            }
            self.shares.acceleration = self.shares.acceleration.max(a[j].abs() / range.acceleration);
            self.shares.jerk = self.shares.jerk.max((a[j] - before.a[j]).abs() / PERIOD / range.jerk);
        }
        self.truth = Desired { q: std::array::from_fn(|j| before.q[j] + v[j] * PERIOD), v, a };
        self.id += 1;
    }
}

fn report(model: Model, id: u64, now: &Desired) -> State {
    let kept = |values: &[f64; DOF]| values.map(|v| if model == Model::Fer { v } else { f64::from(v as f32) });
    State { id, q_d: kept(&now.q), dq_d: kept(&now.v), ddq_d: kept(&now.a), ..State::default() }
}

const MIDDLE: [f64; DOF] = [0.0, 0.0, 0.0, -1.5, 0.0, 1.9, 0.0];

/// Random targets for `cycles` cycles. With `losses` up to 19 commands in a row are lost, repeatedly.
fn wander(model: Model, velocity: bool, losses: bool, seed: u64, cycles: usize) -> Shares {
    let (mut bench, mut random) = (Bench::new(model, MIDDLE), Random(seed));
    bench.record = Record::new(&report(model, 0, &bench.truth), velocity);
    let ranges = model.ranges();
    let (mut wanted, mut lost, mut since) = ([0.0; DOF], 0, 0);
    for cycle in 0..cycles {
        if cycle == 0 || random.next() < 0.004 {
            wanted = std::array::from_fn(|j| match velocity {
                true => (random.next() - 0.5) * 14.0,
                false => ranges[j].lower - 0.3 + random.next() * (ranges[j].upper - ranges[j].lower + 0.6),
            });
        }
        // A controller and a host that both have trouble: the gaps are at least 10 commands apart.
        if losses && lost == 0 && since > 10 && random.next() < 0.05 {
            (lost, since) = (1 + (random.next() * 19.0) as usize, 0);
        }
        let target = if velocity { Target::Velocities(wanted) } else { Target::Positions(wanted) };
        bench.cycle(&target, lost > 0, false);
        since += usize::from(lost == 0);
        lost = lost.saturating_sub(1);
    }
    bench.shares
}

#[test]
fn the_gain_is_the_vendors() {
    assert!((Shaping::new(100.0, None).gain - 0.3859).abs() < 1e-4);
    assert_eq!(Shaping::new(1000.0, None).gain, 1.0);
}

#[test]
fn any_target_stays_at_97_percent_of_the_limits() {
    for model in [Model::Fer, Model::Fr3] {
        for seed in 0..20 {
            let shares = wander(model, false, false, seed, 2000);
            let most = shares.velocity.max(shares.acceleration).max(shares.jerk);
            assert!(most < 0.971 && shares.acceleration > 0.9, "{model:?} {seed}: {shares:?}");
        }
    }
}

#[test]
fn lost_commands_stay_within_the_limits() {
    for model in [Model::Fer, Model::Fr3] {
        for seed in 0..60 {
            let shares = wander(model, false, true, seed, 2000);
            let most = shares.velocity.max(shares.acceleration).max(shares.jerk);
            assert!(most <= 1.0, "{model:?} {seed}: {shares:?}");
        }
    }
}

#[test]
fn velocities_stay_within_the_limits() {
    for model in [Model::Fer, Model::Fr3] {
        for (seed, losses) in (0..20).flat_map(|seed| [(seed, false), (seed, true)]) {
            let shares = wander(model, true, losses, seed, 1500);
            let most = shares.velocity.max(shares.acceleration).max(shares.jerk);
            assert!(most <= 1.0, "{model:?} {seed} {losses}: {shares:?}");
        }
    }
}

/// With the vendor's limits alone it would swing about a position that is far away for ever.
#[test]
fn a_position_far_away_is_reached_without_swinging() {
    let target = [0.4, -0.2, 0.05, -1.9, 0.01, 1.2, 0.3];
    let (mut bench, mut farthest) = (Bench::new(Model::Fr3, [0.0, 0.0, 0.0, -1.5, 0.0, 1.5, 0.0]), 0.0_f64);
    for _ in 0..1500 {
        bench.cycle(&Target::Positions(target), false, true);
        farthest = farthest.max(bench.truth.q[0] - target[0]);
    }
    assert!(farthest < 2e-3, "{farthest} rad beyond");
    assert!(bench.truth.q.iter().zip(&target).all(|(q, target)| (q - target).abs() < 1e-4), "{:?}", bench.truth);
    assert!(bench.truth.v.iter().all(|v| v.abs() < 1e-3), "{:?}", bench.truth);
}

/// Lost commands at the limit of the user: what was missed is made up for later, and no faster.
#[test]
fn catching_up_keeps_to_the_limits_of_the_user() {
    for (speed, acceleration) in [(0.5, 7.0), (0.5, 1.0), (1.5, 7.0)] {
        let mut bench = Bench::new(Model::Fr3, MIDDLE);
        bench.shaping.user = [UserLimit { velocity: speed, acceleration }; DOF];
        // Up to the speed, on until 1.5 s, and down again.
        let ramp = speed / acceleration;
        let up = |t: f64| 0.5 * acceleration * t.clamp(0.0, ramp).powi(2) + speed * (t - ramp).max(0.0);
        let at = |t: f64| up(t) - up(t - 1.5);
        let (mut fastest, mut strongest, mut beyond, end) = (0.0_f64, 0.0_f64, 0.0_f64, at(5.0) + 0.01);
        for cycle in 0..3500_u32 {
            let mut wanted = MIDDLE;
            // 10 mrad of it were missed, and are made up for in 250 ms, as the follower wants it.
            let t = ((f64::from(cycle) - 900.0) / 250.0).clamp(0.0, 1.0);
            let missed = 0.01 * t * t * t * (10.0 + t * (6.0 * t - 15.0));
            wanted[0] = at(f64::from(cycle) * 1e-3) + missed;
            bench.cycle(&Target::Positions(wanted), (800..819).contains(&cycle), true);
            (fastest, strongest) = (fastest.max(bench.truth.v[0]), strongest.max(bench.truth.a[0].abs()));
            beyond = beyond.max(bench.truth.q[0] - end);
        }
        assert!(fastest <= speed + 1e-9, "{fastest} rad/s at {speed}");
        // The acceleration of the user is not kept while the joint catches up: the published one is.
        assert!(strongest <= 9.7 + 1e-6, "{strongest} rad/s² at {acceleration}");
        assert!(beyond < 2e-3, "{beyond} rad beyond the end");
        assert!((bench.truth.q[0] - end).abs() < 1e-3, "{} rad is not {end}", bench.truth.q[0]);
    }
}

#[test]
fn a_velocity_is_reached_and_kept() {
    let mut bench = Bench::new(Model::Fr3, MIDDLE);
    bench.record = Record::new(&report(Model::Fr3, 0, &bench.truth), true);
    for _ in 0..200 {
        bench.cycle(&Target::Velocities([0.5; DOF]), false, false);
    }
    assert!(bench.truth.v.iter().all(|v| (v - 0.5).abs() < 1e-6), "{:?}", bench.truth);
}

#[test]
fn a_joint_that_brakes_at_its_ceiling_never_passes_the_limit() {
    for (joint, range) in Model::Fr3.ranges().iter().enumerate() {
        let mut room = 3.0;
        while room > 0.0 {
            let ((ceiling, slope), limit) = (toward(range, room, 0.97), range.velocities(range.upper - room).1);
            assert!(ceiling <= 0.9701 * limit + 1e-9, "joint {}: {ceiling} of {limit} rad/s", joint + 1);
            assert!(slope * ceiling <= 0.9 * range.acceleration + 1e-6, "joint {}", joint + 1);
            room -= 0.001;
        }
    }
}
