//! Inverse kinematics by damped least squares from sixteen configurations at a time.
//!
//! Per lane: the step solves (J·Jᵀ + λ) x = e, Δq = Jᵀ·x, where e is the remaining distance and λ grows with it
//! (Wampler 1986, Nakamura and Hanafusa 1986). Single precision ends at about 1e-6 m and rad: a caller that needs more
//! takes the last step in double precision.

use crate::block::{Block, LANES, Lanes};
use crate::chain::{Bend, Chain, Frame, Step};
use crate::trig::sin_cos;
use crate::width::{Vectors, Width};

/// A lane has arrived at this distance [m and rad, together].
const ARRIVED: f32 = 1e-4;
/// A lane has ended after this many steps without becoming a tenth closer.
const IDLE: f32 = 6.0;
/// Longest step of a joint [rad or m].
const MAX_STEP: f32 = 0.7;
/// Damping far away, times the squared distance, and close by.
const DAMPING: (f32, f32) = (0.02, 1e-5);

/// When a search ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Until {
    /// As soon as any lane has arrived.
    First,
    /// When each lane has arrived, or makes no progress any longer.
    All,
}

/// A search for configurations of one link.
#[derive(Debug, Clone)]
pub struct Solver {
    chain: Chain,
    /// Per variable of a configuration.
    limits: Vec<(f32, f32)>,
    /// Axis and origin of each joint in the root, of the latest step.
    axes: Vec<[Lanes; 6]>,
    /// Velocity of the link per unit speed of each variable of the chain: linear, angular.
    columns: Vec<[Lanes; 6]>,
    width: Width,
}

impl Solver {
    /// Creates a solver; `limits` are those of the variables of a configuration, lower and upper [rad or m], infinite
    /// where there is none.
    pub fn new(chain: Chain, limits: &[(f64, f64)], width: Width) -> Self {
        let zero = [Lanes::splat(0.0); 6];
        Self {
            limits: limits.iter().map(|(lower, upper)| (*lower as f32, *upper as f32)).collect(),
            axes: vec![zero; chain.steps.len()],
            columns: vec![zero; limits.len()],
            chain,
            width,
        }
    }

    /// Returns the chain.
    pub fn chain(&self) -> &Chain {
        &self.chain
    }

    /// Moves sixteen configurations towards a pose of the link in the root, within the limits; returns the lanes that
    /// arrived at it within about 0.1 mm and 0.1 mrad together, as bits.
    ///
    /// `q` has one entry per variable of a configuration; those that do not move the link keep their values.
    /// `rotation`: whether the orientation counts.
    ///
    /// # Panics
    /// If `q` has fewer entries than there are limits.
    pub fn descend(&mut self, pose: &Frame, rotation: bool, q: &mut [Lanes], steps: usize, until: Until) -> u16 {
        assert!(q.len() >= self.limits.len(), "a configuration has {} entries", self.limits.len());
        let search = Search { target: self.chain.target(pose), rotation, steps, until };
        match self.width.0 {
            // SAFETY: only `Width` makes one, and only of vectors that this processor has.
            #[cfg(target_arch = "x86_64")]
            Vectors::Avx512 => unsafe { avx512(self, &search, q) },
            // SAFETY: see above.
            #[cfg(target_arch = "x86_64")]
            Vectors::Avx2 => unsafe { avx2(self, &search, q) },
            Vectors::Portable => descend::<crate::block::Portable>(self, &search, q),
        }
    }
}

/// Target of a search.
struct Search {
    /// Columns of the rotation of the last joint's frame, and the position of the link.
    target: [[f32; 3]; 4],
    rotation: bool,
    steps: usize,
    until: Until,
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,fma")]
fn avx512(solver: &mut Solver, search: &Search, q: &mut [Lanes]) -> u16 {
    descend::<crate::block::x86::Avx512>(solver, search, q)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn avx2(solver: &mut Solver, search: &Search, q: &mut [Lanes]) -> u16 {
    descend::<crate::block::x86::Avx2>(solver, search, q)
}

/// A vector per lane.
type Vector<B> = [B; 3];

// No `map` of arrays in what follows: it is a function of its own, without the vectors of the kernel that calls it, and
// the kernel becomes twenty times slower.

/// Writes a loop over rows out, so that a matrix of constant size stays in registers.
macro_rules! rows {
    ($($row:literal)*, |$i:ident| $body:block) => { $({ let $i: usize = $row; $body })* };
}

#[inline(always)]
fn splat<B: Block>(v: &[f32; 3]) -> Vector<B> {
    [B::splat(v[0]), B::splat(v[1]), B::splat(v[2])]
}

#[inline(always)]
fn load<B: Block>(from: &[Lanes; 6]) -> [B; 6] {
    let [a, b, c, d, e, f] = from;
    [B::load(a), B::load(b), B::load(c), B::load(d), B::load(e), B::load(f)]
}

#[inline(always)]
fn descend<B: Block>(solver: &mut Solver, search: &Search, q: &mut [Lanes]) -> u16 {
    let (mut best, mut idle) = (B::splat(f32::INFINITY), B::splat(0.0));
    let mut arrived = 0;
    for step in 0..=search.steps {
        let error = distance::<B>(solver, search, q);
        let squared = error.squared();
        arrived = B::bits(squared.less(B::splat(ARRIVED * ARRIVED))) & B::bits(B::splat(2.0).less(error.trace));
        let closer = squared.less(best.mul(B::splat(0.9)));
        idle = B::select(closer, B::splat(0.0), idle.add(B::splat(1.0)));
        best = squared.min(best);
        let ended = arrived | B::bits(B::splat(IDLE).less(idle));
        let enough = match search.until {
            Until::First => arrived != 0 || ended == u16::MAX,
            Until::All => ended == u16::MAX,
        };
        if enough || step == search.steps {
            break;
        }
        advance::<B>(solver, &error, squared, q);
    }
    arrived
}

/// Remaining error.
struct Distance<B> {
    linear: Vector<B>,
    angular: Vector<B>,
    /// Of the remaining rotation: 3 at the target, negative beyond a right angle or more. Zero vectors point both ways.
    trace: B,
}

impl<B: Block> Distance<B> {
    #[inline(always)]
    fn squared(&self) -> B {
        let [x, y, z] = self.linear;
        let [a, b, c] = self.angular;
        x.mul_add(x, y.mul_add(y, z.mul_add(z, a.mul_add(a, b.mul_add(b, c.mul(c))))))
    }
}

/// Computes frames, columns and what remains.
#[inline(always)]
fn distance<B: Block>(solver: &mut Solver, search: &Search, q: &[Lanes]) -> Distance<B> {
    let chain = &solver.chain;
    let [x, y, z, p] = &chain.root;
    let (mut x, mut y, mut z, mut p) = (splat::<B>(x), splat::<B>(y), splat::<B>(z), splat::<B>(p));
    for (step, axis) in chain.steps.iter().zip(&mut solver.axes) {
        p = along(p, &x, &y, &z, &step.translation);
        bend(step, &mut x, &mut y, &mut z);
        let at = B::load(&q[step.variable]).mul_add(B::splat(step.multiplier), B::splat(step.offset));
        if step.slides {
            for (p, z) in p.iter_mut().zip(&z) {
                *p = at.mul_add(*z, *p);
            }
        } else {
            let (sin, cos) = sin_cos(at);
            for (x, y) in x.iter_mut().zip(&mut y) {
                let was = *x;
                *x = cos.mul_add(was, sin.mul(*y));
                *y = cos.mul_add(*y, sin.neg().mul(was));
            }
        }
        for (to, from) in axis.iter_mut().zip(z.iter().chain(&p)) {
            from.store(to);
        }
    }
    let p = along(p, &x, &y, &z, &chain.link);
    columns::<B>(solver, search.rotation, &p);
    let [tx, ty, tz, tp] = &search.target;
    let (tx, ty, tz, tp) = (splat::<B>(tx), splat::<B>(ty), splat::<B>(tz), splat::<B>(tp));
    let linear = [tp[0].sub(p[0]), tp[1].sub(p[1]), tp[2].sub(p[2])];
    if !search.rotation {
        return Distance { linear, angular: [B::splat(0.0); 3], trace: B::splat(3.0) };
    }
    let (mut angular, mut trace) = ([B::splat(0.0); 3], B::splat(0.0));
    for (is, to) in [(&x, &tx), (&y, &ty), (&z, &tz)] {
        for i in 0..3 {
            let (j, k) = ((i + 1) % 3, (i + 2) % 3);
            angular[i] = is[k].neg_mul_add(to[j], is[j].mul_add(to[k], angular[i]));
            trace = is[i].mul_add(to[i], trace);
        }
    }
    let half = B::splat(0.5);
    Distance { linear, angular: [angular[0].mul(half), angular[1].mul(half), angular[2].mul(half)], trace }
}

/// A point at constant coordinates in a frame.
#[inline(always)]
fn along<B: Block>(p: Vector<B>, x: &Vector<B>, y: &Vector<B>, z: &Vector<B>, at: &[f32; 3]) -> Vector<B> {
    let mut p = p;
    for (axis, length) in [x, y, z].into_iter().zip(at).filter(|(_, length)| **length != 0.0) {
        for (p, axis) in p.iter_mut().zip(axis) {
            *p = axis.mul_add(B::splat(*length), *p);
        }
    }
    p
}

/// Rotates a frame by the constant rotation before a joint.
#[inline(always)]
fn bend<B: Block>(step: &Step, x: &mut Vector<B>, y: &mut Vector<B>, z: &mut Vector<B>) {
    let (was_x, was_y, was_z) = (*x, *y, *z);
    match &step.bend {
        Bend::Straight => {}
        Bend::Quarter => (*y, *z) = (was_z, [was_y[0].neg(), was_y[1].neg(), was_y[2].neg()]),
        Bend::QuarterBack => (*y, *z) = ([was_z[0].neg(), was_z[1].neg(), was_z[2].neg()], was_y),
        Bend::AboutX(sin, cos) => {
            let (sin, cos) = (B::splat(*sin), B::splat(*cos));
            for i in 0..3 {
                y[i] = cos.mul_add(was_y[i], sin.mul(was_z[i]));
                z[i] = cos.mul_add(was_z[i], sin.neg().mul(was_y[i]));
            }
        }
        Bend::Any(columns) => {
            for (axis, c) in [x, y, z].into_iter().zip(columns) {
                for i in 0..3 {
                    let part = was_x[i].mul(B::splat(c[0]));
                    axis[i] = was_z[i].mul_add(B::splat(c[2]), was_y[i].mul_add(B::splat(c[1]), part));
                }
            }
        }
    }
}

/// Computes the velocity of the link per unit speed of each variable.
#[inline(always)]
fn columns<B: Block>(solver: &mut Solver, rotation: bool, link: &Vector<B>) {
    for (step, axis) in solver.chain.steps.iter().zip(&solver.axes) {
        let [zx, zy, zz, px, py, pz] = load::<B>(axis);
        let zero = B::splat(0.0);
        let mut column = if step.slides {
            [zx, zy, zz, zero, zero, zero]
        } else {
            let (x, y, z) = (link[0].sub(px), link[1].sub(py), link[2].sub(pz));
            let cross = |a: B, b: B, c: B, d: B| c.neg_mul_add(d, a.mul(b));
            let turning = if rotation { [zx, zy, zz] } else { [zero; 3] };
            [cross(zy, z, zz, y), cross(zz, x, zx, z), cross(zx, y, zy, x), turning[0], turning[1], turning[2]]
        };
        if step.multiplier != 1.0 {
            for part in &mut column {
                *part = part.mul(B::splat(step.multiplier));
            }
        }
        for (to, part) in solver.columns[step.variable].iter_mut().zip(column) {
            let sum = if step.shares { B::load(to).add(part) } else { part };
            sum.store(to);
        }
    }
}

/// Takes the damped step.
#[inline(always)]
fn advance<B: Block>(solver: &Solver, error: &Distance<B>, squared: B, q: &mut [Lanes]) {
    let damping = squared.mul_add(B::splat(DAMPING.0), B::splat(DAMPING.1));
    let zero = B::splat(0.0);
    let mut gram = [zero; 21];
    rows!(0 1 2 3 4 5, |i| { gram[at(i, i)] = damping; });
    for variable in &solver.chain.variables {
        let column = load::<B>(&solver.columns[*variable]);
        rows!(0 1 2 3 4 5, |i| {
            for j in 0..=i {
                gram[at(i, j)] = column[i].mul_add(column[j], gram[at(i, j)]);
            }
        });
    }
    let [a, b, c] = error.linear;
    let [d, e, f] = error.angular;
    let x = solve(gram, [a, b, c, d, e, f]);
    let mut longest = B::splat(MAX_STEP);
    for variable in &solver.chain.variables {
        longest = step(&solver.columns[*variable], &x).abs().max(longest);
    }
    let scale = B::splat(MAX_STEP).div(longest);
    for variable in &solver.chain.variables {
        let (lower, upper) = solver.limits[*variable];
        let next = step(&solver.columns[*variable], &x).mul_add(scale, B::load(&q[*variable]));
        next.max(B::splat(lower)).min(B::splat(upper)).store(&mut q[*variable]);
    }
}

/// The motion of one variable.
#[inline(always)]
fn step<B: Block>(column: &[Lanes; 6], x: &[B; 6]) -> B {
    let column = load::<B>(column);
    let mut sum = column[0].mul(x[0]);
    for i in 1..6 {
        sum = column[i].mul_add(x[i], sum);
    }
    sum
}

/// Where an element of the lower triangle of a symmetric matrix is.
#[inline(always)]
const fn at(row: usize, column: usize) -> usize {
    row * (row + 1) / 2 + column
}

/// Solves a symmetric system by L·D·Lᵀ.
#[inline(always)]
fn solve<B: Block>(mut m: [B; 21], mut x: [B; 6]) -> [B; 6] {
    let mut inverse = [B::splat(0.0); 6];
    rows!(0 1 2 3 4 5, |j| {
        inverse[j] = B::splat(1.0).div(m[at(j, j)]);
        for i in j + 1..6 {
            let factor = m[at(i, j)].mul(inverse[j]);
            for k in j + 1..=i {
                m[at(i, k)] = factor.neg_mul_add(m[at(k, j)], m[at(i, k)]);
            }
            x[i] = factor.neg_mul_add(x[j], x[i]);
        }
        for i in j + 1..6 {
            m[at(i, j)] = m[at(i, j)].mul(inverse[j]);
        }
    });
    rows!(5 4 3 2 1 0, |j| {
        x[j] = x[j].mul(inverse[j]);
        for i in j + 1..6 {
            x[j] = m[at(i, j)].neg_mul_add(x[i], x[j]);
        }
    });
    x
}

/// Returns one lane of a configuration.
pub fn lane(q: &[Lanes], lane: usize) -> impl Iterator<Item = f64> + '_ {
    q.iter().map(move |values| f64::from(values.0[lane % LANES]))
}
