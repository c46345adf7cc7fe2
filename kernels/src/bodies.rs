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

/// Computes the frames of bodies. `q` has one entry per variable.
#[inline(always)]
pub(crate) fn forward<B: Block>(bodies: &[Body], q: &[Lanes], frames: &mut [Frames]) {
    for (i, body) in bodies.iter().enumerate() {
        let frame = match body {
            Body::Fixed(frame) => fixed::<B>(frame),
            Body::Moving { parent, joint } => moved::<B>(&frames[*parent], joint, &q[joint.variable]),
        };
        for c in 0..4 {
            for r in 0..3 {
                frame[c][r].store(&mut frames[i][3 * c + r]);
            }
        }
    }
}

#[inline(always)]
fn fixed<B: Block>(frame: &Frame) -> Columns<B> {
    let [x, y, z] = &frame.rotation;
    [splat(x), splat(y), splat(z), splat(&frame.translation)]
}

#[inline(always)]
fn moved<B: Block>(parent: &Frames, joint: &Joint, q: &Lanes) -> Columns<B> {
    let parent: Columns<B> = [at(parent, 0), at(parent, 3), at(parent, 6), at(parent, 9)];
    let [x, y, z] = &joint.origin.rotation;
    let (x, y, z) = (turn(&parent, x), turn(&parent, y), turn(&parent, z));
    let origin = turn(&parent, &joint.origin.translation);
    let origin = [origin[0].add(parent[3][0]), origin[1].add(parent[3][1]), origin[2].add(parent[3][2])];
    let position = B::load(q).mul_add(B::splat(joint.multiplier as f32), B::splat(joint.offset as f32));
    if joint.slides {
        let slid =
            [z[0].mul_add(position, origin[0]), z[1].mul_add(position, origin[1]), z[2].mul_add(position, origin[2])];
        return [x, y, z, slid];
    }
    let (sin, cos) = sin_cos(position);
    let turned_x =
        [x[0].mul_add(cos, y[0].mul(sin)), x[1].mul_add(cos, y[1].mul(sin)), x[2].mul_add(cos, y[2].mul(sin))];
    let turned_y = [
        x[0].neg_mul_add(sin, y[0].mul(cos)),
        x[1].neg_mul_add(sin, y[1].mul(cos)),
        x[2].neg_mul_add(sin, y[2].mul(cos)),
    ];
    [turned_x, turned_y, z, origin]
}

#[inline(always)]
fn splat<B: Block>(v: &[f64; 3]) -> [B; 3] {
    [B::splat(v[0] as f32), B::splat(v[1] as f32), B::splat(v[2] as f32)]
}

#[inline(always)]
fn at<B: Block>(frame: &Frames, from: usize) -> [B; 3] {
    [B::load(&frame[from]), B::load(&frame[from + 1]), B::load(&frame[from + 2])]
}

/// Turns a constant vector into the world.
#[inline(always)]
fn turn<B: Block>(frame: &Columns<B>, v: &[f64; 3]) -> [B; 3] {
    let (a, b, c) = (B::splat(v[0] as f32), B::splat(v[1] as f32), B::splat(v[2] as f32));
    let [x, y, z, _] = frame;
    [
        x[0].mul_add(a, y[0].mul_add(b, z[0].mul(c))),
        x[1].mul_add(a, y[1].mul_add(b, z[1].mul(c))),
        x[2].mul_add(a, y[2].mul_add(b, z[2].mul(c))),
    ]
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
