//! How deep points are within a mesh, whether or not it is closed. A grid of cells is flooded from outside; what is not
//! reached, past the cells that the surface passes, is inside. Gaps narrower than a cell let nothing in, so that a mesh
//! with cracks has an inside; one that is open has none.

use dimos_kernels::cover::Depth;
use glamx::DVec3;

use super::triangles::{Triangle, Triangles};

/// Size of a cell, at least [m] …
const CELL: f64 = 1.5e-3;
/// … and so that the longest side of the mesh has at most this many.
const MOST: f64 = 160.0;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Cell {
    /// Not reached from outside.
    Inside,
    /// The surface passes it.
    Surface,
    Outside,
}

/// The field of a mesh.
#[derive(Debug)]
pub(super) struct Field<'a> {
    triangles: &'a Triangles,
    low: DVec3,
    size: f64,
    number: [usize; 3],
    cells: Vec<Cell>,
}

impl<'a> Field<'a> {
    /// Floods a grid around triangles.
    pub fn new(triangles: &'a Triangles) -> Self {
        let (middle, half) = triangles.bounds();
        let size = (2.0 * half.max_element() / MOST).max(CELL);
        // One more on each side, for the flood.
        let low = middle - half - DVec3::splat(1.5 * size);
        let number = (half * (2.0 / size)).to_array().map(|cells| cells.ceil() as usize + 3);
        let cells = vec![Cell::Inside; number.iter().product()];
        let mut made = Self { triangles, low, size, number, cells };
        for triangle in triangles.all() {
            made.mark(*triangle);
        }
        made.flood();
        made
    }

    fn place(&self, p: DVec3) -> Option<[usize; 3]> {
        let at = ((p - self.low) / self.size).floor();
        let fits = |i: usize| at[i] >= 0.0 && at[i] < self.number[i] as f64;
        (fits(0) && fits(1) && fits(2)).then(|| [at.x as usize, at.y as usize, at.z as usize])
    }

    fn index(&self, [x, y, z]: [usize; 3]) -> usize {
        (x * self.number[1] + y) * self.number[2] + z
    }

    /// Marks the cells that a triangle may pass: those of the boxes around its parts, which are no larger than a cell.
    fn mark(&mut self, triangle: Triangle) {
        let mut open = vec![triangle];
        while let Some(corners) = open.pop() {
            let edge = |i: usize| corners[i].distance_squared(corners[(i + 1) % 3]);
            let longest = (0..3).max_by(|i, j| edge(*i).total_cmp(&edge(*j))).unwrap_or(0);
            if edge(longest) > self.size * self.size {
                let [a, b, c] = [0, 1, 2].map(|i| corners[(longest + i) % 3]);
                let middle = 0.5 * (a + b);
                open.extend([[a, middle, c], [middle, b, c]]);
                continue;
            }
            let (low, high) = corners.iter().fold((corners[0], corners[0]), |(l, h), p| (l.min(*p), h.max(*p)));
            let (Some(low), Some(high)) = (self.place(low), self.place(high)) else { continue };
            for x in low[0]..=high[0] {
                for y in low[1]..=high[1] {
                    for z in low[2]..=high[2] {
                        let at = self.index([x, y, z]);
                        self.cells[at] = Cell::Surface;
                    }
                }
            }
        }
    }

    fn flood(&mut self) {
        let mut open = vec![[0, 0, 0]];
        self.cells[0] = Cell::Outside;
        while let Some(at) = open.pop() {
            for axis in 0..3 {
                for up in [false, true] {
                    let mut next = at;
                    match up {
                        true if at[axis] + 1 < self.number[axis] => next[axis] += 1,
                        false if at[axis] > 0 => next[axis] -= 1,
                        _ => continue,
                    }
                    let index = self.index(next);
                    if self.cells[index] == Cell::Inside {
                        self.cells[index] = Cell::Outside;
                        open.push(next);
                    }
                }
            }
        }
    }

    /// Returns how deep a point is inside. In the cells that the surface passes it counts as outside.
    pub fn depth(&self, p: DVec3) -> Depth {
        let cell = self.place(p).map_or(Cell::Outside, |place| self.cells[self.index(place)]);
        let away = self.triangles.closest(p) - p;
        let sign = if cell == Cell::Inside { 1.0 } else { -1.0 };
        let outwards = (away * sign).normalize_or_zero().to_array();
        Depth { depth: sign * away.length(), outwards, may_be_inside: cell != Cell::Outside }
    }
}

#[cfg(test)]
mod tests {
    use super::super::outline::outline;
    use super::super::shape::Core;
    use super::*;

    #[test]
    fn a_box_with_a_crack_has_an_inside_and_one_without_a_lid_has_none() {
        let half = DVec3::new(0.03, 0.04, 0.05);
        let whole = outline(&Core::Box { half }).unwrap();
        let cracked = whole.iter().map(|t| t.map(|p| p + DVec3::X * if p.x < 0.0 { -2e-4 } else { 0.0 }));
        let open = whole.iter().copied().filter(|t| t.iter().any(|p| p.z < 0.04));
        for (kind, triangles) in [(true, Triangles::new(cracked)), (false, Triangles::new(open))] {
            let field = Field::new(&triangles);
            let Depth { depth, outwards, may_be_inside } = field.depth(DVec3::new(0.02, 0.01, 0.0));
            assert_eq!(may_be_inside, kind);
            assert!((depth.abs() - 0.01).abs() < 1e-9 && (depth > 0.0) == kind, "{depth}");
            assert!(!kind || (outwards[0] - 1.0).abs() < 1e-9, "{outwards:?}");
            for outside in [DVec3::X * 0.036, DVec3::Y, DVec3::new(0.1, 0.1, 0.1)] {
                let Depth { depth, may_be_inside, .. } = field.depth(outside);
                assert!(depth < 0.0 && !may_be_inside, "{outside}");
            }
        }
    }
}
