//! Frames of all bodies of a tree of joints, of sixteen configurations at a time.

use crate::block::{Block, Lanes};
use crate::chain::{Frame, Joint};
use crate::trig::sin_cos;

/// Something with a frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Body {
    /// Fixed in the world.
    Fixed(Frame),
    /// Moved by a joint; `parent` is the index of an earlier body.
    Moving {
        /// The body that carries the joint.
        parent: usize,
        /// The joint.
        joint: Joint,
    },
}

/// Axes x, y, z and origin of a body per lane, in the world [m].
pub(crate) type Frames = [Lanes; 12];

/// A frame in registers: columns x, y, z, and the origin.
type Columns<B> = [[B; 3]; 4];

/// Bodies, prepared: entries of a joint's frame that are zero or one cost nothing.
#[derive(Debug, Clone)]
pub(crate) struct Prepared(Vec<Step>);

#[derive(Debug, Clone)]
enum Step {
    Fixed([[f32; 3]; 4]),
    Moving(Moving),
}

#[derive(Debug, Clone)]
struct Moving {
    parent: usize,
    /// The axes of the joint at zero, in the parent.
    axes: Axes,
    /// The joint's origin in the parent [m].
    translation: [f32; 3],
    slides: bool,
    variable: usize,
    multiplier: f32,
    offset: f32,
}

/// The axes of a frame in another.
#[derive(Debug, Clone, Copy)]
enum Axes {
    /// Each is one of the other's axes, times 1 or -1.
    Permuted([(usize, f32); 3]),
    Any([[f32; 3]; 3]),
}

/// Components smaller than this are zero.
const SAME: f64 = 1e-9;

impl Axes {
    fn of(rotation: &[[f64; 3]; 3]) -> Self {
        let along = |v: &[f64; 3]| (0..3).find(|i| (0..3).all(|j| j == *i || v[j].abs() < SAME));
        match rotation.each_ref().map(along) {
            [Some(x), Some(y), Some(z)] => {
                let sign = |column: usize, i: usize| (i, if rotation[column][i] > 0.0 { 1.0 } else { -1.0 });
                Self::Permuted([sign(0, x), sign(1, y), sign(2, z)])
            }
            _ => Self::Any(rotation.map(single)),
        }
    }
}

impl Prepared {
    pub fn new(bodies: &[Body]) -> Self {
        let step = |body: &Body| match body {
            Body::Fixed(frame) => {
                let [x, y, z] = frame.rotation.map(single);
                Step::Fixed([x, y, z, single(frame.translation)])
            }
            Body::Moving { parent, joint } => Step::Moving(Moving {
                parent: *parent,
                axes: Axes::of(&joint.origin.rotation),
                translation: joint.origin.translation.map(|x| if x.abs() < SAME { 0.0 } else { x as f32 }),
                slides: joint.slides,
                variable: joint.variable,
                multiplier: joint.multiplier as f32,
                offset: joint.offset as f32,
            }),
        };
        Self(bodies.iter().map(step).collect())
    }
}

fn single(v: [f64; 3]) -> [f32; 3] {
    v.map(|x| x as f32)
}

/// Computes the frames of bodies. `q` has one entry per variable.
#[inline(always)]
pub(crate) fn forward<B: Block>(bodies: &Prepared, q: &[Lanes], frames: &mut [Frames]) {
    // All sines first, in place of two of the numbers to come: they do not wait for each other.
    for (i, step) in bodies.0.iter().enumerate() {
        if let Step::Moving(joint) = step {
            let position = B::load(&q[joint.variable]).mul_add(B::splat(joint.multiplier), B::splat(joint.offset));
            if joint.slides {
                position.store(&mut frames[i][0]);
            } else {
                let (sin, cos) = sin_cos(position);
                sin.store(&mut frames[i][0]);
                cos.store(&mut frames[i][1]);
            }
        }
    }
    for (i, step) in bodies.0.iter().enumerate() {
        let frame = match step {
            Step::Fixed([x, y, z, origin]) => [splat(x), splat(y), splat(z), splat(origin)],
            Step::Moving(joint) => {
                let (first, second) = (B::load(&frames[i][0]), B::load(&frames[i][1]));
                moved::<B>(&frames[joint.parent], joint, first, second)
            }
        };
        for c in 0..4 {
            for r in 0..3 {
                frame[c][r].store(&mut frames[i][3 * c + r]);
            }
        }
    }
}

/// Returns the frame of a body by that of its parent. `first` is its position if it slides; otherwise they are the sine
/// and the cosine.
#[inline(always)]
fn moved<B: Block>(parent: &Frames, joint: &Moving, first: B, second: B) -> Columns<B> {
    let mut origin = at::<B>(parent, 9);
    for k in 0..3 {
        if joint.translation[k] != 0.0 {
            let (t, axis) = (B::splat(joint.translation[k]), at::<B>(parent, 3 * k));
            for r in 0..3 {
                origin[r] = axis[r].mul_add(t, origin[r]);
            }
        }
    }
    let (x, y, z, signs) = match &joint.axes {
        Axes::Permuted([x, y, z]) => {
            let z_axis = at::<B>(parent, 3 * z.0);
            let sign = B::splat(z.1);
            let z_axis = [z_axis[0].mul(sign), z_axis[1].mul(sign), z_axis[2].mul(sign)];
            (at::<B>(parent, 3 * x.0), at::<B>(parent, 3 * y.0), z_axis, [B::splat(x.1), B::splat(y.1)])
        }
        Axes::Any([x, y, z]) => {
            let frame: Columns<B> = [at(parent, 0), at(parent, 3), at(parent, 6), at(parent, 9)];
            (turn(&frame, x), turn(&frame, y), turn(&frame, z), [B::splat(1.0); 2])
        }
    };
    if joint.slides {
        let slid = [z[0].mul_add(first, origin[0]), z[1].mul_add(first, origin[1]), z[2].mul_add(first, origin[2])];
        let x = [x[0].mul(signs[0]), x[1].mul(signs[0]), x[2].mul(signs[0])];
        let y = [y[0].mul(signs[1]), y[1].mul(signs[1]), y[2].mul(signs[1])];
        return [x, y, z, slid];
    }
    let (sin_x, cos_x) = (first.mul(signs[0]), second.mul(signs[0]));
    let (sin_y, cos_y) = (first.mul(signs[1]), second.mul(signs[1]));
    let turned_x = [
        x[0].mul_add(cos_x, y[0].mul(sin_y)),
        x[1].mul_add(cos_x, y[1].mul(sin_y)),
        x[2].mul_add(cos_x, y[2].mul(sin_y)),
    ];
    let turned_y = [
        x[0].neg_mul_add(sin_x, y[0].mul(cos_y)),
        x[1].neg_mul_add(sin_x, y[1].mul(cos_y)),
        x[2].neg_mul_add(sin_x, y[2].mul(cos_y)),
    ];
    [turned_x, turned_y, z, origin]
}

#[inline(always)]
fn splat<B: Block>(v: &[f32; 3]) -> [B; 3] {
    [B::splat(v[0]), B::splat(v[1]), B::splat(v[2])]
}

#[inline(always)]
fn at<B: Block>(frame: &Frames, from: usize) -> [B; 3] {
    [B::load(&frame[from]), B::load(&frame[from + 1]), B::load(&frame[from + 2])]
}

/// Turns a constant vector into the world.
#[inline(always)]
fn turn<B: Block>(frame: &Columns<B>, v: &[f32; 3]) -> [B; 3] {
    let (a, b, c) = (B::splat(v[0]), B::splat(v[1]), B::splat(v[2]));
    let [x, y, z, _] = frame;
    [
        x[0].mul_add(a, y[0].mul_add(b, z[0].mul(c))),
        x[1].mul_add(a, y[1].mul_add(b, z[1].mul(c))),
        x[2].mul_add(a, y[2].mul_add(b, z[2].mul(c))),
    ]
}

/// Returns a frame as it is seen from another: points of the one are then where they are for the other, at the cost of
/// one point each instead of two.
#[inline(always)]
pub(crate) fn seen_from<B: Block>(frame: &Frames, base: &Frames) -> Frames {
    let [x, y, z, origin] = [at::<B>(base, 0), at(base, 3), at(base, 6), at(base, 9)];
    let mut seen = [Lanes::splat(0.0); 12];
    for c in 0..4 {
        let mut v = at::<B>(frame, 3 * c);
        if c == 3 {
            v = [v[0].sub(origin[0]), v[1].sub(origin[1]), v[2].sub(origin[2])];
        }
        dot(&x, &v).store(&mut seen[3 * c]);
        dot(&y, &v).store(&mut seen[3 * c + 1]);
        dot(&z, &v).store(&mut seen[3 * c + 2]);
    }
    seen
}

#[inline(always)]
fn dot<B: Block>(u: &[B; 3], v: &[B; 3]) -> B {
    u[0].mul_add(v[0], u[1].mul_add(v[1], u[2].mul(v[2])))
}

/// Returns a constant point of `frame` if it is carried by that, otherwise the point itself.
#[inline(always)]
pub(crate) fn carried<B: Block>(carries: bool, frame: &Frames, p: &[f32; 3]) -> [B; 3] {
    if carries { point(frame, p) } else { splat(p) }
}

/// Returns the square of the distance of two points.
#[inline(always)]
pub(crate) fn between<B: Block>(p: &[B; 3], q: &[B; 3]) -> B {
    let d = [p[0].sub(q[0]), p[1].sub(q[1]), p[2].sub(q[2])];
    dot(&d, &d)
}

/// Returns a constant point of a body in the world.
#[inline(always)]
pub(crate) fn point<B: Block>(frame: &Frames, p: &[f32; 3]) -> [B; 3] {
    let (a, b, c) = (B::splat(p[0]), B::splat(p[1]), B::splat(p[2]));
    let [x, y, z, origin] = [at::<B>(frame, 0), at(frame, 3), at(frame, 6), at(frame, 9)];
    [
        x[0].mul_add(a, y[0].mul_add(b, z[0].mul_add(c, origin[0]))),
        x[1].mul_add(a, y[1].mul_add(b, z[1].mul_add(c, origin[1]))),
        x[2].mul_add(a, y[2].mul_add(b, z[2].mul_add(c, origin[2]))),
    ]
}
