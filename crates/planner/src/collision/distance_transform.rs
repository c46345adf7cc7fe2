//! Distance of each cell of a grid from the nearest marked one, an axis at a time (Felzenszwalb and Huttenlocher,
//! "Distance transforms of sampled functions", 2012).

/// More than any squared distance [cells²]; exact, as all squared distances are.
const FAR: f32 = 4e6;

/// Returns the distance of the middle of each cell from that of the nearest marked one [cells]. `number`: cells along
/// each axis; the last one is that of neighbours in memory.
pub(super) fn distances(number: [usize; 3], is_marked: impl Fn(usize) -> bool) -> Vec<f32> {
    let [x, y, z] = number;
    let mut all: Vec<f32> = (0..x * y * z).map(|cell| if is_marked(cell) { 0.0 } else { FAR }).collect();
    let mut line = Line::default();
    for (length, stride) in [(z, 1), (y, z), (x, y * z)] {
        for first in (0..all.len()).filter(|cell| cell / stride % length == 0) {
            line.transform(&mut all, first, (length, stride));
        }
    }
    all.iter_mut().for_each(|squared| *squared = squared.sqrt());
    all
}

/// Buffers for a line of cells: parabolas, the lower envelope of which is the result.
#[derive(Debug, Default)]
struct Line {
    values: Vec<f32>,
    /// Cells of the envelope's parabolas.
    lowest: Vec<usize>,
    /// Where each of them begins.
    begins: Vec<f32>,
}

impl Line {
    fn transform(&mut self, all: &mut [f32], first: usize, (length, stride): (usize, usize)) {
        self.values.clear();
        self.values.extend((0..length).map(|i| all[first + i * stride]));
        if self.values.iter().all(|value| *value == 0.0) {
            return;
        }
        self.lowest.clear();
        self.begins.clear();
        for (at, value) in self.values.iter().enumerate().filter(|(_, value)| **value < FAR) {
            let height = |at: usize, value: f32| value + (at * at) as f32;
            let mut begin = f32::NEG_INFINITY;
            while let (Some(&last), Some(&since)) = (self.lowest.last(), self.begins.last()) {
                begin = (height(at, *value) - height(last, self.values[last])) / (2 * (at - last)) as f32;
                if begin > since {
                    break;
                }
                self.lowest.pop();
                self.begins.pop();
                begin = f32::NEG_INFINITY;
            }
            self.lowest.push(at);
            self.begins.push(begin);
        }
        let mut part = 0;
        for i in 0..length {
            while part + 1 < self.lowest.len() && self.begins[part + 1] < i as f32 {
                part += 1;
            }
            let Some(&lowest) = self.lowest.get(part) else { return };
            let away = i.abs_diff(lowest);
            all[first + i * stride] = (self.values[lowest] + (away * away) as f32).min(FAR);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_robot::random::Random;

    #[test]
    fn the_distances_are_those_of_a_search() {
        let mut random = Random::new(2);
        let number = [7, 11, 5];
        for share in [0.002, 0.02, 0.3] {
            let marked: Vec<bool> = (0..7 * 11 * 5).map(|_| random.unit() < share).collect();
            let found = distances(number, |cell| marked[cell]);
            let place = |cell: usize| [cell / 55, cell / 5 % 11, cell % 5];
            for (cell, found) in found.iter().enumerate() {
                let squared = |other: usize| -> usize {
                    place(cell).iter().zip(place(other)).map(|(a, b)| a.abs_diff(b) * a.abs_diff(b)).sum()
                };
                let least = (0..marked.len()).filter(|other| marked[*other]).map(squared).min();
                assert_eq!(*found, least.map_or(FAR, |least| least as f32).sqrt());
            }
        }
    }
}
