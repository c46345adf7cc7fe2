//! Solids of revolution: what a link sweeps while the joint at its end turns all the way round. It is a stack of disks
//! about the joint's axis, each as wide as the farthest point of the link at that height.

use glamx::{DAffine3, DVec3};

use super::outline::outline;
use super::pairs::{Placed, general};
use super::shape::Solid;

/// Height of a disk [m]: what a step of the link's outline is blurred by along the axis.
const HEIGHT: f64 = 2.5e-4;
/// Most disks.
const MOST: usize = 2048;

/// A stack of disks, as a binary tree: its ranges of disks, each within one wider disk.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Revolved {
    nodes: Vec<Disk>,
}

/// Everything between two heights of the axis and within a radius of it [m].
#[derive(Debug, Clone, Copy, PartialEq)]
struct Disk {
    low: f64,
    high: f64,
    radius: f64,
    /// Index of the first of its two halves; 0: none.
    first: usize,
}

impl Disk {
    fn size(&self) -> f64 {
        (self.high - self.low).hypot(self.radius)
    }

    fn placed(&self, axis: &DAffine3) -> Placed<'static> {
        let middle = axis.transform_point3(DVec3::Z * (0.5 * (self.low + self.high)));
        let frame = DAffine3 { matrix3: axis.matrix3, translation: middle };
        Placed::Cylinder(frame, 0.5 * (self.high - self.low), self.radius)
    }
}

impl Revolved {
    /// Revolves solids about the z axis of a frame; `None` if they have no outline, as clouds.
    pub fn new(solids: &[Solid], axis: &DAffine3) -> Option<Self> {
        let into = axis.inverse();
        let mut outlines = Vec::new();
        for solid in solids {
            let place = into * solid.frame;
            let triangles = outline(&solid.core)?.into_iter().map(|corners| corners.map(|p| place.transform_point3(p)));
            outlines.push((triangles.collect::<Vec<_>>(), solid.radius));
        }
        let ends = |(triangles, more): &(Vec<[DVec3; 3]>, f64)| {
            let heights = triangles.iter().flatten().map(|p| p.z);
            let (low, high) = heights.fold((f64::MAX, f64::MIN), |(low, high), z| (low.min(z), high.max(z)));
            (low - more, high + more)
        };
        let all = outlines.iter().map(ends);
        let (low, high) = all.fold((f64::MAX, f64::MIN), |(low, high), (a, b)| (low.min(a), high.max(b)));
        if low > high {
            return None;
        }
        let number = (((high - low) / HEIGHT).ceil() as usize).clamp(1, MOST);
        let height = ((high - low) / number as f64).max(1e-9);
        let mut radii = vec![-1.0_f64; number];
        for (triangles, more) in &outlines {
            for corners in triangles {
                widen(&mut radii, corners, (low, height), *more);
            }
        }
        let disks: Vec<Disk> = radii
            .iter()
            .enumerate()
            .filter(|(_, radius)| **radius >= 0.0)
            .map(|(i, radius)| {
                let low = low + i as f64 * height;
                Disk { low, high: low + height, radius: *radius, first: 0 }
            })
            .collect();
        let mut nodes = vec![around(&disks)?];
        split(&disks, 0, &mut nodes);
        Some(Self { nodes })
    }

    /// Returns a ball around all, in the frame of the axis: its height on it, and its radius [m].
    pub fn ball(&self) -> (f64, f64) {
        let Disk { low, high, radius, .. } = self.nodes[0];
        (0.5 * (low + high), (0.5 * (high - low)).hypot(radius))
    }

    /// Returns whether two of them, each about its axis, are proven farther apart than `reach` [m]. Every pair of
    /// disks that is compared takes one from `budget`; once that is spent, nothing is proven.
    pub fn is_apart(&self, at: &DAffine3, other: &Self, other_at: &DAffine3, reach: f64, budget: &mut usize) -> bool {
        let mut open = vec![(0, 0)];
        while let Some((i, j)) = open.pop() {
            let (one, two) = (&self.nodes[i], &other.nodes[j]);
            if *budget == 0 {
                return false;
            }
            *budget -= 1;
            if !general::within(&one.placed(at), &two.placed(other_at), reach) {
                continue;
            }
            match (one.first, two.first) {
                (0, 0) => return false,
                (first, second) if second == 0 || (first != 0 && one.size() >= two.size()) => {
                    open.extend([(first, j), (first + 1, j)]);
                }
                (_, second) => open.extend([(i, second), (i, second + 1)]),
            }
        }
        true
    }
}

/// Widens the disks that a triangle, and all within `more` of it, reaches.
fn widen(radii: &mut [f64], corners: &[DVec3; 3], (low, height): (f64, f64), more: f64) {
    let heights = corners.map(|p| p.z);
    let bottom = heights.iter().copied().fold(f64::MAX, f64::min) - more;
    let top = heights.iter().copied().fold(f64::MIN, f64::max) + more;
    let place = |z: f64| ((z - low) / height).floor().max(0.0) as usize;
    let last = radii.len() - 1;
    // Rounding moves no point into the disk beside it.
    let (first, end) = (place(bottom - 1e-12).min(last), place(top + 1e-12).min(last));
    for (i, radius) in radii.iter_mut().enumerate().take(end + 1).skip(first) {
        let bottom = low + i as f64 * height - more;
        let farthest = farthest_between(corners, bottom - 1e-12, bottom + height + 2.0 * more + 1e-12);
        *radius = radius.max(farthest + more);
    }
}

/// Returns the distance from the z axis of the farthest point of a triangle between two heights; the distance is
/// convex, so that it is largest at a corner of that part. Negative if there is no such point.
fn farthest_between(corners: &[DVec3; 3], bottom: f64, top: f64) -> f64 {
    let mut most = f64::NEG_INFINITY;
    let mut see = |p: DVec3| most = f64::max(most, p.x.hypot(p.y));
    for (i, a) in corners.iter().enumerate() {
        let b = corners[(i + 1) % 3];
        if (bottom..=top).contains(&a.z) {
            see(*a);
        }
        for height in [bottom, top] {
            if (a.z - height) * (b.z - height) < 0.0 {
                see(*a + (b - *a) * ((height - a.z) / (b.z - a.z)));
            }
        }
    }
    most
}

fn around(disks: &[Disk]) -> Option<Disk> {
    let radius = disks.iter().map(|disk| disk.radius).fold(0.0, f64::max);
    Some(Disk { low: disks.first()?.low, high: disks.last()?.high, radius, first: 0 })
}

fn split(disks: &[Disk], at: usize, nodes: &mut Vec<Disk>) {
    if disks.len() < 2 {
        return;
    }
    let (left, right) = disks.split_at(disks.len() / 2);
    let first = nodes.len();
    nodes[at].first = first;
    nodes.extend(around(left).into_iter().chain(around(right)));
    split(left, first, nodes);
    split(right, first + 1, nodes);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cuboid(x: f64, y: f64, z: f64, at: DVec3) -> Solid {
        Solid::cuboid(DVec3::new(x, y, z), DAffine3::from_translation(at)).unwrap()
    }

    #[test]
    fn a_box_beside_the_axis_sweeps_a_disk() {
        let solids = [cuboid(0.2, 0.1, 0.04, DVec3::new(0.3, 0.0, 0.5))];
        let swept = Revolved::new(&solids, &DAffine3::IDENTITY).unwrap();
        let radius = 0.4_f64.hypot(0.05);
        assert!((swept.nodes[0].radius - radius).abs() < 1e-9 && (swept.nodes[0].low - 0.48).abs() < 1e-9);
        let above = Revolved::new(&[cuboid(0.1, 0.1, 0.1, DVec3::Z * 0.0505)], &DAffine3::IDENTITY).unwrap();
        // From 0.52 on: the gap is 0.5 mm.
        let at = |z: f64| DAffine3::from_translation(DVec3::Z * z);
        let apart = |z: f64, reach: f64| swept.is_apart(&DAffine3::IDENTITY, &above, &at(z), reach, &mut 100_000);
        assert!(apart(0.52, 4.9e-4) && !apart(0.52, 5.1e-4) && !apart(0.5, 0.0));
        // Nothing is proven without a budget.
        assert!(!swept.is_apart(&DAffine3::IDENTITY, &above, &at(2.0), 0.1, &mut 0));
    }

    #[test]
    fn padding_widens_a_disk_on_all_sides() {
        let ball = [Solid::capsule(0.05, 0.2, DAffine3::IDENTITY).unwrap()];
        let swept = Revolved::new(&ball, &DAffine3::IDENTITY).unwrap();
        let Disk { low, high, radius, .. } = swept.nodes[0];
        assert!((low + 0.15).abs() < 1e-9 && (high - 0.15).abs() < 1e-9 && (radius - 0.05).abs() < 1e-9);
    }
}
