//! How near is too near: by a padding, and between samples of a motion by what may be in between.

use super::{Motion, Proof};

/// How much nearer than their radii balls count as touching; `SWEPT`: also between samples.
#[derive(Debug, Clone, Copy)]
pub(super) struct Gap<const SWEPT: bool> {
    /// Padding and bulge [m].
    pub more: f32,
    /// Square of half of a chord [m²].
    pub squared: f32,
    /// Padding, without the rest [m].
    pub pad: f32,
    pub rounding: f32,
}

impl<const SWEPT: bool> Gap<SWEPT> {
    #[inline(always)]
    pub fn new(pad: f32, reach: f32, steps: &Steps<SWEPT>) -> Self {
        if !SWEPT {
            return Self { more: pad, squared: 0.0, pad, rounding: steps.rounding };
        }
        let chord = reach * steps.part;
        // The second derivative of a place is at most twice the product of what turns and what moves.
        let bulge = 0.25 * steps.turn * chord;
        Self { more: pad + bulge, squared: 0.25 * chord * chord, pad, rounding: steps.rounding }
    }

    /// Returns the distance below which a ball touches.
    #[inline(always)]
    pub fn distance(&self, radius: f32) -> f32 {
        let radius = radius + self.more;
        // The root is slow.
        let swept = if SWEPT { radius.mul_add(radius, self.squared).sqrt() } else { radius };
        swept + self.rounding
    }

    /// Returns its square.
    #[inline(always)]
    pub fn squared(&self, radius: f32) -> f32 {
        let distance = self.distance(radius);
        distance * distance
    }

    #[inline(always)]
    pub fn more(&self, radius: f32) -> Self {
        Self { more: self.more + radius, pad: self.pad + radius, ..*self }
    }
}

/// The steps between samples; `SWEPT`: the motion between them counts.
#[derive(Debug, Clone, Copy)]
pub(super) struct Steps<const SWEPT: bool> {
    /// The part of the motion between two samples.
    pub part: f32,
    /// The sum of the angles by which the joints turn on it [rad].
    pub turn: f32,
    pub rounding: f32,
}

#[inline(always)]
pub(super) fn reach_of(motion: &Motion<'_>, pair: u32) -> f32 {
    match motion.proof {
        Proof::Motion { reach, part, .. } => (reach[pair as usize] * part) as f32,
        _ => 0.0,
    }
}

#[inline(always)]
pub(super) fn gap_of<const SWEPT: bool>(motion: &Motion<'_>, pair: u32, steps: &Steps<SWEPT>) -> Gap<SWEPT> {
    let reach = if SWEPT { reach_of(motion, pair) } else { 0.0 };
    Gap::new(motion.pads[pair as usize] as f32, reach, steps)
}
