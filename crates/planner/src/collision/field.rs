//! How deep points are within meshes, whether or not they are closed. A grid of cells is flooded from outside; what is
//! not reached, past the cells that surfaces pass, is inside. Gaps narrower than a cell let nothing in, so that a mesh
//! with cracks has an inside, and so has what several meshes enclose together. What is open, as links often are where
//! they meet, is hollow: it counts for the choice of a cover, but nothing touches there. The depth is the distance
//! from what was flooded, so that surfaces within the solid do not count.

use dimos_kernels::cover::Depth;
use glamx::DVec3;

use super::distance_transform::distances;
use super::triangles::{Triangle, Triangles};

/// Size of a cell, at least [m] …
const CELL: f64 = 1.5e-3;
/// … and so that the longest side of the mesh has at most this many.
const MOST: f64 = 160.0;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Cell {
    /// Not reached from outside.
    Inside,
    /// The same, but through a wide opening: it is hollow, so that what is there touches nothing.
    Hollow,
    /// The surface passes it.
    Surface,
    Outside,
}

/// The field of meshes.
#[derive(Debug)]
pub(super) struct Field<'a> {
    triangles: &'a Triangles,
    /// Distance of the middle of each cell from that of the nearest one outside [cells].
    distances: Vec<f32>,
    low: DVec3,
    size: f64,
    number: [usize; 3],
    cells: Vec<Cell>,
}

/// Openings narrower than twice this let nothing in where meshes would have no inside otherwise [m]: links are often
/// open where they meet.
const OPENING: f64 = 0.04;
/// Size of a cell of that flood, at least [m].
const COARSE: f64 = 2.5e-3;

impl<'a> Field<'a> {
    /// Floods a grid around triangles.
    pub fn new(triangles: &'a Triangles) -> Self {
        let mut made = Self::marked(triangles, CELL, 1.5);
        made.flood(|_| true);
        if !made.cells.contains(&Cell::Inside) {
            // As far as balls of that radius get from outside.
            let reach = OPENING / size_of(triangles, COARSE);
            made = Self::marked(triangles, COARSE, reach + 2.5);
            let gaps = distances(made.number, |cell| made.cells[cell] == Cell::Surface);
            made.flood(|cell| f64::from(gaps[cell]) > reach);
            let away = distances(made.number, |cell| made.cells[cell] == Cell::Outside);
            for (cell, away) in made.cells.iter_mut().zip(&away) {
                if *cell == Cell::Inside {
                    *cell = if f64::from(*away) > reach { Cell::Hollow } else { Cell::Outside };
                }
            }
        }
        made.distances = distances(made.number, |cell| made.cells[cell] == Cell::Outside);
        made
    }

    /// Marks the surface in cells of at least a size; `beyond`: cells beyond the triangles, for the flood.
    fn marked(triangles: &'a Triangles, least: f64, beyond: f64) -> Self {
        let (middle, half) = triangles.bounds();
        let size = size_of(triangles, least);
        let low = middle - half - DVec3::splat(beyond * size);
        let number = (half * (2.0 / size)).to_array().map(|cells| (cells + 2.0 * beyond).ceil() as usize + 1);
        let cells = vec![Cell::Inside; number.iter().product()];
        let mut made = Self { triangles, distances: Vec::new(), low, size, number, cells };
        for triangle in triangles.all() {
            made.mark(*triangle);
        }
        made
    }

    fn place(&self, p: DVec3) -> Option<[usize; 3]> {
        let at = ((p - self.low) / self.size).floor();
        let fits = |i: usize| at[i] >= 0.0 && at[i] < self.number[i] as f64;
        (fits(0) && fits(1) && fits(2)).then_some([at.x as usize, at.y as usize, at.z as usize])
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

    /// Floods the cells that are open, from a corner of the grid on.
    fn flood(&mut self, is_open: impl Fn(usize) -> bool) {
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
                    if self.cells[index] == Cell::Inside && is_open(index) {
                        self.cells[index] = Cell::Outside;
                        open.push(next);
                    }
                }
            }
        }
    }

    fn cell(&self, p: DVec3) -> Cell {
        self.place(p).map_or(Cell::Outside, |place| self.cells[self.index(place)])
    }
}

fn size_of(triangles: &Triangles, least: f64) -> f64 {
    (2.0 * triangles.bounds().1.max_element() / MOST).max(least)
}

impl Depth for Field<'_> {
    fn depth(&self, p: [f64; 3]) -> (f64, [f64; 3]) {
        // Between the middles of eight cells.
        let at = (DVec3::from_array(p) - self.low) / self.size - DVec3::splat(0.5);
        let Some([x, y, z]) = self.place(self.low + at * self.size) else { return (0.0, [0.0; 3]) };
        if x + 1 >= self.number[0] || y + 1 >= self.number[1] || z + 1 >= self.number[2] {
            return (0.0, [0.0; 3]);
        }
        let part = at - at.floor();
        let (mut depth, mut slope) = (0.0, DVec3::ZERO);
        for corner in 0..8 {
            let up = [corner & 1, corner >> 1 & 1, corner >> 2 & 1];
            let value = f64::from(self.distances[self.index([x + up[0], y + up[1], z + up[2]])]);
            let (mut weight, mut sign) = ([0.0; 3], [0.0; 3]);
            for axis in 0..3 {
                (weight[axis], sign[axis]) = if up[axis] == 1 { (part[axis], 1.0) } else { (1.0 - part[axis], -1.0) };
            }
            depth += value * weight[0] * weight[1] * weight[2];
            slope.x += value * sign[0] * weight[1] * weight[2];
            slope.y += value * sign[1] * weight[0] * weight[2];
            slope.z += value * sign[2] * weight[0] * weight[1];
        }
        (depth * self.size, (-slope).normalize_or_zero().to_array())
    }

    fn proven(&self, p: [f64; 3]) -> f64 {
        let p = DVec3::from_array(p);
        if self.cell(p) == Cell::Inside { self.triangles.closest(p).distance(p) } else { -1.0 }
    }

    fn may_be_inside(&self, p: [f64; 3]) -> bool {
        self.cell(DVec3::from_array(p)) != Cell::Outside
    }
}

#[cfg(test)]
mod tests {
    use super::super::outline::outline;
    use super::super::shape::Core;
    use super::*;

    /// A box of these half extents without its lid.
    fn without_lid(half: DVec3) -> Triangles {
        let whole = outline(&Core::Box { half }).unwrap().into_iter();
        Triangles::new(whole.filter(|t| t.iter().any(|p| p.z < 0.9 * half.z)))
    }

    #[test]
    fn a_box_with_a_crack_has_an_inside() {
        let whole = outline(&Core::Box { half: DVec3::new(0.03, 0.04, 0.05) }).unwrap().into_iter();
        let cracked = whole.map(|t| t.map(|p| p + DVec3::X * if p.x < 0.0 { -2e-4 } else { 0.0 }));
        let triangles = Triangles::new(cracked);
        let field = Field::new(&triangles);
        let within = [0.02, 0.01, 0.0];
        let (depth, outwards) = field.depth(within);
        assert!(field.may_be_inside(within) && (depth - 0.01).abs() < 2.0 * CELL && outwards[0] > 0.99, "{depth}");
        assert!((field.proven(within) - 0.01).abs() < 1e-9);
        for outside in [[0.036, 0.0, 0.0], [0.0, 1.0, 0.0], [0.1; 3]] {
            assert!(field.depth(outside).0 == 0.0 && field.proven(outside) < 0.0, "{outside:?}");
            assert!(!field.may_be_inside(outside), "{outside:?}");
        }
    }

    #[test]
    fn a_narrow_box_without_a_lid_is_hollow_and_a_wide_one_is_nothing_but_its_surface() {
        let triangles = without_lid(DVec3::new(0.03, 0.03, 0.1));
        let field = Field::new(&triangles);
        let within = [0.0, 0.01, -0.02];
        // A cover is chosen as if it was solid, but nothing touches within.
        assert!(field.may_be_inside(within) && field.proven(within) < 0.0);
        assert!((field.depth(within).0 - 0.02).abs() < 3.0 * COARSE, "{:?}", field.depth(within));
        let triangles = without_lid(DVec3::new(0.1, 0.1, 0.1));
        let field = Field::new(&triangles);
        assert!(!field.may_be_inside([0.0; 3]) && field.depth([0.0; 3]).0 == 0.0 && field.proven([0.0; 3]) < 0.0);
    }
}
