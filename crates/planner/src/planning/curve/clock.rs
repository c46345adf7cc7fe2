//! The quickest motion along a curve, from rest to rest.
//!
//! A first motion, smooth and at rest at both ends, says where along the curve its time passes; its fastest clock
//! ([`path_clock`](dimos_kernels::path_clock)) makes the next one, whose cells are equally long in time, and so on.
//! The states at the ends of cells are joined by quintics. Where these need more than the limits, the limits of the
//! next search are lower there.

use dimos_kernels::path_clock::{PathClock, Use};
use dimos_kernels::states::{JOINTS, States};

use super::joint_curve::JointCurve;
use super::settings::ClockSettings;
use crate::planning::timing::blend::Jet;
use crate::planning::timing::verify::{Excess, excess, excess_of_cells};
use dimos_core::joint::JointBounds;

/// Abscissas of Gauss's quadrature with four points in a cell, from its middle, in half cells, and their weights.
const GAUSS: [(f64, f64); 4] = [
    (-0.861_136_311_594_052_6, 0.347_854_845_137_453_85),
    (-0.339_981_043_584_856_26, 0.652_145_154_862_546_1),
    (0.339_981_043_584_856_26, 0.652_145_154_862_546_1),
    (0.861_136_311_594_052_6, 0.347_854_845_137_453_85),
];

/// Where a motion along a curve is: parameter and its first three derivatives with respect to time.
type Place = [f64; 4];

/// Returns the states of the quickest motion along a curve within bounds, and what it uses of them. `tool` returns the
/// largest part of its speed limit that a tool uses with the joints at these positions [rad or m] and velocities.
/// `None` if there is no motion: a joint's limit is 0, or not finite numbers are among the configurations.
pub fn quickest(
    curve: &JointCurve,
    bounds: &[JointBounds],
    mut tool: impl FnMut(&[f64], &[f64]) -> f64,
    settings: &ClockSettings,
) -> Option<(States, Excess)> {
    let ramped = |b: &JointBounds| JointBounds { jerk: b.jerk.min(b.acceleration / settings.ramp), ..*b };
    let ramped: Vec<JointBounds> = bounds.iter().map(ramped).collect();
    let mut limits = Limits { curve, bounds: &ramped, factors: Vec::new() };
    let first = Progress::ramps(curve, &ramped);
    let cells = settings.first_cells;
    let uses = limits.uses(&first, cells, &mut tool, settings.tool_share);
    let step = first.duration() / cells as f64;
    let clock = PathClock { uses: &uses.uses, most: &uses.most, step, settings: settings.rough };
    let b = clock.fastest(vec![settings.start * uses.constant()?; cells + 2])?;
    let mut progress = first.with_clock(&clock, &b);
    let mut best: Option<(States, Excess)> = None;
    for _ in 0..=settings.corrections {
        let [fewest, most] = settings.cells;
        let cells = ((progress.duration() / settings.cell) as usize).clamp(fewest, most);
        let uses = limits.uses(&progress, cells, &mut tool, settings.tool_share);
        let step = progress.duration() / cells as f64;
        let clock = PathClock { uses: &uses.uses, most: &uses.most, step, settings: settings.fine };
        let b = clock.fastest(vec![settings.start * uses.constant()?.min(1.0); cells + 2])?;
        let next = progress.with_clock(&clock, &b);
        let mut states = next.states(curve);
        let cells = excess_of_cells(&states, bounds);
        let slower = cells.iter().map(Excess::slower).fold(1.0, f64::max);
        if slower > 1.0 {
            states.stretch(slower * (1.0 + 1e-9));
        }
        if best.as_ref().is_none_or(|(best, _)| states.duration() < best.duration()) {
            let used = excess(&states, bounds, true);
            best = Some((states, used));
        }
        if slower <= settings.correction_ratio {
            break;
        }
        limits.lower(&next, &cells);
        progress = next;
    }
    best
}

/// A motion of the parameter: quintics between nodes.
struct Progress {
    /// Times [s].
    times: Vec<f64>,
    /// Parameter, its velocity and its acceleration at each.
    nodes: Vec<[f64; 3]>,
}

impl Progress {
    fn duration(&self) -> f64 {
        self.times.last().copied().unwrap_or(0.0)
    }

    /// Returns a motion that starts and ends smoothly: about as long as the velocity limits need, and ramps at both
    /// ends about as long as the acceleration takes.
    fn ramps(curve: &JointCurve, bounds: &[JointBounds]) -> Self {
        let slow = |from: &[f64], to: &[f64]| {
            let parts = from.iter().zip(to).zip(bounds).map(|((a, b), bound)| (b - a).abs() / bound.velocity);
            parts.fold(0.0, f64::max)
        };
        let cruise: f64 = curve.configurations().windows(2).map(|pair| slow(&pair[0], &pair[1])).sum();
        let ramp = |b: &JointBounds| b.velocity / b.acceleration + b.acceleration / b.jerk;
        let ramp = bounds.iter().map(ramp).fold(0.02 * cruise, f64::max);
        // A ramp covers 3/5 of what the same time at full speed does: ∫(6x² − 8x³ + 3x⁴).
        let whole = (cruise + 0.8 * ramp).max(2.0 * ramp);
        let speed = curve.length() / (whole - 0.8 * ramp);
        let nodes = 64;
        let times: Vec<f64> = (0..=nodes).map(|k| whole * f64::from(k) / f64::from(nodes)).collect();
        let from_start = |t: f64| {
            let x = (t / ramp).min(1.0);
            let s = speed * (ramp * x * x * x * (2.0 - 2.0 * x + 0.6 * x * x) + (t - ramp).max(0.0));
            let rate = speed * x * x * (6.0 - 8.0 * x + 3.0 * x * x);
            [s, rate, speed / ramp * 12.0 * x * (1.0 - x) * (1.0 - x)]
        };
        let node = |t: &f64| {
            if *t <= 0.5 * whole {
                return from_start(*t);
            }
            let [s, rate, acceleration] = from_start(whole - t);
            [curve.length() - s, rate, -acceleration]
        };
        Self { nodes: times.iter().map(node).collect(), times }
    }

    /// Returns the place at a time [s].
    fn at(&self, time: f64) -> Place {
        let first = self.times.partition_point(|t| *t <= time).clamp(1, self.times.len() - 1) - 1;
        let (h, x) = (self.times[first + 1] - self.times[first], time - self.times[first]);
        let [[p0, v0, a0], [p1, v1, a1]] = [self.nodes[first], self.nodes[first + 1]];
        let (u, inverse) = (x / h, 1.0 / h);
        // In units of the piece's duration.
        let (v0, v1, a0, a1, d) = (v0 * h, v1 * h, a0 * h * h, a1 * h * h, p1 - p0);
        let c3 = 10.0 * d - 6.0 * v0 - 4.0 * v1 - 1.5 * a0 + 0.5 * a1;
        let c4 = -15.0 * d + 8.0 * v0 + 7.0 * v1 + 1.5 * a0 - a1;
        let c5 = 6.0 * d - 3.0 * (v0 + v1) - 0.5 * (a0 - a1);
        [
            p0 + u * (v0 + u * (0.5 * a0 + u * (c3 + u * (c4 + u * c5)))),
            (v0 + u * (a0 + u * (3.0 * c3 + u * (4.0 * c4 + u * 5.0 * c5)))) * inverse,
            (a0 + u * (6.0 * c3 + u * (12.0 * c4 + u * 20.0 * c5))) * inverse * inverse,
            (6.0 * c3 + u * (24.0 * c4 + u * 60.0 * c5)) * inverse * inverse * inverse,
        ]
    }

    /// Returns the same motion with a clock: nodes at the ends of its cells.
    fn with_clock(&self, clock: &PathClock<'_>, b: &[f64]) -> Self {
        let cells = clock.cells();
        let (mut times, mut nodes) = (Vec::with_capacity(cells + 1), Vec::with_capacity(cells + 1));
        let mut time = 0.0;
        for i in 0..=cells {
            let (cell, u) = if i < cells { (i, 0.0) } else { (i - 1, 1.0) };
            let [squared, slope, _] = clock.at(b, cell, u);
            let [s, v, a, _] = self.at(clock.step * i as f64);
            times.push(time);
            nodes.push([s, v * squared.sqrt(), a * squared + 0.5 * v * slope]);
            if i < cells {
                let passed = |(x, weight): &(f64, f64)| weight / clock.at(b, i, 0.5 + 0.5 * x)[0].sqrt();
                time += 0.5 * clock.step * GAUSS.iter().map(passed).sum::<f64>();
            }
        }
        Self { times, nodes }
    }

    /// Returns the states of the joints at the nodes.
    fn states(&self, curve: &JointCurve) -> States {
        let mut states = States::new(curve.joints(), self.nodes.len());
        let last = self.nodes.len() - 1;
        for (i, (time, [s, v, a])) in self.times.iter().zip(&self.nodes).enumerate() {
            // Exactly at rest at the ends.
            let [v, a] = if i == 0 || i == last { [0.0; 2] } else { [*v, *a] };
            states.push(*time, curve.jets(*s).map(|jet| [jet.q, jet.d1 * v, jet.d2 * v * v + jet.d1 * a]));
        }
        states
    }
}

/// The limits of the joints along a curve.
struct Limits<'a> {
    curve: &'a JointCurve,
    bounds: &'a [JointBounds],
    /// Parameters at which limits are lower, and the factor by which velocity, acceleration and jerk are from there to
    /// the next.
    factors: Vec<(f64, [f64; 3])>,
}

/// What a clock may use.
struct Uses {
    uses: Vec<Use>,
    most: Vec<f64>,
}

impl Uses {
    /// Returns the highest constant `b`; `None` without one.
    fn constant(&self) -> Option<f64> {
        let blocks = self.uses.len() / self.most.len();
        let mut least = f64::INFINITY;
        for (uses, most) in self.uses.chunks(blocks).zip(&self.most) {
            least = least.min(*most);
            for used in uses {
                let largest = |list: &[f64; JOINTS]| list.iter().fold(0.0, |most: f64, x| most.max(x.abs()));
                least = least.min(1.0 / largest(&used.acceleration[0])).min(largest(&used.jerk[0]).powf(-2.0 / 3.0));
            }
        }
        (least > 0.0 && least.is_finite()).then_some(least)
    }
}

impl Limits<'_> {
    /// Returns what the clock of a motion may use at the ends and middles of its cells.
    fn uses(
        &self,
        progress: &Progress,
        cells: usize,
        tool: &mut impl FnMut(&[f64], &[f64]) -> f64,
        tool_share: f64,
    ) -> Uses {
        let joints = self.bounds.len();
        let blocks = joints.div_ceil(JOINTS);
        let half = progress.duration() / (2 * cells) as f64;
        let mut uses = vec![Use::default(); blocks * (2 * cells + 1)];
        let mut most = Vec::with_capacity(2 * cells + 1);
        let (mut q, mut v) = (vec![0.0; joints], vec![0.0; joints]);
        for (k, uses) in uses.chunks_exact_mut(blocks).enumerate() {
            let [s, s1, s2, s3] = progress.at(half * k as f64);
            let [slower, weaker, softer] = self.factor(s);
            let mut highest = f64::INFINITY;
            for (j, (Jet { q: at, d1, d2, d3 }, bound)) in self.curve.jets(s).zip(self.bounds).enumerate() {
                let first = d1 * s1;
                let second = d2 * s1 * s1 + d1 * s2;
                let third = d3 * s1 * s1 * s1 + 3.0 * d2 * s1 * s2 + d1 * s3;
                let (block, lane) = (&mut uses[j / JOINTS], j % JOINTS);
                let [acceleration, jerk] = [1.0 / (weaker * bound.acceleration), 1.0 / (softer * bound.jerk)];
                block.acceleration[0][lane] = second * acceleration;
                block.acceleration[1][lane] = 0.5 * first * acceleration;
                block.jerk[0][lane] = third * jerk;
                block.jerk[1][lane] = 1.5 * second * jerk;
                block.jerk[2][lane] = 0.5 * first * jerk;
                highest = highest.min(slower * bound.velocity / first.abs().max(1e-9));
                (q[j], v[j]) = (at, first);
            }
            let part = tool(&q, &v);
            let rate = highest.min(if part > 0.0 { tool_share / part } else { f64::INFINITY });
            most.push(rate * rate);
        }
        Uses { uses, most }
    }

    fn factor(&self, s: f64) -> [f64; 3] {
        let after = self.factors.partition_point(|(from, _)| *from <= s);
        after.checked_sub(1).map_or([1.0; 3], |i| self.factors[i].1)
    }

    /// Lowers the limits where the cells of a motion exceed them.
    fn lower(&mut self, progress: &Progress, cells: &[Excess]) {
        let lower = |part: f64| if part > 1.0 { 1.0 / (part * (1.0 + 1e-4)) } else { 1.0 };
        let mut factors = Vec::with_capacity(cells.len());
        for (i, cell) in cells.iter().enumerate() {
            let s = progress.nodes[i][0];
            let before = self.factor(0.5 * (s + progress.nodes[i + 1][0]));
            let own = [cell.velocity, cell.acceleration, cell.jerk].map(lower);
            factors.push((s, std::array::from_fn(|k| before[k] * own[k])));
        }
        self.factors = factors;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::planning::search::path::Path;
    use dimos_core::double_s::LineLimits;
    use dimos_robot::random::Random;

    const BOUNDS: JointBounds = JointBounds { velocity: 2.0, acceleration: 5.0, jerk: 50.0, ..JointBounds::NONE };

    fn found(path: &[Vec<f64>], bounds: &[JointBounds]) -> (States, Excess) {
        let curve = JointCurve::through(path).unwrap();
        quickest(&curve, bounds, |_, _| 0.0, &ClockSettings::default()).unwrap()
    }

    #[test]
    fn a_straight_line_takes_as_long_as_its_double_s_profile() {
        for length in [0.01, 0.1, 0.5, 1.0, 3.0, 20.0] {
            let (states, used) = found(&[vec![0.0, 0.0], vec![length, 0.4 * length]], &[BOUNDS; 2]);
            let limits = LineLimits { speed: 2.0, acceleration: 5.0, jerk: 50.0 };
            let optimum = limits.duration(0.0, 0.0, length);
            let ratio = states.duration() / optimum;
            assert!((1.0 - 1e-6..1.02).contains(&ratio), "{length}: {ratio}");
            assert!(used.slower() <= 1.0 + 1e-6, "{used:?}");
        }
    }

    #[test]
    fn random_curves_keep_their_limits() {
        let mut random = Random::new(7);
        for _ in 0..12 {
            let path: Path = (0..8).map(|_| (0..7).map(|_| random.between(-1.0, 1.0)).collect()).collect();
            let (states, used) = found(&path, &[BOUNDS; 7]);
            assert!(used.slower() <= 1.0 + 1e-6 && used.jerk > 0.97, "{used:?}");
            assert!(crate::planning::search::path::distance(states.values(0, 0), &path[0]) < 1e-12);
        }
    }

    #[test]
    fn a_tool_slows_the_motion_down_where_it_is_fast_only() {
        let curve = JointCurve::through(&[vec![0.0], vec![3.0]]).unwrap();
        let tool = |q: &[f64], v: &[f64]| if q[0] > 1.5 { v[0].abs() / 0.5 } else { 0.0 };
        let (states, _) = quickest(&curve, &[BOUNDS], tool, &ClockSettings::default()).unwrap();
        let fastest = (0..states.times().len()).map(|i| tool(states.values(i, 0), states.values(i, 1)));
        let fastest = fastest.fold(0.0, f64::max);
        assert!((0.98..1.0).contains(&fastest), "{fastest}");
        assert!(states.duration() < 4.6, "{}", states.duration());
    }
}
