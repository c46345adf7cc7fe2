//! Joint paths: configurations to be joined by straight lines.

/// Configurations that follow each other.
pub type Path = Vec<Vec<f64>>;

/// Euclidean distance of two configurations [rad].
pub fn distance(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(x, y)| (y - x) * (y - x)).sum::<f64>().sqrt()
}

/// Length of a path [rad], in the Euclidean norm of all joints.
pub fn length(path: &[Vec<f64>]) -> f64 {
    path.windows(2).map(|pair| distance(&pair[0], &pair[1])).sum()
}

/// Writes the configuration at part `t` of the way from `a` to `b`.
pub fn between(a: &[f64], b: &[f64], t: f64, out: &mut [f64]) {
    for ((o, x), y) in out.iter_mut().zip(a).zip(b) {
        *o = x + (y - x) * t;
    }
}

/// A path without repeated and without needless configurations: those on the line between their neighbours.
pub fn tidy(path: &[Vec<f64>]) -> Path {
    let mut tidy: Path = Vec::with_capacity(path.len());
    for q in path {
        if tidy.last().is_some_and(|last| distance(last, q) < 1e-12) {
            continue;
        }
        if let [.., before, middle] = tidy.as_slice() {
            let (first, second, whole) = (distance(before, middle), distance(middle, q), distance(before, q));
            if first + second - whole < 1e-12 * whole.max(1.0) {
                tidy.pop();
            }
        }
        tidy.push(q.clone());
    }
    tidy
}
