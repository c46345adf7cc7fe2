//! Edges that are free at all samples: parts of them that a path still has need no second check.

use smallvec::SmallVec;

use super::path::distance;
use dimos_core::trajectory::JointValues;

/// A configuration is on an edge if it is this close [rad]: rounding of what was computed as a place on it.
const ON_EDGE: f64 = 1e-9;

/// Edges that look free at all samples.
#[derive(Debug, Clone, Default)]
pub struct Sampled(SmallVec<[[JointValues; 2]; 8]>);

impl Sampled {
    /// Adds an edge.
    pub fn add(&mut self, from: &[f64], to: &[f64]) {
        self.0.push([from, to].map(JointValues::from_slice));
    }

    /// Returns whether an edge is one of them or a part of one.
    pub fn has(&self, from: &[f64], to: &[f64]) -> bool {
        self.0.iter().any(|[a, b]| is_on(from, (a, b)) && is_on(to, (a, b)))
    }
}

/// Returns whether a configuration is on an edge.
fn is_on(q: &[f64], (a, b): (&[f64], &[f64])) -> bool {
    let (mut along, mut whole) = (0.0, 0.0);
    for ((q, a), b) in q.iter().zip(a).zip(b) {
        along += (q - a) * (b - a);
        whole += (b - a) * (b - a);
    }
    let part = if whole > 0.0 { (along / whole).clamp(0.0, 1.0) } else { 0.0 };
    let nearest: JointValues = a.iter().zip(b).map(|(a, b)| a + (b - a) * part).collect();
    distance(&nearest, q) <= ON_EDGE
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::planning::search::path::between;

    #[test]
    fn parts_of_an_edge_are_known_and_what_leaves_it_is_not() {
        let (a, b) = ([0.3, -2.0, 1.0], [1.1, 0.7, -2.5]);
        let mut sampled = Sampled::default();
        assert!(!sampled.has(&a, &b) && !sampled.has(&a, &a));
        sampled.add(&a, &b);
        let at = |part| {
            let mut q = [0.0; 3];
            between(&a, &b, part, &mut q);
            q
        };
        assert!(sampled.has(&a, &b) && sampled.has(&b, &a) && sampled.has(&at(0.2), &at(0.7)) && sampled.has(&a, &a));
        assert!(!sampled.has(&a, &at(1.001)) && !sampled.has(&at(-0.001), &b));
        let [x, y, z] = at(0.5);
        assert!(!sampled.has(&a, &[x, y, z + 1e-6]));
        // An end on one edge and the other end on another: the way between them was not checked.
        sampled.add(&b, &[2.0, 2.0, 2.0]);
        assert!(!sampled.has(&at(0.5), &[2.0, 2.0, 2.0]));
    }
}
