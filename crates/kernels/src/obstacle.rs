//! Squared distances from points to the cores of obstacles.

use std::sync::Arc;

use crate::block::Block;
use crate::chain::Frame;
use crate::cover::Tree;

/// Everything within `radius` of a core that is fixed in the world.
#[derive(Debug, Clone, PartialEq)]
pub struct Obstacle {
    /// The core.
    pub core: Core,
    /// Distance from the core to the surface [m].
    pub radius: f64,
}

/// The core of an obstacle.
#[derive(Debug, Clone, PartialEq)]
pub enum Core {
    /// A box; also a point or a segment, with no extent across.
    Box {
        /// Its frame.
        frame: Frame,
        /// Half extents [m].
        half: [f64; 3],
    },
    /// A cylinder along z.
    Cylinder {
        /// Its frame.
        frame: Frame,
        /// Half length [m].
        half: f64,
        /// Radius [m].
        radius: f64,
    },
    /// Anything else: its cover, which is carried by a body that is fixed.
    Cover {
        /// Index of the body.
        body: usize,
        /// The balls.
        tree: Arc<Tree>,
        /// The farthest that any of them gets from the origin of the world [m].
        extent: f64,
    },
}

impl Obstacle {
    /// Returns the farthest that any of its points gets from the origin of the world, at most [m].
    pub(crate) fn extent(&self) -> f64 {
        let far = |frame: &Frame| frame.translation.iter().map(|x| x.abs()).sum::<f64>();
        let core = match &self.core {
            Core::Box { frame, half } => far(frame) + half.iter().sum::<f64>(),
            Core::Cylinder { frame, half, radius } => far(frame) + half + radius,
            Core::Cover { extent, .. } => *extent,
        };
        core + self.radius
    }
}

/// A frame in single precision, for points that are turned into it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Placed {
    columns: [[f32; 3]; 3],
    origin: [f32; 3],
}

impl Placed {
    pub fn new(frame: &Frame) -> Self {
        let single = |v: &[f64; 3]| [v[0] as f32, v[1] as f32, v[2] as f32];
        let [x, y, z] = &frame.rotation;
        Self { columns: [single(x), single(y), single(z)], origin: single(&frame.translation) }
    }

    /// Returns the same frame, with its origin at a point of it.
    pub fn moved(&self, p: [f32; 3]) -> Self {
        let [x, y, z] = &self.columns;
        let origin = [0, 1, 2].map(|i| self.origin[i] + x[i] * p[0] + y[i] * p[1] + z[i] * p[2]);
        Self { origin, ..*self }
    }

    /// Returns the box in the world around a box in this frame and all within a radius of it: its corners, a little
    /// outside.
    pub fn bounds(&self, half: [f32; 3], radius: f32) -> ([f32; 3], [f32; 3]) {
        let [x, y, z] = &self.columns;
        let reach = [0, 1, 2].map(|i| {
            let most = x[i].abs() * half[0] + y[i].abs() * half[1] + z[i].abs() * half[2] + radius;
            most + 1e-6 * (most + self.origin[i].abs())
        });
        ([0, 1, 2].map(|i| self.origin[i] - reach[i]), [0, 1, 2].map(|i| self.origin[i] + reach[i]))
    }

    #[inline(always)]
    fn local<B: Block>(&self, p: &[B; 3]) -> [B; 3] {
        let [x, y, z] = &self.columns;
        let d = [
            p[0].sub(B::splat(self.origin[0])),
            p[1].sub(B::splat(self.origin[1])),
            p[2].sub(B::splat(self.origin[2])),
        ];
        [dot(x, &d), dot(y, &d), dot(z, &d)]
    }
}

#[inline(always)]
fn dot<B: Block>(a: &[f32; 3], b: &[B; 3]) -> B {
    b[0].mul_add(B::splat(a[0]), b[1].mul_add(B::splat(a[1]), b[2].mul(B::splat(a[2]))))
}

/// A shape with a distance from points. No closures here: they are functions of their own, without the vectors of the
/// kernel that calls them.
pub(crate) trait Squared {
    /// Returns the squared distance of points.
    fn squared<B: Block>(&self, p: &[B; 3]) -> B;
}

/// The core of an obstacle that is a box.
#[derive(Debug, Clone, Copy)]
pub(crate) struct BoxCore {
    pub placed: Placed,
    pub half: [f32; 3],
}

impl Squared for BoxCore {
    #[inline(always)]
    fn squared<B: Block>(&self, p: &[B; 3]) -> B {
        let [x, y, z] = self.placed.local(p);
        let zero = B::splat(0.0);
        let x = x.abs().sub(B::splat(self.half[0])).max(zero);
        let y = y.abs().sub(B::splat(self.half[1])).max(zero);
        let z = z.abs().sub(B::splat(self.half[2])).max(zero);
        x.mul_add(x, y.mul_add(y, z.mul(z)))
    }
}

/// The core of an obstacle that is a cylinder.
#[derive(Debug, Clone, Copy)]
pub(crate) struct CylinderCore {
    pub placed: Placed,
    pub half: f32,
    pub radius: f32,
}

impl Squared for CylinderCore {
    #[inline(always)]
    fn squared<B: Block>(&self, p: &[B; 3]) -> B {
        let [x, y, z] = self.placed.local(p);
        let zero = B::splat(0.0);
        let radial = x.mul_add(x, y.mul(y)).sqrt().sub(B::splat(self.radius)).max(zero);
        let z = z.abs().sub(B::splat(self.half)).max(zero);
        radial.mul_add(radial, z.mul(z))
    }
}
